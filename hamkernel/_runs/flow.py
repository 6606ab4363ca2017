"""The flow of a field and its tangent over the intervals between samples.

Each interval has three Gauss nodes, where `learn` later evaluates the field.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from hamkernel._gram import subtract_centre
from hamkernel._machine import compiled_by_size
from hamkernel._structures.base import AbstractMatrixKernel
from hamkernel._structures.friction import damped_coordinates, frictions

# Gauss-Legendre nodes and weights on [0, 1]: exact for polynomials of degree 5.
NODES, WEIGHTS = np.add(np.polynomial.legendre.leggauss(3), [[1.0], [0.0]]) / 2
# The classical Runge-Kutta method: for each stage, the distance along the previous slope at which
# it evaluates the field, and its weight in the step.
_RUNGE_KUTTA = np.array([[0, 1 / 6], [1 / 2, 1 / 3], [1 / 2, 1 / 3], [1, 1 / 6]])
_PIECES = np.diff(np.concatenate([[0.0], NODES, [1.0]]))
# Steps between two nodes, at most. They suffice for ‖∂f/∂x‖ h = 64 · .15/.39 = 25 in an interval h;
# sampling resolves a motion up to about 3.
_MOST_STEPS = 64


class Expansion(eqx.Module):
    """f(x) = mean(x) + Σⱼ K(x, sⱼ) aⱼ. If there are inputs, x and sⱼ are points (x, u)."""

    kernel: AbstractMatrixKernel
    points: Float[Array, "m d"]
    coefficients: Float[Array, "m n"]
    mean: Callable[[Array], Array] | None

    def __call__(self, x: Float[Array, " d"]) -> Float[Array, " n"]:
        learned = self.kernel.expansion(
            *subtract_centre(self.kernel, x, self.points), self.coefficients
        )
        return learned if self.mean is None else self.mean(x).astype(x.dtype) + learned


@compiled_by_size
def field_values(field: Expansion, X: Float[Array, "N d"]) -> Float[Array, "N n"]:
    """The values of the field at the points X."""
    return jax.vmap(field)(X)


def with_tangent(
    field: Callable[[Array], Array], s: Float[Array, " d"], n: int
) -> tuple[Float[Array, " n"], Float[Array, "n n"]]:
    """The velocity f and ∂f/∂x at a point s = (x, u), where x has n coordinates."""
    u = s[n:]

    def twice(x):
        f = field(jnp.concatenate([x, u]))
        return f, f

    tangent, f = jax.jacfwd(twice, has_aux=True)(s[:n])
    return f, tangent


class Path(NamedTuple):
    """A path on S segments of L intervals, and the tangents of its flow.

    Attributes:
        x: states at the samples, shape (S, L + 1, n).
        nodes: points at the Gauss nodes, (x, u) with inputs, shape (S, L, 3, d).
        to_end: ∂x(end)/∂x(node) for the nodes of each interval, shape (S, L, 3, n, n).
        across: ∂x(end)/∂x(start) of each interval, shape (S, L, n, n).
    """

    x: Float[Array, "S L+1 n"]
    nodes: Float[Array, "S L 3 d"]
    to_end: Float[Array, "S L 3 n n"]
    across: Float[Array, "S L n n"]


@compiled_by_size
def _with_norms(field: Any, X: Float[Array, "N d"], scale: Float[Array, " n"]):
    def one(s):
        f, D = with_tangent(field, s, len(scale))
        return f, jnp.linalg.norm(D * scale[None] / scale[:, None])

    return jax.vmap(one)(X)


def stiffness(
    field: Callable[[Array], Array], X: Float[np.ndarray, "N d"], scale: Float[np.ndarray, " n"]
) -> float:
    """The .95 quantile of ‖∂f/∂x‖ at the points X, in standard deviations of the coordinates.

    Dry friction is steep near p = 0, but few points lie near p = 0. The result is therefore at
    least .05 |ṗ|/ε, with the rest speed ε of the friction and the root mean square |ṗ| of the
    damped ṗ. At this rate a step of `steps_for` changes the momentum by about 3 ε.

    Without this bound the error of U′ was 1.8 % for a pendulum that sticks, with q measured at
    50 Hz; with the bound it is .04 % (`tests/benchmarks/model_error.py friction`).
    """
    n = len(scale)
    f, norms = map(np.asarray, _with_norms(field, *jax.device_put((X, scale))))
    rates = [float(np.nanquantile(np.where(np.isfinite(norms), norms, 0.0), 0.95))]
    f = f[np.isfinite(f).all(axis=1)]
    kernel: Any = getattr(field, "kernel", None)
    for part in frictions(kernel) if kernel is not None and len(f) else ():
        forces = f[:, list(damped_coordinates(part.damped, n))]
        if part.rest_speed is not None:
            rates.append(0.05 * float(np.sqrt(np.mean(forces**2))) / part.rest_speed)
    return max(rates)


def steps_for(spans: Float[np.ndarray, "S L"], stiffness: float) -> Int[np.ndarray, " L"]:
    """The number of Runge-Kutta steps between two nodes, for each of the L intervals.

    Args:
        spans: the lengths of the intervals of all segments; the longest of the S segments counts.
        stiffness: ‖∂f/∂x‖.
    """
    return np.clip(np.nan_to_num(_count_steps(spans, stiffness), nan=1.0), 1, _MOST_STEPS).astype(
        int
    )


def is_too_stiff(spans: Float[np.ndarray, "S L"], stiffness: float) -> bool:
    """Whether the field needs more steps than `steps_for` allows in half of the intervals.

    Such a field crosses its own range between two samples: it fits the noise.
    """
    return bool(np.median(_count_steps(spans[spans > 0][None], stiffness)) > _MOST_STEPS)


def _count_steps(spans: Float[np.ndarray, "S L"], stiffness: float) -> Float[np.ndarray, " L"]:
    # A step of order four with ‖∂f/∂x‖ dt = .15 has a relative error of .15⁵/120 = 6e-7.
    return np.ceil(spans.max(axis=0) * _PIECES.max() * stiffness / 0.15)


@compiled_by_size
def integrate(
    field: Any,
    starts: Float[Array, "S n"],
    spans: Float[Array, "S L"],
    steps: Int[Array, " L"],
    inputs: Float[Array, "S L 2 m"],
) -> Path:
    """The path of each segment from its start, and its tangents.

    Let an interval have the length h and the inputs u₀ and u₁ at its ends. In a time that runs from
    0 to 1 the point (x, u) then has the velocity (h f, u₁ − u₀). If the field is NaN or infinite at
    some time, the path is NaN or infinite from then on.
    """
    n = starts.shape[1]

    def piece(s, V, h, rise, share, count):
        part = share / count.astype(share.dtype)

        def slope(s, V):
            f, D = with_tangent(field, s, n)
            return jnp.concatenate([h * f, rise]), h * D @ V

        def step(_, at):
            # We scan over the stages: four copies of ∂f/∂x took twice as long to compile.
            def stage(carry, coefficients):
                (move, turn), total = carry
                reach, weight = coefficients[0], coefficients[1]
                f, D = slope(at[0] + reach * part * move, at[1] + reach * part * turn)
                more = part * weight
                return ((f, D), (total[0] + more * f, total[1] + more * D)), None

            still = jax.tree.map(jnp.zeros_like, at)
            table = jnp.asarray(_RUNGE_KUTTA, s.dtype)
            return jax.lax.scan(stage, (still, at), table)[0][1]

        return jax.lax.fori_loop(0, count, step, (s, V))

    def interval(x, h, ends, count):
        def part(s, share):
            s, V = piece(s, jnp.eye(n, dtype=x.dtype), h, ends[1] - ends[0], share, count)
            return s, (s, V)

        start = jnp.concatenate([x, ends[0]])
        end, (nodes, V) = jax.lax.scan(part, start, jnp.asarray(_PIECES, x.dtype))
        to_end = [V[3]]  # products from the end, which need no inverse
        for tangent in (V[2], V[1], V[0]):
            to_end.append(to_end[-1] @ tangent)
        return end[:n], (end[:n], nodes[:3], jnp.stack(to_end[2::-1]), to_end[3])

    def forward(x, args):
        return jax.vmap(interval, in_axes=(0, 0, 0, None))(x, *args)

    _, out = jax.lax.scan(forward, starts, (spans.T, jnp.moveaxis(inputs, 1, 0), steps))
    ends, nodes, to_end, across = (jnp.moveaxis(a, 0, 1) for a in out)
    return Path(jnp.concatenate([starts[:, None], ends], axis=1), nodes, to_end, across)


def jacobians(mean, nodes: Float[Array, "S L 3 d"], n: int) -> Float[Array, "S L n n"]:
    """The average of ∂m/∂x over each interval, for the prior mean m."""
    if mean is None:
        return jnp.zeros((*nodes.shape[:2], n, n), nodes.dtype)
    D = jax.vmap(jax.vmap(jax.vmap(lambda s: with_tangent(mean, s, n)[1])))(nodes)
    return jnp.einsum("slkab,k->slab", D, jnp.asarray(WEIGHTS, nodes.dtype))


def means(
    mean, nodes: Float[Array, "S L 3 d"], slopes: Float[Array, "S L 3 n"]
) -> Float[Array, "S L 3 n"]:
    """The prior mean at the nodes; zeros if there is none."""
    if mean is None:
        return jnp.zeros_like(slopes)
    return jax.vmap(jax.vmap(jax.vmap(mean)))(nodes).astype(nodes.dtype)


class Segments(NamedTuple):
    """Measured samples on S segments of at most L intervals; padding has no weight and no length.

    Attributes:
        spans: the lengths of the intervals, shape (S, L).
        measured: the states, zero where nothing was measured, shape (S, L + 1, n).
        counts: the number of samples in each mean, 0 where nothing was measured, the same shape.
        scatter: the sum of the squared deviations of these samples from their mean, the same shape.
        starts: prior means of the initial states, shape (S, n).
        inputs: the inputs at both ends of each interval, shape (S, L, 2, m); m = 0 without inputs.
    """

    spans: Float[Array, "S L"]
    measured: Float[Array, "S L+1 n"]
    counts: Float[Array, "S L+1 n"]
    scatter: Float[Array, "S L+1 n"]
    starts: Float[Array, "S n"]
    inputs: Float[Array, "S L 2 m"]


def broadcast_mask(mask: Bool[Array, " S"], a: Array) -> Bool[Array, "S ..."]:
    return mask.reshape(-1, *([1] * (a.ndim - 1)))
