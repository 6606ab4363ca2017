"""Splitting: explicit, symplectic where H = T(p) + U(q). See `equal_steps.py`."""

from typing import Any, ClassVar

import diffrax
import jax.numpy as jnp
from equinox import AbstractClassVar, AbstractVar
from jaxtyping import Array, Float

from hamkernel._dynamics.equal_steps import AbstractSymplecticSolver, Step

_TRIPLE_JUMP = 1 / (2 - 2 ** (1 / 3))


def is_separable(terms: Any) -> bool:
    """Whether the field under a Diffrax term says of itself that H = T(p) + U(q)."""
    while not hasattr(terms, "vector_field") and hasattr(terms, "term"):
        terms = terms.term  # Diffrax wraps the user's term to set the direction of time.
    return bool(getattr(getattr(terms, "vector_field", None), "is_separable", False))


class AbstractSplitting(AbstractSymplecticSolver):
    """Kick, drift, kick with h replaced by w_1 h, …, w_s h in turn (w = `weights`, Σ w = 1).

    One such substep of size h, where q̇ = f_q depends on p alone and ṗ = f_p on q alone:

        p½ = p + h/2 f_p(q),   q₁ = q + h f_q(p½),   p₁ = p½ + h/2 f_p(q₁)

    For any other field this is not symplectic, nor even consistent with order 2, and nothing in its
    output shows it. So the field must have an attribute `is_separable` that is True, or the caller
    must say so by `assume_separable=True`. f is evaluated whole, twice in every substep; the state
    carried between steps is f_p(q₁), with which the next step begins.
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

    Order 2; symplectic if H = T(p) + U(q); symmetric, so time-reversible where the field is;
    explicit, two evaluations per step.

    Args:
        assume_separable: take the caller's word for H = T(p) + U(q). False: the field must have an
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

    γ = 1/(2 − 2^{1/3}) ≈ 1.35, so the middle step runs backwards. Order 4; symplectic if
    H = T(p) + U(q); symmetric; explicit, six evaluations per step. Arguments and errors are those
    of `StormerVerlet`.

    Source: Yoshida (1990), Phys. Lett. A 150, 262–268; HLW, II.4 (example 4.2).
    """

    nominal_order: ClassVar[int] = 4
    weights: ClassVar[tuple[float, ...]] = (_TRIPLE_JUMP, 1 - 2 * _TRIPLE_JUMP, _TRIPLE_JUMP)
    assume_separable: bool = False
