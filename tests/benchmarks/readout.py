"""How often `hk.readout` finds the terms of a pendulum, beside PySINDy where that is installed.

    python tests/benchmarks/readout.py [--seeds 5]

H = p²/2 − cos q from 17 terms, in data sets of 60 velocities at random states and of 122 noisy
states (two runs of 61), with noise of 1, 5 and 10 % of each coordinate. Printed: the share of data
sets with exactly the true terms, the median error of their coefficients (those of all data sets),
the share of true coefficients within two deviations, and the median misfit. PySINDy learns the
equations and not H: it is given the gradients B∇φ of the same functions as its library (q̇ and ṗ
with separate coefficients), and its threshold is the best of a scan over five, on the truth. From
states it takes smoothed differences, or the weak form, integrals over 200 windows of a run.

Five seeds, 122 states, exact at noise of 1, 5 and 10 %: readout 1.0, 1.0, 1.0; PySINDy 2.1 with
smoothed differences 1.0, 0.6, 0.6, in its weak form 1.0, 0.8, 0.4.
Median errors of the coefficients: .07, .34, .67 % there, .16, .78, 1.6 % with 60 velocities, all
exact too.
"""

import argparse
import time
import warnings

import jax
import jax.numpy as jnp
import numpy as np

jax.config.update("jax_enable_x64", True)

import hamkernel as hk

TERMS = {
    "p**2": lambda x: x[1] ** 2,
    "cos(q)": lambda x: jnp.cos(x[0]),
    "q": lambda x: x[0],
    "p": lambda x: x[1],
    "q*p": lambda x: x[0] * x[1],
    "q**2": lambda x: x[0] ** 2,
    "q**3": lambda x: x[0] ** 3,
    "q**4": lambda x: x[0] ** 4,
    "p**3": lambda x: x[1] ** 3,
    "p**4": lambda x: x[1] ** 4,
    "q**2*p": lambda x: x[0] ** 2 * x[1],
    "q*p**2": lambda x: x[0] * x[1] ** 2,
    "q**2*p**2": lambda x: x[0] ** 2 * x[1] ** 2,
    "sin(q)": lambda x: jnp.sin(x[0]),
    "cos(2*q)": lambda x: jnp.cos(2 * x[0]),
    "p*sin(q)": lambda x: x[1] * jnp.sin(x[0]),
    "p**2*cos(q)": lambda x: x[1] ** 2 * jnp.cos(x[0]),
}
TRUE = {"p**2": 0.5, "cos(q)": -1.0}
PENDULUM = hk.systems.Pendulum(mass=1.0, length=1.0, gravity=1.0)
STARTS, TIMES = np.array([[2.2, 0.0], [0.0, 1.2]]), np.linspace(0.0, 9.0, 61)


def velocities(noise, seed):
    rng = np.random.default_rng(seed)
    X = np.stack([rng.uniform(-2.5, 2.5, 60), rng.uniform(-1.8, 1.8, 60)], axis=1)
    Y = np.asarray(jax.vmap(PENDULUM)(jnp.asarray(X)))
    return X, Y + noise * Y.std(axis=0) * rng.normal(size=Y.shape)


def states(noise, seed):
    X, _ = hk.systems.sample(PENDULUM, STARTS, TIMES)
    X = np.asarray(X)
    rng = np.random.default_rng(seed)
    return X + noise * X.std(axis=(0, 1)) * rng.normal(size=X.shape)


def of_velocities(noise, seed):
    X, Y = velocities(noise, seed)
    tuned = hk.tune(
        hk.Symplectic(1.0 * hk.Gaussian(1.0)), X, Y, objective="marginal_likelihood", starts=4
    )
    return hk.readout(hk.condition(tuned.kernel, X, Y, tuned.regularization), TERMS)


def of_states(noise, seed):
    runs = hk.Runs([TIMES] * 2, list(states(noise, seed)))
    return hk.readout(hk.learn(hk.Symplectic(hk.Gaussian(1.0)), runs), TERMS)


def scores(formula):
    found = dict(zip(formula.terms, np.asarray(formula.coefficients), strict=True))
    exact = set(found) == set(TRUE)
    within = [
        abs(found[name] - TRUE[name]) <= 2 * float(deviation)
        for name, deviation in zip(formula.terms, formula.deviations, strict=True)
        if name in TRUE
    ]
    error = max(abs(found.get(name, 0.0) - value) / abs(value) for name, value in TRUE.items())
    return exact, error, within, float(formula.misfit)


def sindy(noise, seed, of_runs, weak=False):
    """Whether some of five thresholds finds exactly q̇ = p and ṗ = −sin q."""
    import pysindy as ps  # type: ignore

    def slope(f, i):  # PySINDy counts arguments, defaults too
        gradients = jax.jit(jax.vmap(jax.grad(f)))

        def of_states(q, p):
            x = np.stack([np.ravel(q), np.ravel(p)], axis=-1)
            return np.asarray(gradients(x))[:, i].reshape(np.shape(q))

        return of_states

    slopes = [slope(f, i) for f in TERMS.values() for i in (0, 1)]
    probe = np.random.default_rng(0).normal(size=(9, 2))
    values = [s(*probe.T) for s in slopes]
    library = []
    for i, value in enumerate(values):  # zero and repeated columns are left out
        same = [abs(np.corrcoef(value, values[j])[0, 1]) > 1 - 1e-12 for j in library]
        if value.std() > 0 and not any(same):
            library.append(i)
    functions = [slopes[i] for i in library]
    names = [(lambda name: lambda q, p: name)(f"g{i}") for i in library]
    truth = {0: {"g" + str(2 * 0 + 1)}, 1: {"g" + str(2 * 1)}}
    columns = ps.CustomLibrary(functions, function_names=names)
    if weak:
        columns = ps.WeakPDELibrary(columns, spatiotemporal_grid=TIMES, is_uniform=True, K=200)
    for threshold in (0.02, 0.05, 0.1, 0.2, 0.4):
        model = ps.SINDy(
            optimizer=ps.STLSQ(threshold=threshold),
            feature_library=columns,
            differentiation_method=None if weak else ps.SmoothedFiniteDifference(),
        )
        if of_runs:
            model.fit(list(states(noise, seed)), t=TIMES[1] - TIMES[0])
        else:
            X, Y = velocities(noise, seed)
            model.fit(X, t=1.0, x_dot=Y)
        found = model.coefficients()
        features = model.get_feature_names()
        terms = {i: {features[j] for j in np.flatnonzero(found[i])} for i in (0, 1)}
        if terms == truth:
            return True
    return False


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("--seeds", type=int, default=5)
    seeds = parser.parse_args().seeds
    try:
        import pysindy  # type: ignore  # noqa: F401
    except ImportError:
        sindy_is_there = False
    else:
        sindy_is_there = True
    warnings.simplefilter("ignore")
    print("data            noise  exact  error    2 dev.  misfit  CPU s  PySINDy exact")
    for kind, find in (("60 velocities", of_velocities), ("122 states", of_states)):
        for noise in (0.01, 0.05, 0.1):
            start = time.process_time()
            formulas = [find(noise, seed) for seed in range(seeds)]
            seconds = (time.process_time() - start) / seeds
            rows = [scores(formula) for formula in formulas]
            exact, errors = np.mean([r[0] for r in rows]), np.median([r[1] for r in rows])
            within = np.mean([w for r in rows for w in r[2]])
            misfit = np.median([r[3] for r in rows])
            other = "-"
            if sindy_is_there:
                tried = [sindy(noise, seed, kind == "122 states") for seed in range(seeds)]
                other = f"{np.mean(tried):.1f}"
                if kind == "122 states":
                    tried = [sindy(noise, seed, True, weak=True) for seed in range(seeds)]
                    other += f", weak form {np.mean(tried):.1f}"
            print(
                f"{kind:14s}  {noise:5.0%}  {exact:5.2f}  {errors:6.2%}  {within:6.2f}  "
                f"{misfit:6.2f}  {seconds:5.1f}  {other}",
                flush=True,
            )
            for formula in formulas:
                print("   ", formula)


if __name__ == "__main__":
    main()
