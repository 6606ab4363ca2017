"""The hyperparameters of a `Lagrangian`, by the marginal likelihood of its torques."""

from __future__ import annotations

from typing import Any, NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, ArrayLike, Float

from hamkernel._machine import compiled_by_size
from hamkernel._solvers.lagrangian import TorqueData, known_entries, strong_rows, with_anchor
from hamkernel._solvers.triangle import regression_loss
from hamkernel._structures.lagrangian import Lagrangian, LagrangianFeatures
from hamkernel._tuning.minimiser import best_in_box, inside_box
from hamkernel._tuning.space import Hyperparameter, boxes_of, with_leaves


class Sizes(NamedTuple):
    """Root mean squares of all joints together, that set the boxes of the search.

    Attributes:
        torque: the size of torques, as rows see them.
        speed: the size of velocities.
        acceleration: the size of accelerations.
        error: the deviation of a torque at a sample with which rows are as wrong as they are large.
    """

    torque: float
    speed: float
    acceleration: float
    error: float


class Likeliest(NamedTuple):
    """The end of a search.

    Attributes:
        kernel: the kernel.
        deviation: the standard deviation of the torque of each joint, shape (m,).
        loss: −log p of the torques, but for a constant.
        converged: whether the search met its tolerance.
        steps: how many steps it took.
        at_bounds: the names of what rests on a bound of its box.
        bounds: the box, by names.
        values: the hyperparameters, by names.
    """

    kernel: Lagrangian
    deviation: Float[Array, " m"]
    loss: float
    converged: bool
    steps: int
    at_bounds: tuple[str, ...]
    bounds: dict[str, tuple[float, float]]
    values: dict[str, Array]


def likeliest(
    features: LagrangianFeatures,
    rows: Any,
    sizes: Sizes,
    deviation: Float[np.ndarray, " m"] | None = None,
    steps: int = 64,
) -> Likeliest:
    """The likeliest lengthscales, amplitudes and deviations of torques, from several starts.

    Args:
        features: the features of the first guess; their centres stay.
        rows: (features, deviations of the torques (m,)) -> rows B (N, r) and targets y (N,), both
            over their noise, and the sum of the logarithms of that noise; a PyTree.
        sizes: the sizes of the data.
        deviation: a first guess of the deviations of torques; if None, some are tried.
        steps: how many the search takes at most.
    """
    K, m = features.kernel, features.count
    boxes = _boxes(K, np.asarray(features.centres), sizes)
    leaves = np.asarray(ravel_pytree(eqx.filter(K, eqx.is_inexact_array))[0])
    low, high = (
        np.concatenate([getattr(box, side).ravel() for box in boxes] + [np.zeros(m)])
        for side in ("low", "high")
    )
    # Six decades: torques may be commanded exactly, or be as wrong as they are large.
    low[len(leaves) :], high[len(leaves) :] = np.log(sizes.error) + np.log([1e-6, 3.0])
    names = np.repeat([box.name for box in boxes], [box.low.size for box in boxes])
    is_length = np.array([n.endswith("lengthscale") for n in names])
    is_amplitude = np.array([n.endswith(".scale") for n in names])
    middle = (low + high)[: len(leaves)] / 2
    if deviation is None:
        lengths = np.where(is_length, 1.0, 0.0)
        kernels = [leaves, leaves + np.log(3.0) * lengths]
        kernels += [np.where(is_amplitude, middle, k) for k in kernels]
        # Harmonics of rigid bodies are long kernels with the slope (2) or the curvature (4) of the
        # data. Without these two starts the searches for two arms of four, seen for two runs of
        # 5 s, ended at M = 0.
        flat = leaves + np.log(10.0) * lengths
        kernels += [np.where(is_amplitude, middle + k * np.log(10.0), flat) for k in (2, 4)]
        first = [np.full(m, share * sizes.error) for share in (0.3, 0.03, 0.003)]
    else:  # the kernel is good, and the path explains errors that the torques had to
        kernels, first = [leaves], [deviation * share for share in np.geomspace(1, 1e-3, 12)]
    design = np.array([np.append(k, np.log(d)) for k in kernels for d in first])
    design = np.clip(design, low + 0.02 * (high - low), high - 0.02 * (high - low))
    dtype = features.centres.dtype
    space = jnp.asarray(design, dtype), jnp.asarray(low, dtype), jnp.asarray(high, dtype)
    h, loss, converged, count = _search(features, rows, space, steps)
    kernel = with_leaves(K, h[: len(leaves)])
    share = (np.asarray(h) - low) / (high - low)
    at_edge = (share < 0.01) | (share > 0.99)
    spans, values, first_entry = {}, {}, 0
    for box in boxes:
        entries = slice(first_entry, first_entry + box.low.size)
        first_entry = entries.stop
        spans[box.name] = float(np.exp(low[entries].min())), float(np.exp(high[entries].max()))
        values[box.name] = jnp.exp(h[entries]).reshape(box.low.shape)
    return Likeliest(
        kernel,
        jnp.exp(h[len(leaves) :]),
        float(loss),
        bool(converged),
        int(count),
        tuple(dict.fromkeys(names[at_edge[: len(leaves)]].tolist())),
        spans,
        values,
    )


@compiled_by_size
def _search(features, rows, space, steps):
    m, (design, low, high) = features.count, space

    def loss(h):
        shown = features.with_kernel(with_leaves(features.kernel, h[:-m]))
        B, y, lost = rows(shown, jnp.exp(h[-m:]))
        return regression_loss(*with_anchor(shown, B, y)) + lost

    run = best_in_box(loss, design, low, high, jnp.full_like(low, 0.3), steps)
    return inside_box(run.best.u, low, high), run.best.value, run.converged, run.steps


def _boxes(K: Lagrangian, centres: np.ndarray, sizes: Sizes) -> list[Hyperparameter]:
    """The box of every trainable number, in the order of the leaves of K.

    Amplitudes are near V ~ torque² and M ~ (torque/acceleration)², and those of friction near the
    torques.
    """
    amplitudes = {
        "potential": sizes.torque**2,
        "inertia": (sizes.torque / sizes.acceleration) ** 2,
    }
    boxes = []
    for name, amplitude in amplitudes.items():
        boxes += boxes_of(getattr(K, name), name, centres, amplitude)
    # A joint is up to three times as fast as its root mean square.
    fastest = np.full((1, 2), 3 * sizes.speed)
    for name in ("log_viscous", "log_coulomb", "log_stribeck", "log_stribeck_speed"):
        leaf = getattr(K.friction, name, None)
        if K.friction is not None and leaf is not None:
            bounds = K.friction.bounds(name, fastest, sizes.torque**2)
            sides = (np.broadcast_to(np.asarray(b, float), leaf.shape) for b in bounds)
            boxes.append(Hyperparameter(f"friction.{name[4:]}", True, *sides))
    return boxes


class StrongRows(eqx.Module):
    """The rows of torques at known accelerations as the search calls them.

    All joints have one deviation, as in `fit`: the geometric mean of those of the search.
    """

    data: TorqueData

    def __call__(self, features: LagrangianFeatures, deviation: Float[Array, " m"]):
        log_deviation = jnp.log(deviation).mean()
        rows = strong_rows(features, self.data, jnp.exp(log_deviation))
        return *rows, self.data.torques.size * log_deviation


def sizes_of_torques(K: Lagrangian, data: TorqueData) -> Sizes:
    """The root mean squares of states, torques and accelerations."""
    m = data.torques.shape[1]
    arrays = data.states[:, m:], data.accelerations
    speed, acceleration = (float(np.sqrt(np.mean(np.square(a)))) or 1.0 for a in arrays)
    torque = torque_size(K, data.torques, acceleration)
    return Sizes(torque, speed, acceleration, torque)


def torque_size(K: Lagrangian, torques: ArrayLike, acceleration: float) -> float:
    """The root mean square of the torques of known gains; of motions without, that of M q̈."""
    torques = np.asarray(torques)
    forces = np.delete(torques, np.asarray(K.unknown_gains, int), axis=-1)
    size = float(np.sqrt(np.mean(np.square(forces)))) if forces.any() else 0.0
    anchor = 1.0 if K.known_mass_matrix is None else np.nanmax(np.abs(known_entries(K)))
    return size or float(anchor) * acceleration
