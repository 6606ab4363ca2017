"""What other processes cost: fit, a loss and `tune` alone, and beside one and two busy ones.

    python tests/benchmarks/busy.py [--quick] [--threads]

A busy process spins on one core. Medians and maxima of 20 calls (5 of `tune`), in milliseconds, and
their ratio to the median alone. With --threads the library leaves BLAS all its threads, as it
would without `hamkernel/_machine/threads.py`. Wanted on two cores: medians at most 2.5 times and
maxima at most 6 times the median alone.
"""

import argparse
import contextlib
import subprocess
import sys
import time

import jax

jax.config.update("jax_enable_x64", True)

import numpy as np

import hamkernel as hk
from hamkernel._machine import threads

K = hk.Symplectic(hk.Gaussian(1.0))
CALLS, SEARCHES = 20, 5


def pendulum(N: int) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(N)
    X = rng.uniform(-2, 2, size=(N, 2))
    return X, np.stack([X[:, 1], -np.sin(X[:, 0])], axis=1) + 0.05 * rng.normal(size=X.shape)


@contextlib.contextmanager
def busy(count: int):
    """So many processes that spin."""
    spin = [sys.executable, "-c", "while True: pass"]
    processes = [subprocess.Popen(spin) for _ in range(count)]
    try:
        yield
    finally:
        for process in processes:
            process.kill()


def seconds(call, repeats: int) -> list[float]:
    found = []
    for _ in range(repeats):
        began = time.perf_counter()
        jax.block_until_ready(call())
        found.append(time.perf_counter() - began)
    return found


def calls(N: int):
    X, Y = pendulum(N)
    yield "fit", CALLS, lambda: hk.fit(K, X, Y, 1e-3).coefficients
    yield "loss", CALLS, lambda: hk.cross_validation_loss(K, X, Y, 1e-3, 5)
    yield "tune", SEARCHES, lambda: hk.tune(K, X, Y, folds=5).loss


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--quick", action="store_true", help="N = 100 only, without tune")
    parser.add_argument("--threads", action="store_true", help="leave BLAS its threads")
    options = parser.parse_args()
    if options.threads:
        threads._one_thread = contextlib.nullcontext
    print(f"{'':<14}{'alone':>18}{'beside one':>30}{'beside two':>30}")
    print(
        f"{'N':>5} {'call':<8}"
        + f"{'median  maximum':>18}"
        + f"{'median  maximum      ratios':>30}" * 2
    )
    for N in (100,) if options.quick else (24, 100, 300, 1000):
        for name, repeats, call in calls(N):
            if options.quick and name == "tune":
                continue
            call()
            alone, line = None, f"{N:>5} {name:<8}"
            for count in (0, 1, 2):
                with busy(count):
                    took = 1e3 * np.array(seconds(call, repeats))
                median, maximum = np.median(took), took.max()
                alone = median if alone is None else alone
                line += f"{median:9.1f}{maximum:9.1f}"
                line += f"{median / alone:6.1f}{maximum / alone:6.1f}" if count else ""
            print(line, flush=True)


if __name__ == "__main__":
    main()
