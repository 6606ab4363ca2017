"""One thread of BLAS while the library computes, and the caller's number again afterwards."""

import threading
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import hamkernel as hk
from hamkernel import _machine
from hamkernel._machine import one_blas_thread

X = np.random.default_rng(0).normal(size=(12, 2))
Y = X @ np.array([[0.0, -1.0], [1.0, 0.0]])
K = hk.Symplectic(hk.Gaussian(1.5))


def now() -> list[int]:
    return [pool.num_threads for pool in _machine._controller().lib_controllers]


@pytest.fixture(autouse=True)
def two_threads():
    """As many as a user has, although the tests run with one."""
    controller = _machine._controller()
    with controller.limit(limits=2, user_api="blas"):
        assert set(now()) == {2}
        yield
        assert set(now()) == {2}


def test_inside_there_is_one_and_afterwards_as_many_as_before():
    assert set(one_blas_thread(now)()) == {1}
    assert set(now()) == {2}


def test_after_an_error_too():
    @one_blas_thread
    def fails():
        raise KeyError("x")

    with pytest.raises(KeyError):
        fails()
    assert set(now()) == {2}


def test_calls_inside_of_calls_restore_once():
    @one_blas_thread
    def outer():
        before = one_blas_thread(now)()
        return before, now()  # the inner call has not given the threads back

    inner, after = outer()
    assert set(inner) == set(after) == {1}


def test_a_call_of_another_thread_does_not_give_back_those_of_this_one():
    # OpenBLAS lets the thread that limited it first say how many there are.
    @one_blas_thread
    def outer():
        other = threading.Thread(target=one_blas_thread(now))
        other.start()
        other.join(10)
        return now()

    assert set(outer()) == {1}
    assert set(now()) == {2}


CALLS = {
    "fit": lambda: hk.fit(K, X, Y, 1e-3),
    "condition": lambda: hk.condition(hk.Symplectic(2.0 * hk.Gaussian(1.5)), X, Y, 1e-3),
    "loss": lambda: hk.cross_validation_loss(K, X, Y, 1e-3),
    "likelihood": lambda: hk.log_marginal_likelihood(K, X, Y, 1e-3),
    "tune": lambda: hk.tune(K, X, Y, starts=1, max_steps=1),
}


@pytest.mark.few(1)
@pytest.mark.parametrize("name", CALLS)
def test_public_calls_that_factor_run_on_one(name, monkeypatch):
    seen = []
    limited = _machine._one_thread

    def spied():
        seen.append(True)
        return limited()

    monkeypatch.setattr(_machine, "_one_thread", spied)
    CALLS[name]()
    assert seen


def test_results_are_there_when_the_threads_are_given_back():
    field = hk.fit(K, X, Y, 1e-3)
    arrays: list[Any] = [a for a in jax.tree.leaves(field) if isinstance(a, jax.Array)]
    assert all(a.is_ready() for a in arrays)


def test_under_the_callers_jit_nothing_is_limited_while_it_runs():
    run = jax.jit(lambda ridge: hk.fit(K, X, Y, ridge).coefficients)
    expected = hk.fit(K, X, Y, 1e-3).coefficients
    np.testing.assert_allclose(run(jnp.asarray(1e-3)), expected, atol=1e-10)
    assert set(now()) == {2}
