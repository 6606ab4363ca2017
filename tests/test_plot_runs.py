"""Pictures of logged runs, read back from the axes."""

# pyright: reportArgumentType=false, reportAttributeAccessIssue=false, reportCallIssue=false
# What matplotlib returns has no types.

from types import SimpleNamespace

import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
import pytest

import hamkernel as hk
from hamkernel import plot


@pytest.fixture(autouse=True)
def _close_figures():
    yield
    plt.close("all")


NOISE = 0.1


@pytest.fixture(scope="module")
def runs():
    rng = np.random.default_rng(0)
    times = [np.sort(rng.uniform(0, 8, 30)), np.sort(rng.uniform(0, 6, 20))]
    states = [np.column_stack([np.sin(t), np.cos(t)]) for t in times]
    states = [x + NOISE * rng.standard_normal(x.shape) for x in states]
    states[0][4, 1] = np.nan
    return hk.Runs(times, states)


def line(ax, label):
    (found,) = [each for each in ax.lines if each.get_label() == label]
    return np.asarray(found.get_xydata())


def heights(area, t):
    """The lowest and the highest point of a band at one of its times."""
    vertices = area.get_paths()[0].vertices
    there = vertices[np.isclose(vertices[:, 0], t), 1]
    return there.min(), there.max()


@pytest.mark.slow
def test_a_smoothed_run_shows_samples_curve_and_two_standard_deviations(runs):
    panels = plot.smoothing(runs, 1, time_unit="s", units=("rad", None))
    band = runs.smoothing()
    assert [ax.get_ylabel() for ax in panels] == ["$q$ [rad]", "$p$"]
    assert panels[1].get_xlabel() == "time $t$ [s]"
    assert panels[0].get_title(loc="left") == "run 1"
    for c, ax in enumerate(panels):
        np.testing.assert_array_equal(line(ax, "measured")[:, 1], runs.states[1][:, c])
        curve = line(ax, "smoothed")
        assert len(curve) == 9 * 19 + 1
        np.testing.assert_allclose(curve[::9, 1], band.states[1][:, c], atol=1e-9)
        (area,) = ax.collections
        mean, off = float(band.states[1][7, c]), float(band.deviation[1][7, c])
        expected = mean - 2 * off, mean + 2 * off
        np.testing.assert_allclose(heights(area, float(runs.times[1][7])), expected, atol=1e-7)


def test_the_band_of_the_smoothing_holds_the_truth(runs):
    found = runs.smoothing(between=3)
    z = []
    for t, x, off in zip(found.times, found.states, found.deviation, strict=True):
        truth = np.column_stack([np.sin(t), np.cos(t)])
        z.append((np.asarray(x) - truth) / np.asarray(off))
    z = np.concatenate(z)
    assert np.mean(np.abs(z) < 2) > 0.85
    assert np.sqrt(np.mean(z**2)) > 0.4  # and is no wider than it must be
    np.testing.assert_allclose(found.noise, NOISE, rtol=0.3)
    with pytest.raises(ValueError, match="between must be 0 or more"):
        runs.smoothing(-1)


def learned_of(runs):
    """What a picture asks of a `Learned`: fitted states, σ, and their shares."""
    states = tuple(jnp.stack([jnp.sin(t), jnp.cos(t)], axis=1) for t in runs.times)
    noise = jnp.array([NOISE, NOISE])
    pairs = zip(runs.states, states, strict=True)
    residuals = tuple((x - fit) / noise[None] for x, fit in pairs)
    misfit = jnp.stack([jnp.sqrt(jnp.nanmean(r**2, axis=0)) for r in residuals])
    return SimpleNamespace(
        runs=runs,
        field=lambda x: jnp.array([x[1], -x[0]]),
        states=states,
        residuals=residuals,
        misfit=misfit,
        kept=jnp.array([1.0, 0.5]),
    )


@pytest.mark.slow
def test_a_fitted_run_shows_samples_curve_and_residuals(runs):
    learned = learned_of(runs)
    panels = plot.fitted(learned, names=("angle", "momentum"))
    assert [row[0].get_ylabel() for row in panels] == ["angle", "momentum"]
    assert panels[0][0].get_title(loc="left") == "run 0, 100 % of it used"
    second = plot.fitted(learned, -1)[0][0]
    assert second.get_title(loc="left") == "run 1, 50 % of it used"
    for c, (left, right) in enumerate(panels):
        np.testing.assert_array_equal(line(left, "measured")[:, 1], runs.states[0][:, c])
        curve = line(left, "fitted")  # from each state along the field
        truth = (np.sin, np.cos)[c](curve[:, 0])
        np.testing.assert_allclose(curve[::9, 1], learned.states[0][:, c], atol=1e-12)
        np.testing.assert_allclose(curve[:, 1], truth, atol=1e-6)
        (points,) = [each for each in right.lines if each.get_marker() == "o"]
        np.testing.assert_allclose(np.asarray(points.get_ydata()), learned.residuals[0][:, c])
        size = f"root mean square {float(learned.misfit[0, c]):.2f}"
        assert right.get_title() == f"{size}, grey: ±2"


@pytest.mark.parametrize("between", ["held", "linear"])
def test_between_samples_the_fitted_curve_is_driven_by_what_was_applied(between):
    """A unit mass under a force u: q̈ = u, so q is a parabola, or a cubic where u is a line."""
    t, u = np.array([0.0, 0.5, 0.8, 2.0]), np.array([1.0, -2.0, 4.0, 0.0])
    h = np.diff(t)
    rise = np.diff(u) / h if between == "linear" else np.zeros(3)

    def after(x, k, s):
        q = x[0] + s * x[1] + s**2 / 2 * u[k] + s**3 / 6 * rise[k]
        return np.array([q, x[1] + s * u[k] + s**2 / 2 * rise[k]])

    x = [np.array([0.3, -0.1])]
    for k in range(3):
        x.append(after(x[k], k, h[k]))
    driven = hk.Runs([t], [np.stack(x)], [u[:, None]], between=between)
    learned = SimpleNamespace(
        runs=driven,
        field=SimpleNamespace(whole=lambda s: s[1:]),  # of the points (q, p, u)
        states=driven.states,
        residuals=[np.zeros((4, 2))],
        misfit=np.zeros((1, 2)),
        kept=np.ones(1),
    )
    curve = line(plot.fitted(learned)[0][0], "fitted")
    k = np.clip(np.searchsorted(t, curve[:, 0], side="right") - 1, 0, 2)
    expected = [after(x[j], j, s - t[j])[0] for j, s in zip(k, curve[:, 0], strict=True)]
    np.testing.assert_allclose(curve[:, 1], expected, atol=1e-12)


def test_a_coordinate_that_was_never_measured_has_no_residuals(runs):
    unseen = [np.column_stack([x[:, 0], np.full(len(x), np.nan)]) for x in runs.states]
    only_q = hk.Runs(runs.times, unseen)
    fitted = plot.fitted(learned_of(only_q))
    assert not fitted[1][1].axison  # nothing was measured, so there are no residuals
    assert np.isfinite(line(fitted[1][0], "fitted")).all()
    panels = plot.smoothing(only_q)
    assert np.isnan(line(panels[1], "smoothed")[:, 1]).all()
    panels[0].figure.canvas.draw()
    fitted[0][0].figure.canvas.draw()


def test_axes_may_be_given_and_what_does_not_fit_is_refused(runs):
    column = plt.figure().subplots(2, 1)
    assert plot.smoothing(runs, ax=column) == tuple(column)
    block = plt.figure().subplots(2, 2)
    assert plot.fitted(learned_of(runs), ax=block) == tuple(map(tuple, block))
    with pytest.raises(ValueError, match="there is no run 2: there are 2"):
        plot.smoothing(runs, 2)
    with pytest.raises(ValueError, match="ax has 2 axes; 2 pairs"):
        plot.fitted(learned_of(runs), ax=column)
    with pytest.raises(ValueError, match="names must have 2 entries"):
        plot.smoothing(runs, names="ab")
    with pytest.raises(ValueError, match="units must have 2 entries"):
        plot.fitted(learned_of(runs), units=("m",))
