"""All experiments, readings and kernels; the results as plain numbers."""

import json
import pathlib
from collections.abc import Callable, Mapping

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float
from tqdm import tqdm

from hamkernel.paper._evaluate import Outcome, datasets, evaluate
from hamkernel.paper._experiments import READINGS, experiments
from hamkernel.paper._report import Results, report, tuning_report
from hamkernel.paper._tuned import Choice, Comparison, compare

# experiment -> reading -> model -> its tests
Outcomes = dict[str, dict[str, dict[str, Outcome]]]
# experiment -> model -> both ways to tune it
Comparisons = dict[str, dict[str, Comparison]]
Data = Mapping[str, tuple[Float[Array, "S N n"], Float[Array, "S N n"]]]

TUNED_SEEDS = 20  # of the seeds: enough for a median


def reproduce(
    out: str | pathlib.Path = "results",
    seeds: int = 100,
    *,
    progress: bool = True,
    show: Callable[[str], None] | None = None,
) -> tuple[str, list[pathlib.Path]]:
    """Run the paper's experiments, write `results.json` and the figures, return a report.

    Noise seed i is `jax.random.key(i)`, i = 0 … seeds − 1, the same for all kernels and readings.

    Args:
        out: folder for the files, made if it is missing. The layout of `results.json` is that of
            `summarise`.
        seeds: number of noise seeds, ≥ 1.
        progress: show a progress bar where the standard error is a terminal.
        show: called with the report as soon as it is there, before the figures are drawn.

    Returns:
        The report, for printing, and the files written.

    Raises:
        ValueError: seeds < 1. OSError: the folder cannot be made. RuntimeError: JAX is not in
            float64, or a fit failed.
    """
    path = pathlib.Path(out) / "results.json"
    path.parent.mkdir(parents=True, exist_ok=True)  # before the work
    outcomes = _outcomes(_data(seeds), progress)
    results = summarise(outcomes)
    _write(results, path)
    text = report(results, experiments(), seeds)
    if show is not None:
        show(text)
    # matplotlib loads after the numbers are safe
    from hamkernel.paper._figures import paper_figures

    return text, [path, *paper_figures(outcomes, path.parent, progress)]


def retune(
    out: str | pathlib.Path = "results",
    seeds: int = 100,
    *,
    progress: bool = True,
    show: Callable[[str], None] | None = None,
) -> tuple[str, list[pathlib.Path]]:
    """Tune the hyperparameters on the data of `reproduce`, by grid search and by gradient.

    Of the seeds the first 20 are taken. `results.json` gains the reading "tuned".

    Args:
        out: folder that `reproduce` wrote its results to.
        seeds: number of noise seeds, ≥ 1.
        progress: show a progress bar where the standard error is a terminal.
        show: called with the report as soon as it is there, before the figures are drawn.

    Returns:
        The report, for printing, and the files written.

    Raises:
        FileNotFoundError: `reproduce` has not been run. ValueError: seeds < 1. RuntimeError: JAX
            is not in float64, or a fit failed.
    """
    path = pathlib.Path(out) / "results.json"
    if not path.exists():
        raise FileNotFoundError(f"no {path}: run hamkernel.paper.reproduce({str(out)!r}) first.")
    seeds = min(seeds, TUNED_SEEDS)
    comparisons = _comparisons(_data(seeds), progress)
    results = json.loads(path.read_text())
    for name, models in comparisons.items():
        results[name]["tuned"] = {model: _tuned(each) for model, each in models.items()}
    _write(results, path)
    text = tuning_report(results, experiments(), seeds)
    if show is not None:
        show(text)
    from hamkernel.paper._figures import tuning_figure

    return text, [path, tuning_figure(comparisons, path.parent)]


def _data(seeds: int) -> Data:
    if seeds < 1:
        raise ValueError(f"seeds is {seeds}; at least one noise seed is needed.")
    if jnp.result_type(float) != jnp.float64:
        raise RuntimeError(
            "the paper's regularisation is below the rounding of float32: run "
            "jax.config.update('jax_enable_x64', True) first."
        )
    keys = jax.vmap(jax.random.key)(np.arange(seeds))
    return {name: datasets(experiment, keys) for name, experiment in experiments().items()}


def _write(results: Results, path: pathlib.Path) -> None:
    path.write_text(json.dumps(results, indent=2, allow_nan=False) + "\n")


def _outcomes(data: Data, progress: bool) -> Outcomes:
    outcomes: Outcomes = {}
    runs = [
        (name, experiment, reading, model)
        for name, experiment in experiments().items()
        for reading in READINGS
        for model in experiment.models
    ]
    bar = tqdm(runs, desc="fits and tests", disable=None if progress else True)
    for name, experiment, reading, model in bar:
        chosen = experiment.models[model]
        regularization = READINGS[reading](chosen.regularization, experiment.size)
        X, Y = data[name]
        outcome = evaluate(experiment, chosen.kernel, X, Y, regularization)
        outcomes.setdefault(name, {}).setdefault(reading, {})[model] = outcome
    return outcomes


def _comparisons(data: Data, progress: bool) -> Comparisons:
    known = experiments()
    runs = [(name, model) for name, each in known.items() for model in each.models]
    comparisons: Comparisons = {}
    for name, model in tqdm(runs, desc="tuning", disable=None if progress else True):
        structure = known[name].models[model].structure
        comparisons.setdefault(name, {})[model] = compare(known[name], structure, *data[name])
    return comparisons


def summarise(outcomes: Mapping[str, Mapping[str, Mapping[str, Outcome]]]) -> Results:
    """Return median, 10 % and 90 % quantile over the seeds of every quantity.

    Args:
        outcomes: by experiment, reading and model.

    Returns:
        `[experiment][reading][model][quantity]["median" | "p10" | "p90"]`. `retune` adds a reading
        "tuned" with the same quantities for the hyperparameters of the gradient, and besides
        `["tuned"][model][name]["grid" | "gradient"]["median" | "p10" | "p90"]` for the names
        lengthscale, regularization, loss, seconds and trajectory_error.
    """
    return {
        name: {
            reading: {model: _spreads(outcome.quantities) for model, outcome in models.items()}
            for reading, models in readings.items()
        }
        for name, readings in outcomes.items()
    }


def _tuned(comparison: Comparison) -> dict:
    choices: dict[str, Choice] = {"grid": comparison.grid, "gradient": comparison.gradient}
    both = {
        "lengthscale": lambda choice: choice.lengthscale,
        "regularization": lambda choice: choice.regularization,
        "loss": lambda choice: choice.loss,
        "seconds": lambda choice: choice.seconds,
        "trajectory_error": lambda choice: choice.quantities["trajectory_error_mean"],
    }
    return _spreads(comparison.gradient.quantities) | {
        name: {method: _spread(np.asarray(of(choice))) for method, choice in choices.items()}
        for name, of in both.items()
    }


def _spreads(quantities: Mapping[str, ArrayLike]) -> dict[str, dict[str, float]]:
    return {name: _spread(np.asarray(values)) for name, values in quantities.items()}


def _spread(values: np.ndarray) -> dict[str, float]:
    p10, median, p90 = np.percentile(values, [10, 50, 90])
    return {"median": float(median), "p10": float(p10), "p90": float(p90)}
