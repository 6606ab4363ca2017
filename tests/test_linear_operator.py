"""`Structured` with an operator (u, x): any linear operator on a potential, of any order."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import hamkernel as hk

J = jnp.array([[0.0, 1.0], [-1.0, 0.0]])
X = jnp.asarray(np.random.default_rng(0).uniform(-1.5, 1.5, (40, 2)))


def flow(u, x):
    """J∇(u − ∂²u/∂x²), of order three."""
    return J @ jax.grad(lambda x: u(x) - jax.grad(lambda x: jax.grad(u)(x)[0])(x)[0])(x)


def truth(X):
    """u = sin x cos y has ∂²u/∂x² = −u, so the field is 2 J∇u."""
    x, y = np.asarray(X).T
    return 2 * np.stack([-np.sin(x) * np.sin(y), -np.cos(x) * np.cos(y)], axis=1)


@pytest.fixture(scope="module")
def field():
    K = hk.Structured(hk.Gaussian(1.5), flow)
    return hk.fit(K, X, jnp.asarray(truth(X)), regularization=1e-12)


def test_of_first_order_it_is_the_kernel_of_the_matrix():
    def B(x):
        return jnp.array([[0.0, 1.0], [-1.0, -jnp.exp(x[0])]])

    fast = hk.Structured(hk.Matern(2.5), B)
    general = hk.Structured(hk.Matern(2.5), lambda u, x: B(x) @ jax.grad(u)(x))
    grams = [np.asarray(hk.gram(K, X[:9])) for K in (fast, general)]
    np.testing.assert_allclose(*grams, rtol=0, atol=1e-13 * np.abs(grams[0]).max())


def test_a_symmetric_kernel_is_that_of_the_matrix_in_products_too():
    k = hk.Invariant(hk.Gaussian(1.0), [np.diag([-1.0, 1.0])])
    kernels = hk.CurlFree(k), hk.Structured(k, lambda u, x: jax.grad(u)(x))
    wanted, product = (np.asarray(hk.gram_operator(K, X[:9]).mv(X[:9])) for K in kernels)
    np.testing.assert_allclose(product, wanted, rtol=0, atol=1e-13 * np.abs(wanted).max())


def test_a_field_of_third_order_and_its_potential_are_found(field):
    new = np.random.default_rng(1).uniform(-1, 1, (50, 2))
    assert np.abs(np.asarray(field.evaluate(new)) - truth(new)).max() < 1e-3

    # The potential is known up to a constant, and up to the functions with u = ∂²u/∂x². So
    # u − ∂²u/∂x², by differences, is compared: 2 sin x cos y up to a constant.
    h, u = 1e-2, jax.jit(jax.vmap(field.potential))
    e = np.array([[h, 0.0]])
    right, here, left = (np.asarray(u(new + shift * e)) for shift in (1, 0, -1))
    error = here - (right + left - 2 * here) / h**2 - 2 * np.sin(new[:, 0]) * np.cos(new[:, 1])
    assert np.ptp(error) < 2e-3


def test_the_structure_holds_and_not_in_a_multiple_of_the_field(field):
    # div J∇(…) = 0 to rounding, for every field, and not for x f(x).
    far = jnp.array([2.5, -2.0])
    jacobian = np.asarray(jax.jit(jax.jacfwd(field))(far))
    divergences = np.trace(jacobian), np.trace(jacobian * far[0]) + field(far)[0]
    assert abs(divergences[0]) < 1e-9 < 1e-3 < abs(divergences[1])


def test_what_cannot_be_is_refused():
    Y = jnp.asarray(truth(X))

    def fit(k, operator):
        return hk.fit(hk.Structured(k, operator), X, Y)

    with pytest.raises(ValueError, match="not linear in u"):
        fit(hk.Gaussian(1.0), lambda u, x: jax.grad(u)(x) * u(x))
    with pytest.raises(ValueError, match="not linear in u"):
        fit(hk.Gaussian(1.0), lambda u, x: jax.grad(u)(x) + x)
    with pytest.raises(ValueError, match=r"returned shape \(\); .*of shape \(2,\)"):
        fit(hk.Gaussian(1.0), lambda u, x: u(x))
    with pytest.raises(ValueError, match=r"too few derivatives|too rough"):
        fit(hk.Matern(1.5), lambda u, x: jax.hessian(u)(x) @ jnp.ones(2))
    with pytest.raises(TypeError, match="cannot be odd or even"):
        hk.Odd(hk.Structured(hk.Gaussian(1.0), flow))


@pytest.mark.slow
def test_arrays_of_the_operator_are_tuned():
    class Flow(eqx.Module):
        log_length: jax.Array

        def __call__(self, u, x):
            a = jnp.exp(2 * self.log_length)
            return J @ jax.grad(lambda x: u(x) - a * jnp.trace(jax.hessian(u)(x)))(x)

    K = hk.Structured(2.0 * hk.Gaussian(1.5), Flow(jnp.asarray(-0.5)))

    def loss(K):
        return hk.log_marginal_likelihood(K, X[:12], jnp.asarray(truth(X[:12])), 1e-3)

    slope = eqx.filter_grad(loss)(K).operator.log_length
    moved = [eqx.tree_at(lambda K: K.operator.log_length, K, -0.5 + h) for h in (1e-5, -1e-5)]
    numeric = (loss(moved[0]) - loss(moved[1])) / 2e-5
    np.testing.assert_allclose(slope, numeric, rtol=1e-5)
