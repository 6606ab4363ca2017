"""Measured states as linear functionals of the field, along a path that is nearly right.

With x̂ the path, Φ its tangent, m the mean and τ_k Gauss nodes with weights w_k, a sample is

    x(tᵢ) ≈ x̂(tᵢ) + Φᵢ δz + Σ_{τ_k < tᵢ} w_k Φᵢ Φ_k⁻¹ (f(x̂(τ_k)) − d x̂/dt(τ_k)),

so with g = f − m, and ô the same sum of d x̂/dt − m, xᵢ − x̂ᵢ + ôᵢ = Φᵢ δz + (B g)ᵢ. The sums run
from interval to interval, sᵢ₊₁ = Ψᵢ sᵢ + Σ_k Γ_ik (…)_k, and no matrix B is stored.

The path is that of the current field, or any other, such as a smoothed one: then Φ is the tangent
of the mean alone, the identity where there is none.
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from hamkernel._trajectories.flow import NODES, WEIGHTS, Path


class Segments(NamedTuple):
    """Measured samples on S segments of at most L intervals; padding has no weight and no length.

    Attributes:
        spans: the lengths of the intervals, shape (S, L).
        measured: the states, zero where nothing was seen, shape (S, L + 1, n).
        counts: how many samples an entry stands for, 0 where nothing was seen, the same shape.
        scatter: the sum of squares of those samples about the entry, the same shape.
        starts: where the segments may begin, shape (S, n).
        inputs: at both ends of each interval, shape (S, L, 2, m); m is 0 where there are none.
    """

    spans: Float[Array, "S L"]
    measured: Float[Array, "S L+1 n"]
    counts: Float[Array, "S L+1 n"]
    scatter: Float[Array, "S L+1 n"]
    starts: Float[Array, "S n"]
    inputs: Float[Array, "S L 2 m"]


class Rows(NamedTuple):
    """What the samples say of g = f − m, before the starts are projected out.

    Attributes:
        nodes: where g is asked for, shape (S, L, 3, d), d = n + m with inputs: points (x, u).
        across: Ψ, shape (S, L, n, n).
        weights: Γ, shape (S, L, 3, n, n).
        tangent: Φ at the samples, shape (S, L + 1, n, n).
        target: x − x̂ + ô, shape (S, L + 1, n).
        along: ô, what the rows would be if x̂ were right, the same shape.
        counts: those of the segments, zero on what was dropped.
        scatter: those of the segments, zero on what was dropped.
        displaced: where the prior of the start has its middle, relative to x̂, shape (S, n).
    """

    nodes: Float[Array, "S L 3 d"]
    across: Float[Array, "S L n n"]
    weights: Float[Array, "S L 3 n n"]
    tangent: Float[Array, "S L+1 n n"]
    target: Float[Array, "S L+1 n"]
    along: Float[Array, "S L+1 n"]
    counts: Float[Array, "S L+1 n"]
    scatter: Float[Array, "S L+1 n"]
    displaced: Float[Array, "S n"]


def accumulated(
    across: Float[Array, "S L n n"],
    weights: Float[Array, "S L 3 n n"],
    values: Float[Array, "S L 3 n q"],
) -> Float[Array, "S L+1 n q"]:
    """Bv for each column of values at the nodes."""
    local = jnp.einsum("slkab,slkbq->slaq", weights, values)

    def step(s, at):
        transition, own = at
        s = jnp.einsum("sab,sbq->saq", transition, s) + own
        return s, s

    start = jnp.zeros_like(local[:, 0])
    _, sums = jax.lax.scan(step, start, (jnp.moveaxis(across, 1, 0), jnp.moveaxis(local, 1, 0)))
    return jnp.concatenate([start[:, None], jnp.moveaxis(sums, 0, 1)], axis=1)


@jax.jit
def tangents(across: Float[Array, "S L n n"]) -> Float[Array, "S L+1 n n"]:
    """Φ at the samples, from the tangents across the intervals."""
    S, _, n, _ = across.shape
    first = jnp.broadcast_to(jnp.eye(n, dtype=across.dtype), (S, n, n))

    def step(V, transition):
        V = jnp.einsum("sab,sbc->sac", transition, V)
        return V, V

    _, rest = jax.lax.scan(step, first, jnp.moveaxis(across, 1, 0))
    return jnp.concatenate([first[:, None], jnp.moveaxis(rest, 0, 1)], axis=1)


@eqx.filter_jit
def linearised(
    path: Path,
    slopes: Float[Array, "S L 3 n"],
    mean: Float[Array, "S L 3 n"],
    segments: Segments,
    good: Bool[Array, " S"],
    is_solution: bool,
) -> Rows:
    """The rows along a path of which the slopes and the mean at the nodes are known.

    Args:
        path: a path, with tangents of the field along it or of the mean.
        slopes: d x̂/dt.
        mean: m.
        segments: the samples.
        good: which segments to keep.
        is_solution: whether the path solves ẋ = slope. If not, what the Gauss rule misses of its
            increments is put back: for Φ = I the rows are then exact differences of the samples.
    """
    keep = good[:, None, None]
    x, nodes, to_end, across = (_where(good, a) for a in path)
    n = x.shape[-1]
    # Where nothing is kept the field is still asked: at the starts, which are states of the runs.
    still = jnp.pad(segments.starts, ((0, 0), (0, nodes.shape[-1] - n)))
    nodes = jnp.where(keep[..., None], nodes, still[:, None, None])
    eye = jnp.broadcast_to(jnp.eye(n, dtype=x.dtype), across.shape)
    across = jnp.where(keep[..., None], across, eye)
    shares = segments.spans[:, :, None] * jnp.asarray(WEIGHTS, x.dtype)[None, None]
    weights = shares[..., None, None] * to_end  # Γ_k = h w_k Ψ Φ_k⁻¹
    slopes, mean = _where(good, slopes), _where(good, mean)
    offset = accumulated(across, weights, (slopes - mean)[..., None])[..., 0]
    if not is_solution:
        missed = jnp.diff(x, axis=1) - (shares[..., None] * slopes).sum(axis=2)
        offset = offset + accumulated(across, eye[:, :, None], missed[:, :, None, :, None])[..., 0]
    return Rows(
        nodes=nodes,
        across=across,
        weights=weights,
        tangent=tangents(across),
        target=segments.measured - x + offset,
        along=offset,
        counts=_where(good, segments.counts),
        scatter=_where(good, segments.scatter),
        displaced=_where(good, segments.starts - x[:, 0]),
    )


def _where(good, a):
    mask = good.reshape(-1, *([1] * (a.ndim - 1)))
    return jnp.where(mask, a, jnp.zeros_like(a))


def frozen(
    x: Float[Array, "S L+1 n"],
    nodes: Float[Array, "S L 3 d"],
    spans: Float[Array, "S L"],
    jacobians: Float[Array, "S L n n"],
) -> Path:
    """A given path with the tangent of ẏ = D y, D the Jacobian of the mean in each interval."""
    D = spans[..., None, None] * jacobians
    eye = jnp.broadcast_to(jnp.eye(x.shape[-1], dtype=x.dtype), D.shape)

    def exponential(share: float):
        term = total = eye
        for j in range(1, 9):  # ‖D h‖ is below one or two where samples see the motion
            term = share / j * jnp.einsum("slab,slbc->slac", D, term)
            total = total + term
        return total

    to_end = jnp.stack([exponential(1 - float(c)) for c in NODES], axis=2)
    return Path(x, nodes, to_end, exponential(1.0))


def segments_of(
    pieces: list[tuple[np.ndarray, ...]],
    size: int,
    length: int,
) -> Segments:
    """`size` segments of `length` samples of pieces (times, states, counts, scatter, start, u)."""
    n, m = pieces[0][1].shape[1], pieces[0][5].shape[2]
    spans = np.zeros((size, length - 1))
    measured, counts, scatter = np.zeros((3, size, length, n))
    # Segments that are padding stay at a state of the runs: another one may be where none is
    # possible, as a population of zero in a kernel of its logarithm.
    starts, inputs = np.tile(pieces[0][4], (size, 1)), np.zeros((size, length - 1, 2, m))
    for s, (t, x, count, squares, start, ends) in enumerate(pieces):
        T = len(t)
        spans[s, : T - 1] = np.diff(t)
        seen = np.isfinite(x)
        measured[s, :T] = np.where(seen, x, 0.0)
        counts[s, :T] = np.where(seen, count, 0.0)
        scatter[s, :T] = np.where(seen, squares, 0.0)
        starts[s], inputs[s, : T - 1] = start, ends
    arrays = spans, measured, counts, scatter, starts, inputs
    return Segments(*(jnp.asarray(a) for a in arrays))
