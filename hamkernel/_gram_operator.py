"""Products with the Gram that never form it, in O((N + M) n) memory.

After fusion, `K.along(xᵢ, Z, A)` for all i of a tile is one matrix product of the points and
one pass over the scalar pairs. The temporaries of a tile stay in the cache. Above about 32 MB every
temporary would be new memory from the operating system, whose page faults cost more than the
arithmetic.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import lineax as lx
from jaxtyping import Array, ArrayLike, Float, Num

from hamkernel import _require as require
from hamkernel._gram import diagonals, gram, subtract_centre
from hamkernel._machine import (
    RowSharding,
    follow_data,
    full_precision,
    map_devices,
    precise_jit,
    row_sharding,
    shard,
    to_caller_sharding,
)
from hamkernel._show import describe
from hamkernel._sizes import sizes
from hamkernel._structures.base import AbstractMatrixKernel, matrix_kernel
from hamkernel._structures.structure import expand_group


def gram_operator(
    K: AbstractMatrixKernel, X: Num[ArrayLike, "N n"], Z: Num[ArrayLike, "M n"] | None = None
) -> GramOperator:
    """The Gram of K as a linear operator that maps coefficients (M, n) to fields (N, n).

    `gram_operator(K, X, Z).mv(A)[i] = Σⱼ K(xᵢ, zⱼ) aⱼ`, for any kernel, by automatic
    differentiation. The result is a `lineax` operator: `.mv`, `.T`, `.as_matrix()` (which forms the
    Gram), algebra with other operators, and `lineax.linear_solve`. Products work under jit, vmap
    and grad, with respect to the kernel, the points and the coefficients. Derivatives need no more
    memory than values. For a learned field at many points use `field.evaluate(X)`, the same
    product.

    If the rows of X or Z are sharded over a mesh of devices, each device keeps its own rows, and
    the result is sharded like X.

    Args:
        K: a matrix-valued kernel.
        X: states, shape (N, n).
        Z: states, shape (M, n). If None, Z = X, and the operator is tagged positive semidefinite.

    Returns:
        The operator. A product takes O(N M n) time and O((N + M) n) memory.

    Raises:
        TypeError: K is not matrix-valued. ValueError: shapes do not fit, or the structure does
            not allow this n.

    Source: the forward-over-reverse product of de Roos, Gessner & Hennig (2021) and Ament &
        Gomes (2022), here on the whole tile at once.
    """
    K = matrix_kernel(K)
    X = require.points(X, "X")
    if Z is not None:
        X, Z = require.one_space(X, require.points(Z, "Z"))
    K.check_points(X)
    X_rows = row_sharding(X)
    Z_rows = X_rows if Z is None else row_sharding(Z)
    Z = None if Z is None else shard(Z_rows, Z)
    return GramOperator(K, shard(X_rows, X), Z, X_rows, Z_rows)


class GramOperator(lx.AbstractLinearOperator):
    """The Gram of K at X and Z, (M, n) -> (N, n), as products only; made by `gram_operator`."""

    kernel: AbstractMatrixKernel
    X: Float[Array, "N n"]
    Z: Float[Array, "M n"] | None
    X_rows: RowSharding | None = eqx.field(static=True, default=None)
    Z_rows: RowSharding | None = eqx.field(static=True, default=None)

    def __repr__(self) -> str:
        return describe(self)

    @property
    def columns(self) -> Float[Array, "M n"]:
        return self.X if self.Z is None else self.Z

    @follow_data
    @full_precision
    def mv(self, vector: Num[ArrayLike, "M n"]) -> Float[Array, "N n"]:
        """G a, shape (N, n).

        Raises:
            ValueError: the vector is not of shape (M, n). TypeError: it is complex.
        """
        needed = "one coefficient for each column of the Gram"
        require.shape(vector, "the vector has", needed, self.in_structure().shape)
        vector = require.floating(vector, "the vector")
        return _sharded_product(self.kernel, self.X, self.columns, vector, self.X_rows, self.Z_rows)

    @full_precision
    def as_matrix(self) -> Float[Array, "Nn Mn"]:
        """The dense Gram, O(N M n²) memory."""
        G = gram(self.kernel, self.X, self.columns)
        return G.reshape(G.shape[0] * G.shape[1], -1)

    def transpose(self) -> GramOperator:
        # K(x, z)ᵀ = K(z, x)
        if self.Z is None:
            return self
        return GramOperator(self.kernel, self.Z, self.X, self.Z_rows, self.X_rows)

    def in_structure(self) -> jax.ShapeDtypeStruct:
        return self._coefficients(self.columns)

    def out_structure(self) -> jax.ShapeDtypeStruct:
        return self._coefficients(self.X)

    def _coefficients(self, points: Float[Array, "N n"]) -> jax.ShapeDtypeStruct:
        N, coordinates = points.shape
        return jax.ShapeDtypeStruct((N, self.kernel.outputs(coordinates)), self.X.dtype)


def product(
    K: AbstractMatrixKernel,
    X: Float[Array, "N n"],
    Z: Float[Array, "M n"],
    A: Float[Array, "M n"],
    X_rows: RowSharding | None = None,
    Z_rows: RowSharding | None = None,
) -> Float[Array, "N n"]:
    """The fields Σⱼ K(xᵢ, zⱼ) aⱼ for all i, tile by tile, on the devices that hold the rows.

    If both X and Z are sharded, the rows of Z and A travel around the ring of devices.

    Raises:
        ValueError: X and Z are sharded differently.
    """
    part: Callable[..., Float[Array, "N n"]] = _product_by_tiles
    if Z_rows is None:
        return map_devices(X_rows, lambda w, x: part(w[0], x, *w[1:]), (K, Z, A), X, joined=True)
    if X_rows is None:
        return map_devices(Z_rows, lambda w, z, a: part(*w, z, a), (K, X), Z, A, joined=False)
    if (X_rows.mesh, X_rows.axes) != (Z_rows.mesh, Z_rows.axes):
        raise ValueError(
            f"X and Z are sharded over devices differently: {X_rows.caller} and {Z_rows.caller}. "
            "Put both on one mesh and the same axes, or one of them on every device."
        )
    ring = [(i, (i + 1) % X_rows.count) for i in range(X_rows.count)]

    def around(K, X, Z, A):
        def step(carry, _):
            total, columns = carry
            total = total + part(K, X, *columns)
            return (total, jax.lax.ppermute(columns, X_rows.axes, ring)), None

        start = jnp.zeros_like(X), (Z, A)
        return jax.lax.scan(step, start, length=X_rows.count)[0][0]

    return map_devices(X_rows, around, K, X, Z, A, joined=True)


def placed_product(
    K: AbstractMatrixKernel,
    X: Float[Array, "N n"],
    Z: Float[Array, "M n"],
    A: Float[Array, "M n"],
) -> Float[Array, "N n"]:
    """`product` for arrays that carry their sharding."""
    X_rows, Z_rows = row_sharding(X), row_sharding(Z)
    X, Z = shard(X_rows, X), shard(Z_rows, Z)
    return _sharded_product(K, X, Z, A, X_rows, Z_rows)


def _sharded_product(K, X, Z, A, X_rows, Z_rows):
    """`product` for X and Z that are already sharded over the devices."""
    return to_caller_sharding(X_rows, _product(K, X, Z, shard(Z_rows, A), X_rows, Z_rows))


_product = precise_jit(product)


def _product_by_tiles(K, X, Z, A):
    """`product` on one device."""
    K, Z, A = expand_group(K, Z, A.astype(X.dtype))
    X, Z = subtract_centre(K, X, Z)
    side = sizes().tile
    rows = tiles(X, X[:1], side)
    columns = (tiles(Z, Z[:1], side), tiles(A, jnp.zeros_like(A[:1]), side))

    # The backward pass recomputes the tiles; otherwise it would keep every pair.
    @jax.checkpoint
    def tile(x, z, a):
        return jax.vmap(K.along, in_axes=(0, None, None))(x, z, a)

    def row(x):
        def add(total, column):
            return total + tile(x, *column), None

        return jax.lax.scan(add, jnp.zeros((len(x), A.shape[1]), x.dtype), columns)[0]

    # Reverse mode through a loop forgets the custom rule that makes a Matérn kernel smooth at x =
    # z, and second derivatives become NaN. A single tile is therefore evaluated without a loop.
    if len(rows) == len(columns[0]) == 1:
        return tile(rows[0], columns[0][0], columns[1][0])
    return jax.lax.map(row, rows).reshape(-1, A.shape[1])[: len(X)]


def tiles(
    X: Float[Array, "N n"], padding: Float[Array, "1 n"], largest: int
) -> Float[Array, "T S n"]:
    """The rows of X in tiles of equal size S ≤ largest, the last one filled with `padding`."""
    N, n = X.shape
    count = max(1, math.ceil(N / largest))
    size = max(1, math.ceil(N / count))
    count_of_padding = count * size - N
    if count_of_padding:
        X = jnp.concatenate([X, jnp.broadcast_to(padding.astype(X.dtype), (count_of_padding, n))])
    return X.reshape(count, size, n)


# Properties of the operator for lineax, which dispatches on the type.


@lx.is_symmetric.register
@lx.is_positive_semidefinite.register
def _(operator: GramOperator) -> bool:
    return operator.Z is None


@lx.is_diagonal.register
@lx.is_tridiagonal.register
@lx.is_lower_triangular.register
@lx.is_upper_triangular.register
@lx.has_unit_diagonal.register
@lx.is_negative_semidefinite.register
def _(operator: GramOperator) -> bool:
    return False


@lx.linearise.register
@lx.conj.register
def _(operator: GramOperator) -> GramOperator:
    return operator


@lx.materialise.register
def _(operator: GramOperator) -> lx.PyTreeLinearOperator:
    into, out = operator.in_structure().shape, operator.out_structure().shape
    blocks = operator.as_matrix().reshape(*out, *into)
    tags = lx.positive_semidefinite_tag if operator.Z is None else ()
    return lx.PyTreeLinearOperator(blocks, operator.out_structure(), tags)


@lx.diagonal.register
def _(operator: GramOperator) -> Float[Array, " Nn"]:
    return diagonals(operator.kernel, operator.X, operator.columns).reshape(-1)
