"""How much memory there is, and which dense problems are refused before they start."""

import functools
import os
from pathlib import Path

import jax
import jax.numpy as jnp

_CGROUP_LIMIT = Path("/sys/fs/cgroup/memory.max")


def dense_bytes(rows: int, columns: int, dtype: jnp.dtype, copies: int) -> int:
    """Bytes in so many matrices of that shape."""
    return copies * rows * columns * jnp.dtype(dtype).itemsize


@functools.cache
def memory_bytes() -> int | None:
    """The memory of the default device, or of this machine or container; None if unknown."""
    stats = jax.local_devices()[0].memory_stats() or {}
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
    """Raise a ValueError where so many dense matrices cannot fit, with the size and a cure."""
    needed, memory = dense_bytes(rows, columns, dtype, copies), memory_bytes()
    if memory is not None and needed > memory:
        matrices = "one matrix" if copies == 1 else f"{copies} matrices"
        raise ValueError(
            f"{what} needs {needed / 1e9:.3g} GB ({matrices} of {rows} by {columns} numbers) and "
            f"there are {memory / 1e9:.3g} GB. {cure}"
        )
