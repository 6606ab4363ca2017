"""A Gaussian process in time with the Matérn-7/2 kernel, by Kalman filtering: linear in time.

With u = λ t and λ = √7/ℓ the process and its first three derivatives in u obey a linear equation
driven by white noise, (d/du + 1)⁴ x = w. Between two samples

    A(u) = exp(−u) Σ_{j<4} (N u)ʲ/j!,      P ← P∞ + A (P − P∞) Aᵀ,

N the companion matrix plus the identity, which is nilpotent: both are exact for any spacing.

The smoother is that of Bryson & Frazier, backward in the adjoint (l, L): x = m − P l and
Cov = P − P L P. It inverts no predicted covariance, which is singular to rounding where samples
are close, and it takes padding, no time and no measurement, without a special case.

Source: Hartikainen & Särkkä (2010), "Kalman filtering and smoothing solutions to temporal Gaussian
process regression models"; Bierman (1973) for the smoother.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

# Moments ∫ω^(2j) S(ω) dω of the spectral density (1 + ω²)⁻⁴, of mass one, are 1, 1/5, 1/5, 1.
_STATIONARY = np.array(
    [[1, 0, -0.2, 0], [0, 0.2, 0, -0.2], [-0.2, 0, 0.2, 0], [0, -0.2, 0, 1]], float
)
_NILPOTENT = np.eye(4) + np.array([[0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1], [-1, -4, -6, -4]])
_POWERS = np.stack([np.linalg.matrix_power(_NILPOTENT, j) / f for j, f in enumerate((1, 1, 2, 6))])


class Process(NamedTuple):
    """Hyperparameters: standard deviation of the signal, rate λ per time, that of the noise."""

    log_amplitude: Float[Array, ""]
    log_rate: Float[Array, ""]
    log_noise: Float[Array, ""]


class Smoothed(NamedTuple):
    """The process given the samples, at their times.

    Attributes:
        value: x(t), shape (T,).
        slope: ẋ(t).
        deviation: the standard deviation of x(t).
        slope_deviation: that of ẋ(t).
    """

    value: Float[Array, " T"]
    slope: Float[Array, " T"]
    deviation: Float[Array, " T"]
    slope_deviation: Float[Array, " T"]


def _transition(u: Float[Array, ""]) -> Float[Array, "4 4"]:
    powers = jnp.cumprod(jnp.concatenate([jnp.ones(1, u.dtype), jnp.broadcast_to(u, (3,))]))
    return jnp.exp(-u) * jnp.tensordot(powers, jnp.asarray(_POWERS, u.dtype), 1)


def _stationary(process: Process) -> Float[Array, "4 4"]:
    dtype = process.log_rate.dtype
    return jnp.exp(2 * process.log_amplitude) * jnp.asarray(_STATIONARY, dtype)


def _filtered(process: Process, steps, y, seen):
    """One pass forward; what the backward pass needs of each time, and the log likelihood.

    `steps` are the times since the sample before, and 0 for the first.
    """
    stationary = _stationary(process)
    variance = jnp.exp(2 * process.log_noise)

    def step(carry, sample):
        m, P = carry
        dt, value, there = sample
        A = _transition(jnp.exp(process.log_rate) * dt)
        m = A @ m
        P = stationary + A @ (P - stationary) @ A.T
        P = (P + P.T) / 2
        S = P[0, 0] + variance
        error = jnp.where(there, value - m[0], jnp.zeros_like(value))
        gain = jnp.where(there, P[0] / S, jnp.zeros_like(P[0]))
        loss = jnp.where(there, error**2 / S + jnp.log(2 * jnp.pi * S), jnp.zeros_like(S))
        return (m + gain * error, P - gain[:, None] * P[0][None, :]), (m, P, S, error, A, loss)

    start = jnp.zeros(4, y.dtype), stationary
    _, out = jax.lax.scan(step, start, (steps, y, seen))
    return out


def negative_log_likelihood(
    process: Process,
    steps: Float[Array, "R T"],
    y: Float[Array, "R T"],
    seen: Bool[Array, "R T"],
) -> Float[Array, ""]:
    """−log p(y) of several independent runs; `steps` as in `smooth`."""
    one = jax.vmap(lambda dt, value, there: _filtered(process, dt, value, there)[-1].sum())
    return 0.5 * one(steps, y, seen).sum()


def smooth(
    process: Process, steps: Float[Array, " T"], y: Float[Array, " T"], seen: Bool[Array, " T"]
) -> Smoothed:
    """The process given one run: values and derivatives at all its times, measured or not.

    Args:
        process: the hyperparameters.
        steps: the time since the sample before, 0 for the first.
        y: the samples.
        seen: which of them were measured.
    """
    m, P, S, error, A, _ = _filtered(process, steps, y, seen)

    def step(carry, at):
        l, L = carry  # noqa: E741 - the adjoint, after the sample
        m, P, S, error, A, there = at
        on = there.astype(y.dtype)
        C = jnp.eye(4, dtype=y.dtype).at[:, 0].add(-on * P[0] / S)
        l = C.T @ l  # noqa: E741
        l = l.at[0].add(-on * error / S)  # noqa: E741
        L = C.T @ L @ C
        L = L.at[0, 0].add(on / S)
        value = m - P @ l
        covariance = P - P @ L @ P
        return (A.T @ l, A.T @ L @ A), (value[:2], jnp.diagonal(covariance)[:2])

    none = jnp.zeros(4, y.dtype), jnp.zeros((4, 4), y.dtype)
    _, (mean, variance) = jax.lax.scan(step, none, (m, P, S, error, A, seen), reverse=True)
    rate = jnp.exp(process.log_rate)
    deviation = jnp.sqrt(jnp.maximum(variance, jnp.zeros_like(variance)))
    return Smoothed(mean[:, 0], rate * mean[:, 1], deviation[:, 0], rate * deviation[:, 1])
