"""What other processes cost: fit, a loss and `tune` alone, and beside one and two busy ones.

    python tests/benchmarks/busy.py [--quick] [--threads]

A busy process spins on one core. Medians and maxima of 20 calls (5 of `tune`), in milliseconds, and
their ratio to the median alone. The column "threads" is the median alone, in turn with the other,
where the library leaves BLAS all its threads, as it would without `hamkernel/_machine.py`;
with --threads all columns are. Wanted on two cores: medians at most 2.5 times and maxima at most 6
times the median alone, and alone at most 1.15 times that with threads.
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
from hamkernel import _machine

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


def milliseconds(call) -> float:
    began = time.perf_counter()
    jax.block_until_ready(call())
    return 1e3 * (time.perf_counter() - began)


def free(call) -> float:
    """The same with all threads of BLAS."""
    limited, _machine._one_thread = _machine._one_thread, contextlib.nullcontext
    took = milliseconds(call)
    _machine._one_thread = limited
    return took


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
        _machine._one_thread = contextlib.nullcontext
    print(f"{'':<14}{'alone':>34}{'beside one':>30}{'beside two':>30}")
    print(
        f"{'N':>5} {'call':<8}"
        + f"{'median  maximum  threads   ratio':>34}"
        + f"{'median  maximum      ratios':>30}" * 2
    )
    for N in (100,) if options.quick else (24, 100, 300, 1000):
        for name, repeats, call in calls(N):
            if not (options.quick and name == "tune"):
                print(f"{N:>5} {name:<8}" + row(call, repeats), flush=True)


def row(call, repeats: int) -> str:
    call()
    pairs = [(milliseconds(call), free(call)) for _ in range(repeats)]
    took, with_threads = np.array(pairs).T
    alone, before = np.median(took), np.median(with_threads)
    line = f"{alone:9.2f}{took.max():9.2f}{before:9.2f}{alone / before:7.2f}"
    for count in (1, 2):
        with busy(count):
            took = np.array([milliseconds(call) for _ in range(repeats)])
        median, maximum = np.median(took), took.max()
        line += f"{median:9.2f}{maximum:9.2f}{median / alone:6.1f}{maximum / alone:6.1f}"
    return line


if __name__ == "__main__":
    main()
