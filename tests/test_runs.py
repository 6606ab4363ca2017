"""`Runs`: what is refused, what is said, and the smoother against dense Gaussian processes."""

# pyright: reportArgumentType=false, reportAttributeAccessIssue=false, reportCallIssue=false
# pyright: reportOptionalSubscript=false, reportOptionalMemberAccess=false
# pyright: reportOperatorIssue=false
# Wrong types are refused here, and any field is looked into.

import warnings

import jax.numpy as jnp
import numpy as np
import pytest
import scipy.stats

import hamkernel as hk
from hamkernel._runs.smoothing import (
    Process,
    negative_log_likelihood,
    pad,
    power_of_two,
    processes,
    smooth_runs,
    subtract_means,
)


def swings(count=3, noise=0.05, seed=0, missing=False):
    """Noisy circles at uneven times, of lengths that differ."""
    rng = np.random.default_rng(seed)
    times = [np.sort(rng.uniform(0, 8, 25 + r)) for r in range(count)]
    states = [np.column_stack([np.sin(t + r), np.cos(t + r)]) for r, t in enumerate(times)]
    states = [x + noise * rng.standard_normal(x.shape) for x in states]
    if missing:
        states[0][5:8, 1] = np.nan
        states[1][3] = np.nan
    return times, states


TIMES, STATES = swings()


def changed(run, change):
    times, states = [t.copy() for t in TIMES], [x.copy() for x in STATES]
    change(times[run], states[run])
    return times, states


def test_times_among_the_states_are_refused():
    table = np.column_stack([TIMES[0], STATES[0]])
    with pytest.raises(ValueError, match=r"column 0 of the states holds the times.*table\[:, 1:\]"):
        hk.Runs(table[:, 0], table)
    assert hk.Runs(table[:, 0], table[:, 1:]).dimension == 2


def test_runs_keep_what_came():
    runs = hk.Runs(TIMES, STATES, inputs=[x[::-1, :1] for x in STATES])
    assert len(runs) == 3
    assert runs.dimension == 2
    np.testing.assert_array_equal(runs.times[1], TIMES[1])
    np.testing.assert_array_equal(runs.inputs[2], STATES[2][::-1, :1])
    assert repr(runs) == "Runs(3 runs, 78 samples, n=2, m=1 held)"
    assert repr(hk.Runs(TIMES, STATES)) == "Runs(3 runs, 78 samples, n=2)"
    assert len(hk.Runs(TIMES[0], STATES[0])) == 1  # one run as bare arrays


def test_what_cannot_be_meant_is_refused():
    with pytest.raises(ValueError, match="times has 3 runs and states has 2"):
        hk.Runs(TIMES, STATES[:2])
    with pytest.raises(ValueError, match="there are no runs"):
        hk.Runs([], [])
    with pytest.raises(ValueError, match=r"run 0 has 1 sample: .* Leave it out"):
        hk.Runs([TIMES[0][:1]], [STATES[0][:1]])
    with pytest.raises(ValueError, match=r"times\[1\] must increase; sample 4"):
        hk.Runs(*changed(1, lambda t, x: t.__setitem__(4, t[3])))
    with pytest.raises(ValueError, match=r"It seems transposed: states\[0\].T"):
        hk.Runs([TIMES[0]], [STATES[0].T])
    with pytest.raises(ValueError, match="contains inf"):
        hk.Runs(*changed(2, lambda t, x: x.__setitem__((1, 1), np.inf)))
    with pytest.raises(ValueError, match=r"times\[0\] contains NaN"):
        hk.Runs(*changed(0, lambda t, x: t.__setitem__(2, np.nan)))
    with pytest.raises(ValueError, match=r"\[1, 2\] coordinates"):
        hk.Runs(TIMES, [STATES[0], STATES[1][:, :1], STATES[2]])
    with pytest.raises(ValueError, match="nothing was measured in run 2"):
        hk.Runs(*changed(2, lambda t, x: x.fill(np.nan)))
    with pytest.raises(TypeError, match=r"states\[0\] has dtype <U1; real numbers are needed"):
        hk.Runs([TIMES[0]], [np.full(STATES[0].shape, "a")])


def test_a_wrapped_angle_is_named_with_its_cure():
    t = np.linspace(0, 10, 60)
    angle = np.column_stack([(2 * t) % (2 * np.pi), np.full(60, 2.0) + 0.1 * np.sin(t)])
    with pytest.warns(UserWarning, match=r"coordinate 0 of run 0 jumps by about 2π.*np\.unwrap"):
        hk.Runs(t, angle)
    hk.Runs(t, np.column_stack([np.unwrap(angle[:, 0]), angle[:, 1]]))  # no warning: an error here


@pytest.mark.parametrize("period", [360, 4096, 65536])
def test_an_angle_in_degrees_or_counts_of_an_encoder_is_unwrapped_by_its_period(period):
    t = np.arange(100) / 20
    angle = np.column_stack([0.7 * period * t % period, np.sin(t)])
    with pytest.warns(UserWarning, match=rf"jumps by about {period}: .*, period={period}\)"):
        hk.Runs(t, angle)


@pytest.mark.parametrize("value", [-9999.0, 65535.0, 1e30])
def test_a_sample_that_a_logger_wrote_for_a_lost_one_is_named(value):
    t = np.arange(60) / 10
    states = np.column_stack([np.sin(t), np.cos(t)])
    states[20, 0] = value
    with pytest.warns(UserWarning, match=r"^1 sample is impossible .* sample 20 of run 0"):
        runs = hk.Runs(t, states)
    assert [list(rows) for rows in runs.impossible] == [[20]]


def test_a_wrapped_angle_with_lost_samples_is_told_to_unwrap_those_that_were_measured():
    # np.unwrap of all of them has NaN from the first lost one on.
    t = np.linspace(0, 10, 60)
    angle = np.column_stack([(2 * t) % (2 * np.pi), 2.0 + 0.1 * np.sin(t)])
    angle[20] = np.nan
    with pytest.warns(UserWarning, match=r"q\[ok\] = np\.unwrap\(q\[ok\]\)"):
        hk.Runs(t, angle)
    ok = np.isfinite(angle[:, 0])
    angle[ok, 0] = np.unwrap(angle[ok, 0])
    hk.Runs(t, angle)  # no warning: an error here


def test_a_fast_wrapped_angle_is_named_and_a_momentum_across_a_gap_is_not():
    t = np.linspace(0, 6, 30)
    turning = (6.0 * t + np.pi) % (2 * np.pi) - np.pi  # 1.2 rad between samples
    with pytest.warns(UserWarning, match="coordinate 0 of run 0 jumps by about 2π"):
        hk.Runs(t, np.column_stack([turning, np.sin(t)]))
    far = np.append(t[:15], t[15:] + 1.5)
    hk.Runs(far, np.column_stack([np.where(t < 3, 0.0, 6.2) + 0.1 * t, np.sin(t)]))


def test_gaps_and_constant_columns_are_named():
    t = np.concatenate([np.linspace(0, 1, 20), np.linspace(5, 6, 20)])
    with pytest.warns(UserWarning, match=r"a gap of 4 in run 0, at a median spacing of 0\.0526"):
        hk.Runs(t, np.column_stack([np.sin(t), np.cos(t)]))
    with pytest.warns(UserWarning, match=r"constant in all runs: coordinate 1 \(always 3\)"):
        hk.Runs(TIMES[0], np.column_stack([np.sin(TIMES[0]), np.full(len(TIMES[0]), 3.0)]))


def test_inputs_that_cannot_be_told_apart_are_named():
    t, rng = np.linspace(0, 10, 400), np.random.default_rng(0)
    x, u = np.column_stack([np.sin(t), np.cos(t)]), rng.normal(size=(400, 3))
    hk.Runs(t, x, u)  # a warning is an error here
    with pytest.warns(UserWarning, match=r"constant in all runs: input 2 \(always 3\)\."):
        hk.Runs(t, x, np.where([False, False, True], 3.0, u))
    hk.Runs([t, t], [x, x], [0 * u[:, :1], 0 * u[:, :1] + 1])  # constant in each, not in both
    for share, said in ((0.05, True), (0.5, False)):  # 2.5e-4 and .024
        alike = np.column_stack([u[:, 0], u[:, 1], u[:, 0] - 2 * u[:, 1] + share * u[:, 2]])
        with warnings.catch_warnings(record=True) as seen:
            warnings.simplefilter("always")
            hk.Runs(t, x, alike)
        assert any("inputs 0, 1, 2 depend" in str(w.message) for w in seen) == said


# What sensors and controllers do.

EVEN = np.linspace(0, 10, 400)
SWING = np.stack([np.sin(2 * EVEN), 2 * np.cos(2 * EVEN)], axis=1)
NOISY = SWING + 0.01 * np.random.default_rng(1).normal(size=SWING.shape)


def test_clean_noisy_and_digital_logs_are_taken_without_a_word():
    for x in (SWING, NOISY, np.round(SWING, 2), np.round(NOISY, 2), np.round(SWING, 1)):
        hk.Runs(EVEN, x)  # a warning is an error here
    hk.Runs(EVEN, np.column_stack([0.3 * EVEN, np.full(400, 0.3) + 1e-3 * EVEN]))  # no force
    held = np.concatenate([np.repeat(SWING[:1], 50, axis=0), SWING])  # by hand, before it is let go
    hk.Runs(np.arange(450.0), held)


def test_a_coarse_encoder_at_a_turning_point_is_not_called_dead():
    t = np.linspace(0, 6, 121)
    swing = np.stack([2.2 * np.cos(2 * t), -4.4 * np.sin(2 * t)], axis=1)
    hk.Runs(t, np.round(swing / 0.5) * 0.5)  # warnings are errors


def test_an_outage_is_named_and_a_body_that_is_struck_is_not():
    for value in (0.0, NOISY[200]):
        lost = NOISY.copy()
        lost[200:205] = value
        with pytest.warns(UserWarning, match=r"stand still in run 0 from 5\.013 to 5\.113: all"):
            hk.Runs(EVEN, lost)
    t = np.linspace(0, 3, 61)
    speed = np.maximum(1 - t, 0) + np.where(t > 2, 8.0, 0.0)
    position = np.cumsum(speed) * 0.05
    hk.Runs(t, np.round(np.stack([position, speed], axis=1), 2))  # warnings are errors


def test_clipped_dead_repeated_and_interpolated_samples_are_named():
    clipped = np.column_stack([NOISY[:, 0], np.clip(NOISY[:, 1], -9, 1.5)])
    with pytest.warns(UserWarning, match=r"seems clipped: coordinate 1 at 1\.5 stays"):
        hk.Runs(EVEN, clipped)
    dead = NOISY.copy()
    dead[200:260, 0] = dead[200, 0]
    with pytest.warns(UserWarning, match=r"dead: coordinate 0 of run 0 from 5\.013 to 6\.491"):
        hk.Runs(EVEN, dead)
    with pytest.warns(UserWarning, match=r"repeated samples: coordinate 0 \(75%\), 1 \(75%\)"):
        hk.Runs(EVEN, np.repeat(NOISY[::4], 4, axis=0))
    drawn = [np.interp(EVEN, EVEN[::4], column) for column in NOISY[::4].T]
    with pytest.warns(UserWarning, match=r"interpolated samples: coordinate 0 \(75%\)"):
        hk.Runs(EVEN, np.stack(drawn, axis=1))


def test_feedback_without_excitation_is_named_and_with_it_is_not():
    law = -3 * NOISY[:, :1] - NOISY[:, 1:]
    more = np.random.default_rng(2).normal(size=law.shape)
    with pytest.warns(UserWarning, match="the input is a function of the states but for"):
        hk.Runs(EVEN, NOISY, law + 0.1 * more)
    with pytest.warns(UserWarning, match="a combination of the inputs is a function of"):
        hk.Runs(EVEN, NOISY, np.column_stack([law + more, law - more]))
    hk.Runs(EVEN, NOISY, law + 2 * more)
    hk.Runs(EVEN, NOISY, np.sin(5.1 * EVEN)[:, None])


def dense(coordinate, t, s):
    """The Matérn-7/2 kernel of a process, in closed form."""
    r = np.exp(float(coordinate.process.log_rate)) * np.abs(t[:, None] - s[None])
    k = np.exp(-r) * (1 + r + 2 * r**2 / 5 + r**3 / 15)
    return np.exp(2 * float(coordinate.process.log_amplitude)) * k


@pytest.mark.slow
def test_the_smoother_is_a_dense_gaussian_process_with_missing_entries():
    times, states = swings(missing=True)
    found = processes(times, states)
    paths = smooth_runs(found, times, states)
    inside, means = subtract_means(states)
    for r, t in enumerate(times):
        for c, coordinate in enumerate(found):
            seen = np.isfinite(states[r][:, c])
            y, own = inside[r][seen, c], t[seen]
            A = dense(coordinate, own, own) + coordinate.noise**2 * np.eye(len(own))
            to = dense(coordinate, t, own)
            value = means[r, c] + to @ np.linalg.solve(A, y)
            variance = np.diag(dense(coordinate, t, t) - to @ np.linalg.solve(A, to.T))
            T = len(t)
            np.testing.assert_allclose(paths.value[r, :T, c], value, atol=1e-9)
            np.testing.assert_allclose(paths.deviation[r, :T, c] ** 2, variance, atol=1e-9)
            # The slope, by differences of the dense mean.
            later, sooner = (
                dense(coordinate, t + h, own) @ np.linalg.solve(A, y) for h in (1e-5, -1e-5)
            )
            np.testing.assert_allclose(paths.slope[r, :T, c], (later - sooner) / 2e-5, atol=1e-6)
            # Of the slope a priori λ²σ²/5, the curvature of the kernel at r = 0.
            prior = np.exp(2 * coordinate.process.log_rate) * dense(coordinate, t[:1], t[:1]) / 5
            slopes = (dense(coordinate, t + 1e-5, own) - dense(coordinate, t - 1e-5, own)) / 2e-5
            variance = np.diag(prior - slopes @ np.linalg.solve(A, slopes.T))
            found_there = paths.slope_deviation[r, :T, c] ** 2
            np.testing.assert_allclose(found_there, variance, atol=1e-6)


def test_the_likelihood_is_that_of_scipy():
    t, y = TIMES[0], STATES[0][:, 0]
    process = Process(*(jnp.asarray(np.log(v)) for v in (0.9, 0.8, 0.07)))
    coordinate = type("Coordinate", (), {"process": process})
    A = dense(coordinate, t, t) + 0.07**2 * np.eye(len(t))
    expected = -scipy.stats.multivariate_normal(np.zeros(len(t)), A).logpdf(y)
    steps = np.diff(t, prepend=t[0])
    seen = np.ones(len(t), bool)
    args = (jnp.asarray(a)[None] for a in (steps, y, seen))
    np.testing.assert_allclose(negative_log_likelihood(process, *args), expected, rtol=1e-9)


def test_velocities_are_those_of_the_motion():
    X, Y, labels = hk.Runs(TIMES, STATES).velocities()
    true = np.concatenate(
        [np.column_stack([np.cos(t + r), -np.sin(t + r)]) for r, t in enumerate(TIMES)]
    )
    assert X.shape == Y.shape == (78, 2)
    np.testing.assert_array_equal(labels, np.repeat([0, 1, 2], [25, 26, 27]))
    error = np.sqrt(np.mean((np.asarray(Y) - true) ** 2))
    naive = np.concatenate([np.gradient(x, t, axis=0) for t, x in zip(TIMES, STATES, strict=True)])
    assert error < 0.12
    assert error < 0.3 * np.sqrt(np.mean((naive - true) ** 2))  # uneven times
    noises = [c.noise for c in processes(TIMES, STATES)]
    np.testing.assert_allclose(noises, 0.05, rtol=0.25)


def test_velocities_of_what_was_never_measured_are_refused():
    unseen = [np.column_stack([x[:, 0], np.full(len(x), np.nan)]) for x in STATES]
    with pytest.raises(ValueError, match="coordinate 1 was measured in no run"):
        hk.Runs(TIMES, unseen).velocities()


def test_runs_are_padded_to_few_shapes():
    assert [power_of_two(n) for n in (1, 2, 3, 33, 64)] == [1, 2, 4, 64, 64]
    runs = pad(TIMES, STATES)
    assert runs.states.shape == (4, 32, 2)
    assert not runs.measured[0, 25:].any()


@pytest.mark.slow
def test_a_hundred_thousand_samples_are_smoothed():
    t = np.arange(100_000) * 1e-3
    x = np.column_stack([np.sin(t), np.cos(t)])
    noisy = x + 0.01 * np.random.default_rng(0).standard_normal(x.shape)
    X, Y, _ = hk.Runs(t, noisy).velocities()
    assert np.abs(np.asarray(X) - x).max() < 5e-3
    assert np.sqrt(np.mean((np.asarray(Y)[:, 0] - x[:, 1]) ** 2)) < 5e-3
