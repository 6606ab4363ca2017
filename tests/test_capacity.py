"""What carries many rows and many landmarks in `learn`, against dense algebra in more digits."""

# pyright: reportArgumentType=false, reportAttributeAccessIssue=false, reportCallIssue=false

import math
import warnings
from fractions import Fraction
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import tqdm
from test_learn import with_missed

import hamkernel as hk
from hamkernel import _machine
from hamkernel._runs import preprocessing
from hamkernel._runs.flow import Segments
from hamkernel._solvers.triangle import regression_loss
from hamkernel._trajectories.kalman import whiten
from hamkernel._trajectories.likelihood import (
    closed_form,
    condense,
    conditional,
)
from hamkernel._trajectories.model import Model, landmark_whitening
from hamkernel._trajectories.search import (
    Bounds,
    limited_by_landmarks,
    losses,
    search_sample,
    solve,
)
from hamkernel._trajectories.segments import (
    LONG,
    WINDOW,
    LinearisedSegments,
    equal_pieces,
    given_path,
    linearise,
    make_segments,
    padded_count,
    windows,
)

NONE, WIDE = jnp.full(2, -jnp.inf), jnp.full(2, 1e4)  # no process noise; the prior of starts
MODEL = Model(hk.Symplectic(1.7 * hk.Gaussian(1.2)), jnp.log(jnp.full(2, 0.3)), NONE)


def rows_of(spans, path, nodes, slopes, measured) -> LinearisedSegments:
    size, T, n = path.shape
    none = jnp.zeros((size, T - 1, n, n))
    ones, zeros = jnp.ones_like(path), jnp.zeros_like(path)
    inputs = jnp.zeros((size, T - 1, 2, 0))
    segments = Segments(spans, measured, ones, zeros, path[:, 0], inputs)
    along = given_path(path, nodes, spans, none)
    good = jnp.ones(size, bool)
    rows = linearise(along, slopes, jnp.zeros_like(slopes), segments, good)
    return with_missed(rows, path, slopes, spans)


def arrays(size, T, seed=0):
    rng = np.random.default_rng(seed)
    shapes = (size, T - 1), (size, T, 2), (size, T - 1, 3, 2), (size, T - 1, 3, 2), (size, T, 2)
    spans, *rest = (jnp.asarray(rng.standard_normal(shape)) for shape in shapes)
    return 0.2 + 0.1 * jnp.abs(spans), *rest


@pytest.mark.slow
def test_the_closed_form_in_strips_is_ridge_regression_on_all_rows():
    rows = rows_of(*arrays(4, 12))
    S = rows.nodes[:, 0, 0]  # eight columns: four strips
    found = closed_form(MODEL, S, rows, WIDE)
    T = landmark_whitening(MODEL.kernel, S)
    made = whiten(MODEL, S, T, rows, WIDE)
    M, r = np.asarray(made.M), np.asarray(made.r)
    A = M.T @ M + np.eye(8)
    w = np.linalg.solve(A, M.T @ r)
    np.testing.assert_allclose(found.weights, w, rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(found.used, np.trace(np.linalg.solve(A, M.T @ M)), rtol=1e-9)
    np.testing.assert_allclose(found.squares, np.sum((r - M @ w) ** 2), rtol=1e-9)
    loss = 0.5 * (np.sum((r - M @ w) ** 2) + w @ w + np.linalg.slogdet(A)[1])
    np.testing.assert_allclose(found.loss, loss + made.constant, rtol=1e-10)


@pytest.mark.slow
def test_noise_is_scaled_in_the_triangle_as_in_the_rows():
    rows = rows_of(*arrays(4, 12))
    rng = np.random.default_rng(3)
    counts = jnp.asarray(rng.integers(0, 4, rows.counts.shape).astype(float))
    scatter = jnp.where(counts > 1, jnp.asarray(rng.uniform(0, 1, counts.shape)), 0.0)
    rows = rows._replace(counts=counts, scatter=scatter)
    S, given = rows.nodes[:, 0, 0], (rows, WIDE)
    found = conditional(condense(MODEL, S, *given), S, jnp.asarray(0.7))
    expected = closed_form(MODEL._replace(log_noise=MODEL.log_noise + 0.7), S, *given)
    for name in ("weights", "coefficients", "free", "used", "squares"):
        a, b = getattr(found, name), getattr(expected, name)
        np.testing.assert_allclose(a, b, rtol=1e-6, atol=1e-6, err_msg=name)
    np.testing.assert_allclose(found.loss, expected.loss, rtol=1e-6)


def test_a_large_log_is_padded_by_less_than_a_small_one():
    assert [padded_count(50, large) for large in (False, True)] == [64, 56]
    assert [padded_count(count, True) for count in (3, 8, 20, 120, 129)] == [3, 8, 20, 128, 160]


@pytest.mark.slow
def test_many_short_runs_are_not_padded_in_length():
    t = np.linspace(0.0, 1.0, 5)
    states = [np.column_stack([np.cos(t + i), -np.sin(t + i)]) for i in range(450)]
    runs = preprocessing.preprocess(hk.Runs([t] * 450, states), None).runs
    segments = make_segments(runs, equal_pieces(runs, LONG), [run.path for run in runs])
    assert segments.counts.shape == (512, 5, 2)
    few = make_segments(runs[:9], equal_pieces(runs[:9], LONG), [run.path for run in runs[:9]])
    assert few.counts.shape == (16, 8, 2)


def test_a_long_computation_says_what_it_costs():
    run = SimpleNamespace(times=np.zeros(1000))
    few, many = (SimpleNamespace(scale=np.ones(n), runs=[run]) for n in (2, 16))
    assert preprocessing.seconds_of_iteration(few, 128) < 1
    # 16 000 rows on 2048 columns.
    np.testing.assert_allclose(preprocessing.seconds_of_iteration(many, 128), 13.4, rtol=0.01)


@pytest.mark.slow
def test_landmarks_that_a_solve_of_some_seconds_cannot_carry_are_known_and_named(monkeypatch):
    t = np.linspace(0.0, 2.0, 21)
    states = [np.column_stack([np.cos(t + i), -np.sin(t + i)]) * (1 + i / 20) for i in range(20)]
    data = preprocessing.preprocess(hk.Runs([t] * 20, states), None)
    found = []
    for work in (3e7, 1e10):  # that of a solve with 96 landmarks, and more than all
        monkeypatch.setattr(preprocessing, "_WORK", work)
        monkeypatch.setattr(preprocessing, "_MOST_WORK", 4 * work)
        S, *sizes = preprocessing.landmarks(data, None)
        found.append((len(S), *sizes))
    assert found == [(192, 48, 96, True), (400, 48, 400, False)]


def exact_regression_loss(M, r):
    """½ (rᵀ (I + MMᵀ)⁻¹ r + log det (I + MMᵀ)) by elimination in rational numbers."""
    M = np.vectorize(Fraction)(M)
    A = np.column_stack([M @ M.T + np.eye(len(M), dtype=int), np.vectorize(Fraction)(r)])
    determinant, quadratic = Fraction(1), Fraction(0)
    for i in range(len(A)):
        pivot, value = A[i, i], A[i, -1]
        determinant *= pivot
        quadratic += value * value / pivot
        for j in range(i + 1, len(A)):
            A[j] = A[j] - A[i] * (A[j, i] / pivot)
    log_det = math.log(determinant.numerator) - math.log(determinant.denominator)
    return (log_det + float(quadratic)) / 2


@pytest.mark.parametrize("noise", [1.0, 1e-4, 1e-8, 1e-11])
def test_the_loss_keeps_its_digits_without_noise(noise):
    rng = np.random.default_rng(0)
    mixed = np.linalg.qr(rng.standard_normal((5, 5)))[0]
    M = rng.standard_normal((12, 5)) @ (np.logspace(0, -8, 5)[:, None] * mixed) / noise
    r = M @ rng.standard_normal(5) + rng.standard_normal(12)
    expected = exact_regression_loss(M, r)
    found = regression_loss(jnp.asarray(M), jnp.asarray(r))
    # A residual is rounded as r is, which is 1/noise times as large.
    np.testing.assert_allclose(found, expected, rtol=1e-8, atol=1e-15 / noise)
    # By a factorisation of I + MᵀM, as a control, the digits are lost.
    if noise < 1e-9:
        normal = np.linalg.slogdet(np.eye(5) + M.T @ M)[1] / 2
        exact = np.log(np.hypot(1, np.linalg.svd(M, compute_uv=False))).sum()
        assert abs(normal - exact) > 1e-6 * abs(exact)


def test_the_gradient_of_the_loss_is_that_of_its_values():
    rng = np.random.default_rng(0)
    M, r = jnp.asarray(rng.standard_normal((9, 4))), jnp.asarray(rng.standard_normal(9))
    found = jax.grad(regression_loss, argnums=(0, 1))(M, r)
    ways = jnp.asarray(rng.standard_normal((9, 4))), jnp.asarray(rng.standard_normal(9))
    up, down = (regression_loss(M + h * ways[0], r + h * ways[1]) for h in (1e-5, -1e-5))
    slope = jnp.vdot(found[0], ways[0]) + jnp.vdot(found[1], ways[1])
    np.testing.assert_allclose(slope, (up - down) / 2e-5, rtol=1e-7)


def test_eight_windows_of_long_rows_are_as_long_as_the_samples_allow():
    """What adds up along a path, such as friction, is seen in long windows only."""
    rows = rows_of(*arrays(6, 240))
    for samples, shape in {
        1300: (13, 96),
        600: (12, 48),
        100: (8, WINDOW),
        30: (2, WINDOW),
    }.items():
        assert windows(rows, samples).counts.shape[:2] == shape


@pytest.mark.slow
def test_a_window_says_what_its_part_of_the_path_says():
    given = arrays(1, 40)
    rows = rows_of(*given)
    found = windows(rows, 2 * WINDOW)
    assert found.counts.shape == (2, WINDOW, 2)
    first, last = slice(0, WINDOW), slice(40 - WINDOW, 40)
    parts = [
        rows_of(*(a[:, part.start : part.stop - (a.shape[1] == 39)] for a in given))
        for part in (first, last)
    ]
    direct = jax.tree.map(lambda *a: jnp.concatenate(a), *parts)
    S, flat = given[2][0, :6, 0], MODEL.flat[None]
    values = [float(losses(MODEL, flat, S, each, WIDE)[0]) for each in (found, direct)]
    np.testing.assert_allclose(*values, rtol=1e-8)


@pytest.mark.slow
def test_few_rows_are_all_searched_and_many_are_not():
    few, S = rows_of(*arrays(4, 12)), jnp.zeros((48, 2))
    same, part = search_sample(S, few)
    assert part is few
    assert len(same) == 48
    many = jax.tree.map(lambda a: jnp.concatenate([a] * 512), few)
    same, part = search_sample(S, many)
    assert len(same) == 48
    assert 2 * 48 * 3 * 2 * part.counts[..., 0].size < 2_000_000
    some, part = search_sample(jnp.zeros((1000, 2)), many)
    assert (len(some), len(part.counts)) == (34 * 11, 34)


@pytest.mark.slow
def test_landmarks_are_doubled_while_the_rows_become_likelier():
    """On rows of a rough field; those of a smooth one are content with the first.

    To more than are quick, 64 or 32, where they become likelier by ½ log 2 for each degree of
    freedom: not with much noise.
    """
    rng = np.random.default_rng(0)
    S = rng.uniform(-1, 1, (64, 2))
    spans, path, nodes, _, _ = arrays(16, 12)
    nodes = jnp.asarray(rng.uniform(-1, 1, nodes.shape))
    counts, limited = [], []
    for length, noise in ((0.2, 0.01), (0.2, 1.0), (3.0, 0.01)):
        truth = hk.Symplectic(1.0 * hk.Gaussian(length))
        centres = jnp.asarray(rng.uniform(-1, 1, (200, 2)))
        K = hk.gram(truth, nodes.reshape(-1, 2), centres).reshape(*nodes.shape, -1)
        f = K @ jnp.asarray(rng.standard_normal(400)) / 10
        steps = jnp.einsum("slka,k,sl->sla", f, jnp.array([5, 8, 5]) / 18, spans)
        x = jnp.pad(jnp.cumsum(steps, axis=1), ((0, 0), (1, 0), (0, 0)))
        noisy = x + noise * jnp.asarray(rng.standard_normal(x.shape))
        rows = rows_of(spans, path, nodes, jnp.zeros_like(nodes), noisy)
        model = Model(truth, jnp.log(jnp.full(2, noise)), NONE)
        none = np.zeros(len(model.flat))
        given, bounds = (rows, WIDE), Bounds(none, none, none > 0)
        found = [solve(model, S, 16, quick, *given, bounds)[1] for quick in (64, 32)]
        counts.append([len(each.points) for each in found])
        limited.append(limited_by_landmarks(model, jnp.asarray(S[:16]), *given))
    assert counts == [[64, 64], [64, 32], [16, 16]]
    assert limited == [True, True, False]


@pytest.mark.parametrize("size", [10, _machine._MAX_UNOPTIMISED + 1])
def test_how_a_program_is_compiled_changes_neither_values_nor_derivatives(size):
    """Small ones without optimisation, and inside of others as those say."""

    def waves(x, power: int):
        return jnp.cumsum(jnp.sin(3 * x) ** power)

    x = jnp.linspace(0, 2, size)
    compiled = _machine.compiled_by_size(waves)
    np.testing.assert_allclose(compiled(x, 2), np.cumsum(np.sin(3 * x) ** 2), rtol=1e-12)
    for transform in (jax.jit, jax.jacfwd, jax.vmap):
        points = x[:8].reshape(4, 2)
        found, expected = (transform(lambda x, f=f: f(x, 2))(points) for f in (compiled, waves))
        np.testing.assert_allclose(found, expected, rtol=1e-12)


def test_options_that_a_compiler_does_not_know_are_left_out(monkeypatch):
    monkeypatch.setitem(_machine._UNOPTIMISED, "cpu", {"xla_no_such_option": True})
    assert not _machine._options_are_known.__wrapped__("cpu")
    assert not _machine._options_are_known.__wrapped__("abacus")
    monkeypatch.setattr(_machine, "_options_are_known", lambda _: False)
    assert float(_machine.compiled_by_size(lambda x: 2 * x)(jnp.ones(()))) == 2.0


@pytest.mark.slow
def test_short_runs_without_noise_are_learned_from_whole_and_no_noise_is_found():
    """Forty runs of five samples of a double pendulum; eighty landmarks found noise of .0003."""
    system, rng, ts = hk.systems.DoublePendulum(), np.random.default_rng(0), 0.03 * np.arange(5)
    starts = jnp.asarray(rng.standard_normal((40, 4)) * np.array([1.0, 1.0, 3.0, 2.0]))
    options = {"rtol": 1e-9, "atol": 1e-9}
    paths = jax.vmap(lambda x: hk.simulate(system, x, jnp.asarray(ts), **options).ys)(starts)
    states = np.asarray(paths)
    K = hk.Symplectic(hk.Gaussian(np.ones(4)))
    found = hk.learn(K, hk.Runs([ts] * 40, list(states)), process_noise=0)
    scale = np.asarray(states).std(axis=(0, 1))
    assert (np.asarray(found.noise) < 1e-4 * scale).all()
    assert np.asarray(found.kept).all()
    assert len(found.field.points) > 80
    # By the median: the fastest run is alone where it is, and the field there is off by a fifth.
    f, g = (jax.vmap(each)(states.reshape(-1, 4)) for each in (system, found.field))
    errors = np.linalg.norm(f - g, axis=1) / np.linalg.norm(f, axis=1)
    assert np.median(errors) < 0.002


@pytest.mark.slow
def test_progress_is_told_to_those_who_wait(capsys, monkeypatch):
    """After ten seconds, here at once; never to those who say so."""
    bar, waits = tqdm.tqdm, []

    def at_once(**options):
        waits.append(options["delay"])
        return bar(**options | {"delay": 0.0})

    monkeypatch.setattr(tqdm, "tqdm", at_once)
    ts = np.linspace(0, 3, 8)
    runs = hk.Runs([ts] * 2, [np.column_stack([np.cos(ts + a), -np.sin(ts + a)]) for a in (0, 1)])
    options = {"process_noise": 0, "iterations": 1, "noise": 1e-3}
    said = []
    for progress in (None, False):
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            hk.learn(MODEL.kernel, runs, progress=progress, **options)
        said.append(capsys.readouterr().err)
    assert "learning" in said[0]
    assert not said[1]
    assert waits == [10.0, 10.0]
