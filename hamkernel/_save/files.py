"""`save` and `load`: a learned field in one file, which is read without running anything in it."""

from __future__ import annotations

import importlib.metadata
import os
import pathlib
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.experimental import multihost_utils

from hamkernel import _require as require
from hamkernel._fields.base import AbstractField
from hamkernel._fields.controlled import ControlledField
from hamkernel._save.bytes import FORMAT, VERSION, packed, unpacked, write
from hamkernel._save.tree import CLASSES, Reader, encode, field_classes
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
        path: the file. The name is taken as it is; `.npz` fits, since NumPy can open the file.
        field: what `fit` returned, or `tune(...).field`.

    Raises:
        TypeError: `field` is no field of this library, or holds something that cannot be stored.
        ValueError: the call is inside `jax.jit`, where there are no numbers yet; the field is not
            finite.
        OSError: the file cannot be written; an older one at `path` is left as it was.
    """
    if not isinstance(field, AbstractField) or type(field).__name__ not in CLASSES:
        raise TypeError(
            f"save writes learned fields ({', '.join(field_classes())}), got "
            f"{type(field).__name__}. For the result of tune pass tuned.field."
        )
    if not require.is_concrete(field):
        raise ValueError("save writes numbers and cannot run under jax.jit, grad or vmap.")
    field = jax.tree.map(_whole, field)
    try:
        _evaluable(field)
    except Exception as error:  # a kernel of the user may raise anything
        raise ValueError(
            "save writes one field that can be evaluated, and this one cannot (of a batch made by "
            f"jax.vmap save each field): {error}"
        ) from error
    arrays: list[np.ndarray] = []
    header = {
        "format": FORMAT,
        "version": VERSION,
        "hamkernel": _library_version(),
        "probe": _probe(field),
        "field": encode(field, arrays, "field"),
    }
    write(pathlib.Path(path), packed(header, arrays))


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
        ValueError: the file is no such file, cut off, changed, of a newer version, or in float64
            while JAX is not; or `kernel` is missing or is not the one that was saved, which a
            velocity in the file tells.
        TypeError: `kernel` is not matrix-valued. OSError: the file cannot be read.

    Example: `field = hk.load("pendulum.npz", kernel=hk.Symplectic(hk.Warp(hk.Gaussian(), fn)))`
    """
    if kernel is not None and not isinstance(kernel, AbstractMatrixKernel):
        raise TypeError(
            f"kernel must be the matrix-valued kernel that was given to fit; got {kernel!r}."
        )
    source = str(path)
    header, arrays = unpacked(pathlib.Path(path).read_bytes(), source)
    reader = Reader(source, arrays)
    field = reader.field(header["field"], kernel, mean)
    try:
        _evaluable(field)
    except Exception as error:  # a kernel of the user may raise anything
        raise ValueError(
            f"{source} holds a field that cannot be evaluated"
            + (" with this kernel" if kernel is not None else "")
            + f": {error}"
        ) from error
    if kernel is not None or mean is not None:
        _check_probe(field, header.get("probe"), source)
    return field


def _of_state(field: AbstractField) -> Callable[[Array], Array]:
    """The field as a function of the state alone: where it has inputs, they are 1."""
    if isinstance(field, ControlledField):
        u = jnp.ones(field.kernel.input_count, field.offset.dtype)
        return lambda x: field(x, u)
    return field


def _evaluable(field: AbstractField) -> None:
    """Raise unless the parts fit each other: as many lengthscales as coordinates, and the like."""
    state = jax.ShapeDtypeStruct((field.dimension,), field.offset.dtype)
    if field.offset.shape or jax.eval_shape(_of_state(field), state).shape != state.shape:
        raise ValueError("its arrays have an axis more than those of one field.")


def _probe(field: AbstractField) -> list[list[float]]:
    """A state and the velocity there, by which a kernel of the user's own code is known again."""
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
    try:
        state, saved = np.asarray(probe, float)
        velocity = np.asarray(_of_state(field)(jnp.asarray(state)))
        same = np.linalg.norm(velocity - saved) <= _SAME * np.linalg.norm(saved)
    except (TypeError, ValueError) as error:
        raise ValueError(f"{source} is not a valid file of hamkernel.save: {error}.") from error
    if not same:
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
