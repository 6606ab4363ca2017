"""What random features cost, and how close they come to the exact kernel.

    python tests/benchmarks/random_features.py [--points 20000]

Prints the error of the Gram against the count with its log-log slope; the trajectory error of the
paper's pendulum (odd symplectic Gaussian, 24 points) relative to that of the exact kernel, over
noise seeds; and the time of a fit against the number of points, in one call and in chunks.
"""

import argparse

import jax

jax.config.update("jax_enable_x64", True)

import jax.numpy as jnp
import numpy as np
from timing import in_turn

import hamkernel as hk
from hamkernel import RandomFeatures
from hamkernel._features import features
from hamkernel.paper import READINGS, datasets, experiments

DRAWS = 10
KERNEL = hk.Odd(hk.Symplectic(hk.Gaussian(3.0)))


def gram_errors(X):
    exact = hk.gram(KERNEL, X)

    def error(count, key):
        rows = features(KERNEL, X.shape[1], count, key, X.dtype)(X)
        approximate = jnp.einsum("iar,jbr->iajb", rows, rows)
        return jnp.linalg.norm(approximate - exact) / jnp.linalg.norm(exact)

    keys = jax.random.split(jax.random.key(0), DRAWS)
    counts = 2 ** np.arange(6, 13)
    errors = [
        float(jax.jit(lambda keys, c=int(c): jax.lax.map(lambda k: error(c, k), keys).mean())(keys))
        for c in counts
    ]
    for count, value in zip(counts, errors, strict=True):
        print(f"{count:6d} frequencies: relative error of the Gram {value:.4f}")
    print(f"slope {np.polyfit(np.log(counts), np.log(errors), 1)[0]:.3f}, expected -0.5\n")


def pendulum(seeds):
    experiment = experiments()["pendulum_m1"]
    keys = jax.random.split(jax.random.key(1), seeds)
    X, Y = datasets(experiment, keys)
    ts, x0 = jnp.linspace(0, experiment.horizon, 101), jnp.asarray(experiment.test_state)
    true = jnp.asarray(hk.simulate(experiment.system, x0, ts).ys)

    @jax.jit
    def errors(X, Y, key, ridge):
        fields = [hk.fit(KERNEL, X, Y, ridge, solver=s) for s in (None, RandomFeatures(500, key))]
        orbits = [hk.simulate(field, x0, ts).ys for field in fields]
        return jnp.stack([jnp.linalg.norm(jnp.asarray(ys) - true, axis=1).mean() for ys in orbits])

    for name, reading in READINGS.items():
        ridge = jnp.asarray(reading(1e-4, experiment.size))
        both = np.array([errors(*seed, ridge) for seed in zip(X, Y, keys, strict=True)])
        ratio = both[:, 1] / both[:, 0]
        print(
            f"pendulum, ridge {name}: mean trajectory error, median over {seeds} seeds: exact "
            f"{np.median(both[:, 0]):.4f}, 500 features {np.median(both[:, 1]):.4f}; their ratio "
            f"{np.median(ratio):.2f}, below 2 in {np.mean(ratio < 2):.0%}"
        )


def cost(largest, count=200, chunk=5000):
    system, solver = hk.systems.Pendulum(), RandomFeatures(count, jax.random.key(0))
    print(f"\n{count} frequencies; chunks of {chunk} points")
    for N in (largest // 4, largest // 2, largest):
        X = jax.random.uniform(jax.random.key(2), (N, 2), minval=-3.0, maxval=3.0)
        Y = jax.vmap(system)(X)
        cuts = [(X[i : i + chunk], Y[i : i + chunk]) for i in range(0, N, chunk)]
        runs = {
            "one call": lambda X=X, Y=Y: hk.fit(KERNEL, X, Y, 1e-6, solver=solver),
            "chunks": lambda cuts=cuts: solver.fit_chunks(KERNEL, cuts, 1e-6),
        }
        times = in_turn(3, runs)
        one, chunked = (each.result.evaluate(X[:100]) for each in times.values())
        gap = float(jnp.abs(one - chunked).max())
        shown = ", ".join(f"{name} {each.least:.2f} s" for name, each in times.items())
        print(f"N = {N:8d}: {shown}; they differ by {gap:.1e}")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description="Cost and accuracy of random features.")
    parser.add_argument("--points", type=int, default=20_000)
    parser.add_argument("--seeds", type=int, default=20)
    arguments = parser.parse_args()
    gram_errors(jax.random.normal(jax.random.key(3), (24, 2)) * 2)
    pendulum(arguments.seeds)
    cost(arguments.points)
