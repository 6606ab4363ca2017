"""The text of kernels, fields and results, with the values of their hyperparameters."""

import dataclasses
import html
import sys
import textwrap
from collections.abc import Iterable, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array

# Replacements for terminals of ASCII and for code pages of Windows.
_ASCII = str.maketrans(
    {
        "λ": "lambda",
        "σ": "sigma",  # noqa: RUF001
        "χ": "chi",
        "π": "pi",
        "τ": "tau",
        "ω": "omega",
        "∇": "grad ",
        "‖": "|",
        "√": "sqrt",
        "²": "^2",
        "−": "-",  # noqa: RUF001
        "–": "-",  # noqa: RUF001
        "…": "...",
        "½": "1/2",
        "≤": "<=",
        "≥": ">=",
        "≈": "~",
        "±": "+-",
        "·": "*",
        "×": "x",  # noqa: RUF001
        "→": "->",
        "ẋ": "dx/dt",
        "∞": "inf",
        "θ": "theta",
        "Θ": "Theta",
        "φ": "phi",
        "ε": "eps",
        "μ": "mu",
        "Σ": "sum ",
        "∂": "d",
        "ᵀ": "^T",
        "ᵢ": "_i",
        "₁": "_1",
        "₂": "_2",
        "ṗ": "dp/dt",
        "\u0307": "'",  # a dot above the letter before it, as of q̇
        "é": "e",
    }
)


def printable(text: str) -> str:
    """The text in characters that the standard output can show."""
    encoding = getattr(sys.stdout, "encoding", None) or "utf-8"
    try:
        text.encode(encoding)
    except UnicodeEncodeError:
        return text.translate(_ASCII).encode(encoding, "replace").decode(encoding)
    return text


class Shown:
    """An object that prints a head and a line for each finding; a notebook shows a table."""

    def _summary(self) -> tuple[str, list[tuple[str, str]]]:
        """The head, and the findings, each a name and a text of one or more lines."""
        raise NotImplementedError

    def __repr__(self) -> str:
        head, findings = self._summary()
        width = max((len(name) for name, _ in findings), default=0) + 2
        lines = [name.ljust(width) + t.replace("\n", "\n" + width * " ") for name, t in findings]
        return printable("\n".join([head, *lines]))

    def _repr_html_(self) -> str:
        head, findings = self._summary()
        return f"<b>{html.escape(head)}</b>{html_table(findings)}"


def html_table(rows: Iterable[Sequence[str]], head: Sequence[str] = ()) -> str:
    """A table of HTML from rows of plain text; the first cell of a row is its name."""
    top = "".join(f"<th>{html.escape(cell)}</th>" for cell in head)
    body = "".join(
        "<tr>"
        + "".join(
            f'<{tag} style="text-align:left;white-space:pre-wrap">{html.escape(cell)}</{tag}>'
            for tag, cell in zip(["th", *["td"] * (len(row) - 1)], row, strict=True)
        )
        + "</tr>"
        for row in rows
    )
    return f"<table>{f'<thead><tr>{top}</tr></thead>' if head else ''}<tbody>{body}</tbody></table>"


def describe(module: Any, positional: tuple[str, ...] = ()) -> str:
    """`Gaussian(lengthscale=3.28)`: the attributes as they are read, few numbers as values.

    Attributes in `positional` are shown without their names. Attributes that are None, since they
    do not apply, are left out.
    """
    names = [f.name for f in dataclasses.fields(module) if getattr(module, f.name) is not None]
    return call(
        type(module).__name__,
        [
            text(getattr(module, name)) if name in positional else _attribute(module, name)
            for name in names
        ],
    )


def call(function: str, arguments: list[str]) -> str:
    """`function(a, b)`, in one line if it fits."""
    line = f"{function}({', '.join(arguments)})"
    if _fits(line):
        return line
    lines = _indent(",\n".join(arguments))
    return f"{function}(\n{lines}\n)"


def join_terms(sign: str, terms: list[str]) -> str:
    """`a + b`, in one line if it fits."""
    line = f" {sign} ".join(terms)
    return line if _fits(line) else f"\n{sign} ".join(terms)


def shorten(items: list[str]) -> list[str]:
    """The items; if they are many and long, the first, the number of omitted ones, and the last."""
    if len(items) <= 3 or sum(map(len, items)) <= 300:
        return items
    return [items[0], f"… {len(items) - 2} more", items[-1]]


def put_in_brackets(sum_of_terms: str) -> str:
    """The sum in brackets, to stand as a factor of a product."""
    if _fits(sum_of_terms):
        return f"({sum_of_terms})"
    return f"(\n{_indent(sum_of_terms)}\n)"


def _fits(line: str) -> bool:
    return len(line) <= 88 and "\n" not in line


def _indent(lines: str) -> str:
    return textwrap.indent(lines, "  ")


def _attribute(module: Any, name: str) -> str:
    value = getattr(module, name)
    if name.startswith("log_") and _is_short(value):
        return f"{name.removeprefix('log_')}={exponential(value)}"
    return f"{name}={text(value)}"


def exponential(log_value: Array) -> str:
    """exp(log_value) as text; the shape instead while JAX traces, or for many numbers."""
    short = _is_short(log_value)
    with np.errstate(over="ignore"):  # a gradient, in the place of the hyperparameter
        return text(np.asarray(np.exp(np.asarray(log_value))) if short else log_value)


def _is_short(value: Any) -> bool:
    if isinstance(value, jax.Array):
        if isinstance(value, Tracer) or jnp.issubdtype(value.dtype, jax.dtypes.prng_key):
            return False
        if not (value.is_fully_addressable or value.is_fully_replicated):
            return False
    elif not isinstance(value, np.ndarray):
        return False
    return value.ndim <= 1 and value.size <= 16


def text(value: Any) -> str:
    """A value as code would write it; an array of many numbers as its dtype and shape."""
    if isinstance(value, Shown):
        return value._summary()[0]
    if _is_short(value):
        digits: Any = {"float_kind": _number}
        return np.array2string(np.asarray(value), formatter=digits, separator=", ")
    if eqx.is_array(value):
        return eqx.tree_pformat(value)
    if isinstance(value, float):
        return _number(value)
    if type(value) is tuple:
        items = shorten([text(item) for item in value])
        return f"({', '.join(items)}{',' if len(items) == 1 else ''})"
    if isinstance(value, dict):
        return "{" + ", ".join(f"{key!r}: {text(item)}" for key, item in value.items()) + "}"
    if isinstance(value, eqx.Module) and type(value).__repr__ is eqx.Module.__repr__:
        return _module(value)
    name = getattr(getattr(value, "func", value), "__name__", None)
    return repr(value) if name is None else name


def numbers(value: Any) -> str:
    """`text` of one number for each coordinate; of more than 16 coordinates the range alone."""
    if not (eqx.is_array(value) and np.ndim(value) == 1 and np.size(value) > 16):
        return text(value)
    if not _is_short(value[:16]):  # while JAX traces, or on other machines
        return text(value)
    low, high = (_number(float(end(np.asarray(value)))) for end in (np.nanmin, np.nanmax))
    return f"{low} to {high} in {np.size(value)} coordinates"


def has_arrays(tree: Any) -> bool:
    """Whether all leaves are arrays, rather than None or bool as `jax.tree.map` may leave them."""
    return all(map(eqx.is_array, jax.tree.leaves(tree, is_leaf=lambda leaf: leaf is None)))


def _module(module: eqx.Module) -> str:
    """One line for a module without a `__repr__` of its own, such as a network of any depth."""
    line = describe(module)
    if _fits(line):
        return line
    arrays = [leaf for leaf in jax.tree.leaves(module) if eqx.is_array(leaf)]
    count = sum(array.size for array in arrays)
    return f"{type(module).__name__}({count} parameters in {len(arrays)} arrays)"


def _number(value: float) -> str:
    return f"{value:.4g}"
