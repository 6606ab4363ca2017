"""A = ΦΦᵀ + δI for features Φ (D, r): O(D r²) time, whatever is held out.

With the thin factorisation of a stack, [Φ; √δ I] = [Q; P] R, R upper triangular,

    M = ΦᵀΦ + δI = RᵀR,   C = A⁻¹ = (I − QQᵀ)/δ,   log det A = log det M + (D − r) log δ,
    (C_SS)⁻¹ = δ (I − Q_S Q_Sᵀ)⁻¹ = δ (I + Q_S (I − Q_SᵀQ_S)⁻¹ Q_Sᵀ),

where the last form (Woodbury) serves folds with more rows than features. Cholesky's QR, done twice,
gives Q and R by matrix products alone, and Q is orthonormal to rounding if cond(A) < 1/ε. One pass,
R from M and Q_S = Φ_S R⁻¹, would give I − Q_S Q_Sᵀ, which can be as small as 1/cond(A), an error of
ε cond(A).

The derivatives use CΦ = ΦM⁻¹ and C²Φ = ΦM⁻².

If the rows contain an unknown constant along the unit vector p, C is the projected inverse defined
in `factors.py`. Replace Φ by (I − ppᵀ)Φ; then C = (I − ppᵀ − QQᵀ)/δ, so the code stores p as one
more column of Q.

Source: Yamamoto, Nakatsukasa, Yanagisawa & Fukaya (2015), ETNA 44, on the second pass.
"""

import jax
import jax.numpy as jnp
from jax.tree_util import Partial
from jaxtyping import Array, Float

from hamkernel._gram import plus_ridge
from hamkernel._machine import full_precision
from hamkernel._solvers.factors import (
    AbstractFactor,
    AbstractInverse,
    AbstractSystem,
    BlockSolver,
    Group,
    backward,
    cholesky,
    cholesky_solver,
    forward,
)


class LowRankSystem(AbstractSystem):
    """The features and the ridge that A is made of.

    Attributes:
        rows: Φ, shape (D, r).
        ridge: δ, shape ().
        constant: p, shape (D,), not differentiated; None if no row contains an unknown constant.
    """

    rows: Float[Array, "D r"]
    ridge: Float[Array, ""]
    constant: Float[Array, " D"] | None = None

    def factor(self) -> "LowRankFactor":
        return LowRankFactor(self)


class LowRankFactor(AbstractFactor[LowRankSystem], AbstractInverse[LowRankSystem]):
    """The factors Q and R, from which both A and A⁻¹ are applied.

    Attributes:
        rows: Φ.
        ridge: δ.
        Q: the orthonormal factor of Φ, shape (D, r), with p as one more column if there is one.
        R: the triangular factor, shape (r, r).
        size: the Frobenius norm of M = ΦᵀΦ + δI, used as an estimate of ‖A‖. (A has the
            eigenvalues of M, and δ once more for every row beyond the number of features.)
    """

    rows: Float[Array, "D r"]
    ridge: Float[Array, ""]
    Q: Float[Array, "D q"]
    R: Float[Array, "r r"]
    size: Float[Array, ""]

    def __init__(self, system: LowRankSystem):
        self.rows, self.ridge, p = system.rows, system.ridge, system.constant
        rows = self.rows
        if p is not None:
            p = jax.lax.stop_gradient(p)
            rows = rows - jnp.outer(p, p @ rows)
        square = plus_ridge(gram_of_columns(rows), self.ridge)
        self.size = jnp.linalg.norm(square)
        first = cholesky(square)
        Q = _right_solve(first, rows)
        P = jnp.sqrt(self.ridge) * backward(first, jnp.eye(len(first), dtype=rows.dtype))
        second = cholesky(gram_of_columns(Q) + gram_of_columns(P))
        Q = _right_solve(second, Q)
        self.Q = Q if p is None else jnp.column_stack([Q, p])
        self.R = second @ first

    @property
    def _free(self) -> int:
        """D − q, the dimension of the complement of the columns of Q, on which C = I/δ."""
        return len(self.rows) - self.Q.shape[1]

    @property
    def _images(self) -> Float[Array, "D r"]:
        """CΦ = Q R⁻ᵀ."""
        return _right_solve(self.R, self.Q[:, : len(self.R)], transposed=True)

    def solve(self, b: Float[Array, "D *m"]) -> Float[Array, "D *m"]:
        return (b - self.Q @ (self.Q.T @ b)) / self.ridge

    def solve_with_form(self, y: Float[Array, " D"]) -> tuple[Float[Array, " D"], Float[Array, ""]]:
        # yᵀA⁻¹y = ‖y − Φw‖²/δ + ‖w‖² with the weights w = M⁻¹Φᵀy = R⁻¹Qᵀy of the fit
        rotated = self.Q.T @ y
        residual = y - self.Q @ rotated
        w = backward(self.R, rotated[: len(self.R), None])[:, 0]
        return residual / self.ridge, residual @ residual / self.ridge + w @ w

    @property
    def log_det(self) -> Float[Array, ""]:
        return 2 * jnp.sum(jnp.log(jnp.diagonal(self.R))) + self._free * jnp.log(self.ridge)

    @property
    def inverse_trace(self) -> Float[Array, ""]:
        # tr C = (D − ‖Q‖²)/δ, ‖Q‖² + ‖P‖² = q and P = √δ R⁻¹, so tr C = (D − q)/δ + ‖R⁻¹‖².
        root = backward(self.R, jnp.eye(len(self.R), dtype=self.R.dtype))
        return self._free / self.ridge + jnp.sum(root**2)

    def inverse(self) -> "LowRankFactor":
        return self

    def block_solver(self, group: Group) -> BlockSolver:
        rows = group.gather(self.Q)  # (F, s, r)
        if rows.shape[1] > rows.shape[2]:  # then the factors (F, r, r) are smaller
            one = jnp.eye(rows.shape[2], dtype=rows.dtype)
            factors = jax.lax.map(lambda fold_rows: cholesky(one - fold_rows.T @ fold_rows), rows)
            return Partial(_solve_many_rows, rows, factors, self.ridge)
        one = jnp.eye(rows.shape[1], dtype=rows.dtype)
        return cholesky_solver((one[None] - rows @ rows.transpose(0, 2, 1)) / self.ridge)

    def vjp(self, u, w, inverse=None, square=None) -> LowRankSystem:
        # Ā = u wᵀ + α C + β C² with α = `inverse`, β = `square`. From dA = dΦ Φᵀ + Φ dΦᵀ + dδ I,
        #     Φ̄ = (Ā + Āᵀ)Φ = u (wᵀΦ) + w (uᵀΦ) + 2α CΦ + 2β C²Φ,
        #     δ̄ = tr Ā = u·w + α tr C + β tr C²,     tr Cᵏ = (D − q)/δᵏ + tr M⁻ᵏ,
        # where tr M⁻¹ = ‖R⁻¹‖² and tr M⁻² = ‖R⁻¹R⁻ᵀ‖² in the Frobenius norm.
        rows = u[:, None] * (w @ self.rows)[None, :] + w[:, None] * (u @ self.rows)[None, :]
        ridge = u @ w
        T = self._images
        if inverse is not None:
            rows = rows + 2 * inverse * T
            ridge = ridge + inverse * self.inverse_trace
        if square is not None:
            root = backward(self.R, jnp.eye(len(self.R), dtype=T.dtype))
            # C²Φ = ΦM⁻² = (CΦ)M⁻¹ = (CΦ)R⁻¹R⁻ᵀ
            C_squared = _right_solve(self.R, _right_solve(self.R, T), transposed=True)
            rows = rows + 2 * square * C_squared
            trace = self._free / self.ridge**2 + jnp.sum((root @ root.T) ** 2)
            ridge = ridge + square * trace
        return self._cotangent(rows, ridge)

    def vjp_of_folds(self, a, groups, V, R, bars) -> tuple[LowRankSystem, Float[Array, " D"]]:
        r_bar, a_bar = bars
        # Φ̄ of Σ_S (C_:S v_S)(C_:S r_S)ᵀ is C W, and W has v_S (r_SᵀT_S) + r_S (v_SᵀT_S) in the
        # rows S.
        Q, T, rank = self.Q, self._images, len(self.R)
        P = jnp.sqrt(self.ridge) * backward(self.R, jnp.eye(rank, dtype=Q.dtype))
        v_all, W, ridge = jnp.zeros_like(a), jnp.zeros_like(T), jnp.zeros_like(self.ridge)
        for group, v, r in zip(groups, V, R, strict=True):
            fold_rows = group.gather(T)
            along_v, along_r = (jnp.einsum("fsr,fs->fr", fold_rows, vectors) for vectors in (v, r))
            each_row = v[..., None] * along_r[:, None] + r[..., None] * along_v[:, None]
            W = group.scatter(each_row, into=W)
            v_all = group.scatter(v, into=v_all)
            # The cotangent of δ needs (C_:S v_S)·(C_:S r_S). Rows inside S contribute r̄_S·a_S,
            # since C_SS v_S = r̄_S and C_SS r_S = a_S. Outside S, C_:S = −Q Q_Sᵀ/δ; with QᵀQ + PᵀP
            # = I and t_v = Q_Sᵀv_S/δ, t_r = Q_Sᵀr_S/δ the rows there contribute t_vᵀ(I − PᵀP −
            # Q_SᵀQ_S)t_r = t_v·(Q_Sᵀa_S) − (P t_v)·(P t_r), for Q_Sᵀa_S = t_r − Q_SᵀQ_S t_r.
            # Forming C_:S v_S and C_:S r_S instead loses twice as many digits.
            fold_rows, fold_a = group.gather(Q), group.gather(a)
            v_Q, r_Q, a_Q = (
                jnp.einsum("fsr,fs->fr", fold_rows, vectors) for vectors in (v, r, fold_a)
            )
            t_v, t_r = v_Q / self.ridge, r_Q / self.ridge
            inside = jnp.vdot(group.gather(r_bar), fold_a) + jnp.vdot(t_v, a_Q)
            ridge = ridge + inside - jnp.vdot(t_v[:, :rank] @ P.T, t_r[:, :rank] @ P.T)
        w = self.solve(v_all + a_bar)
        ridge_part = self.vjp(w, a)
        return self._cotangent(self.solve(W) - ridge_part.rows, ridge - ridge_part.ridge), w

    def _cotangent(self, rows: Float[Array, "D r"], ridge: Float[Array, ""]) -> LowRankSystem:
        has_constant = self.Q.shape[1] > len(self.R)
        return LowRankSystem(rows, ridge, jnp.zeros_like(self.Q[:, 0]) if has_constant else None)


def _solve_many_rows(rows, factors, ridge, b: Float[Array, "F s"]) -> Float[Array, "F s"]:
    """((I − Q_S Q_Sᵀ)/δ)⁻¹ b_S of folds with more rows than features, one by one."""

    def solve(fold):
        fold_rows, R, b = fold
        moment = backward(R, forward(R, (fold_rows.T @ b)[:, None]))[:, 0]
        return ridge * (b + fold_rows @ moment)

    return jax.lax.map(solve, (rows, factors, b))


def _right_solve(
    R: Float[Array, "r r"], rows: Float[Array, "D r"], transposed: bool = False
) -> Float[Array, "D r"]:
    """Rows R⁻¹, or rows R⁻ᵀ."""
    return (backward(R, rows.T) if transposed else forward(R, rows.T)).T


@jax.custom_vjp
def gram_of_columns(rows: Float[Array, "D r"]) -> Float[Array, "r r"]:
    """ΦᵀΦ; the cotangent Φ(B + Bᵀ) of a cotangent B costs one product instead of two."""
    return rows.T @ rows


gram_of_columns.defvjp(
    lambda rows: (gram_of_columns(rows), rows),
    full_precision(lambda rows, bar: (rows @ (bar + bar.T),)),
)
