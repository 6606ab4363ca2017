"""Warm times, first calls and errors in float32 of the default device, beside its float64.

    python tests/benchmarks/gpu.py [--quick]
    JAX_PLATFORMS=cpu python tests/benchmarks/gpu.py

The table of `docs/gpu.md`, on whatever device JAX chooses. Milliseconds, minimum over repeats after
one call; "first" is that call, which compiles. The last column is the largest error of the float32
result, relative to the largest entry of the float64 one. `--quick` takes a tenth of the points.
"""

import argparse
import time
from collections.abc import Callable
from typing import Any, NamedTuple

import jax

jax.config.update("jax_enable_x64", True)

import jax.numpy as jnp
import numpy as np

import hamkernel as hk

PENDULUM = hk.systems.Pendulum(mass=1.0)
ODD = hk.Odd(hk.Symplectic(hk.Gaussian(2.0)))


class Task(NamedTuple):
    """A call and its repeats; `in_float32` where the result of float32 is compared."""

    call: Callable[[Any], Any]
    repeats: int = 5
    in_float32: bool = False


def states(N: int, n: int) -> np.ndarray:
    return np.random.default_rng(0).uniform(-2, 2, (N, n))


def velocities(X: np.ndarray) -> np.ndarray:
    """Those of n/2 pendulums."""
    q, p = np.split(X, 2, axis=1)
    return np.concatenate([p, -np.sin(q)], axis=1)


def kernel(dtype) -> hk.Symplectic:
    return hk.Symplectic(hk.Gaussian(jnp.asarray(2.0, dtype)))


def product(N: int, n: int) -> Callable[[Any], Any]:
    def call(dtype):
        X = jnp.asarray(states(N, n), dtype)
        return hk.gram_operator(kernel(dtype), X).mv(jnp.ones((N, n), dtype))

    return call


def fitted(N: int, n: int, solver: Any = None, ridge: float = 1e-4) -> Callable[[Any], Any]:
    X = states(N, n)
    Y = velocities(X)

    def call(dtype):
        data = jnp.asarray(X, dtype), jnp.asarray(Y, dtype)
        field = hk.fit(kernel(dtype), *data, regularization=ridge, solver=solver)
        return jax.vmap(field)(data[0][:100])

    return call


def tuned(N: int, n: int) -> Callable[[Any], Any]:
    X = states(N, n)
    Y = velocities(X) + 0.01 * np.random.default_rng(1).standard_normal(X.shape)
    return lambda dtype: hk.tune(hk.Symplectic(hk.Gaussian(1.0)), X, Y).regularization


def batched(gradient: bool) -> Callable[[Any], Any]:
    X = jnp.asarray(np.stack([states(24, 2)] * 256))
    Y = jnp.asarray(np.stack([velocities(states(24, 2))] * 256))
    K = kernel(jnp.float64)

    @jax.jit
    @jax.vmap
    def fits(X, Y):
        return hk.fit(K, X, Y, regularization=1e-4)(X[0])

    @jax.jit
    @jax.vmap
    def slopes(X, Y):
        return jax.grad(lambda r: hk.log_marginal_likelihood(K, X, Y, regularization=r))(1e-4)

    return lambda dtype: (slopes if gradient else fits)(X, Y)


def evaluated(count: int, N: int) -> Callable[[Any], Any]:
    X = states(N, 2)
    field = hk.fit(kernel(jnp.float64), X, velocities(X), regularization=1e-4)
    at, run = jnp.asarray(states(count, 2)), jax.jit(lambda field, x: jax.vmap(field)(x))
    return lambda dtype: run(field, at)


def simulated(orbits: int) -> Callable[[Any], Any]:
    X = states(24, 2)
    field = hk.fit(kernel(jnp.float64), X, velocities(X), regularization=1e-4)
    starts, ts = jnp.asarray(states(orbits, 2)), jnp.linspace(0.0, 10.0, 101)
    run = jax.jit(lambda field, x: jax.vmap(lambda x: hk.simulate(field, x, ts).ys)(x))
    return lambda dtype: run(field, starts)


def learned() -> Callable[[Any], Any]:
    times, starts = jnp.linspace(0.0, 3.0, 61), jnp.array([[1.2, 0.0], [2.4, 0.0]])
    log, _ = hk.systems.sample(PENDULUM, starts, times, 0.02, 0.0, key=jax.random.key(0))
    return lambda dtype: hk.learn(ODD, hk.Runs([times, times], list(log)), progress=False).noise


def tasks(share: float) -> dict[str, Task]:
    def size(N: int) -> int:
        return max(int(N * share), 24)

    features = hk.RandomFeatures(250, jax.random.key(0))
    return {
        f"Gram, N = {size(1000)}, n = 4": Task(
            lambda dtype: hk.gram(kernel(dtype), jnp.asarray(states(size(1000), 4), dtype)),
            in_float32=True,
        ),
        f"product, N = {size(20_000)}, n = 4": Task(product(size(20_000), 4), 3, True),
        f"exact fit, N n = {4 * size(1000)}": Task(fitted(size(1000), 4), 3, True),
        f"Nystrom, N = {size(100_000)}, n = 2": Task(fitted(size(100_000), 2, hk.Nystrom()), 3),
        f"RandomFeatures, N = {size(100_000)}, n = 2": Task(fitted(size(100_000), 2, features), 3),
        "tune, N = 24, n = 2": Task(tuned(24, 2), 3),
        f"tune, N = {size(300)}, n = 2": Task(tuned(size(300), 2), 3),
        "vmap of fit, 256 x N = 24": Task(batched(False)),
        "vmap of a slope, 256 x N = 24": Task(batched(True)),
        f"field at {size(1_000_000)} states, N = 24": Task(evaluated(size(1_000_000), 24)),
        "field at one state, N = 24": Task(evaluated(1, 24), 20),
        f"simulate {size(10_000)} orbits": Task(simulated(size(10_000)), 3),
        "simulate one orbit": Task(simulated(1), 5),
        "learn from two runs": Task(learned(), 2),
    }


def run(name: str, task: Task) -> str:
    begin = time.perf_counter()
    result = jax.block_until_ready(task.call(jnp.float64))
    first = time.perf_counter() - begin
    seconds = []
    for _ in range(task.repeats):
        begin = time.perf_counter()
        jax.block_until_ready(task.call(jnp.float64))
        seconds.append(time.perf_counter() - begin)
    error = ""
    if task.in_float32:
        rough = np.asarray(task.call(jnp.float32), np.float64)
        assert np.isfinite(rough).all()
        error = f"{np.abs(rough - np.asarray(result)).max() / np.abs(result).max():.1e}"
    return f"| {name} | {1e3 * min(seconds):.3g} ms | {first:.2g} s | {error} |"


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--quick", action="store_true", help="a tenth of the points")
    share = 0.1 if parser.parse_args().quick else 1.0
    device = jax.devices()[0]
    print(f"jax {jax.__version__}, {device.device_kind} ({device.platform})\n")
    print("| | warm | first | float32 |\n|---|---|---|---|")
    for name, task in tasks(share).items():
        print(run(name, task), flush=True)


if __name__ == "__main__":
    main()
