"""What it is worth to know something of H: errors of fields tuned on the same few noisy data.

    python tests/benchmarks/knowledge.py [--seeds 20]

For each structure the error over a box of states, root mean square, as a share of the field: the
median over noise seeds, the range from the 10th to the 90th percentile, and how many times smaller
the median is than that of the symplectic kernel. `tune` does all of it from its defaults, with one
fold for each run.
"""

import argparse
from collections.abc import Callable
from typing import Any, NamedTuple

import jax

jax.config.update("jax_enable_x64", True)

import jax.numpy as jnp
import numpy as np

import hamkernel as hk


class Problem(NamedTuple):
    """A system, the starts of its runs, its times, and half the sides of the box to test in."""

    system: Any
    starts: jax.Array
    ts: jax.Array
    box: list[float]
    even: bool  # H(−x) = H(x)


PENDULUM_STARTS = jnp.array([[1.26, 0.0], [2.51, 0.0], [2.98, -4.0]])
HENON_HEILES_STARTS = jax.random.uniform(jax.random.key(1), (6, 4), minval=-0.35, maxval=0.35)
PROBLEMS = {
    "pendulum, 24 points": Problem(
        hk.systems.Pendulum(mass=1.0), PENDULUM_STARTS, jnp.linspace(0.0, 0.7, 8), [3.0, 8.0], True
    ),
    "Hénon-Heiles, 48 points": Problem(
        hk.systems.HenonHeiles(), HENON_HEILES_STARTS, jnp.linspace(0.0, 2.1, 8), [0.35] * 4, False
    ),
}
NOISE = 0.01


def structures(problem: Problem) -> dict[str, tuple[Any, Callable]]:
    """Kernels that know more and more, with lengthscales of one, and the field that is known."""
    n = problem.starts.shape[1]
    q, p = tuple(range(n // 2)), tuple(range(n // 2, n))
    k = hk.Gaussian(1.0)
    split = hk.Select(k, q) + hk.Select(k, p)

    def kinetic(x):
        q_dot, p_dot = jnp.split(problem.system(x), 2)
        return jnp.concatenate([q_dot, jnp.zeros_like(p_dot)])

    found = {
        "nothing": (hk.Separable(k), jnp.zeros_like),
        "there is an H": (hk.Symplectic(k), jnp.zeros_like),
        "H = T(p) + U(q)": (hk.Symplectic(split), jnp.zeros_like),
        "and T itself": (hk.Symplectic(hk.Select(k, q)), kinetic),
    }
    if problem.even:
        found["H is even"] = hk.Odd(hk.Symplectic(k)), jnp.zeros_like
        found["H = T(p) + U(q) and even"] = hk.Odd(hk.Symplectic(split)), jnp.zeros_like
    return found


def error(K: Any, problem: Problem, known: Callable, seed: int) -> float:
    """The error of the field that is left when `known` is subtracted, over the whole field."""
    n, key = problem.starts.shape[1], jax.random.key(seed)
    runs = hk.systems.sample(problem.system, problem.starts, problem.ts, NOISE, NOISE, key=key)
    X, Y = (values.reshape(-1, n) for values in runs)
    folds = np.repeat(np.arange(len(problem.starts)), len(problem.ts))
    field = hk.tune(K, X, Y - jax.vmap(known)(X), folds=folds).field
    box = np.asarray(problem.box)
    states = jnp.asarray(np.random.default_rng(0).uniform(-box, box, size=(500, n)))
    truth = jax.vmap(problem.system)(states)
    off = field.evaluate(states) + jax.vmap(known)(states) - truth
    return float(jnp.linalg.norm(off) / jnp.linalg.norm(truth))


def report(name: str, problem: Problem, seeds: int) -> None:
    print(f"\n{name}, noise {NOISE}, {seeds} seeds")
    medians = {}
    for what, (K, known) in structures(problem).items():
        errors = [error(K, problem, known, seed) for seed in range(seeds)]
        low, medians[what], high = np.quantile(errors, [0.1, 0.5, 0.9])
        print(f"  {what:26s} {medians[what]:.1e} [{low:.1e}, {high:.1e}]", end="", flush=True)
        print(f"  {medians.get('there is an H', np.nan) / medians[what]:6.1f}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, default=20)
    seeds = parser.parse_args().seeds
    for name, problem in PROBLEMS.items():
        report(name, problem, seeds)


if __name__ == "__main__":
    main()
