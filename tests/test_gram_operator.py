"""Products with the Gram against the dense Gram in NumPy, and what lineax makes of the operator."""

import equinox as eqx
import jax
import jax.numpy as jnp
import lineax as lx
import numpy as np
import pytest

import hamkernel as hk
from hamkernel import gram_operator
from hamkernel._sizes import sizes

TILE = sizes().tile

# Sums of a thousand terms of order one.
ROUNDING = 1e-12
# Three tiles of rows and two of columns, and neither is full.
N, M, n = 2 * TILE + 23, TILE + 203, 2
# Points far from the edge of a tile give the same in one tile.
FEW = 12


def normal(shape, seed=0):
    return np.random.default_rng(seed).normal(size=shape)


def curl_free(X, Z, A, sigma):
    """Σⱼ −∇∇ᵀg(xᵢ − zⱼ) aⱼ for the Gaussian g, by differences of points."""
    d = X[:, None] - Z[None]
    weight = np.exp(-(d**2).sum(-1) / (2 * sigma**2)) / sigma**2
    along = np.einsum("nma,ma->nm", d, A) / sigma**2
    return weight @ A - np.einsum("nm,nma->na", weight * along, d)


def rotated(V):
    return np.concatenate([V[:, n // 2 :], -V[:, : n // 2]], axis=1)


def test_the_product_is_that_of_the_closed_form_across_tiles():
    X, Z, A = normal((N, n)), normal((M, n), 1), normal((M, n), 2)
    expected = rotated(curl_free(X, Z, -rotated(A), 1.3))  # J M Jᵀa
    operator = gram_operator(hk.Symplectic(hk.Gaussian(1.3)), X, Z)
    np.testing.assert_allclose(operator.mv(jnp.asarray(A)), expected, atol=1e3 * ROUNDING)
    wrong = rotated(curl_free(X, Z, rotated(A), 1.3))
    assert np.abs(operator.mv(jnp.asarray(A)) - wrong).max() > 1


PARITIES = {
    "odd_symplectic": (hk.Odd, hk.Symplectic(hk.Matern(2.5, 1.2))),
    "odd_separable": (hk.Odd, hk.Separable(hk.Gaussian(1.1))),
    "even_separable": (hk.Even, hk.Separable(hk.Gaussian(1.1))),
    "even_symplectic": (hk.Even, hk.Symplectic(hk.Gaussian(jnp.array([0.8, 1.3])))),
    "odd_divergence_free": (hk.Odd, hk.DivergenceFree(hk.Gaussian(0.9))),
    "odd_sum": (
        hk.Odd,
        hk.Symplectic(2.0 * hk.Select(hk.Gaussian(1.0), 0) + hk.Select(hk.Matern(2.5), 1)),
    ),
    "odd_callable": (hk.Odd, hk.CurlFree(lambda x, z: (1.5 + x @ z) ** 3)),
    # Neither has k(−x, −z) = k(x, z), nor has the sum whose other term has it.
    "odd_lopsided": (hk.Odd, hk.CurlFree(lambda x, z: jnp.exp(x[0] / 2 + z[0] / 2 + x @ z / 4))),
    "even_lopsided_sum": (
        hk.Even,
        hk.Symplectic(hk.Gaussian(1.1) + hk.Warp(hk.Gaussian(1.0), lambda x: x + x**2 / 4)),
    ),
}
KERNELS = {
    "separable": hk.Separable(hk.Matern(1.5, 0.9)),
    "curl_free": hk.CurlFree(hk.Gaussian(jnp.array([0.8, 1.3]))),
    "divergence_free": hk.DivergenceFree(hk.RationalQuadratic(1.5, 1.1)),
    "sum": hk.Sum(hk.CurlFree(hk.Polynomial(3)), 0 + hk.Symplectic(hk.Gaussian(1.0))),
    "callable": hk.Symplectic(lambda x, z: jnp.cosh(x @ z)),
    "poisson_invariant": hk.Poisson(
        hk.Invariant(hk.Gaussian(1.0), [-np.eye(2)]),
        lambda x: (1 + x[0] ** 2) * jnp.array([[0.0, 1.0], [-1.0, 0.0]]),
    ),
    **{name: parity(K) for name, (parity, K) in PARITIES.items()},
}


@pytest.mark.few(4)
@pytest.mark.parametrize("name", KERNELS)
def test_products_are_those_of_the_dense_gram(name):
    K, X, Z = KERNELS[name], normal((FEW, n)), normal((FEW + 5, n), 1)
    G = np.asarray(hk.gram(K, X, Z)).reshape(X.size, Z.size)
    operator = gram_operator(K, X, Z)
    A, B = normal(Z.shape, 2), normal(X.shape, 3)
    scale = np.abs(G).max()
    np.testing.assert_allclose(
        operator.mv(jnp.asarray(A)).ravel(), G @ A.ravel(), atol=50 * scale * ROUNDING
    )
    if name in PARITIES:  # the other parity fails the same check
        parity, bare = PARITIES[name]
        K = hk.Even(bare) if parity is hk.Odd else hk.Odd(bare)
        other = gram_operator(K, X, Z).mv(jnp.asarray(A))
        assert np.abs(other.ravel() - G @ A.ravel()).max() > 0.1 * scale
    np.testing.assert_allclose(
        operator.T.mv(jnp.asarray(B)).ravel(), G.T @ B.ravel(), atol=50 * scale * ROUNDING
    )
    np.testing.assert_array_equal(operator.as_matrix(), G)


def test_the_diagonal_is_right_far_from_the_origin():
    X = normal((FEW, n)) + 2.0**27
    operator = gram_operator(KERNELS["curl_free"], X, X + 0.3)
    diagonal = np.diag(np.asarray(operator.as_matrix()))
    np.testing.assert_allclose(lx.diagonal(operator), diagonal, atol=1e-10)


@pytest.mark.slow
def test_lineax_knows_when_the_operator_is_positive():
    X = normal((FEW, n))
    K = KERNELS["odd_symplectic"]
    square, rectangle = gram_operator(K, X), gram_operator(K, X, X[:5])
    assert lx.is_positive_semidefinite(square)
    assert lx.is_symmetric(square)
    assert not lx.is_positive_semidefinite(rectangle)
    assert not lx.is_symmetric(rectangle)
    assert not lx.is_diagonal(square)
    assert square.T is square
    assert rectangle.in_size() == 5 * n
    assert rectangle.out_size() == FEW * n
    G = np.asarray(square.as_matrix())
    np.testing.assert_allclose(lx.diagonal(square), np.diag(G), atol=ROUNDING)
    np.testing.assert_array_equal(lx.materialise(square).as_matrix(), G)
    np.testing.assert_allclose((2.0 * square).mv(jnp.asarray(X)).ravel(), 2 * G @ X.ravel())


def test_lineax_solves_with_the_operator():
    X, y = normal((FEW, n)), normal((FEW, n), 1)
    operator = gram_operator(hk.CurlFree(hk.Gaussian(1.0)), X)
    shifted = operator + 0.1 * lx.IdentityLinearOperator(operator.in_structure())
    shifted = lx.TaggedLinearOperator(shifted, lx.positive_semidefinite_tag)
    A = lx.linear_solve(shifted, jnp.asarray(y), lx.CG(rtol=1e-12, atol=1e-12)).value
    G = np.asarray(operator.as_matrix())
    expected = np.linalg.solve(G + 0.1 * np.eye(len(G)), y.ravel())
    np.testing.assert_allclose(A.ravel(), expected, atol=1e-9)  # 10 × tolerance × condition 20


def test_jit_and_vmap_give_the_same_product():
    X, A = normal((FEW, n)), jnp.asarray(normal((3, FEW, n), 1))
    operator = gram_operator(KERNELS["sum"], X)
    one_by_one = jnp.stack([operator.mv(a) for a in A])
    np.testing.assert_allclose(jax.vmap(operator.mv)(A), one_by_one, rtol=ROUNDING, atol=ROUNDING)
    jitted = eqx.filter_jit(lambda operator, a: operator.mv(a))(operator, A[0])
    np.testing.assert_allclose(jitted, one_by_one[0], rtol=ROUNDING, atol=ROUNDING)


@pytest.mark.few(2)
@pytest.mark.parametrize("argument", ["lengthscale", "X", "Z", "A"])
def test_the_gradient_is_that_of_finite_differences_across_tiles(argument):
    start = {
        "lengthscale": jnp.asarray(1.3),
        "X": jnp.asarray(normal((TILE + 3, n))),
        "Z": jnp.asarray(normal((TILE + 7, n), 1)),
        "A": jnp.asarray(normal((TILE + 7, n), 2)),
    }
    weights = jnp.asarray(normal((TILE + 3, n), 3))

    def loss(value):
        given = {**start, argument: value}
        K = hk.Symplectic(hk.Gaussian(given["lengthscale"]))
        product = gram_operator(K, given["X"], given["Z"]).mv(given["A"])
        return jnp.sum(weights * product**2)

    direction = jnp.asarray(normal(start[argument].shape, 4))
    step = 1e-5  # error step² and eps/step, both 1e-10
    ahead, behind = (
        loss(start[argument] + step * direction),
        loss(start[argument] - step * direction),
    )
    slope = jnp.sum(jax.grad(loss)(start[argument]) * direction)
    np.testing.assert_allclose(slope, (ahead - behind) / (2 * step), rtol=1e-6)


def temporaries(function, *arguments):
    analysis = jax.jit(function).lower(*arguments).compile().memory_analysis()
    assert analysis is not None
    return analysis.temp_size_in_bytes


@pytest.mark.slow
def test_second_derivatives_of_a_matern_product_are_the_same_forward_and_backward():
    rng = np.random.default_rng(0)
    X, A = rng.normal(size=(2, 30, 2))

    def square(lengthscale):
        K = hk.Symplectic(hk.Matern(2.5, lengthscale))
        return jnp.sum(hk.gram_operator(K, X).mv(A) ** 2)

    forward = jax.jit(jax.jacfwd(jax.jacfwd(square)))(1.2)
    h = 1e-4
    slope = jax.jit(jax.grad(square))
    np.testing.assert_allclose(forward, (slope(1.2 + h) - slope(1.2 - h)) / (2 * h), rtol=1e-6)
    backward = jax.jit(jax.hessian(square))(1.2)
    np.testing.assert_allclose(backward, forward, rtol=1e-12)


@pytest.mark.slow
def test_value_and_gradient_need_memory_linear_in_the_points():
    K = hk.Symplectic(hk.Gaussian(1.0))

    def value(X):
        return jnp.sum(gram_operator(K, X).mv(X) ** 2)

    def dense(X):
        return jnp.sum((hk.gram(K, X).reshape(X.size, X.size) @ X.reshape(-1)) ** 2)

    small, large = jnp.zeros((2_000, n)), jnp.zeros((32_000, n))
    for function in (value, jax.grad(value)):
        # Sixteen times the points. The tile is the same.
        assert temporaries(function, large) < 16 * temporaries(function, small)
        assert temporaries(function, large) < 64 * large.nbytes + 64 * 8 * TILE * TILE
    assert temporaries(dense, small) > small.size**2 * 8  # the measure would notice a Gram


def test_points_far_from_the_origin_lose_nothing():
    X, A = normal((FEW, n)), normal((FEW, n), 1)
    K = hk.CurlFree(hk.Gaussian(1.0))
    near = gram_operator(K, X).mv(jnp.asarray(A))
    far = gram_operator(K, X + 2.0**20).mv(jnp.asarray(A))
    np.testing.assert_allclose(far, near, atol=1e-8)  # 1e-16 × 2²⁰, and its square is not lost


def test_a_field_at_many_states_is_the_same_as_one_by_one():
    X, Y = normal((FEW, n)), normal((FEW, n), 1)
    field = hk.fit(KERNELS["odd_symplectic"], X, Y, 1e-2)
    new = normal((TILE + 1, n), 2)
    one_by_one = np.stack([field(x) for x in jnp.asarray(new[:: TILE // 2])])
    np.testing.assert_allclose(field.evaluate(new)[:: TILE // 2], one_by_one, atol=1e-10)
    with pytest.raises(ValueError, match="3 coordinates and the field 2"):
        field.evaluate(normal((4, 3)))


def test_float32_stays_float32():
    X = normal((FEW, n)).astype(np.float32)
    product = gram_operator(hk.CurlFree(hk.Gaussian(1.0)), X).mv(jnp.asarray(X))
    assert product.dtype == jnp.float32


def test_an_operator_prints_its_kernel_and_the_shapes_of_its_points():
    operator = gram_operator(hk.Symplectic(hk.Gaussian(1.0)), normal((FEW, n)))
    kernel = "kernel=Symplectic(Gaussian(lengthscale=1))"
    assert repr(operator) == f"GramOperator({kernel}, X=f64[12,2])"
    jax.eval_shape(lambda operator: repr(operator) and operator.X, operator)


def test_what_does_not_fit_is_refused():
    K = hk.Symplectic(hk.Gaussian(1.0))
    with pytest.raises(TypeError, match="matrix-valued"):
        gram_operator(hk.Gaussian(1.0), normal((3, 2)))  # pyright: ignore[reportArgumentType]
    with pytest.raises(ValueError, match="X has 2 coordinates and Z has 4"):
        gram_operator(K, normal((3, 2)), normal((3, 4)))
    with pytest.raises(ValueError, match="even dimension"):
        gram_operator(K, normal((3, 3)))
    with pytest.raises(ValueError, match=r"vector has shape \(4, 2\)"):
        gram_operator(K, normal((3, 2))).mv(jnp.ones((4, 2)))
    with pytest.raises(TypeError, match="complex128; real numbers"):
        gram_operator(K, normal((3, 2))).mv(jnp.ones((3, 2), complex))
