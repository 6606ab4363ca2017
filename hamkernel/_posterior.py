"""`condition`: the Gaussian process of a field given data.

The prior is f ~ GP(mean, K). The rows of the data have independent noise, whose variance is σ² = Nλ
times their squared relative noise. The posterior is Gaussian too. Let c(x) be the covariances of
the rows with f(x), or with a difference of H. Then

    Cov[f(x), f(z) | y] = K(x, z) − c(x)ᵀ A⁻¹ c(z),     A = G + σ²I.
"""

from __future__ import annotations

from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float, Key, Num, UInt32

from hamkernel import _require as require
from hamkernel._features import is_of_parts
from hamkernel._fields.base import AbstractField, FieldSum, Mean, map_states, root
from hamkernel._fields.joined import AbstractJoinedField, FamilyField, known_of, learned_field
from hamkernel._gram import components
from hamkernel._kernels.base import Invariance, Scaled
from hamkernel._kernels.symmetry import drop_symmetry
from hamkernel._machine import EqualToItself, entry_point, full_precision, precise_jit
from hamkernel._observations.blocks import AbstractBlock, Values
from hamkernel._observations.kinds import AbstractObservations, inputs_or_parameters
from hamkernel._observations.measurements import inputs_of, observations
from hamkernel._show import Shown, has_arrays, text
from hamkernel._solvers.dense import Cholesky
from hamkernel._solvers.fit import features_of_parts
from hamkernel._solvers.low_rank import LowRankConditional
from hamkernel._solvers.problem import (
    AbstractConditional,
    AbstractSolver,
    Problem,
    check_solver,
    make_problem,
    new_rows,
)
from hamkernel._structures.base import AbstractMatrixKernel


@entry_point
def condition(
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
) -> Posterior:
    """Condition the Gaussian process GP(mean, K) on data: `fit` with error bars.

    The posterior mean is the field of `fit`. To scale K and λ by one factor changes no field, but
    scales all variances. So tune both by the marginal likelihood first:

        tuned = hk.tune(hk.Symplectic(1.0 * k), X, Y, objective="marginal_likelihood")
        posterior = hk.condition(tuned.kernel, X, Y, tuned.regularization)

    The posterior treats the hyperparameters as known. Error bars are therefore somewhat too small,
    more so for orbits than for H.

    Args:
        K: a matrix-valued kernel, with an amplitude: `2.0 * k`.
        X: states, shape (N, n); or observations, without Y.
        Y: velocities, shape (N, n).
        regularization: λ > 0; Nλ is the noise variance of a row of relative noise 1.
        solver: `Cholesky()`, which is exact, if None; or a low-rank solver. With `Nystrom(…)` and
            few landmarks the field is approximate; far from the landmarks the deviation is the
            prior deviation. With `RandomFeatures(…)` the features define the prior.
        mean: the known part of the field, x (n,) -> (n,), as in `fit`.
        throw: whether a failed solve raises an error; if False, the numbers of the field are NaN.
        inputs: u at each state, for a `Controlled` kernel, shape (N, m). Predictions then need the
            inputs too, `posterior.deviation(x, u)`.
        parameters: θ at each state, for a `Family`, shape (N, p): `posterior.deviation(x, θ)`. The
            deviation grows to the prior deviation outside the range of θ.
        progress: show a progress bar of the blocks of `Cholesky`, as in `fit`.

    Returns:
        The posterior. The cost is O(D³) time and O(D²) memory for D rows; a solver of rank r takes
        O(D r²) time.

    Raises:
        TypeError: the solver is `ConjugateGradient`, which keeps no factor; or as in `fit`.
        ValueError, AttributeError, RuntimeError: as in `fit`.

    Warns:
        UserWarning: the amplitude of K is exactly 1, the value of built-in kernels before tuning.
    """
    problem = make_problem(K, X, Y, regularization, mean, inputs, parameters, throw)
    return posterior_of_problem(problem, solver, throw, progress)


def posterior_of_problem(
    problem: Problem, solver: AbstractSolver | None, throw: bool = True, progress: bool = False
) -> Posterior:
    """`condition` on a problem."""
    check_solver(solver)
    if solver is not None and solver.no_factor:
        raise TypeError(solver.no_factor)
    problem = problem.to_one_device()
    if solver is None:
        solver = features_of_parts() if is_of_parts(problem.kernel) else Cholesky()
    require.warn_of_float32(problem.rows.targets)
    _warn_of_amplitude(problem.kernel, problem.rows.points)
    conditional = solver.condition(problem, throw, progress)
    return Posterior(conditional, learned_field(conditional.field, problem.known))


class Posterior(Shown, EqualToItself, eqx.Module):
    """A field learned from data, with its uncertainty; made by `condition`.

    A posterior is a PyTree. Its methods take one state and work under jit, vmap, and grad with
    respect to states.

    Attributes:
        conditional: the Gaussian process conditioned on the data, minus the prior mean.
        field: the posterior mean, the field that `fit` returns.
    """

    conditional: AbstractConditional
    field: AbstractField

    @property
    def given(self) -> AbstractConditional:
        """The old name of `conditional`, until version 0.2."""
        return self.conditional

    def _summary(self) -> tuple[str, list[tuple[str, str]]]:
        rows = self.conditional.rows
        has_sizes = has_arrays((rows.targets, rows.energies))
        of = f" of {rows.size} rows, {rows.dimension} coordinates" if has_sizes else ""
        u = ", u" if isinstance(self.field, AbstractJoinedField) else ""
        U = ", U" if u else ""
        return f"Posterior{of}", [
            ("field", text(self.field)),
            ("kernel", text(self.conditional.field.kernel)),
            ("lambda", text(self.conditional.field.regularization)),
            *self._misfit(),
            ("next", f".field, .deviation(x{u}), .evaluate(X{U}), .sample(key, 5), .updated(X, Y)"),
        ]

    def _misfit(self) -> list[tuple[str, str]]:
        """χ², with a warning if deviations are too small; empty if the numbers are not known."""
        arrays = self.conditional.field.residual, self.conditional.ridge
        if not has_arrays(arrays) or not require.is_concrete(arrays):
            return []
        chi_squared = float(self.chi_squared)
        if not np.isfinite(chi_squared):
            return []
        said = f"{chi_squared:.3g} a row"
        # D rows scatter by √(2/D) about 1; .3 is three deviations of 200 rows.
        if chi_squared > 1.3:
            said += ": deviations are too small by its root or more, see .chi_squared"
        return [("chi squared", said)]

    @property
    def chi_squared(self) -> Float[Array, ""]:
        """χ² = yᵀA⁻¹y/D for the D rows y minus the prior mean, A = G + NλI, shape ().

        χ² is near 1 if Nλ is the noise variance and the kernel has the right amplitude and
        lengthscales. If χ² is much larger than 1, the deviations of the posterior are too small; if
        it is much smaller, too large. Then pass the kernel and λ of
        `hk.tune(…, objective="marginal_likelihood")`.
        """
        conditional, rows = self.conditional, self.conditional.rows
        field = conditional.field
        if field.residual.size:
            residual = field.residual.ravel() / rows.scale
        else:  # features keep the residuals of velocities alone
            on_states = (
                partial(map_states, f) for f in (field._velocity, field._learned_potential)
            )
            residual = rows.y - rows.contrast(rows.evaluate(*on_states))
        return (field.norm**2 + residual @ residual / conditional.ridge) / rows.size

    @full_precision
    def covariance(
        self,
        x: Num[ArrayLike, " n"],
        u: Num[ArrayLike, " m"] | None = None,
        *,
        x2: Num[ArrayLike, " n"] | None = None,
        u2: Num[ArrayLike, " m"] | None = None,
    ) -> Float[Array, "n n"]:
        """The posterior covariance of f(x) and f(x₂), in squared units of Y, shape (n, n).

        K(x, x₂) − K(x, X) A⁻¹ K(X, x₂): entry (i, j) is the covariance of component i of f at x and
        component j of f at x₂.

        Args:
            x: one state, shape (n,).
            u: the inputs at x, shape (m,), if the field has inputs; zeros for the drift. For a
                family, the θ of a member.
            x2: another state, shape (n,), by keyword; x if None.
            u2: the inputs at x₂, if the field has inputs.

        Raises:
            ValueError: x is no single state of this dimension, or u is missing.
            TypeError: u came and the field has no inputs, or u2 came without x2.
        """
        if x2 is None and u2 is not None:
            raise TypeError(
                "u2 came without x2: give both, posterior.covariance(x, u, x2=z, u2=v)."
            )
        K = self.conditional.field.kernel
        here = components(K, self._point(x, u)[None])
        there = None if x2 is None else components(K, self._point(x2, u2)[None])
        return _covariance(self.conditional, here, there)

    def _point(self, x: Any, u: Any) -> Float[Array, " d"]:
        if isinstance(self.field, AbstractJoinedField):
            return self.field.join(x, u)
        if u is not None:
            raise TypeError(
                "the second argument is u, and this field has no inputs: leave u out. For the "
                "covariance of f at two states write posterior.covariance(x, x2=z)."
            )
        return self.field._state(x)

    @full_precision
    def deviation(
        self, x: Num[ArrayLike, " n"], u: Num[ArrayLike, " m"] | None = None
    ) -> Float[Array, " n"]:
        """The standard deviation of each component of f(x) or f(x, u), in units of Y, shape (n,).

        The deviation of a new measurement also contains its noise, of variance Nλ.

        Args:
            x: one state, shape (n,).
            u: the inputs at x, shape (m,), if the field has inputs; zeros for the drift. For a
                family, the θ of a member.

        Raises:
            ValueError: x is no single state of this dimension, or u is missing.
            TypeError: u came and the field has no inputs.
        """
        return jnp.stack([root(variance) for variance in jnp.diagonal(self.covariance(x, u))])

    @entry_point
    def evaluate(
        self, X: Num[ArrayLike, "N n"], U: Num[ArrayLike, "N m"] | None = None
    ) -> tuple[Float[Array, "N n"], Float[Array, "N n"]]:
        """The means and standard deviations of f at many states, in bounded memory.

        Args:
            X: states, shape (N, n).
            U: inputs or parameters at each state, shape (N, m), if the field has them.

        Returns:
            The means of `field` and the deviations of `deviation`, shape (N, n) each.

        Raises:
            ValueError: a shape does not fit, or U is missing.
            TypeError: U came and the field has no inputs.
        """
        if isinstance(self.field, AbstractJoinedField):
            means = self.field.evaluate(X, U)
        elif U is None:
            means = self.field.evaluate(X)
        else:
            raise TypeError("U came and the field has no inputs: write posterior.evaluate(X).")
        states = (jnp.asarray(X, means.dtype), *(() if U is None else (jnp.asarray(U),)))
        # A state takes D n numbers for D rows: 3 MB for 64 states and 3000 rows with n = 2.
        return means, jax.lax.map(lambda s: self.deviation(*s), states, batch_size=64)

    @full_precision
    def law_deviation(
        self, r: Num[ArrayLike, "..."], r0: Num[ArrayLike, "..."], which: int = 0
    ) -> Float[Array, ""]:
        """The standard deviation of w(r) − w(r₀) for a law w of `hk.Shared`, shape ().

        The deviation includes the prior outside the span of the centres of the law. Far from all
        values of r in the data it equals the prior deviation.

        Args:
            r: an argument of the law, as in `field.law`.
            r0: another argument.
            which: the position of the law, if there are several.

        Raises:
            AttributeError: no part of the kernel is `Shared`.
            TypeError: the posterior has no features, because a term of the kernel is not `Shared`
                and the solver was not `RandomFeatures`.
        """
        conditional = self.conditional
        if not isinstance(conditional, LowRankConditional):
            raise TypeError(
                "law_deviation needs a posterior in features: all terms of the kernel Shared, or "
                "solver=hk.RandomFeatures(500, jax.random.key(0))."
            )
        return root(conditional.law_variance(r, r0, which))

    @full_precision
    def energy_deviation(
        self,
        x: Num[ArrayLike, " n"],
        x0: Num[ArrayLike, " n"],
        theta: Num[ArrayLike, " p"] | None = None,
    ) -> Float[Array, ""]:
        """The standard deviation of H(x) − H(x₀), or of the difference of another potential, ().

        H is the potential of the drift if the field has inputs, and of one member of a family.

        Args:
            x: one state, shape (n,).
            x0: the reference state, shape (n,).
            theta: θ of the member of a family, shape (p,).

        Raises:
            AttributeError: the structure, or the mean, has no potential (with the reason).
            ValueError: a state does not fit, or θ of a family is missing.
            TypeError: θ came and the field is no family.
        """
        field, K = self.field, self.conditional.field.kernel
        if isinstance(field, FamilyField):
            n = field.dimension
            points = jnp.stack([field.join(x, theta), field.join(x0, theta)])
            _ = field.at(points[0, n:]).potential
            both = Values(points, outputs=n)
        else:
            if theta is not None:
                raise TypeError("the field is no family: leave out theta.")
            _ = field.potential  # raises an error if there is none
            states = jnp.stack([field._state(x), field._state(x0)])
            n, m = states.shape[1], inputs_of(K)
            points = jnp.pad(states, ((0, 0), (0, m))) if m else states
            both = Values(points, outputs=n if m else None)
        change = jnp.array([1.0, -1.0], both.points.dtype)
        return root(change @ _covariance(self.conditional, both) @ change)

    @full_precision
    def updated(
        self,
        X: Num[ArrayLike, "M n"] | AbstractObservations,
        Y: Num[ArrayLike, "M n"] | None = None,
        *,
        inputs: Num[ArrayLike, "M m"] | None = None,
        parameters: Num[ArrayLike, "M p"] | None = None,
    ) -> Posterior:
        """The posterior given additional data: as `condition` on all the data, but cheaper.

        The noise variance σ² = Nλ stays, so λ becomes σ² divided by the number of all observations.
        M new rows take O(D² M) time.

        Args:
            X: states, shape (M, n); or observations, without Y.
            Y: velocities, shape (M, n).
            inputs: u at each state, for a `Controlled` kernel, shape (M, m).
            parameters: θ at each state, for a `Family`, shape (M, p).

        Raises:
            ValueError: the new data have another n, or their shapes do not fit.
            TypeError: the new data have another dtype.
            RuntimeError: the new rows are so close to the old rows that the factorisation fails.
        """
        data_inputs = inputs_or_parameters(inputs, parameters, self.conditional.field.kernel)
        data, old = observations(X, Y, data_inputs, part=True), self.conditional.rows
        require.one_system("the new data have", data.dimension, "the posterior", old.dimension)
        mean = known_of(self.field)
        new = new_rows(self.conditional.field.kernel, data, old, mean)
        if new.targets.dtype != old.targets.dtype:
            raise TypeError(
                f"the new data are {new.targets.dtype} and the posterior {old.targets.dtype}: cast "
                "the new data."
            )
        conditional = self.conditional.update(new)
        return Posterior(conditional, learned_field(conditional.field, mean))

    @entry_point
    def sample(
        self,
        key: Key[Array, ""] | UInt32[Array, "..."],
        count: int,
        region: Num[ArrayLike, "2 n"] | None = None,
    ) -> AbstractField:
        """Draw fields from the posterior, each with its own Hamiltonian.

        The draws are one PyTree whose arrays have a leading axis, for `jax.vmap`:

            fields = posterior.sample(jax.random.key(0), 64)
            orbits = jax.vmap(lambda f: hk.simulate(f, x0, ts).ys)(fields)

        In the region and at the data, the draws have the mean and covariance of the posterior. Far
        outside, the draws have errors of a few per cent if `RandomFeatures` accepts the kernel, and
        too little spread otherwise. Choose a region that the orbits do not leave. Draws of a field
        with inputs contain the drift and G, and are affine in u. The region bounds the states, not
        u.

        Args:
            key: the random key.
            count: the number of fields.
            region: the lowest and the highest corner of a box of states, shape (2, n); if None, the
                smallest box that contains the states of the data.

        Returns:
            Fields of the type of `field`. The norm of a draw is not finite.

        Raises:
            ValueError: the region has another shape or a side of length zero, or count is no
                positive number.
            TypeError: key is no key of JAX.
        """
        key, count = require.key(key), require.count(count, "count")
        rows = self.conditional.rows
        n, dtype = rows.dimension, rows.targets.dtype
        if region is None:
            region = _range_of(rows.points[:, :n], None)
        corners = require.floating(region, "region").astype(dtype)
        require.shape(corners, "region has", "a box, its lowest and its highest corner,", (2, n))
        low, high = require.host_array(corners)
        bad = ~((high > low) & (abs(low) < np.inf) & (abs(high) < np.inf))
        message = "region must be finite, its first row the lower corner in every coordinate."
        corners = require.value(corners, bad, message)
        around = None if isinstance(self.field, FamilyField) else 0.0
        corners = jnp.concatenate([corners, _range_of(rows.points[:, n:], around)], axis=1)
        draws, mean = self.conditional.draws(key, count, corners), known_of(self.field)

        def one(draw):
            if draw.mean is None or mean is None:
                return learned_field(draw, mean if draw.mean is None else draw.mean)
            return learned_field(draw, FieldSum((mean, draw.mean)))

        return jax.vmap(one)(draws)


# We compile the whole function: its hundreds of operations, each compiled alone, took 4 s.
@precise_jit
def _covariance(
    conditional: AbstractConditional, left: AbstractBlock, right: AbstractBlock | None = None
) -> Float[Array, "d e"]:
    return conditional.covariance(left, left if right is None else right)


def _range_of(U: Float[Array, "N m"], centre: float | None) -> Float[Array, "2 m"]:
    """The corners of a box that contains all U: the smallest if `centre` is None, else around 0.

    The box around 0 has the half-width max |U| in each coordinate, and 1 if all U are 0.
    """
    if centre is None:
        return jnp.stack([U.min(axis=0), U.max(axis=0)])
    largest = jnp.max(jnp.abs(U), axis=0)
    return jnp.array([[-1.0], [1.0]], U.dtype) * jnp.where(largest > 0, largest, 1)[None]


_variance_at = precise_jit(lambda k, x: k(x, x))


def _warn_of_amplitude(K: AbstractMatrixKernel, X: Float[Array, "P n"]) -> None:
    """Warn if k(x, x) = 1 exactly, as for built-in kernels without an amplitude."""
    if not require.is_concrete(K, X):
        return
    origin = np.zeros(K.outputs(X.shape[1]), X.dtype)
    for k in drop_symmetry(K).scalar_kernels:
        with require.eager():
            one = Invariance.TRANSLATION in k.invariance and float(_variance_at(k, origin)) == 1.0
        if one:
            scaled = "the amplitude" if isinstance(k, Scaled) else f"1.0 * {k!r}"
            require.warn(
                f"the amplitude of {k!r} is exactly 1, its value before tuning, and variances are "
                f"proportional to the amplitude. Tune {scaled} by "
                "hk.tune(..., objective='marginal_likelihood')."
            )
            return
