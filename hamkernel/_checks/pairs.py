"""A kernel and its derivatives on batches of pairs, as `check_kernel` looks at them."""

import math
from collections.abc import Callable
from typing import NamedTuple

import jax
import numpy as np


class Pairs(NamedTuple):
    """k, ∂x k and M on a batch of pairs, in float64 on the host; M in units of the points."""

    k: np.ndarray  # (...)
    gradient: np.ndarray  # (..., n)
    block: np.ndarray  # (..., n, n)


def mixed(k: Callable) -> Callable:
    return jax.jacfwd(jax.grad(k, argnums=0), argnums=1)


def _values(k: Callable) -> Callable:
    return lambda x, z: (k(x, z), jax.grad(k)(x, z), mixed(k)(x, z))


def evaluate(k: Callable, unit: np.ndarray, *pairs: tuple[np.ndarray, np.ndarray]) -> list[Pairs]:
    """k, ∂x k and M on batches of pairs that broadcast to (..., n), in one compilation."""
    n = len(unit)
    shapes = [np.broadcast_shapes(x.shape, z.shape) for x, z in pairs]
    X, Z = (
        np.concatenate(
            [
                np.broadcast_to(pair[side], shape).reshape(-1, n)
                for pair, shape in zip(pairs, shapes, strict=True)
            ]
        )
        for side in (0, 1)
    )

    # Small batches bound the memory. They also keep clear of a fault of jaxlib 0.10.2 on the CPU,
    # which returns wrong numbers for the tail of a large vmapped reduction under jit (above 32768
    # entries in float32; github.com/jax-ml/jax/issues/39103): a sound kernel must not be blamed.
    size = max(1, 8192 // n**2)
    padded = np.minimum(np.arange(-(-len(X) // size) * size), len(X) - 1).reshape(-1, size)
    # Optimised, x/ℓ − z/ℓ may become a fused multiply-add whose rounding error stands in for the
    # distance at x = z: a zero block then shows or hides with the value of ℓ and with what is
    # compiled around it. Level 0 computes what is written, and compiles faster.
    compiled = jax.jit(
        lambda X, Z: jax.lax.map(lambda p: jax.vmap(_values(k))(*p), (X, Z)),
        compiler_options={"xla_backend_optimization_level": 0},
    )
    evaluated = compiled(X[padded], Z[padded])
    evaluated = (np.asarray(v, float).reshape(-1, *v.shape[2:]) for v in evaluated)
    values, gradients, blocks = evaluated
    blocks = blocks * unit[:, None] * unit
    out, start = [], 0
    for *batch, _ in shapes:
        stop = start + math.prod(batch)
        out.append(
            Pairs(
                values[start:stop].reshape(batch),
                gradients[start:stop].reshape(*batch, n),
                blocks[start:stop].reshape(*batch, n, n),
            )
        )
        start = stop
    return out


def size_of(blocks: np.ndarray) -> np.ndarray:
    """Largest entry of each (n, n) block; NaN and inf count as no entry."""
    return np.abs(np.where(np.isfinite(blocks), blocks, 0.0)).max(axis=(-2, -1))


def lowest(matrices: np.ndarray) -> np.ndarray:
    """Smallest eigenvalue of the symmetric part of each matrix; +inf where one is not finite."""
    finite = np.asarray(np.isfinite(matrices).all(axis=(-2, -1)))
    safe = np.where(finite[..., None, None], matrices, 0.0)
    symmetric = (safe + np.swapaxes(safe, -1, -2)) / 2
    return np.where(finite, np.linalg.eigvalsh(symmetric)[..., 0], np.inf)
