"""Fields from noisy states without velocities: `learn` beside differences and filters.

Ten runs of 10 s, as in Tanaka et al. (2022), "Symplectic spectrum Gaussian processes", tested on 25
unseen starts for 15 s. The pendulum is that of Greydanus et al. (2019) with a mass of one,
H = p²/2 + 6 (1 − cos q), with energies up to 90 % of the separatrix; Duffing is
H = p²/2 − q²/2 + q⁴/4 with starts in a box of side 3. Each cell is the median over seeds of the
field error along the true runs, relative to its root mean square, and of the mean squared error of
the rollouts, with the lowest and highest in brackets.

    python tests/benchmarks/trajectories.py [case …] [--seeds 5]

The window of Savitzky and Golay is chosen by the TRUE error, which nobody knows.
"""

import argparse
import time
import warnings

import jax
import jax.numpy as jnp
import numpy as np
from scipy.signal import savgol_filter

import hamkernel as hk

jax.config.update("jax_enable_x64", True)

PENDULUM = hk.systems.Pendulum(1.0, 1.0, 6.0)
DUFFING = hk.systems.Duffing()


def pendulum_start(rng):
    while True:
        x = rng.uniform([-np.pi, -5.0], [np.pi, 5.0])
        if PENDULUM.hamiltonian(x) < 0.9 * 12:
            return x


def duffing_start(rng):
    return rng.uniform(-1.5, 1.5, 2)


# system, starts, samples a second, noise, uneven, positions only
CASES = {
    "pendulum 5 Hz .1": (PENDULUM, pendulum_start, 5, 0.1, False, False),
    "pendulum 2 Hz .1": (PENDULUM, pendulum_start, 2, 0.1, False, False),
    "pendulum 5 Hz .01": (PENDULUM, pendulum_start, 5, 0.01, False, False),
    "pendulum uneven .1": (PENDULUM, pendulum_start, 5, 0.1, True, False),
    "Duffing 5 Hz .1": (DUFFING, duffing_start, 5, 0.1, False, False),
    "Duffing uneven .1": (DUFFING, duffing_start, 5, 0.1, True, False),
    "only q 5 Hz .1": (PENDULUM, pendulum_start, 5, 0.1, False, True),
    "only q 5 Hz .01": (PENDULUM, pendulum_start, 5, 0.01, False, True),
}
RUNS, LENGTH, TESTS, HORIZON = 10, 10.0, 25, 15.0


def paths(system, starts, ts):
    def one(x):
        return hk.simulate(system, x, ts, rtol=1e-6, atol=1e-6, max_steps=4000, throw=False).ys

    return np.asarray(jax.vmap(one)(jnp.asarray(starts)))


def logs(case, seed):
    system, start, rate, noise, uneven, only_q = CASES[case]
    rng = np.random.default_rng(seed)
    if uneven:
        times = [np.sort(rng.uniform(0, LENGTH, int(LENGTH * rate) + 1)) for _ in range(RUNS)]
    else:
        times = [np.linspace(0, LENGTH, int(LENGTH * rate) + 1)] * RUNS
    starts = [start(rng) for _ in range(RUNS)]
    true = [paths(system, x[None], t)[0] for x, t in zip(starts, times, strict=True)]
    states = [x + noise * rng.standard_normal(x.shape) for x in true]
    if only_q:
        for x in states:
            x[:, 1] = np.nan
    tests = np.array([start(rng) for _ in range(TESTS)])
    return system, times, states, np.concatenate(true), tests


def errors(field, system, X, tests):
    f, g = (np.asarray(jax.vmap(each)(jnp.asarray(X))) for each in (system, field))
    ts = np.linspace(0, HORIZON, 76)
    rollout = np.mean((paths(field, tests, ts) - paths(system, tests, ts)) ** 2)
    return np.sqrt(np.mean((f - g) ** 2) / np.mean(f**2)), rollout


def tuned(times, states, slopes):
    labels = np.repeat(np.arange(len(times)), [len(t) for t in times])
    X, Y = np.concatenate(states), np.concatenate(slopes)
    return hk.tune(hk.Symplectic(hk.Gaussian(1.0)), X, Y, folds=labels).field


def by_differences(times, states):
    slopes = [np.gradient(x, t, axis=0) for t, x in zip(times, states, strict=True)]
    return tuned(times, states, slopes)


def by_filter(times, states, window):
    step = times[0][1] - times[0][0]
    return tuned(
        times,
        [savgol_filter(x, window, 3, axis=0) for x in states],
        [savgol_filter(x, window, 3, 1, step, axis=0) for x in states],
    )


def learned(case, times, states):
    runs = hk.Runs(times, states)
    if CASES[case][-1]:
        K = hk.Symplectic(hk.Select(hk.Gaussian(1.0), 0))
        return hk.learn(K, runs, mean=moved_by_momentum)
    return hk.learn(hk.Symplectic(hk.Gaussian(1.0)), runs)


def moved_by_momentum(x):
    return jnp.array([x[1], 0.0])


def row(case, seed, baselines):
    system, times, states, X, tests = logs(case, seed)
    begin = time.perf_counter()
    found = learned(case, times, states)
    took = time.perf_counter() - begin
    out: dict = {"learn": (*errors(found.field, system, X, tests), took, float(found.noise[0]))}
    if baselines and not CASES[case][-1]:
        out["np.gradient"] = errors(by_differences(times, states), system, X, tests)
        if not CASES[case][4]:
            fits = [
                errors(by_filter(times, states, w), system, X, tests)
                for w in (5, 7, 9, 11)
                if w <= len(times[0])
            ]
            out["Savitzky-Golay"] = min(fits)
    return out


def cell(values):
    values = np.array([v[:2] for v in values])
    (e, r), low, high = np.median(values, axis=0), values.min(axis=0), values.max(axis=0)
    return (
        f"{100 * e:.2f} % ({100 * low[0]:.2f} to {100 * high[0]:.2f}) / "
        f"{r:.2g} ({low[1]:.2g} to {high[1]:.2g})"
    )


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("cases", nargs="*", default=list(CASES))
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--baselines", type=int, default=5, help="seeds of the other methods")
    options = parser.parse_args()
    warnings.simplefilter("ignore")
    for case in options.cases or CASES:
        rows = [row(case, seed, seed < options.baselines) for seed in range(options.seeds)]
        for method in ("np.gradient", "Savitzky-Golay", "learn"):
            values = [r[method] for r in rows if method in r]
            if values:
                print(f"| {case} | {method} | {cell(values)} |", flush=True)
        ours = [r["learn"] for r in rows]
        noises, times = (np.array([v[i] for v in ours]) for i in (3, 2))
        print(
            f"| {case} | noise of q, found | {np.median(noises):.4f} ({noises.min():.4f} to "
            f"{noises.max():.4f}); seconds {np.median(times):.1f}, first {times[0]:.1f} |",
            flush=True,
        )


if __name__ == "__main__":
    main()
