"""Sentences about `Shared` laws: undetermined changes, and states outside the data."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from hamkernel._kernels.parts import Shared
from hamkernel._machine import precise_jit
from hamkernel._structures.base import nodes_of
from hamkernel._structures.completed import shared_laws
from hamkernel._structures.structure import AbstractPotentialKernel

_NULL_TOLERANCE = 1e-5  # relative to the largest singular value, above the rounding of float32
_RANGE_MARGIN = 0.05  # as a fraction of the range of the data, which we estimate from 256 states


def undetermined_terms(K: Any, n: int) -> tuple[str, ...]:
    """The changes of the laws within K that change no field, a sentence for each.

    A linear law w(r) = r_j gives the potential Σ_p c_p φ_pj(x). A combination of linear and
    constant laws is undetermined if its field is zero at random states.
    """
    terms = nodes_of(AbstractPotentialKernel, K)
    laws = [(term, law) for term in terms for law in shared_laws(term.kernel)]
    X, columns, names = np.random.default_rng(0).normal(size=(8, n)), [], []
    many, i = sum(law.law_count for _, law in laws) > 1, 0
    for term, law in laws:
        fields = np.asarray(_linear_fields(term, law, jnp.asarray(X)))
        fields = np.moveaxis(fields.reshape(-1, *fields.shape[2:]), 0, 2)  # (L, 1 + d, N n)
        columns += list((fields / (np.abs(fields).max() or 1.0)).reshape(-1, fields.shape[2]))
        d = fields.shape[1] - 1
        coordinates = ["r"] if d == 1 else [f"r[{j}]" for j in range(d)]
        for _ in range(law.law_count):
            place = f"law {i}" if many else "the law"
            names += [f"{name} added to {place}" for name in ("a constant", *coordinates)]
            i += 1
    said = []
    for shares in _null_vectors(np.array(columns).T) if columns else ():
        parts = [(s, name) for s, name in zip(shares, names, strict=True) if s]
        one = len(parts) == 1
        text = " and ".join(name if one else f"{s:.3g} times {name}" for s, name in parts)
        said.append(f"{text} {'changes' if one else 'together change'} no velocity")
    return tuple(said)


@precise_jit
def _linear_fields(K: Any, law: Shared, X: Float[Array, "N n"]) -> Float[Array, "N n L k"]:
    """The fields of each law if it is 1, and if it is one of the coordinates."""

    def potentials(x):
        points, weights = law.parts_at(x)
        terms = weights[:, None] * jnp.column_stack([jnp.ones_like(weights), points])
        return jax.ops.segment_sum(terms, law.part_laws(len(points)), law.law_count)

    def fields(x):
        slopes = jax.jacrev(potentials)(x)
        applied = K.apply(x, slopes.reshape(-1, len(x)).T)
        return applied.reshape(len(applied), *slopes.shape[:2])

    return jax.lax.map(fields, X)


def _null_vectors(M: Float[np.ndarray, "R Q"]) -> Float[np.ndarray, "d Q"]:
    """A basis of the null space of M; Gaussian elimination makes many entries zero."""
    _, sizes, V = np.linalg.svd(M)
    sizes = np.append(sizes, np.zeros(len(V) - len(sizes)))
    space, first = V[sizes <= _NULL_TOLERANCE * max(sizes.max(), 1.0)], 0
    for column in range(space.shape[1]):
        if first == len(space):
            break
        pivot = first + int(np.argmax(np.abs(space[first:, column])))
        if abs(space[pivot, column]) > _NULL_TOLERANCE:
            space[[first, pivot]] = space[[pivot, first]]
            space[first] /= space[first, column]
            rest = np.arange(len(space)) != first
            space[rest] -= space[rest, column][:, None] * space[first][None]
            first += 1
    return np.where(np.abs(space) > 10 * _NULL_TOLERANCE, space, 0.0)


def outside(K: Any, X: Float[Array, "T n"]) -> str:
    """A sentence if parts of the states X lie outside the range of the data; else "".

    For distances we check only for distances below the smallest in the data.
    """
    for law in shared_laws(K) if K is not None else ():
        if law.centres is None:
            continue
        lowest, highest = (np.asarray(a) for a in _range(law, X))
        C = np.asarray(law.centres)
        low, high = C.min(axis=0), C.max(axis=0)
        reach = _RANGE_MARGIN * (high - low)
        distance = getattr(law.parts, "distance", None)
        if distance is not None:
            closest = min(float(distance(low[0])), float(distance(high[0])))
            now = min(float(distance(lowest[0])), float(distance(highest[0])))
            if now < (1 - _RANGE_MARGIN) * closest:
                return (
                    f"two particles come as close as {now:.3g}, and in the data no closer than "
                    f"{closest:.3g}: there the law is not known, see posterior.law_deviation."
                )
        elif (lowest < low - reach).any() or (highest > high + reach).any():
            return (
                f"the parts of a shared law reach from {lowest} to {highest}, and in the data from "
                f"{low} to {high}: there the law is not known, see posterior.law_deviation."
            )
    return ""


@precise_jit
def _range(law: Shared, X: Float[Array, "T n"]) -> tuple[Float[Array, " d"], Float[Array, " d"]]:
    """The lowest and highest coordinates of the parts of the states."""

    def extremes(x):
        points = law.parts_at(x).points
        return points.min(axis=0), points.max(axis=0)

    low, high = jax.lax.map(extremes, X)
    return low.min(axis=0), high.max(axis=0)
