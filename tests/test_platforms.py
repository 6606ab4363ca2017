"""What is compiled for a GPU, read off the lowered program: no GPU is needed."""

import equinox as eqx
import jax
import jax.numpy as jnp
import pytest
from data import swings

import hamkernel as hk
from hamkernel._sizes import platform, sizes

X, Y = map(jnp.asarray, swings(8))
K = hk.Symplectic(hk.Gaussian(1.0))


def lowered(function, *args, platform):
    return jax.jit(function).trace(*args).lower(lowering_platforms=(platform,)).as_text()


def fits(targets):
    return jax.vmap(lambda y: hk.fit(K, X, y, 1e-3, throw=False)(X[0]))(targets)


def likelihoods(lengthscales):
    return jax.vmap(
        jax.grad(lambda s: hk.log_marginal_likelihood(hk.Symplectic(hk.Gaussian(s)), X, Y, 1e-3))
    )(lengthscales)


# A function, its batch, and the type of an operand that only a batch of solves has.
BATCHES = {
    "fits": (fits, jnp.stack([Y] * 5), "tensor<16x16xf64>, tensor<16x5xf64>"),
    "gradients": (likelihoods, jnp.linspace(0.5, 2.0, 5), "tensor<5x16x16xf64>, tensor<5xi32>"),
}


@pytest.mark.parametrize("name", BATCHES)
def test_factorisations_of_a_batch_run_together_on_a_gpu_and_one_by_one_on_a_cpu(name, monkeypatch):
    # Checks of traced arguments call back into Python, which cannot be lowered for a device that is
    # not there.
    monkeypatch.setattr(eqx, "error_if", lambda x, bad, message: x)
    function, batch, batched = BATCHES[name]
    assert batched in lowered(function, batch, platform="cuda")
    assert batched not in lowered(function, batch, platform="cpu")


def test_sizes_follow_the_default_device(monkeypatch):
    with jax.default_device(jax.devices("cpu")[0]):
        assert platform() == "cpu"
        assert sizes().tile == 1000
    monkeypatch.setattr("hamkernel._sizes.platform", lambda: "gpu")
    assert sizes().tile > 1000
