"""Whether the maps under which a potential is unchanged are symmetries of the field as well."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from hamkernel import _require as require
from hamkernel._kernels.base import Invariance
from hamkernel._kernels.groups import matrix_of
from hamkernel._kernels.symmetry import symmetries


def _operators(K: Any, X: Float[Array, "N n"]) -> Float[np.ndarray, "N n n"]:
    # Compiled, 0.05 ms in place of 2; but of a traced K whose B is known that would be traced too.
    evaluate = _compiled if require.is_concrete(K, X) else _evaluated
    return np.asarray(evaluate(K, X))


def _evaluated(K: Any, X: Float[Array, "N n"]) -> Float[Array, "N n n"]:
    return jax.vmap(K.operator_at)(X)


_compiled = eqx.filter_jit(_evaluated)


def check_symmetries(K: Any, X: Float[Array | np.ndarray, "N n"]) -> None:
    """ValueError unless B(Sx) = ± S B(x) Sᵀ for the maps S of the kernel, at these points."""
    n = X.shape[1]
    constant = Invariance.TRANSLATION in K.operator_invariance
    maps = dict.fromkeys(each for mean in symmetries(K.kernel) for each in mean.maps)
    found = {each: matrix_of(each, n) for each in maps}
    if constant:  # S = ±1 is a symmetry of every B
        found = {e: S for e, S in found.items() if not np.array_equal(S, S[0, 0] * np.eye(n))}
    if not found:
        return
    with jax.ensure_compile_time_eval():
        X = jnp.asarray(X)
        here = _operators(K, X)
        for S in found.values():
            moved = jnp.asarray(np.asarray(X) @ S.T, X.dtype)
            there = here if constant else _operators(K, moved)
            image = S @ here @ S.T
            room = 1e-5 * np.abs(here).max()  # maps may come in float32
            if min(np.abs(there - image).max(), np.abs(there + image).max()) > room:
                raise ValueError(
                    f"a map of the symmetry is not one of the fields of {type(K).__name__}: with "
                    f"S = {np.round(S, 3).tolist()} neither B(Sx) = S B(x) Sᵀ nor -S B(x) Sᵀ holds."
                    " For J∇H it must be symplectic or antisymplectic, SᵀJS = ±J, so momenta move "
                    "with their positions; for gradients orthogonal; with all its digits, not 0.866"
                    " for √3/2. With friction time reversal is false."
                )
