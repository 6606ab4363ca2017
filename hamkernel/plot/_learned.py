"""Contours of learned energies and of losses, error bars, and the comparison of structures."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float
from matplotlib.axes import Axes
from matplotlib.colors import LogNorm
from matplotlib.ticker import MaxNLocator

from hamkernel._discovery.compare import QUESTIONS, THRESHOLD, Comparison
from hamkernel.plot._style import (
    BLUE,
    COLORS,
    STREAM,
    Limits,
    Texts,
    as_pair,
    axes,
    dots,
    evaluate_in_plane,
    grid,
    legend,
    plane_data,
    plane_labels,
    refuse_tracers,
    with_unit,
)

ScalarField = Callable[[Float[Array, "2"]], Float[Array, ""]]


@refuse_tracers
def hamiltonian(
    learned: ScalarField,
    true: ScalarField,
    xlim: Limits,
    ylim: Limits,
    ax: Sequence[Axes] | None = None,
    *,
    titles: tuple[str, str] = ("True $H$", "Learned $H$"),
    units: Texts | None = None,
    names: Texts | None = None,
    energy_unit: str | None = None,
    levels: int | Float[ArrayLike, " L"] = 12,
    resolution: int = 81,
) -> tuple[Axes, Axes]:
    """Draw the true and the learned Hamiltonian side by side, on the same contours.

    Velocities determine H up to a constant, so the learned H is shifted by the mean difference of
    both over the grid. Both are drawn relative to the minimum of the true H. The picture stays
    white where a function is not finite. To draw a learned H alone, use
    `plane_slice(field.hamiltonian, jnp.zeros(2), (0, 1), xlim, ylim)`.

    Args:
        learned: x (2,) -> (), such as `field.hamiltonian`.
        true: x (2,) -> (), such as `system.hamiltonian`.
        xlim: limits of q.
        ylim: limits of p.
        ax: two axes, for the true and the learned one; new ones if None.
        titles: the titles of the two axes.
        units: the units of q and p.
        names: the names of the coordinates; q and p if None.
        energy_unit: the unit of H.
        levels: the largest number of contours, or the levels themselves.
        resolution: points on each axis of the grid.

    Returns:
        The two axes.

    Raises:
        ValueError: a function is not scalar or not one of the plane, nowhere on the grid are both
            finite, or an argument is not a pair.
    """
    titles, labels = as_pair("titles", titles), plane_labels((0, 1), 2, units, names)
    panels = None if ax is None else as_pair("ax", ax)
    q, p, points = grid(xlim, ylim, resolution)
    need = "a scalar function, such as field.hamiltonian,"
    H, H_learned = (
        evaluate_in_plane(fn, points, (), need).reshape(len(p), -1) for fn in (true, learned)
    )
    H, H_learned = np.ma.masked_invalid(H), np.ma.masked_invalid(H_learned)
    if (H + H_learned).count() == 0:
        raise ValueError("nowhere on the grid are both functions finite.")
    H_learned = H_learned - (H_learned - H).mean()
    H, H_learned = H - H.min(), H_learned - H.min()
    left, right = panels or _pair()
    if isinstance(levels, int | np.integer):
        steps = MaxNLocator(int(levels)).tick_values(0, float(H.max()))
    else:
        steps = np.asarray(levels)
    for panel, values, title in zip((left, right), (H, H_learned), titles, strict=True):
        filled = panel.contourf(q, p, values, steps, cmap="cividis", extend="both")
        panel.contour(q, p, values, steps[1:], colors="white", linewidths=0.5)
        panel.set(title=title, **labels)
    right.set_ylabel("")
    label = r"$H - \min H_\mathrm{true}$" + (f" [{energy_unit}]" if energy_unit else "")
    left.figure.colorbar(filled, ax=[left, right], label=label)
    return left, right


def _pair() -> tuple[Axes, Axes]:
    import matplotlib.pyplot as plt  # starts a backend, so only where a figure must be made

    _, (left, right) = plt.subplots(1, 2, layout="constrained", figsize=(8, 3.6), sharey=True)
    return left, right


@refuse_tracers
def loss_surface(
    first: Float[ArrayLike, " A"],
    second: Float[ArrayLike, " B"],
    losses: Float[ArrayLike, "A B"],
    path: Float[ArrayLike, "K 2"] | None = None,
    ax: Axes | None = None,
    *,
    names: tuple[str, str] = (r"lengthscale $\sigma$", r"regularization $\lambda$"),
    label: str = "cross-validation loss",
    title: str | None = None,
    levels: int = 16,
) -> Axes:
    """Draw a loss over two positive hyperparameters, and the path of an optimiser on it.

    All three axes are logarithmic. Where the loss is not finite and positive, the picture stays
    white.

    Args:
        first: values of the first hyperparameter, shape (A,).
        second: values of the second, shape (B,).
        losses: the loss at each pair of values, shape (A, B).
        path: the optimiser's steps (first, second), shape (K, 2), from start to end; one row to
            show only the end.
        ax: axes to draw on; new ones if None.
        names: the names of the hyperparameters.
        label: the name of the loss, beside its colours.
        title: the title of the axes.
        levels: number of contours.

    Raises:
        ValueError: the shapes do not fit, a hyperparameter is not positive, no loss is finite and
            positive, or `names` is not a pair.
    """
    names = as_pair("names", names)
    first, second, losses = np.asarray(first), np.asarray(second), np.asarray(losses)
    if losses.shape != (len(first), len(second)):
        raise ValueError(
            f"losses has shape {losses.shape}; ({len(first)}, {len(second)}) is needed, one row "
            "for each value of the first hyperparameter."
        )
    if not ((first > 0).all() and (second > 0).all()):
        raise ValueError("the hyperparameters must be positive, for their axes are logarithmic.")
    shown = np.ma.masked_where(~(np.isfinite(losses) & (losses > 0)), losses)
    if shown.count() == 0:
        raise ValueError("no loss is finite and positive, so there is nothing to draw.")
    ax = axes(ax, figsize=(5.8, 4.4))
    low, high = float(shown.min()), float(shown.max())
    steps = np.geomspace(low, max(high, low * 1.001), levels + 1)
    filled = ax.contourf(
        first, second, shown.T, steps, norm=LogNorm(steps[0], steps[-1]), cmap="cividis"
    )
    ax.contour(first, second, shown.T, steps, colors="white", linewidths=0.4)
    bar = ax.figure.colorbar(filled, ax=ax, label=label)
    ticks = steps[:: max(1, levels // 5)].tolist()
    bar.set_ticks(ticks, labels=_number_labels(ticks))
    bar.ax.minorticks_off()
    i, j = np.unravel_index(np.ma.argmin(shown), shown.shape)
    best = {"ms": 13, "mec": "black", "mfc": "white", "mew": 0.8, "linestyle": "none"}
    ax.plot(first[i], second[j], "*", label="best of the grid", zorder=5, clip_on=False, **best)
    if path is not None:
        path = np.asarray(path)
        red, end = "#D55E00", "end of the optimiser"
        if len(path) > 1:
            ax.plot(*path.T, "-o", color=red, ms=3.5, linewidth=1.5, label="optimiser", zorder=4)
            end = "its end"
        ax.plot(*path[-1], "D", color=red, mec="black", ms=7, zorder=6, label=end, linestyle="none")
    ax.set(xscale="log", yscale="log", xlabel=names[0], ylabel=names[1])
    ax.set(xlim=(first.min(), first.max()), ylim=(second.min(), second.max()))
    if title is not None:
        ax.set_title(title)
    legend(ax)
    return ax


def _number_labels(values: list[float]) -> list[str]:
    """Numbers all with or all without an exponent, with enough digits to distinguish them."""
    plain = 1e-3 <= values[0] and values[-1] < 1e5
    for digits in range(2, 8):
        texts = [f"{value:.{digits - 1}e}" for value in values]
        if plain:
            texts = [np.format_float_positional(float(text), trim="-") for text in texts]
        if len(set(texts)) == len(texts):
            break
    return texts


@refuse_tracers
def ensemble(
    ys: Float[ArrayLike, "S T n"],
    true: Float[ArrayLike, "T n"] | None = None,
    ax: Axes | None = None,
    *,
    dims: tuple[int, int] = (0, 1),
    color: str = BLUE,
    title: str | None = None,
    units: Texts | None = None,
    names: Texts | None = None,
    label: str | None = "draws",
) -> Axes:
    """Draw many orbits, thin and transparent: the picture is dark where most of them pass.

    Args:
        ys: an orbit of each sampled field, shape (S, T, n):
            `jax.vmap(lambda f: hk.simulate(f, x0, ts).ys)(posterior.sample(key, S, region))`.
        true: the true orbit, shape (T, n), drawn on top.
        ax: axes to draw on; new ones if None.
        dims: the two coordinates, counted from 0.
        color: the colour of the ensemble.
        title: the title of the axes.
        units: the units of the two coordinates.
        names: the names of the two coordinates, if not q and p.
        label: the name of the ensemble in the legend.

    Raises:
        ValueError: an array is of another shape, `dims` are not two of the coordinates, or an
            argument is not a pair.
    """
    ys = np.asarray(ys)
    if ys.ndim != 3:
        raise ValueError(f"ys has shape {ys.shape}; an orbit of each draw, (S, T, n), is needed.")
    if true is not None and np.shape(true)[-1:] != ys.shape[2:]:
        raise ValueError(f"true has shape {np.shape(true)}; (T, {ys.shape[2]}) is needed.")
    labels = plane_labels(dims, ys.shape[2], units, names)
    ax = axes(ax, figsize=(4.8, 4.4))
    # Orbits that coincide are as dark as one line, and a single orbit stays visible.
    alpha = float(np.clip(8 / len(ys), 0.06, 0.6))
    for i, orbit in enumerate(ys):
        name = label if i == 0 else None
        ax.plot(*orbit[:, list(dims)].T, color=color, alpha=alpha, linewidth=0.8, label=name)
    ax.plot(*ys[0, 0, list(dims)], "o", color=color, ms=5, zorder=4)
    if true is not None:
        path = np.asarray(true)[:, list(dims)]
        ax.plot(*path.T, color=COLORS["true"], linewidth=1.4, zorder=3, label="true")
    if ax.get_legend_handles_labels()[0]:
        for line in ax.legend(fontsize="small", framealpha=0.9).get_lines():
            line.set_alpha(1.0)
    ax.set(title=title or "", **labels)
    return ax


@refuse_tracers
def band(
    ts: Float[ArrayLike, " T"],
    mean: Float[ArrayLike, " T"],
    deviation: Float[ArrayLike, " T"],
    true: Float[ArrayLike, " T"] | None = None,
    ax: Axes | None = None,
    *,
    color: str = BLUE,
    xlabel: str = "time $t$",
    ylabel: str = "",
    unit: str | None = None,
    title: str | None = None,
    show_legend: bool = True,
) -> Axes:
    """Draw a mean with the bands that contain the truth with a probability of 50 and 90 %.

    Args:
        ts: times, or another abscissa, shape (T,).
        mean: the mean at each time, shape (T,).
        deviation: standard deviations, shape (T,), such as those of `posterior.energy_deviation`.
        true: the true values, shape (T,).
        ax: axes to draw on; new ones if None.
        color: the colour of the mean and of the bands.
        xlabel: the name of the abscissa.
        ylabel: the name of the mean.
        unit: the unit of the mean.
        title: the title of the axes.
        show_legend: whether to name the bands, the mean and the true values.

    Raises:
        ValueError: shapes are not all (T,), or a deviation is negative.
    """
    arrays = [np.asarray(a) for a in (ts, mean, deviation, *([] if true is None else [true]))]
    ts, mean, deviation, *rest = arrays
    if ts.ndim != 1 or any(array.shape != ts.shape for array in arrays):
        shapes = ", ".join(str(array.shape) for array in arrays)
        raise ValueError(f"the arrays have shapes {shapes}; all must be (T,).")
    if (deviation < 0).any():
        raise ValueError("deviation is negative somewhere: standard deviations are needed.")
    ax = axes(ax, figsize=(5.6, 3.6))
    # A share of a normal variable, the standard deviations that hold it, and its shade.
    for share, width, shade in ((0.9, 1.645, 0.18), (0.5, 0.674, 0.38)):
        reach = width * deviation
        name = f"{100 * share:.0f} % band"
        ax.fill_between(
            ts, mean - reach, mean + reach, color=color, alpha=shade, linewidth=0, label=name
        )
    ax.plot(ts, mean, color=color, linewidth=1.4, label="mean")
    for values in rest:
        ax.plot(ts, values, color=COLORS["true"], linewidth=1.2, linestyle="--", label="true")
    ax.set(xlabel=xlabel, ylabel=with_unit(ylabel, unit), title=title or "")
    ax.set_xlim(ts.min(), ts.max())
    if show_legend:
        legend(ax)
    return ax


@refuse_tracers
def deviation(
    fn: Callable[[Float[Array, "2"]], Array],
    xlim: Limits,
    ylim: Limits,
    data: Float[ArrayLike, "N 2"] | None = None,
    ax: Axes | None = None,
    *,
    label: str = "standard deviation",
    title: str | None = None,
    units: Texts | None = None,
    names: Texts | None = None,
    resolution: int = 41,
) -> Axes:
    """Draw the standard deviation of a learned field or H over the plane, and mark its maximum.

    Args:
        fn: x (2,) -> (), or (2,) to draw its length: `posterior.deviation`, or
            `lambda x: posterior.energy_deviation(x, x0)`.
        xlim: limits of q.
        ylim: limits of p.
        data: measured states, shape (N, 2).
        ax: axes to draw on; new ones if None.
        label: the name of the colours.
        title: the title of the axes.
        units: the units of q and p.
        names: the names of the coordinates; q and p if None.
        resolution: points on each axis of the grid.

    Raises:
        ValueError: the function or the data is not in the plane, the limits do not rise, or an
            argument is not a pair.
    """
    labels = plane_labels((0, 1), 2, units, names)
    q, p, points = grid(xlim, ylim, resolution)
    X = plane_data(data)
    length = jax.tree_util.Partial(_length, fn)
    values = evaluate_in_plane(length, points, (), "a deviation")
    ax = axes(ax, figsize=(5.4, 4.4))
    filled = ax.contourf(q, p, values.reshape(len(p), -1), 14, cmap="cividis")
    ax.figure.colorbar(filled, ax=ax, label=label)
    dots(ax, X, clip_on=False)
    star = {"color": "white", "mec": "black", "mew": 0.8, "ms": 13, "linestyle": "none"}
    ax.plot(*points[values.argmax()], "*", label="largest", zorder=6, clip_on=False, **star)
    ax.set(title=title or "", xlim=xlim, ylim=ylim, **labels)
    legend(ax)
    return ax


def _length(fn: Callable[[Array], Array], x: Float[Array, "2"]) -> Float[Array, ""]:
    return jnp.linalg.norm(jnp.atleast_1d(fn(x)))


@refuse_tracers
def comparison(compared: Comparison, ax: Axes | None = None) -> Axes:
    """Draw how far the score of each candidate is below the best, and the answers as the title.

    The best candidate is on top. The dashed line is the threshold: the data do not decide between
    the candidates on its left. A bar longer than 60 ends at the edge; its number is beside it.

    Args:
        compared: the result of `hk.compare`.
        ax: the axes to draw on; those of a new figure if None.

    Returns:
        The axes.
    """
    if not isinstance(compared, Comparison):
        raise TypeError(
            f"the result of hk.compare is needed, a Comparison; got a {type(compared).__name__}."
        )
    count = len(compared.table)
    ax = axes(ax, figsize=(7.0, 0.8 + 0.27 * count))
    longest = 60.0  # e⁶⁰ to one needs no comparing
    for place, row in enumerate(compared.table):
        behind = -row.difference
        near = behind <= THRESHOLD
        color = COLORS["symplectic"] if near else STREAM
        ax.barh(place, min(behind, longest), color=color, height=0.7)
        ax.text(min(behind, longest) + 0.6, place, f"{behind:.1f}", va="center", fontsize="small")
    ax.axvline(THRESHOLD, color=COLORS["true"], linestyle="--", linewidth=1)
    ax.set_yticks(range(count), [row.name for row in compared.table])
    ax.invert_yaxis()
    ax.set_xlim(0.0, 1.12 * longest)
    ax.set_xlabel("score below the best (log evidence)")
    pairs = QUESTIONS.items()
    answers = [f"{question.rstrip('?')}: {compared.answers[key]}" for key, question in pairs]
    ax.set_title("\n".join((", ".join(answers[:3]), ", ".join(answers[3:]))), fontsize="small")
    return ax
