"""The rows of the last iteration as observations of the field, for a posterior."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from hamkernel._observations.base import Together
from hamkernel._observations.kinds import Functionals
from hamkernel._trajectories.rows import Rows


def functionals_of(rows: Rows, log_noise: Float[Array, " n"], mean: Any) -> Together | None:
    """CᵀW B f = CᵀW (x − x̂ + ô + B m) + ε with ε ~ N(0, I), one block for each segment.

    C are the last columns of the complete QR of W Φ, so that the start is projected out. None where
    no segment has more samples than its start takes.
    """
    sigma = np.exp(np.asarray(log_noise))
    rows = Rows(*map(np.asarray, rows))  # pyright: ignore[reportArgumentType]
    found = []
    for s in range(len(rows.counts)):
        counts = rows.counts[s]
        if not counts.any():
            continue
        last = int(np.flatnonzero(counts.any(axis=1))[-1])  # padding follows
        B = _sums(rows.across[s, :last], rows.weights[s, :last])
        nodes = rows.nodes[s, :last].reshape(-1, rows.nodes.shape[-1])
        seen = counts[: last + 1].reshape(-1) > 0
        W = (np.sqrt(counts[: last + 1]) / sigma[None]).reshape(-1)[seen]
        P = W[:, None] * rows.tangent[s, : last + 1].reshape(-1, len(sigma))[seen]
        if len(P) <= P.shape[1]:
            continue
        C = np.linalg.qr(P, mode="complete")[0][:, P.shape[1] :]
        B = C.T @ (W[:, None] * B[seen])
        target = C.T @ (W * rows.target[s, : last + 1].reshape(-1)[seen])
        if mean is not None:
            target = target + B @ np.asarray(jax.vmap(mean)(jnp.asarray(nodes))).reshape(-1)
        x, u = np.split(nodes[None], [len(sigma)], axis=2)
        weights = B.reshape(1, len(B), *x.shape[1:])
        found.append(Functionals(x, weights, target[None], u if u.size else None))
    return Together(tuple(found)) if found else None


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
