"""`learn` where the structure is not the whole truth: five falsifiers of which the field is known.

    python tests/benchmarks/model_error.py [case …] [--seeds 20] [--first 0]

A pendulum v̇ = −6 sin q + G u of gain G = 2, logged at 50 Hz:

- `none`: no model error. (q, v), no input, 6 runs of 6 s, noise .05; beside process_noise=0;
- `stiction`: Coulomb friction of .3 of the largest torque, q alone, in closed loop behind a
  sum of sines;
- `flexible`: a second mass on a spring in the drive, with a period of .3 s and a tenth of the
  inertia, that the structure does not have; both together have an inertia of one, so that the field
  and the gain of slow motion are those of all other cases;
- `delayed`: inputs that act half a sample after they were logged;
- `encoder`: q alone by 12 bits a turn, no other noise;
- `friction`: the log of `stiction`, and a kernel with `hk.Friction`, which can say it;
- `timed`: the log of `delayed`, and `delay="fit"`.

Printed by case, the medians over seeds: the error of U′ along the log relative to its rms (the
smooth part of the field), that of the gain, the share of U′ inside two standard deviations, the
rms of the angle in free runs of 1 s of another log where it stays inside the angles of the first,
and the same for least squares on rollouts with the equation
q̈ = −a sin q − d v − c tanh(v/.05) + G u, which has the true form; how much process noise was found,
how often the innovations were called white; the delay found; CPU seconds.

Medians, errors of U′ and of the gain, free runs beside the grey box, mean share inside two
deviations. Seeds 0 to 2: stiction 5.4 %, 6.4 %, .14 for .0042 rad. Seeds 0 to 18: encoder .018 %,
.005 %, .00007 for .0021, .95. Seeds 0 to 19: timed .12 %, .012 %, .0030 for .024, .96; flexible
.30 %, .61 %, .0024 for .0063, .87. Seeds 0 to 13: friction .07 %, .01 %, .0008 for .0051, .89. One
run of all, of flexible, is worse than the grey box. Without model error, seeds 7 to 18, the error
is that of process_noise=0 and no process noise is found. White w alone does not stand for stiction:
say that there is friction. The gain of `flexible` is too small, since slow motion, whose gain is
one, is not what was logged.
"""

import argparse
import time
import warnings
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from scipy.optimize import least_squares

import hamkernel as hk

jax.config.update("jax_enable_x64", True)

A, GAIN, DT, T = 6.0, 2.0, 0.02, 500
PENDULUM = hk.systems.Pendulum(1.0, 1.0, A)
U_PART = hk.Controlled(
    hk.Symplectic(hk.Select(hk.Gaussian(1.0), 0)), hk.InputMatrix(1.0, acts_on=(1,))
)
WITH_FRICTION = hk.Controlled(
    hk.Sum(potential=U_PART.drift, friction=hk.Friction(0.1, 0.3)), U_PART.inputs
)
LOGS = {"friction": "stiction", "timed": "delayed"}  # those of other cases


def velocity_known(s, u):
    return jnp.array([s[1], 0.0])


def after_friction(v, a, dry, h):
    """The velocity after a time h of constant force a and dry friction, exact where it turns.

    Friction of the velocity after the kick instead is off by up to 2 · dry · h at each reversal.
    """
    slowing = dry - a * np.sign(v)
    if v and slowing * h < abs(v):
        return v - np.sign(v) * slowing * h
    left = h - abs(v) / slowing if v else h
    return np.sign(a) * max(abs(a) - dry, 0.0) * left


def driven(case, seed):
    """Times, true states (T, 2), inputs (T, 1), and the log, NaN for v."""
    case = LOGS.get(case, case)
    rng = np.random.default_rng(seed)
    t, fine = DT * np.arange(T), 40
    frequencies, phases = rng.uniform(1.0, 6.0, 6), rng.uniform(0, 2 * np.pi, 6)
    h = DT / fine
    x, states, inputs = np.array([rng.uniform(-1, 1), 0.0]), [], []
    bent = np.zeros(2)  # of the flexible part
    acting = 0.0
    for i in range(T):
        wanted = 1.2 * np.sin(frequencies * t[i] + phases).sum() / 2
        u = 3.0 * (wanted - x[0]) - 0.6 * x[1]
        states.append(x.copy())
        inputs.append(u)
        for j in range(fine):
            if case != "delayed" or j >= fine // 2:
                acting = u
            # Half a drift, a kick, half a drift: with the drift behind the kick, inputs acted a
            # quarter of a millisecond early, and that was found as process noise.
            x[0] += h / 2 * x[1]
            bent[0] += h / 2 * bent[1]
            a = GAIN * acting - A * np.sin(x[0])
            if case == "flexible":
                spring = (2 * np.pi / 0.3) ** 2 * bent[0] + 2.0 * bent[1]
                a = 1.1 * a + 0.1 * spring
                bent[1] -= h * (a + spring)
            x[1] = after_friction(x[1], a, 0.3 * GAIN * 2.0 if case == "stiction" else 0.0, h)
            x[0] += h / 2 * x[1]
            bent[0] += h / 2 * bent[1]
    states = np.array(states)
    q = states[:, 0] + (0.001 if case != "encoder" else 0.0) * rng.standard_normal(T)
    if case == "encoder":
        step = 2 * np.pi / 4096
        q = step * np.round(q / step)
    return t, states, np.array(inputs)[:, None], np.stack([q, np.full(T, np.nan)], axis=1)


def inside(log, states, length=50):
    """The starts of parts of 1 s whose angles stay inside those of a log."""
    low, high, starts = np.nanmin(log[:, 0]), np.nanmax(log[:, 0]), np.arange(0, T - length, 10)
    q = np.array([states[s : s + length + 1, 0] for s in starts])
    return starts[(q.min(axis=1) >= low) & (q.max(axis=1) <= high)]


def later(inputs, delay):
    """The mean over each sample of held inputs that act later by a part of a sample."""
    share, whole = np.modf(delay / DT)
    at = np.arange(len(inputs)) - int(whole)
    before, after = (inputs[np.clip(at - k, 0, len(inputs) - 1)] for k in (int(np.sign(share)), 0))
    return (1 - abs(share)) * after + abs(share) * before


def free_runs(velocity, states, inputs, starts, length=50):
    """The rms of the angle over rollouts of 1 s from true states, held inputs."""

    def one(x, u):
        def step(x, u):
            def interval(x, _):
                h = DT / 8
                k1 = velocity(x, u)
                k2 = velocity(x + h / 2 * k1, u)
                return x + h * k2, None

            x = jax.lax.scan(interval, x, length=8)[0]
            return x, x[0]

        return jax.lax.scan(step, x, u)[1]

    u = jnp.asarray(np.stack([inputs[s : s + length] for s in starts]))
    q = jax.jit(jax.vmap(one))(jnp.asarray(states[starts]), u)
    true = np.stack([states[s + 1 : s + length + 1, 0] for s in starts])
    return float(np.sqrt(np.mean((np.asarray(q) - true) ** 2)))


def parametric(theta):
    a, d, c, G = theta

    def velocity(x, u):
        return jnp.array(
            [x[1], -a * jnp.sin(x[0]) - d * x[1] - c * jnp.tanh(x[1] / 0.05) + G * u[0]]
        )

    return velocity


def grey_box(t, log, inputs):
    """Least squares on rollouts of half a second, starts smoothed by cubics over 9 samples."""
    from scipy.signal import savgol_filter

    q: Any = savgol_filter(log[:, 0], 9, 3)
    v: Any = savgol_filter(log[:, 0], 9, 3, deriv=1, delta=DT)
    x, starts = np.stack([q, v], axis=1), np.arange(0, T - 26, 25)
    u = jnp.stack([jnp.asarray(inputs[s : s + 25]) for s in starts])
    seen = np.stack([log[s + 1 : s + 26, 0] for s in starts])

    @jax.jit
    def residuals(theta):
        velocity = parametric(theta)

        def one(x, u):
            def step(x, u):
                def interval(x, _):
                    h = DT / 4
                    return x + h * velocity(x + h / 2 * velocity(x, u), u), None

                x = jax.lax.scan(interval, x, length=4)[0]
                return x, x[0]

            return jax.lax.scan(step, x, u)[1]

        return (jax.vmap(one)(jnp.asarray(x[starts]), u) - seen).reshape(-1)

    jacobian = jax.jit(jax.jacfwd(residuals))
    found = least_squares(
        lambda p: np.asarray(residuals(p)),
        np.array([3.0, 0.1, 0.1, 1.0]),
        lambda p: np.asarray(jacobian(p)),  # pyright: ignore[reportArgumentType]
        loss="soft_l1",
        f_scale=0.01,
    )
    return parametric(jnp.asarray(found.x)), float(found.x[3])


def without_warnings(*args, **options):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return hk.learn(*args, **options)


def on_driven(case, seed):
    t, states, inputs, log = driven(case, seed)
    begun = time.process_time()
    kernel = WITH_FRICTION if case == "friction" else U_PART
    runs = hk.Runs(t, log, inputs, delay="fit" if case == "timed" else 0.0)
    found = without_warnings(kernel, runs, mean=velocity_known)
    spent = time.process_time() - begun
    test = driven(case, seed + 1000)
    X = jnp.asarray(states[::5] * [1.0, 0.0])  # where there is no friction
    drift = np.asarray(jax.vmap(found.field.drift)(X))[:, 1]
    truth = -A * np.sin(states[::5, 0])
    scale = np.sqrt(np.mean(truth**2))
    gain = float(found.field.input_matrix(X[0])[1, 0])
    posterior = found.posterior
    none = jnp.zeros((len(X), 1))
    deviation = np.asarray(jax.vmap(posterior.deviation)(X, none))[:, 1]
    covered = np.mean(np.abs(drift - truth) < 2 * deviation)
    delay, starts = float(found.runs.delay), inside(log, test[1])
    ours = free_runs(found.field, test[1], later(test[2], delay), starts)
    theirs, their_gain = grey_box(t, log, inputs)
    return (
        np.sqrt(np.mean((drift - truth) ** 2)) / scale,
        abs(gain / GAIN - 1),
        covered,
        ours,
        free_runs(theirs, test[1], test[2], starts),
        abs(their_gain / GAIN - 1),
        float(found.process_noise[1]),
        float(found.whiteness > 0.05),
        float(found.noise[0]),
        delay,
        spent,
    )


def without_error(seed, noise=0.05):
    """Field errors with process noise looked for, and without; whether it was found; white."""
    rng = np.random.default_rng(seed)
    ts = np.linspace(0, 6, 30)
    starts = jnp.asarray(rng.uniform(-2, 2, (6, 2)))
    true = np.asarray(jax.vmap(lambda x: hk.simulate(PENDULUM, x, jnp.asarray(ts)).ys)(starts))
    runs = hk.Runs([ts] * 6, list(true + noise * rng.standard_normal(true.shape)))
    X = jnp.asarray(true.reshape(-1, 2))
    f = np.asarray(jax.vmap(PENDULUM)(X))

    def error(found):
        g = np.asarray(jax.vmap(found.field)(X))
        return np.sqrt(np.mean((f - g) ** 2) / np.mean(f**2))

    K, out, begun = hk.Symplectic(hk.Gaussian(1.0)), [], time.process_time()
    for q in (None, 0.0):
        found = without_warnings(K, runs, process_noise=q)
        out += [error(found), time.process_time() - begun, found]
        begun = time.process_time()
    found = out[2]
    z = (np.asarray(jax.vmap(found.field)(X)) - f) / np.asarray(
        jax.vmap(found.posterior.deviation)(X)
    )
    return (
        out[0],
        out[3],
        out[0] / out[3],
        float((found.process_noise > 0).any()),
        float(found.whiteness > 0.05),
        np.mean(np.abs(z) < 2),
        out[1],
        out[4],
    )


NONE = "error, today's, ratio, process noise found, white, inside 2 sd, CPU s, today's"
DRIVEN = (
    "error of U', of the gain, inside 2 sd, free run, grey box's, its gain, q, white, noise, "
    "delay, CPU s"
)
CASES = ("none", "stiction", "flexible", "delayed", "encoder", "friction", "timed")


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("cases", nargs="*", default=CASES)
    parser.add_argument("--seeds", type=int, default=20)
    parser.add_argument("--first", type=int, default=0)
    asked = parser.parse_args()
    for case in asked.cases or CASES:
        names = NONE if case == "none" else DRIVEN
        rows = []
        for seed in range(asked.first, asked.first + asked.seeds):
            rows.append(without_error(seed) if case == "none" else on_driven(case, seed))
            print(case, seed, " ".join(f"{v:.3g}" for v in rows[-1]), flush=True)
        middle = np.median(rows, axis=0) if case != "none" else np.mean(rows, axis=0)
        print(f"{case}: {'mean' if case == 'none' else 'median'} of {asked.seeds}")
        for name, value in zip(names.split(", "), middle, strict=True):
            print(f"  {name:22} {value:.4g}")


if __name__ == "__main__":
    main()
