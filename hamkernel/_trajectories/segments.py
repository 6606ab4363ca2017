"""Measured states as linear functionals of the field, linearised about a path.

With x̂ the path, Φ its tangent, m the mean and τ_k Gauss nodes with weights w_k, a sample is

    x(tᵢ) ≈ x̂(tᵢ) + Φᵢ δz + Σ_{τ_k < tᵢ} w_k Φᵢ Φ_k⁻¹ (f(x̂(τ_k)) − d x̂/dt(τ_k)),

so with g = f − m, and ô the same sum of d x̂/dt − m, xᵢ − x̂ᵢ + ôᵢ = Φᵢ δz + (B g)ᵢ. The sums run
from interval to interval, sᵢ₊₁ = Ψᵢ sᵢ + Σ_k Γ_ik (…)_k, and no matrix B is stored. Each
interval adds its `drive` to ô; where the path solves no equation, `missed` is the rest of its
increment.

The path is that of the current field, or any other, such as a smoothed one: then Φ is the tangent
of the mean alone, the identity where there is none.
"""

import itertools
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from hamkernel._machine import compiled, compiled_by_size
from hamkernel._trajectories.flow import (
    NODES,
    WEIGHTS,
    Path,
    Segments,
    broadcast_mask,
    jacobians,
    means,
)
from hamkernel._trajectories.preprocessing import Preprocessed, PreprocessedRun
from hamkernel._trajectories.runs import inputs_at_nodes
from hamkernel._trajectories.smoothing import power_of_two


class Piece(NamedTuple):
    """Samples `start` to `stop` of one run."""

    run: int
    start: int
    stop: int


class LinearisedSegments(NamedTuple):
    """The rows of samples, linear in g = f − m, before they are whitened.

    Attributes:
        nodes: the points where g is evaluated, with inputs (x, u), d = n + m, shape (S, L, 3, d).
        across: Ψ, shape (S, L, n, n).
        weights: Γ, shape (S, L, 3, n, n).
        spans: the lengths of the intervals, shape (S, L).
        pushed: by how much larger the deviation of w is in an interval, shape (S, L).
        drive: Σ_k Γ_k (d x̂/dt − m)_k, shape (S, L, n).
        missed: the increment of x̂ less that of the Gauss rule for d x̂/dt, 0 for a solution, the
            same shape.
        residual: x − x̂, shape (S, L + 1, n).
        counts: the counts of the segments, zero on samples that were dropped.
        scatter: the scatter of the segments, zero on samples that were dropped.
        prior_offset: the mean of the prior of the start, relative to x̂, shape (S, n).
    """

    nodes: Float[Array, "S L 3 d"]
    across: Float[Array, "S L n n"]
    weights: Float[Array, "S L 3 n n"]
    spans: Float[Array, "S L"]
    pushed: Float[Array, "S L"]
    drive: Float[Array, "S L n"]
    missed: Float[Array, "S L n"]
    residual: Float[Array, "S L+1 n"]
    counts: Float[Array, "S L+1 n"]
    scatter: Float[Array, "S L+1 n"]
    prior_offset: Float[Array, "S n"]


@compiled_by_size
def linearised(
    path: Path,
    slopes: Float[Array, "S L 3 n"],
    mean: Float[Array, "S L 3 n"],
    segments: Segments,
    good: Bool[Array, " S"],
) -> LinearisedSegments:
    """The rows along a path, given its slopes and the mean at the nodes.

    Args:
        path: a path, with tangents of the field along it or of the mean.
        slopes: d x̂/dt.
        mean: m.
        segments: the samples.
        good: which segments to keep.
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
    drive = jnp.einsum("slkab,slkb->sla", weights, slopes - mean)
    return LinearisedSegments(
        nodes=nodes,
        across=across,
        weights=weights,
        spans=segments.spans,
        pushed=jnp.ones_like(segments.spans),
        drive=drive,
        missed=jnp.zeros_like(drive),
        residual=segments.measured - x,
        counts=_where(good, segments.counts),
        scatter=_where(good, segments.scatter),
        prior_offset=_where(good, segments.starts - x[:, 0]),
    )


def windows(rows: LinearisedSegments, samples: int) -> LinearisedSegments:
    """The rows, or windows of them, evenly from all segments, with at most `samples` samples.

    The start of a window is unknown, as that of a segment is, and what adds up along a path is seen
    in long windows only; four at least keep some variety. Of six runs of 240 samples of a pendulum
    with friction .2, four seeds, windows of 12 samples gave .222, .191, .206 and .217, windows of
    192 .197, .199, .197 and .197 in the same time, and all rows .199, .199, .198 and .200 (those of
    `logs(seed, samples=240, step=6)` in `tests/test_learn_inputs.py`, a known matrix of inputs).
    """
    seen: Any = np.asarray(rows.counts).any(axis=2)
    if seen.size <= samples or not seen[:, 1:].any():
        return rows
    ends = np.where(seen.any(axis=1), seen.shape[1] - np.argmax(seen[:, ::-1], axis=1), 0)
    # Of few lengths, so that few programs are compiled.
    length = int(ends.max()) if seen.shape[1] < SHORT else SHORT
    while 2 * length <= min(int(ends.max()), samples // 4):
        length *= 2
    firsts = [
        (s, max(min(i, end - length), 0))
        for s, end in enumerate(ends)
        for i in range(0, end - 1, max(length - 1, 1))
    ]
    most = max(samples // length, 1)
    if len(firsts) > most:
        chosen = np.linspace(0, len(firsts) - 1, most).round().astype(int)
        firsts = [firsts[i] for i in chosen]
    s, first = np.array(firsts).T
    return _windows(rows, jnp.asarray(s), jnp.asarray(first[:, None] + np.arange(length)[None]))


@compiled
def _windows(rows: LinearisedSegments, s, at) -> LinearisedSegments:
    inner, s = at[:, :-1], s[:, None]
    cut = {name: getattr(rows, name)[s, at] for name in ("residual", "counts", "scatter")}
    for name in ("nodes", "across", "weights", "spans", "pushed", "drive", "missed"):
        cut[name] = getattr(rows, name)[s, inner]
    offset = jnp.where(at[:, :1] == 0, rows.prior_offset[s[:, 0]], 0.0)
    return LinearisedSegments(**cut, prior_offset=offset)


def _where(good, a):
    return jnp.where(broadcast_mask(good, a), a, jnp.zeros_like(a))


def given_path(
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


def linearised_along_smoothed(
    data: Preprocessed, pieces: list[Piece], segments: Segments, mean, good: np.ndarray
) -> LinearisedSegments:
    """The rows along the smoothed runs, whose tangent is that of the mean."""
    S, L = segments.spans.shape
    n = len(data.scale)
    first = data.runs[pieces[0][0]].path[pieces[0][1]]  # where padding stays
    x, nodes = np.tile(first, (S, L + 1, 1)), np.tile(first, (S, L, 3, 1))
    slopes = np.zeros((S, L, 3, n))
    for s, (r, start, stop) in enumerate(pieces):
        run, T = data.runs[r], stop - start
        x[s] = run.path[stop - 1]
        nodes[s] = run.path[stop - 1]
        x[s, :T] = run.path[start:stop]
        nodes[s, : T - 1] = run.nodes[start : stop - 1]
        slopes[s, : T - 1] = run.slopes[start : stop - 1]
    points = np.concatenate([nodes, inputs_at_nodes(np.asarray(segments.inputs))], axis=-1)
    along = jnp.asarray(x), jnp.asarray(points), jnp.asarray(slopes)
    return _linearised_along_smoothed(mean, along, jnp.asarray(good), segments)


@compiled_by_size
def _linearised_along_smoothed(mean, along, good, segments: Segments) -> LinearisedSegments:
    x, points, slopes = along
    path = given_path(x, points, segments.spans, jacobians(mean, points, x.shape[-1]))
    there = means(mean, points, slopes)
    rows = linearised(path, slopes, there, segments, good)
    # What the Gauss rule misses of the increments of a path that solves no equation is put back.
    shares = segments.spans[:, :, None, None] * jnp.asarray(WEIGHTS, x.dtype)[None, None, :, None]
    missed = jnp.diff(x, axis=1) - (shares * slopes).sum(axis=2)
    return rows._replace(missed=jnp.where(good[:, None, None], missed, 0.0))


SHORT = 12  # samples at most in a segment while the field is rough; 10 gave the same errors
LONG = 256  # at most: longer segments add little information, and arrays stay small


def equal_pieces(runs: list[PreprocessedRun], most: int) -> list[Piece]:
    """Every run in pieces of at most `most` samples, of nearly equal lengths."""
    return [piece for r, run in enumerate(runs) for piece in _equal(r, 0, len(run.times), most)]


def _equal(run: int, start: int, stop: int, most: int) -> list[Piece]:
    # As many as the next power of two needs: runs of other lengths then have as many pieces.
    count = -(-power_of_two(stop - start) // most)
    ends = np.linspace(start, stop, count + 1).round().astype(int)
    return [Piece(run, int(a), int(b)) for a, b in itertools.pairwise(ends)]


def padded_count(count: int, large: bool) -> int:
    """The least power of two that is not below `count`; of a large log an eighth finer."""
    most = power_of_two(count)
    step = max(most // 8, 1) if large else most
    return -(-count // step) * step


def segmented(
    runs: list[PreprocessedRun], pieces: list[Piece], paths: list[np.ndarray]
) -> Segments:
    """The pieces as arrays of a few shapes; they start on `paths`."""
    longest = max(piece.stop - piece.start for piece in pieces)
    # Padding costs as much as samples: in each direction half of a large log may be padding, and
    # above some thousand entries that costs more than to compile anew, some 15 s.
    large = len(pieces) * longest * len(runs[0].path[0]) > 4096
    size, length = (padded_count(count, large) for count in (len(pieces), longest))
    # As the windows of longer pieces have, so that one program does for both; of a large log of
    # short runs there are none, and 400 runs of 5 samples took 11 s a solve for 7.
    if longest <= SHORT and not (large and longest == max(len(run.times) for run in runs)):
        length = min(power_of_two(longest), SHORT)
    filled = []
    for r, start, stop in pieces:
        run, part = runs[r], slice(start, stop)
        own = run.times, run.states, run.counts, run.scatter
        filled.append((*(a[part] for a in own), paths[r][start], run.inputs[start : stop - 1]))
    return segments_of(filled, size, length)


def updated(paths, pieces: list[Piece], good, x: np.ndarray) -> list[np.ndarray]:
    """The paths, with those of the pieces that were kept replaced by x."""
    new = [path.copy() for path in paths]
    for s, (r, start, stop) in enumerate(pieces):
        if good[s] and np.isfinite(x[s]).all():
            new[r][start:stop] = x[s, : stop - start]
    return new
