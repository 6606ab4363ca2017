"""Microseconds per call of a learned field.

    python tests/benchmarks/field_call.py

An odd symplectic Gaussian kernel in the plane, float64. Compiled first, each result waited for;
the smallest mean of several rounds. "One state" is what a controller pays in each of its steps,
mostly the overhead of dispatch; "in a batch" is per state with 1000 states in one call.
"""

import time

import jax

jax.config.update("jax_enable_x64", True)

import jax.export
import jax.numpy as jnp

import hamkernel as hk

ROUNDS, CALLS, BATCH = 7, 200, 1000


def microseconds(fn, argument, calls):
    jax.block_until_ready(fn(argument))

    def one_round():
        start = time.perf_counter()
        for _ in range(calls):
            jax.block_until_ready(fn(argument))
        return (time.perf_counter() - start) / calls

    return 1e6 * min(one_round() for _ in range(ROUNDS))


def main():
    print(f"{'N':>5} {'one state':>10} {'exported':>10} {'H':>10} {'in a batch':>11}   µs")
    system = hk.systems.Pendulum(mass=1.0)
    x = jnp.array([0.5, 0.3])
    states = jax.random.normal(jax.random.key(1), (BATCH, 2))
    for N in (24, 1000):
        X = jax.random.normal(jax.random.key(0), (N, 2))
        field = hk.fit(hk.Odd(hk.Symplectic(hk.Gaussian(3.0))), X, jax.vmap(system)(X), 1e-6)
        exported = jax.export.export(jax.jit(field))(jax.ShapeDtypeStruct((2,), float))
        columns = (
            microseconds(jax.jit(field), x, CALLS),
            microseconds(jax.jit(exported.call), x, CALLS),
            microseconds(jax.jit(field.hamiltonian), x, CALLS),
            microseconds(jax.jit(jax.vmap(field)), states, 5) / BATCH,
        )
        print(f"{N:>5} {columns[0]:>10.1f} {columns[1]:>10.1f} {columns[2]:>10.1f}", end="")
        print(f" {columns[3]:>11.2f}")


if __name__ == "__main__":
    main()
