"""The normal form of all observations: y_r = L_r u + ε_r with one variance Nλ of all rows.

Energies are known up to one constant c, the same for all of them: E = u(z) + c. In rows divided by
their noise the constant stands in the direction p = 1/noise; rows orthogonal to p do not see it.
These are the contrasts of each energy with the weighted mean of those before it,

    q_i = (n_{i−1} e_i − (p_i/n_{i−1}) Σ_{j<i} p_j e_j)/n_i,   n_i² = Σ_{j≤i} p_j²,

which are orthonormal, so that their noise is independent again: generalised least squares with the
constant estimated, exactly, in one row less. A cumulative sum makes them (Helmert's contrasts, with
weights).
"""

import dataclasses
import itertools
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from hamkernel._observations.blocks import AbstractBlock, Components, merged


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Rows:
    """All rows of some observations.

    Attributes:
        blocks: the rows before the contrast, by kind and place.
        targets: what was measured, divided by its noise, shape (M,), before the contrast too.
    """

    blocks: tuple[AbstractBlock, ...]
    targets: Float[Array, " M"]

    @property
    def count(self) -> int:
        """N: of velocities and equilibria the points, masked or not; energies; functionals."""
        return sum(block.count for block in self.blocks)

    @property
    def dimension(self) -> int:
        """n, the number of coordinates of a state."""
        return self.blocks[0].dimension

    @property
    def scale(self) -> Float[Array, " M"]:
        """The relative noise of the rows before the contrast."""
        return jnp.concatenate([block.scale for block in self.blocks])

    @property
    def size(self) -> int:
        """D, the number of rows that are left by the contrast."""
        return len(self.targets) - (len(self.energies) > 0)

    @property
    def y(self) -> Float[Array, " D"]:
        """The targets of the contrasted rows."""
        return self.contrast(self.targets)

    @property
    def slices(self) -> list[slice]:
        """Where the rows of each block stand before the contrast."""
        ends = np.cumsum([0, *(block.size for block in self.blocks)]).tolist()
        return [slice(a, b) for a, b in itertools.pairwise(ends)]

    @property
    def energies(self) -> Int[np.ndarray, " E"]:
        """The rows that see the unknown constant."""
        if not any(block.of_values for block in self.blocks):
            return np.arange(0)
        M = np.arange(len(self.targets))
        pairs = zip(self.slices, self.blocks, strict=True)
        return np.concatenate([M[rows] for rows, block in pairs if block.of_values] or [M[:0]])

    @property
    def constant(self) -> Float[Array, " M"] | None:
        """The direction of the unknown constant, of norm 1; None without energies."""
        where = self.energies
        if not len(where):
            return None
        p = jnp.zeros_like(self.targets).at[where].set(1 / self.scale[where])
        return p / jnp.linalg.norm(p)

    @property
    def states(self) -> tuple[Float[Array, "N d"], Float[Array, "N n"]] | None:
        """Points and velocities, where all were measured with one noise; None of other rows."""
        block = self.blocks[0]
        plain = len(self.blocks) == 1 and isinstance(block, Components)
        if not plain or block.kept is not None or block.noise is not None:
            return None
        return block.points, self.targets.reshape(block.values_shape)

    def labels(self) -> Int[np.ndarray, " M"]:
        """To which of the N observations each row belongs, before the contrast."""
        starts = np.cumsum([0, *(block.count for block in self.blocks)])
        pairs = zip(starts, self.blocks, strict=False)
        return np.concatenate([start + block.labels() for start, block in pairs])

    @property
    def points(self) -> Float[Array, "P d"]:
        """All points of all blocks, (x, u) where there are inputs."""
        return jnp.concatenate([block.points for block in self.blocks])

    def of(
        self,
        field: Callable[[Float[Array, "P n"]], Float[Array, "P n"]],
        potential: Callable[[Float[Array, "E n"]], Float[Array, " E"]],
    ) -> Float[Array, " M"]:
        """The rows of a field and its potential, given at many points, before the contrast."""
        blocks = self.blocks
        return jnp.concatenate(
            [b.rows((potential if b.of_values else field)(b.points)) for b in blocks]
        )

    def less(self, known: Float[Array, " M"]) -> "Rows":
        """The same rows of what is left when the rows of something known are taken off."""
        return dataclasses.replace(self, targets=self.targets - known)

    def measured(self) -> Float[Array, " M"]:
        """The targets in their own units, less the constant that the energies have on average."""
        return self.scale * self.uncontrasted(self.y)

    def joined(self, new: "Rows") -> "Rows":
        """These rows and then the new ones."""
        blocks = merged(self.blocks + new.blocks)
        return Rows(blocks, jnp.concatenate([self.targets, new.targets]))

    def beside(self, new: "Rows") -> "Rows":
        """The new rows, after those of these that their contrasts need: the energies, if any."""
        pairs = [(b, self.targets[rows]) for b, rows in zip(self.blocks, self.slices, strict=True)]
        old = [(b, y) for b, y in pairs if b.of_values and len(new.energies)]
        blocks, targets = (tuple(block for block, _ in old), [y for _, y in old])
        return Rows(blocks + new.blocks, jnp.concatenate([*targets, new.targets]))

    def some(self, chosen: Int[np.ndarray, " C"]) -> tuple["Rows", Int[np.ndarray, " chosen"]]:
        """The rows of some of the N observations, in order, and which observations those are.

        Rows that share points come with each other, and one energy alone, which says nothing, is
        left out.
        """
        ends = np.cumsum([0, *(block.count for block in self.blocks)]).tolist()
        own = [chosen[(a <= chosen) & (chosen < b)] - a for a, b in itertools.pairwise(ends)]
        pairs = list(zip(self.blocks, own, strict=True))
        energies = sum(len(each) for block, each in pairs if block.of_values)
        blocks, targets, taken = [], [], []
        for (block, each), place, start in zip(pairs, self.slices, ends, strict=False):
            if len(each) and not (block.of_values and energies == 1):
                part, rows, these = block.some(each)
                blocks.append(part)
                targets.append(np.asarray(self.targets)[place][rows])
                taken.append(start + these)
        return Rows(tuple(blocks), jnp.asarray(np.concatenate(targets))), np.concatenate(taken)

    def residual(self, left: Float[Array, " D"]) -> Float[Array, "..."]:
        """What a fit leaves of the contrasted rows, in the units of what was measured.

        Of velocities alone, all of which were measured, shape (N, n).
        """
        return self.in_units(self.uncontrasted(left))

    def in_units(self, left: Float[Array, " M"]) -> Float[Array, "..."]:
        """Rows before the contrast in the units of what was measured, and in the shape of Y."""
        block = self.blocks[0]
        whole = len(self.blocks) == 1 and isinstance(block, Components) and block.kept is None
        left = self.scale * left
        return left.reshape(block.values_shape) if whole else left

    def contrast(self, rows: Float[Array, "M *rest"]) -> Float[Array, "D *rest"]:
        """The rows without the constant of the energies."""
        where = self.energies
        if not len(where):
            return rows
        p, sizes = self._constant(rows)
        energies = rows[where]
        before = jnp.cumsum(p * energies, axis=0)[:-1] / sizes[:-1]
        contrasts = (sizes[:-1] * energies[1:] - p[1:] * before) / sizes[1:]
        kept = np.delete(np.arange(len(rows)), where[0])
        return rows.at[where[1:]].set(contrasts)[kept]

    def uncontrasted(self, c: Float[Array, "D *rest"]) -> Float[Array, "M *rest"]:
        """The transpose of `contrast`."""
        where = self.energies
        if not len(where):
            return c
        rows = jnp.zeros((len(self.targets), *c.shape[1:]), c.dtype)
        rows = rows.at[np.delete(np.arange(len(rows)), where[0])].set(c)
        p, sizes = self._constant(rows)
        energies = rows[where][1:] / sizes[1:]
        # Σ_{i>j} of each contrast, from the last one on.
        after = jnp.cumsum((p[1:] / sizes[:-1] * energies)[::-1], axis=0)[::-1]
        none = jnp.zeros_like(after[:1])
        own = jnp.concatenate([none, sizes[:-1] * energies])
        return rows.at[where].set(own - p * jnp.concatenate([after, none]))

    def _constant(self, rows: Float[Array, "M *rest"]) -> tuple[Array, Array]:
        """Of the energies p = 1/noise, and n_i, beside rows."""
        p = 1 / self.scale[self.energies]
        sizes = jnp.sqrt(jnp.cumsum(p**2))
        beside = (-1, *[1] * (rows.ndim - 1))
        return p.reshape(beside), sizes.reshape(beside)

    def coefficients(
        self, c: Float[Array, " D"]
    ) -> tuple[Float[Array, "P d"], Float[Array, "P n"], Float[Array, "E d"], Float[Array, " E"]]:
        """Points and coefficients of the field Lᵀc, and those of its values.

        Of energies alone there is one point of the field, with coefficients of zero.
        """
        raw = self.uncontrasted(c)
        pairs = [(b, b.coefficients(raw[s])) for b, s in zip(self.blocks, self.slices, strict=True)]
        none = self.blocks[0].points[:1]
        fields = [(b.points, a) for b, a in pairs if not b.of_values]
        values = [(b.points, a) for b, a in pairs if b.of_values]
        fields = fields or [(none, jnp.zeros((1, self.dimension), raw.dtype))]
        values = values or [(none[:0], jnp.zeros(0, raw.dtype))]
        Z, A = (jnp.concatenate(each) for each in zip(*fields, strict=True))
        S, b = (jnp.concatenate(each) for each in zip(*values, strict=True))
        return Z, A, S, b
