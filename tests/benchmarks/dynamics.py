"""What learned dynamics keep: a field with a Hamiltonian beside one without.

    python tests/benchmarks/dynamics.py [--seeds 5]

Noise-free data at random states, every hyperparameter found by `hk.tune`, several seeds of points:
the median, and the smallest and largest in brackets. Energies are true ones, of states on learned
trajectories, which are integrated in steps of 0.05 by a method of order 6.

1. Hénon–Heiles, 100 velocities in [−1, 1]⁴. The error of H is that on the plane p = 0, in the
   triangle of bounded motion, relative to the standard deviation of H there, the constant removed.
   A separable field has no H; its number is that of the work along the straight line from the
   origin, the best that can be made of it. The drift is the largest |ΔH|/H up to t = 100, from an
   energy of 1/8, below the 1/6 where motion may escape.
2. Two bodies in the plane, n = 8, 600 velocities around circular orbits: the error of the velocity
   on 1000 other such states, relative, and the largest |ΔH/H| of 10 motions to t = 20, about 4.5
   revolutions. Tuned on 150 of the points, then fitted to all. The time is that of both, with all
   compilation for the first seed.
"""

import argparse
import time
from collections.abc import Callable, Mapping
from typing import NamedTuple, cast

import jax

jax.config.update("jax_enable_x64", True)

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

import hamkernel as hk

Field = Callable[[Array], Array]


def hamiltonian_error(H: Field, true: Field, points: Float[Array, "P n"]) -> float:
    """Standard deviation of H − H_true over the points, relative to that of H_true."""
    values, reference = (np.asarray(jax.jit(jax.vmap(fn))(points)) for fn in (H, true))
    return float(np.std(values - reference) / np.std(reference))


def work(field: Field) -> Field:
    """The work from the origin to x against a field: H where the field is J∇H, else a guess.

    ∫₀¹ (−J f)(sx)·x ds along the straight line, by Gauss–Legendre quadrature with 40 nodes.
    """
    nodes, weights = np.polynomial.legendre.leggauss(40)

    def along(x):
        dq, dp = jnp.split(jax.vmap(lambda s: field(s * x))(jnp.asarray(nodes + 1) / 2), 2, axis=1)
        return jnp.asarray(weights / 2) @ (jnp.concatenate([-dp, dq], axis=1) @ x)

    return along


@eqx.filter_jit
def _energies(field, system, starts, ts):
    def energies(x0):
        # Constant steps: a field of large coefficients rounds at more than the tolerance of a
        # good adaptive run, which then takes forever.
        ys = hk.simulate(field, x0, ts, hk.GaussLegendre6(), dt=0.05, throw=False).ys
        return jax.vmap(system.hamiltonian)(cast(Array, ys))

    return jax.vmap(energies)(starts)


def energy_drift(field: Field, system, starts: Float[Array, "B n"], end: float) -> np.ndarray:
    """The largest |H − H₀|/|H₀| on each motion up to `end`, shape (B,); inf where one is lost."""
    H = np.asarray(_energies(field, system, starts, jnp.linspace(0.0, end, 501)))  # (B, T)
    drift = np.abs(H / H[:, :1] - 1).max(axis=1)
    return np.where(np.isfinite(drift), drift, np.inf)


class HenonHeiles(NamedTuple):
    """What one kernel learned from one seed of points."""

    hamiltonian_error: float
    drift: float


HENON_HEILES = hk.systems.HenonHeiles()
HENON_HEILES_KERNELS = {
    "separable Gaussian": hk.Separable(hk.Gaussian(1.0)),
    "symplectic Gaussian": hk.Symplectic(hk.Gaussian(1.0)),
    "symplectic polynomial, degree 4": hk.Symplectic(hk.Polynomial(4)),
}
BOUNDED = jnp.array([0.3, 0.0, 0.0, 0.4])  # H = 1/8


def triangle(resolution: int = 41) -> Float[Array, "P 4"]:
    """States at rest where motion of H < 1/6 stays: |q₁| < (1 − q₂)/√3, q₂ > −1/2."""
    q1, q2 = np.meshgrid(np.linspace(-1, 1, resolution), np.linspace(-0.5, 1, resolution))
    inside = np.abs(q1) <= (1 - q2) / np.sqrt(3)
    q = np.stack([q1[inside], q2[inside]], axis=1)
    return jnp.asarray(np.hstack([q, np.zeros_like(q)]))


def henon_heiles(K, seed: int) -> HenonHeiles:
    """Learn Hénon–Heiles from 100 velocities and test the field."""
    X = jnp.asarray(np.random.default_rng(seed).uniform(-1, 1, (100, 4)))
    tuned = hk.tune(K, X, jax.vmap(HENON_HEILES)(X), 1e-6, starts=8)
    field = tuned.field
    H = field.hamiltonian if tuned.kernel.symplectic else work(field)
    error = hamiltonian_error(H, HENON_HEILES.hamiltonian, triangle())
    (drift,) = energy_drift(field, HENON_HEILES, BOUNDED[None], 100.0)
    return HenonHeiles(error, float(drift))


class TwoBodies(NamedTuple):
    """What one kernel learned from one seed of points."""

    field_error: float
    drifts: np.ndarray  # (10,)
    seconds: float


TWO_BODIES = hk.systems.NBody(masses=(1.0, 1.0))
TUNED_ON = 150


def _difference(x):
    return x[2:4] - x[:2]


TWO_BODY_KERNELS = {
    "separable Gaussian": hk.Separable(hk.Gaussian(2.0)),
    "symplectic Gaussian": hk.Symplectic(hk.Gaussian(2.0)),
    "symplectic T(p) + U(q₂ - q₁)": hk.Symplectic(
        hk.Select(hk.Gaussian(2.0), (4, 5, 6, 7)) + hk.Warp(hk.Gaussian(1.0), _difference)
    ),
}


def near_circular(rng: np.random.Generator, count: int) -> Float[Array, "count 8"]:
    """States of two unit masses around circular orbits of distance 0.8 to 1.2, counter-clockwise.

    The relative velocity is that of the circle and up to 5 % of it in each direction; the centre of
    mass is up to 0.1 from the origin and moves by up to 0.005 in each direction.
    """
    distance, angle = rng.uniform(0.8, 1.2, count), rng.uniform(0, 2 * np.pi, count)
    outward = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    forward = np.stack([-np.sin(angle), np.cos(angle)], axis=1)
    along, across = rng.uniform(-0.05, 0.05, (2, count, 1))
    v = np.sqrt(2 / distance)[:, None] * ((1 + along) * forward + across * outward)
    r = distance[:, None] * outward
    centre, drift = rng.uniform(-0.1, 0.1, (count, 2)), rng.uniform(-0.005, 0.005, (count, 2))
    return jnp.asarray(np.hstack([centre - r / 2, centre + r / 2, drift - v / 2, drift + v / 2]))


def two_bodies(K, seed: int) -> TwoBodies:
    """Learn two bodies from 600 velocities and test the field."""
    rng = np.random.default_rng(seed)
    X, new, starts = (near_circular(rng, count) for count in (600, 1000, 10))
    Y = jax.vmap(TWO_BODIES)(X)
    begin = time.perf_counter()
    tuned = hk.tune(K, X[:TUNED_ON], Y[:TUNED_ON], 1e-6, starts=4, max_steps=32)
    # The same ridge Nλ for all points as for those that it was tuned on.
    field = hk.fit(tuned.kernel, X, Y, tuned.regularization * (TUNED_ON / len(X)))
    jax.block_until_ready(field)
    seconds = time.perf_counter() - begin
    true = jax.vmap(TWO_BODIES)(new)
    error = float(jnp.linalg.norm(field.evaluate(new) - true) / jnp.linalg.norm(true))
    return TwoBodies(error, energy_drift(field, TWO_BODIES, starts, 20.0), seconds)


def spread(values) -> str:
    median, low, high = np.median(values), np.min(values), np.max(values)
    return f"{median:.1e} [{low:.1e}, {high:.1e}]"


def show(kernels: Mapping, columns: Mapping[str, Callable], run: Callable, seeds: int) -> None:
    print(f"  {'':32s}" + "".join(f"{name:32s}" for name in columns))
    for name, K in kernels.items():
        answers = [run(K, seed) for seed in range(seeds)]
        cells = (spread([of(answer) for answer in answers]) for of in columns.values())
        print(f"  {name:32s}" + "".join(f"{cell:32s}" for cell in cells), flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description="What learned dynamics keep.")
    parser.add_argument("--seeds", type=int, default=5)
    seeds = parser.parse_args().seeds
    print(f"Hénon-Heiles, 100 exact velocities in [-1, 1]^4, {seeds} seeds of points")
    columns = {
        "relative error of H": lambda each: each.hamiltonian_error,
        "energy drift to t = 100": lambda each: each.drift,
    }
    show(HENON_HEILES_KERNELS, columns, henon_heiles, seeds)
    print(f"Two bodies, 600 exact velocities around circular orbits, {seeds} seeds of points")
    columns = {
        "relative error of the field": lambda each: each.field_error,
        "energy drift, median of 10": lambda each: np.median(each.drifts),
        "energy drift, worst of 10": lambda each: each.drifts.max(),
        "tune and fit, s": lambda each: each.seconds,
    }
    show(TWO_BODY_KERNELS, columns, two_bodies, seeds)


if __name__ == "__main__":
    main()
