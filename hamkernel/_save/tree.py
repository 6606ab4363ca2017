"""A learned field as a tree of JSON nodes and a list of arrays, and back.

A node is an object with one of these sets of keys:

    {"module": name, "fields": {…}}     a class of `CLASSES`, by its name
    {"function": name}                  a function of `FUNCTIONS`
    {"array": i}                        the array i
    {"tuple": […]}, {"value": v}        a tuple; a number, text, true, false or null
    {"user": name, "arrays": […]}       code of the user's, which only the user can give

Names are looked up in the two tables: nothing is imported, evaluated or called by name.
"""

import dataclasses
import math
import types
import typing
from collections.abc import Callable
from typing import Any, NoReturn

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import jaxtyped

from hamkernel import systems
from hamkernel._features.waves import (
    ControlledFeatures,
    DivergenceFreeFeatures,
    GroupWaves,
    PotentialFeatures,
    SeparableFeatures,
    SumFeatures,
    Waves,
)
from hamkernel._fields.base import AbstractField, FieldSum, SolverInfo
from hamkernel._fields.controlled import ControlledField
from hamkernel._fields.features import FeatureField
from hamkernel._fields.kernel_field import KernelField
from hamkernel._fields.known import AtRest, KnownPart
from hamkernel._kernels.base import ScalarProduct, ScalarSum, Scaled, UserKernel
from hamkernel._kernels.dot_products import Periodic, Polynomial
from hamkernel._kernels.functions import as_pytree
from hamkernel._kernels.groups import identity, reflection, time_reversal
from hamkernel._kernels.radial import Gaussian, Matern, RationalQuadratic
from hamkernel._kernels.transforms import Select, Symmetrised, Warp
from hamkernel._structures.base import AbstractMatrixKernel, Sum
from hamkernel._structures.controlled import Constant, Controlled, InputMatrix, KnownMatrix
from hamkernel._structures.operators import CurlFree, DivergenceFree, Separable, Symplectic
from hamkernel._structures.own import Poisson, Structured
from hamkernel._structures.port_hamiltonian import PortHamiltonian
from hamkernel.poisson import ChargedParticleTensor, LotkaVolterraTensor, RigidBodyTensor

# Everything that a file may name. A new class of the library needs one line here.
CLASSES: dict[str, type[eqx.Module]] = {
    cls.__name__: cls
    for cls in (
        *(KernelField, FeatureField, ControlledField, FieldSum, KnownPart, AtRest, SolverInfo),
        *(
            Waves,
            GroupWaves,
            PotentialFeatures,
            DivergenceFreeFeatures,
            SeparableFeatures,
            SumFeatures,
            ControlledFeatures,
        ),
        *(systems.DoublePendulum, systems.Duffing, systems.HarmonicOscillator),
        *(systems.HenonHeiles, systems.Kepler, systems.NBody, systems.Pendulum),
        *(systems.CartPole, systems.Acrobot),
        *(systems.PointVortices, systems.SpringChain, systems.Damped, systems.Driven),
        *(systems.RigidBody, systems.LotkaVolterra, systems.ChargedParticle),
        *(Separable, CurlFree, DivergenceFree, Symplectic, Sum),
        *(PortHamiltonian, Poisson, Structured),
        *(Controlled, InputMatrix, KnownMatrix, Constant),
        *(RigidBodyTensor, LotkaVolterraTensor, ChargedParticleTensor),
        *(Gaussian, Matern, RationalQuadratic, Polynomial, Periodic),
        *(ScalarSum, ScalarProduct, Scaled, Select, Symmetrised, Warp, UserKernel),
    )
}
FUNCTIONS: dict[str, Callable] = {
    function.__name__: function for function in (identity, reflection, time_reversal)
}

# Where the mean of the user is: of a field, of one with inputs, and of its drift.
_MEANS = ("field.mean", "field.whole.mean.mean", "field.mean.field")
_DEPTH = 64  # of the tree; kernels that people write have a depth below ten
Node = dict[str, Any]


def field_classes() -> list[str]:
    """The names of the classes that may stand at the root."""
    return [name for name, cls in CLASSES.items() if issubclass(cls, AbstractField)]


def encode(value: Any, arrays: list[np.ndarray], where: str) -> Node:
    """The node of `value`; its arrays are appended to `arrays`."""
    name = type(value).__name__
    if CLASSES.get(name) is type(value):
        fields = {
            f.name: encode(getattr(value, f.name), arrays, f"{where}.{f.name}")
            for f in dataclasses.fields(value)
        }
        return {"module": name, "fields": fields}
    if isinstance(value, jax.Array | np.ndarray):
        return _stored_array(value, arrays, where)
    if isinstance(value, tuple):
        return {"tuple": [encode(v, arrays, f"{where}[{i}]") for i, v in enumerate(value)]}
    if _plain(value):
        return {"value": value}
    for known, function in FUNCTIONS.items():
        if value is function:
            return {"function": known}
    if callable(value):
        leaves = [leaf for leaf in jax.tree.leaves(value) if eqx.is_array(leaf)]
        stored = [_stored_array(leaf, arrays, where) for leaf in leaves]
        return {"user": _name(value), "arrays": stored}
    raise TypeError(f"{where} is a {name}, which cannot be stored.")


def _stored_array(array: Any, arrays: list[np.ndarray], where: str) -> Node:
    stored = np.asarray(array) if allowed(array.dtype) else None
    if stored is None:
        raise TypeError(f"{where} has dtype {array.dtype}, which cannot be stored.")
    arrays.append(stored)
    return {"array": len(arrays) - 1}


def allowed(dtype: Any) -> bool:
    """Whether arrays of this dtype are stored: booleans, integers and real numbers."""
    return isinstance(dtype, np.dtype) and dtype.kind in "biuf"


def _plain(value: Any) -> bool:
    """Whether JSON keeps the value exactly, with its type."""
    exact = value is None or type(value) in (bool, int, str)
    return exact or (type(value) is float and math.isfinite(value))


def _name(fn: Any) -> str:
    """The name of the user's code, for messages only."""
    fn = getattr(fn, "func", fn)
    return str(getattr(fn, "__qualname__", type(fn).__qualname__))


class Reader:
    """Builds objects from nodes, beside the kernel that the user gave, if there is one."""

    def __init__(self, source: str, arrays: list[np.ndarray]):
        self.source, self.arrays = source, arrays
        self.used: set[int] = set()
        self.given: dict[str, Any] = {}  # by the user, by path

    def fail(self, reason: str) -> NoReturn:
        raise ValueError(f"{self.source} is not a valid file of hamkernel.save: {reason}.")

    def field(self, node: Any, kernel: AbstractMatrixKernel | None, mean: Any) -> Any:
        if not isinstance(node, dict) or node.get("module") not in field_classes():
            self.fail("it holds no learned field")
        mean = None if mean is None else as_pytree(mean)
        self.given |= dict.fromkeys(("field.kernel", "field.whole.kernel"), kernel)
        self.given |= dict.fromkeys(_MEANS, mean)
        field = self.module(node, 0, None, "field")
        if len(self.used) != len(self.arrays):
            self.fail("it has arrays that belong to nothing")
        return field

    def beside(self, where: str, node: Any) -> Any:
        """What the user gave for this place, if it is not further inside."""
        name = node.get("module") if isinstance(node, dict) else None
        return None if name in ("KnownPart", "AtRest") else self.given.get(where)

    def value(self, node: Any, depth: int, like: Any, where: str) -> Any:
        """The object of a node; `like` is its counterpart in the user's kernel, or None."""
        if depth > _DEPTH:
            self.fail(f"its tree is deeper than {_DEPTH}")
        read = self.readers.get(frozenset(node)) if isinstance(node, dict) else None
        if read is None:
            self.fail(f"{where} is no known kind of node")
        return read(self, node, depth + 1, like, where)

    def module(self, node: Node, depth: int, like: Any, where: str) -> eqx.Module:
        name, nodes = node["module"], node["fields"]
        cls = CLASSES.get(name) if isinstance(name, str) else None
        if cls is None:
            self.fail(
                f"{where} is of the unknown class {name!r}; the known ones are "
                + ", ".join(CLASSES)
            )
        fields = {f.name: f.type for f in dataclasses.fields(cls)}
        defaults = {f.name: f.default for f in dataclasses.fields(cls)}
        if isinstance(nodes, dict):  # files of before have not the fields that came later
            older = set(fields) - set(nodes)
            later = {n for n in older if defaults[n] is None}
            nodes = nodes | {n: {"value": None} for n in later}
        if not isinstance(nodes, dict) or set(nodes) != set(fields):
            self.fail(f"{where} has not the fields of {name}")
        self.same_type(cls, like, where)
        # Past __init__, which takes lengthscales and not their stored logarithms.
        module = object.__new__(cls)
        with jaxtyped("context"):  # so that the axes of all arrays of a module must agree
            for key, annotation in fields.items():
                path = f"{where}.{key}"
                given = self.beside(path, nodes[key]) if like is None else getattr(like, key)
                value = self.value(nodes[key], depth, given, path)
                if not _fits(value, annotation):
                    self.fail(f"{where}.{key} is a {_shown(value)}, which {name} cannot have")
                object.__setattr__(module, key, value)
        return module

    def array(self, node: Node, depth: int, like: Any, where: str) -> jax.Array:
        del depth, like
        index = node["array"]
        if type(index) is not int or not 0 <= index < len(self.arrays):
            self.fail(f"{where} names an array that is not there")
        self.used.add(index)
        array = jnp.asarray(self.arrays[index])
        if array.dtype != self.arrays[index].dtype:
            raise ValueError(
                f"{self.source} was saved in {self.arrays[index].dtype} and JAX would cut it to "
                f"{array.dtype}: run jax.config.update('jax_enable_x64', True) first."
            )
        return array

    def terms(self, node: Node, depth: int, like: Any, where: str) -> tuple:
        nodes = node["tuple"]
        if not isinstance(nodes, list):
            self.fail(f"{where} is no tuple")
        self.same_type(tuple, like, where)
        if like is not None and len(like) != len(nodes):
            self.differs(where, f"{len(nodes)} terms", f"{len(like)}")
        likes = [None] * len(nodes) if like is None else like
        pairs = enumerate(zip(nodes, likes, strict=True))
        return tuple(self.value(n, depth, other, f"{where}[{i}]") for i, (n, other) in pairs)

    def plain(self, node: Node, depth: int, like: Any, where: str) -> Any:
        del depth
        value = node["value"]
        if not _plain(value):
            self.fail(f"{where} is no plain value")
        if like is not None and (type(like) is not type(value) or like != value):
            self.differs(where, repr(value), repr(like))
        return value

    def function(self, node: Node, depth: int, like: Any, where: str) -> Callable:
        del depth
        name = node["function"]
        if not isinstance(name, str) or name not in FUNCTIONS:
            self.fail(f"{where} is the unknown function {name!r}")
        if like is not None and like is not FUNCTIONS[name]:
            self.differs(where, name, _shown(like))
        return FUNCTIONS[name]

    def user(self, node: Node, depth: int, like: Any, where: str) -> Any:
        name, nodes = node["user"], node["arrays"]
        if not isinstance(name, str) or not isinstance(nodes, list):
            self.fail(f"{where} is no code of a user")
        if like is None:
            if where.startswith(("field.mean", "field.whole.mean")):
                raise ValueError(
                    f"{self.source}: {where} is {name[:80]!r}, code that is not in the file. Pass "
                    "the mean that was given to fit: hk.load(path, mean=...)."
                )
            raise ValueError(
                f"{self.source}: {where} is {name[:80]!r}, code that is not in the file. Pass the "
                "kernel that was given to fit, with any hyperparameters: "
                "hk.load(path, kernel=...)."
            )
        if not callable(like):
            self.differs(where, f"the callable {name[:80]!r}", _shown(like))
        stored = [self.value(n, depth, None, f"{where} array {i}") for i, n in enumerate(nodes)]
        leaves, structure = jax.tree.flatten(like)
        own = [i for i, leaf in enumerate(leaves) if eqx.is_array(leaf)]
        shapes = [(a.shape, str(a.dtype)) for a in stored if isinstance(a, jax.Array)]
        expected = [(leaves[i].shape, str(leaves[i].dtype)) for i in own]
        if len(shapes) != len(stored) or shapes != expected:
            self.differs(where, f"arrays {shapes}", f"{expected}")
        for i, array in zip(own, stored, strict=True):
            leaves[i] = array
        return jax.tree.unflatten(structure, leaves)

    readers: typing.ClassVar[dict[frozenset[str], Callable]] = {
        frozenset({"module", "fields"}): module,
        frozenset({"array"}): array,
        frozenset({"tuple"}): terms,
        frozenset({"value"}): plain,
        frozenset({"function"}): function,
        frozenset({"user", "arrays"}): user,
    }

    def same_type(self, cls: type, like: Any, where: str) -> None:
        if like is not None and type(like) is not cls:
            self.differs(where, cls.__name__, type(like).__name__)

    def differs(self, where: str, saved: str, given: str) -> NoReturn:
        raise ValueError(
            f"the given kernel is not the one saved in {self.source}: {where} is {saved} in the "
            f"file and {given} in the kernel. Pass the kernel as it was given to fit."
        )


def _fits(value: Any, annotation: Any) -> bool:
    """Whether a value is what the annotation of its field allows."""
    origin, args = typing.get_origin(annotation), typing.get_args(annotation)
    if annotation is Any:
        return True
    if origin is tuple:
        return isinstance(value, tuple) and all(_fits(v, args[0]) for v in value)
    if origin in (typing.Union, types.UnionType):
        return any(_fits(value, option) for option in args)
    if origin is not None:  # Callable[..., Any]
        return callable(value)
    return isinstance(value, annotation)


def _shown(value: Any) -> str:
    if isinstance(value, jax.Array):
        return f"{value.dtype} array of shape {value.shape}"
    return type(value).__name__
