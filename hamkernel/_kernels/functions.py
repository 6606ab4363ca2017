"""Functions as PyTrees whose leaves are the arrays that the functions contain."""

import functools
import types
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array

from hamkernel import _require as require
from hamkernel._show import call, text


def as_pytree(fn: Callable[..., Any]) -> Callable[..., Any]:
    """`fn` as a PyTree of which no leaf is a function; `jax.jit` and `jax.grad` refuse these."""
    if not jax.tree_util.all_leaves([fn]):
        return jax.tree.map(_no_leaf, fn)
    if isinstance(fn, functools.partial):
        return Bound(fn)
    if isinstance(fn, types.FunctionType) and _holds_traced(fn):
        return Closure(fn)
    return jax.tree_util.Partial(fn)


def _no_leaf(leaf: Any) -> Any:
    """The leaf; a function, such as an activation, becomes a PyTree without leaves."""
    is_function = callable(leaf) and not eqx.is_array_like(leaf)
    return jax.tree_util.Partial(leaf) if is_function else leaf


class Bound(eqx.Module):
    """A `functools.partial` whose arrays are leaves; its other arguments are static."""

    func: Callable[..., Any]
    arrays: tuple[Array | None, ...]
    static: tuple[Any, ...] = eqx.field(static=True)
    structure: Any = eqx.field(static=True)

    def __init__(self, partial: "functools.partial[Any]"):
        leaves, self.structure = jax.tree.flatten((partial.args, partial.keywords))
        is_array = [eqx.is_array(leaf) for leaf in leaves]
        pairs = list(zip(leaves, is_array, strict=True))
        self.func = as_pytree(partial.func)
        self.arrays = tuple(jnp.asarray(leaf) if array else None for leaf, array in pairs)
        self.static = tuple(None if array else leaf for leaf, array in pairs)

    def __call__(self, *points: Array) -> Any:
        args, keywords = self._bound()
        return self.func(*args, *points, **keywords)

    def __repr__(self) -> str:
        args, keywords = self._bound()
        named = [f"{name}={text(value)}" for name, value in keywords.items()]
        return call("partial", [text(self.func), *map(text, args), *named])

    @property
    def floats(self) -> dict[str, float]:
        """The Python floats among the bound arguments, by keyword or position."""
        args, keywords = self._bound()
        bound = {f"argument {i}": value for i, value in enumerate(args)} | keywords
        return {name: value for name, value in bound.items() if isinstance(value, float)}

    def _bound(self) -> tuple[tuple[Any, ...], dict[str, Any]]:
        pairs = zip(self.arrays, self.static, strict=True)
        leaves = [static if array is None else array for array, static in pairs]
        return jax.tree.unflatten(self.structure, leaves)


class Closure(eqx.Module):
    """A function whose leaves are the traced values in its closure.

    A custom derivative rule differentiates with respect to its arguments only, so each traced value
    must be a leaf of an argument.
    """

    func: Any = eqx.field(static=True)  # with empty cells in place of `traced`
    traced: dict[int, Any]

    def __init__(self, fn: types.FunctionType):
        cells = list(fn.__closure__ or ())
        values = {i: _content(cell) for i, cell in enumerate(cells)}
        self.traced = {
            i: as_pytree(value) if callable(value) else value
            for i, value in values.items()
            if _holds_traced(value)
        }
        kept = [types.CellType() if i in self.traced else cell for i, cell in enumerate(cells)]
        self.func = _with_cells(fn, kept)

    def __call__(self, *points: Array) -> Any:
        cells: list[types.CellType] = list(self.func.__closure__ or ())
        for i, value in self.traced.items():
            cells[i] = types.CellType(value)
        return _with_cells(self.func, cells)(*points)

    def __repr__(self) -> str:
        return text(self.func)


def _holds_traced(value: Any, outer: tuple[Any, ...] = ()) -> bool:
    """Whether a PyTree has traced leaves, or a function closes over such a PyTree or function.

    False for a function that closes over itself, since we cannot copy its cells.
    """
    if isinstance(value, functools.partial):
        return any(
            _holds_traced(v, outer) for v in (value.func, *value.args, *value.keywords.values())
        )
    if not isinstance(value, types.FunctionType):
        return not require.is_concrete(value)
    inner = (*outer, value)
    contents = [_content(cell) for cell in value.__closure__ or ()]
    if any(content is enclosing for content in contents for enclosing in inner):
        return False
    return any(_holds_traced(content, inner) for content in contents)


def _content(cell: types.CellType) -> Any:
    try:
        return cell.cell_contents
    except ValueError:  # an empty cell
        return None


def _with_cells(fn: types.FunctionType, cells: list[types.CellType]) -> types.FunctionType:
    new = types.FunctionType(
        fn.__code__, fn.__globals__, fn.__name__, fn.__defaults__, tuple(cells)
    )
    new.__kwdefaults__ = fn.__kwdefaults__
    return new
