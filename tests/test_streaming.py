"""Fits to chunks on landmarks: the one fit to all, from a stream of any form, and what it costs."""

import json
import subprocess
import sys
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from data import swings

import hamkernel as hk
from hamkernel import LandmarkFit, Nystrom, RandomFeatures
from hamkernel._gram import gram_of_rows, rows_between
from hamkernel._observations.blocks import Components
from hamkernel._observations.measurements import measurements_of

K = hk.Symplectic(hk.Gaussian(1.5))
RIDGE = 1e-4
# The condition of the low-rank system is at most trace K(x, x)/λ, here 1e4; times rounding, and
# what a thousand sums add to it.
ROUNDING = 1e-10
# The root of the condition of the landmarks' Gram, here 1e6, times rounding, and what a thousand
# sums add to it. Exact arithmetic of 60 digits puts NumPy and this library 2e-9 and 3e-9 off.
BASIS = 2e-8


def chunks(X, Y, size):
    for start in range(0, len(X), size):
        yield X[start : start + size], Y[start : start + size]


def given(points):
    """Few landmarks: these tests are about what is done with them."""
    return Nystrom(tolerance=1e9, points=points)


def relative(a, b):
    return np.linalg.norm(np.asarray(a) - np.asarray(b)) / np.linalg.norm(b)


NEW = swings(50, seed=9)[0]
# Few shapes, so that little is compiled: 600 points in chunks of 200, on 30 landmarks.
X, Y = swings(600)
S = X[::20]


@pytest.mark.parametrize(
    "name",
    [
        "symplectic",
        *(pytest.param(name, marks=pytest.mark.slow) for name in ("odd", "sum", "separable")),
    ],
)
def test_a_fit_to_chunks_is_the_fit_to_all(name):
    K = {
        "symplectic": hk.Symplectic(hk.Gaussian(1.5)),
        "odd": hk.Odd(hk.Symplectic(hk.Gaussian(1.5))),
        "sum": hk.CurlFree(hk.Gaussian(2.0)) + hk.Symplectic(hk.Matern(2.5, 2.0)),
        "separable": hk.Separable(hk.RationalQuadratic(1.0, 2.0)),
    }[name]
    whole: Any = hk.fit(K, X, Y, RIDGE, solver=given(S))
    streamed: Any = given(S).fit_chunks(K, chunks(X, Y, 200), RIDGE)
    assert relative(streamed.evaluate(NEW), whole.evaluate(NEW)) < ROUNDING
    np.testing.assert_allclose(streamed.norm, whole.norm, rtol=ROUNDING)
    np.testing.assert_allclose(streamed.info.truncation, whole.info.truncation, rtol=1e-6)
    assert streamed.info.solver == "Nystrom"
    assert streamed.info.rank == whole.info.rank
    assert streamed.residual.shape == (0, 2)
    np.testing.assert_allclose(streamed.residual_norm, whole.residual_norm, rtol=1e-6)
    if name in ("symplectic", "odd"):
        x = jnp.asarray(NEW[0])
        q_slope, p_slope = jax.grad(streamed.hamiltonian)(x)
        np.testing.assert_allclose(streamed(x), [p_slope, -q_slope], atol=1e-12)


@pytest.mark.slow
def test_landmarks_chosen_from_a_sample_are_those_chosen_from_the_data():
    whole: Any = hk.fit(K, X, Y, RIDGE, solver=Nystrom())
    streamed: Any = Nystrom().fit_chunks(K, chunks(X, Y, 200), RIDGE, sample=X)
    np.testing.assert_array_equal(streamed.points, whole.points)
    assert relative(streamed.evaluate(NEW), whole.evaluate(NEW)) < ROUNDING


def low_rank(X, field):
    """C = G_XS, G_SS and F on the columns in use, in NumPy."""
    used = np.abs(np.asarray(field.coefficients).ravel()) > 0
    C = np.asarray(hk.gram(K, X, field.points)).reshape(X.size, -1)[:, used]
    G = np.asarray(hk.gram(K, field.points)).reshape(len(used), -1)[np.ix_(used, used)]
    return C, G, np.linalg.solve(np.linalg.cholesky(G), C.T).T


def least_squares(rows, targets, ridge):
    r = rows.shape[1]
    stacked = np.concatenate([rows, np.sqrt(ridge) * np.eye(r)])
    return np.linalg.lstsq(stacked, np.append(targets, np.zeros(r)), rcond=None)[0]


def test_the_field_is_that_of_numpy_and_not_that_of_a_part_of_the_data():
    field: Any = given(S).fit_chunks(K, chunks(X, Y, 200), RIDGE)
    _, _, F = low_rank(X, field)
    values, ridge = np.asarray(field.evaluate(X)).ravel(), len(X) * RIDGE
    assert relative(values, F @ least_squares(F, Y, ridge)) < BASIS
    part = least_squares(F[:800], Y[:400], ridge)
    assert relative(values, F @ part) > 1e-4


def test_digits_survive_a_small_ridge():
    """At λ = 1e-11 the normal equations in the coefficients keep five digits."""
    field: Any = given(S).fit_chunks(K, chunks(X, Y, 200), 1e-11)
    C, G, F = low_rank(X, field)
    ridge = len(X) * 1e-11
    values = F @ least_squares(F, Y, ridge)
    assert relative(np.asarray(field.evaluate(X)).ravel(), values) < BASIS
    alpha = np.linalg.solve(C.T @ C + ridge * G, C.T @ Y.ravel())
    assert relative(C @ alpha, values) > 10 * BASIS


@pytest.mark.slow
def test_sums_in_the_basis_of_a_sample_keep_the_digits_of_a_qr():
    """At λ = 1e-13 the same sums in the basis that they come in lose four digits more."""
    waves, regularization = hk.RandomFeatures(40, jax.random.key(0)), 1e-13
    design: Any = hk.fit(K, X[:1], Y[:1], RIDGE, solver=waves).features
    rows = np.asarray(design(jnp.asarray(X))).reshape(X.size, -1)
    values = rows @ least_squares(rows, Y, len(X) * regularization)

    def off(start):
        model = waves.start(K, X, start)
        for x, y in chunks(X, Y, 200):
            model = model.add(x, y)
        return relative(np.asarray(model.field(regularization).evaluate(X)).ravel(), values)

    assert off(regularization) < 1e-12
    assert off(1e6) > 1e-10  # a multiple of the identity


def observed():
    """Chunks: masked and noisy velocities; sums along paths and an equilibrium."""
    masked = np.where(np.arange(Y[:100].size).reshape(-1, 2) % 3 == 0, np.nan, Y[:100])
    noise = np.random.default_rng(0).uniform(0.5, 2, size=masked.shape)
    weights = np.random.default_rng(1).normal(size=(20, 2, 3, 2))
    paths = X[100:160].reshape(20, 3, 2)
    targets = np.einsum("srqa,sqa->sr", weights, Y[100:160].reshape(20, 3, 2))
    return [
        hk.Velocities(X[:100], masked, noise=noise),
        hk.Functionals(paths, weights, targets) + hk.Equilibria(np.zeros(2)),
    ]


@pytest.mark.slow
@pytest.mark.parametrize(
    "solver",
    [
        pytest.param(given(S), id="landmarks"),
        pytest.param(
            hk.RandomFeatures(30, jax.random.key(0)), id="features", marks=pytest.mark.slow
        ),
    ],
)
def test_observations_in_chunks_are_the_fit_to_their_sum(solver):
    first, second = observed()
    model = solver.start(K, X, RIDGE).add(first).add(second).add(X[200:400], Y[200:400])
    field: Any = model.field()
    every = first + second + hk.Velocities(X[200:400], Y[200:400])
    whole: Any = hk.fit(K, every, regularization=RIDGE, solver=solver)
    assert relative(field.evaluate(NEW), whole.evaluate(NEW)) < 100 * ROUNDING
    part: Any = hk.fit(K, first + second, regularization=RIDGE, solver=solver)
    assert relative(part.evaluate(NEW), whole.evaluate(NEW)) > 1e-4
    assert int(model.count) == 100 + 40 + 1 + 200
    if field.info.truncation is not None:
        rows = measurements_of(K, every)[1]
        G, C = gram_of_rows(K, rows), rows_between(K, rows, Components(jnp.asarray(S)))
        G_SS = np.asarray(hk.gram(K, S)).reshape(S.size, -1)
        covered = np.trace(C @ np.linalg.pinv(G_SS, rcond=1e-13, hermitian=True) @ C.T)
        expected = (np.trace(G) - covered) / (341 * RIDGE)
        np.testing.assert_allclose(field.info.truncation, expected, rtol=1e-2)


@pytest.mark.slow
def test_a_stream_may_start_from_observations_whose_rows_are_the_landmarks():
    first, _ = observed()
    rough, X3 = hk.Symplectic(100.0 * hk.Matern(1.5, 1.0)), hk.Velocities(X[:3], Y[:3])
    exact = hk.fit(rough, first + X3, regularization=RIDGE)
    model = Nystrom(1e-6).start(rough, first + X3, RIDGE).add(first).add(X[:3], Y[:3])
    assert relative(model.field().evaluate(NEW), exact.evaluate(NEW)) < 1e-4
    of_points = Nystrom(1e-6).start(rough, X[:3], RIDGE).add(first).add(X[:3], Y[:3])
    with pytest.warns(UserWarning, match="landmarks leave"):
        assert relative(of_points.field().evaluate(NEW), exact.evaluate(NEW)) > 1e-2
    with pytest.raises(ValueError, match="takes no energies"):
        Nystrom().start(rough, hk.Energies(X[:5], Y[:5, 0]), RIDGE)


def test_a_stream_refuses_energies_and_other_systems():
    model = given(S).start(K, X, RIDGE)
    with pytest.raises(ValueError, match=r"takes no energies.*Functionals"):
        model.add(hk.Energies(X[:3], Y[:3, 0]) + hk.Velocities(X[:3], Y[:3]))
    with pytest.raises(ValueError, match="4 coordinates and the fit 2"):
        model.add(hk.Velocities(np.ones((3, 4)), np.ones((3, 4)), noise=2.0))


def test_data_and_ridge_may_change_after_the_fit():
    model = given(S).start(K, X).add(X[:200], Y[:200]).add(X[200:400], Y[200:400])
    before, after = model.field(1e-2), model.add(X[400:], Y[400:]).field(RIDGE)
    expected = hk.fit(K, X[:400], Y[:400], 1e-2, solver=given(S))
    assert relative(before.evaluate(NEW), expected.evaluate(NEW)) < ROUNDING
    expected = hk.fit(K, X, Y, RIDGE, solver=given(S))
    assert relative(after.evaluate(NEW), expected.evaluate(NEW)) < ROUNDING
    assert relative(before.evaluate(NEW), after.evaluate(NEW)) > 1e-3


def test_the_ridge_is_that_of_the_start_unless_another_one_is_asked_for():
    model = given(S).start(K, X, 1e-2).add(X[:200], Y[:200])
    assert model.field().regularization == 1e-2
    assert model.field(1e-3).regularization == 1e-3


@pytest.mark.few(1)
@pytest.mark.parametrize(
    ("solver", "size"),
    [(given(S), "landmarks=30"), (hk.RandomFeatures(20, jax.random.key(0)), "features=40")],
    ids=["nystrom", "features"],
)
def test_both_solvers_stream_with_the_same_words(solver: Nystrom | RandomFeatures, size):
    model = solver.start(K, X, RIDGE)
    for x, y in chunks(X, Y, 200):
        model = model.add(x, y)
    assert int(model.count) == 600
    assert model.dimension == 2
    kernel = "kernel=Symplectic(Gaussian(lengthscale=1.5))"
    assert repr(model) == f"{type(model).__name__}({kernel}, {size}, added=600)"
    jax.eval_shape(lambda model: repr(model) and model.count, model)
    field = model.field()
    whole = hk.fit(K, X, Y, RIDGE, solver=solver)
    assert relative(field.evaluate(NEW), whole.evaluate(NEW)) < ROUNDING
    streamed = solver.fit_chunks(K, chunks(X, Y, 200), RIDGE, sample=X)
    np.testing.assert_array_equal(streamed.evaluate(NEW), field.evaluate(NEW))


@pytest.mark.slow
def test_landmarks_of_the_first_chunk_do_where_chunks_are_alike():
    field: Any = Nystrom(tolerance=0.01).fit_chunks(K, chunks(X, Y, 200), RIDGE)
    assert field.info.truncation < 0.2  # seen on all of the data
    exact = hk.fit(K, X, Y, RIDGE)
    assert relative(field.evaluate(NEW), exact.evaluate(NEW)) < 1e-3  # a tenth of the noise


@pytest.mark.slow
def test_a_first_chunk_that_is_not_like_the_rest_is_said():
    order = np.argsort(X[:, 0])
    with pytest.warns(UserWarning, match="from a sample that looks like the data so far"):
        narrow: Any = Nystrom(0.01).fit_chunks(K, chunks(X[order], Y[order], 200), RIDGE)
    spread: Any = Nystrom(0.01).fit_chunks(
        K, chunks(X[order], Y[order], 200), RIDGE, sample=X[:200]
    )
    assert spread.info.truncation < 0.2 < 100 < narrow.info.truncation


@pytest.mark.slow
def test_warnings_name_the_line_of_the_user():
    with pytest.warns(UserWarning, match="fitting in float32") as warned:
        Nystrom().start(K, X[:200].astype(np.float32), 1e-2)
    few = Nystrom(0.01, max_points=4)
    model = few.start(K, X, RIDGE).add(X[:200], Y[:200])
    for ask in (
        lambda: model.field(),
        lambda: few.fit_chunks(K, [(X[:200], Y[:200])], RIDGE),
        lambda: hk.fit(K, X[:200], Y[:200], RIDGE, solver=few),
    ):
        with pytest.warns(UserWarning, match="4 landmarks leave") as truncated:
            ask()
        assert [warning.filename for warning in (*warned, *truncated)] == [__file__] * 2


def test_memory_mapped_files_and_a_shorter_last_chunk(tmp_path):
    np.save(tmp_path / "X.npy", X[:450])
    np.save(tmp_path / "Y.npy", Y[:450])
    states, velocities = (np.load(tmp_path / f"{name}.npy", mmap_mode="r") for name in "XY")
    field = given(S).fit_chunks(K, chunks(states, velocities, 200), RIDGE)
    whole = hk.fit(K, X[:450], Y[:450], RIDGE, solver=given(S))
    assert relative(field.evaluate(NEW), whole.evaluate(NEW)) < ROUNDING


def test_progress_is_shown_on_request_on_a_terminal(monkeypatch, capsys):
    monkeypatch.setattr(sys.stderr, "isatty", lambda: True, raising=False)
    given(S).fit_chunks(K, chunks(X, Y, 200), RIDGE)
    assert capsys.readouterr().err == ""
    given(S).fit_chunks(K, list(chunks(X, Y, 200)), RIDGE, progress=True)
    assert "3/3" in capsys.readouterr().err
    monkeypatch.setattr(sys.stderr, "isatty", lambda: False, raising=False)
    given(S).fit_chunks(K, chunks(X, Y, 200), RIDGE, progress=True)
    assert capsys.readouterr().err == ""


def test_the_size_of_a_fit_ignores_the_data():
    model = given(S).start(K, X)

    def numbers(model):
        return [leaf.shape for leaf in jax.tree.leaves(model)]

    assert isinstance(model, LandmarkFit)
    assert numbers(model) == numbers(model.add(X[:200], Y[:200]))


# Given landmarks.


def test_given_landmarks_carry_the_field_and_repeated_ones_are_left_out():
    once: Any = hk.fit(K, X, Y, RIDGE, solver=given(S))
    np.testing.assert_array_equal(once.points, S)
    assert (int(once.info.landmarks), int(once.info.rank)) == (30, 60)
    twice: Any = hk.fit(K, X, Y, RIDGE, solver=given(np.concatenate([S, S])))
    assert (int(twice.info.landmarks), int(twice.info.rank)) == (30, 60)
    assert relative(twice.evaluate(NEW), once.evaluate(NEW)) < BASIS


# Refusals.


def test_what_makes_no_sense_is_refused():
    solver = given(S)
    with pytest.raises(ValueError, match="at least one chunk"):
        solver.fit_chunks(K, [])
    with pytest.raises(ValueError, match="no data yet"):
        solver.start(K, X).field()
    with pytest.raises(ValueError, match="the data have 4 coordinates and the fit 2"):
        solver.start(K, X).add(*swings(10, n=4))
    with pytest.raises(ValueError, match="have 2 coordinates and X 4"):
        hk.fit(K, *swings(10, n=4), RIDGE, solver=solver)
    with pytest.raises(ValueError, match="NaN or inf in row 3"):
        solver.start(K, np.where(np.arange(600)[:, None] == 3, np.nan, X))
    with pytest.raises(ValueError, match="even"):
        solver.start(K, X[:, :1])
    with pytest.raises(TypeError, match="matrix-valued"):
        solver.start(hk.Gaussian(1.0), X)  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="regularization must be positive"):
        solver.start(K, X, -1.0)
    indefinite = hk.CurlFree(lambda x, z: -jnp.exp(x @ z))
    with pytest.raises(RuntimeError, match="check_kernel"):
        solver.start(indefinite, X).add(X[:200], Y[:200]).field(RIDGE)


def test_an_error_in_a_stream_says_in_which_chunk_it_is():
    good, hole = (X[:9], Y[:9]), (X[:9], np.where(np.arange(9)[:, None] == 7, np.nan, Y[:9]))
    with pytest.raises(ValueError, match="chunk 2, counted from 0: Y contains NaN or inf in row 7"):
        given(S).fit_chunks(K, [good, good, hole])
    with pytest.raises(ValueError, match=r"chunk 1, .* the data have 4 coordinates"):
        given(S).fit_chunks(K, [good, swings(10, n=4)])
    with pytest.raises(TypeError, match=r"chunk 0, .* a pair \(X, Y\) is needed.* \[\(X, Y\)\]"):
        given(S).fit_chunks(K, (X, Y))  # type: ignore[arg-type]
    with pytest.raises(TypeError, match=r"chunks must be an iterable.*Call a generator function"):
        given(S).fit_chunks(K, lambda: iter([good]))  # type: ignore[arg-type]


@pytest.mark.few(1)
@pytest.mark.parametrize("solver", [given(S), hk.RandomFeatures(9, jax.random.key(0))])
def test_a_stream_in_float32_warns_and_takes_no_data_with_more_digits(solver):
    few = X[:20].astype(np.float32), Y[:20].astype(np.float32)
    with pytest.warns(UserWarning, match="fitting in float32"):
        model = solver.start(K, few[0], 1e-2)
    assert model.add(*few).field(1e-2).norm.dtype == jnp.float32
    with pytest.raises(TypeError, match="the data are float64 and the fit float32"):
        model.add(X[:20], Y[:20])
    with pytest.raises(ValueError, match="regularization must be positive"):
        model.add(*few).field(1e-50)  # zero in float32
    with (
        pytest.warns(UserWarning, match="fitting in float32"),
        pytest.raises(ValueError, match="regularization must be positive"),
    ):
        solver.start(K, few[0], 1e-50)


# Memory.

STREAM = """
import json, resource, sys, warnings
import jax
jax.config.update("jax_enable_x64", True)
import numpy as np
import hamkernel as hk
def chunks(count, size=20_000):
    rng = np.random.default_rng(0)
    for _ in range(count):
        X = rng.uniform(-2, 2, size=(size, 2))
        yield X, np.stack([X[:, 1], -np.sin(X[:, 0])], axis=1) + 0.01 * rng.normal(size=X.shape)
K = hk.Symplectic(hk.Gaussian(1.5))
solvers = hk.Nystrom(), hk.RandomFeatures(40, jax.random.key(0))
peaks = []
for count in (2, 40):
    for solver in solvers:
        solver.fit_chunks(K, chunks(count), 1e-4)
    peaks.append(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024)
print(json.dumps(peaks))
"""


@pytest.mark.slow
def test_memory_ignores_the_number_of_points():
    done = subprocess.run(
        [sys.executable, "-c", STREAM], capture_output=True, text=True, check=True
    )
    few, many = json.loads(done.stdout)
    # 38 more chunks are 24 MB; one stays, with what the allocator holds back.
    assert many - few < 8e6


@pytest.mark.slow
def test_chunks_of_fewer_digits_are_added_to_a_fit_of_more():
    X, Y = swings(60)
    low = [each.astype(np.float32) for each in (X, Y)]
    model = given(X[:20]).start(hk.Symplectic(hk.Gaussian(1.5)), X, 1e-2)
    field = model.add(*low).field()
    assert field.coefficients.dtype == np.float64
    wide = model.add(*(each.astype(np.float64) for each in low)).field()
    np.testing.assert_array_equal(field.coefficients, wide.coefficients)
