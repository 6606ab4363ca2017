"""Where learning starts: landmarks, the box of hyperparameters, and rows along smoothed runs."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from hamkernel._kernels.base import Scaled
from hamkernel._structures.base import AbstractMatrixKernel
from hamkernel._structures.controlled import Controlled, InputMatrix
from hamkernel._structures.masses import UnknownMasses
from hamkernel._structures.structure import AbstractStructure
from hamkernel._trajectories.evidence import Box, Model
from hamkernel._trajectories.flow import WEIGHTS, with_tangent
from hamkernel._trajectories.inputs import at_nodes
from hamkernel._trajectories.prepared import Prepared
from hamkernel._trajectories.rows import Rows, Segments, frozen, linearised
from hamkernel._trajectories.shooting import Piece, means
from hamkernel._tuning.boxes import gram_trace, hyperparameters

# Landmarks for n coordinates, 128 for more. 45 for n = 2 and 80 for n = 4 were as good as all.
_FEWEST = {1: 24, 2: 48, 3: 64, 4: 80}
_POINTS = 1024  # from which boxes and landmarks are taken
# Noise to begin with, of the standard deviations, besides that of smoothing. With five samples a
# swing smoothing cannot know it: it found none at all in 3 of 5 logs with noise of 8 %.
_NOISES = (0.01, 0.1)


def with_amplitude(K: AbstractMatrixKernel) -> AbstractMatrixKernel:
    """K, every structure and input matrix in it scaled; a likelihood needs amplitudes.

    `Symplectic(Gaussian(2.0))` becomes `Symplectic(1.0 * Gaussian(2.0))`.
    """

    def is_structure(node: object) -> bool:
        return isinstance(node, AbstractStructure | InputMatrix)

    def scaled(node):
        if not is_structure(node) or node.kernel.has_amplitude:
            return node
        return eqx.tree_at(lambda node: node.kernel, node, Scaled(node.kernel, 1.0))

    return jax.tree.map(scaled, K, is_leaf=is_structure)


def with_masses(K: AbstractMatrixKernel, n: int) -> AbstractMatrixKernel:
    """K for states (q, q̇) of n coordinates, all masses equal at first."""
    if n == 2:
        raise ValueError(
            "masses=True with one degree of freedom: every mass explains the same motion and is "
            "only a unit of the energy, so there is nothing to find. Leave it out; (q, q̇) is "
            "(q, p) of a mass of one."
        )
    if isinstance(K, Controlled):
        return Controlled(with_masses(K.drift, n), K.inputs, K.count)
    return K if isinstance(K, UnknownMasses) else UnknownMasses(K, jnp.ones(n // 2))


def sampled(data: Prepared) -> tuple[Float[np.ndarray, "N d"], Float[np.ndarray, "N n"]]:
    """Points, (x, u) with inputs, and velocities of the smoothed runs at some of their nodes.

    Always as many, if need be some of them twice, so that other lengths do not compile anew.
    """
    n = len(data.scale)
    runs = [run for run, use in zip(data.runs, data.usable, strict=True) if use]
    points = [np.concatenate([run.nodes, at_nodes(run.inputs)], axis=-1) for run in runs]
    X = np.concatenate([each.reshape(-1, each.shape[-1]) for each in points])
    Y = np.concatenate([run.slopes.reshape(-1, n) for run in runs])
    chosen = np.linspace(0, len(X) - 1, _POINTS).round().astype(int)
    return X[chosen], Y[chosen]


def landmarks(X: Float[np.ndarray, "N d"], scale, count: int | None) -> Float[Array, "m d"]:
    """Points of X that cover it: each the one farthest from those before, in standard deviations.

    They do not depend on hyperparameters, which are not known yet.
    """
    count = _FEWEST.get(X.shape[1], 128) if count is None else count
    spread = X[:, len(scale) :].std(axis=0)  # of the inputs
    points = X / np.concatenate([scale, np.where(spread > 0, spread, 1.0)])[None]
    chosen = [int(np.argmin(np.linalg.norm(points - points.mean(axis=0), axis=1)))]
    distance = np.full(len(points), np.inf)
    while len(chosen) < min(count, len(points)):
        distance = np.minimum(distance, np.linalg.norm(points - points[chosen[-1]], axis=1))
        if not distance.max() > 0:
            break
        chosen.append(int(np.argmax(distance)))
    return jnp.asarray(X[chosen])


def box_of(
    model: Model, X: np.ndarray, Y: np.ndarray, scale: np.ndarray, moves: np.ndarray
) -> tuple[Box, np.ndarray]:
    """The box of all hyperparameters, those of the caller inside, and a design of first points.

    Args:
        model: the caller's kernel and the noise of the smoothed runs.
        X: states, with inputs the points (x, u).
        Y: their velocities.
        scale: the standard deviations of the coordinates.
        moves: the coordinates whose noise is looked for.
    """
    speed = float(np.sqrt(np.mean(Y**2)))
    leaves = hyperparameters(model.kernel, jnp.asarray(X), speed, jnp.asarray(X))
    start = np.asarray(model.flat)
    size = len(start) - len(scale)
    most = np.maximum(scale, np.exp(start[size:]))  # where next to nothing moves
    low = np.concatenate([*(p.low.ravel() for p in leaves), np.log(1e-7 * scale)])
    high = np.concatenate([*(p.high.ravel() for p in leaves), np.log(2 * most)])
    low, high = np.minimum(low, start), np.maximum(high, start)
    free = np.concatenate([np.ones(size, bool), moves])
    names = [p.name for p in leaves for _ in range(p.low.size)]
    none = np.zeros(len(scale), bool)
    lengths = np.append([name.endswith("lengthscale") for name in names], none).astype(bool)
    scales = np.append([name.split(".")[-1] == "scale" for name in names], none).astype(bool)
    extents = np.concatenate([*(_extents(p.low, X[:, : len(scale)]) for p in leaves), none])
    design = [start]
    for shift in (None, -1.2, -0.6, 0.0, 0.6, 1.2, 2.0):
        point = start.copy()
        if shift is not None:
            if not lengths.any():
                continue
            point[lengths] = np.clip(extents - 0.7 + shift, low, high)[lengths]
        design.append(_amplified(model, point, scales, X, Y))
    design = np.array(design)
    noisy = [design]
    for share in _NOISES if moves.any() else ():
        noisy.append(design.copy())
        noisy[-1][:, size:] = np.where(moves, np.log(share * scale), start[size:])
    return Box(low, high, free), np.clip(np.concatenate(noisy), low, high)


def _extents(leaf: np.ndarray, X: Float[np.ndarray, "N n"]) -> Float[np.ndarray, " size"]:
    """The logarithm of the extent of X, for each coordinate where the leaf has as many entries."""
    ranges = np.maximum(np.ptp(X, axis=0), np.finfo(float).tiny)
    if leaf.shape == ranges.shape:
        return np.log(ranges * np.sqrt(len(ranges)))
    return np.full(leaf.size, np.log(np.hypot.reduce(ranges)))


def _amplified(model: Model, h, scales, X, Y):
    """The point h, its amplitudes such that a velocity of the prior is twice one that was seen."""
    if not scales.any():
        return h
    trace = float(gram_trace(model.at(jnp.asarray(h)).kernel, jnp.asarray(X))) / len(X)
    target = 4 * np.mean(np.sum(Y**2, axis=1))
    out = h.copy()
    if np.isfinite(trace) and trace > 0 and target > 0:
        out[scales] += np.log(target / trace)
    return out


def smooth_rows(
    data: Prepared, pieces: list[Piece], segments: Segments, mean, good: np.ndarray
) -> Rows:
    """The rows along the smoothed runs, whose tangent is that of the mean."""
    S, L = segments.spans.shape
    n = len(data.scale)
    first = data.runs[pieces[0][0]].path[pieces[0][1]]  # where padding stays
    x, nodes = np.tile(first, (S, L + 1, 1)), np.tile(first, (S, L, 3, 1))
    slopes = np.zeros((S, L, 3, n))
    for s, (r, start, stop) in enumerate(pieces):
        run, T = data.runs[r], stop - start
        x[s] = run.path[stop - 1]
        nodes[s] = run.path[stop - 1]
        x[s, :T] = run.path[start:stop]
        nodes[s, : T - 1] = run.nodes[start : stop - 1]
        slopes[s, : T - 1] = run.slopes[start : stop - 1]
    points = np.concatenate([nodes, at_nodes(np.asarray(segments.inputs))], axis=-1)
    along = jnp.asarray(x), jnp.asarray(points), jnp.asarray(slopes)
    return _smooth_rows(mean, along, jnp.asarray(good), segments)


@eqx.filter_jit
def _smooth_rows(mean, along, good, segments: Segments) -> Rows:
    x, points, slopes = along
    path = frozen(x, points, segments.spans, jacobians(mean, points, x.shape[-1]))
    there = means(mean, points, slopes)
    return linearised(path, slopes, there, segments, good, is_solution=False)


def jacobians(mean, nodes: Float[Array, "S L 3 d"], n: int) -> Float[Array, "S L n n"]:
    """∂m/∂x of the mean in each interval, averaged over its nodes."""
    if mean is None:
        return jnp.zeros((*nodes.shape[:2], n, n), nodes.dtype)
    D = jax.vmap(jax.vmap(jax.vmap(lambda s: with_tangent(mean, s, n)[1])))(nodes)
    return jnp.einsum("slkab,k->slab", D, jnp.asarray(WEIGHTS, nodes.dtype))
