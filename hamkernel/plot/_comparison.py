"""The table of `hk.compare` as bars, with its answers."""

from __future__ import annotations

from matplotlib.axes import Axes

from hamkernel._discovery.compare import QUESTIONS, THRESHOLD, Comparison
from hamkernel.plot._style import COLORS, STREAM, axes, drawn

_SHOWN = 60.0  # beyond, a bar ends at the edge: e⁶⁰ to one needs no comparing


@drawn
def comparison(compared: Comparison, ax: Axes | None = None) -> Axes:
    """How far the score of each candidate is below the best, the best on top, and the answers.

    Candidates within the threshold, the dashed line, are not told apart by the data. Bars longer
    than 60 end at the edge and carry their number.

    Args:
        compared: what `hk.compare` returned.
        ax: the axes to draw on; those of a new figure if None.

    Returns:
        The axes.
    """
    count = len(compared.table)
    ax = axes(ax, figsize=(7.0, 0.8 + 0.27 * count))
    for place, row in enumerate(compared.table):
        behind = -row.difference
        near = behind <= THRESHOLD
        color = COLORS["symplectic"] if near else STREAM
        ax.barh(place, min(behind, _SHOWN), color=color, height=0.7)
        ax.text(min(behind, _SHOWN) + 0.6, place, f"{behind:.1f}", va="center", fontsize="small")
    ax.axvline(THRESHOLD, color=COLORS["true"], linestyle="--", linewidth=1)
    ax.set_yticks(range(count), [row.name for row in compared.table])
    ax.invert_yaxis()
    ax.set_xlim(0.0, 1.12 * _SHOWN)
    ax.set_xlabel("score below the best (log evidence)")
    pairs = QUESTIONS.items()
    answers = [f"{question.rstrip('?')}: {compared.answers[key]}" for key, question in pairs]
    ax.set_title("\n".join((", ".join(answers[:3]), ", ".join(answers[3:]))), fontsize="small")
    return ax
