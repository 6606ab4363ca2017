"""`save` and `load`: a field or a result in one file. Reading a file runs no code from it.

A file is a line with the version of the format and the SHA-256 of the rest, a line of JSON that
describes the object, and its arrays as Equinox writes the leaves of a PyTree, one after another in
NumPy's `.npy` format. The digest reveals a cut or changed file before anything is parsed. It does
not authenticate: whoever changes a file can change its digest, so `load` checks all that it parses.

The description has these nodes:

    {"class": name, field: …}            an object of the library, by its fields
    {"array": "float64", "shape": […]}   an array, without its entries; of NumPy if "numpy": true
    {"dict": {name: …}}                  a dictionary
    {"function": name}                   one of the functions in `_MAPS`
    {"code": name, "leaves": […]}        code of the caller's, which only the caller can give
    […]  0.5  "text"  true  null         a tuple, and plain values

A name is looked up among the classes that this library has loaded: nothing is imported,
evaluated or called by name.
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
from hamkernel._observations.measurements import Measurements
from hamkernel._posterior import Posterior
from hamkernel._runs.table import Diagnostic, Diagnostics
from hamkernel._solvers.problem import Problem
from hamkernel._solvers.stream import AbstractStreamingFit
from hamkernel._structures.base import AbstractMatrixKernel
from hamkernel._trajectories.lagrangian import LearnedLagrangian
from hamkernel._trajectories.learned import Learned
from hamkernel._trajectories.model import Model
from hamkernel._trajectories.segments import LinearisedSegments
from hamkernel._tuning.tune import Tuned

_VERSION = 2  # of the format; 1 was an archive of NumPy's, before the first release
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

    Results are written whole: `learned` with its runs, noise, diagnostics and history, so that
    `hk.load(path).posterior` and `.score(runs)` work; `tuned`; and a posterior with its factor. A
    fit to which chunks are added goes on with the next one after `load`.

    The file at `path` is replaced in one step, so that no reader ever sees half of it. Code of
    your own (kernels, maps of a `Warp`, a mean) is not written, only its arrays are: see `load`.

    If the rows of the field are spread over several processes, all of them must make the call, and
    the first process writes the file before any of them goes on.

    Args:
        path: the file. The name is taken as it is.
        field: the result of `fit`, `learn`, `tune` or `condition`, or the `LandmarkFit` or
            `FeatureFit` of a solver's `start`.

    Raises:
        TypeError: `field` is none of these, or holds something that cannot be stored.
        ValueError: the call is inside `jax.jit`, where there are no numbers yet; the field is not
            finite.
        OSError: the file cannot be written; an older one at `path` is left as it was.
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
    except Exception as error:  # a kernel of the caller's may raise anything
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
    finally:  # else the others would wait for ever for one that could not write
        multihost_utils.sync_global_devices("hamkernel.save")


def load(
    path: str | os.PathLike[str],
    kernel: AbstractMatrixKernel | None = None,
    mean: Callable[..., Any] | None = None,
) -> Any:
    """Read what `save` wrote: the same arrays bit by bit, so the same values of f.

    Nothing in the file is executed. Built-in kernels restore by themselves. For a kernel of your
    own the file has the arrays but not the code: pass the kernel as `fit` or `learn` got it. Its
    hyperparameters may have any values, and those of the file are put in.

    Args:
        path: the file.
        kernel: the matrix-valued kernel, needed if a part of it is your own code.
        mean: the prior mean, needed if it is your own code; a learned field and one of
            `hk.systems` are in the file.

    Returns:
        An object of the class that was saved.

    Raises:
        ValueError: the file is no such file, cut off, changed, of another version, or in float64
            while JAX is not; or `kernel` is missing or is not the one that was saved, which a
            velocity in the file tells.
        TypeError: `kernel` is not matrix-valued. OSError: the file cannot be read.

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
        with jax.ensure_compile_time_eval():  # a constant of what JAX traces around this call
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
    except Exception as error:  # a kernel of the caller's may raise anything
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
    if isinstance(field, LagrangianField):  # which may have no acceleration
        return lambda x: jnp.concatenate([field.momentum(x), field.rest_torques(x)])
    return field


def _evaluable(saved: Any) -> AbstractField:
    """The field of a saved object, with which `_probe` makes its check.

    For a fit to chunks we take the sum of its columns, which needs no data. An error is raised if
    the parts do not fit each other, such as lengthscales and coordinates of different numbers.
    """
    is_stream = isinstance(saved, AbstractStreamingFit)  # whose columns need no data
    field = saved.sum_of_columns() if is_stream else getattr(saved, "field", saved)
    state = jax.ShapeDtypeStruct((field.dimension,), field.offset.dtype)
    if field.offset.shape or jax.eval_shape(_state_function(field), state).shape != state.shape:
        raise ValueError("its arrays have an axis more than those of one field.")
    return field


def _probe(field: AbstractField) -> list[list[float]]:
    """A state and the velocity there, by which `load` checks a kernel that the caller supplies."""
    n = field.dimension  # without points, as for features: no two particles in one place
    points = np.asarray(getattr(field, "points", np.cos(1.0 + np.arange(n))[None]))[:64]
    velocities = np.asarray(jax.vmap(_state_function(field))(jnp.asarray(points)))
    if not np.isfinite(velocities).all():
        raise ValueError(
            "the field is NaN or infinite at its own points, as one is from a fit that failed with "
            "throw=False: there is nothing to save."
        )
    fastest = np.linalg.norm(velocities, axis=1).argmax()  # at an equilibrium all kernels agree
    return [points[fastest].tolist(), velocities[fastest].tolist()]


def _check_probe(field: AbstractField, probe: Any, source: str) -> None:
    state, saved = np.asarray(probe, float)
    velocity = np.asarray(_state_function(field)(jnp.asarray(state)))
    # Computed elsewhere, fields of large coefficients round at 1e-5.
    if not np.linalg.norm(velocity - saved) <= 1e-3 * np.linalg.norm(saved):
        raise ValueError(
            f"with this kernel the field in {source} has the velocity {velocity} at the state "
            f"{state}, and it had {saved} when it was saved: a function in the kernel is not the "
            "one that was given to fit."
        )


def _is_here(leaf: Any) -> bool:
    """Whether this process has the whole array."""
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
        "_trajectories.",
        "systems.",
    )
)
# Classes of results that are no modules of Equinox.
_RECORDS = (Diagnostic, Diagnostics, LinearisedSegments, Measurements, Model, Problem)
_MAPS = {function.__name__: function for function in (identity, reflection, time_reversal)}

Node = Any
Supplied = Mapping[str, tuple[Node, list[Any]]]


class _Mismatch(ValueError):
    """The caller's kernel or mean is not the saved one, or some of its code is missing."""


def _supplied_parts(kernel: Any, mean: Any, as_fitted: bool) -> Supplied:
    """The parts of a field that the caller supplied: for each a description or None, and its code.

    `learn` adds amplitudes and masses to the caller's kernel. Then `as_fitted` is false: we take
    only the code of the caller's kernel, and the saved velocity reveals a wrong kernel.
    """
    of_kernel, of_mean = [], []
    node = None if kernel is None else description(kernel, of_kernel, "field.kernel")
    node = node if as_fitted else None
    if mean is not None:  # which may be a term of the mean of the field
        description(as_pytree(mean), of_mean, "field.mean")
    # Features hold the kernel again.
    return {"kernel": (node, of_kernel), "features": (None, of_kernel), "mean": (None, of_mean)}


def _ours(cls: type) -> bool:
    """Whether a file may name the class; `Bound` and `Closure` only carry code of the caller's."""
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
    """The JSON of `value`; code of the caller's is appended to `codes`, in order.

    Raises:
        TypeError: something in it cannot be stored; `where` is its name.
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
    """The object of a description, with shapes for arrays, and the caller's code in its places.

    Args:
        node: the description.
        codes: the code below, in order; it is used up.
        where: the name of the object.
        supplied: descriptions and code of the parts of a field that the caller has supplied.

    Raises:
        _Mismatch: the caller's kernel or mean is another. ValueError: `node` is no description.
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
            made = object.__new__(cls)  # past __init__, which takes no logarithms
            for key, part in parts.items():
                object.__setattr__(made, key, part)
            return made
        case {"array": str(dtype), "shape": [*shape], "numpy": True}:
            return np.broadcast_to(np.zeros((), dtype), shape)  # which takes no memory
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
            return codes.pop(0)
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
    """The places in a description, with what they hold; code may have any name."""
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
    """The bytes of a file: its first line, with the version and the digest, and the content."""
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
    """Write all of the file or nothing: a new one takes the place of the old one at once."""
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
