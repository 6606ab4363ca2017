"""Linear least squares whose rows Φ are made in tiles and never stored.

minimise ‖Φw − y‖² + δ‖w‖² for a tall Φ (m, r). Two ways keep the digits that the normal equations
ΦᵀΦ would lose.

**A triangle.** The state is the triangular factor of [Φ y] alone, below √δ [I 0] from the start:
orthogonal transformations of the rows change no norm, so the factor of the rows seen so far, with
new rows below it, has the factor of all of them (Golub & Van Loan, section 6.5.3; Demmel et al.
(2012), "tall and skinny QR").

**Sums in the basis of a sample.** The normal equations lose the digits of the condition of
ΦᵀΦ + NλI, which is of order 1/λ, because small directions drown in the rounding of the large ones.
So the sums are over the rows ΦR⁻¹ instead, where RᵀR = ΦᵀΦ/N + λI on a sample of the data: in this
basis the system is near N times the identity and no direction is small. The rounding of ΦR⁻¹ is
left, of order ε/√λ, as with a QR of all rows, which costs several times as much and waits for
threads on a busy machine. This is the second pass of a Cholesky QR (Fukaya et al. (2020), "shifted
Cholesky QR"), whose first pass needs to see a sample only. Rows that the sample does not resemble
are treated no worse than by the normal equations.
"""

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.scipy.linalg import cho_solve, solve_triangular
from jaxtyping import Array, Float

from hamkernel._gram import constant, plus_ridge
from hamkernel._machine import RowSharding, on_each
from hamkernel._sizes import sizes

# A design gives the rows of some points at once: (t, n) -> (t, n, r), row (i, a) of a field's
# component a at point i.
Design = Callable[[Float[Array, "t n"]], Float[Array, "t n r"]]


def triangle_of_design(
    design: Design,
    columns: int,
    X: Float[Array, "N n"],
    Y: Float[Array, "N n"],
    ridge: Float[Array, ""],
    spread: RowSharding | None = None,
) -> Float[Array, "k k"]:
    """The upper triangular factor of √ridge [I 0] above [Φ y]: R, and Qᵀy beside it.

    From the start with the ridge: a QR of Φ alone, where it has fewer rows than columns, divides by
    the rounding errors of the dependent ones, again and again until these underflow to NaN.
    """

    def own_triangle(whole, X, Y):
        design, ridge = whole

        def step(factor, tile):
            rows = design(tile[0])  # (t, n, r)
            below = jnp.concatenate([rows, tile[1][..., None]], axis=2).reshape(-1, columns + 1)
            return jnp.linalg.qr(jnp.concatenate([factor, below]), mode="r"), None

        on_diagonal = jnp.append(jnp.full(columns, jnp.sqrt(ridge)), jnp.zeros((), Y.dtype))
        return over_tiles(step, jnp.diag(on_diagonal), (X, Y), _rows_of_tile(columns))[0]

    ridge = ridge if spread is None else ridge / spread.count
    return on_each(
        spread, own_triangle, (design, ridge), X, Y, joined=False, reduce=_merged_triangle
    )


def _merged_triangle(spread: RowSharding, own: Float[Array, "k k"]) -> Float[Array, "k k"]:
    """The triangular factor of the rows of all devices, from the factor `own` of each device.

    The factors are merged one after the other: no device holds more than two of them, and all
    devices get the same result.
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
    R = constant(triangle_of_design(fixed, columns, fixed_X, fixed_Y, fixed_ridge, spread))
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

    def own_residual(whole, X, Y):
        design, w = whole

        def step(_, tile):
            return None, tile[1] - design(tile[0]) @ w

        return over_tiles(step, None, (X, Y), _rows_of_tile(len(w)))[1]

    return on_each(spread, own_residual, (design, w), X, Y, joined=True)


def _correlations(design, X, Y, w, spread: RowSharding | None) -> Float[Array, " r"]:
    """Φᵀ(Y − Φw)."""

    def own_correlations(whole, X, Y):
        design, w = whole

        def step(total, tile):
            rows = design(tile[0])
            return total + jnp.einsum("inr,in->r", rows, tile[1] - rows @ w), None

        return over_tiles(step, jnp.zeros_like(w), (X, Y), _rows_of_tile(len(w)))[0]

    return on_each(spread, own_correlations, (design, w), X, Y, joined=False)


def over_tiles(step, carry, data: tuple[Array, Array], rows: int):
    """`jax.lax.scan` of `step` over tiles of `rows` rows of a design; the last tile may be smaller.

    A loop that is differentiated backward forgets the rule by which a Matérn kernel is smooth at
    x = z, and second derivatives are NaN: a single tile is therefore evaluated without a loop.
    Derivatives recompute the rows of a tile, which are not stored.
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


def _rows_of_tile(columns: int) -> int:
    """The rows of a tile.

    Appending `rows` rows to a factor of r columns costs (rows + r) r²; with 3r rows a quarter of
    that is spent on the factor.
    """
    return max(1024, 3 * columns)


class Normal(eqx.Module):
    """The sums over rows F with targets y; those of parts of the rows add up."""

    square: Float[Array, "r r"]  # FᵀF
    moment: Float[Array, " r"]  # Fᵀy
    energy: Float[Array, ""]  # yᵀy

    @classmethod
    def of(cls, rows: Float[Array, "D r"], y: Float[Array, " D"]) -> "Normal":
        """The sums over rows that were made already."""
        return cls(rows.T @ rows, rows.T @ y, y @ y)


class Sums(eqx.Module):
    """The sums over all rows seen so far, r² numbers. Rows are those of a design, times `basis`.

    Attributes:
        triangle: R, upper triangular, shape (r, r).
        basis: R⁻¹, or WR⁻¹ if Φ is a design times W, shape (r, r).
        seen: the sums over ΦR⁻¹ and y.
    """

    triangle: Float[Array, "r r"]
    basis: Float[Array, "r r"]
    seen: Normal


def first_sums(seen: Normal, W: Float[Array, "r r"], count: int, ridge: Float[Array, ""]) -> Sums:
    """The sums before the first row, in the basis of a sample and of λ = ridge.

    Args:
        seen: the sums over the rows of the sample, in the basis W.
        W: the matrix that the rows of the design are multiplied with.
        count: N, the observations in the sample.
        ridge: λ.

    Returns:
        The sums; NaN where the kernel is not finite, or λ below rounding.
    """
    R = jnp.linalg.cholesky(plus_ridge(seen.square / count, ridge)).T
    nothing = jax.tree.map(jnp.zeros_like, seen)
    return Sums(R, solve_triangular(R, W.T, trans="T").T, nothing)


def normal(
    design: Design,
    basis: Float[Array, "r r"],
    X: Float[Array, "N n"],
    Y: Float[Array, "N n"],
    spread: RowSharding | None = None,
) -> Normal:
    """The sums over the rows F = design(X) basis, tile by tile, on the devices where they are."""

    def own_sums(whole, X, Y):
        design, basis = whole

        def step(total, tile):
            rows = design(tile[0])  # (t, n, r)
            new = Normal.of(rows.reshape(-1, rows.shape[-1]) @ basis, tile[1].reshape(-1))
            return jax.tree.map(jnp.add, total, new), None

        square = jnp.zeros_like(basis)
        nothing = Normal(square, square[0], square[0, 0])
        at_once = max(1024, sizes().design_entries // len(basis))
        return over_tiles(step, nothing, (X, Y), at_once)[0]

    return on_each(spread, own_sums, (design, basis), X, Y, joined=False)


def solve_sums(
    sums: Sums, ridge: Float[Array, ""]
) -> tuple[Float[Array, " r"], Float[Array, ""], Float[Array, ""]]:
    """For the minimiser w: its weights in the design, ‖w‖, and ‖Φw − y‖; NaN if it fails.

    The last one has the digits of a difference of squares: it is good to 1e-8 ‖y‖ in float64.
    """
    R, seen = sums.triangle, sums.seen
    inverse = solve_triangular(R, jnp.eye(len(R), dtype=R.dtype))
    L = jnp.linalg.cholesky(seen.square + ridge * inverse.T @ inverse)
    v = cho_solve((L, True), seen.moment)
    norm = jnp.linalg.norm(inverse @ v)
    left = seen.energy - seen.moment @ v - ridge * norm**2
    return sums.basis @ v, norm, jnp.sqrt(jnp.maximum(left, jnp.zeros_like(left)))


def trace_of_sums(sums: Sums) -> Float[Array, ""]:
    """The trace of ΦᵀΦ."""
    return jnp.sum((sums.seen.square @ sums.triangle) * sums.triangle)
