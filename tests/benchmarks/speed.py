"""All that the README says of speed, against the peers, in one run.

    python tests/benchmarks/speed.py [--figure speed.png] [--quick]

float64, warm, in one process: the minimum and the median over repeats, never a single run. Same
work and same precision; that the results agree is checked before anything is timed. A peer that
is not installed (`pip install hamkernel[benchmarks]`) is said to be missing. `--quick` leaves out
what takes minutes. A target is a ratio of minima in this run; "met" or "MISSED" stands beside it.
"""

import argparse
import datetime
import os
import platform
import subprocess
import sys
import time
from collections.abc import Callable
from typing import Any

import jax

jax.config.update("jax_enable_x64", True)

import jax.numpy as jnp
import numpy as np
import scipy.linalg
from products import KERNELS, SIGMA, keops, timed
from solvers import data

import hamkernel as hk

ROUNDING = 1e-11


def line(name: str, least: float, median: float, remark: str = "") -> None:
    print(f"  {name:44s} {least * 1e3:10.2f} ms {median * 1e3:10.2f} ms  {remark}", flush=True)


def verdict(ratio: float, target: float, at_least: bool) -> str:
    met = ratio >= target if at_least else ratio <= target
    sign = ">=" if at_least else "<="
    return f"{ratio:.2f} ({sign} {target:g}: {'met' if met else 'MISSED'})"


def measured(run: Callable[[], Any], repeats: int) -> tuple[Any, float, float]:
    return timed(lambda: jax.block_until_ready(run()), repeats)


def dot_product_gaussian(x: jax.Array, z: jax.Array) -> jax.Array:
    """As a user would write it."""
    return jnp.exp(-(x @ x + z @ z - 2 * x @ z) / (2 * SIGMA**2))


def closed_blocks(X: np.ndarray) -> np.ndarray:
    """J (−∇∇ᵀg) Jᵀ for the Gaussian g of all pairs, as the formula reads, (N, n, N, n)."""
    d = X[:, None] - X[None]  # (N, N, n)
    g = np.exp(-np.sum(d**2, axis=-1) / (2 * SIGMA**2))[..., None, None]
    J = symplectic_matrix(X.shape[1])
    M = g * (np.eye(len(J)) / SIGMA**2 - d[..., :, None] * d[..., None, :] / SIGMA**4)
    return np.ascontiguousarray((J @ M @ J.T).transpose(0, 2, 1, 3))


def closed_gram(X: np.ndarray) -> np.ndarray:
    """The same in the order of the result, which spares NumPy the products of small matrices."""
    d = X[:, None] - X[None]
    g = np.exp(-np.einsum("nma,nma->nm", d, d) / (2 * SIGMA**2))
    J = symplectic_matrix(X.shape[1])
    outer = np.einsum("nma,nmb->namb", d, d) / SIGMA**4
    M = g[:, None, :, None] * (np.eye(len(J))[None, :, None, :] / SIGMA**2 - outer)
    return np.einsum("ab,ibjc,dc->iajd", J, M, J, optimize=True)


def symplectic_matrix(n: int) -> np.ndarray:
    return np.kron([[0.0, 1.0], [-1.0, 0.0]], np.eye(n // 2))


def gpytorch_gram(X: np.ndarray) -> Callable[[], Any]:
    import torch  # pyright: ignore[reportMissingImports]
    from gpytorch.kernels import RBFKernelGrad  # pyright: ignore[reportMissingImports]

    kernel = RBFKernelGrad().double()
    kernel.lengthscale = SIGMA
    points = torch.tensor(X)

    def run() -> Any:
        with torch.no_grad():
            return kernel(points).to_dense()

    return run


def gram_section(repeats: int) -> None:
    N, n = 1000, 4
    print(f"\nDense Gram, Gaussian symplectic, N = {N}, n = {n}")
    X = np.random.default_rng(0).normal(size=(N, n))
    K = KERNELS["Gaussian"]
    points = jnp.asarray(X)
    G, ours, median = measured(lambda: hk.gram(K, points), repeats)
    line("hamkernel", ours, median)
    for name, form in (
        ("NumPy closed form, block by block", closed_blocks),
        ("NumPy closed form, in the order of memory", closed_gram),
    ):
        closed, numpy, numpy_median = measured(lambda form=form: form(X), 3)
        np.testing.assert_allclose(G, closed, atol=ROUNDING)
        line(name, numpy, numpy_median, f"{verdict(numpy / ours, 20, True)} times ours")
    try:
        blocks, torch, torch_median = measured(gpytorch_gram(X), 3)
    except ImportError:
        print("  gpytorch is not installed")
    else:
        # Its entries are ordered (point, value or derivative), and hold the values besides.
        theirs = blocks.numpy().reshape(N, n + 1, N, n + 1)[:, 1:, :, 1:]
        np.testing.assert_allclose(theirs, hk.gram(hk.CurlFree(hk.Gaussian(SIGMA)), X), atol=1e-6)
        ratio = verdict(torch / ours, 25, True)
        line("GPyTorch RBFKernelGrad (curl-free)", torch, torch_median, f"{ratio} times ours")
    out = np.empty_like(closed)
    _, copy, copy_median = measured(lambda: np.copyto(out, closed), repeats)
    line(
        "NumPy copy into memory in use",
        copy,
        copy_median,
        f"ours: {verdict(ours / copy, 5, False)}",
    )
    # What XLA needs to hand out a result of this size: fresh pages, one by one.
    once_more = jax.jit(lambda G: G + 1.0)
    _, fresh, fresh_median = measured(lambda: once_more(G), repeats)
    line("G + 1 by XLA, into fresh memory", fresh, fresh_median, f"ours: {ours / fresh:.2f} times")
    own = hk.Symplectic(dot_product_gaussian)
    np.testing.assert_allclose(hk.gram(own, points), closed, atol=ROUNDING)
    _, user, user_median = measured(lambda: hk.gram(own, points), repeats)
    ratio = verdict(numpy / user, 7, True)
    line("a user's callable with dot products", user, user_median, f"{ratio} faster than NumPy")
    _, odd, odd_median = measured(lambda: hk.gram(KERNELS["odd Gaussian"], points), repeats)
    line("odd symplectic", odd, odd_median, f"{verdict(odd / ours, 2, False)} times symplectic")


def product_section(N: int, repeats: int) -> None:
    for n, target in ((4, 3), (20, 4)):
        print(f"\nProduct with the Gram of {N * n} rows, never formed: N = {N}, n = {n}")
        rng = np.random.default_rng(0)
        X, A = rng.normal(size=(N, n)), rng.normal(size=(N, n))
        times = {}
        for name, K in KERNELS.items():
            operator = hk.gram_operator(K, X)
            vector = jnp.asarray(A)
            times[name] = measured(lambda op=operator, v=vector: op.mv(v), repeats)
        base = times["Gaussian"][1]
        for name, (_, least, median) in times.items():
            remark = "" if name == "Gaussian" else f"{verdict(least / base, 2.5, False)} times"
            line(f"hamkernel {name}", least, median, remark)
        try:
            theirs, least, median = timed(keops(X, A), repeats)
        except ImportError:
            print("  pykeops is not installed")
            continue
        np.testing.assert_allclose(times["Gaussian"][0], theirs, atol=1e-8)
        line("KeOps, formula by hand", least, median, f"{verdict(least / base, target, True)} ours")


def fit_section(repeats: int) -> None:
    N, n, regularization = 1000, 4, 1e-4
    print(f"\nExact fit, Nn = {N * n}")
    X, Y = data(N, n)
    K = hk.Symplectic(hk.Gaussian(2.0))
    A = np.asarray(hk.gram(K, X)).reshape(N * n, N * n) + N * regularization * np.eye(N * n)
    y = np.asarray(Y).ravel()

    def scipy_solve() -> np.ndarray:
        return scipy.linalg.cho_solve(scipy.linalg.cho_factor(A), y)

    expected, scipy_least, scipy_median = timed(scipy_solve, repeats)
    solver = hk.Cholesky()
    run = lambda: hk.fit(K, X, Y, regularization, solver=solver)  # noqa: E731
    field, least, median = measured(run, repeats)
    found = field.coefficients
    np.testing.assert_allclose(found.ravel(), expected, rtol=1e-5, atol=1e-5 * np.abs(y).max())
    line("SciPy cho_factor + cho_solve, matrix ready", scipy_least, scipy_median)
    ratio = verdict(least / scipy_least, 1.3, False)
    line("hamkernel fit, assembly included", least, median, f"{ratio} times SciPy")
    try:
        from sklearn.kernel_ridge import KernelRidge  # pyright: ignore[reportMissingImports]
    except ImportError:
        print("  scikit-learn is not installed")
        return
    G = A - N * regularization * np.eye(N * n)
    ridge = KernelRidge(alpha=N * regularization, kernel="precomputed")
    _, sklearn, sklearn_median = timed(lambda: ridge.fit(G, y), repeats)
    line("scikit-learn KernelRidge, matrix ready", sklearn, sklearn_median)


def nystrom_section(large: bool) -> None:
    print("\nLow rank, n = 2, noise 1 %")
    K, regularization = hk.Symplectic(hk.Gaussian(1.5)), 1e-5
    X, Y = data(2000, 2)
    fields, times = {}, {}
    for solver in (hk.Cholesky(), hk.Nystrom()):
        run = lambda solver=solver: hk.fit(K, X, Y, regularization, solver=solver)  # noqa: E731
        name = type(solver).__name__
        fields[name], *times[name] = measured(run, 5)
    new = 0.95 * data(500, 2)[0]
    exact, low = (fields[name].evaluate(new) for name in ("Cholesky", "Nystrom"))
    off = float(jnp.linalg.norm(low - exact) / jnp.linalg.norm(exact))
    (slow, slow_median), (fast, fast_median) = times["Cholesky"], times["Nystrom"]
    line("Cholesky, N = 2000", slow, slow_median)
    ratio = verdict(slow / fast, 10, True)
    line("Nystrom, N = 2000", fast, fast_median, f"{ratio} faster, {off:.1e} from exact")
    sizes = [100_000, 1_000_000] if large else [10_000, 100_000]
    least = []
    for N in sizes:
        X, Y = data(N, 2)
        run = lambda X=X, Y=Y: hk.fit(K, X, Y, regularization, solver=hk.Nystrom())  # noqa: E731
        _, *seconds = measured(run, 2)
        least.append(seconds[0])
        line(f"Nystrom, N = {N}", seconds[0], seconds[1])
    print(f"  log-log slope {verdict(float(np.log10(least[1] / least[0])), 1.1, False)}")


def iterative_section() -> None:
    print("\nConjugate gradients preconditioned by landmarks, residual 1e-6")
    for N, n, sigma in ((20_000, 4, 2.0), (10_000, 8, 3.0)):
        X, Y = data(N, n)
        K = hk.Symplectic(hk.Gaussian(sigma))
        run = lambda: hk.fit(K, X, Y, 1e-4, solver=hk.ConjugateGradient(1e-6))  # noqa: E731, B023
        start = time.perf_counter()
        info: Any = jax.block_until_ready(run()).info
        seconds = time.perf_counter() - start
        done = f"{int(info.iterations)} iterations, residual {float(info.relative_residual):.1e}"
        line(f"N = {N}, n = {n}, compilation included", seconds, seconds, done)


def process_section() -> None:
    print("\nFresh processes")

    def fresh(code: str) -> float:
        seconds = []
        for _ in range(5):
            start = time.perf_counter()
            subprocess.run([sys.executable, "-c", code], check=True)
            seconds.append(time.perf_counter() - start)
        return min(seconds)

    stack = fresh("import jax, equinox, optimistix")
    ours = fresh("import hamkernel")
    line("import jax, equinox, optimistix", stack, stack)
    line("import hamkernel", ours, ours, f"{verdict(ours / stack, 1.3, False)} times")
    first = fresh(
        "import jax; jax.config.update('jax_enable_x64', True)\n"
        "import numpy as np, hamkernel as hk\n"
        "X, Y = np.random.default_rng(0).normal(size=(2, 24, 2))\n"
        "f = hk.fit(hk.Odd(hk.Symplectic(hk.Gaussian(1.0))), X, Y, 1e-3); f(X[0])"
    )
    line("import, first fit, first value, N = 24", first, first, verdict(first, 4, False) + " s")


def figure_section(path: str) -> None:
    from matplotlib.figure import Figure

    print("\nCost against N, Gaussian symplectic")
    K = hk.Symplectic(hk.Gaussian(1.5))

    def gram(X, Y):
        return hk.gram(K, X)

    def product(X, Y):
        return hk.gram_operator(K, X).mv(Y)

    def solved(solver):
        return lambda X, Y: hk.fit(K, X, Y, 1e-4, solver=solver)

    curves = {
        "dense Gram, n = 4": (gram, 4, [125, 250, 500, 1000, 2000]),
        "product, n = 4": (product, 4, [500, 1000, 2000, 4000, 8000, 16_000]),
        "Cholesky fit, n = 2": (solved(hk.Cholesky()), 2, [125, 250, 500, 1000, 2000, 4000]),
        "Nystrom fit, n = 2": (solved(hk.Nystrom()), 2, [1000, 10_000, 100_000, 1_000_000]),
    }
    figure = Figure(figsize=(8, 4.5), layout="constrained")
    ax = figure.subplots()
    for name, (run, n, sizes) in curves.items():
        least = []
        for N in sizes:
            X, Y = data(N, n)
            least.append(measured(lambda run=run, X=X, Y=Y: run(X, Y), 3)[1])
        slope = np.polyfit(np.log(sizes[-3:]), np.log(least[-3:]), 1)[0]
        label = f"{name}: slope {slope:.2f}"
        print(f"  {label}")
        ax.loglog(sizes, least, "o-", label=label)
    ax.set_xlabel("number of points N")
    ax.set_ylabel("time (s)")
    ax.grid(alpha=0.3)
    ax.legend(title="slope over the last three", fontsize=9)
    figure.savefig(path, dpi=150)


def main(figure: str | None, quick: bool) -> None:
    print(f"{datetime.date.today()}, {platform.processor() or platform.machine()}, ", end="")
    print(f"{os.cpu_count()} cores, load {os.getloadavg()[0]:.1f}; ", end="")
    print(f"Python {platform.python_version()}, jax {jax.__version__} on {jax.default_backend()}")
    print(f"  {'':44s} {'minimum':>13s} {'median':>13s}")
    process_section()
    gram_section(repeats=9)
    product_section(4000 if quick else 20_000, repeats=3)
    fit_section(repeats=5)
    nystrom_section(large=not quick)
    if not quick:
        iterative_section()
    if figure:
        figure_section(figure)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--figure", help="also draw the cost against N into this file")
    parser.add_argument("--quick", action="store_true")
    arguments = parser.parse_args()
    main(arguments.figure, arguments.quick)
