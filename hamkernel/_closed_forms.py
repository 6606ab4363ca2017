"""Held-out residuals, free residuals and the log density of y, for every factor of A.

Write A = G + ridge I and a = A⁻¹y for the system with ALL points, and let S be the rows of a
held-out fold. Eliminating the other rows from A a = y by block inversion gives the residual that
a fit WITHOUT S would have on S,

    r_S = y_S − f₋S(X_S) = (C_SS)⁻¹ a_S,    C = A⁻¹,                                   (1)

without a refit for any fold.

The derivatives are written by hand, since differentiating through the factorisation costs
several times as much as the factorisation. From dC = −C dA C, and with v_S = (C_SS)⁻¹ r̄_S for a
cotangent r̄,

    r̄·dr = Σ_S v_Sᵀ[(dC y)_S − dC_SS r_S]   so   Ā = Σ_S (C_:S v_S)(C_:S r_S)ᵀ − (C v) aᵀ,

where v has the entries v_S. With a cotangent ā of a, da = −C dA a adds −(C ā) aᵀ, so that

        Ā = Σ_S (C_:S v_S)(C_:S r_S)ᵀ − w aᵀ,   w = C(v + ā),   ȳ = w.                          (2)

If A is too ill-conditioned, the result is infinite and its derivative zero.

Source: for scalar outputs and single points, Rasmussen & Williams (2006), section 5.4.2; for
folds, Ginsbourger & Schärer (2021), arXiv:2101.03108.
"""

import functools
import operator
import reprlib
from collections.abc import Hashable, Iterable, Iterator
from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Bool, Float, Int, Shaped

from hamkernel import _require as require
from hamkernel._machine import full_precision
from hamkernel._solvers.factors import AbstractSystem, Group

Folds = int | Literal["loo"] | Shaped[ArrayLike, " N"] | Iterable[Hashable]


class Partition:
    """N points in F folds, as a static argument of compiled functions.

    Attributes:
        folds: the points of each of the F folds.
        groups: the same folds, grouped by similar size.
        of_labels: whether the caller gave a label for each point.
        weights: 1 / (F |fold of i|) for each point, so that `weights @ squares` is the mean over
            folds of the mean over points, shape (N,).
    """

    def __init__(self, N: int, folds: Folds):
        folds = list(folds) if isinstance(folds, Iterator) else folds
        names, index, sizes = np.unique(_labels(N, folds), return_inverse=True, return_counts=True)
        self.labels = index
        self.of_labels = not (isinstance(folds, str) or _is_number(folds))
        if len(names) < 2:
            raise ValueError(
                f"cross-validation needs at least two folds, and these {N} points are in one. "
                "Give each point the label of its trajectory, a number of folds, or 'loo'."
            )
        self.folds = np.split(np.argsort(index, kind="stable"), np.cumsum(sizes)[:-1])
        self.weights = 1.0 / (len(names) * sizes[index])
        # The sizes in a group are within a factor of two, so padding at most doubles the points.
        octave = np.floor(np.log2(sizes.max() / sizes)).astype(int)
        self.groups = [
            Group(N, [self.folds[i] for i in np.flatnonzero(octave == size_class)])
            for size_class in np.unique(octave)
        ]

    def __hash__(self) -> int:
        return hash(self.labels.tobytes())

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Partition) and np.array_equal(self.labels, other.labels)


def _labels(N: int, folds: Folds) -> Int[np.ndarray, " N"]:
    """One integer for each point, the same within a fold."""
    if isinstance(folds, str):
        if folds != "loo":
            raise ValueError(f"folds must be a number, 'loo' or labels; got {folds!r}.")
        return np.arange(N)
    if not require.is_concrete(folds):
        raise TypeError(
            "folds is traced: the labels decide the shapes of the computation, so they must be "
            "concrete. Close over them, or mark the argument static under jax.jit."
        )
    if _is_number(folds):
        count = operator.index(np.asarray(folds)[()])
        if not 2 <= count <= N:
            raise ValueError(f"folds must be between 2 and the number of points, {N}; got {count}.")
        parts = np.array_split(np.arange(N), count)
        return np.repeat(np.arange(len(parts)), [len(part) for part in parts])
    return _integers(N, folds)


def _is_number(folds: Any) -> bool:
    """Whether `folds` is a whole number, also as an array of shape ()."""
    return (
        hasattr(folds, "__index__")
        and np.shape(folds) == ()
        and np.asarray(folds).dtype.kind in "iu"
    )


_MISSING = {"None", "nan", "NaT", "<NA>"}  # as text, since pandas' NA does not compare


def _integers(N: int, labels: Any) -> Int[np.ndarray, " N"]:
    """Labels of any kind as integers, in the order in which they appear; integers as they are."""
    shape = getattr(labels, "shape", None)
    if not isinstance(labels, Iterable) or shape == ():
        raise ValueError(
            "folds must be a whole number, 'loo', or one label for each point; got "
            f"{reprlib.repr(labels)}."
        )
    names = np.asarray(labels) if hasattr(labels, "dtype") else list(labels)
    shape = (len(names),) if shape is None else shape
    if shape != (N,) or any(isinstance(name, list | np.ndarray) for name in names):
        raise ValueError(
            f"folds has shape {shape}; one label for each of the {N} points is needed, shape (N,), "
            "or a number of folds, or 'loo'."
        )
    if isinstance(names, np.ndarray) and names.dtype.kind in "iu":
        return names
    for i, name in enumerate(names):
        if not isinstance(name, str) and str(name) in _MISSING:
            raise ValueError(
                f"folds has no label for point {i} ({name}). Each point needs one: leave out "
                "points that belong to no run."
            )
    index = {name: i for i, name in enumerate(dict.fromkeys(names))}
    return np.array([index[name] for name in names])


def _factor_and_solve(system: AbstractSystem, y: Float[Array, " D"]):
    """The factor of A, a = A⁻¹y, yᵀa, and whether A is well-conditioned enough to use these.

    Barriers keep calls of LAPACK from running side by side.
    """
    factor = system.factor()
    factor, a, square = jax.lax.optimization_barrier((factor, *factor.solve_with_form(y)))
    return jax.lax.optimization_barrier((factor, a, square, factor.is_well_conditioned(y)))


@functools.partial(jax.custom_vjp, nondiff_argnums=(2,))
def held_out(
    system: AbstractSystem, y: Float[Array, " D"], partition: Partition
) -> tuple[Float[Array, " D"], Float[Array, " D"]]:
    """The residuals r_S = (C_SS)⁻¹ a_S in the order of y, and a; inf if A is ill-conditioned."""
    return _held_out_forward(system, y, partition)[0]


@full_precision
def _held_out_forward(system, y, partition):
    factor, a, _, is_trusted = _factor_and_solve(system, y)
    C = factor.inverse()
    r, solvers = jnp.zeros_like(a), []
    for group in partition.groups:
        C, r = jax.lax.optimization_barrier((C, r))  # not side by side
        solvers.append(C.block_solver(group))
        r = group.scatter(solvers[-1](group.gather(a)), into=r)
    ok = is_trusted & jnp.isfinite(r).all()
    value = jax.tree.map(lambda array: jnp.where(ok, array, jnp.full_like(array, jnp.inf)), (r, a))
    return value, (C, a, solvers, r, ok)


@full_precision
def _held_out_backward(partition, saved, bars):
    C, a, solvers, r, ok = saved
    r_bar, a_bar = bars
    V, bar = [], r_bar
    for group, solve in zip(partition.groups, solvers, strict=True):
        V.append(solve(group.gather(bar)))
        bar = jax.lax.optimization_barrier((bar, V[-1]))[0]
    R = [group.gather(r) for group in partition.groups]
    return _or_zero(ok, C.vjp_of_folds(a, partition.groups, V, R, (r_bar, a_bar)))


held_out.defvjp(_held_out_forward, _held_out_backward)


@jax.custom_vjp
def free_residuals(
    system: AbstractSystem, y: Float[Array, " D"]
) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """The pair ‖A⁻¹y‖² and tr A⁻¹; inf and 1 if A is ill-conditioned."""
    return _free_residuals_forward(system, y)[0]


@full_precision
def _free_residuals_forward(system, y):
    factor, a, _, is_trusted = _factor_and_solve(system, y)
    squares, trace = a @ a, factor.inverse_trace
    ok = is_trusted & jnp.isfinite(squares) & jnp.isfinite(trace)
    value = jnp.where(ok, squares, jnp.inf), jnp.where(ok, trace, jnp.ones_like(trace))
    return value, (factor, a, ok)


@full_precision
def _free_residuals_backward(saved, bars):
    factor, a, ok = saved
    squares_bar, trace_bar = bars
    # d‖a‖² = −2 aᵀC dA a + 2 aᵀC dy and d tr C = −tr(C² dA), so with w = 2 s̄ C a: Ā = −w aᵀ − t̄
    # C².
    w = 2 * squares_bar * factor.solve(a)
    return _or_zero(ok, (factor.inverse().vjp(-w, a, square=-trace_bar), w))


free_residuals.defvjp(_free_residuals_forward, _free_residuals_backward)


@jax.custom_vjp
def log_density(system: AbstractSystem, y: Float[Array, " D"]) -> Float[Array, ""]:
    """The log density of y under N(0, A); −inf if A is ill-conditioned."""
    return _log_density_forward(system, y)[0]


@full_precision
def _log_density_forward(system, y):
    factor, a, square, is_trusted = _factor_and_solve(system, y)
    value = -0.5 * (square + factor.log_det + len(y) * jnp.log(2 * jnp.pi).astype(y.dtype))
    ok = is_trusted & jnp.isfinite(value)
    return jnp.where(ok, value, -jnp.inf), (factor, a, ok)


@full_precision
def _log_density_backward(saved, bar):
    factor, a, ok = saved
    # d log p = ½ aᵀdA a − ½ tr(C dA) − aᵀdy
    system_bar = factor.inverse().vjp(0.5 * bar * a, a, inverse=-0.5 * bar)
    return _or_zero(ok, (system_bar, -bar * a))


log_density.defvjp(_log_density_forward, _log_density_backward)


def _or_zero(ok: Bool[Array, ""], tree):
    """Derivatives, set to zero if the value is infinite."""
    return jax.tree.map(lambda leaf: jnp.where(ok, leaf, jnp.zeros_like(leaf)), tree)
