"""`hk.Lagrangian` on arms in closed form: errors of M(q) and of the gravity, with their bands.

    python tests/benchmarks/lagrangian.py [letters noisy positions friction …] [--seed 0]

All machines are the two-link arm of `tests/test_lagrangian.py`.

- `letters`: 100 states with accelerations and torques, without noise; `noisy`: with noise of 1 % of
  the rms of the torques, tuned (the strong form);
- `velocities`, `positions`: four runs of 5 s at 100 Hz with noise of 1e-3 rad and 1e-2 rad/s, or of
  1e-3 rad alone (the weak form);
- `friction`: positions, with .4 v + .2 tanh(v/.1) in both joints; `one`: a motor in the first joint
  only.

Printed: the rms errors of M and of the gravity over the states of the runs, relative to their rms,
the share of both inside two deviations, and CPU seconds with compilation.
"""

import argparse
import time
import warnings

import jax
import numpy as np
from scipy.integrate import solve_ivp

import hamkernel as hk

jax.config.update("jax_enable_x64", True)
A1, A2, A3, G1, G2 = 1.8, 0.6, 0.5, 12.0, 4.0


def mass(q):
    """M(q)."""
    c = A3 * np.cos(q[1])
    return np.array([[A1 + 2 * c, A2 + c], [A2 + c, A2]])


def gravity(q):
    """∂V/∂q."""
    both = G2 * np.sin(q[0] + q[1])
    return np.array([G1 * np.sin(q[0]) + both, both])


def torque(q, v, a, viscous=0.0, dry=0.0):
    """The equation of Euler and Lagrange with friction."""
    s = A3 * np.sin(q[1])
    coriolis = np.array([-s * (2 * v[0] + v[1]) * v[1], s * v[0] ** 2])
    return mass(q) @ a + coriolis + gravity(q) + viscous * v + dry * np.tanh(v / 0.1)


def logs(rng, friction=(0.0, 0.0), motors=(1.0, 1.0), count=4):
    """Runs of 5 s at 100 Hz under four sines in each joint: times, states and torques."""
    ts, found = np.arange(501) / 100, []
    for _ in range(count):
        w, p = 2 * np.pi * rng.uniform(0.2, 1.5, (2, 4)), rng.uniform(0, 6, (2, 4))
        size = rng.normal(size=(2, 4)) * np.array([[6.0], [2.0]]) * np.array(motors)[:, None]

        def motor(t, w=w, p=p, size=size):
            return np.sum(size * np.sin(w * t + p), axis=1)

        def rates(t, x, motor=motor):
            rest = torque(x[:2], x[2:], np.zeros(2), *friction)
            return np.concatenate([x[2:], np.linalg.solve(mass(x[:2]), motor(t) - rest)])

        x0 = np.concatenate([rng.uniform(-1.5, 1.5, 2), np.zeros(2)])
        x = solve_ivp(rates, (0, 5), x0, t_eval=ts, rtol=1e-9, atol=1e-9).y.T
        found.append((ts, x, np.array([motor(t) for t in ts])))
    return [list(each) for each in zip(*found, strict=True)]


def states(rng, count):
    """States, accelerations and torques drawn at random, for the strong form."""
    X = np.concatenate([rng.uniform(-3, 3, (count, 2)), rng.normal(0, 3, (count, 2))], axis=1)
    A = rng.normal(0, 3, (count, 2))
    return X, A, np.array([torque(x[:2], x[2:], a) for x, a in zip(X, A, strict=True)])


def strong(rng, noise):
    """The field of 100 states, and where to judge it."""
    X, A, tau = states(rng, 100)
    tau = tau + noise * np.sqrt(np.mean(tau**2)) * rng.normal(size=tau.shape)
    K = hk.Lagrangian(300.0 * hk.Gaussian(3.0), 10.0 * hk.Gaussian(3.0), angles=(0, 1))
    Q = states(rng, 200)[0][:, :2]
    if noise:
        return hk.tune(K, X, tau, accelerations=A).field, Q
    return hk.fit(K, X, tau, 1e-14, accelerations=A), Q


def weak(rng, velocities=False, friction=(0.0, 0.0), motors=(1.0, 1.0)):
    """The field of four runs, and where to judge it."""
    times, paths, u = logs(rng, friction, motors)
    noise = np.array([1e-3, 1e-3, 1e-2, 1e-2])
    seen = [x + noise[None] * rng.normal(size=x.shape) for x in paths]
    seen = seen if velocities else [x[:, :2] for x in seen]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of a torque that is always zero
        runs = hk.Runs(times, seen, inputs=u, between="linear")
    K = hk.Lagrangian(hk.Gaussian(2.0), hk.Gaussian(2.0), (0, 1), friction=bool(any(friction)))
    return hk.learn(K, runs).field, np.concatenate(paths)[::20, :2]


TASKS = {
    "letters": lambda rng: strong(rng, 0.0),
    "noisy": lambda rng: strong(rng, 0.01),
    "velocities": lambda rng: weak(rng, velocities=True),
    "positions": weak,
    "friction": lambda rng: weak(rng, friction=(0.4, 0.2)),
    "one": lambda rng: weak(rng, motors=(1.0, 0.0)),
}


def main():
    """Print one line for each task."""
    parser = argparse.ArgumentParser()
    parser.add_argument("tasks", nargs="*", default=list(TASKS))
    parser.add_argument("--seed", type=int, default=0)
    asked = parser.parse_args()
    for name in asked.tasks:
        start = time.process_time()
        field, Q = TASKS[name](np.random.default_rng(asked.seed))
        seconds = time.process_time() - start
        line = f"{name:10s}"
        for said, truth in (("mass_matrix", mass), ("gravity", gravity)):
            wanted = np.array([truth(q) for q in Q])
            off = np.asarray(jax.jit(jax.vmap(getattr(field, said)))(Q)) - wanted
            band = np.asarray(jax.jit(jax.vmap(getattr(field, f"{said}_deviation")))(Q))
            error = np.sqrt(np.mean(off**2) / np.mean(wanted**2))
            line += f"  {said} {100 * error:.3g} %, {np.mean(np.abs(off) < 2 * band):.2f} inside"
        print(f"{line}  {seconds:.0f} s", flush=True)


if __name__ == "__main__":
    main()
