"""What is compiled for a GPU, read off the lowered program: no GPU is needed."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from data import swings

import hamkernel as hk
from hamkernel._machine import compiled_by_size, follow_data
from hamkernel._sizes import platform, sizes
from hamkernel._solvers import dense
from hamkernel._solvers.problem import make_problem
from hamkernel._solvers.triangle import cholesky_triangle, triangle
from hamkernel._tuning import search

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


def test_sizes_follow_the_device_of_the_data(monkeypatch):
    on_cpu = jax.device_put(X, jax.devices("cpu")[0])
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    tile = follow_data(lambda data: sizes().tile)
    assert tile({"x": np.asarray(X)}) == tile(jnp.zeros(2)) == jax.jit(tile)(on_cpu) == 4000
    assert tile({"n": 3, "x": on_cpu}) == 1000

    monkeypatch.setattr("hamkernel._sizes._GPU", None)  # no one may ask for these now
    field = hk.fit(K, on_cpu, Y, 1e-3)  # asks for the memory too
    assert field.evaluate(on_cpu).shape == hk.gram_operator(K, on_cpu).mv(Y).shape == X.shape


def test_a_program_can_be_compiled_with_options_on_a_gpu_alone(monkeypatch):
    monkeypatch.setattr("hamkernel._machine._options_are_known", None)  # nobody may ask
    assert compiled_by_size(lambda x: 2 * x, platforms=("gpu",))(jnp.ones(2)).sum() == 4
    with pytest.raises(TypeError):
        compiled_by_size(lambda x: 2 * x)(jnp.ones(2))


def test_on_a_gpu_memory_decides_what_is_factored_in_place(monkeypatch):
    problem = make_problem(K, X, Y, 1e-3)
    four = 4 * X.size**2 * 8
    monkeypatch.setattr(dense, "sizes", lambda: sizes()._replace(rows_in_place=None))
    for memory, expected in ((four, False), (four - 1, True), (None, False)):
        monkeypatch.setattr(dense, "memory_bytes", lambda memory=memory: memory)
        assert dense._is_in_place(problem) == expected


@pytest.mark.parametrize("digits", [2, 6, 10, 14])
def test_a_triangle_of_products_is_as_accurate_as_one_of_reflections(digits):
    # S = U R with R known, of condition 10^digits, and badly scaled columns.
    rng, k = np.random.default_rng(digits), 12
    R = np.triu(rng.uniform(-1, 1, (k, k)), 1) + np.eye(k)
    R = np.logspace(0, -digits, k)[:, None] * R * np.logspace(0, 3, k)
    U = np.linalg.qr(rng.normal(size=(60, k)))[0]
    S = U @ R

    def error(found):
        found = np.sign(np.diagonal(found))[:, None] * found
        return np.abs(found - R).max(axis=1) / np.abs(R).max(axis=1)

    made, peer = (
        error(np.asarray(cholesky_triangle(jnp.asarray(S)))),
        error(np.linalg.qr(S, mode="r")),
    )
    assert made.max() < 4 * peer.max() + 1e-14
    assert made.max() < 1e-15 * 10 ** (digits + 1)


@pytest.mark.parametrize(
    "S", [jnp.ones((6, 3)), jnp.zeros((6, 3)), jnp.eye(6)[:, :3].at[:, 1].set(0)]
)
def test_where_columns_are_dependent_reflections_take_over(S):
    R = cholesky_triangle(S)
    np.testing.assert_allclose(R.T @ R, S.T @ S, atol=1e-14)
    assert bool(jnp.isnan(cholesky_triangle(S.at[0, 0].set(jnp.nan))).any())


def test_a_triangle_is_made_of_products_on_a_gpu_alone():
    assert "dot_general" in lowered(triangle, jnp.ones((6, 3)), platform="cuda")
    assert "dot_general" not in lowered(triangle, jnp.ones((6, 3)), platform="cpu")


@pytest.mark.slow
def test_runs_side_by_side_are_computed_without_those_that_have_finished(monkeypatch):
    def tuned():
        return hk.tune(K, X, Y, starts=3)

    alone, widths = tuned(), []
    minimise = search._minimise

    def minimise_and_look(objective, minimiser, runs, *args):
        widths.append((len(runs.u), int(np.sum(runs.active))))
        return minimise(objective, minimiser, runs, *args)

    monkeypatch.setattr(search, "platform", lambda: "gpu")
    monkeypatch.setattr(search, "_minimise", minimise_and_look)
    np.testing.assert_allclose(tuned().loss, alone.loss, rtol=1e-3)
    design = max(width for width, _ in widths)
    assert {width for width, _ in widths} == {4, design}
    assert all(width == 4 for width, active in widths if active <= 3)
