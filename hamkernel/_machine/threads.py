"""One thread for LAPACK while the library computes.

XLA's LAPACK on a CPU is SciPy's OpenBLAS, whose threads wait by spinning. Beside one busy process
on two cores a fit of 592 rows took 0.4 to 1 s with two threads and 8 to 13 ms with one, and alone
one is as fast: 88 ms and 76 ms to factor 2000 rows, 3.0 and 2.9 ms for 592
(`tests/benchmarks/busy.py`).
"""

import functools
import threading
from collections.abc import Callable
from contextlib import contextmanager
from typing import Any, ParamSpec, TypeVar

import jax

P = ParamSpec("P")
T = TypeVar("T")

_lock = threading.Lock()
_inside = 0  # calls that are going on, nested or of several threads
_limit: Any = None  # what restores the number of threads after the last of them


def one_blas_thread(function: Callable[P, T]) -> Callable[P, T]:
    """`function`, and its result computed, with one thread of BLAS; restored afterwards.

    Inside of the caller's own `jax.jit` nothing is computed while `function` runs, and nothing is
    changed: there OPENBLAS_NUM_THREADS=1 in the environment is the cure.
    """

    @functools.wraps(function)
    def limited(*args: P.args, **kwargs: P.kwargs) -> T:
        with _one_thread():
            return jax.block_until_ready(function(*args, **kwargs))

    return limited


@contextmanager
def _one_thread():
    global _inside, _limit
    with _lock:
        if _inside == 0:
            _limit = _controller().limit(limits=1, user_api="blas")
        _inside += 1
    try:
        yield
    finally:
        with _lock:
            _inside -= 1
            if _inside == 0:
                _limit.restore_original_limits()


@functools.cache
def _controller():
    import scipy.linalg  # noqa: F401  its OpenBLAS, which jaxlib would load at its first use
    from threadpoolctl import ThreadpoolController

    return ThreadpoolController()
