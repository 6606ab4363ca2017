"""What a fit takes for how many points, in how many dimensions, on one core: docs/scale.md.

    python tests/benchmarks/scale.py [ranks] [speed] [eight]

n/2 pendulums at uniform states in [−2, 2]ⁿ, velocities with noise of 0.01, symplectic Gaussian of
lengthscale ℓ, float64. All of it runs on one core (on Linux), and seconds are those of the
processor, so that a busy machine changes little. `ranks`: landmarks that `Nystrom()` takes to its
tolerance where Nλ = 0.01, against N, n and ℓ. `speed`: seconds of a stream, a product and an exact
fit, and the model t = N n r (a + b r) of a stream, fitted. `eight`: error against seconds of
each solver for 5000 points with n = 8; it draws notebooks/figures/scale.png.
"""

import os
import sys
import time
from pathlib import Path

if hasattr(os, "sched_setaffinity"):
    os.sched_setaffinity(0, [max(os.sched_getaffinity(0))])

import jax

jax.config.update("jax_enable_x64", True)

import numpy as np

import hamkernel as hk

FIGURE = Path(__file__).parents[2] / "notebooks" / "figures" / "scale.png"


def swings(N, n, seed=0, noise=0.01):
    rng = np.random.default_rng(seed)
    X = rng.uniform(-2, 2, size=(N, n))
    q, p = X[:, : n // 2], X[:, n // 2 :]
    Y = np.concatenate([p, -np.sin(q) * (1 + q**2 / 4)], axis=1)
    return X, Y + noise * rng.normal(size=Y.shape)


def kernel(lengthscale):
    return hk.Symplectic(hk.Gaussian(lengthscale))


def seconds(function):
    """The result, and the processor's seconds of the second call, when all is compiled."""
    jax.block_until_ready(function())
    start = time.process_time()
    result = jax.block_until_ready(function())
    return result, time.process_time() - start


def ranks(most=500):
    print(f"landmarks of Nystrom() for Nλ = 0.01; at most {most}")
    for n, lengthscales in {
        2: (1.0, 2.0, 4.0),
        4: (2.0, 4.0),
        8: (4.0, 8.0),
        16: (8.0, 16.0),
    }.items():
        for scale in lengthscales:
            found = []
            for N in (1_000, 10_000, 100_000, 1_000_000)[: {2: 4, 4: 3}.get(n, 1)]:
                X, _ = swings(N, n)
                start = hk.Nystrom(max_points=most).start(kernel(scale), X, 0.01 / N)
                m = int(start.landmarks.count)
                found.append(f"{'>' if m >= most else ''}{m}")
            print(f"n = {n:2d}, lengthscale {scale:4.1f}: " + ", ".join(found), flush=True)


def speed():
    rows, times = [], []
    for n, scale, m, N in (
        (2, 1.5, 32, 100_000),
        (2, 1.5, 128, 20_000),
        (4, 2.5, 64, 20_000),
        (8, 4.0, 32, 10_000),
        (8, 4.0, 128, 4_000),
        (16, 8.0, 32, 4_000),
    ):
        X, Y = swings(N, n)
        model = hk.Nystrom(1e9, points=X[:m]).start(kernel(scale), X[:2000], 1e-6)
        _, t = seconds(lambda: model.add(X, Y))  # noqa: B023
        r = n * m
        rows.append([N * n * r, N * n * r**2])
        times.append(t)
        print(f"stream n = {n:2d}, r = {r:4d}: {N / t:9.0f} points/s", flush=True)
    weights = 1 / np.asarray(times)[:, None]
    (a, b), *_ = np.linalg.lstsq(np.asarray(rows) * weights, np.ones(len(times)), rcond=None)
    print(f"model: t = N n r ({a:.1e} s + r {b:.1e} s)")
    off = np.asarray(rows) @ [a, b] / times
    print("model / measured:", np.round(off, 2))
    for n, N in ((2, 8000), (4, 4000), (8, 4000), (16, 2000)):
        X, Y = swings(N, n)
        _, t = seconds(lambda: hk.gram_operator(kernel(4.0), X).mv(Y))  # noqa: B023
        print(f"product n = {n:2d}: {t / (N * n) ** 2:.1e} s (N n)²", flush=True)
    X, Y = swings(500, 8)
    _, t = seconds(lambda: hk.fit(kernel(4.0), X, Y, 1e-6))
    print(f"exact fit: {t / 4000**3:.1e} s (N n)³", flush=True)


def eight(N=5_000, scale=5.0, regularization=1e-8):
    X, Y = swings(N, 8)
    Z, true = swings(1000, 8, seed=1, noise=0.0)
    K, key, found = kernel(scale), jax.random.key(0), {}

    def streamed(solver):
        return solver.start(K, X[:2000], regularization).add(X, Y).field()

    def case(name, label, fit, at_once=False):
        start = time.process_time()
        field = jax.block_until_ready(fit())
        t = time.process_time() - start
        if not at_once:
            field, t = seconds(fit)
        error = float(np.linalg.norm(np.asarray(field.evaluate(Z)) - true) / np.linalg.norm(true))
        found.setdefault(name, []).append((t, error, label))
        print(f"{name} {label}: {t:.1f} s, error {error:.1e}; {field.info.solver}", flush=True)

    for part in (125, 250, 500, 800):
        ridge = regularization * N / part
        case("exact, a part", part, lambda: hk.fit(K, X[:part], Y[:part], ridge))  # noqa: B023
    for m in (16, 32, 64, 128):
        case("Nystrom", m, lambda: streamed(hk.Nystrom(max_points=m)))  # noqa: B023
    for count in (64, 128, 256, 512):
        case("RandomFeatures", count, lambda: streamed(hk.RandomFeatures(count, key)))  # noqa: B023
    for tolerance in (1e-1, 1e-2):

        def iterated(solver=hk.ConjugateGradient(tolerance)):  # noqa: B008
            return hk.fit(K, X, Y, regularization, solver=solver)

        case("ConjugateGradient", tolerance, iterated, at_once=True)
    draw(found)


def draw(found):
    from matplotlib.figure import Figure

    figure = Figure(figsize=(7.0, 3.8), layout="constrained", facecolor="white")
    ax = figure.subplots()
    colors = "#0072B2", "#D55E00", "#009E73", "#CC79A7"
    for (name, points), color in zip(found.items(), colors, strict=True):
        ts, errors, _ = zip(*points, strict=True)
        ax.loglog(ts, errors, "o-", color=color, label=name)
        for t, error, label in points:
            ax.annotate(f" {label}", (t, error), fontsize=8, color=color)
    ax.set(xlabel="seconds on one core", ylabel="relative error of the field")
    ax.set_title("5000 points, n = 8, noise 0.01", fontsize=10)
    ax.grid(alpha=0.3)
    ax.legend(frameon=False, fontsize=9)
    figure.savefig(FIGURE, dpi=150)


if __name__ == "__main__":
    import warnings

    warnings.filterwarnings("ignore", message=".*landmarks leave")
    for name in sys.argv[1:] or ["ranks", "speed", "eight"]:
        {"ranks": ranks, "speed": speed, "eight": eight}[name]()
