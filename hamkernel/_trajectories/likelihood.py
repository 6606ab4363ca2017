"""The field given the rows, in closed form, and their marginal likelihood.

In the span of landmarks S, g(x) = K(x, S) T w with T = L⁻ᵀ, L Lᵀ = K(S, S) and w ~ N(0, I).
Whitened rows M w + ε = r, ε ~ N(0, I), give

    (I + MᵀM) w = Mᵀ r,
    −2 log p = ‖r − Mw‖² + ‖w‖² + log det(I + MᵀM) + Σ log s,

up to a constant. We compute all terms from the triangle of the QR factorisation of (I, 0) above
(M, r). For small noise the triangle keeps digits that I + MᵀM loses. Rows are added to the triangle
a strip at a time.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax.scipy.linalg import solve_triangular
from jaxtyping import Array, Float

from hamkernel._machine import compiled_by_size
from hamkernel._solvers.triangle import append_rows, no_rows
from hamkernel._trajectories.kalman import whiten
from hamkernel._trajectories.model import Model, landmark_whitening
from hamkernel._trajectories.segments import LinearisedSegments


class Condensed(NamedTuple):
    """The information of the rows about the weights w, in O(q²) memory.

    Attributes:
        T: the whitening of the landmarks, shape (q, q).
        triangle: the triangle of the QR factorisation of (M̃, r̃), shape (q + 1, q + 1).
        constant: the part of −log p that does not depend on M̃.
        scatter: the sum of squares of samples about their means, the rows, in units of σ².
        samples: the number of samples, less n for each start.
        rows: the number of rows, less n for each start.
    """

    T: Float[Array, "q q"]
    triangle: Float[Array, "k k"]
    constant: Float[Array, ""]
    scatter: Float[Array, ""]
    samples: Float[Array, ""]
    rows: Float[Array, ""]


class ClosedForm(NamedTuple):
    """The field given the rows, and the marginal likelihood of the rows.

    Attributes:
        weights: w, shape (q,); ‖f‖² = ‖w‖².
        points: the landmarks, shape (m, d).
        coefficients: T w, shape (m, n).
        free: the number of rows less the number of parameters that they determine, shape ().
        used: the number of parameters that the rows determine, tr M̃ (I + M̃ᵀM̃)⁻¹ M̃ᵀ.
        squares: ‖r̃ − M̃w‖².
        loss: −log p(rows), up to a constant.
    """

    weights: Float[Array, " q"]
    points: Float[Array, "m d"]
    coefficients: Float[Array, "m n"]
    free: Float[Array, ""]
    used: Float[Array, ""]
    squares: Float[Array, ""]
    loss: Float[Array, ""]


@compiled_by_size
def condense(model: Model, S, rows: LinearisedSegments, start_deviation) -> Condensed:
    """The rows in the triangle of their QR factorisation, a strip at a time."""
    T = landmark_whitening(model.kernel, S)
    (size, samples, n), q = rows.counts.shape, len(T)
    # Strips have twice as many rows as columns: in smaller strips the triangle is most of the work.
    count = 1
    while size % (2 * count) == 0 and size // (2 * count) * samples * n >= 2 * q:
        count *= 2

    def strip(F, part):
        made = whiten(model, S, T, part, start_deviation)
        return append_rows(F, made.M, made.r), made.constant

    parts = jax.tree.map(lambda a: a.reshape(count, -1, *a.shape[1:]), rows)
    F, constant = jax.lax.scan(strip, jnp.zeros((q + 1, q + 1), T.dtype), parts)
    started = (rows.counts.any(axis=(1, 2)).sum() * n).astype(T.dtype)
    scatter = (rows.scatter.sum((0, 1)) @ jnp.exp(-2 * model.log_noise)).astype(T.dtype)
    count, samples = (rows.counts > 0).sum().astype(T.dtype), rows.counts.sum().astype(T.dtype)
    sizes = samples - started, count - started
    return Condensed(T, F, constant.sum(), scatter, *sizes)


@compiled_by_size
def conditional(information: Condensed, S, shift: Array | float = 0.0) -> ClosedForm:
    """The field for rows whose noise is exp(shift) times what it was.

    The prior of the starts does not scale with the rows; it is so wide that this does not matter.
    """
    q, scale = len(information.T), jnp.exp(-shift)
    there = scale * information.triangle
    F = append_rows(no_rows(q, there.dtype), there[:, :q], there[:, q])
    R = F[:q, :q]
    w = solve_triangular(R, F[:q, q])
    inverse = solve_triangular(R, jnp.eye(q, dtype=R.dtype))
    # tr M̃(I + M̃ᵀM̃)⁻¹M̃ᵀ = q − tr (I + M̃ᵀM̃)⁻¹ = q − ‖R⁻¹‖²
    used = q - jnp.sum(inverse**2)
    loss = 0.5 * F[q, q] ** 2 + jnp.log(jnp.abs(jnp.diagonal(R))).sum() + information.constant
    loss = loss + shift * information.samples + 0.5 * (scale**2 - 1) * information.scatter
    squares = F[q, q] ** 2 - w @ w
    coefficients = (information.T @ w).reshape(len(S), -1)
    return ClosedForm(w, S, coefficients, information.rows - used, used, squares, loss)


def closed_form(model: Model, S, rows: LinearisedSegments, start_deviation) -> ClosedForm:
    """The field given the rows."""
    return conditional(condense(model, S, rows, start_deviation), S)
