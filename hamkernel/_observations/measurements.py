"""The normal form of all observations: y_r = L_r u + ε_r with one variance Nλ of all rows.

This module joins inputs to their states. With inputs a point is (x, u), with d = n + m coordinates,
and the field at a point has n components. The Gram, the solvers and the losses need not know which
coordinates are inputs.

Energies are known up to one common constant c, E = u(z) + c. In rows divided by their noise the
constant has the direction p = 1/noise, and linear combinations orthogonal to p do not depend on c.
Such combinations are the contrasts of each energy with the weighted mean of the energies before it,

    q_i = (n_{i−1} e_i − (p_i/n_{i−1}) Σ_{j<i} p_j e_j)/n_i,   n_i² = Σ_{j≤i} p_j².

The contrasts are orthonormal, so their noise is independent again. A fit to the contrasts is
exactly generalised least squares with an estimated constant, with one row fewer. These are
Helmert's contrasts with weights; a cumulative sum computes them.
"""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from hamkernel import _require as require
from hamkernel._machine import automatic, is_on_one_device
from hamkernel._observations.blocks import AbstractBlock, Components, merge
from hamkernel._observations.kinds import (
    AbstractObservations,
    Equilibria,
    Velocities,
    refuse_swapped,
)
from hamkernel._structures.base import AbstractMatrixKernel
from hamkernel._structures.completed import shared_laws
from hamkernel._structures.joined import AbstractJoinedKernel

# Points and coefficients of the field, then of the values.
Representer = tuple[
    Float[Array, "P d"], Float[Array, "P n"], Float[Array, "E d"], Float[Array, " E"]
]


class Measurements(eqx.Module):
    """The rows of observations: the map L in blocks, and the targets y.

    There are M rows before the contrast of the energies and D ≤ M after it.

    Attributes:
        blocks: the M rows of L, one block for each kind of observation.
        targets: the M measured values, each divided by its relative noise, shape (M,).
    """

    blocks: tuple[AbstractBlock, ...]
    targets: Float[Array, " M"]

    @property
    def count(self) -> int:
        """N, the number of points of velocities and equilibria, of energies and of functionals."""
        return sum(block.count for block in self.blocks)

    @property
    def dimension(self) -> int:
        """n, the number of coordinates of a state."""
        return self.blocks[0].dimension

    @property
    def scale(self) -> Float[Array, " M"]:
        """The relative noise of each of the M rows."""
        return jnp.concatenate([block.scale for block in self.blocks])

    @property
    def size(self) -> int:
        """D, the number of rows after the contrast."""
        return len(self.targets) - (len(self.energies) > 0)

    @property
    def y(self) -> Float[Array, " D"]:
        """The targets after the contrast."""
        return self.contrast(self.targets)

    @property
    def slices(self) -> list[slice]:
        """The positions of the rows of each block among the M rows."""
        ends = np.cumsum([0, *(block.size for block in self.blocks)]).tolist()
        return [slice(a, b) for a, b in itertools.pairwise(ends)]

    @property
    def energies(self) -> Int[np.ndarray, " E"]:
        """The positions of the rows that depend on the unknown constant, among the M rows."""
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
        """Points and velocities, if all rows are velocities of one noise; else None."""
        block = self.blocks[0]
        if len(self.blocks) > 1 or not isinstance(block, Components):
            return None
        if block.kept is not None or block.noise is not None:
            return None
        return block.points, self.targets.reshape(block.values_shape)

    def labels(self) -> Int[np.ndarray, " M"]:
        """The index of the observation, of N, of each of the M rows."""
        starts = np.cumsum([0, *(block.count for block in self.blocks)])
        pairs = zip(starts, self.blocks, strict=False)
        return np.concatenate([start + block.labels() for start, block in pairs])

    @property
    def points(self) -> Float[Array, "P d"]:
        """The points of all blocks; (x, u) if there are inputs."""
        return jnp.concatenate([block.points for block in self.blocks])

    def evaluate(
        self,
        field: Callable[[Float[Array, "P n"]], Float[Array, "P n"]],
        potential: Callable[[Float[Array, "E n"]], Float[Array, " E"]],
    ) -> Float[Array, " M"]:
        """The M rows of a field and its potential, both functions of many points at once."""
        blocks = self.blocks
        return jnp.concatenate(
            [b.rows((potential if b.of_values else field)(b.points)) for b in blocks]
        )

    def subtract(self, known_rows: Float[Array, " M"]) -> Measurements:
        """The measurements of f − g, given the M rows of a known field g."""
        return dataclasses.replace(self, targets=self.targets - known_rows)

    def measured_values(self) -> Float[Array, " M"]:
        """The targets in the units of the data; energies minus their weighted mean."""
        return self.scale * self.contrast_transpose(self.y)

    def append(self, new: Measurements) -> Measurements:
        """The measurements with new rows at the end."""
        blocks = merge(self.blocks + new.blocks)
        return Measurements(blocks, jnp.concatenate([self.targets, new.targets]))

    def with_previous(self, new: Measurements) -> Measurements:
        """The new rows, preceded by the old energies if there are new energies.

        The contrasts of new energies need the old energies.
        """
        pairs = [(b, self.targets[rows]) for b, rows in zip(self.blocks, self.slices, strict=True)]
        old = [(b, y) for b, y in pairs if b.of_values and len(new.energies)]
        blocks, targets = (tuple(block for block, _ in old), [y for _, y in old])
        return Measurements(blocks + new.blocks, jnp.concatenate([*targets, new.targets]))

    def subset(
        self, chosen: Int[np.ndarray, " C"]
    ) -> tuple[Measurements, Int[np.ndarray, " chosen"]]:
        """The rows of some of the N observations, and the indices of these observations.

        The indices `chosen` are in increasing order. Rows that share points stay together. A single
        energy has no contrast and is left out.
        """
        ends = np.cumsum([0, *(block.count for block in self.blocks)]).tolist()
        local_indices = [
            chosen[(a <= chosen) & (chosen < b)] - a for a, b in itertools.pairwise(ends)
        ]
        pairs = list(zip(self.blocks, local_indices, strict=True))
        energies = sum(len(local) for block, local in pairs if block.of_values)
        blocks, targets, taken = [], [], []
        for (block, local), place, start in zip(pairs, self.slices, ends, strict=False):
            if len(local) and not (block.of_values and energies == 1):
                part, rows, labels = block.subset(local)
                blocks.append(part)
                targets.append(np.asarray(self.targets)[place][rows])
                taken.append(start + labels)
        return Measurements(tuple(blocks), jnp.asarray(np.concatenate(targets))), np.concatenate(
            taken
        )

    def residual(self, contrasts: Float[Array, " D"]) -> Float[Array, "..."]:
        """The residual y − f in the units of the data, from the residual of the D contrasts.

        The shape is (N, n) for completely measured velocities, else (M,).
        """
        return self.to_units(self.contrast_transpose(contrasts))

    def to_units(self, values: Float[Array, " M"]) -> Float[Array, "..."]:
        """M rows in the units of the data; shape (N, n) for completely measured velocities."""
        block = self.blocks[0]
        is_complete = len(self.blocks) == 1 and isinstance(block, Components) and block.kept is None
        values = self.scale * values
        return values.reshape(block.values_shape) if is_complete else values

    def contrast(self, rows: Float[Array, "M *rest"]) -> Float[Array, "D *rest"]:
        """The D contrasts of M rows, which do not depend on the constant of the energies."""
        where = self.energies
        if not len(where):
            return rows
        # q_i = (n_{i−1} e_i − p_i before_i)/n_i with before_i = (Σ_{j<i} p_j e_j)/n_{i−1}
        p, sizes = self._constant(rows)
        energies = rows[where]
        before = jnp.cumsum(p * energies, axis=0)[:-1] / sizes[:-1]
        contrasts = (sizes[:-1] * energies[1:] - p[1:] * before) / sizes[1:]
        remaining = np.delete(np.arange(len(rows)), where[0])
        return rows.at[where[1:]].set(contrasts)[remaining]

    def contrast_transpose(self, c: Float[Array, "D *rest"]) -> Float[Array, "M *rest"]:
        """The transpose of the linear map `contrast`."""
        where = self.energies
        if not len(where):
            return c
        rows = jnp.zeros((len(self.targets), *c.shape[1:]), c.dtype)
        rows = rows.at[np.delete(np.arange(len(rows)), where[0])].set(c)
        p, sizes = self._constant(rows)
        energies = rows[where][1:] / sizes[1:]
        # Σ_i T_ij c_i = n_{j−1} c_j/n_j − p_j Σ_{i>j} p_i c_i/(n_{i−1} n_i) for the column j. The
        # sums over i > j are accumulated from the last contrast backward.
        after = jnp.cumsum((p[1:] / sizes[:-1] * energies)[::-1], axis=0)[::-1]
        none = jnp.zeros_like(after[:1])
        direct = jnp.concatenate([none, sizes[:-1] * energies])
        return rows.at[where].set(direct - p * jnp.concatenate([after, none]))

    def _constant(self, rows: Float[Array, "M *rest"]) -> tuple[Array, Array]:
        """The arrays p_i and n_i of the energies, with trailing axes that broadcast over rows."""
        p = 1 / self.scale[self.energies]
        sizes = jnp.sqrt(jnp.cumsum(p**2))
        shape = (-1, *[1] * (rows.ndim - 1))
        return p.reshape(shape), sizes.reshape(shape)

    def coefficients(self, c: Float[Array, " D"]) -> Representer:
        """The representer Lᵀc: points z and coefficients a of the field, s and b of the values.

        If all rows are energies, the field has one point, with a = 0.
        """
        return self.representer(self.contrast_transpose(c))

    def representer(self, raw: Float[Array, " M"]) -> Representer:
        """The representer of the M rows before the contrast, as `coefficients` of the D rows."""
        pairs = [(b, b.coefficients(raw[s])) for b, s in zip(self.blocks, self.slices, strict=True)]
        none = self.blocks[0].points[:1]
        fields = [(b.points, a) for b, a in pairs if not b.of_values]
        values = [(b.points, a) for b, a in pairs if b.of_values]
        fields = fields or [(none, jnp.zeros((1, self.dimension), raw.dtype))]
        values = values or [(none[:0], jnp.zeros(0, raw.dtype))]
        Z, A = (jnp.concatenate(parts) for parts in zip(*fields, strict=True))
        S, b = (jnp.concatenate(parts) for parts in zip(*values, strict=True))
        return Z, A, S, b


def measurements(
    K: AbstractMatrixKernel, X: Any, Y: Any = None, inputs: Any = None
) -> tuple[AbstractMatrixKernel, Measurements]:
    """The kernel with its number of inputs, and the rows of the data, checked.

    Args:
        K: the kernel.
        X: states, shape (N, n), or observations, and then there are no Y and no inputs.
        Y: velocities, shape (N, n).
        inputs: u at each state, for a `Controlled` kernel, shape (N, m).

    Raises:
        TypeError, ValueError: as `fit` says.
    """
    many = bool(shared_laws(K))  # a state has many parts, so few states are enough
    if inputs is None and not isinstance(X, AbstractObservations) and not K.takes_inputs:
        return K, measurements_of_states(*place(velocities_at(X, Y, part=many)))
    return measurements_of(K, place(observations(X, Y, inputs, many, K.input_name)))


def observations(
    X: Any, Y: Any, inputs: Any = None, part: bool = False, name: str = "inputs"
) -> AbstractObservations:
    """The observations X, or the velocities Y at the states X.

    `name` is "parameters" if `inputs` are the parameters of a family.
    """
    if not isinstance(X, AbstractObservations):
        return Velocities(*velocities_at(X, Y, inputs, part), **{name: inputs})
    if Y is not None:
        raise TypeError(
            f"X is {type(X).__name__}, which contains all the data, and a third argument Y came: "
            "leave Y out, and pass λ by name, hk.fit(K, data, regularization=1e-4)."
        )
    if inputs is not None:
        raise TypeError(
            "observations contain their inputs: pass them there, hk.Velocities(X, Y, inputs=U), "
            "and likewise to hk.Equilibria and hk.Functionals."
        )
    return X


def velocities_at(
    X: Any, Y: Any, inputs: Any = None, part: bool = False
) -> tuple[Float[Array, "N n"], Float[Array, "N n"]]:
    """States and velocities, finite and of one shape and dtype."""
    if Y is None:
        cure = (
            "give the velocities Y, of the same shape (N, n) as X, or observations in place of "
            "both, hk.Velocities(X, Y)."
        )
        if hasattr(X, "velocities"):
            cure = (
                "hk.learn(K, runs) needs no velocities; smoothed ones are X, Y, labels = "
                "runs.velocities()."
            )
        raise TypeError(f"X is {type(X).__name__} and Y is missing: {cure}")
    refuse_swapped(X, Y, inputs)
    return require.data(X, Y, part=part)


def place(data: Any) -> Any:
    """The data, with arrays on a mesh of devices moved to automatic axes of the mesh."""
    if all(is_on_one_device(array) for array in jax.tree.leaves(data)):
        return data
    return jax.tree.map(automatic, data)


def measurements_of_states(X: Float[Array, "N d"], Y: Float[Array, "N n"]) -> Measurements:
    """The rows of velocities at points, all with the same noise."""
    outputs = None if X.shape == Y.shape else Y.shape[1]
    return Measurements((Components(X, outputs=outputs),), Y.reshape(-1))


def measurements_of(
    K: AbstractMatrixKernel, data: AbstractObservations, previous: Measurements | None = None
) -> tuple[AbstractMatrixKernel, Measurements]:
    """The kernel with its number of inputs, and the rows of observations.

    Args:
        K: the kernel.
        data: the observations.
        previous: the rows to which `data` is added, if any.

    Raises:
        ValueError: inputs are missing, or the data cannot distinguish their effect from the drift;
            or there is a single energy. TypeError: K takes no inputs.
    """
    K = with_input_count(K, data, part=previous is not None)
    blocks, targets = zip(*data.parts(inputs_of(K), K.input_name), strict=True)
    dtype = np.result_type(*[block.points.dtype for block in blocks])
    blocks = tuple(_cast(block, dtype) for block in blocks)
    divided = [
        y.astype(dtype) if block.noise is None else y.astype(dtype) / block.noise
        for block, y in zip(blocks, targets, strict=True)
    ]
    rows = Measurements(merge(blocks), jnp.concatenate(divided))
    before = 0 if previous is None else len(previous.energies)
    if before + len(rows.energies) == 1:
        raise ValueError(
            "there is one energy, and energies are known up to a constant: give two or more."
        )
    return K, rows


def sampled_points(
    K: AbstractMatrixKernel, X: Float[Array, "N n"], inputs: Any
) -> tuple[AbstractMatrixKernel, Float[Array, "N d"]]:
    """The kernel with its number of inputs, and points (x, u) without measurements."""
    data = Equilibria(X, inputs)
    K = with_input_count(K, data)
    (block, _), *_ = data.parts(inputs_of(K), K.input_name)
    return K, block.points


def inputs_of(K: AbstractMatrixKernel) -> int:
    """The number m of inputs; 0 for a kernel without inputs."""
    return K.input_count if isinstance(K, AbstractJoinedKernel) else 0


def with_input_count(
    K: AbstractMatrixKernel, data: AbstractObservations, part: bool = False
) -> AbstractMatrixKernel:
    """The kernel with its number of inputs, taken from the data.

    The inputs or parameters of complete data must vary. For a `part` of the data they may be
    constant.
    """
    all_inputs = list(data.all_inputs())
    if not isinstance(K, AbstractJoinedKernel):
        if all_inputs:
            raise TypeError(
                f"{type(K).__name__} takes no inputs: use hk.Controlled(K, "
                "inputs=hk.InputMatrix(k, acts_on=(1,))) for inputs, and hk.Family(K, k) for the "
                "parameters of a family."
            )
        return K
    counts = {u.shape[-1] for u in all_inputs}
    if len(counts) > 1:
        raise ValueError(
            f"the observations have {sorted(counts)} {K.input_name}: all need as many."
        )
    if not counts:
        list(data.parts(1, K.input_name))  # raises where they are needed
        return K
    count = counts.pop()
    if K.count is not None and K.count != count:
        raise ValueError(
            f"{K.input_name} has {count} columns and the kernel {K.count} {K.input_name}."
        )
    K = K.with_count(count)
    K.check_dimension(data.dimension + count)
    if not part and require.is_concrete(all_inputs):
        K.check_identified(np.concatenate([np.asarray(u).reshape(-1, count) for u in all_inputs]))
    return K


def _cast(block: AbstractBlock, dtype: Any) -> AbstractBlock:
    if block.points.dtype == dtype:
        return block
    arrays, rest = eqx.partition(block, eqx.is_inexact_array)
    return eqx.combine(jax.tree.map(lambda a: a.astype(dtype), arrays), rest)
