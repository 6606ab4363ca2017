"""`Formula`: a formula of the potential, as a field and as text."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterator
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float, Num

from hamkernel import _require as require
from hamkernel._fields.base import potential_of
from hamkernel._machine import EqualToItself, full_precision
from hamkernel._structures.base import AbstractMatrixKernel, Sum
from hamkernel._structures.masses import UnknownMasses
from hamkernel._structures.structure import AbstractPotentialKernel


class Formula(EqualToItself, eqx.Module):
    """The formula u(x) = Σ θ_k φ_k(x) of a potential; made by `readout`.

    A formula is a field and a PyTree: `formula(x)` is the velocity B∇u at one state, so
    `hk.simulate(formula, x0, ts)` works. `formula.potential(x)` is u. If the structure has an
    energy, `formula.hamiltonian(x)` is u too.

    Attributes:
        terms: the names of the selected functions, in the order of the dictionary.
        coefficients: θ, shape (k,).
        deviations: the standard deviations of θ, shape (k,), from the noise and the selection of
            the terms. Hyperparameters of the kernel, such as friction, count as known.
        misfit: s/√(Nλ), shape (), with the residual variance s² of the formula and the noise
            variance Nλ of the kernel. The misfit is about one if the formula explains the data as
            well as the kernel, and larger if a term is missing.
        probability: the posterior probability of these terms among all subsets, shape ().
        rows: the number of rows.
        functions: the φ_k of the terms.
        kernel: the kernel, which defines B.
        mean: the known part of the field, which is added to B∇u; None if there is none.
    """

    terms: tuple[str, ...] = eqx.field(static=True)
    coefficients: Float[Array, " k"]
    deviations: Float[Array, " k"]
    misfit: Float[Array, ""]
    probability: Float[Array, ""]
    rows: int = eqx.field(static=True)
    functions: tuple[Callable[..., Any], ...]
    kernel: AbstractMatrixKernel
    mean: Any

    def __repr__(self) -> str:
        signed = [
            ("- " if value < 0 else "+ ") + f"{_with_deviation(abs(value), deviation)} {name}"
            for name, value, deviation in self._triples()
        ]
        if self.mean is not None:
            signed = ["+ (that of the mean)", *signed]
        total = " ".join(signed)
        total = total.removeprefix("+ ") if total.startswith("+") else "-" + total[2:]
        return (
            f"{self._symbol} = {total}    [misfit {float(self.misfit):.3g} of {self.rows} rows, "
            f"probability {float(self.probability):.2f}]"
        )

    def _repr_latex_(self) -> str:
        return f"${self.latex()}$"

    def latex(self) -> str:
        r"""The formula in LaTeX, such as `H = 0.5002(12)\,p^{2} - 0.981(4)\,\cos(q)`.

        A coefficient comes with its deviation in units of the last digit. We translate the names of
        the terms from Python: powers, products, indices and common functions. A name that contains
        a backslash stays as it is.
        """
        total = ""
        for name, value, deviation in self._triples():
            sign = "-" if value < 0 else "+" if total else ""
            term = rf"{_with_deviation(abs(value), deviation)}\,{_latex(name)}"
            total += f" {sign} {term}" if total else f"{sign}{term}"
        mean = rf"{self._symbol}_\mathrm{{mean}} + " if self.mean is not None else ""
        return f"{self._symbol} = {mean}{total}".replace("+ -", "- ")

    def _triples(self) -> Iterator[tuple[str, float, float]]:
        values = np.asarray(self.coefficients, float), np.asarray(self.deviations, float)
        for name, value, deviation in zip(self.terms, *values, strict=True):
            yield name, float(value), float(deviation)

    @property
    def _symbol(self) -> str:
        return "H" if self.kernel.has_hamiltonian else "u"

    def _formula(self, x: Float[Array, " n"]) -> Float[Array, ""]:
        theta = self.coefficients
        values = [jnp.asarray(fn(x)).astype(theta.dtype) for fn in self.functions]
        return theta @ jnp.stack(values)

    def __call__(self, x: Num[ArrayLike, " n"]) -> Float[Array, " n"]:
        """The velocity B(x)∇u(x) plus the mean, without inputs."""
        x = require.floating(x, "x")
        velocity = operator_of(self.kernel)(x, jax.grad(self._formula)(x))
        return velocity if self.mean is None else velocity + self.mean(x).astype(velocity.dtype)

    @full_precision
    def potential(self, x: Num[ArrayLike, " n"]) -> Float[Array, ""]:
        """The potential u(x) plus that of the mean.

        Raises:
            AttributeError: the mean has no potential of this structure.
        """
        x = require.floating(x, "x")
        value = self._formula(x)
        return value if self.mean is None else value + potential_of(self.mean, self.kernel)(x)

    def hamiltonian(self, x: Num[ArrayLike, " n"]) -> Float[Array, ""]:
        """The energy H(x) plus that of the mean.

        Raises:
            AttributeError: the structure has no energy, or the mean has none.
        """
        if not self.kernel.has_hamiltonian:
            raise AttributeError(
                f"the fields of {type(self.kernel).__name__} have no energy: ask for potential(x)."
            )
        return self.potential(x)


def operator_of(K: AbstractMatrixKernel) -> Callable[[Array, Array], Array]:
    """The function (x, v) -> B(x) v of a kernel of fields B∇u."""
    K = K.state_kernel
    if isinstance(K, Sum):  # a sum with a potential has one operator for all terms
        return operator_of(K.terms[0])
    if isinstance(K, UnknownMasses):  # S⁻¹ B S⁻ᵀ in the coordinates y = S⁻¹x
        inner = operator_of(K.kernel)
        return lambda y, v: K.to_velocities(inner(K.to_momenta(y), K.to_velocities(v)))
    if isinstance(K, AbstractPotentialKernel):
        return K.apply
    raise TypeError(
        f"{type(K).__name__} has no operator B with f = B∇u that the library knows: learn with "
        "Symplectic, PortHamiltonian, Poisson, CurlFree or Structured(k, operator)."
    )


def _with_deviation(value: float, deviation: float) -> str:
    """A positive number with its deviation in units of the last digit, such as `0.981(4)`."""
    if not (deviation > 0 and math.isfinite(deviation)) or deviation < 1e-12 * value:
        return f"{value:.6g}"
    power = math.floor(math.log10(deviation))
    digits = round(deviation / 10.0**power)
    if digits < 3:  # 0.981(12), since 0.98(1) would round the deviation too much
        power, digits = power - 1, round(deviation / 10.0 ** (power - 1))
    if power > 0:
        return f"{round(value, -power):.0f}({digits * 10**power})"
    return f"{value:.{-power}f}({digits})"


def _latex(name: str) -> str:
    """The LaTeX of a name in Python."""
    if "\\" in name:
        return name
    name = re.sub(r"\*\*\s*\(([^()]*)\)|\*\*\s*(-?[\w.]+)", lambda m: f"^{{{m[1] or m[2]}}}", name)
    name = re.sub(r"\b(sin|cos|tan|sinh|cosh|tanh|exp|log|sqrt|arctan)\b", r"\\\1", name)
    name = re.sub(r"(?<![\\\w])([A-Za-z])_?(\d+)\b", r"\1_{\2}", name)
    return re.sub(r"\s*\*\s*", r"\\,", name)
