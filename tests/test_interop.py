"""Kernel objects of GPJax and tinygp serve as scalar kernels, or are refused with the reason."""

import importlib
import warnings

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import hamkernel as hk

RNG = np.random.default_rng(4)
X = RNG.normal(size=(15, 2))
Y = RNG.normal(size=(15, 2))
LENGTHSCALE = 1.3
# The Gaussian written in two ways, after a solve with a Gram of condition 1e3.
AGREEMENT = 1e-10


def foreign(package):
    """The module with the kernels. GPJax warns of its own dependencies when it is imported."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        pytest.importorskip(package, exc_type=ImportError)
        return importlib.import_module(f"{package}.kernels")


def gaussian(package):
    kernels = foreign(package)
    if package == "tinygp":
        return kernels.ExpSquared(scale=jnp.asarray(LENGTHSCALE))
    return kernels.RBF(lengthscale=LENGTHSCALE)


def materns(package):
    """Each with the fault that its second derivatives have at x = z."""
    kernels = foreign(package)
    if package == "gpjax":
        return {r"zero block.*M\(x, x\).*hk\.Matern": kernels.Matern52(lengthscale=LENGTHSCALE)}
    euclidean = kernels.distance.L2Distance()
    return {
        r"no second derivative at x = z.*L1 distance": kernels.Matern52(scale=LENGTHSCALE),
        r"rank-one block.*M\(x, x\).*hk\.Matern": kernels.Matern52(LENGTHSCALE, euclidean),
    }


packages = pytest.mark.parametrize("package", ["tinygp", "gpjax"])
structures = pytest.mark.parametrize(
    "structure",
    [hk.Symplectic, hk.CurlFree, lambda k: hk.Odd(hk.Symplectic(k))],
    ids=["symplectic", "curl-free", "odd symplectic"],
)


@pytest.mark.few(2)
@packages
@structures
def test_their_gaussian_learns_the_field_of_ours(package, structure):
    theirs = hk.fit(structure(gaussian(package)), X, Y, 1e-2)
    ours = hk.fit(structure(hk.Gaussian(LENGTHSCALE)), X, Y, 1e-2)
    states = jnp.asarray(RNG.normal(size=(9, 2)))
    np.testing.assert_allclose(
        jax.vmap(theirs)(states), jax.vmap(ours)(states), rtol=0, atol=AGREEMENT
    )
    np.testing.assert_allclose(
        jax.vmap(theirs.potential)(states), jax.vmap(ours.potential)(states), atol=AGREEMENT
    )


@packages
def test_their_gaussian_is_sound(package):
    hk.check_kernel(gaussian(package), X)


@packages
def test_their_matern_is_refused_with_the_reason(package):
    # Exact would be 5/(3ℓ²) I. tinygp measures Σ|xₐ − zₐ| unless it is told otherwise, and falls
    # back to it at x = z; GPJax has a constant there.
    for reason, kernel in materns(package).items():
        with pytest.raises(ValueError, match=reason):
            hk.check_kernel(kernel, X)


@packages
def test_the_matern_of_this_library_is_sound_there(package):
    foreign(package)
    hk.check_kernel(hk.Matern(2.5, LENGTHSCALE), X)


def test_a_method_that_is_called_evaluate_changes_nothing_in_a_kernel_of_ones_own():
    class Own(eqx.Module):
        def __call__(self, x, z):
            return jnp.exp(x @ z)

        def evaluate(self, x, z):
            return 3 * jnp.exp(x @ z)

    x, z = X[0], X[1]
    np.testing.assert_allclose(hk.Separable(Own())(x, z)[0, 0], np.exp(x @ z), rtol=1e-14)


@packages
def test_their_hyperparameters_are_leaves_that_a_loss_is_differentiated_by(package):
    leaves, structure = jax.tree.flatten(hk.Symplectic(gaussian(package)))
    trained = [i for i, leaf in enumerate(leaves) if eqx.is_inexact_array(leaf)]
    assert trained

    def loss(factor):
        scaled = [leaf * factor if i in trained else leaf for i, leaf in enumerate(leaves)]
        return hk.cross_validation_loss(jax.tree.unflatten(structure, scaled), X, Y, 1e-2, 5)

    step = 1e-6
    difference = (loss(1.0 + step) - loss(1.0 - step)) / (2 * step)
    np.testing.assert_allclose(jax.grad(loss)(1.0), difference, rtol=1e-6)


def test_a_kernel_of_tinygp_prints_as_it_is_written():
    kernel = foreign("tinygp").ExpSquared(scale=jnp.asarray(LENGTHSCALE))
    written = "Odd(CurlFree(ExpSquared(scale=1.3, distance=L2Distance())))"
    assert repr(hk.Odd(hk.CurlFree(kernel))) == written
