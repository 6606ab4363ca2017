"""Draws pendulum.png, the picture at the top of the README.

python notebooks/figures/pendulum.py [folder]
"""

import sys
from pathlib import Path

import jax

jax.config.update("jax_enable_x64", True)

import jax.numpy as jnp
import numpy as np
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

import hamkernel as hk

TRUE, WITHOUT, WITH, DATA = "black", "#D55E00", "#0072B2", "#E69F00"
BOX = {"xlim": (-3.1, 3.1), "ylim": (-8.0, 8.0), "units": ("rad", "kg m²/s")}


def main(folder: Path) -> None:
    pendulum = hk.systems.Pendulum(mass=1.0)
    starts = jnp.array([[0.4 * jnp.pi, 0.0], [0.8 * jnp.pi, 0.0], [0.95 * jnp.pi, -4.0]])
    sampled = hk.systems.sample(
        pendulum,
        starts,
        jnp.linspace(0.0, 0.7, 8),
        state_noise=0.01,
        velocity_noise=0.01,
        key=jax.random.key(0),
    )
    X, Y = (a.reshape(-1, 2) for a in sampled)
    k = hk.Gaussian(3.0)
    kernels = {"Separable(k)": hk.Separable(k), "Odd(hk.Symplectic(k))": hk.Odd(hk.Symplectic(k))}
    found = {name: hk.tune(K, X, Y, folds=np.repeat(np.arange(3), 8)) for name, K in kernels.items()}
    for name, tuned in found.items():
        print(name, tuned.kernel, float(tuned.regularization))

    ts = jnp.linspace(0.0, 6.0, 601)

    def orbits(field):
        paths = [hk.simulate(field, x0, ts, throw=False).ys for x0 in starts]
        return [np.asarray(path)[np.isfinite(path).all(axis=1)] for path in paths]

    figure = Figure(figsize=(8.0, 4.6), layout="constrained", facecolor="white")
    left, right = figure.subplots(1, 2, sharey=True)
    titles = ("no structure", "energy conserved, mirror-symmetric")
    for ax, (name, tuned), color, title in zip(
        (left, right), found.items(), (WITHOUT, WITH), titles, strict=True
    ):
        hk.plot.phase_portrait(tuned.field, **BOX, ax=ax, show_legend=False)
        ax.set_title(f"{title}\nhk.{name}", fontsize=11)
        for path in orbits(pendulum):
            ax.plot(*path.T, color=TRUE, linewidth=3.0, alpha=0.35)
        for path in orbits(tuned.field):
            ax.plot(*path.T, color=color, linewidth=1.8)
        ax.plot(*X.T, "o", color=DATA, markeredgecolor="black", markersize=5.5)
    right.set_ylabel("")
    legend = [
        Line2D([], [], color=DATA, marker="o", markeredgecolor="black", linestyle=""),
        Line2D([], [], color=TRUE, linewidth=3.0, alpha=0.35),
        Line2D([], [], color=WITHOUT, linewidth=1.8),
        Line2D([], [], color=WITH, linewidth=1.8),
    ]
    names = ["24 noisy points", "true motion", "learned, no structure", "learned, with structure"]
    figure.legend(legend, names, loc="outside lower center", ncols=4, frameon=False, fontsize=9.5)
    figure.suptitle(
        r"hk.fit solves $(G + N\lambda I)\,a = y$; lengthscale and $\lambda$ tuned by hk.tune, one fold per run",
        fontsize=10.5,
    )
    figure.savefig(folder / "pendulum.png", dpi=150)


if __name__ == "__main__":
    main(Path(sys.argv[1]) if len(sys.argv) > 1 else Path(__file__).parent)
