"""What observations of every kind are, sums of them, and the inputs that they may have."""

from __future__ import annotations

import abc
from collections.abc import Iterator
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from hamkernel import _require as require
from hamkernel._observations.blocks import AbstractBlock
from hamkernel._show import described, joined


class AbstractObservations(eqx.Module):
    """Measured values of linear functionals of a field; those of two add up."""

    def __repr__(self) -> str:
        return described(self)

    @property
    @abc.abstractmethod
    def dimension(self) -> int:
        """n, the number of coordinates of a state."""

    def driven(self) -> Iterator[Float[Array, "*points m"]]:
        """The inputs that were given, of one kind after the other."""
        inputs = getattr(self, "inputs", None)  # energies have none
        if inputs is not None:
            yield inputs

    @abc.abstractmethod
    def parts(self, count: int = 0) -> Iterator[tuple[AbstractBlock, Float[Array, " D"]]]:
        """The rows of one kind after the other, and what was measured, in the units it has.

        Points are (x, u) where there are `count` inputs.

        Raises:
            ValueError: there are, and they were not given.
        """

    def __add__(self, other: Any) -> AbstractObservations:
        if not isinstance(other, AbstractObservations):
            return NotImplemented
        return Together(_terms(self) + _terms(other))

    def __radd__(self, other: Any) -> AbstractObservations:
        return self if isinstance(other, int) and other == 0 else NotImplemented


class Together(AbstractObservations):
    """Observations of several kinds or places; made by `a + b`."""

    terms: tuple[AbstractObservations, ...]

    def __check_init__(self):
        dimensions = [term.dimension for term in self.terms]
        if len(set(dimensions)) > 1:
            raise ValueError(
                f"the observations in a sum are of states of {dimensions} coordinates: all must be "
                "of one system, with the same n."
            )

    def __repr__(self) -> str:
        return joined("+", [repr(term) for term in self.terms])

    @property
    def dimension(self) -> int:
        return self.terms[0].dimension

    def driven(self) -> Iterator[Float[Array, "*points m"]]:
        for term in self.terms:
            yield from term.driven()

    def parts(self, count: int = 0) -> Iterator[tuple[AbstractBlock, Float[Array, " D"]]]:
        for term in self.terms:
            yield from term.parts(count)


def _terms(data: AbstractObservations) -> tuple[AbstractObservations, ...]:
    return data.terms if isinstance(data, Together) else (data,)


def refuse_swapped(X: Any, Y: Any, inputs: Any) -> None:
    """ValueError where X and the inputs have each the shape of the other."""
    if inputs is not None and np.shape(X) != np.shape(Y) == np.shape(inputs):
        raise ValueError(
            f"X has shape {np.shape(X)}, inputs {np.shape(inputs)} and Y {np.shape(Y)}: X and "
            "the inputs seem to be swapped, hk.fit(K, X, Y, inputs=U)."
        )


def inputs_at(X: Float[Array, "*points n"], inputs: Any) -> Float[Array, "*points m"] | None:
    """U at every state, finite and in the dtype of the states; None if there are none."""
    if inputs is None:
        return None
    U = require.floating(inputs, "inputs")
    if U.ndim != X.ndim or U.shape[:-1] != X.shape[:-1] or U.shape[-1] == 0:
        hint = ""
        if U.shape == X.shape[:-1]:
            hint = f" For one input write U[{':, ' * U.ndim}None]."
        elif U.ndim == X.ndim == 2 and U.shape[1] == len(X):
            hint = " They seem to be transposed: U.T."
        raise ValueError(
            f"inputs has shape {U.shape}; m inputs for each of the states are needed, which have "
            f"shape {X.shape}.{hint}"
        )
    return require.finite(U.astype(X.dtype), "inputs")


def joined_points(
    data: Any, X: Float[Array, "*points n"], count: int
) -> tuple[Float[Array, "*points d"], int | None]:
    """The points (x, u) and n, where there are inputs; X and None where there are none."""
    if not count:
        return X, None
    if data.inputs is None:
        raise ValueError(
            f"the inputs of {type(data).__name__} are missing: a Controlled kernel needs inputs=U, "
            "one row of shape (m,) for each state."
        )
    return jnp.concatenate([X, data.inputs], axis=-1), X.shape[-1]
