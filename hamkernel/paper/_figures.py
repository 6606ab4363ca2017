"""The paper's figures: phase portraits, and the test trajectory with its error."""

import pathlib
from collections.abc import Mapping

import numpy as np
from matplotlib.figure import Figure
from tqdm import tqdm

from hamkernel import plot
from hamkernel.paper._experiments import GRID, Comparison, Experiment, Outcome, experiments

Models = Mapping[str, Outcome]

_DPI = 150  # 1200 pixels over 8 inches, sharp at the 800 pixels of a README


def paper_figures(
    outcomes: Mapping[str, Mapping[str, Models]], out: pathlib.Path, progress: bool = True
) -> list[pathlib.Path]:
    """Write the figures of each experiment and reading; return their paths.

    Args:
        outcomes: the outcomes by experiment, reading and model.
        out: an existing folder.
        progress: show a progress bar if the standard error is a terminal.
    """
    every = experiments()
    runs = [
        (name, reading, kind, draw)
        for name, readings in outcomes.items()
        for reading in readings
        for kind, draw in {"portraits": portraits, "test_trajectory": tracking}.items()
    ]
    paths = []
    for name, reading, kind, draw in tqdm(runs, "figures", disable=None if progress else True):
        figure = draw(every[name], reading, outcomes[name][reading])
        path = out / f"{name}_{reading.replace('*', '_')}_{kind}.png"
        figure.savefig(path, dpi=_DPI)
        paths.append(path)
    return paths


def tuning_figure(
    comparisons: Mapping[str, Mapping[str, Comparison]], out: pathlib.Path
) -> pathlib.Path:
    """Write the loss of one experiment over its hyperparameters; return the path.

    Args:
        comparisons: the comparisons by experiment and model.
        out: an existing folder.
    """
    name = "pendulum_m1"
    path = out / f"{name}_tuning.png"
    figure = tuning(experiments()[name], comparisons[name]["odd_symplectic"])
    figure.savefig(path, dpi=_DPI)
    return path


def tuning(experiment: Experiment, comparison: Comparison) -> Figure:
    """Return the cross-validation loss over (σ, λ), with the ends of both searches, seed 0."""
    figure = Figure(figsize=(8, 5), layout="constrained")
    end = comparison.gradient.lengthscale[0], comparison.gradient.regularization[0]
    plot.loss_surface(
        *GRID,
        comparison.surface,
        np.array([end]),
        figure.subplots(),
        title=f"{experiment.title}, odd symplectic, seed 0",
    )
    return figure


def portraits(experiment: Experiment, reading: str, models: Models) -> Figure:
    """Return stream lines and trajectories of the true system, data and learned fields.

    The panels are those of figures 1 and 2 of the paper, with noise seed 0.
    """
    separable = models["separable"]
    panels = [
        ("True system", experiment.system, {"true": separable.true_orbits}, None),
        ("Data set", experiment.system, None, separable.field.points),
    ]
    for name in ("separable", "odd_symplectic"):
        title = f"Learned, {name.replace('_', ' ')}"
        panels.append((title, models[name].field, {name: models[name].orbits}, None))
    figure = Figure(figsize=(8, 7.2), layout="constrained")
    for ax, (title, field, curves, data) in zip(figure.subplots(2, 2).flat, panels, strict=True):
        plot.phase_portrait(
            field,
            *experiment.box,
            data,
            curves,
            ax,
            title=title,
            units=experiment.units,
            show_legend=False,
        )
    figure.suptitle(_title(experiment, reading))
    return figure


def tracking(experiment: Experiment, reading: str, models: Models) -> Figure:
    """Return the test trajectory of noise seed 0, and the error over time of all seeds."""
    figure = Figure(figsize=(8, 3.7), layout="constrained")
    left, right = figure.subplots(1, 2, width_ratios=(1, 1.45))
    first = next(iter(models.values()))
    curves = {"true": first.true, **{name: model.learned[0] for name, model in models.items()}}
    plot.trajectories(
        curves, left, units=experiment.units, title="Test trajectory, seed 0", show_legend=False
    )
    errors = {name: np.asarray(model.error) for name, model in models.items()}
    seeds = len(first.error)
    plot.trajectory_error(
        first.ts,
        errors,
        right,
        time_unit="s",
        title=f"Error, median and 10 to 90 % of {seeds} seeds",
        show_legend=False,
    )
    figure.legend(
        *left.get_legend_handles_labels(), loc="outside lower center", ncols=4, frameon=False
    )
    figure.suptitle(_title(experiment, reading))
    return figure


def _title(experiment: Experiment, reading: str) -> str:
    ridge = {"lambda": r"$G + \lambda I$", "N*lambda": r"$G + N\lambda I$"}
    return f"{experiment.title}, {ridge.get(reading, reading)}"
