"""A = ΦΦᵀ + δI for features Φ (D, r): O(D r²) time, whatever is held out.

With the thin factorisation of a stack, [Φ; √δ I] = [Q; P] R, R upper triangular,

    M = ΦᵀΦ + δI = RᵀR,   C = A⁻¹ = (I − QQᵀ)/δ,   log det A = log det M + (D − r) log δ,
    (C_SS)⁻¹ = δ (I − Q_S Q_Sᵀ)⁻¹ = δ (I + Q_S (I − Q_SᵀQ_S)⁻¹ Q_Sᵀ),

the last of them for folds of more rows than features (Woodbury). Q and R come from Cholesky's QR,
twice: products of matrices only, and Q orthonormal to rounding where the condition of A is below
1/ε. The normal equations alone, with R from M and Q_S = Φ_S R⁻¹, give I − Q_S Q_Sᵀ an error of
ε cond(A) where it is as small as 1/cond(A).

The derivatives use CΦ = ΦM⁻¹ and C²Φ = ΦM⁻².

Of rows that see an unknown constant, in the direction p with ‖p‖ = 1, C is that of
`factors.py`. With Φ − ppᵀΦ in the place of Φ it is (I − ppᵀ − QQᵀ)/δ: the constant is one more
orthonormal column beside Q, whose weight is free.

Source: Yamamoto, Nakatsukasa, Yanagisawa & Fukaya (2015), ETNA 44, on the second pass.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from hamkernel._gram import plus_ridge
from hamkernel._machine import full_precision
from hamkernel._solvers.factors import (
    AbstractBlocks,
    AbstractFactor,
    AbstractInverse,
    AbstractSystem,
    CholeskyBlocks,
    Group,
    backward,
    cholesky,
    forward,
)


class LowRankSystem(AbstractSystem):
    """A by its features at the data and its ridge.

    Attributes:
        rows: Φ, shape (D, r).
        ridge: δ, shape ().
        constant: p, shape (D,), which is not differentiated; None if there is none.
    """

    rows: Float[Array, "D r"]
    ridge: Float[Array, ""]
    constant: Float[Array, " D"] | None = None

    def factor(self) -> "LowRankFactor":
        return LowRankFactor(self)


class LowRankFactor(AbstractFactor[LowRankSystem], AbstractInverse[LowRankSystem]):
    """A and its inverse, by Q and R.

    Attributes:
        rows: Φ.
        ridge: δ.
        Q: the rows of the orthonormal factor that belong to Φ, shape (D, r), and p beside them.
        R: its triangular factor, shape (r, r).
        size: ‖M‖ in the Frobenius norm: that of A without the directions that have no features.
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
        """The number of directions without features or constant."""
        return len(self.rows) - self.Q.shape[1]

    @property
    def _images(self) -> Float[Array, "D r"]:
        """CΦ = Q R⁻ᵀ."""
        return _right_solve(self.R, self.Q[:, : len(self.R)], transposed=True)

    def solve(self, b: Float[Array, "D *m"]) -> Float[Array, "D *m"]:
        return (b - self.Q @ (self.Q.T @ b)) / self.ridge

    def solved(self, y: Float[Array, " D"]) -> tuple[Float[Array, " D"], Float[Array, ""]]:
        # yᵀA⁻¹y = ‖y − Φw‖²/δ + ‖w‖² with the weights w of the fit
        rotated = self.Q.T @ y
        left = y - self.Q @ rotated
        w = backward(self.R, rotated[: len(self.R), None])[:, 0]
        return left / self.ridge, left @ left / self.ridge + w @ w

    @property
    def log_det(self) -> Float[Array, ""]:
        return 2 * jnp.sum(jnp.log(jnp.diagonal(self.R))) + self._free * jnp.log(self.ridge)

    @property
    def inverse_trace(self) -> Float[Array, ""]:
        # (D − ‖Q‖²)/δ with ‖Q‖² + ‖P‖² = q and P = √δ R⁻¹
        root = backward(self.R, jnp.eye(len(self.R), dtype=self.R.dtype))
        return self._free / self.ridge + jnp.sum(root**2)

    def inverse(self) -> "LowRankFactor":
        return self

    def blocks(self, group: Group) -> AbstractBlocks:
        rows = group.gather(self.Q)  # (F, s, r)
        if rows.shape[1] > rows.shape[2]:
            return _ManyRows(rows, self.ridge)
        one = jnp.eye(rows.shape[1], dtype=rows.dtype)
        return CholeskyBlocks((one[None] - rows @ rows.transpose(0, 2, 1)) / self.ridge)

    def pulled(self, u, w, inverse=None, square=None) -> LowRankSystem:
        rows = u[:, None] * (w @ self.rows)[None, :] + w[:, None] * (u @ self.rows)[None, :]
        ridge = u @ w
        T = self._images
        if inverse is not None:
            rows = rows + 2 * inverse * T
            ridge = ridge + inverse * self.inverse_trace
        if square is not None:
            root = backward(self.R, jnp.eye(len(self.R), dtype=T.dtype))
            C_squared = _right_solve(self.R, _right_solve(self.R, T), transposed=True)  # C²Φ
            rows = rows + 2 * square * C_squared
            trace = self._free / self.ridge**2 + jnp.sum((root @ root.T) ** 2)
            ridge = ridge + square * trace
        return self._cotangent(rows, ridge)

    def pulled_folds(self, a, groups, V, R, bars) -> tuple[LowRankSystem, Float[Array, " D"]]:
        r_bar, a_bar = bars
        Q, T, r_own = self.Q, self._images, len(self.R)
        P = jnp.sqrt(self.ridge) * backward(self.R, jnp.eye(r_own, dtype=Q.dtype))
        v_all, W, ridge = jnp.zeros_like(a), jnp.zeros_like(T), jnp.zeros_like(self.ridge)
        for group, v, r in zip(groups, V, R, strict=True):
            own = group.gather(T)
            along_v, along_r = (jnp.einsum("fsr,fs->fr", own, each) for each in (v, r))
            each_row = v[..., None] * along_r[:, None] + r[..., None] * along_v[:, None]
            W = group.scattered(each_row, into=W)
            v_all = group.scattered(v, into=v_all)
            # (C_:S v_S)·(C_:S r_S), from C_SS v_S = r̄_S and C_SS r_S = a_S in S, and outside by
            # t = Q_Sᵀv_S/δ and Q_SᵀQ_S; of v and r alone it would lose the square of the condition.
            own, fold_a = group.gather(Q), group.gather(a)
            v_Q, r_Q, a_Q = (jnp.einsum("fsr,fs->fr", own, each) for each in (v, r, fold_a))
            t_v, t_r = v_Q / self.ridge, r_Q / self.ridge
            inside = jnp.vdot(group.gather(r_bar), fold_a) + jnp.vdot(t_v, a_Q)
            ridge = ridge + inside - jnp.vdot(t_v[:, :r_own] @ P.T, t_r[:, :r_own] @ P.T)
        w = self.solve(v_all + a_bar)
        less = self.pulled(w, a)
        return self._cotangent(self.solve(W) - less.rows, ridge - less.ridge), w

    def _cotangent(self, rows: Float[Array, "D r"], ridge: Float[Array, ""]) -> LowRankSystem:
        has_constant = self.Q.shape[1] > len(self.R)
        return LowRankSystem(rows, ridge, jnp.zeros_like(self.Q[:, 0]) if has_constant else None)


class _ManyRows(AbstractBlocks):
    """Blocks (I − Q_S Q_Sᵀ)/δ of folds with more rows than features, one after the other."""

    rows: Float[Array, "F s r"]
    ridge: Float[Array, ""]
    factors: Float[Array, "F r r"]  # no more numbers than the rows have

    def __init__(self, rows: Float[Array, "F s r"], ridge: Float[Array, ""]):
        one = jnp.eye(rows.shape[2], dtype=rows.dtype)
        self.rows, self.ridge = rows, ridge
        self.factors = jax.lax.map(lambda own: cholesky(one - own.T @ own), rows)

    def solve(self, b: Float[Array, "F s"]) -> Float[Array, "F s"]:
        def one(fold):
            own, R, b = fold
            moment = backward(R, forward(R, (own.T @ b)[:, None]))[:, 0]
            return self.ridge * (b + own @ moment)

        return jax.lax.map(one, (self.rows, self.factors, b))


def _right_solve(
    R: Float[Array, "r r"], rows: Float[Array, "D r"], transposed: bool = False
) -> Float[Array, "D r"]:
    """Rows R⁻¹, or rows R⁻ᵀ."""
    return (backward(R, rows.T) if transposed else forward(R, rows.T)).T


@jax.custom_vjp
def gram_of_columns(rows: Float[Array, "D r"]) -> Float[Array, "r r"]:
    """ΦᵀΦ, whose derivative is one product with Φ and not two."""
    return rows.T @ rows


gram_of_columns.defvjp(
    lambda rows: (gram_of_columns(rows), rows),
    full_precision(lambda rows, bar: (rows @ (bar + bar.T),)),
)
