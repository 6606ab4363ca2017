"""`learned.score`, `.gain` and `.log_evidence`: against SciPy's paths, fits and least squares."""

# pyright: reportArgumentType=false

import dataclasses
import functools
import warnings

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.optimize import least_squares

import hamkernel as hk
from hamkernel._learned.score import Score, _lead

K = hk.Symplectic(hk.Gaussian(1.0))


def logs(friction, seed, count=4, noise=0.01):
    """Runs of 6 s of a pendulum, from rest or not."""
    rng, ts = np.random.default_rng(seed), np.linspace(0, 6, 32)

    def rates(t, x):
        return [x[1], -6 * np.sin(x[0]) - friction * x[1]]

    starts = rng.uniform(-1.8, 1.8, (count, 2))
    true = [solve_ivp(rates, (0, 6), x, t_eval=ts, rtol=1e-9, atol=1e-9).y.T for x in starts]
    return hk.Runs([ts] * count, [x + noise * rng.standard_normal(x.shape) for x in true])


@functools.cache
def learned(friction=0.0):
    """A field without friction, of runs without or with it."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return hk.learn(K, logs(friction, 0), progress=False)


@pytest.mark.slow
def test_a_free_run_is_scipys_from_scipys_start():
    field, runs, first = learned().field, logs(0.0, 1, count=1), 8
    score = learned().score(runs, first=first)
    t, x = np.asarray(runs.times[0]), np.asarray(runs.states[0])
    compiled = jax.jit(field)

    def path(start, ts):
        found = solve_ivp(
            lambda _, x: compiled(jnp.asarray(x)),
            (0, ts[-1]),
            start,
            t_eval=ts,
            rtol=1e-8,
            atol=1e-8,
        )
        return found.y.T

    start = least_squares(lambda s: (path(s, t[:first]) - x[:first]).ravel(), x[0]).x
    free = path(start, t)
    # The prior of starts, three standard deviations wide, moves them by 1e-5.
    np.testing.assert_allclose(score.predictions[0], free, atol=2e-3)
    rmse = np.sqrt(np.mean((free[first:] - x[first:]) ** 2, axis=0))
    np.testing.assert_allclose(score.rmse, rmse, rtol=0.02)
    still = np.sqrt(np.mean((x[first - 1] - x[first:]) ** 2, axis=0))
    np.testing.assert_allclose(score.persistence, still)
    assert "times better than a linear model" in score.text
    assert 0.85 < float(score.coverage) <= 1


def test_the_linear_model_is_exact_for_an_oscillator(learned):
    """It is fitted to smoothed slopes, so that a linear system leaves next to no error."""
    ts, sizes = np.linspace(0, 6, 32), np.random.default_rng(0).uniform(0.5, 2, 4)
    states = [np.stack([c * np.cos(2 * ts), -2 * c * np.sin(2 * ts)], 1) for c in sizes]
    # The linear model knows the runs alone, and no field.
    found = dataclasses.replace(learned, runs=hk.Runs([ts] * 4, states))
    score = found.score(hk.Runs([ts], [0.7 * states[0]]), draws=0)
    assert float(jnp.max(score.linear / score.scale)) < 0.01
    assert np.isnan(float(score.coverage))


@pytest.mark.slow
def test_a_score_without_runs_holds_out_the_last_fifth():
    score = learned().score(draws=0)
    assert [len(t) for t in score.times] == [6] * 4
    np.testing.assert_array_equal(score.times[0], learned().runs.times[0][-6:])
    assert float(jnp.max(score.rmse / score.scale)) < 0.05


def of_errors(own, still, linear, lead=9.0, count=12):
    t = jnp.arange(float(count))
    errors = jnp.array([[np.nan], [0.1], [0.2]] + [[0.4]] * (count - 3))
    own, still, linear = (jnp.array([each]) for each in (own, still, linear))
    return Score(
        rmse=own,
        persistence=still,
        linear=linear,
        lead=jnp.array(lead),
        coverage=jnp.array(np.nan),
        predictions=(errors,),
        times=(t,),
        errors=(errors,),
        scale=jnp.ones(1),
        first=1,
    )


@pytest.mark.parametrize(
    ("own", "still", "linear", "said"),
    [
        (0.1, 1.0, 0.7, "follows the runs 7 times better than a linear model"),
        (5.3, 2.2, 1.0, "worse than saying that nothing moves: off by [5.3], where the"),
        (np.inf, 2.2, 1.0, "worse than saying that nothing moves"),
        (0.9, 1.0, 0.7, "worse than a linear model ([0.9] for [0.7])"),
        (0.9, 1.0, np.inf, "a linear model leaves every bound"),
    ],
)
def test_the_verdict_is_one_sentence(own, still, linear, said):
    score = of_errors(own, still, linear)
    assert said in score.text
    assert "last sample stays" in repr(score)


def test_noise_of_one_sensor_does_not_hide_another_coordinate():
    score = of_errors(0.1, 1.0, 0.7)
    errors = {"rmse": [0.01, 1.9], "linear": [0.4, 2.4], "persistence": [0.5, 3.5]}
    errors = {name: jnp.array(values) for name, values in errors.items()}
    both = dataclasses.replace(score, scale=jnp.ones(2), **errors)
    assert both.text.endswith("1.28 times better than a linear model, and 40 times in coordinate 0")


def test_many_coordinates_are_printed_as_a_range():
    score = of_errors(0.1, 1.0, 0.7)
    rmse = jnp.linspace(0.1, 0.5, 20)
    more = dict.fromkeys(("linear", "persistence", "scale"), jnp.ones(20))
    assert "0.1 to 0.5 in 20 coordinates" in repr(dataclasses.replace(score, rmse=rmse, **more))


def test_a_few_numbers_are_no_verdict():
    assert "compared with 9 numbers, too few" in of_errors(0.1, 1.0, 0.7, count=10).text
    assert "too few" not in of_errors(0.1, 1.0, 0.7, count=11).text


def test_a_difference_within_its_error_is_no_verdict():
    rng = np.random.default_rng(0)
    noise, shift = rng.normal(size=(3, 40, 2)), 0.1 * rng.normal(size=(3, 40, 2))
    assert abs(_lead(noise**2, (noise + 0.1 * shift) ** 2)) < 2
    assert _lead(noise**2, (noise + 2.0) ** 2) > 2
    assert (
        "do not tell it from a linear model ([0.9] for [0.7])" in of_errors(0.9, 2.0, 0.7, 1.0).text
    )


def test_the_horizon_ends_before_the_first_larger_error():
    score = of_errors(0.1, 1.0, 0.7)
    times = [float(score.horizon(bound)[0]) for bound in (0.05, 0.15, 0.3, 1.0)]
    assert times == [0.0, 1.0, 2.0, 11.0]
    with pytest.raises(ValueError, match="positive"):
        score.horizon(-1.0)


@pytest.mark.slow
def test_friction_raises_log_p_where_there_is_some_and_only_there():
    price = 0.5 * np.log(4 * 32 * 2)
    assert learned().gain(hk.Friction()) < 2 * price
    assert learned(0.1).gain(hk.Friction()) > 20


@pytest.mark.slow
def test_the_evidence_of_a_wrong_structure_is_lower():
    """A curl-free field cannot turn in circles."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        wrong = hk.learn(hk.CurlFree(hk.Gaussian(1.0)), learned().runs, progress=False)
    assert wrong.log_evidence < learned().log_evidence - 20


def test_what_cannot_be_scored_is_refused(learned):
    with pytest.raises(TypeError, match=r"score takes hk\.Runs"):
        learned.score(np.zeros((5, 2)))
    t = np.arange(12.0)
    with pytest.raises(TypeError, match="these runs have inputs and the learned have none"):
        learned.score(hk.Runs(t, np.sin(np.outer(t, [1, 2])), np.cos(t)[:, None]))
    with pytest.raises(ValueError, match="4 coordinates"):
        learned.score(hk.Runs(t, np.sin(np.outer(t, [1, 2, 3, 4]))))
    with pytest.raises(ValueError, match="first must be"):
        learned.score(first=0)
