"""Whether M(x, x) is the limit of its neighbours M(x, x + h), and what is wrong where it is not."""

from typing import NamedTuple

import numpy as np

from hamkernel._checks.pairs import Pairs, lowest, size_of

_SHRINK = 4.0  # ratio of one step to the next
_SETTLED, _VIOLATED = 0.03, 0.05  # plateau of M(x, x + h); negative eigenvalue of a pair
_STEADY = 5  # steps of growth in a row, 4⁵ = 1000 in distance: more than a sound kernel has
_CLOSE = 0.01  # change of k, relative to k, within which a neighbour counts as near
_TAIL = 0.1  # change of k, relative to its largest, beyond which h is no small step

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
    """Compare M(x, x) with M(x, x + h) at every point of `near`, direction and step."""
    measures = _measured(diagonal, between, beyond)
    settled = measures.close & (measures.change <= _SETTLED) & (size_of(measures.block) >= 0.1)
    has_limit = np.asarray(settled.any(axis=-1))

    violation = _violation(measures)
    blatant = measures.close & (measures.change <= 10 * _SETTLED) & (violation > 10 * _VIOLATED)
    violated = ((settled & (violation > _VIOLATED)) | blatant).any(axis=-1)

    grows, endless = _growth(measures, size_of(diagonal.block))
    growing = (grows & ~has_limit) | endless
    missed = _never_reached(measures, eps) & (has_limit | growing)

    pairs = zip(diagonal.block, diagonal.gradient, strict=True)
    broken = np.array([not (np.isfinite(b).all() and np.isfinite(g).all()) for b, g in pairs])
    wrong = missed | violated | broken[:, None] | endless
    plateau = np.where(has_limit[..., None], settled, blatant)
    change = measures.change
    return [
        _Near(index, diagonal.block[i], between.block[i], plateau[i], change[i], growing[i], bad)
        for i, (index, bad) in enumerate(zip(near, wrong, strict=True))
    ]


class _Measures(NamedTuple):
    """The blocks of P points, D directions and J steps, and how much k and they move.

    Blocks are in the unit of their step, the largest block of any point at that step: one that
    happens to vanish, such as that of (x·z)² at the origin, is then no fault, and a diverging one
    stays one.
    """

    own: np.ndarray  # (P, D, J, n, n): M(x, x)
    block: np.ndarray  # (P, D, J, n, n): M(x, x + h)
    after: np.ndarray  # (P, D, J, n, n): M(x + h, x + h)
    unit: np.ndarray  # (J,)
    raw: np.ndarray  # (P, D, J): the size of M(x, x + h), in no unit
    finite: np.ndarray  # (P, D, J): whether M(x, x + h) is
    # ‖φ(x) − φ(x + h)‖², the distance in feature space, as a fraction of its largest value.
    moved: np.ndarray  # (P, D, J)
    change: np.ndarray  # (P, D, J): of M(x, x + h) to the next step; ∞ after the last

    @property
    def close(self) -> np.ndarray:
        return self.finite & (self.moved <= _CLOSE)


def _measured(diagonal: Pairs, between: Pairs, beyond: Pairs) -> _Measures:
    own = np.broadcast_to(diagonal.block[:, None, None], between.block.shape)
    scale = np.stack([size_of(own), size_of(between.block), size_of(beyond.block)])
    scale = scale.max(axis=(0, 1, 2))  # (J,)
    unit = np.where(scale > 0, scale, 1.0)
    own, block, after = (b / unit[:, None, None] for b in (own, between.block, beyond.block))
    finite = np.asarray(np.isfinite(block).all(axis=(-2, -1)))

    k_own = diagonal.k[:, None, None]
    largest = np.asarray(np.abs(k_own) + np.abs(beyond.k))
    moved = np.abs(k_own + beyond.k - 2 * between.k) / np.where(largest > 0, largest, 1.0)

    # The next step, in the unit of this one.
    later = np.roll(between.block, -1, axis=2) / unit[:, None, None]
    both = finite & np.isfinite(later).all(axis=(-2, -1))
    change = np.where(both, size_of(block - later), np.inf)
    change[:, :, -1] = np.inf
    raw = size_of(between.block)
    return _Measures(own, block, after, unit, raw, finite, np.asarray(moved), change)


def _violation(measures: _Measures) -> np.ndarray:
    """By how much the matrix of the blocks of x and x + h is not positive, (P, D, J)."""
    own, block, after = measures.own, measures.block, measures.after
    pair = np.block([[own, block], [np.swapaxes(block, -1, -2), after]])
    return np.minimum(size_of(block - own), -lowest(pair))


def _never_reached(measures: _Measures, eps: float) -> np.ndarray:
    """Whether no M(x, x + h) comes near to M(x, x), though h becomes small, (P, D).

    A Matérn-3/2 block moves by 2√3 r while k moves by 3r²/2 (r = ‖h‖/ℓ), the slowest of the sound
    kernels. Where k has moved more than that, h is not small yet: no verdict. Where all blocks
    shrink to zero together (an indefinite k with a flat top), the largest of the near ones at this
    step or before is the measure.
    """
    tolerance = eps**0.25
    near = np.where(measures.close, measures.raw, 0.0)
    largest = np.maximum(1.0, np.maximum.accumulate(near, axis=-1) / measures.unit)
    off = size_of(measures.block - measures.own)
    reached = measures.finite & (off <= tolerance * largest)
    judged = measures.finite & (measures.moved <= tolerance**2 / 8)
    return judged.any(axis=-1) & ~reached.any(axis=-1)


def _growth(measures: _Measures, own: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Whether M(x, x + h) grows in almost all steps, and whether over decades of h; (P, D) each.

    A block of a sound kernel with a second, unresolved scale may grow, but not beyond M(x, x), of
    the sizes `own`, (P,). It passes a scale in a step or two: growth over decades is a kernel of
    the distance, also where a term under the root stops it in the end, and M(x, x) is then a delta
    beside the rest. The tails of a sound kernel grow over decades as well. There k has moved by
    all that it can, which beside a large constant is not much.
    """
    raw, moved = measures.raw, np.where(measures.finite, measures.moved, 0.0)
    ratio = raw[:, :, 1:] / np.where(raw[:, :, :-1] > 0, raw[:, :, :-1], np.inf)
    both = measures.close[:, :, 1:] & measures.close[:, :, :-1]
    grown = both & (ratio > 1.3)
    steps = both.sum(axis=-1)
    grows = (steps >= 3) & (grown.sum(axis=-1) > 0.8 * steps)
    grows &= raw.max(axis=-1) > 2 * own[:, None]
    in_tail = moved > _TAIL * moved.max(axis=-1, keepdims=True)
    run = longest = np.zeros(steps.shape, int)
    for step in np.moveaxis(grown & ~in_tail[:, :, :-1], -1, 0):
        run = np.where(step, run + 1, 0)
        longest = np.maximum(longest, run)
    return grows, longest >= _STEADY


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
