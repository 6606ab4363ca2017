"""The table of `docs/speed.md`, every time that is said anywhere, against the peers in one run.

    python tests/benchmarks/speed.py [--figure cost.png] [--quick]

float64, warm, in one process, peers in turn: the minimum and the median over repeats, never a
single run. Same work and same precision; the results are checked to agree first. A peer that is not
installed (`pip install hamkernel[benchmarks]`) is reported as missing. `--quick` omits what takes
minutes. A target is a ratio of minima in this run, printed with "met" or "MISSED" and the ratio of
medians. The environment matters to all of them: see `docs/speed.md`.
"""

import argparse
import datetime
import os
import platform
import subprocess
import sys
import tempfile
from collections.abc import Callable
from time import perf_counter
from typing import Any

import jax

jax.config.update("jax_enable_x64", True)

import jax.export
import jax.numpy as jnp
import numpy as np
import products
import scipy.linalg
from products import KERNELS, SIGMA
from solvers import data
from timing import Timed, environment, in_turn, timed

import hamkernel as hk

ROUNDING = 1e-11


def line(name: str, time: Timed, remark: str = "") -> None:
    least, median = time.least * 1e3, time.median * 1e3
    print(f"  {name:44s} {least:10.2f} ms {median:10.2f} ms  {remark}", flush=True)


def at_least(target: float, peer: Timed, ours: Timed) -> str:
    """How many times faster ours is, and whether that is enough."""
    return _verdict(peer, ours, f">= {target:g}", peer.least / ours.least >= target)


def at_most(target: float, ours: Timed, other: Timed) -> str:
    """How many times longer ours takes, and whether that is too long."""
    return _verdict(ours, other, f"<= {target:g}", ours.least / other.least <= target)


def _verdict(above: Timed, below: Timed, target: str, met: bool) -> str:
    ratio, of_medians = above.least / below.least, above.median / below.median
    return f"{ratio:.2f} ({target}: {'met' if met else 'MISSED'}; medians {of_medians:.2f})"


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
    points, closed = jnp.asarray(X), closed_blocks(X)
    out, own = np.empty_like(closed), hk.Symplectic(dot_product_gaussian)
    in_place = hk.gram(KERNELS["Gaussian"], points)
    once_more = jax.jit(lambda G: G + 1.0)
    runs: dict[str, Callable[[], Any]] = {
        "hamkernel": lambda: hk.gram(KERNELS["Gaussian"], points),
        "NumPy closed form, block by block": lambda: closed_blocks(X),
        "NumPy closed form, in the order of memory": lambda: closed_gram(X),
        "NumPy copy into memory in use": lambda: np.copyto(out, closed),
        # What XLA needs to hand out a result of this size: fresh memory.
        "G + 1 by XLA, into fresh memory": lambda: once_more(in_place),
        "a user's callable with dot products": lambda: hk.gram(own, points),
        "odd symplectic": lambda: hk.gram(KERNELS["odd Gaussian"], points),
    }
    try:
        runs["GPyTorch RBFKernelGrad (curl-free)"] = gpytorch_gram(X)
    except ImportError:
        print("  gpytorch is not installed")

    def agree(results: dict[str, Any]) -> None:
        ours, _, ordered, _, _, user, _, *torch = results.values()
        for each in (ours, ordered, user):
            np.testing.assert_allclose(each, closed, atol=ROUNDING)
        for blocks in torch:
            # Ordered (point, value or derivative), with the values besides.
            theirs = blocks.numpy().reshape(N, n + 1, N, n + 1)[:, 1:, :, 1:]
            curl_free = hk.gram(hk.CurlFree(hk.Gaussian(SIGMA)), X)
            np.testing.assert_allclose(theirs, curl_free, atol=1e-6)

    times = in_turn(repeats, runs, agree)
    ours, blocks, ordered, copy, fresh, user, odd, *torch = times.values()
    remarks = [
        "",
        f"{at_least(20, blocks, ours)} times ours",
        f"{at_least(20, ordered, ours)} times ours",
        f"ours: {at_most(5, ours, copy)}",
        f"ours: {ours.least / fresh.least:.2f} times",
        f"{at_least(7, ordered, user)} faster than NumPy",
        f"{at_most(2, odd, ours)} times symplectic",
    ]
    remarks += [f"{at_least(25, each, ours)} times ours" for each in torch]
    for (name, time), remark in zip(times.items(), remarks, strict=True):
        line(name, time, remark)


def product_section(N: int) -> None:
    for n, target, repeats in ((4, 3, 9), (20, 4, 3)):
        print(f"\nProduct with the Gram of {N * n} rows, never formed: N = {N}, n = {n}")
        times = products.measured(N, n, repeats)
        base = times[products.OURS]
        for name, time in times.items():
            if name == products.PEER:
                remark = f"{at_least(target, time, base)} times ours"
            else:
                remark = "" if time is base else f"{at_most(2.5, time, base)} times"
            line(name, time, remark)


def fit_section(repeats: int) -> None:
    N, n, regularization = 1000, 4, 1e-4
    print(f"\nExact fit, Nn = {N * n}")
    X, Y = data(N, n)
    K, solver = hk.Symplectic(hk.Gaussian(2.0)), hk.Cholesky()
    G = np.asarray(hk.gram(K, X)).reshape(N * n, N * n)
    A = G + N * regularization * np.eye(N * n)
    y = np.asarray(Y).ravel()
    runs: dict[str, Callable[[], Any]] = {
        "SciPy cho_factor + cho_solve, matrix ready": lambda: scipy.linalg.cho_solve(
            scipy.linalg.cho_factor(A), y
        ),
        "hamkernel fit, assembly included": lambda: hk.fit(K, X, Y, regularization, solver=solver),
    }
    try:
        from sklearn.kernel_ridge import KernelRidge  # pyright: ignore[reportMissingImports]
    except ImportError:
        print("  scikit-learn is not installed")
    else:
        ridge = KernelRidge(alpha=N * regularization, kernel="precomputed")
        runs["scikit-learn KernelRidge, matrix ready"] = lambda: ridge.fit(G, y).dual_coef_

    def agree(results: dict[str, Any]) -> None:
        expected, *others = results.values()
        for each in others:
            found = np.ravel(getattr(each, "coefficients", each))
            np.testing.assert_allclose(found, expected, rtol=1e-5, atol=1e-5 * np.abs(y).max())

    times = in_turn(repeats, runs, agree)
    scipy_time, ours, *_ = times.values()
    for name, time in times.items():
        line(name, time, f"{at_most(1.3, ours, scipy_time)} times SciPy" if time is ours else "")


def nystrom_section(large: bool) -> None:
    print("\nLow rank, n = 2, noise 1 %")
    K, regularization = hk.Symplectic(hk.Gaussian(1.5)), 1e-5
    X, Y = data(2000, 2)
    runs = {
        type(solver).__name__: lambda solver=solver: hk.fit(K, X, Y, regularization, solver=solver)
        for solver in (hk.Cholesky(), hk.Nystrom())
    }
    slow, fast = in_turn(9, runs).values()
    new = 0.95 * data(500, 2)[0]
    exact, low = slow.result.evaluate(new), fast.result.evaluate(new)
    off = float(jnp.linalg.norm(low - exact) / jnp.linalg.norm(exact))
    line("Cholesky, N = 2000", slow)
    line("Nystrom, N = 2000", fast, f"{at_least(10, slow, fast)} faster, {off:.1e} from exact")
    sizes = [100_000, 1_000_000] if large else [10_000, 100_000]
    least = []
    for N in sizes:
        X, Y = data(N, 2)
        run = lambda X=X, Y=Y: hk.fit(K, X, Y, regularization, solver=hk.Nystrom())  # noqa: E731
        time = timed(run, 2)
        least.append(time.least)
        line(f"Nystrom, N = {N}", time)
    slope = float(np.log10(least[1] / least[0]))
    print(f"  log-log slope {slope:.2f} (<= 1.1: {'met' if slope <= 1.1 else 'MISSED'})")


def high_dimension_section() -> None:
    N, n = 300, 8
    print(f"\nn = {n}, where the rank is high: N = {N}, noise 1 %")
    K, regularization = hk.Symplectic(hk.Gaussian(3.0)), 1e-5
    X, Y = data(N, n)
    runs = {
        type(solver).__name__: lambda solver=solver: hk.fit(K, X, Y, regularization, solver=solver)
        for solver in (hk.Cholesky(), hk.Nystrom())
    }
    exact, low = in_turn(3, runs).values()
    line("Cholesky", exact)
    rank, ratio = int(low.result.info.rank), low.least / exact.least
    line("Nystrom", low, f"rank {rank} of {N * n}, {ratio:.1f} times Cholesky")


def iterative_section() -> None:
    print("\nConjugate gradients preconditioned by landmarks, residual 1e-6")
    for N, n, sigma in ((20_000, 4, 2.0), (10_000, 8, 3.0)):
        X, Y = data(N, n)
        K = hk.Symplectic(hk.Gaussian(sigma))
        run = lambda: hk.fit(K, X, Y, 1e-4, solver=hk.ConjugateGradient(1e-6))  # noqa: E731, B023
        start = perf_counter()
        info: Any = jax.block_until_ready(run()).info
        seconds = perf_counter() - start
        done = f"{int(info.iterations)} iterations, residual {float(info.relative_residual):.1e}"
        line(f"N = {N}, n = {n}, compilation included", Timed(seconds, seconds), done)


FRESH = """
import jax; jax.config.update("jax_enable_x64", True)
import numpy as np, hamkernel as hk
X, Y = np.random.default_rng(0).normal(size=(2, 24, 2))
K = hk.Odd(hk.Symplectic(hk.Gaussian(1.0)))
"""


# XLA sends each fusion through a pipeline of MLIR, which takes half of the time of compilation.
FEWER_PASSES = "--xla_cpu_use_fusion_emitters=false"


def process_section() -> None:
    print("\nFresh processes")

    def fresh(code: str, **variables: str) -> Callable[[], Any]:
        env = os.environ | variables
        # Else a package that pip has not compiled is compiled by every process.
        env.pop("PYTHONDONTWRITEBYTECODE", None)
        return lambda: subprocess.run([sys.executable, "-c", code], check=True, env=env)

    tuning = FRESH + "hk.tune(K, X, Y)"
    with tempfile.TemporaryDirectory() as folder:
        kept = {
            "JAX_COMPILATION_CACHE_DIR": folder,
            "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0",
        }
        runs = {
            "import jax, equinox, optimistix": fresh("import jax, equinox, optimistix"),
            "import hamkernel": fresh("import hamkernel"),
            "import, first fit, first value, N = 24": fresh(FRESH + "hk.fit(K, X, Y, 1e-3)(X[0])"),
            "import, first tune, N = 24": fresh(tuning),
            "the same, compiled by a process before": fresh(tuning, **kept),
            "the same, compiled without fusion emitters": fresh(tuning, XLA_FLAGS=FEWER_PASSES),
        }
        times = in_turn(9, runs)
    stack, ours, first, *_ = times.values()
    met = "met" if first.least <= 4 else "MISSED"
    remarks = ("", f"{at_most(1.3, ours, stack)} times", f"<= 4 s: {met}", "", "", "")
    for (name, time), remark in zip(times.items(), remarks, strict=True):
        line(name, time, remark)


def field_section() -> None:
    """What a controller pays in each of its steps, mostly the overhead of dispatch."""
    print("\nOne call of a field, one state, odd symplectic Gaussian, n = 2")
    system, x, calls = hk.systems.Pendulum(mass=1.0), jnp.array([0.5, 0.3]), 200

    def many(fn):
        for _ in range(calls):
            jax.block_until_ready(fn(x))

    for N in (24, 1000):
        X = jax.random.normal(jax.random.key(0), (N, 2))
        field = hk.fit(hk.Odd(hk.Symplectic(hk.Gaussian(3.0))), X, jax.vmap(system)(X), 1e-6)
        exported = jax.export.export(jax.jit(field))(jax.ShapeDtypeStruct((2,), float))
        runs = {"compiled": jax.jit(field), "exported": jax.jit(exported.call)}
        for name, fn in runs.items():
            time = timed(lambda fn=fn: many(fn), 7)
            each = f"{1e6 * time.least / calls:.1f} µs a call"
            line(f"{calls} calls, {name}, N = {N}", time, each)


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
            least.append(timed(lambda run=run, X=X, Y=Y: run(X, Y), 3).least)
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
    print(environment())
    print(f"  {'':44s} {'minimum':>13s} {'median':>13s}")
    process_section()
    field_section()
    gram_section(repeats=9)
    product_section(4000 if quick else 20_000)
    fit_section(repeats=9)
    nystrom_section(large=not quick)
    high_dimension_section()
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
