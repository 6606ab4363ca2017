"""Fits of a Hamiltonian field without the dense Gram, against the exact fit.

    python tests/benchmarks/solvers.py [--large]

float64, warm, in one process: the minimum and the median over repeats. Agreement with Cholesky is
shown first. `--large` adds a million points and conjugate gradients with 20 000, which take
minutes on two cores. Memory is the peak of the process so far, so sizes run in rising order.
"""

import argparse
import resource

import jax

jax.config.update("jax_enable_x64", True)

import jax.numpy as jnp
import numpy as np
from timing import timed

import hamkernel as hk
from hamkernel import ConjugateGradient, Nystrom


def hamiltonian(x: jax.Array) -> jax.Array:
    q, p = jnp.split(x, 2)
    return p @ p / 2 - jnp.sum(jnp.cos(q)) + 0.1 * jnp.sum(q) ** 2


def data(N: int, n: int, noise: float = 0.01) -> tuple[jax.Array, jax.Array]:
    """Velocities at uniform points, with noise relative to their size."""
    rng = np.random.default_rng(0)
    X = jnp.asarray(rng.uniform(-2, 2, size=(N, n)))
    slope = jax.jit(jax.vmap(jax.grad(hamiltonian)))(X)
    V = jnp.concatenate([slope[:, n // 2 :], -slope[:, : n // 2]], axis=1)
    return X, V + noise * V.std() * jnp.asarray(rng.normal(size=(N, n)))


def report(name: str, N: int, n: int, solver, K, regularization: float, repeats: int, exact=None):
    X, Y = data(N, n)
    least, median, field = timed(
        lambda: hk.fit(K, X, Y, regularization, solver=solver),  # pyright: ignore
        repeats,
    )
    memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6
    print(f"  {name:22s} {N:9d} {n:3d} {least:9.3f} s {median:9.3f} s {memory:6.2f} GB", end="")
    info = field.info
    if info is not None and info.landmarks is not None and info.truncation is not None:
        print(f"  {int(info.landmarks)} landmarks, truncation {float(info.truncation):.1e}", end="")
    if info is not None and info.iterations is not None and info.relative_residual is not None:
        left = float(info.relative_residual)
        print(f", {int(info.iterations)} iterations, residual {left:.1e}", end="")
    if exact is not None:
        new = data(500, n)[0] * 0.95
        reference = exact.evaluate(new)
        off = jnp.linalg.norm(field.evaluate(new) - reference) / jnp.linalg.norm(reference)
        print(f", from exact {float(off):.1e}", end="")
    print(flush=True)
    return field, least


def main(large: bool) -> None:
    plane, K = hk.Symplectic(hk.Gaussian(1.5)), hk.Symplectic(hk.Gaussian(2.0))
    exact, slow = report("Cholesky", 2000, 2, hk.Cholesky(), plane, 1e-5, 3)
    _, fast = report("Nystrom", 2000, 2, Nystrom(), plane, 1e-5, 7, exact)
    print(f"  Nystrom is {slow / fast:.1f} times faster than Cholesky")
    exact, _ = report("Cholesky", 1000, 4, hk.Cholesky(), K, 1e-4, 2)
    report("ConjugateGradient 1e-6", 1000, 4, ConjugateGradient(1e-6), K, 1e-4, 2, exact)
    sizes = [10_000, 100_000, 1_000_000] if large else [10_000, 100_000]
    seconds = [report("Nystrom", N, 2, Nystrom(), plane, 1e-5, 2)[1] for N in sizes]
    slope = np.log10(seconds[-1] / seconds[-2])
    print(f"  slope of log time over log N from {sizes[-2]} to {sizes[-1]}: {slope:.2f}")
    if large:
        report("ConjugateGradient 1e-6", 20_000, 4, ConjugateGradient(1e-6), K, 1e-4, 1)
        wide = hk.Symplectic(hk.Gaussian(3.0))
        report("ConjugateGradient 1e-6", 10_000, 8, ConjugateGradient(1e-6), wide, 1e-4, 1)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--large", action="store_true")
    main(parser.parse_args().large)
