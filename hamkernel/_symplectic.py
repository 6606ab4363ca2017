"""Symplectic integrators as Diffrax solvers, and steps of one size between saved times.

A one-step map x₁ = Ψ_h(x₀) is symplectic if (∂Ψ)ᵀ J ∂Ψ = J. Up to terms exponentially small in 1/h,
such a map follows the flow of a nearby Hamiltonian H + O(hᵖ), so the error in H stays bounded (HLW,
IX.8). This holds for one fixed map, and therefore for a CONSTANT step. An adaptive step is another
map at every state, and the error in H grows (HLW, VIII.1).

Two families, both with x = (q, p) in one array of shape (n,):

- Gauss collocation solves implicit equations and is symplectic for every Hamiltonian.
- Splitting is explicit, and needs H = T(p) + U(q).

Diffrax runs the loop over steps, saves the output and differentiates. Optimistix solves the
implicit equations, and differentiates them by the implicit function theorem.

Source: "HLW" below is Hairer, Lubich & Wanner, Geometric Numerical Integration, 2nd ed. (2006).
"""

import dataclasses
from collections.abc import Callable
from typing import Any, ClassVar, NamedTuple

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from equinox import AbstractClassVar, AbstractVar
from jaxtyping import Array, Bool, Float, Int, Scalar

from hamkernel._machine import precise_jit


class Step(eqx.Module):
    """One step from (t0, y0) to t1, with its signed size h and the field f(t, y)."""

    terms: Any
    args: Any
    t0: Array
    t1: Array
    y0: Float[Array, " n"]
    h: Float[Array, ""]

    def __init__(self, terms: Any, t0: Any, t1: Any, y0: Any, args: Any):
        if jax.tree.structure(y0) != jax.tree.structure(0) or jnp.ndim(y0) != 1:
            raise ValueError(
                f"A symplectic solver got a state of shape {jax.tree.map(jnp.shape, y0)}; it needs "
                "one array of shape (n,). For a batch, use `jax.vmap` over the initial states."
            )
        self.terms, self.args = terms, args
        self.t0, self.t1, self.y0 = jnp.asarray(t0), jnp.asarray(t1), jnp.asarray(y0)
        # The sign of h is the direction of time. The times may have fewer digits than the state.
        self.h = jnp.asarray(terms.contr(t0, t1), self.y0.dtype)

    def field(self, t: Any, y: Float[Array, " n"]) -> Float[Array, " n"]:
        return self.terms.vf(t, y, self.args)

    def time(self, fraction: float | np.ndarray) -> Array:
        return self.t0 + jnp.asarray(fraction, self.t0.dtype) * (self.t1 - self.t0)


class AbstractSymplecticSolver(diffrax.AbstractSolver):
    """A Diffrax solver whose step is a symplectic map for every constant step size.

    The solver gives no error estimate, so Diffrax refuses to combine it with an adaptive step size.
    """

    term_structure: ClassVar = diffrax.AbstractTerm
    nominal_order: AbstractClassVar[int]

    @property
    def interpolation_cls(self):  # pyright: ignore[reportIncompatibleVariableOverride]
        """The interpolation between steps, for `SaveAt(ts=...)`: linear at order 2, else cubic.

        Neither is symplectic. End steps at the times of interest, as `simulate` does.
        """
        if self.nominal_order == 2:
            return diffrax.LocalLinearInterpolation
        return diffrax.ThirdOrderHermitePolynomialInterpolation

    def order(self, terms: Any) -> int:
        """Return the order p: the error at a fixed time is O(hᵖ)."""
        return self.nominal_order

    def func(self, terms: Any, t0: Any, y0: Any, args: Any) -> Any:
        """Return the vector field at one point."""
        return terms.vf(t0, y0, args)

    def _dense_info(self, step: Step, y1: Float[Array, " n"]) -> dict[str, Array]:
        info = {"y0": step.y0, "y1": y1}
        if self.nominal_order > 2:  # XLA drops these two evaluations if no state is interpolated.
            info["k0"] = step.h * step.field(step.t0, step.y0)
            info["k1"] = step.h * step.field(step.t1, y1)
        return info


# Gauss collocation.


class FixedPointToRounding(optx.AbstractFixedPointSolver):
    """Iterate y ← f(y) until the increments are rounding errors.

    The iteration stops in one of three cases.

    1. The increment is at most `rtol · max|y| + atol`, by default zero.
    2. The increment is below √eps · max|y| and has had no new minimum for three iterations.
    3. The increment is below ∛eps · max|y| or `options["rounding"]`, and has had no new minimum for
       nine iterations. The first bound is for kernel sums with coefficients of 1e11, as from
       noise-free data, whose rounding errors are larger. The second is for equilibria, where f
       consists of rounding errors.

    Any tolerance, even eps, leaves an error of the same sign in every step, and H drifts. In 3e6
    steps of the midpoint rule the energy of an oscillator changed by 1.6e-11 with a tolerance of
    eps, and by less than 1e-12 with zero, at the same cost. For small steps of a non-stiff field
    the iteration is cheaper than Newton's method.

    Source: HLW, VIII.6; Hairer, McLachlan & Razakarivony (2008), BIT 48, 231-243.
    """

    rtol: float = 0.0
    atol: float = 0.0
    norm: Callable[[Any], Scalar] = optx.max_norm

    # The increments for an oscillator shrink only every second iteration, so we wait for three.
    patience: ClassVar[int] = 3

    def init(self, fn, y, args, options, f_struct, aux_struct, tags):
        """Return (increment, smallest increment so far, iterations since then)."""
        infinite = jnp.full_like(self.norm(y), jnp.inf)
        return infinite, infinite, jnp.array(0)

    def step(self, fn, y, args, options, state, tags):
        """Apply f once."""
        _, smallest, since = state
        new, aux = fn(y, args)
        increment = self.norm(new - y)
        since = jnp.where(increment < smallest, 0, since + 1)
        return new, (increment, jnp.minimum(increment, smallest), since), aux

    def terminate(self, fn, y, args, options, state, tags) -> tuple[Bool[Array, ""], optx.RESULTS]:
        """Return whether the increments are rounding errors, or not finite."""
        increment, _, since = state
        size = self.norm(y)
        eps = float(jnp.finfo(size.dtype).eps)
        done = increment <= self.rtol * size + self.atol
        stalled = (since >= self.patience) & (increment <= eps**0.5 * size)
        enough = jnp.maximum(eps ** (1 / 3) * size, options.get("rounding", 0.0))
        stalled |= (since >= 3 * self.patience) & (increment <= enough)
        # The increment is infinite before the first iteration, and NaN once the field overflows.
        is_nan = jnp.isnan(increment)
        result = optx.RESULTS.where(
            is_nan, optx.RESULTS.nonlinear_divergence, optx.RESULTS.successful
        )
        return done | stalled | is_nan, result

    def postprocess(self, fn, y, aux, args, options, state, tags, result):
        """Return the last iterate as it is."""
        return y, aux, {}


class GaussTableau(NamedTuple):
    """The Butcher coefficients of s-stage Gauss collocation, and an extrapolation of slopes."""

    a: np.ndarray  # (s, s)
    share: np.ndarray  # (s, s): a_ij / b_j
    b: np.ndarray  # (s,)
    c: np.ndarray  # (s,)
    ahead: np.ndarray  # (s, s): slopes of one step ↦ first guess for the next step


def _gauss(stages: int) -> GaussTableau:
    """The tableau of collocation at the zeros c of the shifted Legendre polynomial (HLW II.1.3).

    With the Lagrange polynomials ℓ_j at c, a_ij = ∫₀^{c_i} ℓ_j and b_j = ∫₀¹ ℓ_j. The first guess
    for the next step is the polynomial through the slopes of this step, at 1 + c (VIII.6.1).
    """
    nodes, weights = np.polynomial.legendre.leggauss(stages)
    c, b = (nodes + 1) / 2, weights / 2
    powers = np.arange(stages)
    to_coefficients = np.linalg.inv(c[:, None] ** powers)  # (s, s): values at c ↦ coefficients
    a = (c[:, None] ** (powers + 1) / (powers + 1)) @ to_coefficients
    ahead = (1 + c[:, None]) ** powers @ to_coefficients
    share = a / b
    np.fill_diagonal(share, 0.5)
    return GaussTableau(a, share, b, c, ahead)


class AbstractGauss(AbstractSymplecticSolver, diffrax.AbstractImplicitSolver):
    """Gauss collocation: k_i = f(t + c_i h, x + h Σ_j a_ij k_j), x₁ = x + h Σ_i b_i k_i.

    The order is 2s with s stages. The map is symplectic because b_i a_ij + b_j a_ji = b_i b_j
    (HLW VI.4), and symmetric, Ψ_h⁻¹ = Ψ_{−h}, because the nodes are symmetric (V.2). The solver
    state is the slopes of the last step, from which we guess the next.

    Rounded coefficients violate the equation b_i a_ij + b_j a_ji = b_i b_j, and H drifts by a
    fraction of eps in every step. We therefore round m_ij = a_ij/b_j instead, with increments
    l_i = h b_i k_i and stages x + Σ_j m_ij l_j. The equation becomes m_ij + m_ji = 1, which holds
    exactly in floating point for any rounding of b.

    Source: HLW; the increments are those of Antoñana, Makazaga & Murua (2017), Numer. Algorithms
        76, 861-880.
    """

    tableau: AbstractClassVar[GaussTableau]
    root_finder: AbstractVar[Any]
    root_find_max_steps: AbstractVar[int]

    def __repr__(self) -> str:
        integrator: Any = type(self)
        usual, names = integrator(), [field.name for field in dataclasses.fields(self)]
        values = [(name, getattr(self, name), getattr(usual, name)) for name in names]
        # We compare by value, since after pickling a default is no longer the same object.
        changed = [f"{name}={v!r}" for name, v, u in values if eqx.tree_equal(v, u) is not True]
        return f"{type(self).__name__}({', '.join(changed)})"

    def init(self, terms: Any, t0: Any, t1: Any, y0: Any, args: Any) -> Float[Array, "s n"]:
        """Return the first guess of the stage slopes."""
        step = Step(terms, t0, t1, y0, args)
        slope = step.field(t0, step.y0)
        return jnp.broadcast_to(slope, (self.tableau.b.size, slope.size))

    def step(
        self, terms: Any, t0: Any, t1: Any, y0: Any, args: Any, solver_state: Any, made_jump: Any
    ) -> tuple[Float[Array, " n"], None, dict[str, Array], Float[Array, "s n"], diffrax.RESULTS]:
        """Solve the stage equations to rounding and make one step."""
        step = Step(terms, t0, t1, y0, args)
        tableau = jax.tree.map(lambda x: jnp.asarray(x, step.y0.dtype), self.tableau)
        weights = step.h * tableau.b
        # One of m_ij and m_ji is in [1/2, 2], where 1 − m is exact in every precision.
        share = jnp.where(tableau.share < 0.5, 1 - tableau.share.T, tableau.share)
        # Increments below √eps max|x|/h that do not shrink are rounding errors.
        rounding = float(jnp.finfo(step.y0.dtype).eps) ** 0.5 * jnp.abs(step.y0 / step.h).max()
        solution = optx.fixed_point(
            _stage_slopes,
            self.root_finder,
            jax.lax.stop_gradient(tableau.ahead @ solver_state),
            (step, step.time(self.tableau.c), share, weights),
            options={"rounding": jax.lax.stop_gradient(rounding)},
            max_steps=self.root_find_max_steps,
            throw=False,
        )
        y1 = step.y0 + jnp.sum(weights[:, None] * solution.value, axis=0)
        result = diffrax.RESULTS.promote(solution.result)
        return y1, None, self._dense_info(step, y1), solution.value, result


def _stage_slopes(
    k: Float[Array, "s n"],
    inputs: tuple[Step, Float[Array, " s"], Float[Array, "s s"], Float[Array, " s"]],
) -> Float[Array, "s n"]:
    """The map of slopes whose fixed point is the slopes k of the stages."""
    step, times, share, weights = inputs
    return jax.vmap(step.field)(times, step.y0[None] + share @ (weights[:, None] * k))


class ImplicitMidpoint(AbstractGauss):
    """Implicit midpoint rule, x₁ = x + h f((x + x₁)/2): Gauss collocation with one stage.

    The rule has order 2 and is symplectic for every Hamiltonian. It is symmetric, and therefore
    time-reversible if the field is. It conserves every quadratic invariant up to rounding. An
    iteration takes one evaluation of f.

    Args:
        root_finder: an `optimistix` fixed-point solver or root finder for the implicit equation.
            The default needs h‖Df‖/2 well below 1. `optimistix.Newton(rtol, atol)` with tolerances
            near rounding allows larger steps of stiffer fields.
        root_find_max_steps: the largest number of iterations of a step; beyond it the solve fails.

    Raises:
        ValueError: the state is not one array of shape (n,).
        RuntimeError: the iteration did not converge; take a smaller step.

    Source: HLW, I.1.2 and VI.3 (theorem 3.5).
    """

    nominal_order: ClassVar[int] = 2
    tableau: ClassVar[GaussTableau] = _gauss(1)
    root_finder: Any = FixedPointToRounding()
    root_find_max_steps: int = 100


class GaussLegendre4(AbstractGauss):
    """Gauss collocation with two stages, c = 1/2 ∓ √3/6.

    The method has order 4, is symplectic for every Hamiltonian and symmetric, and conserves every
    quadratic invariant. For the formula see `AbstractGauss`, for arguments and errors see
    `ImplicitMidpoint`.

    Source: HLW, II.1.3 (table 1.1) and VI.4.
    """

    nominal_order: ClassVar[int] = 4
    tableau: ClassVar[GaussTableau] = _gauss(2)
    root_finder: Any = FixedPointToRounding()
    root_find_max_steps: int = 100


class GaussLegendre6(AbstractGauss):
    """Gauss collocation with three stages, c = 1/2, 1/2 ∓ √15/10.

    The method has order 6, is symplectic for every Hamiltonian and symmetric, and conserves every
    quadratic invariant. For the formula see `AbstractGauss`, for arguments and errors see
    `ImplicitMidpoint`.

    Source: HLW, II.1.3 (table 1.1) and VI.4.
    """

    nominal_order: ClassVar[int] = 6
    tableau: ClassVar[GaussTableau] = _gauss(3)
    root_finder: Any = FixedPointToRounding()
    root_find_max_steps: int = 100


# Splitting.


def is_separable(terms: Any) -> bool:
    """Whether the field of a Diffrax term declares H = T(p) + U(q)."""
    while not hasattr(terms, "vector_field") and hasattr(terms, "term"):
        terms = terms.term  # Diffrax wraps the user's term to set the direction of time.
    return bool(getattr(getattr(terms, "vector_field", None), "is_separable", False))


class AbstractSplitting(AbstractSymplecticSolver):
    """Kick–drift–kick substeps of sizes w₁h, …, w_s h, with w = `weights`, Σ w = 1.

    A substep of size h, where q̇ = f_q depends only on p and ṗ = f_p only on q, is

        p½ = p + h/2 f_p(q),   q₁ = q + h f_q(p½),   p₁ = p½ + h/2 f_p(q₁).

    For any other field this map is neither symplectic nor of order 2, and the output does not show
    it. The field must therefore have an attribute `is_separable` that is True, or the caller must
    pass `assume_separable=True`. A substep evaluates f twice. The solver state is f_p(q₁), with
    which the next step begins.
    """

    weights: AbstractClassVar[tuple[float, ...]]
    assume_separable: AbstractVar[bool]

    def init(self, terms: Any, t0: Any, t1: Any, y0: Any, args: Any) -> Float[Array, " m"]:
        """Return the force f_p at the start."""
        step = Step(terms, t0, t1, y0, args)
        self._require_separable(terms, step.y0.size)
        return step.field(t0, step.y0)[step.y0.size // 2 :]

    def step(
        self, terms: Any, t0: Any, t1: Any, y0: Any, args: Any, solver_state: Any, made_jump: Any
    ) -> tuple[Float[Array, " n"], None, dict[str, Array], Float[Array, " m"], diffrax.RESULTS]:
        """Make one step of s kicks and s drifts."""
        step = Step(terms, t0, t1, y0, args)
        self._require_separable(terms, step.y0.size)
        q, p = jnp.split(step.y0, 2)
        force = solver_state
        if made_jump is not False:
            fresh = self.init(terms, t0, t1, y0, args)
            force = jnp.where(made_jump, fresh, force)
        begin = 0.0
        for weight in self.weights:
            h = weight * step.h
            p = p + h / 2 * force
            velocity = step.field(step.time(begin + weight / 2), jnp.concatenate([q, p]))
            q = q + h * velocity[: q.size]
            begin += weight
            force = step.field(step.time(begin), jnp.concatenate([q, p]))[q.size :]
            p = p + h / 2 * force
        y1 = jnp.concatenate([q, p])
        return y1, None, self._dense_info(step, y1), force, diffrax.RESULTS.successful

    def _require_separable(self, terms: Any, n: int) -> None:
        name = type(self).__name__
        if n % 2:
            raise ValueError(f"{name} got {n} coordinates: x = (q, p) has an even number.")
        if not (self.assume_separable or is_separable(terms)):
            raise ValueError(
                f"{name} needs a separable Hamiltonian H = T(p) + U(q), and this field cannot be "
                "proved to have one: it has no attribute `is_separable` that is True. A learned H "
                "is separable if its kernel is, hk.Select(k1, (0, 1)) + hk.Select(k2, (2, 3)) for "
                "four coordinates; for every other use hk.ImplicitMidpoint() or "
                "hk.GaussLegendre4(). "
                f"If you know that it is, say so with hk.{name}(assume_separable=True)."
            )


class StormerVerlet(AbstractSplitting):
    """Störmer–Verlet (leapfrog, velocity Verlet): the kick–drift–kick of `AbstractSplitting`.

    The method has order 2 and is symplectic if H = T(p) + U(q). It is symmetric, and therefore
    time-reversible if the field is. It is explicit, with two evaluations per step.

    Args:
        assume_separable: whether to assume H = T(p) + U(q). If False, the field must have an
            attribute `is_separable` that is True.

    Raises:
        ValueError: the field is not known to be separable, n is odd, or the state is not (n,).

    Source: HLW, I.1.4 and VI.3 (theorem 3.4).
    """

    nominal_order: ClassVar[int] = 2
    weights: ClassVar[tuple[float, ...]] = (1.0,)
    assume_separable: bool = False


class Yoshida4(AbstractSplitting):
    """Yoshida's triple jump: three `StormerVerlet` steps of sizes γh, (1 − 2γ)h, γh.

    γ = 1/(2 − 2^{1/3}) ≈ 1.35, so the middle step runs backwards. The method has order 4, is
    symplectic if H = T(p) + U(q), symmetric, and explicit with six evaluations per step. For
    arguments and errors see `StormerVerlet`.

    Source: Yoshida (1990), Phys. Lett. A 150, 262–268; HLW, II.4 (example 4.2).
    """

    nominal_order: ClassVar[int] = 4
    weights: ClassVar[tuple[float, ...]] = tuple(
        w / (2 - 2 ** (1 / 3)) for w in (1.0, -(2 ** (1 / 3)), 1.0)
    )
    assume_separable: bool = False


class EqualSteps(diffrax.AbstractSolver):
    """One long step that consists of ⌈(t1 − t0)/dt⌉ equal steps of another solver.

    With `diffrax.StepTo(ts)` every time in `ts` is the end of a step, so Diffrax interpolates
    nothing and stores only the saved points. The steps between two times have one size, at most
    `dt`, independent of the state. Each long step starts at time 0, so that a small step does not
    vanish in the rounding of a large time. For fields with inputs, `args` is the true start time.
    """

    solver: diffrax.AbstractSolver
    dt: Float[Array, ""]
    adjoint: diffrax.AbstractAdjoint
    max_steps: int = eqx.field(static=True)

    term_structure: ClassVar = diffrax.AbstractTerm
    interpolation_cls: ClassVar = diffrax.LocalLinearInterpolation

    def order(self, terms: Any) -> int | None:
        """Return the order of the inner solver."""
        return self.solver.order(terms)

    def init(self, terms: Any, t0: Any, t1: Any, y0: Any, args: Any) -> None:
        """Return None: a long step needs nothing from the previous one."""

    def func(self, terms: Any, t0: Any, y0: Any, args: Any) -> Any:
        """Return the vector field at one point."""
        return self.solver.func(terms, t0, y0, args)

    def step(
        self, terms: Any, t0: Any, t1: Any, y0: Any, args: Any, solver_state: Any, made_jump: Any
    ) -> tuple[Any, None, dict[str, Any], None, diffrax.RESULTS]:
        """Make the equal steps."""
        span = t1 - t0
        solution = diffrax.diffeqsolve(
            terms,
            self.solver,
            jnp.zeros_like(span),
            span,
            span / equal_steps(span, self.dt),
            y0,
            # With inputs: the caller's time at the start of this long step.
            None if args is None else args + t0,
            adjoint=self.adjoint,
            max_steps=self.max_steps,
            throw=False,
        )
        # If the steps did not reach t1, we return infinity, as Diffrax does.
        reached = solution.result == diffrax.RESULTS.successful
        y1 = jax.tree.map(lambda y: jnp.where(reached, y[-1], jnp.inf), solution.ys)
        return y1, None, {"y0": y0, "y1": y1}, None, solution.result


@precise_jit
def step_counts(ts: Float[Array, " T"], dt: Float[Array, ""]) -> Int[Array, " T-1"]:
    """The number of equal steps in each interval of ts."""
    return equal_steps(ts[1:] - ts[:-1], dt).astype(int)


def equal_steps(span: Float[Array, "..."], dt: Float[Array, ""]) -> Float[Array, "..."]:
    """The number of equal steps of at most `dt` that fill `span`, an integer ≥ 1.

    A step may exceed `dt` by a factor 1 + √eps, so that 10 dt plus rounding errors take 10 steps.
    """
    slack = 1 - float(jnp.finfo(span.dtype).eps) ** 0.5
    return jnp.maximum(jnp.ceil(span / jnp.asarray(dt, span.dtype) * slack), 1)
