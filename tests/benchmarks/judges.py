"""Which objective of `tune` finds the better field, by the number of runs.

    python tests/benchmarks/judges.py [--seeds 8] [--systems pendulum ...] [--runs 3 6 12]

Noisy runs of eight points each from random states. For each number of runs and each judge: the
median over seeds of the field error, the root mean square of f − f* over that of f*, at the states
of 100 new runs from the same distribution. Judges: cross-validation by run, leave-one-out, five
blocks of consecutive points, and the marginal likelihood with an amplitude.
"""

import argparse
import warnings

import jax

jax.config.update("jax_enable_x64", True)

import jax.numpy as jnp
import numpy as np

import hamkernel as hk

POINTS, NEW = 8, 100
# name: system, half the box of initial states, length of a run, noise on states and velocities
SYSTEMS = {
    "pendulum": (hk.systems.Pendulum(mass=1.0), [2.5, 4.0], 0.7, 0.01),
    "duffing": (hk.systems.Duffing(), [1.5, 1.0], 3.0, 0.05),
    "henon_heiles": (hk.systems.HenonHeiles(), [0.4, 0.4, 0.3, 0.3], 6.0, 0.01),
}
JUDGES = ("by run", "loo", "blocks", "likelihood")


def runs_of(name: str, count: int, noise: float, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Points (count · POINTS, n) of so many runs, one run after the other."""
    system, box, end, _ = SYSTEMS[name]
    starts = np.random.default_rng(seed).uniform(-1, 1, size=(count, len(box))) * box
    ts = jnp.linspace(0.0, end, POINTS)
    X, Y = hk.systems.sample(
        system, jnp.asarray(starts), ts, noise, noise, key=jax.random.key(seed)
    )
    return np.asarray(X).reshape(-1, len(box)), np.asarray(Y).reshape(-1, len(box))


def tuned_by(judge: str, X: np.ndarray, Y: np.ndarray) -> hk.Tuned:
    k = hk.Gaussian(1.0)
    if judge == "likelihood":
        return hk.tune(hk.Symplectic(1.0 * k), X, Y, objective="marginal_likelihood")
    folds = {"by run": np.arange(len(X)) // POINTS, "loo": "loo", "blocks": 5}[judge]
    return hk.tune(hk.Symplectic(k), X, Y, folds=folds)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, default=8)
    parser.add_argument("--systems", nargs="+", choices=SYSTEMS, default=list(SYSTEMS))
    parser.add_argument("--runs", nargs="+", type=int, default=[3, 6, 12])
    options = parser.parse_args()
    warnings.filterwarnings("ignore", "the labels in folds make")
    print(f"{'':21s}" + "".join(f"{judge:>12s}" for judge in JUDGES))
    for name in options.systems:
        new, true = runs_of(name, NEW, 0.0, 10**6)
        for count in options.runs:
            errors = {judge: [] for judge in JUDGES}
            for seed in range(options.seeds):
                X, Y = runs_of(name, count, SYSTEMS[name][3], seed)
                for judge in JUDGES:
                    field = tuned_by(judge, X, Y).field
                    wrong = np.linalg.norm(field.evaluate(new) - true)
                    errors[judge].append(wrong / np.linalg.norm(true))
            medians = "".join(f"{np.median(errors[judge]):12.3g}" for judge in JUDGES)
            print(f"{name:13s}{count:3d} runs {medians}", flush=True)


if __name__ == "__main__":
    main()
