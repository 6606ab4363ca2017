"""Linear least squares whose rows are made in tiles and never stored.

minimise ‖Φw − y‖² + δ‖w‖² for a tall Φ (m, r) that is never stored. The state is the triangular
factor of [Φ y] alone: orthogonal transformations of the rows change no norm, so the factor of the
rows seen so far, with new rows below it, has the factor of all of them (Golub & Van Loan, section
6.5.3; Demmel et al. (2012), "tall and skinny QR"). The normal equations ΦᵀΦ would have the same
size and half of the digits.
"""

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.scipy.linalg import solve_triangular
from jaxtyping import Array, Float

from hamkernel._devices import Rows, on_each
from hamkernel._trained import constant

# A design gives the rows of some points at once: (t, n) -> (t, n, r), row (i, a) of a field's
# component a at point i.
Design = Callable[[Float[Array, "t n"]], Float[Array, "t n r"]]


class LeastSquares(eqx.Module):
    """The rows and targets seen so far, compressed to O(r²) numbers.

    Attributes:
        factor: upper triangular factor of [Φ y], shape (r + 1, r + 1): R, Qᵀy beside it, and in
            the corner the norm of what no w can fit.
    """

    factor: Float[Array, "k k"]

    @staticmethod
    def empty(columns: int, dtype: jnp.dtype | type) -> "LeastSquares":
        """The state before the first row, for `columns` = r unknowns."""
        return LeastSquares(jnp.zeros((columns + 1, columns + 1), dtype))


@eqx.filter_jit
def accumulate(
    state: LeastSquares, rows: Float[Array, "m r"], targets: Float[Array, " m"]
) -> LeastSquares:
    """The state after some more rows; O((m + r) r²) time, O((m + r) r) memory."""
    below = jnp.concatenate([rows, targets[:, None]], axis=1)
    stacked = jnp.concatenate([state.factor, below])
    return LeastSquares(jnp.linalg.qr(stacked, mode="r"))


def _with_ridge(state: LeastSquares, ridge: Float[Array, ""]):
    r = len(state.factor) - 1
    below = jnp.sqrt(ridge) * jnp.eye(r, r + 1, dtype=state.factor.dtype)
    factor = jnp.linalg.qr(jnp.concatenate([state.factor, below]), mode="r")
    return factor[:r, :r], factor[:r, r]


def accumulate_data(
    state: LeastSquares,
    design: Design,
    X: Float[Array, "N n"],
    Y: Float[Array, "N n"],
    spread: Rows | None = None,
) -> LeastSquares:
    """The state after the rows design(X) with targets Y, tile by tile, where the rows are."""
    if spread is not None:

        def part(whole, X, Y):
            state, design = whole
            own = LeastSquares(jnp.zeros_like(state.factor))
            return _with_all(spread, state, accumulate_data(own, design, X, Y))

        return on_each(spread, part, (state, design), X, Y, joined=False)

    def step(state, tile):
        rows = design(tile[0])  # (t, n, r)
        return accumulate(state, rows.reshape(-1, rows.shape[-1]), tile[1].reshape(-1)), None

    return over_tiles(step, state, (X, Y), columns=len(state.factor) - 1)[0]


def _with_all(spread: Rows, state: LeastSquares, own: LeastSquares) -> LeastSquares:
    """The state after the rows of each device, of which it has its `own` factor.

    One factor after the other, so that no device holds more than two, and all get the same.
    """

    def join(device, factor):
        is_mine = jax.lax.axis_index(spread.axes) == device
        theirs = spread.sum(jnp.where(is_mine, own.factor, jnp.zeros_like(factor)))
        return jnp.linalg.qr(jnp.concatenate([factor, theirs]), mode="r")

    return LeastSquares(jax.lax.fori_loop(0, spread.count, join, state.factor))


def ridge_regression(
    design: Design,
    columns: int,
    X: Float[Array, "N n"],
    Y: Float[Array, "N n"],
    ridge: Float[Array, ""],
    spread: Rows | None = None,
) -> tuple[Float[Array, " r"], Float[Array, "N n"]]:
    """The minimiser w of ‖Y − Φw‖² + ridge ‖w‖², and the residual Y − Φw.

    O(N n r²) time and O(r² + N n) memory. Differentiable to every order with respect to the data,
    the ridge and the arrays in `design`, which must be a PyTree.

    Args:
        design: the rows Φ, (t, n) -> (t, n, r).
        columns: r.
        X: points.
        Y: targets.
        ridge: δ ≥ 0; with δ = 0 the columns of Φ must be independent.
        spread: the devices over which points and targets are spread, if they are.
    """
    fixed, fixed_X, fixed_Y, fixed_ridge = constant((design, X, Y, ridge))
    state = LeastSquares.empty(columns, X.dtype)
    state = accumulate_data(state, fixed, fixed_X, fixed_Y, spread)
    triangle, rotated = _with_ridge(state, fixed_ridge)
    w = constant(solve_triangular(triangle, rotated))
    triangle = constant(triangle)

    # One step of iterative refinement, w + H⁻¹(Φᵀ(y − Φw) − δw) with H = ΦᵀΦ + δI = RᵀR. It equals
    # H⁻¹Φᵀy for every w, so that its derivatives are exact although w and R are held constant,
    # and no derivative of a QR is needed (it does not exist where R is singular).
    def times_H(v):
        return ridge * v - _correlations(design, X, jnp.zeros_like(Y), v, spread)

    def times_inverse(_, v):
        return solve_triangular(triangle, solve_triangular(triangle, v, trans="T"))

    slope = _correlations(design, X, Y, w, spread) - ridge * w
    w = w + jax.lax.custom_linear_solve(times_H, slope, times_inverse, symmetric=True)
    return w, residual(design, X, Y, w, spread)


def residual(
    design: Design,
    X: Float[Array, "N n"],
    Y: Float[Array, "N n"],
    w: Float[Array, " r"],
    spread: Rows | None = None,
) -> Float[Array, "N n"]:
    """Y − Φw, tile by tile, where the rows are."""
    if spread is not None:

        def part(whole, X, Y):
            return residual(whole[0], X, Y, whole[1])

        return on_each(spread, part, (design, w), X, Y, joined=True)

    def step(_, tile):
        return None, tile[1] - design(tile[0]) @ w

    return over_tiles(step, None, (X, Y), columns=len(w))[1]


def _correlations(design, X, Y, w, spread: Rows | None) -> Float[Array, " r"]:
    """Φᵀ(Y − Φw)."""
    if spread is not None:

        def part(whole, X, Y):
            return spread.sum(_correlations(whole[0], X, Y, whole[1], None))

        return on_each(spread, part, (design, w), X, Y, joined=False)

    def step(total, tile):
        rows = design(tile[0])
        return total + jnp.einsum("inr,in->r", rows, tile[1] - rows @ w), None

    return over_tiles(step, jnp.zeros_like(w), (X, Y), columns=len(w))[0]


def over_tiles(step, carry, data: tuple[Array, Array], columns: int):
    """`jax.lax.scan` of `step` over tiles of points, the last one shorter.

    A factorisation of a tile on top of R costs (tile rows + r) r², so tiles of 3r rows lose a
    quarter to the repetition of R. Derivatives recompute the rows of a tile: they are not kept.
    """
    N, n = data[0].shape
    size = max(1024, 3 * columns) // n + 1
    tiles, rest = divmod(N, size)
    step = jax.checkpoint(step)
    outs = []
    if tiles:
        full = jax.tree.map(lambda a: a[: tiles * size].reshape(tiles, size, n), data)
        carry, out = jax.lax.scan(step, carry, full)
        outs.append(jax.tree.map(lambda a: a.reshape(-1, n), out))
    if rest:
        carry, out = step(carry, jax.tree.map(lambda a: a[tiles * size :], data))
        outs.append(out)
    return carry, jax.tree.map(lambda *parts: jnp.concatenate(parts), *outs)
