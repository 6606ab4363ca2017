"""How close `tune` comes to the best point of a fine grid over the same box.

    python tests/benchmarks/tuning_quality.py [--seeds 4] [--times 1] [--systems pendulum ...]

Five systems, four kernels, noise seeds, and poor starting points (lengthscale 0.3, 3, 30 with
λ = 0.1): 240 problems by default. The grid has 60 × 60 points over the box that `tune` searches,
lengthscale by λ, where λ runs upwards from the rounding of the Gram at each lengthscale, or from
the larger bound of a search that was made again so that the field is smooth. Prints the ratio of
the tuned loss to the grid's best. `--times 4` has four times the points on each trajectory, so that
the runs are on a subset; the grid then takes most of the time, minutes with n = 4.
"""

import argparse

import jax

jax.config.update("jax_enable_x64", True)

import equinox as eqx
import jax.numpy as jnp
import numpy as np

import hamkernel as hk
from hamkernel._tuning.boxes import full_trace
from hamkernel._tuning.space import ROUNDINGS, SearchSpace
from hamkernel._validation.folds import Partition
from hamkernel._validation.losses import partition_loss

GRID = 60
START_RIDGE = 0.1

# name: system, initial states, end time, points per trajectory, noise on states and velocities
SYSTEMS = {
    "oscillator": (hk.systems.HarmonicOscillator(), [[1, 0], [2.25, 0], [3.5, 0]], 1.0, 5, 0.1),
    "pendulum": (
        hk.systems.Pendulum(mass=1.0),
        [[1.257, 0], [2.513, 0], [2.985, -4]],
        0.7,
        8,
        0.01,
    ),
    "duffing": (hk.systems.Duffing(), [[0.5, 0], [1.2, 0.3], [-1.5, 0.5]], 3.0, 9, 0.05),
    "henon_heiles": (
        hk.systems.HenonHeiles(),
        [[0.1, 0.2, 0.3, 0.1], [-0.3, 0.1, 0.1, 0.2], [0.2, -0.4, 0.0, 0.1]],
        6.0,
        10,
        0.01,
    ),
    "double_pendulum": (
        hk.systems.DoublePendulum(),
        [[0.5, 0.2, 0, 0], [1.0, -0.5, 0, 0], [-0.8, 0.9, 0, 0]],
        1.5,
        10,
        0.02,
    ),
}
KERNELS = {
    "separable Gaussian": lambda ell: hk.Separable(hk.Gaussian(ell)),
    "symplectic Gaussian": lambda ell: hk.Symplectic(hk.Gaussian(ell)),
    "odd symplectic Gaussian": lambda ell: hk.Odd(hk.Symplectic(hk.Gaussian(ell))),
    "symplectic Matérn 5/2": lambda ell: hk.Symplectic(hk.Matern(2.5, ell)),
}
LENGTHSCALES = (0.3, 3.0, 30.0)


def data(system: str, seed: int, times: int = 1) -> tuple[jax.Array, jax.Array]:
    """Noisy points (N, n) of one problem."""
    field, x0, end, count, noise = SYSTEMS[system]
    X, Y = hk.systems.sample(
        field,
        jnp.asarray(x0, float),
        jnp.linspace(0.0, end, times * count),
        noise,
        noise,
        key=jax.random.key(seed),
    )
    return X.reshape(-1, X.shape[-1]), Y.reshape(-1, X.shape[-1])


def roundings(tuned, X) -> float:
    """How far λ had to stay above the rounding of the Gram in the box that was searched."""
    low = tuned.bounds["regularization"][0]
    return float(low * len(X) / (jnp.finfo(X.dtype).eps * full_trace(tuned.kernel, X)))


def grid_optimum(K, X, Y, folds: int, roundings: float) -> float:
    """The best loss of the grid in the box of `tune`."""
    space = SearchSpace(K, X, Y, jnp.asarray(START_RIDGE), (), {}, roundings)
    shares = jnp.linspace(0.0, 1.0, GRID)
    u = jnp.arcsin(2 * jnp.stack(jnp.meshgrid(shares, shares), -1).reshape(-1, 2) - 1)
    return float(jnp.nanmin(_grid_losses(space, u, X, Y, Partition(len(X), folds))))


@eqx.filter_jit
def _grid_losses(space, u, X, Y, partition):
    def loss(u):
        kernel, regularization = space.decode(u, X)
        return partition_loss(kernel, X, Y, regularization, partition)

    return jax.lax.map(loss, u, batch_size=60)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, default=4)
    parser.add_argument("--times", type=int, default=1)
    parser.add_argument("--systems", nargs="+", choices=SYSTEMS, default=list(SYSTEMS))
    options = parser.parse_args()
    ratios, again = {}, 0
    for system in options.systems:
        for name, make in KERNELS.items():
            for seed in range(options.seeds):
                X, Y = data(system, seed, options.times)
                for start in LENGTHSCALES:
                    tuned = hk.tune(make(start), X, Y, regularization=START_RIDGE, folds=5)
                    above = roundings(tuned, X)
                    again += above > 1.01 * ROUNDINGS
                    best = grid_optimum(make(1.0), X, Y, 5, above)
                    ratios[system, name, seed, start] = float(tuned.loss) / best
        here = np.array([r for key, r in ratios.items() if key[0] == system])
        print(f"{system:16s} median {np.median(here):.4f}  worst {here.max():.4f}", flush=True)
    worst = sorted(ratios.items(), key=lambda item: -item[1])[:8]
    for key, ratio in worst:
        print("   ", *key, f"{ratio:.4f}")
    values = np.array(list(ratios.values()))
    print(
        f"{len(values)} problems: at most 1.01 in {np.mean(values <= 1.01):.1%}, "
        f"at most 1.10 in {np.mean(values <= 1.10):.1%}, NaN in {np.isnan(values).sum()}; "
        f"searched again in {again}"
    )


if __name__ == "__main__":
    main()
