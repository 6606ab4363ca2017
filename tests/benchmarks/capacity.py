"""How much `learn` can carry: short runs without noise, eight coordinates, many samples.

    python tests/benchmarks/capacity.py double [runs …] [--kernel plain|odd|mechanical] [--seed 0]
    python tests/benchmarks/capacity.py chain [--masses 4] [--seed 0]
    python tests/benchmarks/capacity.py many | long [--seed 0]

`double` is the setting of Finzi, Wang & Wilson (2020), "Simplifying Hamiltonian and Lagrangian
neural networks via explicit constraints": a double pendulum of unit masses and lengths, runs of 5
samples .03 s apart without noise, and for 20 unseen starts the geometric mean over 3 s of
‖x − x̂‖/‖x + x̂‖, x the Cartesian positions and velocities of both masses. Their Hamiltonian network
has .416, .105, .027 and .0048 with 10, 40, 100 and 400 runs. Starts are angles of one radian and
half a radian a second, normally distributed, three seconds before at most.

`chain` is four masses between walls on springs that harden, 20 runs of 50 samples with noise of
1 %, beside `fit` on true velocities with the same noise. `many` is 100 runs of 1000 samples of a
pendulum with noise, and `long` one driven run of 65 000. Each line says the CPU seconds, with
compilation, and the peak of the memory of the process.
"""

import argparse
import resource
import time

import jax
import jax.numpy as jnp
import numpy as np

import hamkernel as hk

jax.config.update("jax_enable_x64", True)

HNN = {10: 0.416, 40: 0.105, 100: 0.027, 400: 0.0048}


def paths(system, starts, ts):
    options = {"rtol": 1e-8, "atol": 1e-8, "max_steps": 20_000, "throw": False}
    one = jax.vmap(lambda x: hk.simulate(system, x, jnp.asarray(ts), **options).ys)
    return np.asarray(jax.jit(one)(jnp.asarray(starts)))


def field_error(field, system, X):
    f, g = (np.asarray(jax.vmap(each)(jnp.asarray(X))) for each in (system, field))
    return np.sqrt(np.mean((f - g) ** 2) / np.mean(f**2))


def measured(name, K, runs, scale):
    """What is learned of the runs, after a line on what it took and on what was found."""
    cpu = time.process_time()
    found = hk.learn(K, runs)
    seconds = time.process_time() - cpu
    memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20
    whole = getattr(found.field, "whole", found.field)
    noise = ", ".join(f"{each:.2g}" for each in np.asarray(found.noise) / scale)
    print(
        f"| {name} | CPU {seconds:.0f} s, peak {memory:.2f} GB | {len(whole.points)} landmarks, "
        f"{len(found.history)} iterations, kept {np.mean(found.kept):.0%}, noise/scale {noise} |",
        flush=True,
    )
    return found


DOUBLE = hk.systems.DoublePendulum()


def double_starts(rng, count):
    q, v = rng.standard_normal((count, 2)), 0.5 * rng.standard_normal((count, 2))
    shared = np.cos(q[:, 0] - q[:, 1])
    p = np.column_stack([2 * v[:, 0] + shared * v[:, 1], v[:, 1] + shared * v[:, 0]])
    return np.concatenate([q, p], axis=1)


def double_chunks(rng, count):
    """Runs of five samples from anywhere in the first three seconds, shape (count, 5, 4)."""
    whole = paths(DOUBLE, double_starts(rng, count), np.arange(0, 3, 0.03))
    return whole.reshape(count, 20, 5, 4)[np.arange(count), rng.integers(20, size=count)]


def cartesian(x):
    """Positions and velocities of both masses of states (q, p), shape (…, 8)."""
    q, p = x[..., :2], x[..., 2:]
    shared = np.cos(q[..., 0] - q[..., 1])
    v = np.stack([p[..., 0] - shared * p[..., 1], 2 * p[..., 1] - shared * p[..., 0]], axis=-1)
    v = v / (2 - shared**2)[..., None]
    parts = [np.sin(q), -np.cos(q), np.cos(q) * v, np.sin(q) * v]
    return np.concatenate([np.cumsum(part, axis=-1) for part in parts], axis=-1)


def double_error(field, rng):
    ts, starts = np.arange(0, 3, 0.03), double_chunks(rng, 20)[:, 0]
    x, y = (cartesian(paths(f, starts, ts)) for f in (DOUBLE, field))
    size = np.linalg.norm(x + y, axis=-1)
    errors = np.linalg.norm(x - y, axis=-1) / size
    return float(np.exp(np.mean(np.log(np.where(np.isfinite(errors), errors, 1.0) + 1e-8))))


def double_kernel(name):
    if name == "plain":
        return hk.Symplectic(hk.Gaussian(np.ones(4)))
    if name == "odd":
        return hk.Odd(hk.Symplectic(hk.Gaussian(np.ones(4))))
    q, p = (0, 1), (2, 3)
    mass = hk.Select(hk.Gaussian(np.ones(2)), q) * hk.Select(hk.Polynomial(2), p)
    return hk.Symplectic(1.0 * mass + 1.0 * hk.Select(hk.Gaussian(np.ones(2)), q))


def double(options):
    for count in options.runs:
        rng, ts = np.random.default_rng(options.seed), 0.03 * np.arange(5)
        states = list(double_chunks(rng, count))
        K, X = double_kernel(options.kernel), np.concatenate(states)
        name = f"double {count} {options.kernel}"
        found = measured(name, K, hk.Runs([ts] * count, states), X.std(axis=0))
        errors = double_error(found.field, rng), field_error(found.field, DOUBLE, X)
        line = f"rollouts {errors[0]:.4f}, network {HNN.get(count)}, field {errors[1]:.5f}"
        print(f"| {name} | {line} |", flush=True)


class Chain:
    """Masses of one between walls, on springs of force d + d³."""

    def __init__(self, masses):
        self.n = 2 * masses

    def hamiltonian(self, x):
        q, p = jnp.split(x, 2)
        d = jnp.diff(jnp.pad(q, 1))
        return jnp.sum(p**2) / 2 + jnp.sum(d**2 / 2 + d**4 / 4)

    def __call__(self, x):
        slope = jax.grad(self.hamiltonian)(x)
        return jnp.concatenate([slope[self.n // 2 :], -slope[: self.n // 2]])


def chain(options):
    system, rng = Chain(options.masses), np.random.default_rng(options.seed)
    ts = np.linspace(0, 5, 50)
    true = paths(system, rng.uniform(-1, 1, (20, system.n)), ts)
    scale, X = true.std(axis=(0, 1)), true.reshape(-1, system.n)
    states = true + 0.01 * scale * rng.standard_normal(true.shape)
    K, name = hk.Symplectic(hk.Gaussian(3.0 * np.ones(system.n))), f"chain n = {system.n}"
    found = measured(name, K, hk.Runs([ts] * 20, list(states)), scale)
    Y = np.asarray(jax.vmap(system)(jnp.asarray(X)))
    noise = 0.01 * Y.std()
    Y = Y + noise * rng.standard_normal(Y.shape)
    solver = hk.Nystrom(max_points=256)  # 2048 columns; all of them would take 8000
    field = hk.fit(found.kernel, X, Y, noise**2 / len(X), solver=solver)
    errors = (field_error(each, system, X) for each in (found.field, field))
    print("| {} | field {:.4f}, `fit` on velocities {:.4f} |".format(name, *errors), flush=True)


PENDULUM = hk.systems.Pendulum(1.0, 1.0, 6.0)


def many(options):
    rng, ts = np.random.default_rng(options.seed), np.linspace(0, 10, 1000)
    true = paths(PENDULUM, rng.uniform(-2, 2, (100, 2)), ts)
    states = list(true + 0.05 * rng.standard_normal(true.shape))
    K = hk.Symplectic(hk.Gaussian(np.ones(2)))
    found = measured("many", K, hk.Runs([ts] * 100, states), true.std(axis=(0, 1)))
    error = field_error(found.field, PENDULUM, true[:, ::50].reshape(-1, 2))
    print(f"| many | field {error:.5f} |", flush=True)


def long(options):
    """A torque of three tones, held for .01 s each, on a pendulum with friction."""
    rng, ts = np.random.default_rng(options.seed), 0.01 * np.arange(65_000)
    tones = [np.sin(w * ts + rng.uniform(0, 6)) for w in (0.7, 1.9, 3.1)]
    u = np.sum(tones, axis=0)[:, None]

    def step(x, u):
        def slope(x):
            return PENDULUM(x) + jnp.array([0.0, u[0] - 0.2 * x[1]])

        a = slope(x)
        b = slope(x + 0.005 * a)
        c = slope(x + 0.005 * b)
        d = slope(x + 0.01 * c)
        return x + 0.01 / 6 * (a + 2 * b + 2 * c + d), x

    true = np.asarray(jax.lax.scan(step, jnp.zeros(2), jnp.asarray(u))[1])
    states = true + 0.02 * rng.standard_normal(true.shape)
    drift = hk.PortHamiltonian(hk.Gaussian(np.ones(2)), friction=0.1)
    K = hk.Controlled(drift, inputs=hk.InputMatrix(1.0, acts_on=(1,)))
    found = measured("long", K, hk.Runs(ts, states, u), true.std(axis=0))
    u0 = jnp.zeros(1)
    error = field_error(
        lambda x: found.field(x, u0),
        lambda x: PENDULUM(x) - jnp.array([0.0, 0.2]) * x,
        true[::100],
    )
    print(f"| long | drift {error:.5f} |", flush=True)


CASES = {"double": double, "chain": chain, "many": many, "long": long}


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("case", choices=CASES)
    parser.add_argument("runs", nargs="*", type=int, default=list(HNN))
    parser.add_argument("--kernel", default="plain", choices=["plain", "odd", "mechanical"])
    parser.add_argument("--masses", type=int, default=4)
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    CASES[options.case](options)


if __name__ == "__main__":
    main()
