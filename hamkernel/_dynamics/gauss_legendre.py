"""Gauss collocation: implicit, symplectic for every Hamiltonian. See `equal_steps.py`."""

from collections.abc import Callable
from typing import Any, ClassVar, NamedTuple

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from equinox import AbstractClassVar, AbstractVar
from jaxtyping import Array, Bool, Float, Scalar

from hamkernel._dynamics.equal_steps import AbstractSymplecticSolver, Step


class FixedPointToRounding(optx.AbstractFixedPointSolver):
    """Iterate y ← f(y) until the increments are rounding errors.

    Stops when the increment is at most `rtol · max|y| + atol`, by default zero; or when it is below
    √eps · max|y| without a new minimum for three iterations, where the rounding of f ends the
    descent. That of a kernel sum with coefficients of 1e11, as of noise-free data, ends it earlier:
    below ∛eps · max|y| nine such iterations suffice, and so they do below `options["rounding"]`,
    since at an equilibrium f is nothing but rounding and no part of max|y| is small.

    Any tolerance, even eps, leaves an error of one sign in every step, and H drifts: in 3e6 steps
    the midpoint rule changed an oscillator's energy by 1.6e-11 with eps and by less than 1e-12 with
    zero, in the same time. For small steps of a non-stiff field it is cheaper than Newton.

    Source: HLW, VIII.6; Hairer, McLachlan & Razakarivony (2008), BIT 48, 231-243.
    """

    rtol: float = 0.0
    atol: float = 0.0
    norm: Callable[[Any], Scalar] = optx.max_norm

    # Increments of an oscillation shrink every second iteration only, hence more than two.
    patience: ClassVar[int] = 3

    def init(self, fn, y, args, options, f_struct, aux_struct, tags):
        """Return (increment, smallest increment so far, iterations since then)."""
        del fn, args, options, f_struct, aux_struct, tags
        infinite = jnp.full_like(self.norm(y), jnp.inf)
        return infinite, infinite, jnp.array(0)

    def step(self, fn, y, args, options, state, tags):
        """Apply f once."""
        del options, tags
        _, smallest, since = state
        new, aux = fn(y, args)
        increment = self.norm(new - y)
        since = jnp.where(increment < smallest, 0, since + 1)
        return new, (increment, jnp.minimum(increment, smallest), since), aux

    def terminate(self, fn, y, args, options, state, tags) -> tuple[Bool[Array, ""], optx.RESULTS]:
        """Return whether the increments are rounding errors, or not finite."""
        del fn, args, tags
        increment, _, since = state
        size = self.norm(y)
        eps = float(jnp.finfo(size.dtype).eps)
        done = increment <= self.rtol * size + self.atol
        stalled = (since >= self.patience) & (increment <= eps**0.5 * size)
        enough = jnp.maximum(eps ** (1 / 3) * size, options.get("rounding", 0.0))
        stalled |= (since >= 3 * self.patience) & (increment <= enough)
        # The increment is infinite before the first iteration, and NaN once the field overflows.
        lost = jnp.isnan(increment)
        result = optx.RESULTS.where(
            lost, optx.RESULTS.nonlinear_divergence, optx.RESULTS.successful
        )
        return done | stalled | lost, result

    def postprocess(self, fn, y, aux, args, options, state, tags, result):
        """Return the last iterate as it is."""
        del fn, args, options, state, tags, result
        return y, aux, {}


class GaussTableau(NamedTuple):
    """Butcher coefficients of s-stage Gauss collocation, and the extrapolation of its slopes."""

    a: np.ndarray  # (s, s)
    share: np.ndarray  # (s, s): a_ij / b_j
    b: np.ndarray  # (s,)
    c: np.ndarray  # (s,)
    ahead: np.ndarray  # (s, s): slopes of one step ↦ guess for the next


def _gauss(stages: int) -> GaussTableau:
    """Collocation at the zeros c of the shifted Legendre polynomial (HLW II.1.3).

    With ℓ_j the Lagrange polynomials at c: a_ij = ∫₀^{c_i} ℓ_j, b_j = ∫₀¹ ℓ_j. The polynomial
    through the slopes of a step, evaluated at 1 + c, starts the iteration of the next (VIII.6.1).
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

    Order 2s with s stages. Symplectic because b_i a_ij + b_j a_ji = b_i b_j (HLW VI.4), and
    symmetric, Ψ_h⁻¹ = Ψ_{−h}, because the nodes are (V.2). The state carried between steps is the
    last slopes, from which the next are guessed.

    Rounded coefficients break that equation, and H drifts by a part of eps in every step. So what
    is rounded is m_ij = a_ij/b_j, in increments l_i = h b_i k_i and stages x + Σ_j m_ij l_j: then
    the equation is m_ij + m_ji = 1, which holds exactly in floating point, and no b breaks it.

    Source: HLW; the increments are those of Antoñana, Makazaga & Murua (2017), Numer. Algorithms
        76, 861-880.
    """

    tableau: AbstractClassVar[GaussTableau]
    root_finder: AbstractVar[Any]
    root_find_max_steps: AbstractVar[int]

    def init(self, terms: Any, t0: Any, t1: Any, y0: Any, args: Any) -> Float[Array, "s n"]:
        """Return the first guess of the stage slopes."""
        step = Step(terms, t0, t1, y0, args)
        slope = step.field(t0, step.y0)
        return jnp.broadcast_to(slope, (self.tableau.b.size, slope.size))

    def step(
        self, terms: Any, t0: Any, t1: Any, y0: Any, args: Any, solver_state: Any, made_jump: Any
    ) -> tuple[Float[Array, " n"], None, dict[str, Array], Float[Array, "s n"], diffrax.RESULTS]:
        """Solve the stage equations to rounding and make one step."""
        del made_jump  # The slopes of the last step are but a guess.
        step = Step(terms, t0, t1, y0, args)
        tableau = jax.tree.map(lambda x: jnp.asarray(x, step.y0.dtype), self.tableau)
        weights = step.h * tableau.b
        # One of each pair is in [1/2, 2], where 1 − m is exact in every precision.
        share = jnp.where(tableau.share < 0.5, 1 - tableau.share.T, tableau.share)
        # What moves the state by less than √eps of it, and does not shrink, is rounding.
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
    """The map whose fixed point are the slopes k of the stages."""
    step, times, share, weights = inputs
    return jax.vmap(step.field)(times, step.y0[None] + share @ (weights[:, None] * k))


class ImplicitMidpoint(AbstractGauss):
    """Implicit midpoint rule, x₁ = x + h f((x + x₁)/2): Gauss collocation with one stage.

    Order 2; symplectic for every Hamiltonian; symmetric, so time-reversible where the field is; it
    conserves every quadratic invariant exactly (up to rounding). One evaluation per iteration.

    Args:
        root_finder: how the implicit equation is solved: an `optimistix` fixed-point solver or root
            finder. The default needs h‖Df‖/2 well below 1; `optimistix.Newton(rtol, atol)` with
            tolerances near rounding takes larger steps of stiffer fields.
        root_find_max_steps: iterations after which a step is given up and the solve fails.

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

    Order 4; symplectic for every Hamiltonian; symmetric; conserves every quadratic invariant. The
    formula is that of `AbstractGauss`; arguments and errors are those of `ImplicitMidpoint`.

    Source: HLW, II.1.3 (table 1.1) and VI.4.
    """

    nominal_order: ClassVar[int] = 4
    tableau: ClassVar[GaussTableau] = _gauss(2)
    root_finder: Any = FixedPointToRounding()
    root_find_max_steps: int = 100


class GaussLegendre6(AbstractGauss):
    """Gauss collocation with three stages, c = 1/2, 1/2 ∓ √15/10.

    Order 6; symplectic for every Hamiltonian; symmetric; conserves every quadratic invariant. The
    formula is that of `AbstractGauss`; arguments and errors are those of `ImplicitMidpoint`.

    Source: HLW, II.1.3 (table 1.1) and VI.4.
    """

    nominal_order: ClassVar[int] = 6
    tableau: ClassVar[GaussTableau] = _gauss(3)
    root_finder: Any = FixedPointToRounding()
    root_find_max_steps: int = 100
