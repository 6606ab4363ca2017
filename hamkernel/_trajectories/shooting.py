"""Multiple shooting: segments, their starts by Levenberg steps, and which of them to trust."""

import itertools
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from hamkernel._machine import orthonormal
from hamkernel._trajectories.evidence import back_substituted
from hamkernel._trajectories.flow import Expansion, Path, simulated
from hamkernel._trajectories.padding import power_of_two
from hamkernel._trajectories.prepared import Run
from hamkernel._trajectories.rows import Rows, Segments, linearised, segments_of, tangents

SHORT = 12  # samples at most in a segment while the field is rough; 10 gave the same errors
_LEAST = 3  # samples of a piece: one more than its start takes
LONG = 256  # at most: the tangent of a longer path says little more, and arrays stay small
_GROWTH = 1e4  # of the tangent, beyond which a path says nothing of its start
_FAR = 25.0  # times the median χ² per sample


class Piece(NamedTuple):
    """Samples `start` to `stop` of one run."""

    run: int
    start: int
    stop: int


def cuts(runs: list[Run], most: int) -> list[Piece]:
    """Every run in pieces of at most `most` samples, of nearly equal lengths."""
    return [piece for r, run in enumerate(runs) for piece in _equal(r, 0, len(run.times), most)]


def short_cuts(runs: list[Run]) -> list[Piece]:
    """Short pieces, none of them across a gap, if it has three samples at least."""
    pieces = []
    for r, run in enumerate(runs):
        start, T = 0, len(run.times)
        for gap in run.gaps:
            if gap - start >= _LEAST and T - gap >= _LEAST:
                pieces += _equal(r, start, int(gap), SHORT)
                start = int(gap)
        pieces += _equal(r, start, T, SHORT)
    return pieces


def _equal(run: int, start: int, stop: int, most: int) -> list[Piece]:
    # As many as the next power of two needs: runs of other lengths then have as many pieces.
    count = -(-power_of_two(stop - start) // most)
    ends = np.linspace(start, stop, count + 1).round().astype(int)
    return [Piece(run, int(a), int(b)) for a, b in itertools.pairwise(ends)]


def grown(runs: list[Run], pieces: list[Piece], good: Bool[np.ndarray, " S"]) -> list[Piece]:
    """Runs of which all pieces are good in one piece, up to `LONG` samples; others as they are."""
    lost = {piece.run for piece, is_good in zip(pieces, good, strict=True) if not is_good}
    whole = [piece for piece in cuts(runs, LONG) if piece.run not in lost]
    return whole + [piece for piece in pieces if piece.run in lost]


def halved(runs: list[Run], pieces: list[Piece], good: Bool[np.ndarray, " S"]) -> list[Piece]:
    """The pieces, those that are not good cut at the gap in their middle, or in halves if long."""
    out = []
    for piece, is_good in zip(pieces, good, strict=True):
        middle = (piece.start + piece.stop) // 2
        gaps = [int(g) for g in runs[piece.run].gaps if piece.start < g < piece.stop]
        if is_good or (not gaps and piece.stop - piece.start <= SHORT):
            out.append(piece)
            continue
        middle = min(gaps, key=lambda gap: abs(gap - middle), default=middle)
        out += [piece._replace(stop=middle), piece._replace(start=middle)]
    return out


def segmented(runs: list[Run], pieces: list[Piece], paths: list[np.ndarray]) -> Segments:
    """The pieces as arrays of a few shapes; they start on `paths`."""
    longest = max(piece.stop - piece.start for piece in pieces)
    length = SHORT if longest <= SHORT else power_of_two(longest)
    filled = []
    for r, start, stop in pieces:
        run, part = runs[r], slice(start, stop)
        own = run.times, run.states, run.counts, run.scatter
        filled.append((*(a[part] for a in own), paths[r][start], run.inputs[start : stop - 1]))
    return segments_of(filled, power_of_two(len(pieces)), length)


class Shot(NamedTuple):
    """The path of the current field through every segment.

    Attributes:
        starts: where it starts, shape (S, n).
        path: the path.
        squares: χ² of each segment, inf where the path is lost.
    """

    starts: Float[Array, "S n"]
    path: Path
    squares: Float[Array, " S"]


@eqx.filter_jit
def shot(
    field: Any,
    segments: Segments,
    log_noise: Float[Array, " n"],
    spread: Float[Array, " n"],
    steps,
    starts: Float[Array, "S n"],
    rounds: int,
) -> Shot:
    """The starts after some Levenberg steps from `starts`, of each segment on its own.

    δz minimises ‖r − Pδz‖² + μ‖U δz‖², where P = QU scales the coordinates; μ goes down by ten
    after a step that was better, and up after one that was worse.
    """
    W = jnp.sqrt(segments.counts) * jnp.exp(-log_noise)[None, None]
    S, n = starts.shape
    prior = jnp.broadcast_to(jnp.diag(1 / spread), (S, n, n))

    def at(z):
        path = simulated(field, z, segments.spans, steps, segments.inputs)
        r = (W * (segments.measured - path.x)).reshape(S, -1)
        r = jnp.concatenate([r, (segments.starts - z) / spread[None]], axis=1)
        squares = jnp.sum(r**2, axis=1)
        squares = jnp.where(jnp.isfinite(squares), squares, jnp.inf)
        return path, r, squares

    def move(path, r, squares):
        P = (W[..., None] * tangents(path.across)).reshape(S, -1, n)
        P = jnp.concatenate([P, prior], axis=1)
        P = jnp.where(jnp.isfinite(P), P, jnp.zeros_like(P))
        Q, U = orthonormal(P)
        return back_substituted(U, jnp.einsum("sdn,sd->sn", Q, jnp.where(jnp.isfinite(r), r, 0.0)))

    def step(carry, _):
        best, least, way, mu = carry
        z = best + way / (1 + mu)[:, None]
        path, r, squares = at(z)
        better = squares < least
        new = jnp.where(better[:, None], move(path, r, squares), way)
        new = jnp.where(jnp.isfinite(new), new, jnp.zeros_like(new))
        best = jnp.where(better[:, None], z, best)
        mu = jnp.where(better, mu / 10, mu * 10 + 1)
        return (best, jnp.minimum(squares, least), new, mu), None

    # The first step goes nowhere: it finds the way from the given starts.
    begin = (
        starts,
        jnp.full(S, jnp.inf, starts.dtype),
        jnp.zeros_like(starts),
        jnp.zeros_like(starts[:, 0]),
    )
    (best, _, _, _), _ = jax.lax.scan(step, begin, length=rounds + 1)
    path, _, squares = at(best)
    return Shot(best, path, squares)


def trusted(
    found: Shot,
    segments: Segments,
    noise: Float[np.ndarray, " n"],
    least: Float[np.ndarray, " n"],
) -> Bool[np.ndarray, " S"]:
    """Which segments the field follows well enough to learn from them.

    Residuals are compared with the noise, or with those of half of the segments where they are
    less: a jump in one of them may have been taken for noise in all.

    Args:
        found: the paths.
        segments: the samples.
        noise: the noise as far as it is known.
        least: what a field that is not yet exact may leave where there is no noise at all, a share
            of the states.
    """
    counts = np.asarray(segments.counts)
    samples = (counts > 0).sum(axis=1)  # (S, n)
    with np.errstate(all="ignore"):  # a path that is lost is infinite
        growth = np.abs(np.asarray(tangents(found.path.across))) * (least / least[:, None])
        residual = np.asarray(segments.measured) - np.asarray(found.path.x)
        squares = np.where(counts > 0, counts * residual**2, 0.0).sum(axis=1)  # (S, n)
    whole = np.isfinite(found.squares) & np.isfinite(squares).all(axis=1)
    # A start takes a sample; of one that stands alone nothing is left to compare.
    typical = np.array(
        [
            np.median(s[use] / (t[use] - 1)) if (use := whole & (t > 1)).any() else np.inf
            for s, t in zip(squares.T, samples.T, strict=True)
        ]
    )
    sigma = np.maximum(np.minimum(noise, np.sqrt(typical)), least)
    good = whole & samples.any(axis=1) & (growth.max(axis=(1, 2, 3)) < _GROWTH)
    if good.any():
        each = (squares / sigma[None] ** 2).sum(axis=1) / np.maximum(samples.sum(axis=1), 1)
        # Where half of them are better than that, it is no reason to drop the others.
        good &= each < _FAR * max(np.median(each[good]), 1.0)
    return good


@eqx.filter_jit
def rows_along(field: Expansion, path: Path, segments: Segments, good) -> Rows:
    """The rows along the path of the current field."""
    nodes = jnp.where(good[:, None, None, None], path.nodes, jnp.zeros_like(path.nodes))
    slopes = jax.vmap(jax.vmap(jax.vmap(field)))(nodes)
    return linearised(
        path, slopes, means(field.mean, nodes, slopes), segments, good, is_solution=True
    )


def means(
    mean, nodes: Float[Array, "S L 3 d"], slopes: Float[Array, "S L 3 n"]
) -> Float[Array, "S L 3 n"]:
    """The prior mean at the nodes, whose slopes have its shape."""
    if mean is None:
        return jnp.zeros_like(slopes)
    return jax.vmap(jax.vmap(jax.vmap(mean)))(nodes).astype(nodes.dtype)
