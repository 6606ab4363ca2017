"""Do 50 and 90 % bands hold what they say? Pendulum, N = 40, tuned by the marginal likelihood.

    python tests/benchmarks/calibration.py [seeds]

For each seed new states, new noise, a new kernel; then the share of a grid on which the true field,
the true H (as a difference to the equilibrium) and the true positions along orbits lie within the
bands of the posterior, those of orbits from the quantiles of 64 draws. Hyperparameters are plugged
in as if they were known, which the bands do not tell: those of positions are too narrow.
"""

import sys

import jax
import jax.numpy as jnp
import numpy as np

import hamkernel as hk

jax.config.update("jax_enable_x64", True)

SEEDS = int(sys.argv[1]) if len(sys.argv) > 1 else 50
N, NOISE, DRAWS = 40, 0.1, 64
REGION = np.array([[-2.5, -4.0], [2.5, 4.0]])
PENDULUM = hk.systems.Pendulum()
ORIGIN = jnp.zeros(2)
SIDE = jnp.linspace(-1.8, 1.8, 9)
GRID = jnp.stack(jnp.meshgrid(SIDE, SIDE), axis=-1).reshape(-1, 2)
TRUE_FIELD = jax.vmap(PENDULUM)(GRID)
TRUE_H = jax.vmap(PENDULUM.hamiltonian)(GRID) - PENDULUM.hamiltonian(ORIGIN)
STARTS = jnp.array([[0.5, 0.0], [1.0, 0.0], [1.5, 0.0]])
TS = jnp.array([0.0, 1.0, 2.0, 4.0])
TRUE_ORBITS = jax.vmap(lambda x: hk.simulate(PENDULUM, x, TS).ys)(STARTS)
WIDTHS = {50: 0.6745, 90: 1.6449}  # standard deviations on either side


@jax.jit
def bands(posterior):
    H = posterior.field.anchored(ORIGIN).hamiltonian
    energy = jax.vmap(lambda x: posterior.energy_deviation(x, ORIGIN))(GRID)
    f = jax.vmap(posterior.field)(GRID), jax.vmap(posterior.deviation)(GRID)
    return f, (jax.vmap(H)(GRID), energy)


@jax.jit
def orbits(fields):
    def of(field):
        return jax.vmap(lambda x: hk.simulate(field, x, TS, rtol=1e-6, atol=1e-6).ys)(STARTS)

    return jax.vmap(of)(fields)  # (draws, starts, times, 2)


def covered(seed):
    """The share within each band: of f, of H, and of positions at each time."""
    rng = np.random.default_rng(seed)
    X = rng.uniform(-2, 2, (N, 2))
    Y = np.array(jax.vmap(PENDULUM)(X)) + NOISE * rng.normal(size=X.shape)
    kernel = hk.Symplectic(1.0 * hk.Gaussian(1.0))
    tuned = hk.tune(kernel, X, Y, objective="marginal_likelihood", starts=4)
    posterior = hk.condition(tuned.kernel, X, Y, tuned.regularization)
    (f, f_deviation), (H, H_deviation) = bands(posterior)
    draws = np.asarray(orbits(posterior.sample(jax.random.key(seed), DRAWS, REGION)))
    shares = []
    for percent, width in WIDTHS.items():
        low, high = np.quantile(draws, [0.5 - percent / 200, 0.5 + percent / 200], axis=0)
        within = (low <= TRUE_ORBITS) & (high >= TRUE_ORBITS)
        shares.append(
            [
                np.mean(abs(f - TRUE_FIELD) <= width * f_deviation),
                np.mean((abs(H - TRUE_H) <= width * H_deviation)[TRUE_H > 1e-9]),
                *np.mean(within, axis=(0, 2))[1:],
            ]
        )
    return shares


def main():
    shares = np.mean([covered(seed) for seed in range(SEEDS)], axis=0)
    names = ["f", "H", *(f"position at t = {t:g}" for t in TS[1:])]
    print(f"pendulum, N = {N}, noise {NOISE}, {SEEDS} seeds: share within the bands")
    print(f"{'':22}" + "".join(f"{percent:>6} %" for percent in WIDTHS))
    for i, name in enumerate(names):
        values = shares[:, i]
        narrow = any(v < p / 100 - 0.05 for v, p in zip(values, WIDTHS, strict=True))
        print(f"{name:22}" + "".join(f"{v:8.3f}" for v in values) + "  too narrow" * narrow)


if __name__ == "__main__":
    main()
