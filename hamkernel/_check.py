"""Whether a scalar kernel may serve in the structured kernels, said with the cause and the cure.

Their blocks are M(x, z) = ∂x ∂zᵀ k(x, z), and every point meets itself on the diagonal of the
Gram. There a kernel written with a distance ‖x − z‖ has a removable singularity that autodiff does
not remove: it returns NaN, or zeros, or a rank-one block, and nothing raises. The check compares
M(x, x) with its neighbours M(x, x + h) while h shrinks to the resolution of the numbers:

- positivity of the pair (x, x + h), whose Gram is [[M(x,x), M(x,x+h)], [·, M(x+h,x+h)]]. It holds
  for a sound kernel at every h, whatever its lengthscale, and fails for a block that is too small;
- the limit M(x, x + h) → M(x, x), which need not be fast (Matérn-3/2: linear in ‖h‖), only reached.

After that come symmetry and the smallest eigenvalue of the two Grams.
"""

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float

from hamkernel import _require as require
from hamkernel._scalar import UserKernel, as_scalar_kernel

_NEAR_POINTS = 8  # points whose diagonal block is compared with its neighbours
_GRAM_POINTS, _GRAM_ROWS = 64, 256  # caps on the Grams whose eigenvalues are taken
_SHRINK = 4.0  # ratio of one step to the next
_SETTLED, _VIOLATED = 0.03, 0.05  # plateau of M(x, x + h); negative eigenvalue of a pair
_CLOSE = 0.01  # change of k, relative to k, within which a neighbour counts as near

_PROFILE = (
    "Write the kernel as a profile of the squared distance s = ‖x - z‖² with exact derivatives at "
    "s = 0 instead of through the distance, or use a kernel of this library (hk.Matern, …)."
)


class _Pairs(NamedTuple):
    """k, ∂x k and M on a batch of pairs, in float64 on the host; M in units of the points."""

    k: np.ndarray  # (...)
    gradient: np.ndarray  # (..., n)
    block: np.ndarray  # (..., n, n)


class _Near(NamedTuple):
    """One point x and its neighbours x + h along D directions at J shrinking steps."""

    index: int
    block: np.ndarray  # (n, n): M(x, x)
    neighbours: np.ndarray  # (D, J, n, n): M(x, x + h)
    settled: np.ndarray  # (D, J): M(x, x + h) has reached a plateau
    change: np.ndarray  # (D, J): change of M(x, x + h) to the next step
    growing: np.ndarray  # (D,): M(x, x + h) grows without end as h shrinks
    wrong: np.ndarray  # (D,): M(x, x) disagrees with its neighbours


def check_kernel(k: Callable[..., Any], points: Float[ArrayLike, "N n"]) -> None:
    """Raise if the scalar kernel `k` is unfit for the structured kernels; return None if sound.

    Looked for, in this order: a result that is not one differentiable real number; NaN or inf in
    k, its gradient or M(x, z) = ∂x ∂zᵀ k(x, z); a block M(x, x) that is not the limit of its
    neighbours M(x, x + h), whether zero, of rank one, or without a limit because the kernel is too
    rough; k(x, z) ≠ k(z, x); a negative eigenvalue of the Gram of k or of M.

    The neighbours are taken at 8 of the points, the eigenvalues from at most 64 of them (fewer
    where 64 n > 256, never fewer than 8), both evenly spaced in `points`, so the answer is
    deterministic. A kernel that passes is sound at these points; no finite check proves more.

    Args:
        k: a kernel of this library or any callable (x, z) → scalar on two points of shape (n,);
            of an object with a method `evaluate` (tinygp), that method.
        points: representative states, shape (N, n); N = 1 is enough to look at x = z only. Their
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
    Z = _neighbours(X, X[near], unit, eps)  # (P, D, J, n)
    # The same Gram at points moved by a few units in the last place measures its rounding noise.
    n = X.shape[1]
    ulps = 1 + 4 * eps * np.where(np.arange(len(some) * n).reshape(-1, n) % 2 == 0, 1.0, -1.0)
    Y = (X[some] * ulps).astype(X.dtype)
    here, there = X[near][:, None, None, :], X[some]
    gram, noisy, between, beyond = _evaluate(
        k,
        unit,
        (there[:, None], there[None]),
        (Y[:, None], Y[None]),
        (here, Z),
        (Z, Z),
    )
    _check_values(some, gram)
    own = np.searchsorted(some, near)
    diagonal = _Pairs(*(values[own, own] for values in gram))
    with np.errstate(all="ignore"):  # inf at a far neighbour is no fault: smaller steps decide
        compared = _near_blocks(near, diagonal, between, beyond, eps)
    for one in compared:
        _check_limit(one, unit)
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
        jax.eval_shape(_mixed(k), x, x)
    except Exception as error:
        raise ValueError(
            "k(x, z) cannot be differentiated once in x (reverse) and once in z (forward): "
            f"{type(error).__name__}: {_first_line(error)} Write it with jax.numpy, and custom "
            "rules as jax.custom_jvp, which allow both modes, rather than jax.custom_vjp."
        ) from error
    return float(max(jnp.finfo(out.dtype).eps, jnp.finfo(X.dtype).eps))


def _first_line(error: Exception) -> str:
    return (str(error).strip().splitlines() or [""])[0].rstrip(".") + "."


def _mixed(k: Callable) -> Callable:
    return jax.jacfwd(jax.grad(k, argnums=0), argnums=1)


def _spaced(size: int, count: int) -> np.ndarray:
    """At most `count` indices, evenly spaced from the first to the last of `size`."""
    return np.unique(np.linspace(0, size - 1, min(size, count)).round().astype(int))


def _unit(X: np.ndarray) -> np.ndarray:
    """A length for each coordinate, (n,): its spread, else its size, else one.

    Blocks are compared in these units, so that coordinates of unlike scale weigh the same.
    """
    spread, size = np.ptp(X.astype(float), axis=0), np.abs(X.astype(float)).max(axis=0)
    return np.where(spread > 0, spread, np.where(size > 0, size, 1.0))


def _neighbours(X: np.ndarray, near: np.ndarray, unit: np.ndarray, eps: float) -> np.ndarray:
    """Points x + h, (P, D, J, n), from the spread of the data down to the resolution of `eps`.

    Two directions, oblique and of unlike signs: no axis, no kink of |x_a − z_a| goes unseen.
    """
    resolution = 8 * eps * max(1.0, float((np.abs(X).max(axis=0) / unit).max()))
    steps = _SHRINK ** -np.arange(max(3.0, 1 - np.log(resolution) / np.log(_SHRINK)))
    oblique = 1 + 0.3 * np.cos(np.arange(1, len(unit) + 1))
    directions = np.stack([oblique, oblique * (-1.0) ** np.arange(1, len(unit) + 1)])
    h = steps[None, :, None] * (directions * unit)[:, None, :]  # (D, J, n)
    return (near[:, None, None, :] + h[None]).astype(X.dtype)


def _values(k: Callable) -> Callable:
    return lambda x, z: (k(x, z), jax.grad(k)(x, z), _mixed(k)(x, z))


def _evaluate(k: Callable, unit: np.ndarray, *pairs: tuple[np.ndarray, np.ndarray]) -> list[_Pairs]:
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
            _Pairs(
                values[start:stop].reshape(batch),
                gradients[start:stop].reshape(*batch, n),
                blocks[start:stop].reshape(*batch, n, n),
            )
        )
        start = stop
    return out


def _size(blocks: np.ndarray) -> np.ndarray:
    """Largest entry of each (n, n) block; NaN and inf count as no entry."""
    return np.abs(np.where(np.isfinite(blocks), blocks, 0.0)).max(axis=(-2, -1))


def _lowest(matrices: np.ndarray) -> np.ndarray:
    """Smallest eigenvalue of the symmetric part of each matrix; +inf where one is not finite."""
    finite = np.asarray(np.isfinite(matrices).all(axis=(-2, -1)))
    safe = np.where(finite[..., None, None], matrices, 0.0)
    symmetric = (safe + np.swapaxes(safe, -1, -2)) / 2
    return np.where(finite, np.linalg.eigvalsh(symmetric)[..., 0], np.inf)


def _near_blocks(
    near: np.ndarray, diagonal: _Pairs, between: _Pairs, beyond: _Pairs, eps: float
) -> list[_Near]:
    """Compare M(x, x) with M(x, x + h) at every point of `near`, direction and step.

    Sizes are relative to the largest block of any point at the same step: a block that happens to
    vanish, such as that of (x·z)² at the origin, is then no fault, and a diverging one stays one.
    """
    own = diagonal.block[:, None, None]  # (P, 1, 1, n, n)
    A, after = between.block, beyond.block  # (P, D, J, n, n): M(x, x + h), M(x + h, x + h)
    own = np.broadcast_to(own, A.shape)
    scale = np.stack([_size(own), _size(A), _size(after)]).max(axis=(0, 1, 2))  # (J,)
    unit = np.where(scale > 0, scale, 1.0)[:, None, None]
    own, A, after = own / unit, A / unit, after / unit
    size = _size(A)
    finite = np.asarray(np.isfinite(A).all(axis=(-2, -1)))

    # Distance in feature space, ‖φ(x) − φ(x + h)‖², as a fraction of its largest possible value.
    k_own = diagonal.k[:, None, None]
    largest = np.asarray(np.abs(k_own) + np.abs(beyond.k))
    moved = np.abs(k_own + beyond.k - 2 * between.k) / np.where(largest > 0, largest, 1.0)
    close = finite & (moved <= _CLOSE)

    # Change to the next step, with the scale of this step on both sides.
    later = np.roll(between.block, -1, axis=2) / unit
    change = np.where(finite & np.isfinite(later).all(axis=(-2, -1)), _size(A - later), np.inf)
    change[:, :, -1] = np.inf
    settled = close & (change <= _SETTLED) & (size >= 0.1)

    pair = np.block([[own, A], [np.swapaxes(A, -1, -2), after]])
    violation = np.minimum(_size(A - own), -_lowest(pair))
    blatant = close & (change <= 10 * _SETTLED) & (violation > 10 * _VIOLATED)
    violated = (settled & (violation > _VIOLATED)) | blatant

    # A Matérn-3/2 block moves by 2√3 r while k moves by 3r²/2 (r = ‖h‖/ℓ), the slowest of the
    # sound kernels. Where k has moved more than that, h is not small yet: no verdict.
    # Where all blocks shrink to zero together (an indefinite k with a flat top), the largest of
    # the near ones at this step or before is the measure.
    tolerance = eps**0.25
    raw = _size(between.block)
    largest_near = np.maximum.accumulate(np.where(close, raw, 0.0), axis=-1)
    reached = finite & (_size(A - own) <= tolerance * np.maximum(1.0, largest_near / unit[:, 0, 0]))
    judged = finite & (moved <= tolerance**2 / 8)
    ratio = raw[:, :, 1:] / np.where(raw[:, :, :-1] > 0, raw[:, :, :-1], np.inf)
    both = close[:, :, 1:] & close[:, :, :-1]
    steps = both.sum(axis=-1)
    growing = (steps >= 3) & ~settled.any(axis=-1)
    growing &= (both & (ratio > 1.3)).sum(axis=-1) > 0.8 * steps
    # A block of a sound kernel with a second, unresolved scale may grow, but not beyond M(x, x).
    growing &= raw.max(axis=-1) > 2 * _size(diagonal.block)[:, None]
    missed = judged.any(axis=-1) & ~reached.any(axis=-1) & (settled.any(axis=-1) | growing)

    broken = np.asarray(~np.isfinite(diagonal.block).all(axis=(-2, -1)))
    broken |= ~np.isfinite(diagonal.gradient).all(axis=-1)
    settled = np.where(settled.any(axis=-1, keepdims=True), settled, blatant)
    wrong = missed | violated.any(axis=-1) | broken[:, None]
    return [
        _Near(index, diagonal.block[i], between.block[i], settled[i], change[i], growing[i], bad)
        for i, (index, bad) in enumerate(zip(near, wrong, strict=True))
    ]


def _check_limit(one: _Near, unit: np.ndarray) -> None:
    """Name what is wrong with M(x, x), given its neighbours."""
    if not one.wrong.any():
        return
    where = f"at x = z = points[{one.index}]"
    best = np.where(one.settled, one.change, np.inf).argmin(axis=-1)  # (D,)
    plateaus = one.neighbours[np.arange(len(best)), best][one.settled.any(axis=-1)]
    scale = max(float(_size(plateaus).max(initial=0.0)), np.finfo(float).tiny)
    got = _show(one.block / unit[:, None] / unit)
    finite = np.isfinite(one.block).all()

    # The limit of positive blocks is positive: a negative plateau is the flank of a delta at x = z.
    negative = len(plateaus) and float(_lowest(plateaus).min()) < -_VIOLATED * scale
    if one.growing.any() or negative:
        how = "turns negative" if negative else "grows without end"
        raise ValueError(
            f"k has no second derivative at x = z; the kernel is too rough (Matérn-1/2, "
            f"exponential/Laplace, …): {where} autodiff returns M(x, x) = {got}, while M(x, x + h) "
            f"{how} as h → 0. Use a kernel whose mixed derivative exists: Matérn with nu > 1 "
            "(hk.Matern(nu=1.5), …), hk.Gaussian, hk.RationalQuadratic."
        )
    if len(plateaus) > 1 and float(_size(plateaus[0] - plateaus[1])) > 0.2 * scale:
        first, second = (_show(p / unit[:, None] / unit) for p in plateaus)
        raise ValueError(
            f"k has no second derivative at x = z: {where} the limit of M(x, x + h) depends on the "
            f"direction of h, {first} along one and {second} along another; autodiff returns "
            f"M(x, x) = {got}. The kernel has a kink, as the L1 distance Σ|x_a - z_a| has. "
            f"{_PROFILE}"
        )
    limit = _show(plateaus[0] / unit[:, None] / unit) if len(plateaus) else None
    truth = f" The neighbours M(x, x + h) tend to {limit} as h → 0." if limit else ""
    if not finite:
        raise ValueError(
            f"NaN or inf in the derivatives of k {where}: M(x, x) = {got}.{truth} Likely cause: "
            "the square root of the squared distance, or a norm, whose derivative at zero is "
            f"infinite. {_PROFILE}"
        )
    if len(plateaus) and float(_size(one.block)) <= _VIOLATED * scale:
        raise ValueError(
            f"zero block: {where} autodiff returns M(x, x) = {got}.{truth} Likely cause: a safe "
            "norm (`jnp.where` around the square root, or a square root clipped from below), "
            "which removes the NaN at zero distance and the second derivative with it. "
            f"{_PROFILE}"
        )
    if len(plateaus) and _rank_one(one.block) and not _rank_one(plateaus[0]):
        raise ValueError(
            f"rank-one block: {where} autodiff returns M(x, x) = {got}, of rank one.{truth} Likely "
            "cause: a distance that falls back to another one at zero (Σ|x_a - z_a| for the "
            f"Euclidean norm). {_PROFILE}"
        )
    raise ValueError(
        f"wrong block: {where} autodiff returns M(x, x) = {got}, which is not the limit of its "
        f"neighbours M(x, x + h) as h → 0.{truth} Likely cause: a branch of k at small distances, "
        f"a wrong custom derivative rule, a kernel too rough to be differentiated, or rounding "
        "(points far from the origin compared with the lengthscale: centre them, use float64). "
        f"{_PROFILE}"
    )


def _rank_one(block: np.ndarray) -> bool:
    values = np.linalg.svd(block, compute_uv=False)
    return len(values) > 1 and values[1] <= _VIOLATED * values[0]


def _show(block: np.ndarray) -> str:
    """A block for a message, without the rounding noise in its zeros."""
    block = np.where(np.abs(block) < 1e-6 * _size(block), 0.0, block) + 0.0
    text = np.array2string(block, precision=4, threshold=16, edgeitems=2, separator=", ")
    return " ".join(text.split())


def _check_values(some: np.ndarray, gram: _Pairs) -> None:
    """The kernel itself must be finite on every pair."""
    bad = np.argwhere(~np.isfinite(gram.k))
    if len(bad):
        i, j = some[bad[0]]
        raise ValueError(
            f"k is {gram.k[tuple(bad[0])]} at x = points[{i}], z = points[{j}] ({len(bad)} of "
            f"{gram.k.size} pairs are not finite). Likely cause: overflow, or a root, logarithm or "
            "quotient outside its domain. Scale the points or restrict the kernel to its domain."
        )


def _check_finite_blocks(X: np.ndarray, some: np.ndarray, gram: _Pairs) -> None:
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
            f"root or norm at zero, or overflow. {_PROFILE}"
        )


def _check_symmetry(some: np.ndarray, gram: _Pairs, noisy: _Pairs, eps: float) -> None:
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
    """Largest difference; a moved point that left the domain of k (NaN) says nothing."""
    return float(np.abs(np.nan_to_num(noisy - values)).max())


def _check_positive(gram: _Pairs, noisy: _Pairs, eps: float) -> None:
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
        lowest = float(_lowest(G))
        # An error δ of every entry moves an eigenvalue by at most len(G) δ.
        allowed = max(eps ** (2 / 3) * trace, 4 * _gap(G, noise) * len(G))
        if lowest < -allowed:
            raise ValueError(
                f"k is not positive definite: the Gram of {name} on {count} of the points has the "
                f"eigenvalue {lowest * scale:.4g} (largest diagonal entry "
                f"{np.diag(G).max() * scale:.4g}, allowed by rounding {-allowed * scale:.2g}). "
                "tanh(x·z), -‖x - z‖², and functions of the distance that are no kernel give "
                "this. Use a positive definite kernel: sums and products of such, or φ(x)·φ(z)."
                + rounding
            )
