"""Fields from noisy states without velocities: `learn` beside differences and filters.

Ten runs of 10 s in the settings of Tanaka et al. (2022), "Symplectic spectrum Gaussian processes",
with the systems and starts of the authors' published code: the pendulum H = p² + 3 (1 − cos q)
with starts at 1.3 to 2.3 from rest, Duffing's H = p²/2 − q²/2 + q⁴/4 with starts of energies
between 0.5 and 2, and the double pendulum of .2 and .1 kg, released from angles below one. All are
tested on 25 unseen starts for 15 s. Each cell is the median over seeds of the field error along
the true runs, relative to its root mean square, and of the mean squared error of the rollouts,
with the lowest and highest in brackets. Where only q is logged and q̇ is known, the error of ṗ has
a line of its own. The arm is one run of 10 000 samples of two links of 1 m and 1 kg; it is tested
from states of that run, since it has been nowhere else.

    python tests/benchmarks/trajectories.py [case …] [--seeds 5] [--one-lengthscale]
    python tests/benchmarks/trajectories.py --claims [claim …] [--seeds 10]

The kernel of all methods is `Symplectic(Gaussian)` with one lengthscale for each coordinate: q and
p have different units. The window of Savitzky and Golay is chosen by the TRUE error, which nobody
knows. With four coordinates their fields, and those of differences, are fitted on landmarks.

Claims: how often a wrong and a right structure warn when the noise is given, for a pendulum with
friction, for one without, and for two unequal masses in (q, q̇); the ratio of those masses; and the
friction that is found, true .05, as 1000 times the mean of squared errors.
"""

import argparse
import time
import warnings
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from scipy.signal import savgol_filter

import hamkernel as hk

jax.config.update("jax_enable_x64", True)

PENDULUM = hk.systems.Pendulum(0.5, 1.0, 6.0)  # H = p² + 3 (1 − cos q)
DUFFING = hk.systems.Duffing()
DOUBLE = hk.systems.DoublePendulum((0.2, 0.1), (1.0, 1.0), 9.8)
HENON_HEILES = hk.systems.HenonHeiles()
ARM = hk.systems.DoublePendulum()
RUNS, LENGTH, TESTS, HORIZON = 10, 10.0, 25, 15.0


def pendulum_start(rng):
    way = rng.uniform(-1, 1, 2)
    return way / np.linalg.norm(way) * rng.uniform(1.3, 2.3)


def between(system, box, low, high):
    """Starts evenly in a box, of energies between two."""

    def start(rng):
        while True:
            x = rng.uniform(-box, box)
            if low <= system.hamiltonian(x) <= high:
                return x

    return start


duffing_start = between(DUFFING, np.full(2, 3.0), 0.5, 2.0)


class Case(NamedTuple):
    """What is logged: the system, samples a second, their noise, what is missing, and how often."""

    system: Any
    start: Callable
    rate: int
    noise: float
    uneven: bool = False
    only_q: bool = False
    runs: int = RUNS


def released(rng):
    return np.append(rng.uniform(-1, 1, 2), [0, 0])


PENDULUM_CASE = Case(PENDULUM, pendulum_start, 5, 0.1)
DUFFING_CASE = Case(DUFFING, duffing_start, 5, 0.1)
CASES = {
    "pendulum 5 Hz .1": PENDULUM_CASE,
    "pendulum 3 Hz .1": PENDULUM_CASE._replace(rate=3),
    "pendulum 2 Hz .1": PENDULUM_CASE._replace(rate=2),
    "pendulum 5 Hz .01": PENDULUM_CASE._replace(noise=0.01),
    "pendulum uneven .1": PENDULUM_CASE._replace(uneven=True),
    "Duffing 5 Hz .1": DUFFING_CASE,
    "Duffing uneven .1": DUFFING_CASE._replace(uneven=True),
    "only q 5 Hz .1": PENDULUM_CASE._replace(only_q=True),
    "only q 5 Hz .01": PENDULUM_CASE._replace(noise=0.01, only_q=True),
    "double pendulum 10 Hz .01": Case(DOUBLE, released, 10, 0.01),
    "Henon-Heiles 5 Hz .01": Case(
        HENON_HEILES, between(HENON_HEILES, np.full(4, 0.5), 0.0, 0.125), 5, 0.01
    ),
    "arm 1 kHz .01": Case(ARM, released, 1000, 0.01, runs=1),
}


def gaussian(n, one=False):
    return hk.Gaussian(1.0) if one else hk.Gaussian(np.ones(n))


def paths(system, starts, ts):
    options = {"rtol": 1e-6, "atol": 1e-6, "max_steps": 4000 + 4 * len(ts), "throw": False}

    def one(x):
        return hk.simulate(system, x, ts, **options).ys

    return np.asarray(jax.vmap(one)(jnp.asarray(starts)))


def logs(case: Case, seed: int):
    """Times, measured and true states of the runs, and starts for tests."""
    rng = np.random.default_rng(seed)
    count = int(LENGTH * case.rate) + 1
    if case.uneven:
        times = [np.sort(rng.uniform(0, LENGTH, count)) for _ in range(case.runs)]
    else:
        times = [np.linspace(0, LENGTH, count)] * case.runs
    starts = [case.start(rng) for _ in range(case.runs)]
    true = [paths(case.system, x[None], t)[0] for x, t in zip(starts, times, strict=True)]
    states = [x + case.noise * rng.standard_normal(x.shape) for x in true]
    if case.only_q:
        for x in states:
            x[:, x.shape[1] // 2 :] = np.nan
    if case.runs == 1:
        return times, states, true, rng.choice(true[0], TESTS)
    return times, states, true, np.array([case.start(rng) for _ in range(TESTS)])


def field_error(field, system, X, of=slice(None)):
    f, g = (np.asarray(jax.vmap(each)(jnp.asarray(X)))[:, of] for each in (system, field))
    return np.sqrt(np.mean((f - g) ** 2) / np.mean(f**2))


def errors(field, system, X, tests):
    ts = np.linspace(0, HORIZON, 76)
    rollout = np.mean((paths(field, tests, ts) - paths(system, tests, ts)) ** 2)
    return field_error(field, system, X), rollout


def tuned(times, states, slopes, one):
    labels = np.repeat(np.arange(len(times)), [len(t) for t in times])
    X, Y = np.concatenate(states), np.concatenate(slopes)
    solver = None if X.shape[1] == 2 else hk.Nystrom(max_points=80)  # as many as in `learn`
    K = hk.Symplectic(gaussian(X.shape[1], one))
    return hk.tune(K, X, Y, folds=labels, solver=solver).field


def by_differences(times, states, one):
    slopes = [np.gradient(x, t, axis=0) for t, x in zip(times, states, strict=True)]
    return tuned(times, states, slopes, one)


def by_filter(times, states, window, one):
    step = times[0][1] - times[0][0]
    smoothed = [savgol_filter(x, window, 3, axis=0) for x in states]
    slopes = [savgol_filter(x, window, 3, 1, step, axis=0) for x in states]
    return tuned(times, smoothed, slopes, one)


def moved_by_momentum(x):
    return jnp.array([2 * x[1], 0.0])  # q̇ = p/m with a mass of one half


def learned(case: Case, times, states, one):
    runs = hk.Runs(times, states)
    if case.only_q:
        K = hk.Symplectic(hk.Select(hk.Gaussian(1.0), 0))
        return hk.learn(K, runs, mean=moved_by_momentum)
    return hk.learn(hk.Symplectic(gaussian(states[0].shape[1], one)), runs)


def row(case: Case, seed: int, baselines: bool, one: bool):
    times, states, true, tests = logs(case, seed)
    X = np.concatenate(true)
    begin, cpu = time.perf_counter(), time.process_time()
    found = learned(case, times, states, one)
    took = time.perf_counter() - begin, time.process_time() - cpu
    out: dict = {"learn": (*errors(found.field, case.system, X, tests), *took)}
    out["noise"] = np.nanmean(np.asarray(found.noise)) / case.noise
    if case.only_q:
        out["ṗ"] = field_error(found.field, case.system, X, slice(X.shape[1] // 2, None))
    if baselines and not case.only_q:
        field = by_differences(times, states, one)
        out["np.gradient"] = errors(field, case.system, X, tests)
        if not case.uneven:
            fields = [by_filter(times, states, w, one) for w in (5, 7, 9, 11)]
            out["Savitzky-Golay"] = min(errors(f, case.system, X, tests) for f in fields)
    return out


FRICTION = 0.05
DAMPED_PENDULUM = PENDULUM_CASE._replace(system=hk.systems.Damped(PENDULUM, FRICTION))
DAMPED_DUFFING = DUFFING_CASE._replace(system=hk.systems.Damped(DUFFING, FRICTION))


def masses(y):
    """Masses of 1 and 2.5 on a hardening spring and between springs, in (q, q̇)."""
    a, b = y[:2]
    force = jnp.array([-a - a**3 + 1.5 * (b - a), -1.5 * (b - a) - b])
    return jnp.concatenate([y[2:], force / jnp.array([1.0, 2.5])])


def warns(K, runs, noise, **options):
    """What was learned, and whether it warned that the structure does not explain the runs."""
    with warnings.catch_warnings(record=True) as seen:
        warnings.simplefilter("always")
        found = hk.learn(K, runs, noise=noise, **options)
    return found, any("does not explain" in str(each.message) for each in seen)


def friction_is_noticed(seed):
    """A pendulum with friction as without, and as what it is; and one without."""
    damped, undamped = (hk.Runs(*logs(c, seed)[:2]) for c in (DAMPED_PENDULUM, PENDULUM_CASE))
    k = gaussian(2)
    wrong, right = (warns(K, damped, 0.1) for K in (hk.Symplectic(k), hk.PortHamiltonian(k, 0.1)))
    none = warns(hk.Symplectic(k), undamped, 0.1)
    return {
        "wrong": wrong[1],
        "right": right[1],
        "right, without friction": none[1],
        "wrong χ²": float(wrong[0].chi_squared),
        "right χ²": float(right[0].chi_squared),
        "χ² without friction": float(none[0].chi_squared),
    }


def masses_are_noticed(seed):
    """Two unequal masses in (q, q̇) as if they were equal, and unknown; the ratio is 2.5."""
    rng, ts = np.random.default_rng(seed), np.linspace(0, 6, 31)
    true = paths(masses, rng.uniform(-1, 1, (6, 4)), ts)
    runs = hk.Runs([ts] * 6, list(true + 0.01 * rng.standard_normal(true.shape)))
    K = hk.Symplectic(hk.Gaussian(1.0))
    wrong, right = warns(K, runs, 0.01), warns(K, runs, 0.01, masses=True)
    assert isinstance(right[0].kernel, hk.UnknownMasses)
    ratio = float(right[0].kernel.masses[1])
    return {"wrong": wrong[1], "right": right[1], "ratio": ratio}


def friction_of(case: Case) -> Callable:
    def found(seed):
        times, states, _, _ = logs(case, seed)
        K = hk.PortHamiltonian(gaussian(2), 0.1)
        kernel = hk.learn(K, hk.Runs(times, states)).kernel
        assert isinstance(kernel, hk.PortHamiltonian)
        friction = float(kernel.friction)
        return {"friction": friction, "squared error times 1000": 1e3 * (friction - FRICTION) ** 2}

    return found


CLAIMS = {
    "friction noticed": friction_is_noticed,
    "masses noticed": masses_are_noticed,
    "friction of the pendulum": friction_of(DAMPED_PENDULUM),
    "friction of Duffing": friction_of(DAMPED_DUFFING),
}


def claim(name, seeds):
    rows = [CLAIMS[name](seed) for seed in range(seeds)]
    for what in rows[0]:
        values = np.array([row[what] for row in rows])
        if values.dtype == bool:
            print(f"| {name} | {what} | warns in {values.sum()} of {seeds} |", flush=True)
        else:
            print(
                f"| {name} | {what} | mean {values.mean():.4g}, median {np.median(values):.4g} "
                f"({values.min():.4g} to {values.max():.4g}) |",
                flush=True,
            )


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
    parser.add_argument("--one-lengthscale", action="store_true", help="for all coordinates")
    parser.add_argument("--claims", nargs="*", help="claims instead of cases; all if none is named")
    options = parser.parse_args()
    warnings.simplefilter("ignore")
    if options.claims is not None:
        for name in options.claims or CLAIMS:
            claim(name, options.seeds)
        return
    for case in options.cases:
        rows = [
            row(CASES[case], seed, seed < options.baselines, options.one_lengthscale)
            for seed in range(options.seeds)
        ]
        for method in ("np.gradient", "Savitzky-Golay", "learn"):
            values = [r[method] for r in rows if method in r]
            if values:
                print(f"| {case} | {method} | {cell(values)} |", flush=True)
        noise = np.array([r["noise"] for r in rows])
        seconds, cpu = np.median([r["learn"][2:] for r in rows], axis=0)
        first = rows[0]["learn"][2]
        print(
            f"| {case} | noise found over true | {np.median(noise):.3f} ({noise.min():.3f} to "
            f"{noise.max():.3f}); seconds {seconds:.1f}, of CPU {cpu:.1f}, first {first:.1f} |",
            flush=True,
        )
        if CASES[case].only_q:
            e = 100 * np.array([r["ṗ"] for r in rows])
            print(f"| {case} | ṗ | {np.median(e):.2f} % ({e.min():.2f} to {e.max():.2f}) |")


if __name__ == "__main__":
    main()
