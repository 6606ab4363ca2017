"""How close `tune` comes to the best point of a fine grid over the same box.

    python tests/benchmarks/tuning_quality.py [--seeds 4] [--times 1] [--systems pendulum ...]

Five systems, four kernels, noise seeds, and poor starting points (lengthscale 0.3, 3, 30 with
λ = 0.1): 240 problems by default. The grid has 60 × 60 points over the box that `tune` searches,
lengthscale by λ, where λ runs upwards from the rounding of the Gram at each lengthscale. Prints the
ratio of the tuned loss, with the penalty on rounding, to the grid's best. `--times 4` has four
times the points on each trajectory, so that the runs are on a subset; the grid then takes most of
the time, minutes with n = 4. `--noiseless` takes data without noise.
"""

import argparse

import jax

jax.config.update("jax_enable_x64", True)

import equinox as eqx
import jax.numpy as jnp
import numpy as np

import hamkernel as hk
from hamkernel._observations.measurements import measurements_of_states
from hamkernel._tuning.objective import SearchObjective, criterion_of
from hamkernel._tuning.space import SearchSpace

GRID = 60
START_RIDGE, FOLDS = 0.1, 5

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


def data(system: str, seed: int, times: int, noiseless: bool) -> tuple[jax.Array, jax.Array]:
    """Points (N, n) of one problem."""
    field, x0, end, count, noise = SYSTEMS[system]
    noise = 0.0 if noiseless else noise
    X, Y = hk.systems.sample(
        field,
        jnp.asarray(x0, float),
        jnp.linspace(0.0, end, times * count),
        noise,
        noise,
        key=jax.random.key(seed),
    )
    return X.reshape(-1, X.shape[-1]), Y.reshape(-1, X.shape[-1])


@eqx.filter_jit
def searched_on_grid(objective: SearchObjective) -> jax.Array:
    """What is minimised, at GRID × GRID points of the box: the logarithm of the loss, penalised."""
    shares = jnp.linspace(0.0, 1.0, GRID)
    u = jnp.arcsin(2 * jnp.stack(jnp.meshgrid(shares, shares), -1).reshape(-1, 2) - 1)
    return jax.lax.map(lambda u: objective(u)[0], u)


def objective_of(K, X, Y) -> SearchObjective:
    """That of the search, on all points."""
    rows, rms = measurements_of_states(X, Y), float(jnp.sqrt(jnp.mean(Y**2)))
    space = SearchSpace(K, X, rms, jnp.asarray(START_RIDGE), (), {})
    criterion = criterion_of("cross_validation", len(X), FOLDS)
    criterion = criterion.restrict(K, rows, np.arange(len(X)))
    return SearchObjective(space, criterion, rows, *map(jnp.asarray, (1.0, rms, 1.0)))


@eqx.filter_jit
def searched(objective: SearchObjective, tuned) -> jax.Array:
    """The same for what was tuned."""
    size = objective.space.size_of_gram(tuned.kernel)
    return objective.value_and_loss(tuned.kernel, tuned.regularization, size)[0]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, default=4)
    parser.add_argument("--times", type=int, default=1)
    parser.add_argument("--systems", nargs="+", choices=SYSTEMS, default=list(SYSTEMS))
    parser.add_argument("--noiseless", action="store_true")
    options = parser.parse_args()
    ratios = {}
    for system in options.systems:
        for name, make in KERNELS.items():
            for seed in range(options.seeds):
                X, Y = data(system, seed, options.times, options.noiseless)
                objective = objective_of(make(1.0), X, Y)
                best = float(np.nanmin(searched_on_grid(objective)))
                for start in LENGTHSCALES:
                    tuned = hk.tune(make(start), X, Y, regularization=START_RIDGE, folds=FOLDS)
                    value = float(searched(objective, tuned))
                    ratios[system, name, seed, start] = np.exp(value - best)
        here = np.array([r for key, r in ratios.items() if key[0] == system])
        print(f"{system:16s} median {np.median(here):.4f}  worst {here.max():.4f}", flush=True)
    worst = sorted(ratios.items(), key=lambda item: -item[1])[:8]
    for key, ratio in worst:
        print("   ", *key, f"{ratio:.4f}")
    values = np.array(list(ratios.values()))
    print(
        f"{len(values)} problems: at most 1.01 in {np.mean(values <= 1.01):.1%}, "
        f"at most 1.10 in {np.mean(values <= 1.10):.1%}, NaN in {np.isnan(values).sum()}"
    )


if __name__ == "__main__":
    main()
