"""What `tune` warns of before it searches: data and kernels whose best values mean little."""

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Array

from hamkernel import _require as require
from hamkernel._structures.base import AbstractMatrixKernel
from hamkernel._tuning.boxes import constants
from hamkernel._tuning.objective import SearchCriterion
from hamkernel._tuning.space import RIDGE, SearchSpace

_UNEQUAL = 100.0  # in size, and so 10 000 in the loss
# Held out one at a time, few runs are a noisy judge: on the pendulum of the paper, with three, the
# field error was 0.164 where the likelihood's was 0.048. See `tests/benchmarks/judges.py`.
_FEW_FOLDS = 5


def warn_of_unequal_sizes(Y: Array) -> None:
    """Velocities of one coordinate that are lost beside those of another."""
    sizes = np.asarray(Y).std(axis=0)
    sizes = sizes[sizes > 0]
    if sizes.size and sizes.max() > _UNEQUAL * sizes.min():
        require.warn(
            f"the velocities of one coordinate are {sizes.max() / sizes.min():.3g} times as large "
            "as those of another, and a loss sums the squares of both: the small one may be lost "
            "in it. Choose units in which they are of similar size. With more than one degree of "
            "freedom x stays canonical only if [q_i][p_i] is the same product of units for every i."
        )


def warn_of_constants(K: AbstractMatrixKernel) -> None:
    """Python floats, which are no hyperparameters."""
    kept = constants(K)
    if kept:
        shown = ", ".join(f"{name} = {value:.4g}" for name, value in kept.items())
        require.warn(
            f"kept, and not tuned: {shown}. Python floats are constants to JAX. Store an array to "
            "have them tuned, jnp.array(0.3), and name it in frozen=... to have it kept."
        )


def warn_of_few_folds(criterion: SearchCriterion, folds: object) -> None:
    """Labels of so few groups that what is held out is a matter of chance."""
    if criterion.partition is None or criterion.own or np.ndim(folds) == 0:  # type: ignore
        return
    count = len(criterion.partition.folds)
    if count < _FEW_FOLDS:
        require.warn(
            f"the labels in folds make {count} folds, and cross-validation by fewer than "
            f"{_FEW_FOLDS} runs is a noisy judge. Compare with objective='marginal_likelihood' and "
            "an amplitude, `1.0 * k`, or with folds='loo': the docstring of hk.tune has numbers."
        )


def warn_of_free_scale(space: SearchSpace, criterion: SearchCriterion) -> None:
    """Amplitudes on every term, of which only the ratios to λ count."""
    free = {space.names[i] for i in space.free}
    if not criterion.logarithmic or RIDGE not in free or space.given_ridge is not None:
        return
    if _has_amplitude(space):
        require.warn(
            "every term of this kernel has an amplitude, and cross-validation does not see a "
            "factor that is common to all of them and to lambda: their values mean nothing but "
            "for their ratios. Leave one amplitude away, freeze it, frozen='scale', or pass "
            "objective='marginal_likelihood', which knows the scale."
        )


def _has_amplitude(space: SearchSpace) -> bool:
    """Whether factors that are searched multiply all of the kernel."""
    leaves, structure = jax.tree.flatten(eqx.filter(space.kernel, eqx.is_inexact_array))
    last = np.cumsum([leaf.size for leaf in leaves]) - 1
    free = [leaf if i in space.free else None for leaf, i in zip(leaves, last, strict=True)]
    terms = jax.tree.unflatten(structure, free).scalar_kernels
    return bool(terms) and all(k.has_amplitude for k in terms)
