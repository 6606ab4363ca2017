"""The call of Diffrax."""

from typing import Any

import diffrax
from jaxtyping import Array, Float

from hamkernel._dynamics.plan import Plan
from hamkernel._dynamics.right_hand_side import RightHandSide


def checked_adjoint(adjoint: Any) -> diffrax.AbstractAdjoint:
    """How Diffrax differentiates; its default if None."""
    if adjoint is None:
        return diffrax.RecursiveCheckpointAdjoint()
    if not isinstance(adjoint, diffrax.AbstractAdjoint):
        raise TypeError(
            f"adjoint must be one of Diffrax, such as diffrax.ForwardMode(); got {adjoint!r}."
        )
    return adjoint


def followed(
    rhs: RightHandSide,
    plan: Plan,
    ts: Float[Array, " T"],
    x0: Float[Array, " n"],
    adjoint: diffrax.AbstractAdjoint,
    progress: bool,
) -> diffrax.Solution:
    """The solution, whether it reached its end or not.

    Raises:
        TypeError: forward mode through an adjoint of reverse mode.
    """
    try:
        return diffrax.diffeqsolve(
            diffrax.ODETerm(rhs.called),
            plan.solver,
            ts[0],
            ts[-1],
            None,
            x0,
            rhs.args,
            saveat=plan.saveat,
            stepsize_controller=plan.controller,
            adjoint=adjoint,
            max_steps=plan.max_steps,
            throw=False,
            progress_meter=diffrax.TqdmProgressMeter() if progress else diffrax.NoProgressMeter(),
        )
    except TypeError as error:
        if "forward-mode" not in str(error) or isinstance(adjoint, diffrax.ForwardMode):
            raise
        raise TypeError(
            f"{type(adjoint).__name__} is for reverse mode alone: pass adjoint="
            "diffrax.ForwardMode() for jax.jvp and jax.jacfwd, adjoint=diffrax.DirectAdjoint() for "
            "jax.hessian."
        ) from error
