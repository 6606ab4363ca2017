"""The machine: devices, memory, the threads of BLAS, and batches of small matrices.

Data whose rows are sharded over devices, of one machine or of many, stay on their devices. Each
device runs the loops over its own rows and sends only sums. A product of all points with all points
also needs the rows of the other devices: they travel around the ring of devices, one part at a
time.

The compiler could shard these loops, but it would first gather all rows on every device, because of
the loop over tiles of rows. We therefore put `jax.shard_map` around the loops and leave the rest to
the compiler.
"""

import dataclasses
import functools
import math
import os
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, ParamSpec, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jax.sharding import AxisType, Mesh, NamedSharding, PartitionSpec, SingleDeviceSharding
from jaxtyping import Array, Float

from hamkernel import _sizes

P = ParamSpec("P")
T = TypeVar("T")


@dataclasses.dataclass(frozen=True)
class RowSharding:
    """The axes of a mesh of devices over which the rows of an array are sharded."""

    mesh: Mesh
    axes: tuple[str, ...]
    caller: NamedSharding = dataclasses.field(compare=False)

    @property
    def count(self) -> int:
        """The number of parts."""
        return math.prod(self.mesh.shape[axis] for axis in self.axes)

    @property
    def spec(self) -> PartitionSpec:
        return PartitionSpec(self.axes)

    def replicate(self, array: Array) -> Array:
        """The array with all rows on every device."""
        return jax.device_put(array, NamedSharding(self.mesh, PartitionSpec()))


def row_sharding(array: Array) -> RowSharding | None:
    """The sharding of the rows of `array`; None if it lies on one device or is traced.

    The devices of a traced array are unknown, so inside `jax.jit` the compiler shards the loops:
    the results are right, but every device holds all rows.
    """
    sharding = _mesh_sharding(array)
    if sharding is None or not sharding.spec:
        return None
    first = sharding.spec[0]
    axes = first if isinstance(first, tuple) else () if first is None else (first,)
    rows = RowSharding(_automatic(sharding.mesh), axes, sharding)
    return rows if rows.count > 1 else None


def shard(rows: RowSharding | None, array: Array) -> Array:
    """The array with its rows sharded as `rows`, on automatic axes."""
    if rows is None:
        return automatic(array)
    return jax.device_put(array, NamedSharding(rows.mesh, rows.spec))


def automatic(array: Array) -> Array:
    """The array on the same devices, on automatic axes of its mesh."""
    sharding = _mesh_sharding(array)
    if sharding is None:
        return array
    mesh = _automatic(sharding.mesh)
    if mesh == sharding.mesh:
        return array
    return jax.device_put(array, NamedSharding(mesh, sharding.spec))


def _mesh_sharding(array: Array) -> Any:
    """The sharding of an array on a mesh of devices; None for other arrays, and under tracing."""
    sharding = None if isinstance(array, Tracer) else getattr(array, "sharding", None)
    is_named = isinstance(sharding, NamedSharding)
    return sharding if is_named and isinstance(sharding.mesh, Mesh) else None  # no abstract mesh


def _automatic(mesh: Mesh) -> Mesh:
    types = (AxisType.Auto,) * len(mesh.axis_names)
    return Mesh(np.asarray(mesh.devices), mesh.axis_names, axis_types=types)


def is_on_one_device(array: Array) -> bool:
    """Whether `array` lies on one device and on no mesh; True if traced."""
    return isinstance(array, Tracer) or isinstance(array.sharding, SingleDeviceSharding)


def to_one_device(name: str, array: Array) -> Array:
    """`array` on one device of this process, and on automatic axes."""
    if isinstance(array, Tracer):
        return array
    if len(array.sharding.device_set) == 1:
        return automatic(array)
    if not array.is_fully_addressable:
        raise ValueError(
            f"{name} is sharded over several processes, and one process must hold all of it here: "
            "gather it with jax.experimental.multihost_utils.process_allgather(..., tiled=True), "
            "or pass a part."
        )
    return jnp.asarray(np.asarray(array))  # by the host: bound to no device


def to_caller_sharding(rows: RowSharding | None, array: Array) -> Array:
    """The array, with one row for each row of the data, on the caller's mesh."""
    if rows is None or isinstance(array, Tracer) or rows.caller.mesh == rows.mesh:
        return array
    return jax.device_put(array, rows.caller)


def map_devices(
    rows: RowSharding | None,
    function: Callable[..., Any],
    replicated: Any,
    *parts: Array,
    joined: bool,
) -> Any:
    """`function(replicated, *parts)`, evaluated by each device for its own rows of the parts.

    Args:
        rows: the sharding of the parts; None if one device holds them: one call on all rows.
        function: (replicated, *parts) -> a PyTree of arrays.
        replicated: a PyTree, the same on all devices.
        parts: arrays with rows.
        joined: whether the results are rows, which are concatenated; otherwise they are summed.
    """
    if rows is None:
        return function(replicated, *parts)
    arrays, static = eqx.partition(replicated, eqx.is_array)

    def result_of_device(arrays, *parts):
        result = function(eqx.combine(arrays, static), *parts)
        return result if joined else jax.lax.psum(result, rows.axes)

    # `check_vma=False`: tracking would require every loop, also in a user's kernel, to state
    # whether its start differs between devices. Derivatives are right either way.
    mapped = jax.shard_map(
        result_of_device,
        mesh=rows.mesh,
        in_specs=(PartitionSpec(), *(rows.spec for _ in parts)),
        out_specs=rows.spec if joined else PartitionSpec(),
        check_vma=False,
    )
    return mapped(arrays, *parts)


_CGROUP_LIMIT = Path("/sys/fs/cgroup/memory.max")


def dense_bytes(rows: int, columns: int, dtype: jnp.dtype, copies: int) -> int:
    """The number of bytes of `copies` matrices of this shape."""
    return copies * rows * columns * jnp.dtype(dtype).itemsize


def memory_bytes() -> int | None:
    """The memory of the default device, or of this machine or container; None if unknown."""
    return _memory_of(_sizes.platform())


@functools.cache
def _memory_of(platform: str) -> int | None:
    stats = jax.local_devices(backend=platform)[0].memory_stats() or {}
    if "bytes_limit" in stats:
        return stats["bytes_limit"]
    try:
        total = os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    except (AttributeError, ValueError, OSError):  # not on every system
        return None
    limit = _CGROUP_LIMIT.read_text().strip() if _CGROUP_LIMIT.exists() else "max"
    return min(total, int(limit)) if limit.isdigit() else total


def refuse_beyond_memory(
    what: str, rows: int, columns: int, dtype: jnp.dtype, copies: int, cure: str
) -> None:
    """ValueError if `copies` dense matrices do not fit in memory, with their size and a cure."""
    needed, memory = dense_bytes(rows, columns, dtype, copies), memory_bytes()
    if memory is not None and needed > memory:
        matrices = "one matrix" if copies == 1 else f"{copies} matrices"
        raise ValueError(
            f"{what} needs {needed / 1e9:.3g} GB ({matrices} of {rows} by {columns} numbers) and "
            f"there are {memory / 1e9:.3g} GB. {cure}"
        )


def follow_data(function: Callable[P, T]) -> Callable[P, T]:
    """`function` with the device of its arguments as JAX's default device.

    If the caller put the data on a CPU of a machine with a GPU, the CPU computes. Sizes, memory and
    compiler options belong to the default device (`_sizes`), so we change the default. Arrays that
    no one put on a device, and traced arrays, do not change it.
    """

    @functools.wraps(function)
    def wrapper(*args: P.args, **kwargs: P.kwargs) -> T:
        device = _device_of_data((args, kwargs))
        if device is None or device.platform == _sizes.platform():
            return function(*args, **kwargs)
        with jax.default_device(device):
            return function(*args, **kwargs)

    return wrapper


def _device_of_data(tree: Any) -> Any:
    """A device of this process on which the first committed array of a PyTree lies, or None."""
    # JAX warns of generators, such as chunks of data, unless they are leaves by request.
    for leaf in jax.tree.leaves(tree, is_leaf=lambda node: isinstance(node, Iterator)):
        if isinstance(leaf, jax.Array) and not isinstance(leaf, Tracer) and leaf.committed:
            return min(leaf.sharding.addressable_devices, key=lambda device: device.id)
    return None


# LAPACK uses one thread while the library computes. XLA's LAPACK on a CPU is SciPy's OpenBLAS,
# whose threads wait by spinning. On two cores beside one busy process, a fit of 592 rows took 0.4
# to 1 s with two threads and 8 to 13 ms with one. On idle cores one thread is as fast: 88 ms
# against 76 ms to factor 2000 rows, 3.0 against 2.9 ms for 592 (`tests/benchmarks/busy.py`).

_lock = threading.Lock()
_active_calls = 0  # the number of active calls, nested or in several threads
_limit: Any = None  # restores the number of threads after the last call


def one_blas_thread(function: Callable[P, T]) -> Callable[P, T]:
    """`function` with one thread of BLAS until its result is computed; then the limit is lifted.

    Inside the caller's own `jax.jit` nothing is computed while `function` runs, so this decorator
    has no effect. Set OPENBLAS_NUM_THREADS=1 in the environment instead.
    """

    @functools.wraps(function)
    def with_one_thread(*args: P.args, **kwargs: P.kwargs) -> T:
        with _one_thread():
            return jax.block_until_ready(function(*args, **kwargs))

    return with_one_thread


@contextmanager
def _one_thread():
    global _active_calls, _limit
    with _lock:
        if _active_calls == 0:
            _limit = _controller().limit(limits=1, user_api="blas")
        _active_calls += 1
    try:
        yield
    finally:
        with _lock:
            _active_calls -= 1
            if _active_calls == 0:
                _limit.restore_original_limits()


@functools.cache
def _controller():
    import scipy.linalg  # noqa: F401  its OpenBLAS, which jaxlib would load at its first use
    from threadpoolctl import ThreadpoolController

    return ThreadpoolController()


def double_precision(function: Callable[P, T]) -> Callable[P, T]:
    """`function` of NumPy arrays, computed in float64 whatever the configuration of JAX."""
    if hasattr(jax, "enable_x64"):
        context = jax.enable_x64
    else:  # before jax 0.8
        from jax.experimental import enable_x64 as context  # pyright: ignore

    @functools.wraps(function)
    def call(*args: P.args, **kwargs: P.kwargs) -> T:
        with context(True):
            return function(*args, **kwargs)

    return call


def full_precision(function: Callable[P, T]) -> Callable[P, T]:
    """`function`, whose matrix products keep all digits of their type on every device.

    On a GPU XLA computes float32 products in TF32, with 10 bits of mantissa, unless the program
    asks for more. The relative error of the Gram of 1000 states was then 6e-4, and 1.5e-7 with the
    highest precision, which took .58 ms instead of .70 ms (NVIDIA H200). JAX traces the caller's
    kernel inside `function` as well, so its products are covered.
    """

    @functools.wraps(function)
    def precise(*args: P.args, **kwargs: P.kwargs) -> T:
        with jax.default_matmul_precision("highest"):
            return function(*args, **kwargs)

    return precise


def entry_point(function: Callable[P, T]) -> Callable[P, T]:
    """`function` on the device of its data, with one thread of BLAS, in full precision."""
    return follow_data(one_blas_thread(full_precision(function)))


class EqualToItself:
    """A base of PyTrees with arrays, so that `jax.jit` takes the object and its methods.

    `jax.jit(field)` looks up the compiled function by hash and equality. Arrays have no hash and
    traced arrays no equality, so such an object equals only itself.
    """

    def __hash__(self) -> int:
        return id(self)

    def __eq__(self, other: object) -> bool:
        return self is other


def precise_jit(function: Any = None, **options: Any) -> Any:
    """`function` under `eqx.filter_jit` with products in full precision; `options` are of the jit.

    The precision is set while JAX traces, so a call of the compiled program costs nothing extra.
    """
    if function is None:
        return functools.partial(precise_jit, **options)
    return eqx.filter_jit(full_precision(function), **options)


# Options of XLA for programs that compile for longer than they run. A search of hyperparameters on
# a CPU takes, to compile and to run, for n = 2 and n = 8:
#     XLA's own options             4.5 s / .11 s    10.6 s / 4 s
#     without fusion emitters       2.5 s / .11 s     7.4 s / 4 s
#     nor optimisation by LLVM       .8 s / .25 s     1.7 s / 7 s
# So only small programs skip LLVM's optimisation. The first `learn` takes
#                                  this rule    no LLVM    XLA's own options
#     2 runs of 61 samples           24 s        18 s           55 s          (7000 numbers)
#     20 runs of 50, n = 8           44 s        73 s                         (20 000 to 400 000)
# On a GPU XLA times several versions of each product while it compiles. Without these timings the
# first `tune` of 300 points took 15.5 s instead of 78 s, and the first `learn` 60 s instead of
# 185 s; later calls are as fast (NVIDIA H200, jax 0.11). Products of large Grams keep the timings.
_BY_PLATFORM = {
    "cpu": {"xla_cpu_use_fusion_emitters": False},
    "gpu": {"xla_gpu_autotune_level": 0},
}
_UNOPTIMISED = {
    "cpu": _BY_PLATFORM["cpu"] | {"xla_backend_optimization_level": 0},
    "gpu": _BY_PLATFORM["gpu"],
}
_MAX_UNOPTIMISED = 16_384  # numbers in the arguments; larger programs are optimised


def compiled_by_size(
    function: Callable[P, T],
    unoptimised_up_to: int = _MAX_UNOPTIMISED,
    platforms: tuple[str, ...] = ("cpu", "gpu"),
) -> Callable[P, T]:
    """`precise_jit` with options of XLA that shorten compilation.

    On a CPU, programs with at most `unoptimised_up_to` numbers in their arguments also skip LLVM's
    optimisation. Platforms that are not in `platforms` use XLA's own options. Inside another JAX
    transformation the outer transformation chooses the options.
    """
    plain = precise_jit(function)
    fast, fastest = (
        {name: precise_jit(function, compiler_options=options) for name, options in table.items()}
        for table in (_BY_PLATFORM, _UNOPTIMISED)
    )

    @functools.wraps(function)
    def call(*args: P.args, **kwargs: P.kwargs) -> T:
        arrays = [a for a in jax.tree.leaves((args, kwargs)) if eqx.is_array(a)]
        platform = _sizes.platform()
        is_traced = any(isinstance(a, Tracer) for a in arrays)
        if is_traced or platform not in platforms or not _options_are_known(platform):
            return plain(*args, **kwargs)
        small = sum(a.size for a in arrays) <= unoptimised_up_to
        return (fastest if small else fast)[platform](*args, **kwargs)

    return call


def compiled_without_emitters(function: Callable[P, T]) -> Callable[P, T]:
    """`precise_jit` without XLA's fusion emitters, for integrations, which have few large fusions.

    Compile and run times of two programs on a CPU, with and without emitters:

        `hk.simulate`, field of 24 points, 1000 saved times   4.4 s / 136 ms   2.7 s / 114 ms
        Gram of 500 states, run time                          3.5 ms           12 ms
    """
    return compiled_by_size(function, unoptimised_up_to=0)


@functools.cache
def _options_are_known(platform: str) -> bool:
    """Whether the compiler of the platform has these options."""
    try:
        jax.jit(lambda: 0, compiler_options=_UNOPTIMISED[platform]).lower().compile()
    except Exception:  # jaxlib has no type of its own for it
        return False
    return True


# A QR of batches of small matrices without batched LAPACK calls. Two batched calls in one
# program, such as `jit(lambda a, b: (qr(a), qr(b)))` of shape (64, 48, 48), deadlock on two cores
# in jaxlib 0.10.2; see `_solvers/factors.py`.


def orthonormal(
    P: Float[Array, "B d n"],
) -> tuple[Float[Array, "B d n"], Float[Array, "B n n"]]:
    """The factors Q and U of P = QU, U upper triangular with a positive diagonal, for a batch.

    Gram–Schmidt applied twice, which is orthonormal to rounding as Householder's QR is (Giraud,
    Langou, Rozložník & van den Eshof (2005), Numer. Math. 101). The loop is over n.
    """
    Q = P[:, :, :0]
    for j in range(P.shape[2]):
        v = P[:, :, j]
        for _ in range(2):
            v = v - jnp.einsum("bdi,bi->bd", Q, jnp.einsum("bdi,bd->bi", Q, v))
        v = v / jnp.sqrt(jnp.einsum("bd,bd->b", v, v))[:, None]
        Q = jnp.concatenate([Q, v[:, :, None]], axis=2)
    return Q, jnp.triu(jnp.einsum("bdi,bdj->bij", Q, P))
