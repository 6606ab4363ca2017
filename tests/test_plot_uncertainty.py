"""Pictures of what is not known, read back from the axes."""

# pyright: reportArgumentType=false, reportAttributeAccessIssue=false, reportCallIssue=false
# pyright: reportIndexIssue=false, reportOptionalMemberAccess=false, reportOperatorIssue=false
# pyright: reportOptionalOperand=false
# What matplotlib returns has no types.

import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
import pytest

from hamkernel import plot


@pytest.fixture(autouse=True)
def _close_figures():
    yield
    plt.close("all")


TS = np.linspace(0, 1, 5)
ORBITS = np.random.default_rng(0).normal(size=(7, 5, 4))


def test_an_ensemble_is_thin_lines_of_one_colour_below_the_truth():
    ax = plot.ensemble(ORBITS, ORBITS[0], dims=(0, 2))
    draws = [line for line in ax.lines if line.get_linewidth() == 0.8]
    assert len(draws) == 7
    assert len({line.get_color() for line in draws}) == 1
    assert all(line.get_alpha() < 1 for line in draws)
    np.testing.assert_array_equal(draws[3].get_xydata(), ORBITS[3][:, [0, 2]])
    assert [text.get_text() for text in ax.get_legend().get_texts()] == ["draws", "true"]
    with pytest.raises(ValueError, match=r"ys has shape \(5, 4\)"):
        plot.ensemble(ORBITS[0])


def test_a_band_holds_so_many_deviations():
    ax = plot.band(TS, TS, 0.1 + TS, 2 * TS, ylabel="$H$")
    wide, narrow = (area.get_paths()[0].vertices[:, 1] for area in ax.collections)
    np.testing.assert_allclose([wide.min(), wide.max()], 1 + 1.1 * 1.645 * np.array([-1, 1]))
    np.testing.assert_allclose(narrow.max(), 1 + 1.1 * 0.674)
    with pytest.raises(ValueError, match="negative"):
        plot.band(TS, TS, -TS)
    with pytest.raises(ValueError, match=r"all must be \(T,\)"):
        plot.band(TS, TS[:3], TS)


def test_a_deviation_is_its_length_and_a_star_where_it_is_largest():
    ax = plot.deviation(lambda x: jnp.abs(x), (-1, 2), (-1, 1), np.zeros((3, 2)), resolution=7)
    (star,) = [line for line in ax.lines if line.get_marker() == "*"]
    assert abs(star.get_xydata()[0]).tolist() == [2.0, 1.0]
    with pytest.raises(ValueError, match=r"data has shape \(3,\)"):
        plot.deviation(jnp.abs, (-1, 1), (-1, 1), np.zeros(3))
    with pytest.raises(ValueError, match="limits"):
        plot.deviation(jnp.abs, (1, -1), (-1, 1))
