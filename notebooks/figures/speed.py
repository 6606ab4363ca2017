"""Draws speed.png: the times of the table in docs/speed.md, beside those of the peers.

python notebooks/figures/speed.py [folder]

The numbers are those that `tests/benchmarks/speed.py` printed on 2026-11-24.
"""

import sys
from pathlib import Path

from matplotlib.figure import Figure

OURS, PEER = "#0072B2", "0.65"
MILLISECONDS = {
    "dense Gram\nN = 1000, n = 4": {
        "hamkernel": 35,
        "NumPy, closed form": 327,
        "GPyTorch": 1250,
    },
    "product with the Gram\nN = 20 000, n = 4": {"hamkernel": 870, "KeOps": 3180},
    "product with the Gram\nN = 20 000, n = 20": {"hamkernel": 1370, "KeOps": 8880},
    "exact fit, N n = 4000": {
        "hamkernel, with its Gram": 445,
        "SciPy, Gram given": 380,
        "scikit-learn, Gram given": 565,
    },
}


def main(folder: Path) -> None:
    figure = Figure(figsize=(8.0, 4.2), layout="constrained", facecolor="white")
    axes = figure.subplots(2, 2)
    for ax, (task, times) in zip(axes.flat, MILLISECONDS.items(), strict=True):
        names = list(times)[::-1]
        values = [times[name] for name in names]
        colors = [OURS if name.startswith("hamkernel") else PEER for name in names]
        bars = ax.barh(names, values, color=colors, height=0.65)
        labels = [f"{t} ms" if t < 1000 else f"{t / 1000:.1f} s" for t in values]
        ax.bar_label(bars, labels, padding=3, fontsize=9)
        ax.set_title(task, fontsize=10)
        ax.set_xlim(0, 1.25 * max(values))
        ax.set_ylim(len(names) - 3.6, len(names) - 0.4)  # bars of the same height everywhere
        ax.set_xticks([])
        ax.spines[["top", "right", "bottom"]].set_visible(False)
    figure.suptitle("Time, shorter is better: 2 CPU cores, float64, least of several", fontsize=11)
    figure.savefig(folder / "speed.png", dpi=150)


if __name__ == "__main__":
    main(Path(sys.argv[1]) if len(sys.argv) > 1 else Path(__file__).parent)
