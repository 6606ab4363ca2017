"""Whether a scalar kernel is fit for the structured kernels, and if not, the cause and the cure.

Their blocks are M(x, z) = ∂x ∂zᵀ k(x, z), and every point meets itself on the diagonal of the
Gram. There a kernel written with a distance ‖x − z‖ has a removable singularity that autodiff does
not remove: it returns NaN, or zeros, or a rank-one block, and nothing raises. The check compares
M(x, x) with its neighbours M(x, x + h) while h shrinks to the resolution of the numbers:

- positivity of the pair (x, x + h), whose Gram is [[M(x,x), M(x,x+h)], [·, M(x+h,x+h)]]. It holds
  for a sound kernel at every h, whatever its lengthscale, and fails for a block that is too small;
- the limit M(x, x + h) → M(x, x), which need not be fast (Matérn-3/2: linear in ‖h‖), only reached.

After that come symmetry and the smallest eigenvalue of the two Grams.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Num

from hamkernel import _require as require
from hamkernel._checks.limit import PROFILE, check_limit, near_blocks, neighbours_of
from hamkernel._checks.pairs import Pairs, evaluate, lowest, mixed
from hamkernel._kernels.base import UserKernel, as_scalar_kernel
from hamkernel._machine import one_blas_thread

_NEAR_POINTS = 8  # points whose diagonal block is compared with its neighbours
_GRAM_POINTS, _GRAM_ROWS = 64, 256  # caps on the Grams whose eigenvalues are taken


@one_blas_thread
def check_kernel(k: Callable[..., Any], points: Num[ArrayLike, "N n"]) -> None:
    """Raise if the scalar kernel `k` is unfit for the structured kernels; return None if sound.

    It looks for these faults, in this order: a result that is not one differentiable real number;
    NaN or inf in k, its gradient or M(x, z) = ∂x ∂zᵀ k(x, z); a block M(x, x) that is not the limit
    of its neighbours M(x, x + h), whether zero, of rank one, or without a limit because the kernel
    is too rough; k(x, z) ≠ k(z, x); a negative eigenvalue of the Gram of k or of M.

    The neighbours are taken at 8 of the points, the eigenvalues from at most 64 of them (fewer
    where 64 n > 256, never fewer than 8), both evenly spaced in `points`, so the answer is
    deterministic. A kernel that passes is sound at these points; no finite check proves more.

    Args:
        k: a kernel of this library or any callable (x, z) → scalar on two points of shape (n,);
            of a kernel object of tinygp, its method `evaluate`.
        points: representative states, shape (N, n); N = 1 suffices to look only at x = z. Their
            spread sets the largest step h, their dtype the tolerances: an eigenvalue counts as
            negative below −ε^(2/3) of the trace (4e-11 in float64, 2e-5 in float32), or below
            the measured rounding noise of the kernel where that is larger.

    Raises:
        ValueError: the first fault found, with its cause, its numbers and its cure.
        TypeError: `points` are not real numbers, or `k` is not callable or is matrix-valued.
    """
    if not require.is_concrete(k, points):
        raise ValueError(
            "check_kernel looks at values and cannot run under jax.jit, grad or vmap: call it "
            "once, outside of them."
        )
    X = require.finite(require.points(points, "points"), "points")
    k = as_scalar_kernel(k)
    k = k.fn if isinstance(k, UserKernel) else k
    eps = _check_signature(k, X)
    X = np.asarray(X)
    some = _spaced(len(X), min(_GRAM_POINTS, max(8, _GRAM_ROWS // X.shape[1])))
    unit = _unit(X)
    near = some[_spaced(len(some), _NEAR_POINTS)]
    Z = neighbours_of(X, X[near], unit, eps)  # (P, D, J, n)
    # The same Gram at points moved by a few units in the last place measures its rounding noise.
    n = X.shape[1]
    ulps = 1 + 4 * eps * np.where(np.arange(len(some) * n).reshape(-1, n) % 2 == 0, 1.0, -1.0)
    Y = (X[some] * ulps).astype(X.dtype)
    here, there = X[near][:, None, None, :], X[some]
    gram, noisy, between, beyond = evaluate(
        k,
        unit,
        (there[:, None], there[None]),
        (Y[:, None], Y[None]),
        (here, Z),
        (Z, Z),
    )
    _check_values(some, gram)
    own = np.searchsorted(some, near)
    diagonal = Pairs(*(values[own, own] for values in gram))
    with np.errstate(all="ignore"):  # inf at a far neighbour is no fault: smaller steps decide
        compared = near_blocks(near, diagonal, between, beyond, eps)
    for one in compared:
        check_limit(one, unit)
    _check_finite_blocks(X, some, gram)
    if not gram.block.any() and not between.block.any():
        raise ValueError(
            "The mixed derivative ∂x ∂zᵀ k is zero at all points, so every structured kernel built "
            "from k is zero: k is constant, a sum f(x) + f(z), piecewise (min, max), or hides its "
            "arguments from autodiff (stop_gradient, rounding, integers)."
        )
    _check_symmetry(some, gram, noisy, eps)
    _check_positive(gram, noisy, eps)


def _check_signature(k: Callable, X: Array) -> float:
    """Machine epsilon of `k` at `X`, once it is known to be one differentiable real number."""
    x, n = X[0], X.shape[1]
    try:
        out = jax.eval_shape(k, x, x)
    except Exception as error:
        raise ValueError(
            f"k(x, z) failed on two points of shape ({n},): {type(error).__name__}: "
            f"{_first_line(error)} A scalar kernel takes one pair of points and is written with "
            "jax.numpy; batches come from jax.vmap."
        ) from error
    if not hasattr(out, "shape") or out.shape != ():
        raise ValueError(
            f"k(x, z) must return one number, shape (), on two points of shape ({n},); it returns "
            f"{getattr(out, 'shape', type(out).__name__)}. Reduce over the coordinates (sum, dot), "
            "or, if k builds a Gram matrix, pass its function of one pair of points."
        )
    if not jnp.issubdtype(out.dtype, jnp.floating):
        raise ValueError(f"k(x, z) must return a real floating number; it returns {out.dtype}.")
    try:
        jax.eval_shape(mixed(k), x, x)
    except Exception as error:
        raise ValueError(
            "k(x, z) cannot be differentiated once in x (reverse) and once in z (forward): "
            f"{type(error).__name__}: {_first_line(error)} Write it with jax.numpy, and custom "
            "rules as jax.custom_jvp, which allow both modes, rather than jax.custom_vjp."
        ) from error
    return float(max(jnp.finfo(out.dtype).eps, jnp.finfo(X.dtype).eps))


def _first_line(error: Exception) -> str:
    return (str(error).strip().splitlines() or [""])[0].rstrip(".") + "."


def _spaced(size: int, count: int) -> np.ndarray:
    """At most `count` indices, evenly spaced from the first to the last of `size`."""
    return np.unique(np.linspace(0, size - 1, min(size, count)).round().astype(int))


def _unit(X: np.ndarray) -> np.ndarray:
    """A length for each coordinate, (n,): its spread, else its size, else one.

    Blocks are compared in these units, so that coordinates of unlike scale weigh the same.
    """
    spread, size = np.ptp(X.astype(float), axis=0), np.abs(X.astype(float)).max(axis=0)
    return np.where(spread > 0, spread, np.where(size > 0, size, 1.0))


def _check_values(some: np.ndarray, gram: Pairs) -> None:
    """The kernel itself must be finite on every pair."""
    bad = np.argwhere(~np.isfinite(gram.k))
    if len(bad):
        i, j = some[bad[0]]
        raise ValueError(
            f"k is {gram.k[tuple(bad[0])]} at x = points[{i}], z = points[{j}] ({len(bad)} of "
            f"{gram.k.size} pairs are not finite). Likely cause: overflow, or a root, logarithm or "
            "quotient outside its domain. Scale the points or restrict the kernel to its domain."
        )


def _check_finite_blocks(X: np.ndarray, some: np.ndarray, gram: Pairs) -> None:
    """The derivatives must be finite on every pair, as k is."""
    finite = np.isfinite(gram.block).all(axis=(-2, -1)) & np.isfinite(gram.gradient).all(axis=-1)
    bad = np.argwhere(~finite)
    if len(bad):
        i, j = some[bad[0]]
        same = "which are equal" if (X[i] == X[j]).all() else "which differ"
        raise ValueError(
            f"NaN or inf in the derivatives of k at x = points[{i}], z = points[{j}], {same} "
            f"({len(bad)} of {finite.size} pairs are not finite), though k itself is finite. "
            "Likely cause: a branch of `jnp.where` that is not finite where it is not taken, a "
            f"root or norm at zero, or overflow. {PROFILE}"
        )


def _check_symmetry(some: np.ndarray, gram: Pairs, noisy: Pairs, eps: float) -> None:
    """k(x, z) = k(z, x) and M(x, z) = M(z, x)ᵀ up to the rounding noise of the kernel."""
    for values, flipped, noise, name in (
        (gram.k, gram.k.T, noisy.k, "k(x, z)"),
        (gram.block, gram.block.transpose(1, 0, 3, 2), noisy.block, "M(x, z)"),
    ):
        scale = np.abs(values).max()
        gap = np.abs(values - flipped)
        if gap.max() > max(np.sqrt(eps) * scale, 4 * _gap(values, noise)):
            at = np.unravel_index(gap.argmax(), gap.shape)
            i, j = some[list(at[:2])]
            cause = (
                "Symmetrise it, (k(x, z) + k(z, x))/2, or use the feature form k = φ(x)·φ(z)."
                if name == "k(x, z)"
                else "k is symmetric but its derivatives are not: correct its custom rule."
            )
            raise ValueError(
                f"{name} is not symmetric: {values[at]:.6g} at x = points[{i}], z = points[{j}], "
                f"but {flipped[at]:.6g} with the arguments exchanged. {cause}"
            )


def _gap(values: np.ndarray, noisy: np.ndarray) -> float:
    """Largest difference; a moved point that left the domain of k (NaN) does not count."""
    return float(np.abs(np.nan_to_num(noisy - values)).max())


def _check_positive(gram: Pairs, noisy: Pairs, eps: float) -> None:
    """No eigenvalue of the two Grams below −tolerance × trace."""
    count, n = len(gram.k), gram.block.shape[-1]
    rounding = (
        ""
        if eps < 1e-12
        else " If it is one, float32 is too coarse for these points: centre them, use float64."
    )

    def assembled(block):  # (N, N, n, n) → (N n, N n)
        return block.transpose(0, 2, 1, 3).reshape(count * n, count * n)

    for G, noise, name in (
        (gram.k, noisy.k, "k"),
        (assembled(gram.block), assembled(noisy.block), "M = ∂x ∂zᵀ k"),
    ):
        scale = np.abs(G).max()
        if scale == 0:
            continue
        G, noise = G / scale, noise / scale
        trace = np.abs(np.diag(G)).sum()
        smallest = float(lowest(G))
        # An error δ of every entry moves an eigenvalue by at most len(G) δ.
        allowed = max(eps ** (2 / 3) * trace, 4 * _gap(G, noise) * len(G))
        if smallest < -allowed:
            raise ValueError(
                f"k is not positive definite: the Gram of {name} on {count} of the points has the "
                f"eigenvalue {smallest * scale:.4g} (largest diagonal entry "
                f"{np.diag(G).max() * scale:.4g}, allowed by rounding {-allowed * scale:.2g}). "
                "tanh(x·z), -‖x - z‖², and functions of the distance that are no kernel give "
                "this. Use a positive definite kernel: sums and products of such, or φ(x)·φ(z)."
                + rounding
            )
