"""`save` and `load`: a learned field in one file, which is read without running anything in it.

Its content is a line of JSON that says what the field is made of, see `description.py`, and then
the arrays as Equinox writes the leaves of a PyTree: one after another in NumPy's `.npy` format.
"""

from __future__ import annotations

import importlib.metadata
import inspect
import io
import json
import os
import pathlib
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.experimental import multihost_utils

from hamkernel import _require as require
from hamkernel._fields.base import AbstractField
from hamkernel._fields.controlled import ControlledField
from hamkernel._kernels.functions import as_pytree
from hamkernel._save.bytes import opened, sealed, write
from hamkernel._save.description import MissingCode, classes, description, difference, skeleton
from hamkernel._structures.base import AbstractMatrixKernel

_PROBES = 64  # points of the field, of which the one of the largest velocity is kept
_SAME = 1e-3  # of a velocity computed elsewhere: fields of large coefficients round at 1e-5


def save(path: str | os.PathLike[str], field: AbstractField) -> None:
    """Write a learned field to one file: kernel, hyperparameters, data, coefficients, version.

    The file at `path` is replaced in one step, so that no reader ever sees half of it. Code of
    your own (kernels, maps of a `Warp`, a mean) is not written, only its arrays are: see `load`.

    If the rows of the field are spread over several processes, all of them must make the call;
    each writes the whole field, to a path of its own or to one that they share.

    Args:
        path: the file. The name is taken as it is.
        field: what `fit` returned, or `tune(...).field`.

    Raises:
        TypeError: `field` is no field of this library, or holds something that cannot be stored.
        ValueError: the call is inside `jax.jit`, where there are no numbers yet; the field is not
            finite.
        OSError: the file cannot be written; an older one at `path` is left as it was.
    """
    if not isinstance(field, AbstractField):
        names = [name for name, cls in classes().items() if _is_field(cls)]
        raise TypeError(
            f"save writes learned fields ({', '.join(names)}), got {type(field).__name__}. For "
            "the result of tune pass tuned.field."
        )
    if not require.is_concrete(field):
        raise ValueError("save writes numbers and cannot run under jax.jit, grad or vmap.")
    field = jax.tree.map(_whole, field)
    described = description(field, [], "field")
    try:
        _check_evaluable(field)
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
        "probe": _probe(field),
        "field": described,
    }
    content = io.BytesIO()
    content.write(json.dumps(header, ensure_ascii=False, allow_nan=False).encode() + b"\n")
    eqx.tree_serialise_leaves(content, field)
    write(pathlib.Path(path), sealed(content.getvalue()))


def load(
    path: str | os.PathLike[str],
    kernel: AbstractMatrixKernel | None = None,
    mean: Callable[..., Any] | None = None,
) -> AbstractField:
    """Read a field that `save` wrote: the same arrays bit by bit, so the same values of f.

    Nothing in the file is executed. Built-in kernels restore by themselves. For a kernel of your
    own the file has the arrays but not the code: pass the kernel as it was given to `fit`, with
    any values of its hyperparameters, and those of the file are put in.

    Args:
        path: the file.
        kernel: the matrix-valued kernel, needed if a part of it is your own code.
        mean: the prior mean, needed if it is your own code; a learned field and one of
            `hk.systems` are in the file.

    Returns:
        The field, of the class that was saved.

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
    content = io.BytesIO(opened(pathlib.Path(path).read_bytes(), source))
    try:
        header = json.loads(content.readline())
        node, probe, needs_x64 = header["field"], header["probe"], header["x64"]
        if not _is_field(classes().get(node["class"])):
            raise ValueError("it holds no learned field")
    except (ValueError, LookupError, TypeError, RecursionError) as error:
        raise ValueError(f"{source} is not a valid file of hamkernel.save: {error}.") from error
    if needs_x64 and jnp.result_type(float) != jnp.float64:
        raise ValueError(
            f"{source} has numbers of 64 bits, which JAX would cut to 32: run "
            "jax.config.update('jax_enable_x64', True) first."
        )
    field = _read(node, content, source, kernel, None if mean is None else as_pytree(mean))
    if kernel is not None or mean is not None:
        _check_probe(field, probe, source)
    return field


def _read(node: Any, content: io.BytesIO, source: str, kernel: Any, mean: Any) -> Any:
    """The field of a description, with the code that the caller gives and the arrays of the file.

    Raises:
        ValueError: code is missing or is not what was saved, or the parts do not fit each other.
    """
    codes: dict[str, list[Any]] = {"kernel": [], "mean": []}
    for name, given in {"kernel": kernel, "mean": mean}.items():
        if given is not None:
            own = description(given, codes[name], f"field.{name}")
            differs = difference(_given(node, name), own, f"field.{name}")
            if differs:
                raise ValueError(
                    f"the given {name} is not the one saved in {source}: {differs}. Pass the "
                    f"{name} as it was given to fit."
                )
    try:
        # Features have the kernel again.
        like = skeleton(node, [], "field", codes | {"features": codes["kernel"]})
        field = eqx.tree_deserialise_leaves(content, like)
        if content.read():
            raise ValueError("it has arrays that belong to nothing")
        _check_evaluable(field)
    except MissingCode as error:
        name = "mean" if ".mean" in str(error) else "kernel"
        raise ValueError(
            f"{source}: {error}. Pass the {name} that was given to fit, with any "
            f"hyperparameters: hk.load(path, {name}=...)."
        ) from error
    except Exception as error:  # a kernel of the caller's may raise anything
        raise ValueError(
            f"{source} is not a valid file of hamkernel.save"
            + (" for this kernel" if kernel is not None else "")
            + f": {error}"
        ) from error
    return field


def _given(node: dict[str, Any], name: str) -> Any:
    """What the caller gave as the kernel or the mean of a field, in the description of the field.

    A field with inputs has the `whole` one inside, and its mean is wrapped.
    """
    match node.get("whole", node).get(name):
        case {"class": "KnownPart", "mean": inner} | {"class": "AtRest", "field": inner}:
            return inner
        case part:
            return part


def _is_field(cls: Any) -> bool:
    return isinstance(cls, type) and issubclass(cls, AbstractField) and not inspect.isabstract(cls)


def _of_state(field: AbstractField) -> Callable[[Array], Array]:
    """The field as a function of the state alone: where it has inputs, they are 1."""
    if isinstance(field, ControlledField):
        u = jnp.ones(field.kernel.input_count, field.offset.dtype)
        return lambda x: field(x, u)
    return field


def _check_evaluable(field: AbstractField) -> None:
    """Raise unless the parts fit each other: as many lengthscales as coordinates, and the like."""
    state = jax.ShapeDtypeStruct((field.dimension,), field.offset.dtype)
    if field.offset.shape or jax.eval_shape(_of_state(field), state).shape != state.shape:
        raise ValueError("its arrays have an axis more than those of one field.")


def _probe(field: AbstractField) -> list[list[float]]:
    """A state and the velocity there, by which a kernel of the caller's code is known again."""
    points = np.asarray(getattr(field, "points", np.zeros((1, field.dimension))))[:_PROBES]
    velocities = np.asarray(jax.vmap(_of_state(field))(jnp.asarray(points)))
    if not np.isfinite(velocities).all():
        raise ValueError(
            "the field is NaN or infinite at its own points, as one is from a fit that failed with "
            "throw=False: there is nothing to save."
        )
    fastest = np.linalg.norm(velocities, axis=1).argmax()  # at an equilibrium all kernels agree
    return [points[fastest].tolist(), velocities[fastest].tolist()]


def _check_probe(field: AbstractField, probe: Any, source: str) -> None:
    state, saved = np.asarray(probe, float)
    velocity = np.asarray(_of_state(field)(jnp.asarray(state)))
    if not np.linalg.norm(velocity - saved) <= _SAME * np.linalg.norm(saved):
        raise ValueError(
            f"with this kernel the field in {source} has the velocity {velocity} at the state "
            f"{state}, and it had {saved} when it was saved: a function in the kernel is not the "
            "one that was given to fit."
        )


def _whole(leaf):
    """An array of this process for one whose rows are spread over several."""
    if not isinstance(leaf, jax.Array) or leaf.is_fully_addressable or leaf.is_fully_replicated:
        return leaf
    return multihost_utils.process_allgather(leaf, tiled=True)


def _library_version() -> str:
    try:
        return importlib.metadata.version("hamkernel")
    except importlib.metadata.PackageNotFoundError:  # run from a folder, not installed
        return "unknown"
