"""Fits to a stream: time and peak memory against the number of points.

    python tests/benchmarks/streaming.py [--points 1000000 10000000] [--solver nystrom features]

A pendulum (n = 2) at uniform states with 1 % noise, float64, made chunk by chunk and thrown away.
Each size runs in a process of its own, whose peak memory is what the system counts. The error is
that of the field at states without noise. First, 50 000 points in one call and as a stream.
"""

import argparse
import json
import resource
import subprocess
import sys
import time

import jax

jax.config.update("jax_enable_x64", True)

import numpy as np

import hamkernel as hk

KERNEL = hk.Symplectic(hk.Gaussian(1.5))
REGULARIZATION = 1e-5
SOLVERS = {"nystrom": hk.Nystrom(), "features": hk.RandomFeatures(64, jax.random.key(0))}


def states(count, rng):
    X = rng.uniform(-2, 2, size=(count, 2))
    return X, np.stack([X[:, 1], -np.sin(X[:, 0])], axis=1)


def chunks(points, size):
    rng = np.random.default_rng(0)
    for start in range(0, points, size):
        X, Y = states(min(size, points - start), rng)
        yield X, Y + 0.01 * Y.std() * rng.normal(size=Y.shape)


def gap(a, b):
    return float(np.linalg.norm(np.asarray(a) - b) / np.linalg.norm(b))


def measured(name, points, size):
    """What one process finds."""
    start = time.perf_counter()
    generated = sum(len(X) for X, _ in chunks(points, size))
    generation = time.perf_counter() - start
    assert generated == points
    solver = SOLVERS[name]
    solver.fit_chunks(KERNEL, chunks(size, size), REGULARIZATION)  # compiles
    start = time.perf_counter()
    field = jax.block_until_ready(
        solver.fit_chunks(KERNEL, chunks(points, size), REGULARIZATION, progress=True)
    )
    seconds = time.perf_counter() - start
    X, Y = states(1000, np.random.default_rng(1))
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024
    return {
        "seconds": seconds,
        "generation": generation,
        "peak": peak,
        "error": gap(field.evaluate(X), Y),
        "columns": int(field.info.rank) if name == "nystrom" else len(field.weights),
    }


def agreement(size):
    X, Y = (np.concatenate(parts) for parts in zip(*chunks(50_000, size), strict=True))
    new = states(1000, np.random.default_rng(1))[0]
    for name, solver in SOLVERS.items():
        one = hk.fit(KERNEL, X, Y, REGULARIZATION, solver=solver)
        stream = solver.fit_chunks(KERNEL, chunks(50_000, size), REGULARIZATION, sample=X)
        print(f"{name:9s} 50 000 points, stream against one call: ", end="")
        print(f"{gap(stream.evaluate(new), np.asarray(one.evaluate(new))):.1e}")


def main(arguments):
    agreement(arguments.chunk)
    for name in arguments.solver:
        for points in arguments.points:
            command = [sys.executable, __file__, "--measure", name, str(points)]
            command += ["--chunk", str(arguments.chunk)]
            done = subprocess.run(command, stdout=subprocess.PIPE, text=True, check=True)
            found = json.loads(done.stdout)
            print(
                f"{name:9s} {points:9d} points: {found['seconds']:7.1f} s, of which making the "
                f"data {found['generation']:5.1f} s; peak {found['peak'] / 1e9:.2f} GB; "
                f"{found['columns']} columns; error {found['error']:.1e}",
                flush=True,
            )


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--points", type=int, nargs="+", default=[1_000_000, 10_000_000])
    parser.add_argument("--solver", nargs="+", default=list(SOLVERS), choices=list(SOLVERS))
    parser.add_argument("--chunk", type=int, default=50_000)
    parser.add_argument("--measure", nargs=2, metavar=("SOLVER", "POINTS"), help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.measure:
        name, points = arguments.measure
        print(json.dumps(measured(name, int(points), arguments.chunk)))
    else:
        main(arguments)
