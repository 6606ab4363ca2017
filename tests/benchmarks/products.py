"""Products with the Gram of a symplectic kernel, against KeOps with a hand-written formula.

    python tests/benchmarks/products.py [--points 20000] [--dimensions 4 20] [--repeats 3]

float64, warm, in one process: the minimum and the median over repeats, and nanoseconds per pair of
points. The results are first checked to agree with KeOps, or with each other's rows in NumPy where
pykeops is not installed (`pip install hamkernel[benchmarks]`). KeOps compiles its formula at the
first call, which is not timed.
"""

import argparse
import time
from collections.abc import Callable
from typing import Any

import jax

jax.config.update("jax_enable_x64", True)

import jax.numpy as jnp
import numpy as np

import hamkernel as hk
from hamkernel._gram_operator import gram_operator

SIGMA = 1.3
# Sums of 20 000 terms of order one.
AGREEMENT = 1e-10


def timed(run: Callable[[], Any], repeats: int) -> tuple[Any, float, float]:
    """The result, and the minimum and median of seconds after one call to warm up."""
    result = run()
    seconds = []
    for _ in range(repeats):
        start = time.perf_counter()
        run()
        seconds.append(time.perf_counter() - start)
    return result, min(seconds), float(np.median(seconds))


def rotated(V: np.ndarray) -> np.ndarray:
    q, p = np.split(V, 2, axis=1)
    return np.concatenate([p, -q], axis=1)


def closed_form(X: np.ndarray, Z: np.ndarray, A: np.ndarray) -> np.ndarray:
    """J Σⱼ −∇∇ᵀg(xᵢ − zⱼ) Jᵀaⱼ for the Gaussian g."""
    C = -rotated(A)
    d = X[:, None] - Z[None]
    weight = np.exp(-(d**2).sum(-1) / (2 * SIGMA**2)) / SIGMA**2
    along = np.einsum("nma,ma->nm", d, C) / SIGMA**2
    return rotated(weight @ C - np.einsum("nm,nma->na", weight * along, d))


def keops(X: np.ndarray, A: np.ndarray) -> Callable[[], np.ndarray]:
    from pykeops.numpy import LazyTensor  # pyright: ignore[reportMissingImports]

    C = -rotated(A)
    x, z, c = LazyTensor(X[:, None].copy()), LazyTensor(X[None].copy()), LazyTensor(C[None].copy())

    def run() -> np.ndarray:
        d = x - z
        weight = (-(d | d) / (2 * SIGMA**2)).exp()
        total = weight * (c - d * ((d | c) / SIGMA**2))
        return rotated(total.sum(axis=1) / SIGMA**2)

    return run


KERNELS = {
    "Gaussian": hk.Symplectic(hk.Gaussian(SIGMA)),
    "Matérn 5/2": hk.Symplectic(hk.Matern(2.5, SIGMA)),
    "odd Gaussian": hk.Odd(hk.Symplectic(hk.Gaussian(SIGMA))),
}


def measure(N: int, n: int, repeats: int) -> None:
    rng = np.random.default_rng(0)
    X, A = rng.normal(size=(N, n)), rng.normal(size=(N, n))
    coefficients = jnp.asarray(A)
    rows = [0, N // 2, N - 1]
    reference = closed_form(X[rows], X, A)
    ours = {}
    for name, K in KERNELS.items():
        operator = gram_operator(K, X)
        ours[name] = timed(lambda op=operator: op.mv(coefficients).block_until_ready(), repeats)
    difference = np.abs(np.asarray(ours["Gaussian"][0])[rows] - reference).max()
    assert difference < AGREEMENT * np.abs(reference).max() * np.sqrt(N), difference
    base = ours["Gaussian"][1]
    lines = [(f"hamkernel {name}", *seconds[1:]) for name, seconds in ours.items()]
    try:
        theirs = timed(keops(X, A), repeats)
    except ImportError:
        print("pykeops is not installed: pip install hamkernel[benchmarks]")
    else:
        off = np.abs(np.asarray(ours["Gaussian"][0]) - theirs[0]).max()
        assert off < AGREEMENT * np.abs(theirs[0]).max() * np.sqrt(N), off
        lines.append(("KeOps Gaussian, formula by hand", *theirs[1:]))
    print(f"\nN = {N}, n = {n}: product with the ({N * n}, {N * n}) Gram")
    print(f"  {'':34s} {'minimum':>10s} {'median':>10s} {'ns/pair':>8s} {'ratio':>6s}")
    for name, least, median in lines:
        per_pair = least / N**2 * 1e9
        times = f"{least:8.3f} s {median:8.3f} s {per_pair:8.2f} {least / base:6.2f}"
        print(f"  {name:34s} {times}", flush=True)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--points", type=int, default=20_000)
    parser.add_argument("--dimensions", type=int, nargs="+", default=[4, 20])
    parser.add_argument("--repeats", type=int, default=3)
    arguments = parser.parse_args()
    for n in arguments.dimensions:
        measure(arguments.points, n, arguments.repeats)
