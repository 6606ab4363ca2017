"""Draws prediction.png, what the ten lines of the README learn, with its uncertainty.

python notebooks/figures/prediction.py [folder]
"""

import re
import sys
from pathlib import Path

import matplotlib as mpl

mpl.use("Agg")
import jax
import jax.numpy as jnp
import numpy as np
from matplotlib.figure import Figure

import hamkernel as hk

ROOT = Path(__file__).parents[2]
LEARNED, TRUE, DATA = "#0072B2", "black", "#E69F00"
DRAWS = 40


def ten_lines() -> dict:
    """The names that the code of the README defines."""
    names: dict = {}
    exec(re.findall(r"```python\n(.*?)```", (ROOT / "README.md").read_text(), re.DOTALL)[0], names)
    return names


def energy(ax, posterior, pendulum) -> None:
    q = jnp.linspace(-3.1, 3.1, 125)
    states, rest = jnp.stack([q, jnp.zeros_like(q)], axis=1), jnp.zeros(2)
    learned = posterior.field.anchored(rest).hamiltonian
    true = jax.vmap(pendulum.hamiltonian)(states) - pendulum.hamiltonian(rest)
    band = 2 * jax.vmap(lambda x: posterior.energy_deviation(x, rest))(states)
    ax.fill_between(q, -band, band, color=LEARNED, alpha=0.25, lw=0, label="± 2 deviations")
    ax.plot(q, jax.vmap(learned)(states) - true, color=LEARNED, lw=1.6)
    ax.axhline(0.0, ls="--", color=TRUE, lw=1.2)
    for edge in (-2.4, 2.4):
        ax.axvline(edge, color="0.6", lw=0.8)
    ax.text(
        0.0,
        0.93,
        "where the log is",
        ha="center",
        fontsize=9,
        color="0.35",
        transform=ax.get_xaxis_transform(),
    )
    ax.set(xlim=(-3.1, 3.1), xlabel="$q$ [rad], at rest")
    ax.set(ylabel="$\\Delta H$, learned − true [J]", title="error of the energy, 19.6 J at the top")


def ensemble(ax, posterior, pendulum) -> None:
    start, ts = jnp.array([2.75, 0.0]), jnp.linspace(0.0, 10.0, 201)
    fields = posterior.sample(jax.random.key(1), DRAWS, np.array([[-3.2, -8.0], [3.2, 8.0]]))
    run = jax.jit(jax.vmap(lambda field: hk.simulate(field, start, ts).ys))
    for path in np.asarray(run(fields)):
        ax.plot(ts, path[:, 0], color=LEARNED, lw=0.6, alpha=0.45)
    ax.plot(ts, hk.simulate(pendulum, start, ts).ys[:, 0], "--", color=TRUE, lw=1.2)
    ax.set(xlim=(0, 10), xlabel="time [s]", ylabel="$q$ [rad]")
    ax.set_title(f"{DRAWS} draws from (2.75, 0), outside the log")


def main(folder: Path) -> None:
    names = ten_lines()
    posterior, pendulum = names["learned"].posterior, names["pendulum"]
    figure = Figure(figsize=(12.0, 3.9), layout="constrained", facecolor="white")
    left, middle, right = figure.subplots(1, 3)
    hk.plot.phase_portrait(
        names["field"], (-3.1, 3.1), (-8, 8), ax=left, show_legend=False, units=("rad", "kg m²/s")
    )
    states = np.asarray(names["log"]).reshape(-1, 2)
    left.plot(*states.T, "o", color=DATA, ms=3.5, mec="black", mew=0.4, label="log")
    left.plot(*np.asarray(names["orbit"]).T, color=LEARNED, lw=1.8, label="learned")
    left.plot([], [], "--", color=TRUE, lw=1.2, label="true")
    left.set_title("prediction from (1.8, 0)")
    energy(middle, posterior, pendulum)
    ensemble(right, posterior, pendulum)
    figure.legend(loc="outside lower center", ncols=4, frameon=False)
    figure.savefig(folder / "prediction.png", dpi=120)


if __name__ == "__main__":
    main(Path(sys.argv[1]) if len(sys.argv) > 1 else Path(__file__).parent)
