"""Batches of small matrices, without batches of LAPACK calls.

Two of those in one program, such as `jit(lambda a, b: (qr(a), qr(b)))` of shape (64, 48, 48), wait
for each other for ever on two cores (jaxlib 0.10.2).
"""

import jax.numpy as jnp
from jaxtyping import Array, Float


def orthonormal(
    P: Float[Array, "B d n"],
) -> tuple[Float[Array, "B d n"], Float[Array, "B n n"]]:
    """Q and U of P = QU, U upper triangular with a positive diagonal, for a batch.

    By Gram and Schmidt done twice, which is as good as Householder. The loop is over n.
    """
    Q = P[:, :, :0]
    for j in range(P.shape[2]):
        v = P[:, :, j]
        for _ in range(2):
            v = v - jnp.einsum("bdi,bi->bd", Q, jnp.einsum("bdi,bd->bi", Q, v))
        v = v / jnp.sqrt(jnp.einsum("bd,bd->b", v, v))[:, None]
        Q = jnp.concatenate([Q, v[:, :, None]], axis=2)
    return Q, jnp.triu(jnp.einsum("bdi,bdj->bij", Q, P))
