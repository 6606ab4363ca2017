"""Functions of two variables as contours."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from jaxtyping import Array, ArrayLike, Float
from matplotlib.axes import Axes
from matplotlib.colors import LogNorm
from matplotlib.ticker import MaxNLocator

from hamkernel.plot._style import (
    Limits,
    Texts,
    axes,
    drawn,
    grid,
    in_plane,
    legend,
    plane_labels,
    two,
)

Scalar = Callable[[Float[Array, "2"]], Float[Array, ""]]


@drawn
def hamiltonian(
    learned: Scalar,
    true: Scalar,
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

    Velocities determine H up to a constant, so the learned one is shifted by the mean difference
    over the grid; both are drawn relative to the minimum of the true one. Where a function is not
    finite the picture stays white. To draw a learned H alone, use
    `plane_slice(field.hamiltonian, jnp.zeros(2), (0, 1), xlim, ylim)`.

    Args:
        learned: x (2,) -> (), such as `field.hamiltonian`.
        true: x (2,) -> (), such as `system.hamiltonian`.
        xlim: limits of q.
        ylim: limits of p.
        ax: two axes, for the true and the learned one; new ones if None.
        titles: of the two axes.
        units: of q and p.
        names: of the coordinates; q and p if None.
        energy_unit: of H.
        levels: the largest number of contours, or the levels themselves.
        resolution: points on each axis of the grid.

    Returns:
        The two axes.

    Raises:
        ValueError: a function is not scalar or not one of the plane, nowhere on the grid are both
            finite, or an argument is not a pair.
    """
    titles, labels = two("titles", titles), plane_labels((0, 1), 2, units, names)
    panels = None if ax is None else two("ax", ax)
    q, p, points = grid(xlim, ylim, resolution)
    need = "a scalar function, such as field.hamiltonian,"
    H, H_learned = (in_plane(fn, points, (), need).reshape(len(p), -1) for fn in (true, learned))
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


@drawn
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
        losses: shape (A, B).
        path: the optimiser's steps (first, second), shape (K, 2), from start to end; one row to
            show only the end.
        ax: axes to draw on; new ones if None.
        names: of the hyperparameters.
        label: of the loss.
        title: of the axes.
        levels: number of contours.

    Raises:
        ValueError: the shapes do not fit, a hyperparameter is not positive, no loss is finite and
            positive, or `names` is not a pair.
    """
    names = two("names", names)
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
    bar.set_ticks(ticks, labels=_in_one_format(ticks))
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


def _in_one_format(values: list[float]) -> list[str]:
    """Numbers all with or all without an exponent, with enough digits to distinguish them."""
    plain = 1e-3 <= values[0] and values[-1] < 1e5
    for digits in range(2, 8):
        texts = [f"{value:.{digits - 1}e}" for value in values]
        if plain:
            texts = [np.format_float_positional(float(text), trim="-") for text in texts]
        if len(set(texts)) == len(texts):
            break
    return texts
