"""`fit`: from data to a learned field."""

from __future__ import annotations

import dataclasses
from typing import Any, overload

import jax
from jaxtyping import ArrayLike, Num

from hamkernel import _require as require
from hamkernel._features import is_of_parts
from hamkernel._fields.base import AbstractField, Mean
from hamkernel._fields.expansions import KernelField
from hamkernel._fields.joined import ControlledField, FamilyField, learned_field
from hamkernel._fields.lagrangian import LagrangianField
from hamkernel._machine import (
    as_given,
    dense_bytes,
    full_precision,
    memory_bytes,
    one_blas_thread,
    rows_of,
)
from hamkernel._observations.kinds import AbstractObservations
from hamkernel._solvers.conjugate_gradient import ConjugateGradient
from hamkernel._solvers.dense import Cholesky, copies
from hamkernel._solvers.lagrangian import fit_lagrangian
from hamkernel._solvers.problem import AbstractSolver, LearnedField, Problem, problem
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


@overload
def fit(
    K: Controlled,
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
) -> ControlledField: ...
@overload
def fit(
    K: AbstractFamily,
    X: Num[ArrayLike, "N n"] | AbstractObservations,
    Y: Num[ArrayLike, "N n"] | None = None,
    regularization: ArrayLike = 1e-4,
    *,
    solver: AbstractSolver | None = None,
    mean: Mean | None = None,
    throw: bool = True,
    parameters: Num[ArrayLike, "N p"] | None = None,
    progress: bool = False,
) -> FamilyField: ...
@overload
def fit(
    K: AbstractMatrixKernel,
    X: Num[ArrayLike, "N n"] | AbstractObservations,
    Y: Num[ArrayLike, "N n"] | None = None,
    regularization: ArrayLike = 1e-4,
    *,
    solver: None = None,
    mean: Mean | None = None,
    throw: bool = True,
    inputs: Num[ArrayLike, "N m"] | None = None,
    parameters: Num[ArrayLike, "N p"] | None = None,
    progress: bool = False,
) -> KernelField: ...
@overload
def fit(
    K: AbstractMatrixKernel,
    X: Num[ArrayLike, "N n"] | AbstractObservations,
    Y: Num[ArrayLike, "N n"] | None = None,
    regularization: ArrayLike = 1e-4,
    *,
    solver: AbstractSolver[LearnedField],
    mean: Mean | None = None,
    throw: bool = True,
    inputs: Num[ArrayLike, "N m"] | None = None,
    parameters: Num[ArrayLike, "N p"] | None = None,
    progress: bool = False,
) -> LearnedField: ...


@one_blas_thread
@full_precision
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
    to the diagonal. Read as a Gaussian process, Nλ is the variance of the noise on Y.

    Args:
        K: a matrix-valued kernel, for example `Odd(Symplectic(Gaussian(3.0)))`.
        X: states, shape (N, n); or observations of any kind, without Y:
            `hk.fit(K, hk.Velocities(X, Y) + hk.Energies(Z, E), regularization=1e-4)`. With X and Y
            they are `hk.Velocities(X, Y)`.
        Y: measured velocities, shape (N, n), in units of X per unit of time.
        regularization: λ > 0, in squared units of Y over those of the kernel. With other
            observations Nλ is the variance of a row of relative noise 1, and N counts points of
            velocities and equilibria, energies and functionals.
        solver: if None, `Cholesky()` if its matrices of (N n)² numbers (two of velocities from 6000
            rows on, else four) take at most half of the memory, else `ConjugateGradient()`; both
            are exact, and `field.info.solver` names the one used. `Nystrom()` is faster, and
            approximate to a stated tolerance. If the rows of X are sharded over a mesh of devices
            they stay there, and None means `ConjugateGradient()`; only `Cholesky()` gathers them on
            one device.
        mean: the known part of the field, x (n,) -> (n,): a learned field, one of `hk.systems`, any
            function of one state. The kernel learns the rest, and the field is the sum; it has a
            Hamiltonian if both parts have one.
        throw: whether a failed solve raises. If False, the learned field is NaN, and so is
            `field.norm`: for `jax.vmap` over many hyperparameters, where one failure would end them
            all, and for your own objectives in `tune`, which turns away from NaN.
        inputs: of a `Controlled` kernel: u at each state, shape (N, m). What is learned is then a
            `ControlledField`, field(x, u).
        parameters: of a `Family`: θ at each state, shape (N, p). What is learned is then a
            `FamilyField`, field(x, θ), and `field.at(θ)` an ordinary field.
        progress: show a progress bar where the standard error is a terminal: of the iterations of
            `ConjugateGradient`, with their residual, and of the blocks of `Cholesky` from 6000 rows
            on. Ctrl-C ends the fit between two of them; inside of one it waits for it.
        accelerations: of a `Lagrangian`, shape (N, m); X are then states (q, v), and Y torques.

    Returns:
        The learned field. Works under jit, vmap and grad, with respect to every argument; new
        values of hyperparameters or λ do not recompile, except with `Nystrom()` if they change the
        number of landmarks.

    Raises:
        TypeError: K is not matrix-valued, `solver` is no solver, or the data is complex or in half
            precision. ValueError: a shape does not fit, the data is empty or not finite, n is not
            allowed by the structure, λ is not positive, or a dense problem does not fit in memory.
            AttributeError: energies, of a structure or a mean that has no potential. RuntimeError:
            the ridge is too small for this Gram (the text says what to do).

    Source: Smith & Egeland (2023), section 3, where "Nλ a_j" should read "Nλ a_i".
    """
    check_solver(solver)
    if isinstance(K, Lagrangian):
        return fit_lagrangian(K, X, Y, regularization, accelerations)
    if accelerations is not None:
        raise TypeError("accelerations= belongs to hk.Lagrangian(potential=…, inertia=…).")
    given = problem(K, X, Y, regularization, mean, inputs, parameters, throw)
    return field_of_problem(given, solver, throw, progress)


def field_of_problem(
    given: Problem, solver: AbstractSolver | None, throw: bool = True, progress: bool = False
) -> AbstractField:
    """The field by this solver, or by the default one if it is None."""
    require.warn_of_float32(given.rows.targets)
    if solver is None:
        spread = rows_of(given.rows.points) is not None
        solver = ConjugateGradient() if spread else default_solver(given)
    field = solver._fitted(given, throw, progress)
    if given.spread is not None and given.states is not None:
        field = dataclasses.replace(field, residual=as_given(given.spread, field.residual))
    return learned_field(field, given.known)


def check_solver(solver: Any) -> None:
    """TypeError if it is no solver, nor None."""
    if not (solver is None or isinstance(solver, AbstractSolver)):
        raise TypeError(f"solver must be an instance, for example hk.Cholesky(); got {solver!r}.")


def features_of_parts() -> RandomFeatures:
    """The solver in the features of shared laws, which draws nothing."""
    return RandomFeatures(1, jax.random.key(0))


def default_solver(given: Problem) -> AbstractSolver[Any]:
    """Cholesky where it takes at most half of the memory of one device, which has all the data.

    Of laws that many parts share the features, which are exact and few.
    """
    if is_of_parts(given.kernel):
        return features_of_parts()
    rows = given.rows
    needed = dense_bytes(rows.size, rows.size, rows.targets.dtype, copies(given))
    memory = memory_bytes()
    return Cholesky() if memory is None or needed <= memory / 2 else ConjugateGradient()
