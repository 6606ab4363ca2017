"""What a learned field is made of, as JSON, and back to a field that lacks only its numbers.

    {"class": name, field: …}            an object of the library, by its fields
    {"array": "float64", "shape": […]}   an array, without its entries
    {"function": name}                   one of the functions below
    {"code": name, "leaves": […]}        code of the caller's, which only the caller can give
    […]  0.5  "text"  true  null         a tuple, and plain values

A name is looked up among the classes that this library has loaded: nothing is imported,
evaluated or called by name.
"""

import dataclasses
import functools
from collections.abc import Mapping
from typing import Any, NamedTuple

import equinox as eqx
import jax
import numpy as np

from hamkernel._fields.base import AbstractField
from hamkernel._kernels.functions import Bound, Closure
from hamkernel._kernels.symmetry import identity, reflection, time_reversal

_ROOMS = tuple(
    f"hamkernel.{room}"
    for room in ("_kernels.", "_structures.", "_features.", "_fields.", "systems.")
)
_FUNCTIONS = {function.__name__: function for function in (identity, reflection, time_reversal)}

Node = Any


class NotGiven(ValueError):
    """What the caller gave is not what was saved, or lacks code that is in the field."""


class Given(NamedTuple):
    """What the caller gives for a part of a field: its description, if any, and the code in it."""

    node: Node
    codes: list[Any]


def _ours(cls: type) -> bool:
    """Whether a file may name the class; `Bound` and `Closure` only carry code of the caller's."""
    found = issubclass(cls, eqx.Module) and cls.__module__.startswith(_ROOMS)
    return found and cls not in (Bound, Closure)


@functools.cache
def classes() -> dict[str, type[eqx.Module]]:
    """What a file may name."""
    found: dict[str, type[eqx.Module]] = {}
    left = [eqx.Module]
    for cls in left:  # which grows
        left += cls.__subclasses__()
        if _ours(cls):
            found[cls.__name__] = cls
    return found


def description(value: Any, codes: list[Any], where: str) -> Node:
    """The JSON of `value`; code of the caller's is appended to `codes`, in order.

    Raises:
        TypeError: something in it cannot be stored; `where` is its name.
    """
    cls = type(value)
    if _ours(cls):
        fields = {field.name: getattr(value, field.name) for field in dataclasses.fields(cls)}
        nodes = {name: description(v, codes, f"{where}.{name}") for name, v in fields.items()}
        return {"class": cls.__name__, **nodes}
    if eqx.is_array(value) or isinstance(value, np.ndarray):
        if np.dtype(value.dtype).kind not in "biuf":
            raise TypeError(f"{where} has dtype {value.dtype}, which cannot be stored.")
        return {"array": str(value.dtype), "shape": list(value.shape)}
    if isinstance(value, tuple):
        return [description(v, codes, f"{where}[{i}]") for i, v in enumerate(value)]
    if value is None or cls in (bool, int, float, str):
        return value
    if any(value is function for function in _FUNCTIONS.values()):
        return {"function": value.__name__}
    if not callable(value):
        raise TypeError(f"{where} is a {cls.__name__}, which cannot be stored.")
    codes.append(value)
    leaves = [leaf for leaf in jax.tree.leaves(value) if eqx.is_array_like(leaf)]
    named = getattr(value, "func", value)
    return {
        "code": str(getattr(named, "__qualname__", cls.__qualname__)),
        "leaves": [description(leaf, [], where) for leaf in leaves],
    }


def skeleton(node: Node, codes: list[Any], where: str, given: Mapping[str, Given]) -> Any:
    """The object of a description, with shapes for arrays, and the caller's code in its places.

    Args:
        node: the description.
        codes: the code below, in order; it is used up.
        where: the name of the object.
        given: what the caller gives for the parts of a field.

    Raises:
        NotGiven: the caller has not given the same. ValueError: it is no description.
    """
    match node:
        case {"class": str(name), **nodes}:
            cls = classes().get(name)
            if cls is None:
                raise ValueError(f"{where} is of the unknown class {name[:80]!r}")
            if nodes.keys() != {field.name for field in dataclasses.fields(cls)}:
                raise ValueError(f"{where} does not have the fields of {name}")
            own = given if issubclass(cls, AbstractField) else {}
            made = object.__new__(cls)  # past __init__, which takes no logarithms
            for key, child in nodes.items():
                path, inside = f"{where}.{key}", (codes, given)
                if key in own:
                    differs = difference(child, own[key].node, path)
                    if differs:
                        raise NotGiven(differs)
                    inside = list(own[key].codes), {}
                object.__setattr__(made, key, skeleton(child, inside[0], path, inside[1]))
            return made
        case {"array": str(dtype), "shape": [*shape]}:
            return jax.ShapeDtypeStruct(tuple(shape), np.dtype(dtype))
        case {"function": str(name)} if name in _FUNCTIONS:
            return _FUNCTIONS[name]
        case {"code": str(name), "leaves": list()}:
            if not codes:
                raise NotGiven(f"{where} is {name[:80]!r}, code that is not in the file")
            return codes.pop(0)
        case list():
            below = enumerate(node)
            return tuple(skeleton(child, codes, f"{where}[{i}]", given) for i, child in below)
        case None | bool() | int() | float() | str():
            return node
    raise ValueError(f"{where} is {str(node)[:80]}, which is no part of a field")


def difference(saved: Node, given: Node, where: str) -> str | None:
    """Where two descriptions differ first, in words. What the given one leaves open may differ."""
    match saved, given:
        case {"code": _, "leaves": first}, {"code": _, "leaves": second}:  # of whatever name
            same = first == second
        case {**nodes}, {**others} if nodes.get("class") == others.get("class") is not None:
            found = (difference(nodes[key], others[key], f"{where}.{key}") for key in nodes)
            return next(filter(None, found), None)
        case [*nodes], [*others] if len(nodes) == len(others):
            pairs = enumerate(zip(nodes, others, strict=True))
            found = (difference(*pair, f"{where}[{i}]") for i, pair in pairs)
            return next(filter(None, found), None)
        case _:
            same = given is None or (type(saved) is type(given) and saved == given)
    return (
        None
        if same
        else f"{where} is {_shown(saved)} in the file and {_shown(given)} here: not the one saved"
    )


def _shown(node: Node) -> str:
    match node:
        case {"class": name} | {"function": name}:
            return str(name)
        case {"array": dtype, "shape": shape}:
            return f"an array {dtype}{shape}"
        case {"code": name, "leaves": leaves}:
            return f"{name} with the arrays [{', '.join(map(_shown, leaves))}]"
        case list():
            return f"{len(node)} terms"
    return repr(node)
