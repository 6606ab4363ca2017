"""The Gram: its layout, symmetry and positivity, and the wrong constructions that lack them."""

import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from kernels import BY_NAME, CASES, canonical

import hamkernel as hk
from hamkernel._gram import block_traces, trace

SYMMETRY = 1e-12  # relative: entries are computed twice, in two orders
NEGATIVE = -1e-10  # smallest eigenvalue relative to the trace: rounding of the eigenvalues
STRUCTURES = {
    "separable": hk.Separable,
    "curl_free": hk.CurlFree,
    "symplectic": hk.Symplectic,
    "divergence_free": hk.DivergenceFree,
    "odd_symplectic": lambda k: hk.Odd(hk.Symplectic(k)),
    "even_symplectic": lambda k: hk.Even(hk.Symplectic(k)),
    "sum": lambda k: hk.CurlFree(k) + hk.DivergenceFree(hk.Gaussian(0.8)),
}
# Each structure with every kernel is for the slow tests: the rest of the product says little new.
QUICK = {"symplectic", "odd_symplectic"}
FEW = {"gaussian_ard", "partial", "function"}


def states(N=6, n=4, seed=0):
    return np.random.default_rng(seed).normal(size=(N, n))


def crowded():
    """States with a repeated one, and one so close that its distance is lost in rounding."""
    X = states()
    X[1], X[2] = X[0], X[0] + 1e-8
    return X


def square(K, X):
    """The Gram as a matrix."""
    G = jax.jit(hk.gram)(K, X)
    return np.asarray(G).reshape(X.size, X.size)


def asymmetry(G):
    return np.abs(G - G.T).max() / np.abs(G).max()


def smallest(G):
    """The smallest eigenvalue relative to the trace."""
    return np.linalg.eigvalsh((G + G.T) / 2).min() / np.trace(G)


@pytest.mark.few(8)
@pytest.mark.parametrize(
    ("structure", "case"),
    [
        pytest.param(
            structure,
            case,
            id=f"{name}-{case}",
            marks=[] if name in QUICK or case.name in FEW else [pytest.mark.slow],
        )
        for name, structure in STRUCTURES.items()
        for case in CASES
    ],
)
def test_gram_is_symmetric_and_positive_also_for_coincident_points(structure, case):
    G = square(structure(case.make(4)), crowded())
    assert asymmetry(G) < SYMMETRY
    assert smallest(G) > NEGATIVE


def test_minus_the_hessian_in_x_is_indefinite_for_a_polynomial():
    k, X = BY_NAME["polynomial"].make(2), states(n=2)

    def wrong(x, z):
        return -jax.hessian(k)(x, z)

    G = jax.vmap(jax.vmap(wrong, (None, 0), 1), (0, None))(X, X).reshape(X.size, X.size)
    assert np.linalg.eigvalsh((G + G.T) / 2).min() < -0.1
    assert smallest(square(hk.CurlFree(k), X)) > NEGATIVE


def test_the_mean_over_one_argument_is_asymmetric_without_invariance():
    k, X = BY_NAME["partial"].make(2), states(n=2)

    def one_sided(x, z):
        return (k(x, z) + k(-x, z)) / 2

    assert asymmetry(square(hk.Symplectic(one_sided), X)) > 0.1
    assert asymmetry(square(hk.Odd(hk.Symplectic(k)), X)) < SYMMETRY


@pytest.mark.parametrize("name", ["gaussian", "polynomial"])
def test_the_two_sided_mean_equals_the_one_sided_where_both_are_right(name):
    k, X = BY_NAME[name].make(2), states(n=2)
    cheap = square(hk.Odd(hk.Symplectic(k)), X)
    # The same function as a user's callable, of which nothing is known.
    safe = square(hk.Odd(hk.Symplectic(lambda x, z: k(x, z))), X)
    np.testing.assert_allclose(cheap, safe, atol=1e-12 * np.abs(cheap).max())


def gaussian_symplectic(x, z, sigma):
    """The paper's eq. (symplectic_kernel_from_gaussian)."""
    d, J = x - z, canonical(len(x))
    block = np.eye(len(x)) - np.outer(d, d) / sigma**2
    return np.exp(-d @ d / (2 * sigma**2)) / sigma**2 * J @ block @ J.T


def test_axes_are_point_component_point_component():
    X, Z, sigma = states(3), states(5, seed=1), 1.3
    G = hk.gram(hk.Symplectic(hk.Gaussian(sigma)), X, Z)
    assert G.shape == (3, 4, 5, 4)
    for i, x in enumerate(X):
        for j, z in enumerate(Z):
            np.testing.assert_allclose(
                G[i, :, j, :], gaussian_symplectic(x, z, sigma), atol=SYMMETRY
            )


def test_one_argument_is_the_gram_of_a_set_with_itself():
    K, X, Z = hk.Odd(hk.Symplectic(BY_NAME["partial"].make(4))), states(3), states(5, seed=1)
    np.testing.assert_array_equal(hk.gram(K, X), hk.gram(K, X, X))
    transposed = hk.gram(K, Z, X).transpose(2, 3, 0, 1)
    np.testing.assert_allclose(hk.gram(K, X, Z), transposed, atol=1e-12)


def test_a_rough_kernel_does_not_feel_the_rounding_of_the_distance_of_a_point_from_itself():
    # Of M(x, x) = 3/ℓ² I a distance of 1e-8 would take 1e-8.
    X = np.random.default_rng(0).normal(size=(40, 4))
    G = hk.gram(hk.CurlFree(hk.Matern(1.5, 1.2)), X)
    own = np.einsum("iaib->iab", G)
    np.testing.assert_allclose(own - 3 / 1.2**2 * np.eye(4), 0.0, atol=SYMMETRY)


@pytest.mark.few(2)
@pytest.mark.parametrize("name", ["gaussian", "matern2.5", "periodic"])
def test_shift_invariant_kernels_do_not_feel_the_origin(name):
    K, X = hk.Symplectic(BY_NAME[name].make(4)), states()
    near, far = hk.gram(K, X), hk.gram(K, X + 1e6)
    # The data itself is rounded to 1e-10 out there; the product form alone would lose 1e-4.
    np.testing.assert_allclose(far, near, atol=1e-8)
    there = jnp.asarray((X + 1e3).astype(np.float32))
    np.testing.assert_allclose(hk.gram(K, there), near, atol=1e-3)  # data rounded to 6e-5
    np.testing.assert_allclose(block_traces(K, there), block_traces(K, jnp.asarray(X)), rtol=1e-3)
    polynomial = hk.Symplectic(hk.Polynomial(2))
    assert np.abs(hk.gram(polynomial, X + 1.0) - hk.gram(polynomial, X)).max() > 1.0


def test_gram_works_under_jit_vmap_and_grad():
    X = states(3, 2)

    def trace(lengthscale, X):
        return jnp.einsum("iaia->", hk.gram(hk.Symplectic(hk.Gaussian(lengthscale)), X))

    # tr K(x, x) = n/ℓ², and its derivative −2n/ℓ³.
    ell = 1.7
    np.testing.assert_allclose(jax.jit(trace)(ell, X), 3 * 2 / ell**2, rtol=1e-12)
    np.testing.assert_allclose(jax.grad(trace)(ell, X), -2 * 3 * 2 / ell**3, rtol=1e-12)
    np.testing.assert_allclose(jax.grad(trace, 1)(ell, X), 0.0, atol=1e-12)
    several = jax.vmap(trace, in_axes=(0, None))(jnp.array([1.0, 2.0]), X)
    np.testing.assert_allclose(several, [6.0, 1.5], rtol=1e-12)


@pytest.mark.slow
def test_the_trace_takes_memory_linear_in_the_points_for_a_kernel_with_a_network():
    weights = jnp.asarray(np.random.default_rng(0).normal(size=(30, 2)))
    K = hk.Symplectic(hk.Warp(hk.Gaussian(2.0), lambda x: jnp.tanh(weights @ x)))
    X = jnp.asarray(np.random.default_rng(1).normal(size=(10, 2)))
    expected = np.trace(np.asarray(hk.gram(K, X)).reshape(20, 20))
    np.testing.assert_allclose(trace(K, X), expected, rtol=1e-12)

    def more(function):
        """Bytes of temporaries that a further point takes."""
        few, many = (
            memory(jax.jit(lambda X: function(K, X)), jax.ShapeDtypeStruct((N, 2), X.dtype))
            for N in (10_000, 110_000)
        )
        return (many - few) / 100_000

    assert more(trace) < 50
    assert more(lambda K, X: jax.vmap(lambda x: jnp.trace(K(x, x)))(X)) > 500  # all at once


def memory(compiled, X) -> int:
    analysis = compiled.lower(X).compile().memory_analysis()
    assert analysis is not None
    return analysis.temp_size_in_bytes


def test_new_hyperparameters_do_not_recompile():
    traces = []

    def k(x, z):
        traces.append(None)
        return jnp.exp(x @ z)

    X, first = states(3, 2), None
    for lengthscale in (0.5, 1.0, 2.0):
        hk.gram(hk.Symplectic(lengthscale * hk.Warp(k, jnp.sin)), X)
        first = first or len(traces)
    assert first == len(traces) > 0
    hk.gram(hk.Symplectic(1.0 * hk.Warp(k, jnp.sin)), states(4, 2))  # another shape: the control
    assert len(traces) > first


def test_no_argument_is_cut_to_the_precision_of_the_other():
    X, Z = np.full((1, 2), 1 / 3), np.full((1, 2), 2 / 3)
    K, single = hk.Symplectic(hk.Gaussian()), X.astype(np.float32)
    there, back = hk.gram(K, single, Z), hk.gram(K, Z, single)
    assert there.dtype == back.dtype == jnp.float64
    np.testing.assert_array_equal(there[0, :, 0], back[0, :, 0].T)
    np.testing.assert_allclose(
        hk.gram_operator(K, single, Z).mv(jnp.asarray(Z)),
        (there.reshape(2, 2) @ Z[0])[None],
        rtol=1e-12,
    )
    assert K(jnp.asarray(single[0]), jnp.asarray(Z[0])).dtype == jnp.float64


def test_float32_gives_float32_and_integers_give_floats():
    K = hk.Symplectic(hk.Gaussian(1.3))
    X = states(3, 2)
    G = hk.gram(K, X.astype(np.float32))
    assert G.dtype == jnp.float32
    np.testing.assert_allclose(G, hk.gram(K, X), atol=1e-6)
    integers = np.arange(6).reshape(3, 2)
    np.testing.assert_array_equal(hk.gram(K, integers), hk.gram(K, integers.astype(float)))


K = hk.Symplectic(hk.Gaussian())


@pytest.mark.parametrize(
    ("call", "error", "match"),
    [
        (lambda: hk.gram(hk.Gaussian(), states()), TypeError, re.escape("hk.Symplectic(k), ")),  # pyright: ignore
        (lambda: hk.gram(hk.Symplectic, states()), TypeError, "must be a matrix-valued kernel"),  # pyright: ignore
        (lambda: hk.gram(K, states()[0]), ValueError, r"shape \(4,\); it must be \(N, n\).*None"),
        (lambda: hk.gram(K, states()[None]), ValueError, r"reshape\(-1, X\.shape\[-1\]\)"),
        (lambda: hk.gram(K, states(0)), ValueError, "at least one point"),
        (lambda: hk.gram(K, states(n=3)), ValueError, "even dimension, got n = 3"),
        (lambda: hk.gram(K, states(), states(n=2)), ValueError, "X has 4 coordinates and Z has 2"),
        (lambda: hk.gram(K, states(), states()[0]), ValueError, r"Z has shape \(4,\)"),
        (lambda: hk.gram(K, states() * 1j), TypeError, "complex128; real numbers are needed"),
        (
            lambda: hk.gram(hk.Symplectic(hk.Gaussian(np.ones(2))), states()),
            ValueError,
            "2 lengthscales",
        ),
        (
            lambda: hk.gram(hk.Symplectic(lambda x, z: x * z), states()),
            ValueError,
            r"a scalar of shape \(\) is needed",
        ),
        (
            lambda: hk.gram(K, np.zeros((200_000, 4))),
            ValueError,
            r"needs 5.12e\+03 GB \(one matrix of 800000 by 800000 numbers\).*hk.gram_operator",
        ),
    ],
)
def test_gram_refuses(call, error, match):
    with pytest.raises(error, match=match):
        call()
