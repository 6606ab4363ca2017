"""`fit`: from data to a learned field."""

from __future__ import annotations

import dataclasses
from typing import Any, TypedDict, Unpack, overload

import jax
from jaxtyping import ArrayLike, Num

from hamkernel import _require as require
from hamkernel._features import is_of_parts
from hamkernel._fields.base import AbstractField, Mean
from hamkernel._fields.expansions import KernelField
from hamkernel._fields.joined import ControlledField, FamilyField, learned_field
from hamkernel._fields.lagrangian import LagrangianField
from hamkernel._machine import (
    dense_bytes,
    entry_point,
    memory_bytes,
    row_sharding,
    to_caller_sharding,
)
from hamkernel._observations.kinds import AbstractObservations
from hamkernel._solvers.conjugate_gradient import ConjugateGradient
from hamkernel._solvers.dense import Cholesky, copies
from hamkernel._solvers.lagrangian import fit_lagrangian
from hamkernel._solvers.problem import (
    AbstractSolver,
    LearnedField,
    Problem,
    check_solver,
    make_problem,
)
from hamkernel._solvers.random_features import RandomFeatures
from hamkernel._structures.base import AbstractMatrixKernel
from hamkernel._structures.family import AbstractFamily
from hamkernel._structures.joined import Controlled
from hamkernel._structures.lagrangian import Lagrangian


@overload
def fit(
    K: Lagrangian,
    X: Num[ArrayLike, "N n"],
    Y: Num[ArrayLike, "N m"],
    regularization: ArrayLike = ...,
    *,
    accelerations: Num[ArrayLike, "N m"],
) -> LagrangianField: ...


class FitOptions(TypedDict, total=False):
    """The arguments of `fit` on which the type of the field does not depend."""

    mean: Mean | None
    throw: bool
    inputs: Num[ArrayLike, "N m"] | None
    parameters: Num[ArrayLike, "N p"] | None
    progress: bool


@overload
def fit(
    K: Controlled,
    X: Num[ArrayLike, "N n"] | AbstractObservations,
    Y: Num[ArrayLike, "N n"] | None = None,
    regularization: ArrayLike = 1e-4,
    *,
    solver: AbstractSolver | None = None,
    **options: Unpack[FitOptions],
) -> ControlledField: ...
@overload
def fit(
    K: AbstractFamily,
    X: Num[ArrayLike, "N n"] | AbstractObservations,
    Y: Num[ArrayLike, "N n"] | None = None,
    regularization: ArrayLike = 1e-4,
    *,
    solver: AbstractSolver | None = None,
    **options: Unpack[FitOptions],
) -> FamilyField: ...
@overload
def fit(
    K: AbstractMatrixKernel,
    X: Num[ArrayLike, "N n"] | AbstractObservations,
    Y: Num[ArrayLike, "N n"] | None = None,
    regularization: ArrayLike = 1e-4,
    *,
    solver: None = None,
    **options: Unpack[FitOptions],
) -> KernelField: ...
@overload
def fit(
    K: AbstractMatrixKernel,
    X: Num[ArrayLike, "N n"] | AbstractObservations,
    Y: Num[ArrayLike, "N n"] | None = None,
    regularization: ArrayLike = 1e-4,
    *,
    solver: AbstractSolver[LearnedField],
    **options: Unpack[FitOptions],
) -> LearnedField: ...


@entry_point
def fit(
    K: AbstractMatrixKernel,
    X: Num[ArrayLike, "N n"] | AbstractObservations,
    Y: Num[ArrayLike, "N n"] | None = None,
    regularization: ArrayLike = 1e-4,
    *,
    solver: AbstractSolver | None = None,
    mean: Mean | None = None,
    throw: bool = True,
    inputs: Num[ArrayLike, "N m"] | None = None,
    parameters: Num[ArrayLike, "N p"] | None = None,
    progress: bool = False,
    accelerations: Num[ArrayLike, "N m"] | None = None,
) -> Any:
    """Learn the field f in the RKHS of K that minimises (1/N) Σᵢ‖f(xᵢ) − yᵢ‖² + λ‖f‖².

    By the representer theorem f(x) = Σⱼ K(x, xⱼ) aⱼ with (G + NλI) a = y. Nothing else is added
    to the diagonal. For the Gaussian process f ~ GP(0, K), Nλ is the variance of the noise on Y.

    Args:
        K: a matrix-valued kernel, for example `Odd(Symplectic(Gaussian(3.0)))`.
        X: states, shape (N, n); or observations of any kind, without Y:
            `hk.fit(K, hk.Velocities(X, Y) + hk.Energies(Z, E), regularization=1e-4)`. X and Y mean
            `hk.Velocities(X, Y)`.
        Y: measured velocities, shape (N, n), in units of X per unit of time.
        regularization: λ > 0, in squared units of Y over those of the kernel. With other
            observations Nλ is the variance of a row of relative noise 1, and N counts points of
            velocities and equilibria, energies and functionals.
        solver: if None, `Cholesky()` as long as its matrices take at most half of the memory, and
            `ConjugateGradient()` otherwise. (There are four matrices of (N n)² numbers, or two for
            velocities from 6000 rows on.) Both solvers are exact; `field.info.solver` names the
            solver used. `Nystrom()` is faster, and approximate to a stated tolerance. If the rows
            of X are sharded over devices, None means `ConjugateGradient()`, which keeps the rows
            sharded; `Cholesky()` gathers the rows on one device.
        mean: the known part of the field, x (n,) -> (n,): a learned field, one of `hk.systems`, or
            any function of one state. The kernel learns the difference, and the result is the sum,
            which has a Hamiltonian if both parts have one.
        throw: whether a failed solve raises. If False, the numbers of the field and `field.norm`
            are NaN. Pass False under `jax.vmap` over many hyperparameters, where one failure would
            end all fits, and in your own objectives of `tune`, which avoids NaN.
        inputs: for a `Controlled` kernel, u at each state, shape (N, m). The result is a
            `ControlledField`, field(x, u).
        parameters: for a `Family`, θ at each state, shape (N, p). The result is a `FamilyField`,
            field(x, θ), and `field.at(θ)` is an ordinary field.
        progress: show a progress bar if the standard error is a terminal: for the iterations of
            `ConjugateGradient`, with their residuals, and for the blocks of `Cholesky` from 6000
            rows on. Ctrl-C stops a fit by `Cholesky` between two blocks.
        accelerations: for a `Lagrangian`, the accelerations, shape (N, m). X holds the states
            (q, v), shape (N, 2m), and Y the torques, shape (N, m).

    Returns:
        The learned field. Works under jit, vmap and grad, with respect to every argument; new
        values of hyperparameters or λ do not recompile, except with `Nystrom()` if they change the
        number of landmarks.

    Raises:
        TypeError: K is not matrix-valued, `solver` is no solver, or the data are complex or in half
            precision. ValueError: a shape does not fit, the data are empty or not finite, the
            structure does not allow this n, λ is not positive, or a dense problem does not fit in
            memory. AttributeError: there are energies, and the structure or the mean has no
            potential. RuntimeError: the ridge is too small for this Gram (the text says what to
            do).

    Source: Smith & Egeland (2023), section 3, where "Nλ a_j" should read "Nλ a_i".
    """
    check_solver(solver)
    if isinstance(K, Lagrangian):
        return fit_lagrangian(K, X, Y, regularization, accelerations)
    if accelerations is not None:
        raise TypeError(
            f"accelerations came with a {type(K).__name__}: they belong to "
            "hk.Lagrangian(potential=…, inertia=…). For another kernel leave them out."
        )
    problem = make_problem(K, X, Y, regularization, mean, inputs, parameters, throw)
    return field_of_problem(problem, solver, throw, progress)


def field_of_problem(
    problem: Problem, solver: AbstractSolver | None, throw: bool = True, progress: bool = False
) -> AbstractField:
    """The field that the solver finds for a problem; the default solver if None."""
    require.warn_of_float32(problem.rows.targets)
    if solver is None:
        spread = row_sharding(problem.rows.points) is not None
        solver = ConjugateGradient() if spread else default_solver(problem)
    field = solver.fit(problem, throw, progress)
    if problem.spread is not None and problem.states is not None:
        field = dataclasses.replace(
            field, residual=to_caller_sharding(problem.spread, field.residual)
        )
    return learned_field(field, problem.known)


def features_of_parts() -> RandomFeatures:
    """The solver in the features of `Shared` laws, which draws nothing."""
    return RandomFeatures(1, jax.random.key(0))


def default_solver(problem: Problem) -> AbstractSolver[Any]:
    """The solver for data on one device: Cholesky if it takes at most half of the memory.

    Otherwise conjugate gradients. For `Shared` laws the solver uses their features, which are exact
    and few.
    """
    if is_of_parts(problem.kernel):
        return features_of_parts()
    rows = problem.rows
    needed = dense_bytes(rows.size, rows.size, rows.targets.dtype, copies(problem))
    memory = memory_bytes()
    return Cholesky() if memory is None or needed <= memory / 2 else ConjugateGradient()
