"""Verdicts of `learn` on logs that a field of the kernel describes, and on logs that none does.

    python tests/benchmarks/verdicts.py [name …] [--seed 0]
    python tests/benchmarks/verdicts.py --good 30
    python tests/benchmarks/verdicts.py --energies

Each line has the verdict, the error of a free run from an unseen start over the deviation of the
motion, three rows of the diagnostics, and the names of those that fall short. SciPy simulates the
logs. `--good` counts refusals among that many short logs of pendula and double wells, which a field
describes. `--energies` learns from two runs of a pendulum whose amplitudes differ by a share δ, and
prints how far their energies are apart, and the median error of the field inside the larger orbit
in deviations of the posterior.
"""

import argparse
import time
import warnings

import jax
import jax.numpy as jnp
import numpy as np
from scipy.integrate import solve_ivp

import hamkernel as hk

jax.config.update("jax_enable_x64", True)

T = np.linspace(0, 6, 61)
STARTS = [[1.0, 0.0], [2.2, 0.0], [-1.5, 1.0]]
TEST = [1.7, 0.5]


def pendulum(x):
    return np.array([x[1], -4 * np.sin(x[0])])


def damped_pendulum(x):
    return np.array([x[1], -4 * np.sin(x[0]) - 0.3 * x[1]])


def double_well(x):
    return np.array([x[1], x[0] - x[0] ** 3])


def van_der_pol(x):
    return np.array([x[1], (1 - x[0] ** 2) * x[1] - x[0]])


def dry_friction(x):
    return np.array([x[1], -x[0] - 0.5 * np.tanh(20 * x[1])])


def spiral(x):
    return np.array([x[1] + 0.1 * x[0], -x[0] + 0.1 * x[1]])


def populations(x):
    """Logarithms of predators and prey, which are Hamiltonian."""
    return np.array([1 - np.exp(x[1]), np.exp(x[0]) - 1])


def counts(x):
    """Predators and prey themselves."""
    return np.array([x[0] * (1 - x[1]), x[1] * (x[0] - 1)])


def beside_a_hidden_one(x):
    """A pendulum and an oscillator that pulls it, of which no sensor knows."""
    pull = 1.5 * (x[2] - x[0])
    return np.array([x[1], -4 * np.sin(x[0]) + pull, x[3], -3 * x[2] - pull])


def path(f, start, ts):
    options = {"t_eval": ts, "rtol": 1e-10, "atol": 1e-10}
    return solve_ivp(lambda _, x: f(x), (ts[0], ts[-1]), np.array(start, float), **options).y.T


def noisy(rng, f, starts, ts, noise):
    paths = [path(f, start, ts) for start in starts]
    return [x + noise * x.std(axis=0) * rng.standard_normal(x.shape) for x in paths]


def symplectic(lengthscale=1.0):
    return hk.Symplectic(hk.Gaussian(lengthscale))


def logs(rng):
    """Name, kernel, times, states, the field and a start for the free run, and its unit."""
    plain, friction = symplectic(), hk.PortHamiltonian(hk.Gaussian(1.0), friction=0.1)
    wells = [[0.5, 0.2], [1.4, 0.3], [-1.2, 0.6], [0.2, 0.9]]
    cycles = [[0.5, 0.0], [2.5, 0.0], [-1.0, 2.0]]
    long, few = np.linspace(0, 12, 121), np.linspace(0, 6, 12)
    swings = noisy(rng, pendulum, STARTS, T, 0.02)
    damped = noisy(rng, damped_pendulum, STARTS, T, 0.02)
    cycling = noisy(rng, van_der_pol, cycles, T, 0.02)
    between = noisy(rng, double_well, wells, T, 0.02)
    seldom = noisy(rng, double_well, wells[:2], few, 0.01)
    encoder = [np.round(path(pendulum, start, T) / 0.25) * 0.25 for start in STARTS]
    animals = noisy(rng, populations, [[0.5, 0], [1, 0], [0, 0.8]], long, 0.03)
    rubbing = noisy(rng, dry_friction, [[2, 0], [3, 1], [-4, 0]], T, 0.01)
    growing = noisy(rng, spiral, [[0.2, 0], [0.3, 0.1]], long, 0.01)
    hunted = noisy(rng, counts, [[1.5, 1.0], [2.0, 1.0], [1.0, 0.6]], long, 0.02)
    pulled = noisy(rng, beside_a_hidden_one, [[*start, 0.5, 0.0] for start in STARTS], T, 0.02)
    rare = np.linspace(0, 60, 30)
    aliased = noisy(rng, pendulum, STARTS, rare, 0.01)
    noise = list(rng.standard_normal((2, 61, 2)))
    walk = [np.cumsum(rng.standard_normal((61, 2)), axis=0) for _ in range(2)]
    large = [1e6 * x for x in swings]
    return [
        ("good: pendulum", plain, T, swings, pendulum, TEST, 1),
        ("good: a million times", symplectic(1e6), T, large, pendulum, TEST, 1e6),
        ("good: coarse encoder", plain, T, encoder, pendulum, TEST, 1),
        ("good: friction", friction, T, damped, damped_pendulum, TEST, 1),
        ("good: double well", plain, T, between, double_well, [1.2, 0.4], 1),
        ("good: twelve samples", plain, few, seldom, double_well, [1.2, 0.4], 1),
        ("good: populations", plain, long, animals, populations, [0.7, 0.1], 1),
        ("bad: friction that is missing", plain, T, damped, damped_pendulum, TEST, 1),
        ("bad: dry friction", plain, T, rubbing, dry_friction, [2.5, 0.5], 1),
        ("bad: limit cycle", plain, T, cycling, van_der_pol, TEST, 1),
        ("bad: limit cycle, friction", friction, T, cycling, van_der_pol, TEST, 1),
        ("bad: growing spiral", plain, long, growing, spiral, [0.25, 0.0], 1),
        ("bad: counts of animals", plain, long, hunted, counts, [1.7, 1.0], 1),
        ("bad: a hidden oscillator", plain, T, [x[:, :2] for x in pulled], None, TEST, 1),
        ("bad: two samples a swing", plain, rare, aliased, pendulum, TEST, 1),
        ("bad: noise", plain, T, noise, None, TEST, 1),
        ("bad: random walk", plain, T, walk, None, TEST, 1),
    ]


def free_run(field, truth, start, unit):
    """The RMS error of the free run over the deviation of the motion."""
    true = path(truth, start, T)
    found = hk.simulate(field, jnp.array(start) * unit, jnp.asarray(T), throw=False).ys / unit
    error = (np.asarray(found) - true) / true.std(axis=0)
    return float(np.sqrt(np.mean(np.clip(np.nan_to_num(error, nan=9.0), -9, 9) ** 2)))


def learned(K, ts, states):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return hk.learn(K, hk.Runs([ts] * len(states), states), progress=False)


def table(names, seed):
    print("| log | usable | unseen | free run | whiteness | missing | falls short | CPU s |")
    print("|---|---|---|---|---|---|---|---|")
    for name, K, ts, states, truth, start, unit in logs(np.random.default_rng(seed)):
        if names and not any(part in name for part in names):
            continue
        cpu = time.process_time()
        found = learned(K, ts, states)
        cpu = time.process_time() - cpu
        error = "" if truth is None else f"{free_run(found.field, truth, start, unit):.3f}"
        short = ", ".join(found.diagnostics.failing)
        asked = ("free run", "whiteness", "missing force")
        values = " | ".join(found.diagnostics[question].value for question in asked)
        print(f"| {name} | {found.converged} | {error} | {values} | {short} | {cpu:.0f} |")


def count_refusals(count):
    refused = []
    for seed in range(count):
        rng = np.random.default_rng(seed)
        ts = np.linspace(0, 6, (20, 40, 81)[seed % 3])
        truth = (pendulum, double_well)[seed % 2]
        starts = rng.uniform(-1.5, 1.5, (2 + seed % 3, 2))
        states = noisy(rng, truth, starts, ts, (0.01, 0.05)[seed // 6 % 2])
        if not learned(symplectic(), ts, states).converged:
            refused.append(seed)
    print(f"{len(refused)} of {count} good logs refused: {refused}")


def compare_energies(seed):
    ts = np.linspace(0, 8, 60)
    x = np.stack(np.meshgrid(*[np.linspace(-1.2, 1.2, 13)] * 2), -1).reshape(-1, 2)
    x = x[x[:, 1] ** 2 / 2 - np.cos(x[:, 0]) < -np.cos(1.2)]
    true = np.stack([x[:, 1], -np.sin(x[:, 0])], 1)
    print("| noise | δ | energies apart | median error |")
    print("|---|---|---|---|")
    for noise, shares in ((0.01, (0, 0.01, 0.02, 0.1)), (0.05, (0, 0.02, 0.05, 0.1))):
        for share in shares:
            rng = np.random.default_rng(seed)
            starts = [[1.2, 0.0], [1.2 * (1 - share), 0.0]]
            paths = [path(lambda x: [x[1], -np.sin(x[0])], start, ts) for start in starts]
            found = learned(
                symplectic(), ts, [y + noise * rng.standard_normal(y.shape) for y in paths]
            )
            error = np.abs(np.asarray(jax.vmap(found.field)(jnp.asarray(x))) - true)
            band = np.asarray(jax.vmap(found.posterior.deviation)(jnp.asarray(x)))
            apart = found.diagnostics["energies"].value
            print(f"| {noise} | {share} | {apart} | {np.median(error / band):.1f} |", flush=True)


if __name__ == "__main__":
    parser = argparse.ArgumentParser()
    parser.add_argument("names", nargs="*")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--good", type=int, default=0)
    parser.add_argument("--energies", action="store_true")
    options = parser.parse_args()
    if options.energies:
        compare_energies(options.seed)
    elif options.good:
        count_refusals(options.good)
    else:
        table(options.names, options.seed)
