"""Fit the points of many machines at once, and save the field.

    python distributed.py FOLDER OUT --coordinator HOST:PORT --processes P --process I

Every machine runs this with its own I from 0 to P − 1; HOST is the one with I = 0. Under Slurm or
Open MPI, and on Cloud TPUs, leave out the three options: JAX finds them by itself. FOLDER has files
`*.npz` with arrays X of states, shape (N, n), and Y of velocities, the same; process I reads every
P-th of them. Process 0 writes OUT, which `hk.load` reads.
"""

import argparse
from pathlib import Path

import jax
import numpy as np
from jax.experimental import multihost_utils
from jax.sharding import AxisType, NamedSharding, PartitionSpec

import hamkernel as hk

jax.config.update("jax_enable_x64", True)


def own_part(folder):
    """The states and velocities of this process, as many as every other process has."""
    files = sorted(Path(folder).glob("*.npz"))[jax.process_index() :: jax.process_count()]
    parts = [np.load(file) for file in files]
    X, Y = (np.concatenate([part[name] for part in parts]) for name in ("X", "Y"))
    # JAX splits an array into equal parts, one for each device.
    here = np.asarray(len(X) // jax.local_device_count())
    rows = int(multihost_utils.process_allgather(here).min()) * jax.local_device_count()
    print(f"process {jax.process_index()}: {rows} of {len(X)} points of {len(files)} files")
    return X[:rows], Y[:rows]


def main(arguments):
    """Fit and save, in step with the other processes."""
    if arguments.coordinator is None:
        jax.distributed.initialize()
    else:
        jax.distributed.initialize(arguments.coordinator, arguments.processes, arguments.process)
    mesh = jax.make_mesh((jax.device_count(),), ("data",), axis_types=(AxisType.Auto,))
    rows = NamedSharding(mesh, PartitionSpec("data"))
    X, Y = (
        jax.make_array_from_process_local_data(rows, part) for part in own_part(arguments.folder)
    )

    # The kernel and λ are yours: `hk.tune` finds them on a part of the data, in one process.
    K, regularization = hk.Symplectic(hk.Gaussian(1.5)), 1e-6
    field = hk.fit(K, X, Y, regularization, solver=hk.ConjugateGradient(1e-8))
    hk.save(arguments.out, field)  # by all of them, for each holds a part of the residual
    if jax.process_index() == 0:
        print(f"{len(X)} points: {field.info}")
        print(f"{arguments.out} is written")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description="Fit the points of many machines at once.")
    parser.add_argument("folder", help="with files *.npz of X and Y")
    parser.add_argument("out", help="the file that the field is saved to")
    parser.add_argument("--coordinator", help="HOST:PORT of process 0")
    parser.add_argument("--processes", type=int)
    parser.add_argument("--process", type=int)
    main(parser.parse_args())
