"""The field on landmarks, and the warning where they are too few."""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float

from hamkernel import _require as require
from hamkernel._fields.base import SolverInfo
from hamkernel._fields.kernel_field import KernelField
from hamkernel._solvers.landmark_gram import checked, singular


class Solution(NamedTuple):
    coefficients: Float[Array, " r"]
    residual: Float[Array, "N n"]
    norm: Float[Array, ""]
    truncation: Float[Array, ""]
    residual_norm: Float[Array, ""] | None = None


def landmark_field(
    K, landmarks, solution, regularization, tolerance, cure, throw=True
) -> KernelField:
    dtype = landmarks.points.dtype
    failed = require.not_finite(solution.coefficients).any()
    solution = checked(solution, landmarks, solution.truncation, failed, singular(dtype), throw)
    warn_if_truncated(solution.truncation, landmarks.count, tolerance, cure)
    Z, A, S, b = landmarks.representer(solution.coefficients)
    return KernelField(
        kernel=K,
        points=Z,
        coefficients=A,
        residual=solution.residual,
        norm=solution.norm,
        regularization=regularization,
        offset=jnp.zeros((), dtype),
        info=SolverInfo(
            "Nystrom",
            landmarks=landmarks.count,
            rank=landmarks.kept.sum(),
            truncation=solution.truncation,
            residual_norm=solution.residual_norm,
        ),
        value_points=S if len(S) else None,
        value_coefficients=b if len(S) else None,
    )


CHOOSE = (
    "Raise max_points, the tolerance or the regularization; let landmarks be chosen from more "
    "candidates;"
)
START_ANEW = (
    "Start anew with landmarks from a sample that looks like the data so far, and a max_points "
    "that suffices; or ask for a larger regularization;"
)


def warn_if_truncated(truncation, count, tolerance, cure):
    if not require.is_concrete(truncation, count):
        return
    # Twice: a random part of the data need not show all that the rest has.
    if truncation > 2 * tolerance:
        if truncation.dtype == jnp.float32:
            cure = (
                "In float32 rounding may have ended the choice of landmarks early: "
                f"jax.config.update('jax_enable_x64', True). {cure}"
            )
        require.warn(
            f"{int(count)} landmarks leave trace(G - Ĝ)/(N λ) = {float(truncation):.2g}, more than "
            f"the tolerance {tolerance:.2g}. The field is the best one on these landmarks, but may "
            f"be far from the exact fit. {cure} for a rough kernel or many dimensions take "
            "hk.ConjugateGradient(), which is exact."
        )
