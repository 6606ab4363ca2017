"""Laws that many parts share: u(x) = Σ_p c_p w(φ_p(x)) with one unknown function w.

The value of u at x is a weighted sum of values of w at the points φ_p(x). The derivative of u along
v is the same sum of derivatives of w along Dφ_p(x) v. If w ~ GP(0, k), then u has the kernel

    k_S(x, z) = Σ_pq c_p c_q k(φ_p(x), φ_q(z)).

Let C be m centres in the space of the parts. In their span w(r) = k(r, C) L⁻ᵀ a with
L Lᵀ = k(C, C) and a ~ N(0, I). Then u(x) = Φ(x)·a with

    Φ(x) = L⁻¹ Σ_p c_p k(C, φ_p(x)),   ∂Φ/∂x = L⁻¹ Σ_p c_p ∂₂k(C, φ_p(x)) Dφ_p(x)

for constant weights c_p, with ∂₂ the derivative in the second argument. A system of any size thus
has m unknowns. If the parts obey several laws with one kernel, each law has m features of its own,
summed over its parts.
"""

import itertools
from collections.abc import Callable, Sequence
from typing import Any, Literal, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jax.scipy.linalg import solve_triangular
from jaxtyping import Array, ArrayLike, Float, Int

from hamkernel import _require as require
from hamkernel._kernels.base import (
    AbstractScalarKernel,
    Descriptor,
    Point,
    as_scalar_kernel,
    one_point,
)
from hamkernel._kernels.functions import as_pytree
from hamkernel._kernels.symmetry import LinearMap, close_group
from hamkernel._machine import compiled_by_size
from hamkernel._show import call, describe, text

_AT_ONCE = 2**16  # parts times centres of one batch: arrays of 512 KB
_CENTRES = 64  # centres of a law; with one variable they resolve a thirtieth of the range
_FEWEST_CENTRES, _FEATURES = 20, 320  # if there are many laws: of each law, and of all laws


class Shared(AbstractScalarKernel):
    """The kernel of u(x) = Σ_p c_p w(φ_p(x)): one unknown law w that many parts share.

        K = hk.Symplectic(hk.Shared(hk.Matern(2.5, 1.0), hk.pairs(particles=30, dim=2)))
        field = hk.fit(K, X, Y, 1e-6, mean=hk.kinetic(mass=1.0))
        V = jax.vmap(field.law)(r)  # the pair potential, up to a constant

    A constant in w changes no velocity, so `field.law` is known up to a constant. If there are
    several laws, a linear term may move from one law to another (see `field.undetermined`). Outside
    the values of φ in the data the law is unknown, and `posterior.law_deviation` is large.

    Parts may obey several laws with one kernel. With one law for each of the ten pairs of five
    particles, for example, `field.law(r, r0, which)` shows which particles springs connect:

        K = hk.Symplectic(hk.Shared(k, hk.pairs(particles=5, dim=2), laws=range(10)))

    Args:
        kernel: the kernel k of w, on points of the parts, (d,).
        parts: x (n,) -> points (P, d), or (points, weights c) with weights (P,); `hk.pairs`,
            `hk.neighbours`, `hk.sites`, or a function of your own.
        centres: points c of the parts, shape (m, d), such that the k(·, c) span w. If None, a fit
            takes up to 64 points spread over the parts of the data, and fewer for many laws.
        laws: the number of the law of each part, from 0, shape (P,); if None, one law for all.

    Raises:
        TypeError: `kernel` is no scalar kernel or `parts` no function.
        ValueError: `laws` are not the numbers 0, 1, … without gaps. When called, `parts` returns
            other shapes, or `laws` has another length.
    """

    kernel: AbstractScalarKernel
    parts: Callable[..., Any]
    # Python numbers, since `tune` trains the arrays of a kernel.
    centres: tuple[tuple[float, ...], ...] | None = eqx.field(static=True)
    laws: tuple[int, ...] | None = eqx.field(static=True)

    def __init__(
        self,
        kernel: Any,
        parts: Callable[..., Any],
        centres: ArrayLike | None = None,
        laws: Sequence[int] | Int[np.ndarray, " P"] | None = None,
    ):
        if not callable(parts) or isinstance(parts, AbstractScalarKernel):
            raise TypeError(
                "Shared needs a kernel and then a function x -> points (P, d), such as "
                f"Shared(k, hk.pairs(particles=30, dim=2)); got {parts!r} as parts."
            )
        self.kernel = as_scalar_kernel(kernel)
        self.parts = as_pytree(parts)
        self.centres = None
        if centres is not None:
            points = np.asarray(centres, float)
            points = points[:, None] if points.ndim == 1 else points
            self.centres = tuple(tuple(map(float, point)) for point in points)
        self.laws = None if laws is None else _law_numbers(laws)

    def __repr__(self) -> str:
        said = [] if self.centres is None else [f"centres={len(self.centres)}"]
        said += [] if self.laws is None else [f"laws={self.law_count}"]
        return call("Shared", [repr(self.kernel), text(self.parts), *said])

    def __call__(self, x: Float[Array, " n"], z: Float[Array, " n"]) -> Float[Array, ""]:
        if self.centres is not None:
            return self.features(x) @ self.features(z)
        (X, a), (Z, b) = self.parts_at(x), self.parts_at(z)
        rows = jax.vmap(jax.vmap(self.kernel, (None, 0)), (0, None))(X, Z)
        laws = self.part_laws(len(X))
        return a @ jnp.where(laws[:, None] == laws[None], rows, 0.0) @ b

    @property
    def law_count(self) -> int:
        """The number of laws."""
        return 1 if self.laws is None else max(self.laws) + 1

    @property
    def columns(self) -> int:
        """The number of features, m for each law."""
        return self.law_count * len(self.centres or ())

    def parts_at(self, x: Float[Array, " n"]) -> "Parts":
        """The points and the weights of the parts of one state."""
        x = one_point(x)
        with require.traceable("the parts function of Shared"):
            result = self.parts(x)
        points, weights = result if isinstance(result, tuple) else (result, 1.0)
        if jnp.ndim(points) != 2 or jnp.shape(weights) not in ((), jnp.shape(points)[:1]):
            raise ValueError(
                f"the parts of Shared are of shape {jnp.shape(points)}, with weights "
                f"{jnp.shape(weights)}, for a state of shape {x.shape}; points (P, d), and weights "
                "(P,) if any, are needed. For one number a part return points[:, None]."
            )
        points = require.floating(points, "the parts of Shared").astype(x.dtype)
        weights = require.floating(weights, "the weights of Shared").astype(x.dtype)
        copies = self.parts.copies(len(x)) if isinstance(self.parts, GroupParts) else 1
        if self.laws is not None and len(points) != copies * len(self.laws):
            raise ValueError(
                f"laws= has the laws of {len(self.laws)} parts, and there are "
                f"{len(points) // copies}: give a number for each part."
            )
        return Parts(points, jnp.broadcast_to(weights, points.shape[:1]))

    def part_laws(self, parts: int) -> Int[np.ndarray, " P"]:
        """The law of each part."""
        return np.resize(np.asarray(self.laws or (0,)), parts)  # repeated for each image of a group

    def features(self, x: Float[Array, " n"]) -> Float[Array, " r"]:
        """The features Φ(x), with k_S(x, z) = Φ(x)·Φ(z)."""
        return Laws((self,)).features(x)

    def gradients(self, x: Float[Array, " n"]) -> Float[Array, "n r"]:
        """The gradients of the features."""
        return Laws((self,)).gradients(x)

    def point(self, r: ArrayLike) -> Float[Array, " d"]:
        """The argument of the kernel for an argument r of the law, such as log r for a distance."""
        point = jnp.atleast_1d(require.floating(r, "r"))
        point = getattr(self.parts, "coordinate", lambda r: r)(point)
        d = len((self.centres or ((0.0,),))[0])
        require.shape(
            point, "r has", "one point", (d,), cure="Use jax.vmap(field.law)(r) for many."
        )
        return point

    def law(self, point: Float[Array, " d"]) -> Float[Array, " m"]:
        """The features L⁻¹ k(C, point) of a law w at one point of the parts."""
        C = self._points(point.dtype)
        values = jax.vmap(self.kernel, (None, 0))(point, C)
        return solve_triangular(root_at(self.kernel, C), values, lower=True)

    def missing(self, point: Float[Array, " d"], origin: Float[Array, " d"]) -> Float[Array, ""]:
        """The prior variance of w(point) − w(origin) outside the span of the centres."""
        k = self.kernel
        prior = k(point, point) - 2 * k(point, origin) + k(origin, origin)
        carried = self.law(point) - self.law(origin)
        return jnp.maximum(prior - carried @ carried, 0.0)

    def _points(self, dtype: Any) -> Float[Array, "m d"]:
        assert self.centres is not None
        return jnp.asarray(np.asarray(self.centres), dtype)

    def through_descriptor(self, n: int) -> Descriptor | None:
        if self.centres is None:
            return None
        return Descriptor(
            self.features,
            InnerProduct(),
            jacobian=lambda x: self.gradients(x).T,
            point_data=lambda x: ravel_pytree(self.parts_at(x))[0],
        )

    def supports(self, n: int) -> tuple[frozenset[int], ...]:
        return (frozenset(range(getattr(self.parts, "positions", n))),)

    def transform_inputs(self, X: Float[np.ndarray, "N n"]) -> Float[np.ndarray, "N d"]:
        return self.spread(X, 16 * _CENTRES)

    def spread(self, X: Float[np.ndarray, "N n"], limit: int) -> Float[np.ndarray, "m d"]:
        """Up to `limit` points of the parts of X, spread over their range.

        On a line the points are an even grid. Otherwise each point is the farthest from all points
        before it.
        """
        rows = jnp.asarray(X[np.linspace(0, len(X) - 1, min(len(X), 256)).astype(int)])
        parts = np.asarray(_points_of_parts(self, rows))
        points = parts.reshape(-1, parts.shape[-1])
        low, high = points.min(axis=0), points.max(axis=0)
        if not (np.isfinite(low).all() and np.isfinite(high).all()):
            raise ValueError(
                "the parts of Shared are not finite at the data: two particles in one place have "
                "no distance to take a logarithm of. Leave such states out."
            )
        unit = points / np.where(high > low, high - low, 1.0)
        if points.shape[1] == 1 and len(points) > limit:
            return np.unique(np.linspace(low, high, limit), axis=0)
        return points[far_apart(unit, limit)]

    def with_centres(self, X: Float[np.ndarray, "N n"]) -> "Shared":
        """The same kernel with centres among the parts of the states X."""
        count = int(np.clip(_FEATURES // self.law_count, _FEWEST_CENTRES, _CENTRES))
        return Shared(self.kernel, self.parts, self.spread(X, count), self.laws)


@compiled_by_size
def _points_of_parts(law: Shared, X: Float[Array, "N n"]) -> Float[Array, "N P d"]:
    return jax.lax.map(lambda x: law.parts_at(x).points, X)


class Laws(eqx.Module):
    """`Shared` kernels of one structure, see `alike`, whose features one program evaluates.

    The features are in the order of the kernels, of their laws, and of their centres.
    """

    terms: tuple[Shared, ...]

    def features(self, x: Float[Array, " n"]) -> Float[Array, " r"]:
        """The features Φ(x), with k_S(x, z) = Φ(x)·Φ(z)."""
        (points, weights), owner, laws = self._join([term.parts_at(x) for term in self.terms])

        def feature(c):
            values = jax.vmap(lambda r, t: self._kernel(t)(r, c[t]))(points, owner)
            return jax.ops.segment_sum(weights * values, laws, self._law_count)

        return self._whiten(self._over_centres(feature, len(points), x.dtype)).ravel()

    def gradients(self, x: Float[Array, " n"]) -> Float[Array, "n r"]:
        """The gradients of the features, with one reverse derivative of the parts for each."""
        by_term, vjps = zip(*(jax.vjp(term.parts_at, x) for term in self.terms), strict=True)
        (points, weights), owner, laws = self._join(by_term)
        of_law = jnp.asarray(laws[None] == np.arange(self._law_count)[:, None], x.dtype)

        def gradient(c):
            value, slope = jax.vmap(lambda r, t: jax.value_and_grad(self._kernel(t))(r, c[t]))(
                points, owner
            )
            slope, rows, part, law = weights[:, None] * slope, [], 0, 0
            for term, parts, vjp in zip(self.terms, by_term, vjps, strict=True):
                at = slice(part, part := part + len(parts.weights))
                masks = of_law[law : (law := law + term.law_count), at]
                cotangents = Parts(masks[:, :, None] * slope[None, at], masks * value[None, at])
                rows.append(jax.vmap(lambda cotangent, vjp=vjp: vjp(cotangent)[0])(cotangents))
            return jnp.concatenate(rows)

        rows = self._over_centres(gradient, len(points) * self._law_count, x.dtype)
        return self._whiten(rows).reshape(-1, len(x)).T

    def slope(self, x: Float[Array, " n"], w: Float[Array, " r"]) -> Float[Array, " n"]:
        """The product `gradients(x) @ w`, with one reverse derivative of the parts."""
        by_term, vjp = jax.vjp(lambda x: [term.parts_at(x) for term in self.terms], x)
        (points, weights), owner, laws = self._join(by_term)
        C = self._centres(x.dtype)
        w = w.reshape(self._law_count, -1)
        coefficients = jax.lax.map(
            lambda both: solve_triangular(*both, lower=True, trans="T"), (self.roots(x.dtype), w)
        )

        def value_and_slope(part):
            r, t, law = part
            columns = jax.vmap(self._kernel(t), (None, 0))
            return jax.value_and_grad(lambda r: columns(r, C[:, t]) @ coefficients[law])(r)

        at_once = max(1, _AT_ONCE // len(C))
        value, slope = jax.lax.map(value_and_slope, (points, owner, laws), batch_size=at_once)
        slope = weights[:, None] * slope
        ends = np.cumsum([len(parts.weights) for parts in by_term])[:-1]
        pieces = zip(jnp.split(slope, ends), jnp.split(value, ends), strict=True)
        return vjp([Parts(*both) for both in pieces])[0]

    @property
    def _law_count(self) -> int:
        return sum(term.law_count for term in self.terms)

    def _join(self, by_term: Sequence["Parts"]) -> tuple["Parts", np.ndarray, np.ndarray]:
        """All parts, and the term and the law of each."""
        counts, first = [len(parts.weights) for parts in by_term], 0
        laws = []
        for term, count in zip(self.terms, counts, strict=True):
            laws.append(first + term.part_laws(count))
            first += term.law_count
        parts = jax.tree.map(lambda *arrays: jnp.concatenate(arrays), *by_term)
        return parts, np.repeat(np.arange(len(counts)), counts), np.concatenate(laws)

    def _kernel(self, t: Int[ArrayLike, ""]) -> Any:
        """The kernel of term t."""
        if len(self.terms) == 1:
            return self.terms[0].kernel
        arrays, static = zip(
            *(eqx.partition(term.kernel, eqx.is_array) for term in self.terms), strict=True
        )
        return eqx.combine(jax.tree.map(lambda *a: jnp.stack(a)[t], *arrays), static[0])

    def _centres(self, dtype: Any) -> Float[Array, "m t d"]:
        return jnp.asarray(np.stack([np.asarray(term.centres) for term in self.terms], 1), dtype)

    def roots(self, dtype: Any) -> Float[Array, "l m m"]:
        """The factor L of k(C, C) of each law."""
        C, terms = self._centres(dtype), np.arange(len(self.terms))
        roots = jax.lax.map(lambda t: root_at(self._kernel(t), C[:, t]), terms)
        return roots[np.repeat(terms, [term.law_count for term in self.terms])]

    def _over_centres(self, fn: Callable[..., Array], parts: int, dtype: Any) -> Array:
        """The values of `fn` at the centres, in batches whose memory is bounded."""
        # The checkpoint bounds the memory of the reverse derivative too.
        C = self._centres(dtype)
        at_once = int(np.clip(_AT_ONCE // parts, 1, len(C)))
        return jax.lax.map(jax.checkpoint(fn), C, batch_size=at_once)

    def _whiten(self, rows: Float[Array, "m l *n"]) -> Float[Array, "l m *n"]:
        """L⁻¹ times the rows of each law."""
        columns = jnp.moveaxis(rows, 1, 0)
        solved = jax.lax.map(
            lambda both: solve_triangular(*both, lower=True),
            (self.roots(rows.dtype), columns.reshape(*columns.shape[:2], -1)),
        )
        return solved.reshape(columns.shape)


def alike(terms: Sequence[Shared]) -> list[slice]:
    """Runs of neighbouring terms whose kernels differ in their hyperparameters alone."""

    def structure(term: Shared) -> Any:
        leaves, tree = jax.tree.flatten(term.kernel)
        shapes = [leaf.shape if eqx.is_array(leaf) else leaf for leaf in leaves]
        return tree, shapes, np.asarray(term.centres).shape

    groups = [list(group) for _, group in itertools.groupby(terms, structure)]
    ends = np.cumsum([0, *map(len, groups)]).tolist()
    return [slice(*both) for both in itertools.pairwise(ends)]


def _law_numbers(laws: Any) -> tuple[int, ...]:
    """The checked numbers of the laws of the parts, 0, 1, … without gaps."""
    numbers = np.asarray(list(laws))
    is_whole = numbers.ndim == 1 and len(numbers) > 0 and numbers.dtype.kind in "iu"
    if not is_whole or set(numbers.tolist()) != set(range(int(numbers.max()) + 1)):
        raise ValueError(
            f"laws must have the number of the law of each part, 0, 1, … without gaps; got {laws}."
        )
    return tuple(numbers.tolist())


def root_at(k: AbstractScalarKernel, C: Float[Array, "m d"]) -> Float[Array, "m m"]:
    """The Cholesky factor L of k(C, C)."""
    G = jax.vmap(jax.vmap(k, (None, 0)), (0, None))(C, C)
    # We add a hundred times the rounding error to the diagonal, which keeps the factor finite if
    # centres nearly coincide. For 64 centres that is 1e-12 of the mean of the diagonal.
    rounding = 100 * jnp.finfo(G.dtype).eps * len(G) * jnp.diagonal(G).mean()
    return jnp.linalg.cholesky(G + rounding * jnp.eye(len(G), dtype=G.dtype))


def far_apart(points: Float[np.ndarray, "N d"], count: int) -> list[int]:
    """The indices of up to `count` distinct points, each the farthest from all before it."""
    chosen, distance = [int(np.argmin(points[:, 0]))], np.full(len(points), np.inf)
    while len(chosen) < count:
        distance = np.minimum(distance, np.linalg.norm(points - points[chosen[-1]], axis=1))
        if not distance.max() > 1e-6:
            break
        chosen.append(int(np.argmax(distance)))
    return chosen


class Parts(NamedTuple):
    """The points of the parts of one state, shape (P, d), and their weights, shape (P,)."""

    points: Float[Array, "P d"]
    weights: Float[Array, " P"]


class GroupParts(eqx.Module):
    """The parts of all images gx of a state, with the weights χ(g) c/|G|.

    `Shared` with these parts is the kernel of the mean Σ_g χ(g) u(gx)/|G|.
    """

    parts: Callable[..., Any]
    maps: tuple[LinearMap, ...] = eqx.field(static=True)
    characters: tuple[float, ...] = eqx.field(static=True)

    def __call__(self, x: Float[Array, " n"]) -> tuple[Float[Array, "P d"], Float[Array, " P"]]:
        group, points, weights = close_group(self.maps, self.characters, len(x)), [], []
        for g in group:
            result = self.parts(g.matrix @ x)
            X, c = result if isinstance(result, tuple) else (result, 1.0)
            points.append(X)
            weights.append(jnp.broadcast_to(g.character * c / len(group), len(X)))
        return jnp.concatenate(points), jnp.concatenate(weights)

    def copies(self, n: int) -> int:
        """The number |G| of images of a state of n coordinates."""
        return len(close_group(self.maps, self.characters, n))

    def coordinate(self, r: Float[Array, "..."]) -> Float[Array, "..."]:
        """The coordinate of the law at r, the same as without the group."""
        return getattr(self.parts, "coordinate", lambda r: r)(r)


class InnerProduct(AbstractScalarKernel):
    """The kernel k(d, e) = d·e of features d and e."""

    def __call__(self, x: Point, z: Point) -> Float[Array, ""]:
        return x @ z


class _Pairs(eqx.Module):
    """The distances of pairs of particles; made by `pairs`."""

    first: tuple[int, ...] = eqx.field(static=True)
    second: tuple[int, ...] = eqx.field(static=True)
    particles: int = eqx.field(static=True)
    dim: int = eqx.field(static=True)
    box: float | None = eqx.field(static=True)
    of: str = eqx.field(static=True)

    def __repr__(self) -> str:
        return f"pairs({len(self.first)} of {self.particles} particles, of={self.of!r})"

    @property
    def positions(self) -> int:
        """How many coordinates of a state the parts depend on, the first ones."""
        return self.particles * self.dim

    @property
    def bodies(self) -> tuple[int, ...]:
        """The particle of each position."""
        return tuple(i // self.dim for i in range(self.positions))

    def __call__(self, x: Float[Array, " n"]) -> Float[Array, "P 1"]:
        size = self.positions
        if len(x) not in (size, 2 * size):
            raise ValueError(
                f"a state of {self.particles} particles in {self.dim} dimensions has {size} "
                f"positions, and as many momenta; got {len(x)} coordinates."
            )
        q = x[:size].reshape(self.particles, self.dim)
        apart = q[np.asarray(self.first)] - q[np.asarray(self.second)]
        if self.box is not None:
            apart = apart - self.box * jax.lax.stop_gradient(jnp.round(apart / self.box))
        return self.coordinate(jnp.sqrt(jnp.sum(apart**2, axis=1)))[:, None]

    def coordinate(self, r: Float[Array, "..."]) -> Float[Array, "..."]:
        """The coordinate in which the law is smooth: r, log r or 1/r."""
        return {"distance": lambda r: r, "log": jnp.log, "inverse": lambda r: 1 / r}[self.of](r)

    def distance(self, coordinate: Float[Array, "..."]) -> Float[Array, "..."]:
        """The distance r that has this coordinate."""
        return jnp.exp(coordinate) if self.of == "log" else self.coordinate(coordinate)


def pairs(
    particles: int,
    dim: int,
    box: float | None = None,
    of: Literal["distance", "log", "inverse"] = "distance",
    among: Sequence[int] | tuple[Sequence[int], Sequence[int]] | None = None,
) -> Callable[..., Array]:
    """The distances of all pairs of particles, x -> (P, 1), for `hk.Shared`.

    States are (q, p), or q alone, with q the positions of the first particle, of the second, ….
    Pairs are in the order (0, 1), (0, 2), …, (1, 2), ….

    Args:
        particles: the number of particles.
        dim: the dimension of space.
        box: the side of a periodic box, in which a distance is to the nearest image; None without.
        of: the coordinate of the law: "distance" r; or "log" or "inverse" for laws that vary by
            many orders of magnitude, such as Lennard-Jones or gravity.
        among: the particles between which the law acts, all if None. If two groups, the law acts
            between a particle of one and a particle of the other. For species, add one `Shared` for
            each pair of species.

    Raises:
        ValueError: a number is not positive, `of` is unknown, or `among` has no pair or a particle
            that does not exist.
    """
    particles, dim = require.count(particles, "particles"), require.count(dim, "dim")
    if of not in ("distance", "log", "inverse"):
        raise ValueError(f"of must be 'distance', 'log' or 'inverse'; got {of!r}.")
    if box is not None:
        box = require.positive_number(box, "box")
    groups: Any = range(particles) if among is None else among
    left, right = groups if np.ndim(groups[0]) else (groups, groups)
    two = sorted({(min(i, j), max(i, j)) for i in left for j in right if i != j})
    if not two or min(i for i, _ in two) < 0 or max(j for _, j in two) >= particles:
        raise ValueError(
            f"`among` contains no pair, or a particle that is not among 0 to {particles - 1}: "
            "particles are counted from 0."
        )
    first, second = zip(*two, strict=True)
    return _Pairs(tuple(map(int, first)), tuple(map(int, second)), particles, dim, box, of)


class _Sites(eqx.Module):
    """The positions of sites, or the differences of neighbours; made by `sites`, `neighbours`."""

    count: int = eqx.field(static=True)
    neighbours: bool = eqx.field(static=True)
    periodic: bool = eqx.field(static=True)

    def __repr__(self) -> str:
        return describe(self)

    @property
    def positions(self) -> int:
        """How many coordinates of a state the parts depend on, the first ones."""
        return self.count

    def __call__(self, x: Float[Array, " n"]) -> Float[Array, "P 1"]:
        if len(x) not in (self.count, 2 * self.count):
            raise ValueError(
                f"a state of {self.count} sites has {self.count} positions, and as many momenta; "
                f"got {len(x)} coordinates."
            )
        q = x[: self.count]
        if not self.neighbours:
            return q[:, None]
        return (jnp.roll(q, -1) - q if self.periodic else jnp.diff(q))[:, None]


def neighbours(sites: int, periodic: bool = False) -> Callable[..., Array]:
    """The differences qᵢ₊₁ − qᵢ along a chain, x -> (P, 1), for `hk.Shared`.

    Args:
        sites: the number of sites; states are (q, p), or q alone.
        periodic: whether the first site follows the last, which adds the difference q₁ − q_last.

    Raises:
        ValueError: there are fewer than two sites.
    """
    if require.count(sites, "sites") < 2:
        raise ValueError("a chain needs at least two sites.")
    return _Sites(sites, neighbours=True, periodic=bool(periodic))


def sites(count: int) -> Callable[..., Array]:
    """The positions qᵢ of sites, x -> (P, 1), for a law that acts on each site, for `hk.Shared`.

    Args:
        count: the number of sites; states are (q, p), or q alone.

    Raises:
        ValueError: count is not positive.
    """
    return _Sites(require.count(count, "count"), neighbours=False, periodic=False)
