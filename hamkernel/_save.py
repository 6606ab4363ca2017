"""`save` and `load`: a field or a result in one file. `load` runs no code from the file.

A file has three parts. The first line has the version of the format and the SHA-256 of the rest.
The second line describes the object in JSON. Then follow the arrays of the object, as Equinox
writes the leaves of a PyTree in NumPy's `.npy` format. The digest reveals a cut or changed file
before `load` parses it. It does not authenticate: whoever changes a file can change its digest, so
`load` checks all that it parses.

The description has these nodes:

    {"class": name, field: …}            an object of the library, by its fields
    {"array": "float64", "shape": […]}   an array, without its entries; of NumPy if "numpy": true
    {"dict": {name: …}}                  a dictionary
    {"function": name}                   one of the functions in `_MAPS`
    {"code": name, "leaves": […]}        code of the caller, which the caller must pass to `load`
    […]  0.5  "text"  true  null         a tuple, and plain values

`load` looks names up among the classes that this library has loaded. It imports, evaluates and
calls nothing by name.
"""

from __future__ import annotations

import dataclasses
import functools
import hashlib
import importlib.metadata
import inspect
import io
import json
import os
import pathlib
import re
import uuid
from collections.abc import Callable, Iterator, Mapping
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.experimental import multihost_utils

from hamkernel import _require as require
from hamkernel._fields.base import AbstractField
from hamkernel._fields.joined import AbstractJoinedField
from hamkernel._fields.lagrangian import LagrangianField
from hamkernel._kernels.functions import Bound, Closure, as_pytree
from hamkernel._kernels.symmetry import identity, reflection, time_reversal
from hamkernel._learned.result import Learned
from hamkernel._observations.measurements import Measurements
from hamkernel._posterior import Posterior
from hamkernel._runs.table import Diagnostic, Diagnostics
from hamkernel._solvers.problem import Problem
from hamkernel._solvers.stream import AbstractStreamingFit
from hamkernel._structures.base import AbstractMatrixKernel
from hamkernel._trajectories.model import Model
from hamkernel._trajectories.segments import LinearisedSegments
from hamkernel._tuning.tune import Tuned
from hamkernel._weak.lagrangian import LearnedLagrangian

_VERSION = 2  # of the format; version 1, before the first release, was a NumPy archive
_FIRST_LINE = "hamkernel field, version {}, sha256 {}"


def save(
    path: str | os.PathLike[str],
    field: AbstractField
    | AbstractStreamingFit
    | LagrangianField
    | Learned
    | LearnedLagrangian
    | Tuned
    | Posterior,
) -> None:
    """Write a learned field to one file: kernel, hyperparameters, data, coefficients, version.

    `save` writes results completely: `learned` with its runs, noise, diagnostics and history, so
    that `hk.load(path).posterior` and `.score(runs)` work; `tuned`; and a posterior with its
    factor. You can add further chunks to a streaming fit after `load`.

    `save` replaces the file at `path` in one step, so that no reader ever sees half of it. Of your
    own code (kernels, maps of a `Warp`, a mean) it writes only the arrays: see `load`.

    If the rows of the field are sharded over several processes, all of them must call `save`. The
    first process writes the file before any of them continues.

    Args:
        path: the file. `save` adds no suffix.
        field: the result of `fit`, `learn`, `tune` or `condition`, or the `LandmarkFit` or
            `FeatureFit` of a solver's `start`.

    Raises:
        TypeError: `field` is none of these, or contains an object that cannot be stored.
        ValueError: the call is inside `jax.jit`, `grad` or `vmap`, where there are no numbers yet;
            `field` is a batch of fields, or not finite.
        OSError: the file cannot be written; an older file at `path` is unchanged.
    """
    if isinstance(field, str | os.PathLike):
        raise TypeError("save takes the path first, hk.save(path, field).")
    if not _is_saved(type(field)):
        names = sorted(name for name, cls in _classes().items() if _is_saved(cls))
        raise TypeError(
            "save writes what fit, learn, tune, condition and start return "
            f"({', '.join(names)}); got {type(field).__name__}."
        )
    if not require.is_concrete(field):
        raise ValueError(
            "save writes numbers, and there are none yet under jax.jit, grad or vmap: return the "
            "field from there, and save it outside."
        )
    spread = not all(map(_is_here, jax.tree.leaves(field)))
    gather = multihost_utils.process_allgather  # all rows on every process
    field = jax.tree.map(lambda x: x if _is_here(x) else gather(x, tiled=True), field)
    described = description(field, [], "field")
    try:
        evaluable = _evaluable(field)
    except Exception as error:  # a kernel of the caller may raise any error
        raise ValueError(
            "save writes one field that can be evaluated, and this one cannot (of a batch made by "
            f"jax.vmap save each field): {error}"
        ) from error
    header = {
        "hamkernel": _library_version(),
        "x64": any(
            leaf.dtype.itemsize == 8 for leaf in jax.tree.leaves(field) if eqx.is_array(leaf)
        ),
        "probe": _probe(evaluable),
        "field": described,
    }
    content = io.BytesIO()
    content.write(json.dumps(header, ensure_ascii=False, allow_nan=False).encode() + b"\n")
    eqx.tree_serialise_leaves(content, field)
    if not spread:
        _write_at_once(pathlib.Path(path), seal(content.getvalue()))
        return
    try:
        if jax.process_index() == 0:
            _write_at_once(pathlib.Path(path), seal(content.getvalue()))
    finally:  # else the other processes would wait for ever after an error
        multihost_utils.sync_global_devices("hamkernel.save")


def load(
    path: str | os.PathLike[str],
    kernel: AbstractMatrixKernel | None = None,
    mean: Callable[..., Any] | None = None,
) -> Any:
    """Read a file of `save`: the arrays are equal bit by bit, so f has the same values.

    `load` executes nothing in the file. It restores built-in kernels. For a kernel of your own the
    file has the arrays but not the code: pass the kernel that you passed to `fit` or `learn`, with
    any hyperparameters. `load` takes the hyperparameters from the file.

    Args:
        path: the file.
        kernel: the matrix-valued kernel, needed if a part of it is your own code.
        mean: the prior mean, needed if it is your own code. The file contains a mean that is a
            learned field or a system of `hk.systems`.

    Returns:
        An object of the class that was saved.

    Raises:
        ValueError: `save` did not write the file, or it is cut off, changed, of another version, or
            in float64 while JAX is not. Or `kernel` is missing, or is not the saved kernel: a
            velocity in the file differs.
        TypeError: `kernel` is not matrix-valued.
        OSError: the file cannot be read.

    Example: `field = hk.load("pendulum", kernel=hk.Symplectic(hk.Warp(hk.Gaussian(), fn)))`
    """
    if kernel is not None and not isinstance(kernel, AbstractMatrixKernel):
        raise TypeError(
            f"kernel must be the matrix-valued kernel that was given to fit; got {kernel!r}."
        )
    source = str(path)
    content = io.BytesIO(_open(pathlib.Path(path).read_bytes(), source))
    try:
        header = json.loads(content.readline())
        node, probe, needs_x64 = header["field"], header["probe"], header["x64"]
        if not _is_saved(_classes().get(node["class"])):
            raise ValueError("it holds no learned field")
    except (ValueError, LookupError, TypeError, RecursionError) as error:
        raise ValueError(f"{source} is not a valid file of hamkernel.save: {error}.") from error
    if needs_x64 and jnp.result_type(float) != jnp.float64:
        raise ValueError(
            f"{source} has numbers of 64 bits, which JAX would cut to 32: run "
            "jax.config.update('jax_enable_x64', True) first."
        )
    is_supplied = kernel is not None or mean is not None
    try:
        results = Learned.__name__, LearnedLagrangian.__name__
        as_fitted = node["class"] not in results  # learn adds amplitudes and masses
        like = skeleton(node, [], "field", _supplied_parts(kernel, mean, as_fitted))
        with jax.ensure_compile_time_eval():  # arrays, also if JAX traces the caller
            field = eqx.tree_deserialise_leaves(content, like)
        if content.read():
            raise ValueError("it has arrays that belong to nothing")
        evaluable = _evaluable(field)
    except _Mismatch as error:
        name = "mean" if ".mean" in str(error) else "kernel"
        raise ValueError(
            f"{source}: {error}. Pass the {name} that was given to fit, with any "
            f"hyperparameters: hk.load(path, {name}=...)."
        ) from error
    except Exception as error:  # a kernel of the caller may raise any error
        with_supplied = " with what was given" if is_supplied else ""
        raise ValueError(
            f"{source} is not a valid file of hamkernel.save{with_supplied}: {error}"
        ) from error
    if is_supplied:
        with jax.ensure_compile_time_eval():
            _check_probe(evaluable, probe, source)
    return field


def _is_saved(cls: Any) -> bool:
    results = Learned, LearnedLagrangian, Tuned, Posterior
    kinds = AbstractField, AbstractStreamingFit, LagrangianField, *results
    return isinstance(cls, type) and issubclass(cls, kinds) and not inspect.isabstract(cls)


def _state_function(field: Any) -> Callable[[Array], Array]:
    """The field as a function of the state alone; inputs and parameters are set to 1."""
    if isinstance(field, AbstractJoinedField):
        u = jnp.ones(field.kernel.input_count, field.offset.dtype)
        return lambda x: field(x, u)
    if isinstance(field, LagrangianField):  # M may be singular, so we take no acceleration
        return lambda x: jnp.concatenate([field.momentum(x), field.rest_torques(x)])
    return field


def _evaluable(saved: Any) -> AbstractField:
    """The field of a saved object, which `_probe` evaluates.

    For a streaming fit we take the sum of its columns, which needs no data. If the parts do not
    fit each other, such as the numbers of lengthscales and coordinates, an error comes.
    """
    is_stream = isinstance(saved, AbstractStreamingFit)
    field = saved.sum_of_columns() if is_stream else getattr(saved, "field", saved)
    state = jax.ShapeDtypeStruct((field.dimension,), field.offset.dtype)
    if field.offset.shape or jax.eval_shape(_state_function(field), state).shape != state.shape:
        raise ValueError("its arrays have one axis more than the arrays of one field.")
    return field


def _probe(field: AbstractField) -> list[list[float]]:
    """A state and its velocity, with which `load` checks a kernel that the caller supplies."""
    # Features have no points. We then take a state in which no two particles coincide.
    n = field.dimension
    points = np.asarray(getattr(field, "points", np.cos(1.0 + np.arange(n))[None]))[:64]
    velocities = np.asarray(jax.vmap(_state_function(field))(jnp.asarray(points)))
    if not np.isfinite(velocities).all():
        raise ValueError(
            "the field is NaN or infinite at its own points, as after a fit with throw=False that "
            "failed: there is nothing to save."
        )
    fastest = np.linalg.norm(velocities, axis=1).argmax()  # at an equilibrium all kernels agree
    return [points[fastest].tolist(), velocities[fastest].tolist()]


def _check_probe(field: AbstractField, probe: Any, source: str) -> None:
    state, saved = np.asarray(probe, float)
    velocity = np.asarray(_state_function(field)(jnp.asarray(state)))
    # On another machine fields with large coefficients differ by 1e-5.
    if not np.linalg.norm(velocity - saved) <= 1e-3 * np.linalg.norm(saved):
        raise ValueError(
            f"with this kernel the field in {source} has the velocity {velocity} at the state "
            f"{state}, and it had {saved} when it was saved: a function in the kernel is not the "
            "one that was given to fit."
        )


def _is_here(leaf: Any) -> bool:
    """Whether this process has the complete array."""
    is_array = isinstance(leaf, jax.Array)
    return not is_array or leaf.is_fully_addressable or leaf.is_fully_replicated


def _library_version() -> str:
    try:
        return importlib.metadata.version("hamkernel")
    except importlib.metadata.PackageNotFoundError:  # run from a folder, not installed
        return "unknown"


# The description.

_ROOMS = tuple(
    f"hamkernel.{room}"
    for room in (
        "_kernels.",
        "_structures.",
        "_observations.",
        "_features",
        "_fields.",
        "_solvers.",
        "_posterior",
        "_tuning.tune",
        "_runs.",
        "_learned.",
        "_trajectories.",
        "_weak.",
        "_learn",
        "systems.",
    )
)
# Classes of results that are no modules of Equinox.
_RECORDS = (Diagnostic, Diagnostics, LinearisedSegments, Measurements, Model, Problem)
_MAPS = {function.__name__: function for function in (identity, reflection, time_reversal)}

Node = Any
Supplied = Mapping[str, tuple[Node, list[Any]]]


class _Mismatch(ValueError):
    """An error: the caller's kernel or mean is not the saved one, or code is missing."""


def _supplied_parts(kernel: Any, mean: Any, as_fitted: bool) -> Supplied:
    """The supplied parts of a field: for each name a description or None, and the code.

    `learn` adds amplitudes and masses to the caller's kernel. In this case `as_fitted` is false: we
    take only the code of the caller's kernel, and the saved velocity reveals a wrong kernel.
    """
    of_kernel, of_mean = [], []
    node = None if kernel is None else description(kernel, of_kernel, "field.kernel")
    node = node if as_fitted else None
    if mean is not None:  # the code only: it may be one term of the mean of the field
        description(as_pytree(mean), of_mean, "field.mean")
    # Features contain the kernel a second time.
    return {"kernel": (node, of_kernel), "features": (None, of_kernel), "mean": (None, of_mean)}


def _ours(cls: type) -> bool:
    """Whether a file may name the class. `Bound` and `Closure` hold code of the caller."""
    is_module = issubclass(cls, eqx.Module) and cls.__module__.startswith(_ROOMS)
    return cls in _RECORDS or (is_module and cls not in (Bound, Closure))


def _fields(cls: type) -> list[str]:
    """The names of the fields of a dataclass or of a named tuple."""
    return list(getattr(cls, "_fields", ())) or [field.name for field in dataclasses.fields(cls)]


@functools.cache
def _classes() -> dict[str, type]:
    """The classes that a file may name, by name."""
    classes: dict[str, type] = {cls.__name__: cls for cls in _RECORDS}
    queue = [eqx.Module]
    for cls in queue:  # the queue grows by all subclasses
        queue += cls.__subclasses__()
        if _ours(cls):
            classes[cls.__name__] = cls
    return classes


def description(value: Any, codes: list[Any], where: str) -> Node:
    """The JSON of `value`. We append code of the caller to `codes`, in order.

    Raises:
        TypeError: a part of `value` cannot be stored. The message begins with its name `where`.
    """
    cls = type(value)
    if _ours(cls):
        parts = {name: getattr(value, name) for name in _fields(cls)}
        nodes = {name: description(v, codes, f"{where}.{name}") for name, v in parts.items()}
        return {"class": cls.__name__, **nodes}
    if isinstance(value, np.generic):
        value, cls = value.item(), type(value.item())
    if eqx.is_array(value) or isinstance(value, np.ndarray):
        if np.dtype(value.dtype).kind not in "biuf":
            raise TypeError(f"{where} has dtype {value.dtype}, which cannot be stored.")
        node = {"array": str(value.dtype), "shape": list(value.shape)}
        return node | {"numpy": True} if isinstance(value, np.ndarray) else node
    if isinstance(value, tuple | list):
        return [description(v, codes, f"{where}[{i}]") for i, v in enumerate(value)]
    if cls is dict and all(type(key) is str for key in value):
        return {"dict": {k: description(v, codes, f"{where}[{k!r}]") for k, v in value.items()}}
    if value is None or cls in (bool, int, float, str):
        return value
    if any(value is function for function in _MAPS.values()):
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


def skeleton(node: Node, codes: list[Any], where: str, supplied: Supplied) -> Any:
    """The object of a description, with shapes in place of arrays, and with the caller's code.

    Args:
        node: the description.
        codes: the code in this object, in order; we remove the code that we use.
        where: the name of the object.
        supplied: descriptions and code of the parts that the caller has supplied.

    Raises:
        _Mismatch: the caller's kernel or mean differs from the saved one.
        ValueError: `node` is no description.
    """
    match node:
        case {"class": str(name), **nodes}:
            cls = _classes().get(name)
            if cls is None:
                raise ValueError(f"{where} is of the unknown class {name[:80]!r}")
            if nodes.keys() != set(_fields(cls)):
                raise ValueError(f"{where} does not have the fields of {name}")
            parts = {}
            for key, child in nodes.items():
                path, inside = f"{where}.{key}", (codes, supplied)
                if key in supplied:
                    differs = _difference(child, supplied[key][0], path)
                    if differs:
                        raise _Mismatch(differs)
                    inside = list(supplied[key][1]), {}
                parts[key] = skeleton(child, inside[0], path, inside[1])
            if issubclass(cls, tuple):
                return cls(**parts)
            made = object.__new__(cls)  # without __init__, since the fields are logarithms
            for key, part in parts.items():
                object.__setattr__(made, key, part)
            return made
        case {"array": str(dtype), "shape": [*shape], "numpy": True}:
            return np.broadcast_to(np.zeros((), dtype), shape)  # takes no memory
        case {"array": str(dtype), "shape": [*shape]}:
            return jax.ShapeDtypeStruct(tuple(shape), np.dtype(dtype))
        case {"dict": dict(items)}:
            below = items.items()
            return {k: skeleton(child, codes, f"{where}[{k!r}]", supplied) for k, child in below}
        case {"function": str(name)} if name in _MAPS:
            return _MAPS[name]
        case {"code": str(name), "leaves": list()}:
            if not codes:
                raise _Mismatch(f"{where} is {name[:80]!r}, code that is not in the file")
            code = codes.pop(0)
            differs = _difference(node, description(code, [], where), where)
            if differs:
                raise _Mismatch(differs)
            return code
        case list():
            below = enumerate(node)
            return tuple(skeleton(child, codes, f"{where}[{i}]", supplied) for i, child in below)
        case None | bool() | int() | float() | str():
            return node
    raise ValueError(f"{where} is {str(node)[:80]}, which is no part of a field")


def _difference(saved: Node, supplied: Node, where: str) -> str | None:
    """The first difference of two descriptions, in words; parts that are None may differ."""
    supplied_entries = dict(_entries(supplied, where))
    for place, entry in _entries(saved, where):
        here = supplied_entries.get(place, "null")
        if here not in (entry, "null"):
            return f"{place} is {entry} in the file and {here} here: not the one saved"
    return None


def _entries(node: Node, where: str) -> Iterator[tuple[str, str]]:
    """The places in a description with their contents; the name of code does not count."""
    match node:
        case {"class": str(name), **nodes}:
            yield where, name
            for key, child in nodes.items():
                yield from _entries(child, f"{where}.{key}")
        case list():
            yield where, f"{len(node)} terms"
            for i, child in enumerate(node):
                yield from _entries(child, f"{where}[{i}]")
        case {"code": _, "leaves": content} | {"function": content}:
            yield where, json.dumps(content)
        case {"array": dtype, "shape": shape}:  # of NumPy or of JAX
            yield where, f"an array {dtype} of shape {shape}"
        case _:
            yield where, json.dumps(node)


# The file.


def seal(content: bytes) -> bytes:
    """The bytes of a file: the first line with version and digest, then the content."""
    digest = hashlib.sha256(content).hexdigest()
    return _FIRST_LINE.format(_VERSION, digest).encode() + b"\n" + content


def _open(content: bytes, source: str) -> bytes:
    """The content of a file that `save` wrote.

    Raises:
        ValueError: `save` did not write the file, it was cut or changed, or it has another version.
    """
    first, _, rest = content.partition(b"\n")
    match = re.fullmatch(_FIRST_LINE.format("([0-9]+)", "([0-9a-f]{64})").encode(), first)
    if match is None:
        old = " It may be of a version before 0.1.0: fit again." * content.startswith(b"PK")
        raise ValueError(f"{source} was not written by hamkernel.save, or is cut off.{old}")
    if int(match[1]) != _VERSION:
        raise ValueError(
            f"{source} has version {int(match[1])} of the format and this library reads version "
            f"{_VERSION}: load it with the hamkernel that wrote it."
        )
    if hashlib.sha256(rest).hexdigest().encode() != match[2]:
        raise ValueError(
            f"{source} is cut off or was changed after hamkernel.save wrote it: its checksum does "
            "not fit. Take another copy, or save again."
        )
    return rest


def _write_at_once(path: pathlib.Path, content: bytes) -> None:
    """Write a new file and replace the old one in one step, so that no file is half written."""
    if path.is_dir():
        raise IsADirectoryError(f"{path} is a folder; save needs the name of a file.")
    if not path.parent.is_dir():
        raise FileNotFoundError(f"there is no folder {path.parent} to write {path.name} to.")
    temporary = path.with_name(f".{path.name}.{uuid.uuid4().hex}.tmp")
    try:
        with temporary.open("xb") as file:
            file.write(content)
            file.flush()
            os.fsync(file.fileno())  # else a crash could leave the new name on an empty file
        temporary.replace(path)
    finally:
        temporary.unlink(missing_ok=True)
