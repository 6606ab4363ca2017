"""Plain functions that close over what JAX differentiates or maps over."""

import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import hamkernel as hk

RNG = np.random.default_rng(7)
X = RNG.normal(size=(12, 2))
Y = RNG.normal(size=(12, 2))
STEP = 1e-5
DIFFERENCES = 1e-7  # central ones, of values of order one


def nested(width):
    def square(x, z):
        return x @ x + z @ z - 2 * x @ z

    def scaled(x, z):
        return square(x, z) / width["of q and p"] ** 2

    return lambda x, z, power=0.5: jnp.exp(-power * scaled(x, z))


KERNELS = {
    "nested": lambda width: nested({"of q and p": width}),
    "in a warp": lambda width: hk.Warp(hk.Gaussian(1.0), lambda x: x / width),
}
QUANTITIES = {
    "loss": lambda K: hk.cross_validation_loss(K, X, Y, 1e-2, 4),
    "likelihood": lambda K: hk.log_marginal_likelihood(K, X, Y, 1e-2),
    "Cholesky": lambda K: hk.fit(K, X, Y, 1e-2).norm,
    "CG": lambda K: hk.fit(K, X, Y, 1e-2, solver=hk.ConjugateGradient(1e-10)).norm,
    "Nystrom": lambda K: hk.fit(K, X, Y, 1e-2, solver=hk.Nystrom(points=X)).norm,
    "product": lambda K: jnp.sum(hk.gram_operator(K, X).mv(jnp.asarray(Y)) ** 2) / 100,
}


# The iterations of Nystrom and CG compile for seconds, anew for every closure.
SLOW = {("Nystrom", "nested"), ("Nystrom", "in a warp"), ("CG", "in a warp")}


@pytest.mark.few(3)
@pytest.mark.parametrize(
    ("quantity", "kernel"),
    [
        pytest.param(*case, marks=pytest.mark.slow if case in SLOW else ())
        for case in itertools.product(QUANTITIES, KERNELS)
    ],
)
def test_a_function_may_close_over_what_is_differentiated_or_mapped(kernel, quantity):
    def value(width):
        return QUANTITIES[quantity](hk.Symplectic(KERNELS[kernel](width)))

    def plain(width):  # closes over a number; the exact fits are one
        return QUANTITIES["Cholesky" if quantity == "CG" else quantity](
            hk.Symplectic(KERNELS[kernel](width))
        )

    difference = (plain(1.5 + STEP) - plain(1.5 - STEP)) / (2 * STEP)
    np.testing.assert_allclose(jax.grad(value)(1.5), difference, rtol=DIFFERENCES, atol=DIFFERENCES)
    many = jax.vmap(value)(jnp.array([1.5, 2.0]))
    np.testing.assert_allclose(many, [plain(1.5), plain(2.0)], rtol=1e-8)


def test_a_function_that_closes_over_arrays_keeps_them_as_constants():
    width = jnp.array(1.5)
    K = hk.Symplectic(lambda x, z: jnp.exp(-((x - z) @ (x - z)) / width))
    assert jax.tree.leaves(K) == []


def test_a_traced_closure_keeps_defaults_keywords_and_names():
    def gaussian(x, z, power=0.5, *, scale=2.0):
        return scale * jnp.exp(-power * width * (x - z) @ (x - z))

    def value(w):
        nonlocal width
        width = w
        return hk.gram(hk.Separable(gaussian), X[:1], X[1:2])[0, 0, 0, 0]

    width = 0.0
    expected = 2.0 * np.exp(-0.5 * 0.3 * np.sum((X[0] - X[1]) ** 2))
    assert jax.jit(value)(0.3) == pytest.approx(float(expected), rel=1e-12)


def test_the_name_of_a_traced_closure_is_in_its_errors():
    def no_scalar(width):
        def wide(x, z):
            return width * x

        return hk.gram(hk.Symplectic(wide), X).sum()

    with pytest.raises(ValueError, match=r"the kernel wide returned an array of shape \(2,\)"):
        jax.grad(no_scalar)(1.0)


def test_a_function_that_closes_over_itself_is_left_alone():
    def polynomial(width):
        def power(s, exponent):
            return 1.0 if exponent == 0 else width * s * power(s, exponent - 1)

        return lambda x, z: power(1 + x @ z, 2)

    def value(width):
        return hk.fit(hk.Symplectic(polynomial(width)), X, Y, 1e-2).norm

    difference = (value(1.5 + STEP) - value(1.5 - STEP)) / (2 * STEP)
    np.testing.assert_allclose(jax.grad(value)(1.5), difference, rtol=1e-5)
