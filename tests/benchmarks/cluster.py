"""A stream on worker processes of Dask: points per second, memory of a worker, and the same field.

    pip install ".[cluster]" && python tests/benchmarks/cluster.py [--files 16] [--points 50000]

Each process, the one without Dask too, has a core of its own (on Linux) and reads files of its own
from a folder of NPZ files, a pendulum in float64, after a first pass in which all is compiled.
Points per second of the processor, of the busiest worker, are what other programs on the machine
change little. Workers run half of the files, and then all: the peak memory of a worker stays.
"""

import argparse
import contextlib
import operator
import os
import tempfile
import time
from pathlib import Path

os.environ["JAX_ENABLE_X64"] = "1"  # which the workers inherit

import dask.bag  # type: ignore[import-not-found]
import numpy as np
from dask.distributed import Client, LocalCluster  # type: ignore[import-not-found]

import hamkernel as hk

KERNEL, REGULARIZATION = hk.Symplectic(hk.Gaussian(1.5)), 1e-8


def pinned(core):
    """This process on one core, where the system can."""
    if hasattr(os, "sched_setaffinity"):
        cores = sorted(os.sched_getaffinity(os.getppid()))
        for thread in os.listdir("/proc/self/task"):
            with contextlib.suppress(ProcessLookupError):  # one that has just ended
                os.sched_setaffinity(int(thread), [cores[core % len(cores)]])


def peak():
    """The peak memory of this process, in bytes."""
    return int(Path("/proc/self/status").read_text().partition("VmHWM:")[2].split()[0]) * 1024


def added(model, path):
    part = np.load(path)
    return model.add(part["X"], part["Y"])


def written(folder, files, points):
    rng = np.random.default_rng(0)
    for i in range(files):
        X = rng.uniform(-2, 2, size=(points, 2))
        Y = np.stack([X[:, 1], -np.sin(X[:, 0])], axis=1) + 0.01 * rng.normal(size=X.shape)
        np.savez(folder / f"{i:03}.npz", X=X, Y=Y)
    return sorted(folder.glob("*.npz"))


def one_process(start, paths):
    model = start
    for path in paths:
        model = added(model, path)
    return model.field()


def on_workers(count, start, paths):
    def work(paths):
        files = dask.bag.from_sequence(paths, npartitions=2 * count)
        return files.fold(added, operator.add, initial=start).compute().field()

    with LocalCluster(count, threads_per_worker=1, dashboard_address=None) as cluster:
        with Client(cluster) as client:
            client.run(lambda dask_worker: pinned(dask_worker.name))
            work(paths[: 2 * count])  # compiles

            def on_all(function):
                return np.asarray(list(client.run(function).values()))

            found = [
                (*timed(work, some, lambda: on_all(time.process_time)), on_all(peak).max())
                for some in (paths[::2], paths)
            ]
    return found


def timed(work, paths, used=lambda: np.asarray([time.process_time()])):
    """The field, and the seconds: of the clock, and of the processor in the busiest process."""
    before, begin = used(), time.perf_counter()
    field = work(paths)
    return field, time.perf_counter() - begin, (used() - before).max()


def main(arguments):
    with tempfile.TemporaryDirectory() as folder:
        paths = written(Path(folder), arguments.files, arguments.points)
        sample = np.concatenate([np.load(path)["X"][:200] for path in paths])
        start = hk.Nystrom().start(KERNEL, sample, REGULARIZATION)
        print(f"{len(start.sums.basis)} columns, files of {arguments.points} points")
        workers = {count: on_workers(count, start, paths) for count in arguments.workers}
        pinned(0)
        one_process(start, paths[:1])  # compiles
        rows = {"one process": [(*timed(lambda p: one_process(start, p), paths), peak())]}
    whole = np.asarray(rows["one process"][0][0].evaluate(sample))
    rows |= {f"{count} workers": found for count, found in workers.items()}
    for name, found in rows.items():
        files = arguments.files // len(found)  # half of them, and all, or all at once
        for field, seconds, busy, memory in found:
            values = np.asarray(field.evaluate(sample))
            off = np.linalg.norm(values - whole) / np.linalg.norm(whole)
            same = f"{off:.1e} from one process" if files == arguments.files else ""
            points = files * arguments.points
            print(
                f"{name:12s} {files:4d} files: {points / seconds:9.0f} points/s, "
                f"{points / busy:9.0f} per s of the processor, {memory / 1e6:.0f} MB  {same}"
            )
            files *= 2


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description="Streams on worker processes of Dask.")
    parser.add_argument("--files", type=int, default=16)
    parser.add_argument("--points", type=int, default=50_000)
    parser.add_argument("--workers", type=int, nargs="+", default=[1, 2])
    main(parser.parse_args())
