"""Multiple shooting: each segment simulated with the current field, and its start improved.

Levenberg steps on the starts alone come before a segment is judged: without them up to 40 % of the
segments were lost.
"""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from hamkernel._machine import orthonormal
from hamkernel._trajectories.flow import (
    Expansion,
    Path,
    means,
    simulated,
)
from hamkernel._trajectories.segments import (
    LinearisedSegments,
    Segments,
    back_substituted,
    broadcast_mask,
    linearised,
    tangents,
)

_GROWTH = 1e4  # of the tangent, beyond which a path says nothing of its start
_DONE = 1e-3  # of χ², and absolutely: a start that is .03 of its deviation from the best
_FAR = 25.0  # times the median χ² per sample


class Shooting(NamedTuple):
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
def shoot(
    field: Any,
    segments: Segments,
    log_noise: Float[Array, " n"],
    start_deviation: Float[Array, " n"],
    steps,
    starts: Float[Array, "S n"],
    rounds: int,
) -> Shooting:
    """The starts after some Levenberg steps from `starts`, of each segment on its own.

    δz minimises ‖r − Pδz‖² + μ‖U δz‖², where P = QU scales the coordinates; μ goes down by ten
    after a step that was better, and up after one that was worse. The steps end when none promises
    a decrease of χ², ‖Qᵀr‖², that would be noticed.
    """
    W = jnp.sqrt(segments.counts) * jnp.exp(-log_noise)[None, None]
    S, n = starts.shape
    prior = jnp.broadcast_to(jnp.diag(1 / start_deviation), (S, n, n))

    def at(z):
        path = simulated(field, z, segments.spans, steps, segments.inputs)
        r = (W * (segments.measured - path.x)).reshape(S, -1)
        r = jnp.concatenate([r, (segments.starts - z) / start_deviation[None]], axis=1)
        squares = jnp.sum(r**2, axis=1)
        squares = jnp.where(jnp.isfinite(squares), squares, jnp.inf)
        return path, r, squares

    def move(path, r):
        P = (W[..., None] * tangents(path.across)).reshape(S, -1, n)
        P = jnp.concatenate([P, prior], axis=1)
        P = jnp.where(jnp.isfinite(P), P, jnp.zeros_like(P))
        Q, U = orthonormal(P)
        right = jnp.einsum("sdn,sd->sn", Q, jnp.where(jnp.isfinite(r), r, 0.0))
        return back_substituted(U, right), jnp.sum(right**2, axis=1)

    def step(carry):
        count, best, path, least, way, mu, promised = carry
        z = best + way / (1 + mu)[:, None]
        there, r, squares = at(z)
        better = squares < least
        new, decrease = move(there, r)
        path = jax.tree.map(lambda a, b: jnp.where(broadcast_mask(better, a), a, b), there, path)
        return (
            count + 1,
            jnp.where(better[:, None], z, best),
            path,
            jnp.minimum(squares, least),
            jnp.where(better[:, None], jnp.where(jnp.isfinite(new), new, 0.0), way),
            jnp.where(better, mu / 10, mu * 10 + 1),
            jnp.where(better, decrease, promised),
        )

    def goes_on(carry):
        count, *_, least, _, _, promised = carry
        return (count == 0) | ((count <= rounds) & jnp.any(promised > _DONE * (1 + least)))

    # The first step goes nowhere: it finds the way from the given starts.
    shapes = jax.eval_shape(at, starts)[0]
    nowhere = jax.tree.map(lambda a: jnp.zeros(a.shape, a.dtype), shapes)
    lost, zeros = jnp.full(S, jnp.inf, starts.dtype), jnp.zeros_like(starts)
    begin = (0, starts, nowhere, lost, zeros, zeros[:, 0], zeros[:, 0])
    _, best, path, squares, *_ = jax.lax.while_loop(goes_on, step, begin)
    return Shooting(best, path, squares)


def trusted(
    found: Shooting,
    segments: Segments,
    noise: Float[np.ndarray, " n"],
    least: Float[np.ndarray, " n"],
    was_asked: bool = True,
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
        was_asked: whether a field was learned from rows along its own path before. If not, it may
            miss a segment because the smoothed path did: of five samples a swing, or of the fastest
            of short runs.
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
    if good.any() and was_asked:
        each = (squares / sigma[None] ** 2).sum(axis=1) / np.maximum(samples.sum(axis=1), 1)
        # Where half of them are better than that, it is no reason to drop the others.
        good &= each < _FAR * max(np.median(each[good]), 1.0)
    return good


@eqx.filter_jit
def linearised_along_field(
    field: Expansion, path: Path, segments: Segments, good
) -> LinearisedSegments:
    """The rows along the path of the current field."""
    nodes = jnp.where(good[:, None, None, None], path.nodes, jnp.zeros_like(path.nodes))
    slopes = jax.vmap(jax.vmap(jax.vmap(field)))(nodes)
    return linearised(
        path, slopes, means(field.mean, nodes, slopes), segments, good, is_solution=True
    )
