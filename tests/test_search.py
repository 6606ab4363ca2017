"""Where `tune` looks: the box of each hyperparameter, the subset of points, the starts."""

import dataclasses
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
import pytest

import hamkernel as hk
from hamkernel._gram import gram_of_rows
from hamkernel._observations.blocks import Components
from hamkernel._observations.measurements import measurements_of, measurements_of_states
from hamkernel._tuning.minimiser import BoxBFGS, init, inside_box, minimise, run_in_box
from hamkernel._tuning.objective import SearchObjective, criterion_of, parts_of
from hamkernel._tuning.search import box_distance, choose_starts, design
from hamkernel._tuning.space import SearchSpace, full_trace, hyperparameters
from hamkernel._validation import generalized_loss

N = 20
RNG = np.random.default_rng(0)
X = RNG.uniform([-3, -1], [3, 1], size=(N, 2))
Y = RNG.normal(size=X.shape)
EXTENTS = np.ptp(X, axis=0)
EXTENT = np.linalg.norm(EXTENTS)
K = hk.Symplectic(hk.Gaussian(1.0))


class Own(eqx.Module):
    """A kernel of the user, whose parameter says by its name only that it is positive."""

    log_width: jax.Array

    def __call__(self, x, z):
        return jnp.exp(-((x - z) @ (x - z)) * jnp.exp(-2 * self.log_width))


class Plain(eqx.Module):
    """A kernel of the user, whose parameters may mean anything."""

    log_lengthscale: jax.Array
    shift: jax.Array

    def __call__(self, x, z):
        return jnp.exp(-((x - z) @ (x - z)) * jnp.exp(-2 * self.log_lengthscale)) + self.shift[0]


def tenfold(x):
    return 10 * x


SQUARE = np.mean(np.sum(X**2, axis=1))
BOXES = {
    "lengthscale": (hk.Gaussian(1.0), "lengthscale", 0.3 * EXTENT / N, 30 * EXTENT),
    "for each": (hk.Gaussian(np.ones(2)), "lengthscale", 0.3 * EXTENTS / N, 30 * EXTENTS),
    "selected": (hk.Select(hk.Gaussian(), 1), "lengthscale", 0.3 * EXTENTS[1] / N, 30 * EXTENTS[1]),
    "warped": (hk.Warp(hk.Gaussian(), tenfold), "lengthscale", 3 * EXTENT / N, 300 * EXTENT),
    "period": (hk.Periodic(), "period", 2 * EXTENT / N, 10 * EXTENT),
    # Dimensionless: on a circle of radius 1, whatever the units of the states.
    "on a circle": (hk.Periodic(), "lengthscale", 0.6 / N, 60.0),
    "offset": (hk.Polynomial(2), "offset", 1e-4 * SQUARE, 1e4 * SQUARE),
    "period for each": (hk.Periodic(np.ones(2)), "period", 2 * EXTENTS / N, 10 * EXTENTS),
    "scale": (2.0 * hk.Gaussian(), "scale", 1e-5 * np.mean(Y**2), 1e5 * np.mean(Y**2)),
    "own": (Own(jnp.log(1e5)), "width", 1e2, 1e8),
    # Not one of ours: its lengthscale need not be a distance between states.
    "own lengthscale": (Plain(jnp.log(1e5), jnp.zeros(1)), "lengthscale", 1e2, 1e8),
}


def boxes(k, X, Y):
    X = jnp.asarray(X)
    return hyperparameters(hk.Separable(k), X, speed(Y), X)


def speed(Y):
    return float(np.sqrt(np.mean(np.asarray(Y) ** 2)))


def zeros(N, n):
    return measurements_of_states(jnp.zeros((N, n)), jnp.zeros((N, n)))


@pytest.mark.parametrize("name", BOXES)
def test_the_box_comes_from_the_data(name):
    k, parameter, low, high = BOXES[name]
    found = boxes(k, X, Y)
    (box,) = (each for each in found if each.name.endswith("." + parameter))
    np.testing.assert_allclose(np.exp(box.low), low, rtol=1e-9)
    np.testing.assert_allclose(np.exp(box.high), high, rtol=1e-9)


def only_box(k, parameter, X, Y):
    found = boxes(k, X, Y)
    (box,) = (each for each in found if each.name.endswith("." + parameter))
    return box.low, box.high


def test_a_number_of_unknown_meaning_has_a_box_of_ten_times_its_size_and_of_ten_at_least():
    k = Plain(jnp.zeros(()), jnp.array([-50.0, 0.0, 0.2]))
    low, high = only_box(k, "shift", X, Y)
    np.testing.assert_allclose(low, [-550.0, -10.0, -9.8], rtol=1e-12)
    np.testing.assert_allclose(high, [450.0, 10.0, 10.2], rtol=1e-12)


def test_on_a_circle_many_points_do_not_ask_for_more_than_a_series_can_carry():
    many = RNG.uniform(-3, 3, size=(100, 2))
    low, high = only_box(hk.Periodic(), "lengthscale", many, many)
    np.testing.assert_allclose(np.exp([low, high]), [1 / 64, 60.0], rtol=1e-12)


@pytest.mark.parametrize(
    ("k", "parameter", "low", "high"),
    [
        (hk.Gaussian(1.0), "lengthscale", 0.3 / 2, 30.0),
        (hk.Polynomial(2), "offset", 1e-4, 1e4),
        (2.0 * hk.Gaussian(1.0), "scale", 1e-5, 1e5),
    ],
)
def test_data_without_extent_or_size_has_the_box_of_one(k, parameter, low, high):
    found = only_box(k, parameter, np.zeros((1, 2)), np.zeros((1, 2)))
    np.testing.assert_allclose(np.exp(found), [low, high], rtol=1e-12)


@pytest.mark.parametrize("unit", [1e-7, 1e4])
def test_each_part_has_the_box_of_its_own_units(unit):
    """Of positions and momenta in another unit, and of inputs in a third."""

    def found(unit, of_input):
        friction = hk.Friction(rest_speed=0.1 * unit)
        K = hk.Sum(energy=hk.Symplectic(1.0 * hk.Gaussian(unit)), friction=friction)
        K = hk.Controlled(K, hk.InputMatrix(1.0, acts_on=(1,)), count=1)
        joined = jnp.column_stack([X * unit, U * of_input])
        rms = unit * float(np.sqrt(np.mean(Y**2)))
        each = hyperparameters(K, joined, rms, joined)
        return {p.name.split(".", 1)[1]: np.exp([p.low, p.high]) for p in each}

    U = RNG.normal(size=(len(X), 1))
    here, there = found(1.0, 1.0), found(unit, 100.0)
    for name, power in {
        "friction.viscous": 1.0,
        "friction.coulomb": unit,
        "energy.kernel.scale": unit**4,
        "kernel.scale": (unit / 100) ** 2,
    }.items():
        np.testing.assert_allclose(there[name], here[name] * power, rtol=1e-6, err_msg=name)


def test_the_lengthscale_of_a_periodic_kernel_does_not_know_the_units_of_the_states():
    for units in (1.0, 1e4):
        K = hk.Separable(hk.Periodic(2.0 * units))
        tuned = hk.tune(K, X * units, np.sin(np.pi * X), folds=4, starts=4, frozen="period")
        assert tuned.loss < 1e-2 * np.mean(np.sin(np.pi * X) ** 2)


def test_rounding_is_that_of_the_terms_before_they_cancel():
    def trace(kernel):
        return np.trace(np.asarray(hk.gram(kernel, X)).reshape(2 * N, -1))

    long = hk.Symplectic(hk.Gaussian(30.0))
    odd = hk.Odd(long)
    assert trace(odd) < 1e-2 * trace(long)
    for K in (odd, hk.Even(hk.Symplectic(hk.Gaussian(30.0))), long, odd + long):
        terms = trace(long) * (2 if isinstance(K, hk.Sum) else 1)
        np.testing.assert_allclose(full_trace(K, jnp.asarray(X)), terms, rtol=1e-9)
    # Of a kernel that is larger on the other side, where there is no data, both terms round.
    lopsided = hk.Symplectic(hk.Warp(hk.Polynomial(1), lambda x: jnp.exp(-3.0 * x)))
    right = jnp.asarray(np.abs(X))
    both = np.trace(np.asarray(hk.gram(hk.Odd(lopsided), right)).reshape(2 * N, -1))
    one = np.trace(np.asarray(hk.gram(lopsided, right)).reshape(2 * N, -1))
    assert both > 10 * one
    np.testing.assert_allclose(full_trace(hk.Odd(lopsided), right), both, rtol=1e-9)


def space(kernel=K, bounds=None):
    return SearchSpace(kernel, jnp.asarray(X), speed(Y), jnp.asarray(1e-3), (), bounds or {})


def test_a_start_whose_kernel_is_not_positive_is_in_the_box():
    start = space(hk.Symplectic(lambda x, z: -jnp.exp(-((x - z) @ (x - z)))))
    assert np.isfinite(start.encode_start()).all()


def test_the_subset_has_its_share_of_every_fold():
    labels = np.where(np.arange(400) % 12 == 0, 1, 0)
    criterion = criterion_of("cross_validation", 400, labels)
    rows, everything = parts_of(zeros(400, 2), criterion, dense=True)
    assert (len(rows), len(everything)) == (64, 400)
    assert abs(labels[rows].mean() - labels.mean()) < 1 / len(rows)


@pytest.mark.slow
def test_generalised_cross_validation_judges_only_fits_that_leave_residuals_free():
    few, states, ridge = jnp.asarray(Y[:6]), jnp.asarray(X[:6]), jnp.asarray(1e-3)
    waves = hk.RandomFeatures(3, jax.random.key(0))
    features, gram = waves.span(K, 2, states.dtype).rows_of(Components(states)), hk.gram(K, states)
    rows = measurements_of_states(states, few)
    F, G = (np.asarray(each).reshape(12, -1) for each in (features, gram))

    def free(matrix):
        return 6e-3 * np.trace(np.linalg.inv(matrix + 6e-3 * np.eye(12))) / 12

    low_rank, dense = free(F @ F.T), free(G)
    for more, judged in ((-1e-6, np.isfinite), (1e-6, np.isinf)):
        assert judged(generalized_loss(K, rows, ridge, waves, low_rank + more))
        assert judged(generalized_loss(K, rows, ridge, None, dense + more))
    criterion = criterion_of("generalized_cross_validation", 6, 5)
    assert criterion.loss(K, rows, jnp.asarray(1e-12))[0] == np.inf
    assert dataclasses.replace(criterion, basis=waves).loss(K, rows, jnp.asarray(1.0))[0] < np.inf


def test_the_ridge_of_a_subset_is_that_of_all_points():
    some, lam = 8, 0.1
    rows = measurements_of_states(jnp.asarray(X[:some]), jnp.asarray(Y[:some]))
    criterion = criterion_of("generalized_cross_validation", some, 5)
    objective = SearchObjective(space(), criterion, rows, *map(jnp.asarray, (N / some, 1.0, 1.0)))
    _, loss = objective.value_and_loss(K, jnp.asarray(lam), jnp.asarray(2.0))
    D = 2 * some
    A = np.asarray(hk.gram(K, X[:some])).reshape(D, D) + N * lam * np.eye(D)
    a = np.linalg.solve(A, Y[:some].ravel())
    np.testing.assert_allclose(loss, D * a @ a / np.trace(np.linalg.inv(A)) ** 2)


@pytest.mark.parametrize(("N", "n", "parts"), [(64, 2, 1), (65, 2, 2), (2000, 2, 3), (600, 8, 3)])
def test_many_points_are_searched_in_parts_that_grow_and_end_with_all(N, n, parts):
    criterion = criterion_of("cross_validation", N, 5)
    rows = parts_of(zeros(N, n), criterion, dense=True)
    sizes = [len(each) for each in rows]
    assert len(rows) == parts
    assert sizes == sorted(sizes)
    np.testing.assert_array_equal(rows[-1], np.arange(N))
    for some in rows:
        assert len(set(some.tolist())) == len(some)
    few = parts_of(zeros(N, n), criterion, dense=False)
    assert len(few) == max(parts - 1, 1)


@pytest.mark.slow
def test_a_subset_of_observations_has_their_rows():
    half, rng = (
        np.where(np.arange(2 * N).reshape(N, 2) % 3 == 0, np.nan, Y),
        np.random.default_rng(1),
    )
    data = (
        hk.Velocities(X, half, noise=rng.uniform(0.5, 2, size=(N, 2)))
        + hk.Energies(X[:5], Y[:5, 0])
        + hk.Functionals(X[:6].reshape(3, 2, 2), rng.normal(size=(3, 2, 2, 2)), Y[:3])
    )
    rows = measurements_of(K, data)[1]
    assert rows.count == N + 5 + 6
    some, which = rows.subset(np.array([1, 4, 19, 21, 24, 27]))
    np.testing.assert_array_equal(which, [1, 4, 19, 21, 24, 27, 28])  # 28 shares the points of 27
    inside = np.isin(rows.labels(), which)
    np.testing.assert_array_equal(some.targets, rows.targets[inside])
    np.testing.assert_array_equal(which[some.labels()], rows.labels()[inside])
    G, own = (np.asarray(gram_of_rows(K, each)) for each in (rows, some))
    of_velocities = np.flatnonzero(inside[: rows.slices[0].stop])
    expected = G[np.ix_(of_velocities, of_velocities)]
    np.testing.assert_allclose(own[: len(expected), : len(expected)], expected, atol=1e-12)
    lone, which = rows.subset(np.array([0, 1, 21]))
    np.testing.assert_array_equal(which, [0, 1])
    assert not len(lone.energies)


def test_starts_are_no_neighbours():
    points = design((0, 1))
    starts = points[choose_starts(points, np.sum(points**2, axis=1), 6)]
    gaps = [box_distance(starts[i], starts[j]) for i in range(6) for j in range(i)]
    assert min(gaps) >= 0.25 * 2**0.5
    everywhere = choose_starts(points, np.sum(points**2, axis=1), 60)
    assert len(set(everywhere)) == 60  # full, but none is taken twice


def test_the_lengthscales_of_a_vector_start_together():
    moved = space(hk.Symplectic(hk.Gaussian(np.ones(2)) + 2.0 * hk.Gaussian(np.ones(2))))
    assert moved.directions == (0, 0, 1, 1, 2, 3)
    points = design(moved.directions)
    assert points.shape == (256, 6)
    np.testing.assert_array_equal(points[:, 0], points[:, 1])
    # Weights of a network that start equal would stay so.
    assert space(hk.Symplectic(Plain(jnp.zeros(()), jnp.zeros(2)))).directions == (0, 1, 2, 3)


DEFAULT: Any = BoxBFGS(atol=jnp.asarray(1e-8))


@eqx.filter_jit
def minimum(fn, start, minimiser=DEFAULT, max_steps=200, before=None):
    """The run that follows a function u -> () from a point."""

    def with_loss(u):
        return fn(u), fn(u)

    run = init(minimiser, with_loss, jnp.asarray(start))
    run = run if before is None else run.with_curvature_of(before)._replace(steps=jnp.array(0))
    return minimise(minimiser, with_loss, run, max_steps)


def rosenbrock(u):
    return (1 - u[0]) ** 2 + 10 * (u[1] - u[0] ** 2) ** 2


MINIMISERS = {
    "default": DEFAULT,
    "BFGS": optx.BFGS(1e-5, 1e-5),
    "Nelder-Mead": optx.NelderMead(1e-6, 1e-6),
}


@pytest.mark.parametrize("name", MINIMISERS)
def test_a_run_of_any_minimiser_finds_the_end_of_a_curved_valley(name):
    run = minimum(rosenbrock, [-1.2, 1.0], MINIMISERS[name])
    np.testing.assert_allclose(run.best.u, [1, 1], atol=1e-3)
    assert run.converged
    # Of this point, and not of the one before: 1 - u is 1e-8 or more, and rounded to 1e-16.
    np.testing.assert_allclose(run.best.value, rosenbrock(run.best.u), rtol=1e-6)
    stopped = minimum(rosenbrock, [-1.2, 1.0], MINIMISERS[name], max_steps=3)
    assert stopped.steps == 3
    assert not stopped.converged
    assert stopped.best.value <= rosenbrock(jnp.array([-1.2, 1.0]))


def test_the_default_takes_fewer_steps_than_that_of_optimistix():
    ours, theirs = (
        minimum(rosenbrock, [-1.2, 1.0], MINIMISERS[each]).steps for each in ("default", "BFGS")
    )
    assert ours < theirs


def test_a_run_backs_away_from_where_there_is_no_value():
    run = minimum(lambda u: jnp.where(u[0] < 0.5, rosenbrock(u), jnp.nan), [-1.2, 1.0])
    assert rosenbrock(run.best.u) < 0.3
    nowhere = minimum(lambda u: jnp.inf + 0 * u[0], [0.0, 0.0])
    assert nowhere.steps == 1
    assert not nowhere.converged
    assert nowhere.best.value == np.inf


@pytest.mark.parametrize("name", ["default", "BFGS"])
def test_a_run_takes_its_curvature_along(name):
    run = minimum(rosenbrock, [-1.2, 1.0], MINIMISERS[name])
    near = run.best.u + np.array([0.01, 0.02])
    again = minimum(rosenbrock, near, MINIMISERS[name], before=run)
    np.testing.assert_allclose(again.best.u, [1, 1], atol=1e-3)
    assert again.steps < minimum(rosenbrock, near, MINIMISERS[name]).steps


def test_a_likelihood_is_followed_in_the_units_of_its_deviations_and_inside_its_box():
    deviations = jnp.array([1e-3, 0.5])
    low, high = jnp.array([-1.0, -1.0]), jnp.array([1.0, 3.0])

    def minus_log(h):
        return 0.5 * jnp.sum(((h - jnp.array([0.2, 5.0])) / deviations) ** 2)

    run = run_in_box(minus_log, jnp.array([0.21, 1.0]), low, high, deviations, 30)
    h, value = inside_box(run.best.u, low, high), run.best.value
    np.testing.assert_allclose(h, [0.2, 3.0], atol=2e-4)
    np.testing.assert_allclose(value, minus_log(h))


def whole(kernel, Y, bounds=None):
    """The objective of the search on all of X."""
    rows, typical = measurements_of_states(jnp.asarray(X), jnp.asarray(Y)), speed(Y)
    given = SearchSpace(kernel, rows.points, typical, jnp.asarray(1e-3), (), bounds or {})
    criterion = criterion_of("cross_validation", N, 5).restrict(kernel, rows, np.arange(N))
    return SearchObjective(given, criterion, rows, *map(jnp.asarray, (1.0, typical, 1.0)))


@eqx.filter_jit
def with_slope(objective, u):
    return jax.value_and_grad(objective, has_aux=True)(jnp.asarray(u))


@pytest.mark.parametrize("share", [0.3, 0.7])
def test_the_slope_is_that_of_the_value_on_both_sides_of_the_penalty(share):
    objective = whole(hk.Symplectic(hk.Gaussian(4.0)), Y)
    u = np.arcsin(2 * np.array([0.8, share]) - 1)
    (value, loss), slope = with_slope(objective, u)
    assert (value > np.log(loss) + 1) == (share < 0.5)  # far beyond its edge, and before it
    h = 1e-3  # below 1e-4 the rounding of the loss is what differs
    for i, one in enumerate(np.eye(2)):
        more, less = (with_slope(objective, u + sign * h * one)[0][0] for sign in (1, -1))
        np.testing.assert_allclose(slope[i], (more - less) / (2 * h), rtol=1e-3, atol=1e-5)


def test_rounding_is_penalised_where_coefficients_are_too_large_and_only_where_lambda_is_ours():
    k = hk.Gaussian(8.0)
    u = jnp.arcsin(2 * jnp.array([0.75, 0.25]) - 1)
    objective = whole(hk.Symplectic(k), Y)
    value, loss = objective(u)
    kernel, ridge, _ = objective.space.decode(u)
    G = np.asarray(hk.gram(kernel, X)).reshape(2 * N, 2 * N)
    a = np.linalg.solve(G + 0.8 * N * float(ridge) * np.eye(2 * N), Y.ravel())
    size = np.linalg.norm(a) * np.trace(G) * np.finfo(float).eps ** 0.5 / np.linalg.norm(Y)
    assert size > 2
    np.testing.assert_allclose(value, np.log(loss) + np.log(size) ** 2, rtol=1e-4)
    low, high = (float(np.exp(side)) for side in objective.space.ridge_bounds(jnp.asarray(2.0)))
    value, loss = whole(hk.Symplectic(k), Y, {"regularization": (low, high)})(u)
    np.testing.assert_allclose(value, np.log(loss))
