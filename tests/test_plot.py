"""Pictures: what is drawn, with which labels and colours, read back from the axes."""

from typing import Any

import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
import pytest
from matplotlib.collections import LineCollection
from matplotlib.colors import to_hex

from hamkernel import plot
from hamkernel.systems import HarmonicOscillator, HenonHeiles


@pytest.fixture(autouse=True)
def _close_figures():
    yield
    plt.close("all")


SYSTEM = HarmonicOscillator(mass=1.0, stiffness=1.0)
TS = np.linspace(0, 2 * np.pi, 201)
CIRCLE = np.stack([np.cos(TS), -np.sin(TS)], axis=1)  # the closed-form trajectory from (1, 0)
LIMITS = ((-2.0, 2.0), (-1.5, 1.5))


def labels(ax):
    return {text.get_text() for text in ax.get_legend().get_texts()}


def line(ax, label):
    (found,) = [each for each in ax.lines if each.get_label() == label]
    return found


def points_of(ax, label):
    return np.asarray(line(ax, label).get_xydata())


def heights_of(ax, label):
    return points_of(ax, label)[:, 1]


def change_of_radius(ax):
    """Of each stream line: the largest less the smallest distance from 0."""
    (stream,) = [each for each in ax.collections if isinstance(each, LineCollection)]
    lines = stream.get_segments()
    assert len(lines) > 10
    return [np.ptp(np.linalg.norm(points, axis=1)) for points in lines]


def test_every_function_draws_on_the_axes_given():
    grid, path = np.geomspace(0.1, 10, 5), np.array([[1.0, 1.0], [2.0, 0.5]])
    losses = 1 + np.log(grid)[:, None] ** 2 + np.log(grid)[None] ** 2
    draw = [
        lambda ax: plot.phase_portrait(SYSTEM, *LIMITS, ax=ax),
        lambda ax: plot.trajectories(CIRCLE, ax),
        lambda ax: plot.trajectory_error(TS, TS, ax),
        lambda ax: plot.energy_drift(TS, TS, ax),
        lambda ax: plot.loss_surface(grid, grid, losses, path, ax),
        lambda ax: plot.plane_slice(HenonHeiles().hamiltonian, np.zeros(4), (0, 1), *LIMITS, ax),
        lambda ax: plot.poincare_section(CIRCLE, (0, 1), ax),
    ]
    for each in draw:
        ax = plt.figure().add_subplot()
        assert each(ax) is ax
    pair = plt.figure().subplots(1, 2)
    assert plot.hamiltonian(SYSTEM.hamiltonian, SYSTEM.hamiltonian, *LIMITS, pair) == tuple(pair)


def test_phase_portrait_shows_stream_lines_trajectories_and_data():
    data = CIRCLE[::20]
    curves = {"true": np.stack([CIRCLE, 0.5 * CIRCLE]), "odd_symplectic": 0.9 * CIRCLE}
    ax = plot.phase_portrait(SYSTEM, *LIMITS, data, curves, title="Portrait", units=("m", "kg m/s"))
    assert labels(ax) == {"true", "odd symplectic", "data"}
    assert (ax.get_xlabel(), ax.get_ylabel()) == ("$q$ [m]", "$p$ [kg m/s]")
    assert (ax.get_xlim(), ax.get_ylim()) == LIMITS
    assert ax.get_title() == "Portrait"
    np.testing.assert_array_equal(points_of(ax, "data"), data)
    np.testing.assert_array_equal(points_of(ax, "odd symplectic"), 0.9 * CIRCLE)
    # Two true trajectories under one name, and one learned; a dot where each starts.
    assert sum(len(np.asarray(each.get_xydata())) == 1 for each in ax.lines) == 3
    # Stream lines of a rotation are circles, as far as Matplotlib's steps of second order go.
    assert max(change_of_radius(ax)) < 0.02


def test_stream_lines_of_a_field_that_is_no_rotation_fail_the_same_check():
    ax = plot.phase_portrait(lambda x: x, *LIMITS)
    assert max(change_of_radius(ax)) > 0.2


def test_a_phase_portrait_of_a_field_outside_the_plane_is_refused():
    with pytest.raises(ValueError, match="plane_slice"):
        plot.phase_portrait(lambda x: jnp.concatenate([x, x]), *LIMITS)
    with pytest.raises(ValueError, match=r"data has shape \(5, 4\)"):
        plot.phase_portrait(lambda x: x, *LIMITS, data=np.zeros((5, 4)))
    # Systems and learned fields ask for a state of their own shape.
    system = HenonHeiles()
    with pytest.raises(ValueError, match=r"plane_slice draws .*\(4,\) is needed"):
        plot.phase_portrait(system, *LIMITS)
    with pytest.raises(ValueError, match=r"plane_slice draws .*\(4,\) is needed"):
        plot.hamiltonian(system.hamiltonian, SYSTEM.hamiltonian, *LIMITS)


def test_fields_and_single_axes_are_no_pair_of_hamiltonians():
    with pytest.raises(ValueError, match=r"\(2,\) -> \(\) is needed, this one returns \(2,\)"):
        plot.hamiltonian(SYSTEM, SYSTEM.hamiltonian, *LIMITS)
    one: Any = plt.gca()
    with pytest.raises(ValueError, match="ax must be a pair"):
        plot.hamiltonian(SYSTEM.hamiltonian, SYSTEM.hamiltonian, *LIMITS, ax=one)


@pytest.mark.parametrize(
    "limits", [((2, -2), (-1, 1)), ((-2, 2), (1, 1)), ((0, np.inf), (0, 1)), (2, (0, 1))]
)
def test_limits_that_do_not_rise_are_refused(limits):
    with pytest.raises(ValueError, match="lim must be"):
        plot.phase_portrait(SYSTEM, *limits)


@pytest.mark.parametrize("pair", ["rad", "ab", ("rad", "m", "s"), ("rad",), 3])
def test_what_is_no_pair_is_refused_before_anything_is_drawn(pair):
    H, grid = SYSTEM.hamiltonian, np.ones(2)
    draw = {
        "units": [
            lambda: plot.phase_portrait(SYSTEM, *LIMITS, units=pair),
            lambda: plot.trajectories(CIRCLE, units=pair),
            lambda: plot.poincare_section(CIRCLE, (0, 1), units=pair),
            lambda: plot.plane_slice(SYSTEM, np.zeros(2), (0, 1), *LIMITS, units=pair),
            lambda: plot.hamiltonian(H, H, *LIMITS, units=pair),
        ],
        "names": [
            lambda: plot.trajectories(CIRCLE, names=pair),
            lambda: plot.loss_surface(grid, grid, np.eye(2), names=pair),
        ],
        "titles": [lambda: plot.hamiltonian(H, H, *LIMITS, titles=pair)],
        "dims": [lambda: plot.trajectories(CIRCLE, dims=pair)],
    }
    for argument, functions in draw.items():
        for each in functions:
            with pytest.raises(ValueError, match=f"{argument} must be a pair"):
                each()
    assert not plt.get_fignums()


def test_coordinates_may_have_names():
    names, H = ("charge", "flux"), SYSTEM.hamiltonian
    left, _ = plot.hamiltonian(H, H, *LIMITS, names=names, units=("C", "Wb"))
    for ax in (
        left,
        plot.phase_portrait(SYSTEM, *LIMITS, names=names, units=("C", "Wb")),
        plot.trajectories(CIRCLE, names=names, units=("C", "Wb")),
        plot.plane_slice(H, np.zeros(2), (0, 1), *LIMITS, names=names, units=("C", "Wb")),
        plot.poincare_section(CIRCLE, (0, 1), names=names, units=("C", "Wb")),
    ):
        assert (ax.get_xlabel(), ax.get_ylabel()) == ("charge [C]", "flux [Wb]")


@pytest.mark.parametrize("names", [("orbit", "learned"), ("learned", "true")])
def test_a_learned_curve_does_not_hide_the_first_or_the_true_one(names):
    curves = dict.fromkeys(names, CIRCLE)
    wide, thin = ("true", "learned") if "true" in names else names
    for ax in (plot.trajectories(curves), plot.phase_portrait(SYSTEM, *LIMITS, None, curves)):
        assert line(ax, wide).get_linewidth() > 1.5 * line(ax, thin).get_linewidth()
        assert line(ax, wide).get_zorder() < line(ax, thin).get_zorder()


@pytest.mark.parametrize("corner", [(-1, -1), (-1, 1), (1, -1), (1, 1)])
def test_the_legend_lies_in_the_corner_that_is_free(corner):
    # An orbit that covers all of the portrait but a box at one corner.
    edge = np.stack(np.meshgrid(np.linspace(-1, 1, 41), np.linspace(-1, 1, 41)), axis=-1)
    ys = edge.reshape(-1, 2) * [2.0, 1.5]
    ys = ys[(ys * corner < [0.4, 0.8]).any(axis=1)]
    ax = plot.phase_portrait(SYSTEM, *LIMITS, ys)
    ax.figure.canvas.draw()
    legend = ax.get_legend()
    assert legend is not None
    assert not legend.get_window_extent().count_contains(ax.transData.transform(ys))


def test_levels_may_be_given():
    levels = np.linspace(0, 0.5, 6)
    H = SYSTEM.hamiltonian
    ax = plot.plane_slice(H, np.zeros(2), (0, 1), *LIMITS, levels=levels)
    pair = plot.hamiltonian(H, H, *LIMITS, levels=levels)
    for panel in (ax, *pair):
        filled: Any = panel.collections[0]
        np.testing.assert_array_equal(filled.levels, levels)
        assert filled.extend == "both"  # colours, not white, beyond the last level


def test_no_other_curve_takes_the_colour_of_a_model():
    ones = np.ones(3)
    names = ["my kernel", "odd symplectic", "another", "separable", "true", "symplectic"]
    ax = plot.trajectory_error(np.arange(3.0), dict.fromkeys(names, ones), log=False)
    assert len({to_hex(line.get_color()) for line in ax.lines}) == len(names)


def test_a_name_has_one_colour_in_every_picture():
    names = ("true", "separable", "symplectic", "odd symplectic")
    phase = plot.trajectories({name: CIRCLE for name in names})
    time = plot.trajectory_error(TS, {name: TS for name in reversed(names)})
    colors = [to_hex(line(phase, name).get_color()) for name in names]
    assert colors == [to_hex(line(time, name).get_color()) for name in names]
    assert len(set(colors)) == len(names)
    assert colors[0] == plot.COLORS["true"]


def test_trajectories_of_more_coordinates_name_the_two_that_are_drawn():
    ys = np.random.default_rng(0).normal(size=(7, 6))
    ax = plot.trajectories(ys, dims=(1, 5))
    assert (ax.get_xlabel(), ax.get_ylabel()) == ("$q_{2}$", "$p_{3}$")
    np.testing.assert_array_equal(ax.lines[0].get_xydata(), ys[:, [1, 5]])
    assert ax.get_legend() is None


def test_error_of_many_seeds_is_their_median_in_a_band_of_quantiles():
    seeds = np.random.default_rng(0).lognormal(size=(11, len(TS)))
    ax = plot.trajectory_error(TS, {"separable": seeds, "true": seeds[0]}, time_unit="s")
    ranked = np.sort(seeds, axis=0)  # of 11 values, the quantiles are elements 1, 5 and 9
    np.testing.assert_allclose(heights_of(ax, "separable"), ranked[5])
    band, of_legend = ax.collections  # a single run has no band
    assert not of_legend.get_paths()
    (path,) = band.get_paths()
    corners = {(x, y) for x, y in np.round(np.asarray(path.vertices), 9)}
    for edge in (ranked[1], ranked[9]):
        assert {(x, y) for x, y in np.round(np.stack([TS, edge], axis=1), 9)} <= corners
    assert ax.get_yscale() == "log"
    assert ax.get_xlabel() == "time $t$ [s]"
    assert labels(ax) == {"separable", "true", "median and 10 to 90 % of 11"}
    bare = plot.trajectory_error(TS, seeds, quantiles=(0.25, 0.75))
    assert labels(bare) == {"median and 25 to 75 % of 11"}


def test_a_curve_that_has_not_one_value_for_each_time_is_refused():
    with pytest.raises(ValueError, match=r"shape \(201,\); .* with T = 5"):
        plot.trajectory_error(TS[:5], TS)
    with pytest.raises(ValueError, match=r"curve 'a' has shape \(201, 2\)"):
        plot.energy_drift(TS, {"a": CIRCLE})
    with pytest.raises(ValueError, match=r"ts has shape \(201, 1\)"):
        plot.energy_drift(TS[:, None], TS)


def test_an_error_of_zero_is_left_out_of_a_logarithmic_axis_and_kept_on_a_linear_one():
    errors = TS.copy()
    assert errors[0] == 0
    ax = plot.trajectory_error(TS, {"a": errors})
    assert np.isnan(heights_of(ax, "a")[0])
    ax = plot.trajectory_error(TS, {"a": errors}, log=False)
    assert heights_of(ax, "a")[0] == 0


def test_energy_drift_is_the_change_since_the_start():
    energy = 5.0 + 0.1 * TS
    ax = plot.energy_drift(TS, {"a": energy}, unit="J")
    np.testing.assert_allclose(heights_of(ax, "a"), 0.1 * TS, atol=1e-12)
    assert ax.get_ylabel() == r"energy drift $\Delta H$ [J]"
    relative = plot.energy_drift(TS, {"a": -energy}, relative=True)
    np.testing.assert_allclose(heights_of(relative, "a"), -0.02 * TS, atol=1e-12)
    logarithmic = plot.energy_drift(TS, {"a": -energy}, log=True)
    np.testing.assert_allclose(heights_of(logarithmic, "a")[1:], 0.1 * TS[1:], rtol=1e-9)


def contour_paths(ax):
    return [np.asarray(path.vertices) for each in ax.collections for path in each.get_paths()]


def test_a_constant_in_the_learned_hamiltonian_is_not_seen():
    H = SYSTEM.hamiltonian
    left, right = plot.hamiltonian(lambda x: H(x) - 108.5, H, *LIMITS, energy_unit="J")
    for expected, drawn in zip(contour_paths(left), contour_paths(right), strict=True):
        np.testing.assert_allclose(drawn, expected, atol=1e-6)
    assert (left.get_title(), right.get_title()) == ("True $H$", "Learned $H$")
    bar = left.figure.axes[-1]
    assert bar.get_ylabel().endswith("[J]")


def test_a_wrong_learned_hamiltonian_is_seen():
    H = SYSTEM.hamiltonian
    left, right = plot.hamiltonian(lambda x: H(x) * 1.5, H, *LIMITS)
    pairs = zip(contour_paths(left), contour_paths(right), strict=True)
    assert any(a.shape != b.shape or np.abs(a - b).max() > 0.01 for a, b in pairs)


def test_loss_surface_marks_the_best_point_and_the_end_of_the_path():
    first, second = np.geomspace(0.1, 100, 13), np.geomspace(1e-6, 1, 9)
    losses = 1 + np.log(first / 2)[:, None] ** 2 + np.log(second / 1e-3)[None] ** 2
    losses[0, 0], losses[0, 1] = np.nan, np.inf
    path = np.geomspace([50, 0.5], [2, 1e-3], 6)
    ax = plot.loss_surface(first, second, losses, path)
    i, j = np.unravel_index(np.nanargmin(losses), losses.shape)
    np.testing.assert_array_equal(points_of(ax, "best of the grid"), [[first[i], second[j]]])
    np.testing.assert_array_equal(points_of(ax, "optimiser"), path)
    np.testing.assert_array_equal(points_of(ax, "its end"), path[-1:])
    assert (ax.get_xscale(), ax.get_yscale()) == ("log", "log")
    assert labels(ax) == {"best of the grid", "optimiser", "its end"}
    ax.figure.canvas.draw()


def test_a_loss_surface_with_nothing_to_draw_or_transposed_is_refused():
    first, second = np.geomspace(0.1, 1, 3), np.geomspace(0.1, 1, 4)
    with pytest.raises(ValueError, match="nothing to draw"):
        plot.loss_surface(first, second, np.full((3, 4), np.nan))
    with pytest.raises(ValueError, match=r"\(3, 4\) is needed"):
        plot.loss_surface(first, second, np.ones((4, 3)))
    with pytest.raises(ValueError, match="must be positive"):
        plot.loss_surface(-first, second, np.ones((3, 4)))


@pytest.mark.parametrize(
    ("low", "high", "first", "last"),
    [(0.5, 500, "0.5", "500"), (1e-6, 1e-2, "1.0e-06", "1.0e-02"), (1, 1.001, "1", "1.001")],
)
def test_the_numbers_of_a_loss_have_one_format_and_differ(low, high, first, last):
    grid = np.geomspace(0.1, 1, 3)
    ax = plot.loss_surface(grid, grid, np.geomspace(low, high, 9).reshape(3, 3), levels=15)
    texts = [text.get_text() for text in ax.figure.axes[-1].get_yticklabels()]
    assert (texts[0], texts[-1]) == (first, last)
    assert len({"e" in text for text in texts}) == 1
    assert len(set(texts)) == len(texts)


def test_slices_of_a_hamiltonian_and_of_its_field_name_their_coordinates():
    system, point = HenonHeiles(), np.array([0.1, 0.2, 0.3, 0.4])
    ax = plot.plane_slice(system.hamiltonian, point, (0, 1), (-1, 1), (-1, 1))
    assert (ax.get_xlabel(), ax.get_ylabel()) == ("$q_{1}$", "$q_{2}$")
    assert ax.figure.axes[-1].get_ylabel() == r"$H - \min H$"
    ax = plot.plane_slice(system, point, (0, 2), (-1, 1), (-1, 1))
    assert (ax.get_xlabel(), ax.get_ylabel()) == ("$q_{1}$", "$p_{1}$")
    with pytest.raises(ValueError, match="plane_slice needs"):
        plot.plane_slice(lambda x: x[:3], point, (0, 1), (-1, 1), (-1, 1))


def test_a_slice_leaves_out_the_point_where_the_potential_is_infinite():
    def potential(x):
        return -1 / jnp.linalg.norm(x[:2])

    ax = plot.plane_slice(potential, np.zeros(4), (0, 1), (-1, 1), (-1, 1), label="$U$")
    assert ax.figure.axes[-1].get_ylabel() == "$U$"
    low, high = ax.figure.axes[-1].get_ylim()
    # From the centre's neighbour, 30 to the unit, to the corner.
    assert 0.8 * (30 - 0.5**0.5) < high - low < 1.2 * (30 - 0.5**0.5)
    with pytest.raises(ValueError, match="finite nowhere"):
        plot.plane_slice(lambda x: jnp.inf * x[0] ** 2, np.zeros(4), (1, 2), (-1, 1), (-1, 1))


def test_pictures_of_nothing_are_refused():
    with pytest.raises(ValueError, match=r"\(T, n\) or \(B, T, n\)"):
        plot.trajectories(np.zeros(3))
    with pytest.raises(ValueError, match="points is empty"):
        plot.poincare_section([], (0, 1))
    with pytest.raises(ValueError, match="no coordinate 2"):
        plot.crossings(np.zeros((3, 2)), 2)
    with pytest.raises(ValueError, match="no relative change"):
        plot.energy_drift(np.arange(3.0), np.arange(3.0), relative=True)


def test_crossings_of_a_circle_are_where_the_closed_form_says():
    ts = np.linspace(0, 20.3, 4001)
    ys = np.stack([np.cos(ts), -np.sin(ts)], axis=1)
    # cos t rises through 1/2 at t = 2πk − π/3; linear interpolation errs by h²/8 = 3e-6.
    up = plot.crossings(ys, 0, 0.5)
    np.testing.assert_allclose(up, np.tile([0.5, np.sqrt(0.75)], (3, 1)), atol=1e-5)
    down = plot.crossings(ys, 0, 0.5, direction=-1)
    np.testing.assert_allclose(down, np.tile([0.5, -np.sqrt(0.75)], (4, 1)), atol=1e-5)
    assert len(plot.crossings(ys, 0, 0.5, direction=0)) == 7
    assert plot.crossings(ys, 0, 2.0).shape == (0, 2)


def test_a_state_on_the_section_is_one_crossing():
    ys = np.array([[-1.0, 0.0], [0.0, 5.0], [1.0, 0.0]])
    np.testing.assert_array_equal(plot.crossings(ys, 0, direction=0), [[0.0, 5.0]])
    with pytest.raises(ValueError, match="one trajectory"):
        plot.crossings(ys[None], 0)


def test_poincare_section_gives_each_orbit_a_colour_and_named_ones_a_legend():
    ys = np.random.default_rng(0).normal(size=(3, 50, 4))
    ax = plot.poincare_section(list(ys), (1, 3))
    assert (ax.get_xlabel(), ax.get_ylabel()) == ("$q_{2}$", "$p_{2}$")
    assert len({to_hex(each.get_color()) for each in ax.lines}) == 3
    np.testing.assert_array_equal(ax.lines[2].get_xydata(), ys[2][:, [1, 3]])
    ax = plot.poincare_section({"true": ys[0], "learned": ys[1]}, (1, 3))
    assert labels(ax) == {"true", "learned"}


def test_a_hamiltonian_that_is_infinite_at_a_point_is_drawn_elsewhere():
    def kepler(x):
        return x[1] ** 2 / 2 - 1 / jnp.abs(x[0])  # the grid has points with q = 0

    left, right = plot.hamiltonian(lambda x: kepler(x) + 7.0, kepler, *LIMITS)
    for panel in (left, right):
        drawn = np.concatenate([path.vertices for c in panel.collections for path in c.get_paths()])
        assert np.ptp(drawn[:, 0]) > 3  # of 4, both sides of the pole
    with pytest.raises(ValueError, match="nowhere on the grid"):
        plot.hamiltonian(lambda x: x[0] * jnp.nan, kepler, *LIMITS)


def test_coordinates_may_be_counted_from_the_end():
    ax = plot.trajectories(np.zeros((5, 4)), dims=(-3, -1))
    assert (ax.get_xlabel(), ax.get_ylabel()) == ("$q_{2}$", "$p_{2}$")
    for dims in [(0, 5), (1, 1), (0, -4)]:
        with pytest.raises(ValueError, match="two different coordinates"):
            plot.trajectories(np.zeros((5, 4)), dims=dims)
        with pytest.raises(ValueError, match="two different coordinates"):
            plot.poincare_section(np.zeros((5, 4)), dims)


@pytest.mark.parametrize(
    "curves",
    [CIRCLE.T, np.tile(CIRCLE, 2), CIRCLE[0], np.zeros((0, 2)), [CIRCLE, CIRCLE[:9]], {}, object()],
    ids=["transposed", "wide", "one state", "empty", "ragged", "none", "no array"],
)
def test_trajectories_that_are_not_in_the_plane_are_refused(curves):
    with pytest.raises(ValueError, match="trajector"):
        plot.phase_portrait(SYSTEM, *LIMITS, trajectories=curves)


def test_seeds_that_are_not_finite_are_left_out_and_said():
    errors = np.tile(np.linspace(1, 2, 5), (20, 1))
    errors[3, 2:] = np.nan
    with pytest.warns(UserWarning, match="1 of the 20 curves of learned"):
        ax = plot.trajectory_error(np.arange(5.0), {"learned": errors})
    np.testing.assert_array_equal(points_of(ax, "learned")[:, 1], errors[0])
    with pytest.raises(ValueError, match="none of the 20 curves"):
        plot.trajectory_error(np.arange(5.0), errors * np.nan)
