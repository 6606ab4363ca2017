"""Whether M(x, x) is the limit of its neighbours M(x, x + h), and what is wrong where it is not."""

from typing import NamedTuple

import numpy as np

from hamkernel._check_pairs import Pairs, lowest, size_of

_SHRINK = 4.0  # ratio of one step to the next
_SETTLED, _VIOLATED = 0.03, 0.05  # plateau of M(x, x + h); negative eigenvalue of a pair
_STEADY = 5  # steps of growth in a row, 4⁵ = 1000 in distance: more than a sound kernel has
_CLOSE = 0.01  # change of k, relative to k, within which a neighbour counts as near

PROFILE = (
    "Write the kernel as a profile of the squared distance s = ‖x - z‖² with exact derivatives at "
    "s = 0 instead of through the distance, or use a kernel of this library (hk.Matern, …)."
)


class _Near(NamedTuple):
    """One point x and its neighbours x + h along D directions at J shrinking steps."""

    index: int
    block: np.ndarray  # (n, n): M(x, x)
    neighbours: np.ndarray  # (D, J, n, n): M(x, x + h)
    settled: np.ndarray  # (D, J): M(x, x + h) has reached a plateau
    change: np.ndarray  # (D, J): change of M(x, x + h) to the next step
    growing: np.ndarray  # (D,): M(x, x + h) grows without end as h shrinks
    wrong: np.ndarray  # (D,): M(x, x) disagrees with its neighbours


def neighbours_of(X: np.ndarray, near: np.ndarray, unit: np.ndarray, eps: float) -> np.ndarray:
    """Points x + h, (P, D, J, n), from the spread of the data down to the resolution of `eps`.

    Two directions, oblique and of unlike signs: no axis, no kink of |x_a − z_a| goes unseen.
    """
    resolution = 8 * eps * max(1.0, float((np.abs(X).max(axis=0) / unit).max()))
    steps = _SHRINK ** -np.arange(max(3.0, 1 - np.log(resolution) / np.log(_SHRINK)))
    oblique = 1 + 0.3 * np.cos(np.arange(1, len(unit) + 1))
    directions = np.stack([oblique, oblique * (-1.0) ** np.arange(1, len(unit) + 1)])
    h = steps[None, :, None] * (directions * unit)[:, None, :]  # (D, J, n)
    return (near[:, None, None, :] + h[None]).astype(X.dtype)


def near_blocks(
    near: np.ndarray, diagonal: Pairs, between: Pairs, beyond: Pairs, eps: float
) -> list[_Near]:
    """Compare M(x, x) with M(x, x + h) at every point of `near`, direction and step.

    Sizes are relative to the largest block of any point at the same step: a block that happens to
    vanish, such as that of (x·z)² at the origin, is then no fault, and a diverging one stays one.
    """
    own = diagonal.block[:, None, None]  # (P, 1, 1, n, n)
    A, after = between.block, beyond.block  # (P, D, J, n, n): M(x, x + h), M(x + h, x + h)
    own = np.broadcast_to(own, A.shape)
    scale = np.stack([size_of(own), size_of(A), size_of(after)]).max(axis=(0, 1, 2))  # (J,)
    unit = np.where(scale > 0, scale, 1.0)[:, None, None]
    own, A, after = own / unit, A / unit, after / unit
    size = size_of(A)
    finite = np.asarray(np.isfinite(A).all(axis=(-2, -1)))

    # Distance in feature space, ‖φ(x) − φ(x + h)‖², as a fraction of its largest possible value.
    k_own = diagonal.k[:, None, None]
    largest = np.asarray(np.abs(k_own) + np.abs(beyond.k))
    moved = np.abs(k_own + beyond.k - 2 * between.k) / np.where(largest > 0, largest, 1.0)
    close = finite & (moved <= _CLOSE)

    # Change to the next step, with the scale of this step on both sides.
    later = np.roll(between.block, -1, axis=2) / unit
    change = np.where(finite & np.isfinite(later).all(axis=(-2, -1)), size_of(A - later), np.inf)
    change[:, :, -1] = np.inf
    settled = close & (change <= _SETTLED) & (size >= 0.1)

    pair = np.block([[own, A], [np.swapaxes(A, -1, -2), after]])
    violation = np.minimum(size_of(A - own), -lowest(pair))
    blatant = close & (change <= 10 * _SETTLED) & (violation > 10 * _VIOLATED)
    violated = (settled & (violation > _VIOLATED)) | blatant

    # A Matérn-3/2 block moves by 2√3 r while k moves by 3r²/2 (r = ‖h‖/ℓ), the slowest of the
    # sound kernels. Where k has moved more than that, h is not small yet: no verdict.
    # Where all blocks shrink to zero together (an indefinite k with a flat top), the largest of
    # the near ones at this step or before is the measure.
    tolerance = eps**0.25
    raw = size_of(between.block)
    largest_near = np.maximum.accumulate(np.where(close, raw, 0.0), axis=-1)
    reached = finite & (
        size_of(A - own) <= tolerance * np.maximum(1.0, largest_near / unit[:, 0, 0])
    )
    judged = finite & (moved <= tolerance**2 / 8)
    ratio = raw[:, :, 1:] / np.where(raw[:, :, :-1] > 0, raw[:, :, :-1], np.inf)
    both = close[:, :, 1:] & close[:, :, :-1]
    steps = both.sum(axis=-1)
    grown = both & (ratio > 1.3)
    growing = (steps >= 3) & ~settled.any(axis=-1)
    growing &= grown.sum(axis=-1) > 0.8 * steps
    # A block of a sound kernel with a second, unresolved scale may grow, but not beyond M(x, x).
    growing &= raw.max(axis=-1) > 2 * size_of(diagonal.block)[:, None]
    # A scale is passed in a step or two. Growth over decades is a kernel of the distance, also
    # where a term under the root stops it in the end: M(x, x) is then a delta beside the rest.
    run = longest = np.zeros(steps.shape, int)
    for step in np.moveaxis(grown, -1, 0):
        run = np.where(step, run + 1, 0)
        longest = np.maximum(longest, run)
    endless = longest >= _STEADY
    growing |= endless
    missed = judged.any(axis=-1) & ~reached.any(axis=-1) & (settled.any(axis=-1) | growing)

    broken = np.asarray(~np.isfinite(diagonal.block).all(axis=(-2, -1)))
    broken |= ~np.isfinite(diagonal.gradient).all(axis=-1)
    settled = np.where(settled.any(axis=-1, keepdims=True), settled, blatant)
    wrong = missed | violated.any(axis=-1) | broken[:, None] | endless
    return [
        _Near(index, diagonal.block[i], between.block[i], settled[i], change[i], growing[i], bad)
        for i, (index, bad) in enumerate(zip(near, wrong, strict=True))
    ]


def check_limit(one: _Near, unit: np.ndarray) -> None:
    """Name what is wrong with M(x, x), given its neighbours."""
    if not one.wrong.any():
        return
    where = f"at x = z = points[{one.index}]"
    best = np.where(one.settled, one.change, np.inf).argmin(axis=-1)  # (D,)
    plateaus = one.neighbours[np.arange(len(best)), best][one.settled.any(axis=-1)]
    scale = max(float(size_of(plateaus).max(initial=0.0)), np.finfo(float).tiny)
    got = _show(one.block / unit[:, None] / unit)
    finite = np.isfinite(one.block).all()

    # The limit of positive blocks is positive: a negative plateau is the flank of a delta at x = z.
    negative = len(plateaus) and float(lowest(plateaus).min()) < -_VIOLATED * scale
    if one.growing.any() or negative:
        how = "turns negative" if negative else "grows without end"
        raise ValueError(
            f"k has no second derivative at x = z; the kernel is too rough (Matérn-1/2, "
            "exponential/Laplace, …, also with a small number under the root): "
            f"{where} autodiff returns M(x, x) = {got}, while M(x, x + h) {how} as h → 0. Use a "
            "kernel whose mixed derivative exists: Matérn with nu > 1 (hk.Matern(nu=1.5), …), "
            "hk.Gaussian, hk.RationalQuadratic."
        )
    if len(plateaus) > 1 and float(size_of(plateaus[0] - plateaus[1])) > 0.2 * scale:
        first, second = (_show(p / unit[:, None] / unit) for p in plateaus)
        raise ValueError(
            f"k has no second derivative at x = z: {where} the limit of M(x, x + h) depends on the "
            f"direction of h, {first} along one and {second} along another; autodiff returns "
            f"M(x, x) = {got}. The kernel has a kink, as the L1 distance Σ|x_a - z_a| has. "
            f"{PROFILE}"
        )
    limit = _show(plateaus[0] / unit[:, None] / unit) if len(plateaus) else None
    truth = f" The neighbours M(x, x + h) tend to {limit} as h → 0." if limit else ""
    if not finite:
        raise ValueError(
            f"NaN or inf in the derivatives of k {where}: M(x, x) = {got}.{truth} Likely cause: "
            "the square root of the squared distance, or a norm, whose derivative at zero is "
            f"infinite. {PROFILE}"
        )
    if len(plateaus) and float(size_of(one.block)) <= _VIOLATED * scale:
        raise ValueError(
            f"zero block: {where} autodiff returns M(x, x) = {got}.{truth} Likely cause: a safe "
            "norm (`jnp.where` around the square root, or a square root clipped from below), "
            "which removes the NaN at zero distance and the second derivative with it. "
            f"{PROFILE}"
        )
    if len(plateaus) and _rank_one(one.block) and not _rank_one(plateaus[0]):
        raise ValueError(
            f"rank-one block: {where} autodiff returns M(x, x) = {got}, of rank one.{truth} Likely "
            "cause: a distance that falls back to another one at zero (Σ|x_a - z_a| for the "
            f"Euclidean norm). {PROFILE}"
        )
    raise ValueError(
        f"wrong block: {where} autodiff returns M(x, x) = {got}, which is not the limit of its "
        f"neighbours M(x, x + h) as h → 0.{truth} Likely cause: a branch of k at small distances, "
        f"a wrong custom derivative rule, a kernel too rough to be differentiated, or rounding "
        "(points far from the origin compared with the lengthscale: centre them, use float64). "
        f"{PROFILE}"
    )


def _rank_one(block: np.ndarray) -> bool:
    values = np.linalg.svd(block, compute_uv=False)
    return len(values) > 1 and values[1] <= _VIOLATED * values[0]


def _show(block: np.ndarray) -> str:
    """A block for a message, without the rounding noise in its zeros."""
    block = np.where(np.abs(block) < 1e-6 * size_of(block), 0.0, block) + 0.0
    text = np.array2string(block, precision=4, threshold=16, edgeitems=2, separator=", ")
    return " ".join(text.split())
