"""The rows of the last iteration as observations of the field, for a posterior."""

from typing import Any

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Array, Float

from hamkernel._observations.kinds import Functionals, Together
from hamkernel._trajectories.rows import Rows
from hamkernel._trajectories.shooting import means


def functionals_of(rows: Rows, log_noise: Float[Array, " n"], mean: Any) -> Together | None:
    """CᵀW B f = CᵀW (x − x̂ + ô + B m) + ε with ε ~ N(0, I), one block for each segment.

    C are the last columns of the complete QR of W Φ, so that the start is projected out. None where
    no segment has more samples than its start takes.
    """
    sigma = np.exp(np.asarray(log_noise))
    at_nodes = _at_nodes(mean, rows.nodes, len(sigma))
    every = jax.tree.map(np.asarray, (rows, at_nodes))  # one segment of a JAX array compiles
    segments = (jax.tree.map(lambda a, s=s: a[s], every) for s in range(len(rows.counts)))
    found = [_of_segment(segment, at_nodes, sigma) for segment, at_nodes in segments]
    parts = tuple(part for part in found if part is not None)
    return Together(parts) if parts else None


@eqx.filter_jit
def _at_nodes(mean, nodes: Float[Array, "S L 3 d"], n: int) -> Float[Array, "S L 3 n"]:
    return means(mean, nodes, nodes[..., :n])


def _of_segment(
    rows: Any, mean: Float[np.ndarray, "L 3 n"], sigma: Float[np.ndarray, " n"]
) -> Functionals | None:
    """The block of one segment, `rows` without their first axis; None if it says nothing."""
    n = len(sigma)
    if not rows.counts.any():
        return None
    last = int(np.flatnonzero(rows.counts.any(axis=1))[-1])  # padding follows
    B = _sums(rows.across[:last], rows.weights[:last])
    counts = rows.counts[: last + 1]
    seen = counts.reshape(-1) > 0
    W = (np.sqrt(counts) / sigma[None]).reshape(-1)[seen]
    P = W[:, None] * rows.tangent[: last + 1].reshape(-1, n)[seen]
    if len(P) <= n:
        return None
    C = np.linalg.qr(P, mode="complete")[0][:, n:]
    B = C.T @ (W[:, None] * B[seen])
    target = C.T @ (W * rows.target[: last + 1].reshape(-1)[seen]) + B @ mean[:last].reshape(-1)
    x, u = np.split(rows.nodes[:last].reshape(1, 3 * last, -1), [n], axis=2)
    return Functionals(x, B.reshape(1, len(B), 3 * last, n), target[None], u if u.size else None)


def _sums(
    across: Float[np.ndarray, "L n n"], weights: Float[np.ndarray, "L 3 n n"]
) -> Float[np.ndarray, "D Q"]:
    """B of one segment as a matrix: all samples by all nodes."""
    L, k, n, _ = weights.shape
    out = np.zeros((L + 1, n, L, k, n))
    for i in range(L):
        out[i + 1] = np.einsum("ab,blkc->alkc", across[i], out[i])
        out[i + 1, :, i] += np.moveaxis(weights[i], 0, 1)
    return out.reshape((L + 1) * n, L * k * n)
