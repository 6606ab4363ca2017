"""`check_kernel`: whether a scalar kernel can be differentiated once in each argument.

Structured kernels consist of blocks M(x, z) = ∂x ∂zᵀ k(x, z), and the diagonal of the Gram has the
blocks M(x, x). A kernel written with the distance ‖x − z‖ has a removable singularity at x = z.
Automatic differentiation does not remove it: M(x, x) is NaN, zero or of rank one, without an error.
We therefore compare M(x, x) with M(x, x + h) at steps h that halve from the spread of the data down
to rounding. We use the steps at which k changes by more than rounding and M by little. A kernel is
sound if M(x, x) agrees with M(x, x + h) at one of these steps or more.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Num

from hamkernel import _require as require
from hamkernel._kernels.base import UserKernel, as_scalar_kernel
from hamkernel._machine import full_precision, one_blas_thread

_CURE = (
    "Write the kernel as a profile of the squared distance s = ‖x - z‖² with exact derivatives at "
    "s = 0 instead of through the distance, or use a kernel of this library (hk.Matern, …)."
)


class _Pairs(NamedTuple):
    """The values k, ∂x k and M of a batch of pairs, in float64, per unit of the points."""

    k: np.ndarray  # (...)
    gradient: np.ndarray  # (..., n)
    block: np.ndarray  # (..., n, n)


@one_blas_thread
@full_precision
def check_kernel(k: Callable[..., Any], points: Num[ArrayLike, "N n"]) -> None:
    """Raise an error if the scalar kernel `k` is unfit for structured kernels; else return None.

    The faults, in the order of the checks:

    1. k(x, z) is not one differentiable real number, or is not finite.
    2. The block M(x, x) = ∂x ∂zᵀ k is not the limit of M(x, x + h), or has no limit because the
       kernel is too rough.
    3. A derivative is not finite.
    4. All blocks M are zero.
    5. k(x, z) ≠ k(z, x).
    6. The Gram of k or of M has a negative eigenvalue.

    A kernel that passes is sound at these points.

    Args:
        k: a kernel of this library or any callable (x, z) → scalar on two points of shape (n,). Of
            a tinygp kernel we check the method `evaluate`.
        points: representative states, shape (N, n). Their spread sets the largest h. Their dtype
            sets the tolerances: an eigenvalue counts as negative below −ε^(2/3) of the trace.

    Raises:
        ValueError: the first fault, with its cause, its numbers and its cure.
        TypeError: `points` are not real numbers, or `k` is not callable or is matrix-valued.
    """
    if not require.is_concrete(k, points):
        raise ValueError("check_kernel looks at values: call it outside of jax.jit, grad and vmap.")
    X = require.finite(require.points(points, "points"), "points")
    k = as_scalar_kernel(k)
    k = k.fn if isinstance(k, UserKernel) else k
    eps = _check_signature(k, X)
    X = np.asarray(X)
    N, n = X.shape
    subset = _even_indices(N, min(64, max(8, 256 // n)))  # the Gram of blocks has some 256 rows
    near = _even_indices(len(subset), 8)  # the points that are compared with their neighbours
    spread, size = np.ptp(X.astype(float), axis=0), np.abs(X.astype(float)).max(axis=0)
    unit = np.where(spread > 0, spread, np.where(size > 0, size, 1.0))
    here, Z = X[subset], _neighbours(X[subset[near]], unit, size, eps)
    moved = here * (1 + 4 * eps * np.cos(np.pi * np.indices(here.shape).sum(axis=0)))
    moved = moved.astype(X.dtype)  # points moved by a few units in the last place show the rounding
    pairs = (here[:, None], here[None]), (moved[:, None], moved[None])
    gram, rounded, between, beyond = _derivatives_of_pairs(
        k, unit, *pairs, (here[near][:, None, None], Z), (Z, Z)
    )
    _refuse_infinite(gram.k, subset, f"k is {gram.k.sum()}")
    with np.errstate(all="ignore"):
        diagonal = _Pairs(*(values[near, near] for values in gram))
        _check_limits(diagonal, between, beyond, subset[near], unit, eps)
    _refuse_infinite(
        gram.block.sum(axis=(2, 3)) + gram.gradient.sum(axis=2),
        subset,
        "NaN or inf in the derivatives of k",
    )
    if not gram.block.any() and not between.block.any():
        raise ValueError(
            "∂x ∂zᵀ k is zero at all points, so every structured kernel built from k is zero: k is "
            "constant, a sum f(x) + f(z), piecewise, or hides its arguments from autodiff."
        )
    blocks, noise = (
        g.block.transpose(0, 2, 1, 3).reshape(len(subset) * n, -1) for g in (gram, rounded)
    )
    _check_gram("k", gram.k, rounded.k, eps)
    _check_gram("M = ∂x ∂zᵀ k", blocks, noise, eps)


def _check_signature(k: Callable, X: Array) -> float:
    """The machine epsilon of k and X; a ValueError unless k is one differentiable real number."""
    x = X[0]
    try:
        out = jax.eval_shape(k, x, x)
    except Exception as error:
        raise ValueError(
            f"k(x, z) failed on two points of shape {x.shape}: {type(error).__name__}: {error} A "
            "kernel takes one pair of points and is written with jax.numpy."
        ) from error
    if getattr(out, "shape", None) != () or not jnp.issubdtype(out.dtype, jnp.floating):
        got = f"{out.dtype}{out.shape}" if hasattr(out, "shape") else type(out).__name__
        raise ValueError(
            f"k(x, z) must return one real number, shape (), for two points; got {got}."
        )
    try:
        jax.eval_shape(_mixed_derivative(k), x, x)
    except Exception as error:
        raise ValueError(
            f"k(x, z) cannot be differentiated once in x and once in z: {error} Write it with "
            "jax.numpy, and custom rules as jax.custom_jvp rather than jax.custom_vjp."
        ) from error
    return float(max(jnp.finfo(out.dtype).eps, jnp.finfo(X.dtype).eps))


def _mixed_derivative(k: Callable) -> Callable:
    return jax.jacfwd(jax.grad(k), argnums=1)


def _even_indices(size: int, count: int) -> np.ndarray:
    return np.unique(np.linspace(0, size - 1, min(size, count)).round().astype(int))


def _neighbours(X: np.ndarray, unit: np.ndarray, size: np.ndarray, eps: float) -> np.ndarray:
    """The points X + h for two oblique directions and J halvings of h, shape (P, 2, J, n)."""
    halvings = np.arange(max(3.0, -np.log2(2 * eps * max(1.0, (size / unit).max()))))
    oblique = 1 + 0.3 * np.cos(np.arange(1, len(unit) + 1))
    directions = unit * np.stack([oblique, oblique * (-1.0) ** np.arange(1, len(unit) + 1)])
    h = directions[:, None] * 2.0 ** -halvings[:, None]
    return (X[:, None, None] + h).astype(X.dtype)


def _derivatives_of_pairs(k: Callable, unit: np.ndarray, *pairs) -> list[_Pairs]:
    """The values and derivatives of k on batches of pairs (..., n), in one compilation."""
    n = len(unit)
    wide = [np.broadcast_arrays(*pair) for pair in pairs]
    X, Z = (np.concatenate([pair[side].reshape(-1, n) for pair in wide]) for side in (0, 1))
    # Small batches save memory and avoid github.com/jax-ml/jax/issues/39103. We switch XLA's
    # optimisation off: it may turn x/ℓ − z/ℓ into a fused multiply-add, which returns a rounding
    # error instead of the distance.
    values = jax.jit(
        lambda X, Z: jax.lax.map(
            lambda p: (k(*p), jax.grad(k)(*p), _mixed_derivative(k)(*p)),
            (X, Z),
            batch_size=8192 // n**2 or 1,
        ),
        compiler_options={
            "xla_backend_optimization_level": 0,
            "xla_cpu_use_fusion_emitters": True,
        },
    )(X, Z)
    values, slopes, blocks = (np.asarray(v, float) for v in values)
    ends = np.cumsum([0, *(x[..., 0].size for x, _ in wide)])
    return [
        _Pairs(
            values[a:b].reshape(x.shape[:-1]),
            (slopes[a:b] * unit).reshape(x.shape),
            (blocks[a:b] * unit[:, None] * unit).reshape(*x.shape, n),
        )
        for a, b, (x, _) in zip(ends[:-1], ends[1:], wide, strict=True)
    ]


def _size(blocks: np.ndarray) -> np.ndarray:
    """The largest absolute entry of each block, without NaN and inf."""
    return np.abs(np.where(np.isfinite(blocks), blocks, 0.0)).max(axis=(-2, -1))


def _lowest(matrix: np.ndarray) -> float:
    return float(np.linalg.eigvalsh((matrix + matrix.T) / 2)[0])


def _check_limits(diagonal: _Pairs, between: _Pairs, beyond: _Pairs, index, unit, eps) -> None:
    """Raise a ValueError for the first M(x, x) that is not the limit of M(x, x + h)."""
    total = np.abs(diagonal.k[:, None, None]) + np.abs(beyond.k)
    moved = diagonal.k[:, None, None] + beyond.k - 2 * between.k
    moved = np.abs(moved) / np.where(total > 0, total, 1.0)  # (P, 2, J)
    finite: Any = np.isfinite(between.block).all(axis=(-2, -1))
    size = _size(between.block)
    # `near` are the neighbours at which k changes by more than rounding and M by little. The M of
    # Matérn-3/2 changes by 3 √moved.
    near = finite & (moved > 8 * eps) & (moved <= eps**0.5 / 8)
    larger = np.maximum.accumulate(np.where(finite & (moved <= 0.01), size, 0.0), axis=2)
    scale = np.maximum(np.maximum(size, larger), _size(diagonal.block)[:, None, None])
    scale = np.maximum(scale, 0.1 * scale.max(axis=(0, 1)))  # blocks may vanish at some points
    # M may not reach its limit at the smallest step. For Matérn-3/2 it converges linearly, so we
    # also extrapolate from two successive steps.
    before = np.concatenate([between.block[:, :, :1], between.block[:, :, :-1]], axis=2)
    here: Any = diagonal.block[:, None, None]
    misses = [_size(tends - here) for tends in (between.block, 2 * between.block - before)]
    differs = np.minimum(*misses) / np.where(scale > 0, scale, 1.0)
    is_finite: Any = np.isfinite(diagonal.block).all(axis=(-2, -1))
    differs = np.where(is_finite[:, None, None], differs, np.inf)
    grows: Any = (size[..., 1:] > 1.2 * size[..., :-1]) & finite[..., 1:] & finite[..., :-1]
    grows &= (moved <= 0.1 * np.where(finite, moved, 0).max(axis=2, keepdims=True))[..., :-1]
    for p, i in enumerate(index):
        # Only blocks of a kernel that is too rough keep growing over 10 halvings of h, a factor of
        # 1000. Blocks of a sound kernel with a second, smaller scale grow over two or three. In
        # float32, blocks of a sound kernel at near neighbours differ from M(x, x) by
        # 3 √(√ε/8) = .02. An M(x, x) that is twice too large differs from its neighbours by .5.
        steady = max(_longest(row) for row in grows[p]) >= 10
        rows = zip(near[p], differs[p], strict=True)
        wrong = any(row.any() and off[row].min() > 0.3 for row, off in rows)
        if not (steady or wrong or not np.isfinite(diagonal.block[p]).all()):
            continue
        last = [np.flatnonzero(row)[-1] for row in near[p] if row.any()]
        limits = [between.block[p, d, j] for d, j in enumerate(last)]
        raise ValueError(
            _diagnosis(diagonal.block[p], limits, steady, f"at x = z = points[{i}]", unit)
        )


def _longest(row: np.ndarray) -> int:
    """The length of the longest run of True in the row."""
    breaks = np.flatnonzero(~np.concatenate([[False], row, [False]]))
    return int(np.diff(breaks).max()) - 1


def _diagnosis(block, limits, steady: bool, where: str, unit) -> str:
    got, *shown = (_block_text(b / unit[:, None] / unit) for b in (block, *limits))
    scale = max(map(_size, limits), default=0.0)
    tends = f" The neighbours M(x, x + h) tend to {shown[0]} as h → 0." if limits else ""
    said = f"{where} autodiff returns M(x, x) = {got}.{tends}"
    if steady or any(_lowest(b) < -0.05 * scale for b in limits):
        return (
            "k has no second derivative at x = z; the kernel is too rough (Matérn-1/2, "
            f"exponential, also with a small number under the root): {said} Use hk.Matern(nu=1.5) "
            "or smoother, hk.Gaussian, hk.RationalQuadratic."
        )
    if len(limits) == 2 and _size(limits[0] - limits[1]) > 0.2 * scale:
        return (
            f"k has no second derivative at x = z: {where} the limit of M(x, x + h) depends on the "
            f"direction of h, {shown[0]} and {shown[1]}; a kink, as in the L1 distance "
            f"Σ|x_a - z_a|. {_CURE}"
        )
    if not np.isfinite(block).all():
        return f"NaN or inf in the derivatives of k {said} Likely the square root of zero. {_CURE}"
    if _size(block) <= 0.05 * scale:
        return f"zero block: {said} Likely a 'safe' norm, jnp.where around the root. {_CURE}"
    if _rank_one(block) and not _rank_one(limits[0]):
        return f"rank-one block: {said} Likely a distance that changes its kind at zero. {_CURE}"
    return f"wrong block: {said} A branch at small distances, or a wrong derivative rule. {_CURE}"


def _rank_one(block: np.ndarray) -> bool:
    values = np.linalg.svd(block, compute_uv=False)
    return len(values) > 1 and values[1] <= 0.05 * values[0]


def _block_text(block: np.ndarray) -> str:
    block = np.where(np.abs(block) < 1e-6 * _size(block), 0.0, block) + 0.0
    text = np.array2string(block, precision=4, threshold=16, edgeitems=2, separator=", ")
    return " ".join(text.split())


def _refuse_infinite(values: np.ndarray, subset: np.ndarray, what: str) -> None:
    bad = np.argwhere(~np.isfinite(values))
    if len(bad):
        i, j = subset[bad[0]]
        raise ValueError(
            f"{what} at x = points[{i}], z = points[{j}] ({len(bad)} of {values.size} pairs): "
            "overflow, or a root, logarithm or quotient outside its domain, taken or not."
        )


def _check_gram(name: str, G: np.ndarray, noisy: np.ndarray, eps: float) -> None:
    """Raise a ValueError if G is not symmetric, or has a negative eigenvalue beyond rounding."""
    scale = np.abs(G).max()
    if not scale:
        return
    noise = 4 * np.abs(np.nan_to_num(noisy - G)).max()
    gap = np.abs(G - G.T).max()
    if gap > max(np.sqrt(eps) * scale, noise):
        raise ValueError(
            f"the Gram of {name} is not symmetric, by {gap:.3g} beside {scale:.3g}: use "
            "(k(x, z) + k(z, x))/2 or φ(x)·φ(z), or correct a custom derivative rule."
        )
    lowest, allowed = _lowest(G), max(eps ** (2 / 3) * np.abs(np.diag(G)).sum(), noise * len(G))
    if lowest < -allowed:
        coarse = " Or float32 is too coarse: centre the points, use float64." * (eps > 1e-12)
        raise ValueError(
            f"k is not positive definite: the Gram of {name} has the eigenvalue {lowest:.4g}, and "
            f"rounding allows {-allowed:.2g}. tanh(x·z) and -‖x - z‖² give this. Use sums and "
            f"products of kernels, or φ(x)·φ(z).{coarse}"
        )
