"""Products with the Gram of a symplectic kernel, against KeOps with a hand-written formula.

    python tests/benchmarks/products.py [--points 20000] [--dimensions 4 20] [--repeats 9]

float64, warm, in one process and in turn: the minimum and the median over repeats, nanoseconds per
pair of points, and the ratios of minima and of medians. The results are first checked to agree
with some rows in NumPy, and with KeOps where it is installed (`pip install hamkernel[benchmarks]`).
KeOps compiles its formula at the first call, which is not timed.
"""

import argparse
from collections.abc import Callable
from typing import Any

import jax

jax.config.update("jax_enable_x64", True)

import jax.numpy as jnp
import numpy as np
from timing import Timed, in_turn

import hamkernel as hk

SIGMA = 1.3
AGREEMENT = 1e-8  # of sums of 20 000 terms of order one


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
OURS, PEER = "hamkernel Gaussian", "KeOps Gaussian, formula by hand"


def compared(X: np.ndarray, A: np.ndarray) -> dict[str, Callable[[], Any]]:
    """The products to compare; that of KeOps if it is installed."""
    coefficients = jnp.asarray(A)
    operators = {name: hk.gram_operator(K, X) for name, K in KERNELS.items()}
    runs: dict[str, Callable[[], Any]] = {
        f"hamkernel {name}": lambda operator=operator: operator.mv(coefficients)
        for name, operator in operators.items()
    }
    try:
        runs[PEER] = keops(X, A)
    except ImportError:
        print("  pykeops is not installed: pip install hamkernel[benchmarks]")
    return runs


def measured(N: int, n: int, repeats: int) -> dict[str, Timed]:
    """The times of all products, of which those of the Gaussian are seen to agree first."""
    rng = np.random.default_rng(0)
    X, A = rng.normal(size=(N, n)), rng.normal(size=(N, n))
    rows = [0, N // 2, N - 1]
    expected = closed_form(X[rows], X, A)

    def agree(results: dict[str, Any]) -> None:
        ours = np.asarray(results[OURS])
        np.testing.assert_allclose(ours[rows], expected, rtol=0, atol=AGREEMENT)
        np.testing.assert_allclose(results.get(PEER, ours), ours, rtol=0, atol=AGREEMENT)

    return in_turn(repeats, compared(X, A), agree)


def report(N: int, n: int, repeats: int) -> None:
    times = measured(N, n, repeats)
    base = times[OURS]
    print(f"\nN = {N}, n = {n}: product with the ({N * n}, {N * n}) Gram")
    print(f"  {'':34s} {'minimum':>10s} {'median':>10s} {'ns/pair':>8s} {'ratios':>12s}")
    for name, each in times.items():
        seconds = f"{each.least:8.3f} s {each.median:8.3f} s {each.least / N**2 * 1e9:8.2f}"
        ratios = f"{each.least / base.least:6.2f} {each.median / base.median:5.2f}"
        print(f"  {name:34s} {seconds} {ratios}", flush=True)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--points", type=int, default=20_000)
    parser.add_argument("--dimensions", type=int, nargs="+", default=[4, 20])
    parser.add_argument("--repeats", type=int, default=9)
    arguments = parser.parse_args()
    for n in arguments.dimensions:
        report(arguments.points, n, arguments.repeats)
