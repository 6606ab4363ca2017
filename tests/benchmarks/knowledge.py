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


PENDULUM = jnp.array([[1.26, 0.0], [2.51, 0.0], [2.98, -4.0]])
HENON_HEILES = jax.random.uniform(jax.random.key(1), (6, 4), minval=-0.35, maxval=0.35)
PROBLEMS = {
    "pendulum, 24 points": Problem(
        hk.systems.Pendulum(mass=1.0), PENDULUM, jnp.linspace(0.0, 0.7, 8), [3.0, 8.0], True
    ),
    "Hénon-Heiles, 48 points": Problem(
        hk.systems.HenonHeiles(), HENON_HEILES, jnp.linspace(0.0, 2.1, 8), [0.35] * 4, False
    ),
}
NOISE = 0.01


def structures(n: int, even: bool) -> dict[str, hk.Separable | Any]:
    """Kernels that know more and more, with lengthscales of one."""
    k, m = hk.Gaussian(1.0), n // 2
    parts = hk.Select(k, tuple(range(m))) + hk.Select(k, tuple(range(m, n)))
    known = {
        "nothing": hk.Separable(k),
        "a Hamiltonian": hk.Symplectic(k),
        "H = T(p) + U(q)": hk.Symplectic(parts),
        "T, and H = T(p) + U(q)": hk.Symplectic(hk.Select(k, tuple(range(m)))),
    }
    if even:
        known["an even H"] = hk.Odd(hk.Symplectic(k))
        known["an even H = T(p) + U(q)"] = hk.Odd(hk.Symplectic(parts))
    return known


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
    n = problem.starts.shape[1]

    def kinetic(x):
        q_dot, _ = jnp.split(problem.system(x), 2)
        return jnp.concatenate([q_dot, jnp.zeros(n // 2)])

    print(f"\n{name}, noise {NOISE}, {seeds} seeds")
    found = {}
    for what, K in structures(n, problem.even).items():
        known = kinetic if what.startswith("T,") else jnp.zeros_like
        found[what] = np.array([error(K, problem, known, seed) for seed in range(seeds)])
        low, median, high = np.quantile(found[what], [0.1, 0.5, 0.9])
        print(f"  {what:26s} {median:.1e} [{low:.1e}, {high:.1e}]", end="", flush=True)
        base = found.get("a Hamiltonian", found[what])
        print(f"  {np.median(base) / median:6.1f}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, default=20)
    seeds = parser.parse_args().seeds
    for name, problem in PROBLEMS.items():
        report(name, problem, seeds)


if __name__ == "__main__":
    main()
