"""Plain functions that close over what JAX differentiates or maps over."""

import functools
import itertools
import math

import equinox as eqx
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


@pytest.mark.few(1)
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


@pytest.mark.slow
def test_a_function_that_closes_over_itself_is_left_alone():
    def polynomial(width):
        def power(s, exponent):
            return 1.0 if exponent == 0 else width * s * power(s, exponent - 1)

        return lambda x, z: power(1 + x @ z, 2)

    def value(width):
        return hk.fit(hk.Symplectic(polynomial(width)), X, Y, 1e-2).norm

    difference = (value(1.5 + STEP) - value(1.5 - STEP)) / (2 * STEP)
    np.testing.assert_allclose(jax.grad(value)(1.5), difference, rtol=1e-5)


def closure(width):
    return lambda power, x, z: jnp.exp(-power * (x - z) @ (x - z) / width**2)


def in_a_partial(width):
    return functools.partial(closure(width), 0.5)


def in_a_function(width):
    gaussian = closure(width)
    return lambda x, z: gaussian(0.5, x, z)


def in_a_function_and_a_partial(width):
    gaussian = in_a_partial(width)
    return lambda x, z: gaussian(x, z)


@pytest.mark.few(2)
@pytest.mark.parametrize("kernel", [in_a_partial, in_a_function, in_a_function_and_a_partial])
def test_what_closes_over_the_differentiated_may_be_inside_of_a_partial_or_function(kernel):
    @jax.jit
    def value(width):
        return hk.log_marginal_likelihood(hk.Separable(kernel(width)), X, Y, 1e-2)

    difference = (value(1.5 + STEP) - value(1.5 - STEP)) / (2 * STEP)
    np.testing.assert_allclose(jax.grad(value)(1.5), difference, rtol=1e-6)


def test_functions_that_close_over_each_other_are_left_alone():
    def even(s, exponent):
        return 1.0 if exponent == 0 else s * odd(s, exponent - 1)

    def odd(s, exponent):
        return 0.5 * s * even(s, exponent - 1)

    gram = hk.gram(hk.Separable(lambda x, z: even(1 + x @ z, 2)), X)
    np.testing.assert_allclose(gram[:, 0, :, 0], 0.5 * (1 + X @ X.T) ** 2, rtol=1e-12)


def test_a_function_may_name_what_has_no_value_yet():
    K = hk.Separable(lambda x, z: width + x @ z)
    width = 0.5
    np.testing.assert_allclose(hk.gram(K, X)[:, 0, :, 0], 0.5 + X @ X.T, rtol=1e-12)


@pytest.mark.parametrize(
    "kernel",
    [
        lambda x, z: np.exp(-np.sum((x - z) ** 2)),
        lambda x, z: math.exp(-jnp.sum((x - z) ** 2)),
        lambda x, z: jnp.exp(-x @ z) if x @ z > 0 else 1.0,
        hk.Warp(hk.Gaussian(), lambda x: jnp.array([math.cos(x[0]), x[1]])),
        hk.Shared(hk.Gaussian(), lambda x: np.array([[x[0]], [x[1]]])),
    ],
)
def test_functions_of_a_kernel_that_jax_cannot_trace_are_told_to_use_jax_numpy(kernel):
    with pytest.raises(TypeError, match=r"jax\.numpy in place of numpy.*jnp\.where"):
        hk.fit(hk.Symplectic(kernel), np.eye(2), np.eye(2), 1e-4)


def test_a_matrix_of_lists_is_a_matrix():
    K = [
        hk.Structured(hk.Gaussian(), lambda x, wrap=wrap: wrap([[0, x[0]], [-x[0], 0]]))
        for wrap in (list, jnp.array)
    ]
    X = np.eye(2) + 0.1
    of_lists, of_arrays = (hk.gram(each, X) for each in K)
    np.testing.assert_array_equal(of_lists, of_arrays)


def test_one_function_makes_the_same_kernel_again():
    # So that it is compiled once. One made anew, as a lambda of each call, is another kernel.
    def made(width):
        return lambda x, z: jnp.exp(-((x - z) @ (x - z)) / width)

    one, other = made(2.0), made(2.0)
    same = [jax.tree.structure(hk.Symplectic(k)) for k in (one, one, other)]
    assert same[0] == same[1] != same[2]


def network():
    mlp = eqx.nn.MLP(2, 3, 4, 2, activation=jnp.tanh, key=jax.random.key(0))
    return hk.Symplectic(hk.Warp(hk.Gaussian(1.0), mlp))


@pytest.mark.slow
def test_jax_grad_passes_the_functions_inside_a_kernel():
    K, norm = network(), lambda K: hk.gram(K, X[:3])[0, 0, 0, 0]
    gradient = jax.grad(norm)(K)
    ahead, behind = (
        eqx.tree_at(lambda K: K.kernel.fn.layers[0].bias, K, replace_fn=lambda b, s=s: b + s)
        for s in (STEP, -STEP)
    )
    slope = (norm(ahead) - norm(behind)) / (2 * STEP)
    np.testing.assert_allclose(gradient.kernel.fn.layers[0].bias.sum(), slope, atol=DIFFERENCES)
    assert not [leaf for leaf in jax.tree.leaves(K) if not eqx.is_array(leaf)]


def test_a_deep_kernel_prints_in_one_line():
    line = "Symplectic(Warp(Gaussian(lengthscale=1), fn=MLP(47 parameters in 6 arrays)))"
    assert repr(network()) == line
