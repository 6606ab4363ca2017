"""Linear least squares whose rows are made in tiles and never stored.

minimise ‖Φw − y‖² + δ‖w‖² for a tall Φ (m, r) that is never stored. The state is the triangular
factor of [Φ y] alone, below √δ [I 0] from the start: orthogonal transformations of the rows change
no norm, so the factor of the rows seen so far, with new rows below it, has the factor of all of
them (Golub & Van Loan, section 6.5.3; Demmel et al. (2012), "tall and skinny QR"). The normal
equations ΦᵀΦ would have the same size and half of the digits.
"""

from collections.abc import Callable

import jax
import jax.numpy as jnp
from jax.scipy.linalg import solve_triangular
from jaxtyping import Array, Float

from hamkernel._gram.derivatives import constant
from hamkernel._machine import RowSharding, on_each

# A design gives the rows of some points at once: (t, n) -> (t, n, r), row (i, a) of a field's
# component a at point i.
Design = Callable[[Float[Array, "t n"]], Float[Array, "t n r"]]


def triangle(
    design: Design,
    columns: int,
    X: Float[Array, "N n"],
    Y: Float[Array, "N n"],
    ridge: Float[Array, ""],
    spread: RowSharding | None = None,
) -> Float[Array, "k k"]:
    """The upper triangular factor of √ridge [I 0] above [Φ y]: R, and Qᵀy beside it.

    From the start with the ridge: a QR of Φ alone, where it has fewer rows than columns, divides by
    what rounding leaves of the dependent ones, again and again until that underflows to NaN.
    """
    if spread is not None:

        def part(whole, X, Y):
            design, ridge = whole
            return _joined(spread, triangle(design, columns, X, Y, ridge / spread.count))

        return on_each(spread, part, (design, ridge), X, Y, joined=False)

    def step(factor, tile):
        rows = design(tile[0])  # (t, n, r)
        below = jnp.concatenate([rows, tile[1][..., None]], axis=2).reshape(-1, columns + 1)
        return jnp.linalg.qr(jnp.concatenate([factor, below]), mode="r"), None

    on_diagonal = jnp.append(jnp.full(columns, jnp.sqrt(ridge)), jnp.zeros((), Y.dtype))
    return over_tiles(step, jnp.diag(on_diagonal), (X, Y), _rows(columns))[0]


def _joined(spread: RowSharding, own: Float[Array, "k k"]) -> Float[Array, "k k"]:
    """The factor of the rows of all devices, of which each has its `own`.

    One factor after the other, so that no device holds more than two, and all get the same.
    """

    def join(device, factor):
        is_mine = jax.lax.axis_index(spread.axes) == device
        theirs = spread.sum(jnp.where(is_mine, own, jnp.zeros_like(own)))
        return jnp.linalg.qr(jnp.concatenate([factor, theirs]), mode="r")

    return jax.lax.fori_loop(0, spread.count, join, jnp.zeros_like(own))


def ridge_regression(
    design: Design,
    columns: int,
    X: Float[Array, "N n"],
    Y: Float[Array, "N n"],
    ridge: Float[Array, ""],
    spread: RowSharding | None = None,
) -> tuple[Float[Array, " r"], Float[Array, "N n"]]:
    """The minimiser w of ‖Y − Φw‖² + ridge ‖w‖², and the residual Y − Φw.

    O(N n r²) time and O(r² + N n) memory. Differentiable to every order with respect to the data,
    the ridge and the arrays in `design`, which must be a PyTree.

    Args:
        design: the rows Φ, (t, n) -> (t, n, r).
        columns: r.
        X: points.
        Y: targets.
        ridge: δ > 0.
        spread: the devices over which points and targets are spread, if they are.
    """
    fixed, fixed_X, fixed_Y, fixed_ridge = constant((design, X, Y, ridge))
    R = constant(triangle(fixed, columns, fixed_X, fixed_Y, fixed_ridge, spread))
    R, rotated = R[:-1, :-1], R[:-1, -1]
    w = solve_triangular(R, rotated)

    # One step of iterative refinement, w + H⁻¹(Φᵀ(y − Φw) − δw) with H = ΦᵀΦ + δI = RᵀR. It equals
    # H⁻¹Φᵀy for every w, so that its derivatives are exact although w and R are held constant,
    # and no derivative of a QR is needed (it does not exist where R is singular).
    def times_H(v):
        return ridge * v - _correlations(design, X, jnp.zeros_like(Y), v, spread)

    def times_inverse(_, v):
        return solve_triangular(R, solve_triangular(R, v, trans="T"))

    slope = _correlations(design, X, Y, w, spread) - ridge * w
    w = w + jax.lax.custom_linear_solve(times_H, slope, times_inverse, symmetric=True)
    return w, residual(design, X, Y, w, spread)


def residual(
    design: Design,
    X: Float[Array, "N n"],
    Y: Float[Array, "N n"],
    w: Float[Array, " r"],
    spread: RowSharding | None = None,
) -> Float[Array, "N n"]:
    """Y − Φw, tile by tile, where the rows are."""
    if spread is not None:

        def part(whole, X, Y):
            return residual(whole[0], X, Y, whole[1])

        return on_each(spread, part, (design, w), X, Y, joined=True)

    def step(_, tile):
        return None, tile[1] - design(tile[0]) @ w

    return over_tiles(step, None, (X, Y), _rows(len(w)))[1]


def _correlations(design, X, Y, w, spread: RowSharding | None) -> Float[Array, " r"]:
    """Φᵀ(Y − Φw)."""
    if spread is not None:

        def part(whole, X, Y):
            return spread.sum(_correlations(whole[0], X, Y, whole[1], None))

        return on_each(spread, part, (design, w), X, Y, joined=False)

    def step(total, tile):
        rows = design(tile[0])
        return total + jnp.einsum("inr,in->r", rows, tile[1] - rows @ w), None

    return over_tiles(step, jnp.zeros_like(w), (X, Y), _rows(len(w)))[0]


def over_tiles(step, carry, data: tuple[Array, Array], rows: int):
    """`jax.lax.scan` of `step` over tiles of so many rows of a design, the last one after it.

    A loop, when differentiated backward, forgets the rule by which a Matérn kernel is smooth at
    x = z, and second derivatives are NaN: where one tile will do there is none. Derivatives
    recompute the rows of a tile: they are not kept.
    """
    N, n = data[1].shape
    size = rows // n + 1
    full = (N - 1) // size
    step = jax.checkpoint(step)
    outs = []
    if full:
        tiles = jax.tree.map(lambda a: a[: full * size].reshape(full, size, -1), data)
        carry, out = jax.lax.scan(step, carry, tiles)
        outs.append(jax.tree.map(lambda a: a.reshape(-1, n), out))
    carry, out = step(carry, jax.tree.map(lambda a: a[full * size :], data))
    outs.append(out)
    return carry, jax.tree.map(lambda *parts: jnp.concatenate(parts), *outs)


def _rows(columns: int) -> int:
    """Of a tile. A factorisation below R costs (rows + r) r²: 3r lose a quarter to repeating R."""
    return max(1024, 3 * columns)
