"""Whether the marginal likelihood tells a structure that is slightly wrong: a damped pendulum.

    python tests/benchmarks/structure.py [--seeds 4]

Five runs of 21 states and velocities, noise 0.01 on both. For each damping it prints how much
`Symplectic + CurlFree`, which may dissipate, gains in log marginal likelihood over `Symplectic`,
and the cross-validation loss (by run) of `Symplectic` over that of `Separable`: one value a seed.
"""

import argparse

import jax

jax.config.update("jax_enable_x64", True)

import jax.numpy as jnp
import numpy as np

import hamkernel as hk

RUNS, COUNT, NOISE = 5, 21, 0.01


def data(damping: float, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """States and velocities, shape (105, 2), run after run."""
    rng = np.random.default_rng(seed)
    starts = jnp.asarray(rng.uniform(-1, 1, size=(RUNS, 2)) * [2.5, 4.0])
    pendulum = hk.systems.Pendulum(mass=1.0)

    def damped(x):
        return pendulum(x) - jnp.array([0.0, damping]) * x

    ts = jnp.linspace(0.0, 2.0, COUNT)
    X = np.asarray(jax.vmap(lambda x: hk.simulate(damped, x, ts).ys)(starts)).reshape(-1, 2)
    Y = np.asarray(jax.vmap(damped)(jnp.asarray(X)))
    return X + NOISE * rng.normal(size=X.shape), Y + NOISE * rng.normal(size=Y.shape)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, default=4)
    seeds = parser.parse_args().seeds
    k = hk.Gaussian(3.0)
    conserving = hk.Symplectic(1.0 * k)
    dissipating = hk.Symplectic(1.0 * k) + hk.CurlFree(1.0 * k)
    runs = np.repeat(np.arange(RUNS), COUNT)
    for damping in (0.0, 0.02, 0.05, 0.2):
        gains, ratios = [], []
        for seed in range(seeds):
            X, Y = data(damping, seed)
            losses = [
                float(hk.tune(K, X, Y, 1e-5, objective="marginal_likelihood").loss)
                for K in (conserving, dissipating)
            ]
            gains.append(losses[0] - losses[1])
            errors = [
                float(hk.tune(K, X, Y, 1e-5, runs).loss)
                for K in (hk.Symplectic(k), hk.Separable(k))
            ]
            ratios.append(errors[0] / errors[1])
        print(f"damping {damping:4.2f}/s: gain in log likelihood {np.round(gains, 1)}", end="")
        print(f", loss over that of Separable {np.round(ratios, 2)}", flush=True)


if __name__ == "__main__":
    main()
