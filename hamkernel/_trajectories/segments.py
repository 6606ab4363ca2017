"""Measured states as linear functionals of the field, linearised about a path.

Let x̂ be the path, Φ its tangent, m the mean, and τ_k Gauss nodes with weights w_k. A sample is

    x(tᵢ) ≈ x̂(tᵢ) + Φᵢ δz + Σ_{τ_k < tᵢ} w_k Φᵢ Φ_k⁻¹ (f(x̂(τ_k)) − d x̂/dt(τ_k)),

where δz is the change of the start. Let g = f − m, and let ô be the same sum of d x̂/dt − m. Then
xᵢ − x̂ᵢ + ôᵢ = Φᵢ δz + (B g)ᵢ. We compute the sums from interval to interval, as
sᵢ₊₁ = Ψᵢ sᵢ + Σ_k Γ_ik (…)_k, and store no matrix B. Each interval adds its `drive` to ô. If the
path is no solution of an equation, `missed` is the part of its increment that the Gauss rule
misses.

The path is a solution of the current field, or any other path, such as a smoothed one. For a
smoothed path Φ is the tangent of the mean alone, the identity if there is no mean.
"""

import itertools
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from hamkernel._machine import compiled_by_size, precise_jit
from hamkernel._runs.flow import (
    NODES,
    WEIGHTS,
    Path,
    Segments,
    broadcast_mask,
    jacobians,
    means,
)
from hamkernel._runs.preprocessing import Preprocessed, PreprocessedRun
from hamkernel._runs.runs import inputs_at_nodes
from hamkernel._runs.smoothing import power_of_two


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
        pushed: the factor on the standard deviation of w in an interval, shape (S, L).
        drive: Σ_k Γ_k (d x̂/dt − m)_k, shape (S, L, n).
        missed: the increment of x̂ minus the Gauss rule for ∫ d x̂/dt, 0 for a solution of an
            equation, shape (S, L, n).
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
def linearise(
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
    # Dropped segments are evaluated too: we put their nodes at the starts, states of the runs.
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

    The start of a window is unknown, like the start of a segment, so only long windows contain the
    effects that add up along a path. For variety we take at least 2n windows, and eight. With
    n = 8, the error of the field was .0237 with four windows of 24 samples, and .0086 with eight of
    12 samples (`tests/benchmarks/capacity.py chain`). With n = 2, four windows of 96 samples of a
    driven oscillator had six times as many landmarks and no end in 11 minutes. With eight of 48
    samples `learn` took 3 minutes (`machines.py oscillator`). The table has the friction found for
    a pendulum with friction .2 from six runs of 240 samples, for four seeds:

        windows of 12 samples     .222  .191  .206  .217
        windows of 48 samples     .197  .200  .197  .199
        all rows                  .199  .199  .198  .200

    The runs are `logs(seed, samples=240, step=6)` in `tests/test_learn_inputs.py`.
    """
    measured: Any = np.asarray(rows.counts).any(axis=2)
    if measured.size <= samples or not measured[:, 1:].any():
        return rows
    lengths = measured.shape[1] - np.argmax(measured[:, ::-1], axis=1)
    ends = np.where(measured.any(axis=1), lengths, 0)
    # There are few possible lengths, so that few programs are compiled.
    length = int(ends.max()) if measured.shape[1] < WINDOW else WINDOW
    fewest = max(2 * rows.residual.shape[-1], 8)
    while 2 * length <= min(int(ends.max()), samples // fewest):
        length *= 2
    firsts = [
        (s, max(min(i, end - length), 0))
        for s, end in enumerate(ends)
        for i in range(0, end - 1, max(length - 1, 1))
    ]
    limit = max(samples // length, 1)
    if len(firsts) > limit:
        chosen = np.linspace(0, len(firsts) - 1, limit).round().astype(int)
        firsts = [firsts[i] for i in chosen]
    s, first = np.array(firsts).T
    return _windows(rows, jnp.asarray(s), jnp.asarray(first[:, None] + np.arange(length)[None]))


@precise_jit
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
    # Padding stays at a state of the runs. Other states may be impossible, such as a population of
    # zero for a kernel of its logarithm.
    starts, inputs = np.tile(pieces[0][4], (size, 1)), np.zeros((size, length - 1, 2, m))
    for s, (t, x, count, squares, start, ends) in enumerate(pieces):
        T = len(t)
        spans[s, : T - 1] = np.diff(t)
        finite = np.isfinite(x)
        measured[s, :T] = np.where(finite, x, 0.0)
        counts[s, :T] = np.where(finite, count, 0.0)
        scatter[s, :T] = np.where(finite, squares, 0.0)
        starts[s], inputs[s, : T - 1] = start, ends
    arrays = spans, measured, counts, scatter, starts, inputs
    return Segments(*jax.device_put(arrays))


def linearised_along_smoothed(
    data: Preprocessed, pieces: list[Piece], segments: Segments, mean, good: np.ndarray
) -> LinearisedSegments:
    """The rows along the smoothed runs, with the tangent of the mean."""
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
    along, good = jax.device_put(((x, points, slopes), good))
    return _linearised_along_smoothed(mean, along, good, segments)


@compiled_by_size
def _linearised_along_smoothed(mean, along, good, segments: Segments) -> LinearisedSegments:
    x, points, slopes = along
    path = given_path(x, points, segments.spans, jacobians(mean, points, x.shape[-1]))
    there = means(mean, points, slopes)
    rows = linearise(path, slopes, there, segments, good)
    # The smoothed path solves no equation, so the Gauss rule misses a part of its increments.
    shares = segments.spans[:, :, None, None] * jnp.asarray(WEIGHTS, x.dtype)[None, None, :, None]
    missed = jnp.diff(x, axis=1) - (shares * slopes).sum(axis=2)
    return rows._replace(missed=jnp.where(good[:, None, None], missed, 0.0))


WINDOW = 12  # samples, the shortest window of a search; 10 gave the same errors
LONG = 256  # samples, the longest segment: longer ones add little information


def equal_pieces(runs: list[PreprocessedRun], limit: int) -> list[Piece]:
    """Every run in pieces of at most `limit` samples, of nearly equal lengths."""
    return [piece for r, run in enumerate(runs) for piece in _equal(r, 0, len(run.times), limit)]


def _equal(run: int, start: int, stop: int, limit: int) -> list[Piece]:
    # The count is that of the next power of two, so that runs of similar lengths have equal counts.
    count = -(-power_of_two(stop - start) // limit)
    ends = np.linspace(start, stop, count + 1).round().astype(int)
    return [Piece(run, int(a), int(b)) for a, b in itertools.pairwise(ends)]


def padded_count(count: int, large: bool) -> int:
    """The least power of two that is not below `count`; for a large log a multiple of an eighth."""
    power = power_of_two(count)
    step = max(power // 8, 1) if large else power
    return -(-count // step) * step


def make_segments(
    runs: list[PreprocessedRun], pieces: list[Piece], paths: list[np.ndarray]
) -> Segments:
    """The pieces as arrays of a few shapes; they start on `paths`."""
    longest = max(piece.stop - piece.start for piece in pieces)
    # Padding costs as much as samples, and half of each axis may be padding. For more than some
    # thousand entries this costs more than compiling a new program, some 15 s.
    large = len(pieces) * longest * len(runs[0].path[0]) > 4096
    size, length = (padded_count(count, large) for count in (len(pieces), longest))
    # Windows of longer pieces have this length too, so that one program serves both. A large log of
    # short runs has no windows: with this padding 400 runs of 5 samples took 11 s a solve, not 7.
    if longest <= WINDOW and not (large and longest == max(len(run.times) for run in runs)):
        length = min(power_of_two(longest), WINDOW)
    filled = []
    for r, start, stop in pieces:
        run, part = runs[r], slice(start, stop)
        arrays = run.times, run.states, run.counts, run.scatter
        filled.append((*(a[part] for a in arrays), paths[r][start], run.inputs[start : stop - 1]))
    return segments_of(filled, size, length)


def replace_pieces(paths, pieces: list[Piece], good, x: np.ndarray) -> list[np.ndarray]:
    """The paths, in which x replaces the pieces that were kept."""
    new = [path.copy() for path in paths]
    for s, (r, start, stop) in enumerate(pieces):
        if good[s] and np.isfinite(x[s]).all():
            new[r][start:stop] = x[s, : stop - start]
    return new
