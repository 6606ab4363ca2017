"""`simulate` asks a learned field for no more digits than it has."""

# pyright: reportArgumentType=false, reportAttributeAccessIssue=false, reportCallIssue=false
# pyright: reportOptionalSubscript=false, reportOptionalMemberAccess=false
# pyright: reportOperatorIssue=false
# Wrong types are refused here, and any field is looked into.

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import hamkernel as hk
from hamkernel._gram import field_rounding

HENON_HEILES = hk.systems.HenonHeiles()
START = jnp.array([0.1, 0.2, 0.3, 0.1])
TIMES = jnp.linspace(0.0, 100.0, 201)
EPS = np.finfo(float).eps


@pytest.fixture(scope="module")
def learned():
    """From 100 exact velocities, with the hyperparameters that `tune` finds for them."""
    X = jnp.asarray(np.random.default_rng(0).uniform(-1, 1, size=(100, 4)))
    return hk.fit(hk.Symplectic(hk.Gaussian(7.776)), X, jax.vmap(HENON_HEILES)(X), 4.2e-15)


def rounding(field, x):
    return field_rounding(field.kernel, x, field.points, field.coefficients, field(x))


def terms(K, x, field):
    """|K(x, zⱼ) aⱼ| summed over j, from the blocks of the Gram."""
    blocks = np.asarray(hk.gram(K, x[None], field.points))[0]  # (n, M, n)
    return np.abs(np.einsum("ajb,jb->ja", blocks, field.coefficients)).sum(axis=0)


def test_the_rounding_of_a_field_is_that_of_its_terms(learned):
    x = 2.0 * START
    share = EPS * np.linalg.norm(terms(learned.kernel, x, learned)) / np.linalg.norm(learned(x))
    assert 1e-9 < share < 1e-7
    np.testing.assert_allclose(rounding(learned, x), share, rtol=1e-6)


def test_of_an_odd_kernel_it_is_that_of_the_terms_before_they_cancel():
    X = jnp.asarray(np.random.default_rng(0).uniform(-1, 1, size=(20, 2)))
    plain = hk.Symplectic(hk.Gaussian(30.0))
    field = hk.fit(hk.Odd(plain), X, jnp.stack([X[:, 1], -X[:, 0]], axis=1), 1e-6)
    x = jnp.array([0.3, 0.2])
    share = EPS * np.linalg.norm(terms(plain, x, field)) / np.linalg.norm(field(x))
    np.testing.assert_allclose(rounding(field, x), share, rtol=1e-6)
    assert share > 10 * EPS * np.linalg.norm(terms(field.kernel, x, field)) / np.linalg.norm(
        field(x)
    )


def test_an_equilibrium_has_no_digits_and_is_simulated_to_six():
    X = jnp.asarray(np.random.default_rng(0).uniform(-1, 1, size=(20, 2)))
    field = hk.fit(hk.Odd(hk.Symplectic(hk.Gaussian(2.0))), X, jnp.stack([X[:, 1], -X[:, 0]], 1))
    assert rounding(field, jnp.zeros(2)) > 1e-6
    away = hk.simulate(field, jnp.array([1e-9, 0.0]), jnp.linspace(0, 6, 3)).ys
    np.testing.assert_allclose(away, 0.0, atol=1e-5)
    # 1e-10, as of every field that was not learned
    end, tight = (
        hk.simulate(HENON_HEILES, START, jnp.array([0.0, 5.0]), rtol=tolerance, atol=tolerance)
        for tolerance in (None, 1e-13)
    )
    np.testing.assert_allclose(end.ys[-1], tight.ys[-1], atol=1e-8)


def test_a_field_from_exact_data_is_simulated_in_few_steps_with_the_same_drift(learned):
    def run(**tolerances):
        solution = hk.simulate(learned, START, TIMES, **tolerances)
        energies = jax.vmap(HENON_HEILES.hamiltonian)(solution.ys)
        return int(solution.stats["num_steps"]), float(np.ptp(energies))

    steps, drift = run()
    # The negative control: tolerances that are given are kept, and these are beyond its digits.
    more, same = run(rtol=1e-10, atol=1e-10)
    assert steps < 0.3 * more
    np.testing.assert_allclose(drift, same, rtol=0.01)


def test_rounding_is_mapped_and_has_no_derivative(learned):
    starts = jnp.stack([START, 2 * START])
    mapped = jax.vmap(lambda x: rounding(learned, x))(starts)
    np.testing.assert_allclose(mapped, [rounding(learned, x) for x in starts], rtol=1e-9)
    assert not jax.grad(lambda x: rounding(learned, x))(START).any()
