"""The memory of each device as devices are added.

    python tests/benchmarks/devices.py [--points 4194304] [--devices 1 2 4 8]

Host devices of one process, float64, n = 2. First each fit of 4096 points is compared with that of
one device. Then the programs for many points are compiled, not run, and XLA is asked what one
device needs for its arguments, results and everything between. The cores are shared, so there is
no speed to be measured here.
"""

import argparse
from typing import Any

import jax

jax.config.update("jax_enable_x64", True)
jax.config.update("jax_num_cpu_devices", 8)

import jax.numpy as jnp
import numpy as np
from jax.sharding import AxisType, NamedSharding, PartitionSpec

import hamkernel as hk
from hamkernel._gram_operator import product
from hamkernel._machine import RowSharding
from hamkernel._observations.measurements import measurements_of_states
from hamkernel._solvers import conjugate_gradient, nystrom, random_features

KERNEL = hk.Symplectic(hk.Gaussian(1.5))
REGULARIZATION = 1e-4


def mesh_of(devices):
    kind = (AxisType.Auto,)
    return jax.make_mesh((devices,), ("data",), axis_types=kind, devices=jax.devices()[:devices])


def agreement(devices, points=4096):
    rng = np.random.default_rng(0)
    X = rng.uniform(-2, 2, size=(points, 2))
    Y = np.stack([X[:, 1], -np.sin(X[:, 0])], axis=1) + 0.01 * rng.normal(size=X.shape)
    new = rng.uniform(-2, 2, size=(100, 2))
    spread = jax.device_put((X, Y), NamedSharding(mesh_of(devices), PartitionSpec("data")))
    solvers = hk.Nystrom(), hk.RandomFeatures(50, jax.random.key(0)), hk.ConjugateGradient()
    for solver in solvers:
        one, many = (
            np.asarray(hk.fit(KERNEL, x, y, REGULARIZATION, solver=solver).evaluate(new))
            for x, y in ((X, Y), spread)
        )
        off = np.linalg.norm(many - one) / np.linalg.norm(one)
        name = type(solver).__name__
        print(f"{name:18s} {points} points, {devices} devices against one: {off:.1e}", flush=True)


def programs():
    """Functions of states, velocities and where they are: a product, and what `fit` runs."""
    some = np.random.default_rng(1).uniform(-2, 2, size=(32, 2))
    ridge, waves = jnp.asarray(REGULARIZATION), hk.RandomFeatures(32, jax.random.key(0))
    S = hk.Nystrom(points=some).landmarks(
        KERNEL, measurements_of_states(jnp.asarray(some), jnp.asarray(some)), ridge
    )

    def features(X, Y, rows):
        return random_features._feature_fit(KERNEL, waves, X, Y, ridge, rows).residual

    def gradients(X, Y, rows):
        N_ridge = len(X) * ridge
        given = KERNEL, X, N_ridge, S, rows
        return conjugate_gradient._solve(
            conjugate_gradient._prepare_velocities, given, Y, N_ridge, jnp.asarray(1e-8), 100
        )

    return {
        "product": lambda X, Y, rows: product(KERNEL, X, X, Y, rows, rows),
        "Nystrom": lambda X, Y, rows: nystrom._landmark_fit(KERNEL, X, Y, ridge, S, rows),
        "RandomFeatures": features,
        "ConjugateGradient": gradients,
    }


def bytes_of_a_device(function, points, devices):
    mesh = mesh_of(devices)
    sharding = NamedSharding(mesh, PartitionSpec("data"))
    data = jax.ShapeDtypeStruct((points, 2), jnp.float64, sharding=sharding)
    rows = RowSharding(mesh, ("data",), sharding) if devices > 1 else None
    compiled = jax.jit(lambda X, Y: function(X, Y, rows)).lower(data, data).compile()
    used: Any = compiled.memory_analysis()
    return used.argument_size_in_bytes + used.output_size_in_bytes + used.temp_size_in_bytes


def main(points, devices):
    agreement(max(devices))
    print(f"\nmegabytes of one device, N = {points}")
    print(f"{'devices':18s}" + "".join(f"{count:9d}" for count in devices))
    for name, function in programs().items():
        sizes = [bytes_of_a_device(function, points, count) for count in devices]
        print(f"{name:18s}" + "".join(f"{size / 1e6:9.1f}" for size in sizes), flush=True)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--points", type=int, default=2**22)
    parser.add_argument("--devices", type=int, nargs="+", default=[1, 2, 4, 8])
    arguments = parser.parse_args()
    main(arguments.points, arguments.devices)
