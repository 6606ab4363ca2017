"""Where `tune` looks: the box of each hyperparameter, the subset of points, the starts."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import hamkernel as hk
from hamkernel._tuning.boxes import full_trace, hyperparameters
from hamkernel._tuning.objective import HUGE, criterion_of
from hamkernel._tuning.plan import SearchPlan
from hamkernel._tuning.runs import _design, _spread_out
from hamkernel._tuning.space import SearchSpace
from hamkernel._validation.bases import WaveBasis
from hamkernel._validation.losses import generalized_loss

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


@pytest.mark.parametrize("name", BOXES)
def test_the_box_comes_from_the_data(name):
    k, parameter, low, high = BOXES[name]
    found = hyperparameters(hk.Separable(k), jnp.asarray(X), jnp.asarray(Y))
    (box,) = (each for each in found if each.name.endswith("." + parameter))
    np.testing.assert_allclose(np.exp(box.low), low, rtol=1e-9)
    np.testing.assert_allclose(np.exp(box.high), high, rtol=1e-9)


def only_box(k, parameter, X, Y):
    found = hyperparameters(hk.Separable(k), jnp.asarray(X), jnp.asarray(Y))
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
    return SearchSpace(kernel, jnp.asarray(X), jnp.asarray(Y), jnp.asarray(1e-3), (), bounds or {})


def test_the_floor_of_lambda_rises_where_the_field_would_be_rough():
    whole, states = space(), jnp.asarray(X)
    lowest = jnp.exp(whole.ridge_box(K, states)[0])
    smooth = whole.smooth(K, lowest, states, 0.1)
    trace = 2 * N * 1.0  # of the Gram
    floor = 0.1 * np.sqrt(np.finfo(float).eps) * trace / N
    np.testing.assert_allclose(jnp.exp(smooth.ridge_box(K, states)[0]), floor)
    assert whole.smooth(K, lowest, states, 1e-12) is whole  # there is no misfit
    assert whole.smooth(K, jnp.asarray(1.0), states, 0.1) is whole  # λ is large enough
    assert smooth.smooth(K, floor, states, 0.4) is smooth  # the misfit is that of the bound
    assert smooth.smooth(K, 3 * floor, states, 0.9) is not smooth
    assert smooth.holds_up(K, floor, states, 1e-4)  # that of a thousand times the misfit
    assert not smooth.holds_up(K, 10 * floor, states, 1e-4)  # λ is where it wants to be
    assert not smooth.holds_up(K, floor, states, 0.1)
    given = space(bounds={"regularization": (1e-9, 1.0)})
    assert given.smooth(K, lowest, states, 0.1) is given  # the caller has said


def test_the_slope_of_the_floor_of_lambda_takes_the_memory_of_a_few_copies_of_the_states():
    many = jnp.asarray(RNG.normal(size=(50_000, 4)))
    whole = SearchSpace(
        hk.Symplectic(hk.Gaussian(np.ones(4))), many[:9], many[:9], jnp.asarray(1e-3), (), {}
    )

    def floor(log_lengthscale):
        kernel = eqx.tree_at(lambda K: K.kernel.log_lengthscale, whole.kernel, log_lengthscale)
        return whole.ridge_box(kernel, many)[0]

    analysis = jax.jit(jax.grad(floor)).lower(jnp.zeros(4)).compile().memory_analysis()
    assert analysis is not None
    assert analysis.temp_size_in_bytes < 12 * many.nbytes


def test_a_start_whose_kernel_is_not_positive_is_in_the_box():
    start = space(hk.Symplectic(lambda x, z: -jnp.exp(-((x - z) @ (x - z)))))
    assert np.isfinite(start.encode_start(jnp.asarray(X))).all()


def test_the_subset_has_its_share_of_every_fold():
    labels = np.where(np.arange(400) % 12 == 0, 1, 0)
    rows = criterion_of("cross_validation", 400, labels).coarse_points(jnp.zeros((400, 2)))
    assert abs(labels[rows].mean() - labels.mean()) < 1 / len(rows)


def test_starts_are_no_neighbours():
    design = _design((0, 1), np.float64)
    shares = np.sin(_spread_out(design, jnp.sum(design**2, axis=1), 6)) / 2
    gaps = np.linalg.norm(shares[:, None] - shares[None], axis=2)[np.triu_indices(6, 1)]
    assert gaps.min() >= 0.25 * 2**0.5


def test_the_lengthscales_of_a_vector_start_together():
    moved = space(hk.Symplectic(hk.Gaussian(np.ones(2)) + 2.0 * hk.Gaussian(np.ones(2))))
    assert moved.directions == (0, 0, 1, 1, 2, 3)
    design = _design(moved.directions, np.float64)
    assert design.shape == (256, 6)
    np.testing.assert_array_equal(design[:, 0], design[:, 1])
    # Weights of a network that start equal would stay so.
    assert space(hk.Symplectic(Plain(jnp.zeros(()), jnp.zeros(2)))).directions == (0, 1, 2, 3)


def test_generalised_cross_validation_judges_only_fits_that_leave_residuals_free():
    few, states, ridge = jnp.asarray(Y[:6]), jnp.asarray(X[:6]), jnp.asarray(1e-3)
    waves = WaveBasis(jax.random.key(0), 3)
    features, gram = waves.features(K, states)(states), hk.gram(K, states)
    F, G = (np.asarray(each).reshape(12, -1) for each in (features, gram))

    def free(matrix):
        return 6e-3 * np.trace(np.linalg.inv(matrix + 6e-3 * np.eye(12))) / 12

    low_rank, dense = free(F @ F.T), free(G)
    for more, judged in ((-1e-6, np.isfinite), (1e-6, np.isinf)):
        assert judged(generalized_loss(K, states, few, ridge, waves, low_rank + more))
        assert judged(generalized_loss(K, states, few, ridge, None, dense + more))
    criterion = criterion_of("generalized_cross_validation", 6, 5)
    assert criterion.value(K, states, few, jnp.asarray(1e-12)) == HUGE
    assert criterion.with_basis(waves).value(K, states, few, jnp.asarray(1.0)) < HUGE


@pytest.mark.parametrize("told", [5e-4, 0.5])
def test_a_few_runs_decide_neither_without_noise_nor_where_they_misled(told, monkeypatch):
    """The misfit that they tell is wrong: if it were 0.5, all λ of a search would be too large."""
    rng = np.random.default_rng(3)
    S = jnp.asarray(rng.uniform(-2, 2, size=(30, 2)))
    V = jnp.stack([S[:, 1], -jnp.sin(S[:, 0])], axis=1)
    right = hk.tune(K, S, V)
    really, bounds, made = SearchPlan._found, [], []

    def watched(plan, space, runs):
        found: Any = really(plan, space, runs)
        bounds.append(float(space.roundings))
        made.append(int((found.runs.value < HUGE).sum()))
        return found._replace(misfit=told) if len(made) == 1 else found

    monkeypatch.setattr(SearchPlan, "_found", watched)
    tuned = hk.tune(K, S, V)
    if told == 0.5:
        assert bounds[1] > 1e5 * bounds[0]
        del bounds[1], made[1]
    assert bounds == 2 * bounds[:1]
    assert made == [4, 16]
    np.testing.assert_allclose(tuned.loss, right.loss)
