"""Seconds of what is compared, measured in turn: what slows the machine slows it all."""

import os
import time
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import jax
import numpy as np

# Threads of OpenBLAS keep a core busy for 2²⁶ cycles after their work: not on the time of the next.
_PAUSE = 0.1


def environment() -> str:
    """What changes the times of all: how memory is handed out, how long idle threads stay awake."""
    names = ["GLIBC_TUNABLES", "OPENBLAS_THREAD_TIMEOUT"]
    return ", ".join(f"{name}={os.environ.get(name, '')}" for name in names)


class Timed(NamedTuple):
    """Minimum and median of seconds over the repeats, and the result."""

    least: float
    median: float
    result: Any = None

    def scaled(self, by: float) -> "Timed":
        return Timed(self.least * by, self.median * by)


def in_turn(
    repeats: int,
    runs: Mapping[str, Callable[[], Any]],
    check: Callable[[dict[str, Any]], None] | None = None,
    clock: Callable[[], float] = time.perf_counter,
) -> dict[str, Timed]:
    """Each of `runs`, one after the other, then in reverse, and again, after one call of each.

    In reverse, so that nobody always comes after the one that leaves the caches cold.

    `check` is given the results of those calls before anything is timed. On a busy machine long
    runs wait for others more surely than short ones: `clock=time.process_time` counts work alone.
    """
    results = {name: jax.block_until_ready(run()) for name, run in runs.items()}
    if check is not None:
        check(results)
    seconds = {name: [] for name in runs}
    for repeat in range(repeats):
        for name, run in list(runs.items())[:: -1 if repeat % 2 else 1]:
            time.sleep(_PAUSE)
            start = clock()
            jax.block_until_ready(run())
            seconds[name].append(clock() - start)
    return {
        name: Timed(min(taken), float(np.median(taken)), results[name])
        for name, taken in seconds.items()
    }


def timed(run: Callable[[], Any], repeats: int) -> Timed:
    """One alone."""
    return in_turn(repeats, {"": run})[""]
