"""Least squares over a stream by sums that keep their digits: matrix products only.

minimise ‖Φw − y‖² + Nλ‖w‖² for rows Φ that are seen once. The normal equations lose the digits of
the condition of ΦᵀΦ + NλI, which is of order 1/λ, because small directions drown in the rounding
of the large ones. So the sums are over the rows ΦR⁻¹ instead, where RᵀR = ΦᵀΦ/N + λI on a sample of
the data: in this basis the system is near N times the identity and no direction is small. What is
left is the rounding of ΦR⁻¹, of order eps/√λ, as with a QR of all rows, which costs several times
as much and waits for threads on a busy machine. This is the second pass of a Cholesky QR (Fukaya et
al. (2020), "shifted Cholesky QR"), whose first pass needs to see a sample only.

Rows that the sample does not resemble are treated no worse than by the normal equations.
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.scipy.linalg import cho_solve, solve_triangular
from jaxtyping import Array, Float

from hamkernel._gram.dense import plus_ridge
from hamkernel._machine import RowSharding, on_each
from hamkernel._solvers.tall_least_squares import Design, over_tiles

# Numbers in the tile of rows that is held at once; see `_gram/operator.py`.
TILE = 2**20


class Normal(NamedTuple):
    """The sums over rows F with targets y; those of parts of the rows add up."""

    square: Float[Array, "r r"]  # FᵀF
    moment: Float[Array, " r"]  # Fᵀy
    energy: Float[Array, ""]  # yᵀy

    @classmethod
    def zero(cls, basis: Float[Array, "r r"]) -> "Normal":
        """The sums over no rows in a basis."""
        square = jnp.zeros_like(basis)
        return cls(square, square[0], square[0, 0])

    def plus(self, F: Float[Array, "D r"], y: Float[Array, " D"]) -> "Normal":
        """The sums with more rows."""
        return Normal(self.square + F.T @ F, self.moment + F.T @ y, self.energy + y @ y)


class Sums(eqx.Module):
    """What has been seen, in r² numbers. Rows are those of a design, times `basis`.

    Attributes:
        triangle: R, upper triangular, shape (r, r).
        basis: R⁻¹, or WR⁻¹ if Φ is a design times W, shape (r, r).
        seen: the sums over ΦR⁻¹ and y.
    """

    triangle: Float[Array, "r r"]
    basis: Float[Array, "r r"]
    seen: Normal


def start(seen: Normal, W: Float[Array, "r r"], count: int, ridge: Float[Array, ""]) -> Sums:
    """The sums before the first row, in the basis of a sample and of λ = ridge.

    Args:
        seen: the sums over the rows of the sample, in the basis W.
        W: what the rows of the design are multiplied with.
        count: N, the observations in the sample.
        ridge: λ.

    Returns:
        The sums; NaN where the kernel is not finite, or λ below rounding.
    """
    R = jnp.linalg.cholesky(plus_ridge(seen.square / count, ridge)).T
    nothing = jax.tree.map(jnp.zeros_like, seen)
    return Sums(R, solve_triangular(R, W.T, trans="T").T, nothing)


def add(
    sums: Sums,
    design: Design,
    X: Float[Array, "N n"],
    Y: Float[Array, "N n"],
    spread: RowSharding | None = None,
) -> Sums:
    """The sums after the rows design(X) with targets Y."""
    new = normal(design, sums.basis, X, Y, spread)
    return Sums(sums.triangle, sums.basis, jax.tree.map(jnp.add, sums.seen, new))


def add_rows(sums: Sums, rows: Float[Array, "D r"], y: Float[Array, " D"]) -> Sums:
    """The sums after rows of the design that were made already, with targets y."""
    return Sums(sums.triangle, sums.basis, sums.seen.plus(rows @ sums.basis, y))


def normal(
    design: Design,
    basis: Float[Array, "r r"],
    X: Float[Array, "N n"],
    Y: Float[Array, "N n"],
    spread: RowSharding | None = None,
) -> Normal:
    """The sums over the rows F = design(X) basis, tile by tile, on the devices where they are."""
    if spread is not None:

        def part(whole, X, Y):
            design, basis = whole
            return spread.sum(normal(design, basis, X, Y))

        return on_each(spread, part, (design, basis), X, Y, joined=False)

    def step(total, tile):
        rows = design(tile[0])  # (t, n, r)
        return total.plus(rows.reshape(-1, rows.shape[-1]) @ basis, tile[1].reshape(-1)), None

    return over_tiles(step, Normal.zero(basis), (X, Y), max(1024, TILE // len(basis)))[0]


def solve(
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


def trace(sums: Sums) -> Float[Array, ""]:
    """The trace of ΦᵀΦ."""
    return jnp.sum((sums.seen.square @ sums.triangle) * sums.triangle)
