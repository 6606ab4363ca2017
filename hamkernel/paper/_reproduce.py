"""All experiments, readings and kernels: their numbers, and tables beside those of the paper."""

import json
import pathlib
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float
from tqdm import tqdm

from hamkernel.paper._experiments import (
    FOLDS,
    GRID,
    READINGS,
    Choice,
    Comparison,
    Experiment,
    Outcome,
    compare,
    datasets,
    evaluate,
    experiments,
)

# experiment -> reading -> model -> quantity -> "median", "p10", "p90"; see `summarise`
Results = dict[str, dict[str, dict[str, dict[str, Any]]]]
Experiments = Mapping[str, Experiment]
Row = Sequence[str]


def report(results: Results, experiments: Experiments, seeds: int) -> str:
    """Return Tables I and II of the paper beside the results, and the trajectory errors.

    Args:
        results: the return value of `summarise`.
        experiments: the experiments that were run, with the published numbers.
        seeds: the number of noise seeds in the results.
    """
    published = _published_values(results)
    head = (
        f"Smith & Egeland (2023) with {seeds} noise seeds: median [10 %, 90 %];\n"
        "the published numbers are of one seed.\n\n"
        "Two readings of the regulariser: lambda solves (G + λI) a = y, N*lambda solves\n"
        "(G + NλI) a = y, which is what the paper's text says. Two masses of the pendulum: 0.5 is\n"
        "in the text, 1 follows from the true Hamiltonian in Table II. The symplectic kernel is\n"
        "not in the paper and takes the hyperparameters of the odd symplectic one."
    )
    separable = ("separable", ("odd_error_mean", "odd_error_variance"))
    hamiltonian = ("odd_symplectic", ("true_hamiltonian_mean", "learned_hamiltonian_mean"))
    return "\n\n".join(
        [
            head,
            _odd_error_table(published, experiments),
            _closest("Table I", published, experiments, *separable),
            _hamiltonian_table(published, experiments),
            _closest("Table II", published, experiments, *hamiltonian),
            _trajectory_table(published, experiments),
        ]
    )


def _published_values(results: Results) -> Results:
    """The results without the reading "tuned": the paper's hyperparameters only."""
    return {
        name: {reading: readings[reading] for reading in READINGS if reading in readings}
        for name, readings in results.items()
    }


def tuning_report(results: Results, experiments: Experiments, seeds: int) -> str:
    """Return the table of tuned hyperparameters and a verdict on it in words.

    Args:
        results: the return value of `summarise`, with the reading "tuned".
        experiments: the experiments that were run.
        seeds: the number of noise seeds that were tuned.
    """
    rows = []
    for name, experiment in experiments.items():
        rows.append((f"{experiment.title}, N = {experiment.size}",))
        for model, values in results[name]["tuned"].items():
            for method in ("grid", "gradient"):
                cells = (_cell(values[of][method]) for of in _TUNED)
                label = model.replace("_", " ") if method == "grid" else ""
                rows.append((label, method, *cells))
    title = (
        f"Hyperparameters tuned on each of {seeds} seeds by {FOLDS}-fold cross-validation, "
        "with the ridge NλI:\n"
        f"the paper's grid search ({len(GRID[0])} by {len(GRID[1])}, refits for every fold, one "
        "compiled program) and the gradient of `tune`.\n"
        "error: mean trajectory error; seconds: for one data set, compiled before."
    )
    table = _table(title, ("kernel", "by", *_TUNED.values()), rows)
    return f"{table}\n\n{_tuned_verdict(results)}"


_TUNED = {
    "loss": "loss",
    "lengthscale": "lengthscale",
    "regularization": "lambda",
    "trajectory_error": "error",
    "seconds": "seconds",
}


def _tuned_verdict(results: Results) -> str:
    cases = [values for readings in results.values() for values in readings["tuned"].values()]

    def ratios(of: str, above: str, below: str) -> np.ndarray:
        return np.array([case[of][above]["median"] / case[of][below]["median"] for case in cases])

    loss, speed = ratios("loss", "gradient", "grid"), ratios("seconds", "grid", "gradient")
    text = (
        f"Of {len(cases)} pairs of system and kernel the gradient finds the lower median loss in "
        f"{np.sum(loss <= 1)}\n(ratio to the grid's {loss.min():.3f} to {loss.max():.3f}), "
        f"{np.median(speed):.2g} times as fast in the median ({speed.min():.2g} to "
        f"{speed.max():.2g})."
    )
    clauses = []
    for model in ("separable", "odd_symplectic"):
        gains = [
            readings["lambda"][model]["trajectory_error_mean"]["median"]
            / readings["tuned"][model]["trajectory_error_mean"]["median"]
            for readings in results.values()
        ]
        clauses.append(f"{min(gains):.2g} to {max(gains):.2g} ({model.replace('_', ' ')})")
    return (
        f"{text}\nThe trajectory error of the paper's hyperparameters (reading lambda) is that of "
        f"the tuned ones\ntimes {', '.join(clauses)}, medians of the experiments."
    )


def _odd_error_table(results: Results, experiments: Experiments) -> str:
    rows = []
    for name, experiment in experiments.items():
        (_, q), (low, high) = experiment.box
        published = experiment.published
        rows += [
            (f"{experiment.title}, 0 < q < {q:.3g}, {low:.3g} < p < {high:.3g}",),
            (
                "published",
                "separable",
                f"{published.odd_error_mean:.2f}",
                f"{published.odd_error_variance:.2f}",
            ),
            ("", "odd symplectic", "0.00", "0.00"),
            *_model_rows(results[name], ("odd_error_mean", "odd_error_variance")),
        ]
    title = (
        "Table I. Odd error ‖f(x) + f(-x)‖ at 10 000 points of the right half of the portraits,\n"
        "whose limits the paper does not give: those used here follow the system's name."
    )
    return _table(title, ("", "kernel", "mean", "variance"), rows)


def _hamiltonian_table(results: Results, experiments: Experiments) -> str:
    rows = []
    for name, experiment in experiments.items():
        published, readings = experiment.published, results[name]
        # The true Hamiltonian does not depend on reading or kernel, so we take the first.
        quantities = next(iter(next(iter(readings.values())).values()))
        ours = {quantity: spread["median"] for quantity, spread in quantities.items()}
        rows += [
            (experiment.title,),
            _mean_and_variance("published", "true", vars(published), "true_hamiltonian"),
            _mean_and_variance("here", "true", ours, "true_hamiltonian"),
            _mean_and_variance(
                "published", "odd symplectic", vars(published), "learned_hamiltonian"
            ),
            *_model_rows(readings, ("learned_hamiltonian_mean", "learned_hamiltonian_variance")),
        ]
    title = (
        "Table II. Hamiltonian along the test trajectory: the true one on the true trajectory,\n"
        "the learned one, with the constant of the representer, on the learned trajectory.\n"
        "The variances are those of the integrator, here at a tolerance of 1e-10."
    )
    return _table(title, ("", "Hamiltonian", "mean", "variance"), rows)


def _mean_and_variance(label: str, kernel: str, values: Mapping[str, float], quantity: str) -> Row:
    mean, variance = (values[f"{quantity}_{of}"] for of in ("mean", "variance"))
    return (label, kernel, f"{mean:.2f}", f"{variance:.1e}")


def _trajectory_table(results: Results, experiments: Experiments) -> str:
    rows, error = [], "trajectory_error_mean"
    for name, experiment in experiments.items():
        rows.append((f"{experiment.title}, {experiment.horizon:g} s",))
        gains = [
            f"{_median(models['separable'], error) / _median(quantities, error):.3g}"
            for models in results[name].values()
            for quantities in models.values()
        ]
        lines = _model_rows(results[name], (error, "trajectory_error_max"))
        rows += [(*line, gain) for line, gain in zip(lines, gains, strict=True)]
    title = (
        "Trajectory error ‖x_true - x_learned‖ on the test trajectory, its mean and maximum over\n"
        "time; gain: how many times smaller the median of the mean is than the separable one."
    )
    return _table(title, ("", "kernel", "mean", "maximum", "gain"), rows)


def _model_rows(
    readings: Mapping[str, Mapping[str, Mapping[str, dict[str, float]]]], quantities: Sequence[str]
) -> Iterable[Row]:
    """The rows of a table, one for each reading and model that has the quantities."""
    for reading, models in readings.items():
        label = reading
        for model, values in models.items():
            if all(quantity in values for quantity in quantities):
                cells = (_cell(values[quantity]) for quantity in quantities)
                yield (label, model.replace("_", " "), *cells)
                label = ""


def _median(values: Mapping[str, dict[str, float]], quantity: str) -> float:
    return values[quantity]["median"]


def _cell(spread: Mapping[str, float]) -> str:
    median, p10, p90 = (_format(spread[key]) for key in ("median", "p10", "p90"))
    return f"{median} [{p10}, {p90}]"


def _format(x: float) -> str:
    if x == 0 or 1e-3 <= abs(x) < 1e4:
        return f"{x:.4g}" if abs(x) >= 100 else f"{x:.3g}"
    return f"{x:.1e}"


def _table(title: str, header: Row, rows: Sequence[Row]) -> str:
    """The table with aligned columns; a row of one cell is a heading."""
    widths = [
        max(len(row[i]) for row in [header, *rows] if len(row) > 1) for i in range(len(header))
    ]

    def line(row: Row) -> str:
        if len(row) == 1:
            return row[0]
        cells = (cell.ljust(width) for cell, width in zip(row, widths, strict=True))
        return "  " + "  ".join(cells).rstrip()

    return "\n".join([title, "", line(header), *map(line, rows)])


def _closest(
    table: str,
    results: Results,
    experiments: Experiments,
    model: str,
    quantities: Sequence[str],
) -> str:
    """A sentence that names the reading whose medians are closest to the published table."""
    systems: dict[str, list[tuple[float, str]]] = {}
    for name, experiment in experiments.items():
        system, _, detail = experiment.title.partition(", ")
        for reading, models in results[name].items():
            medians = np.array([_median(models[model], quantity) for quantity in quantities])
            published = [vars(experiment.published)[quantity] for quantity in quantities]
            deviation = np.mean(np.abs(medians / published - 1))
            label = f"{reading} with {detail}" if detail else reading
            systems.setdefault(system, []).append((float(deviation), label))
    clauses = []
    for system, fits in systems.items():
        (best, label), (second, next_label), *_ = sorted(fits)
        clauses.append(
            f"{label} for the {system.lower()} ({best:.1%} off on average, "
            f"next {next_label} {second:.1%})"
        )
    return f"{table} is closest to " + ",\nand to ".join(clauses) + "."


# experiment -> reading -> model -> the tests of its fields
Outcomes = dict[str, dict[str, dict[str, Outcome]]]
# experiment -> model -> the choices of grid search and gradient
Comparisons = dict[str, dict[str, Comparison]]
Data = Mapping[str, tuple[Float[Array, "S N n"], Float[Array, "S N n"]]]


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
        out: the folder for the files, made if it is missing. `results.json` has the layout of
            `summarise`.
        seeds: the number of noise seeds, ≥ 1.
        progress: show a progress bar if the standard error is a terminal.
        show: a function that is called with the complete report, before the figures are drawn.

    Returns:
        The report, for printing, and the paths of the files.

    Raises:
        ValueError: seeds < 1.
        OSError: the folder cannot be made.
        RuntimeError: JAX is not in float64, or a fit failed.
    """
    path = pathlib.Path(out) / "results.json"
    # We make the folder first, so that an error comes before the work.
    path.parent.mkdir(parents=True, exist_ok=True)
    outcomes = _outcomes(_datasets_of_seeds(seeds), progress)
    results = summarise(outcomes)
    _write(results, path)
    text = report(results, experiments(), seeds)
    if show is not None:
        show(text)
    # We import Matplotlib after the numbers are saved.
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

    `retune` uses at most the first 20 seeds, and adds the reading "tuned" to `results.json`.

    Args:
        out: the folder with the results of `reproduce`.
        seeds: the number of noise seeds, ≥ 1.
        progress: show a progress bar if the standard error is a terminal.
        show: a function that is called with the complete report, before the figure is drawn.

    Returns:
        The report, for printing, and the paths of the files.

    Raises:
        FileNotFoundError: the folder has no `results.json` of `reproduce`.
        ValueError: seeds < 1.
        RuntimeError: JAX is not in float64, or a fit failed.
    """
    path = pathlib.Path(out) / "results.json"
    if not path.exists():
        raise FileNotFoundError(f"no {path}: run hamkernel.paper.reproduce({str(out)!r}) first.")
    # The median of 20 seeds has a standard error of 1.25 σ/√20 = .28 σ, σ their deviation.
    seeds = min(seeds, 20)
    comparisons = _comparisons(_datasets_of_seeds(seeds), progress)
    results = json.loads(path.read_text())
    for name, models in comparisons.items():
        results[name]["tuned"] = {model: _tuned_quantities(c) for model, c in models.items()}
    _write(results, path)
    text = tuning_report(results, experiments(), seeds)
    if show is not None:
        show(text)
    from hamkernel.paper._figures import tuning_figure

    return text, [path, tuning_figure(comparisons, path.parent)]


def _datasets_of_seeds(seeds: int) -> Data:
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
    by_name = experiments()
    runs = [(name, model) for name, experiment in by_name.items() for model in experiment.models]
    comparisons: Comparisons = {}
    for name, model in tqdm(runs, desc="tuning", disable=None if progress else True):
        structure = by_name[name].models[model].structure
        comparisons.setdefault(name, {})[model] = compare(by_name[name], structure, *data[name])
    return comparisons


def summarise(outcomes: Mapping[str, Mapping[str, Mapping[str, Outcome]]]) -> Results:
    """Return the median, 10 % and 90 % quantile over the seeds of every quantity.

    Args:
        outcomes: the outcomes by experiment, reading and model.

    Returns:
        `[experiment][reading][model][quantity]["median" | "p10" | "p90"]`. `retune` adds a reading
        "tuned" with the same quantities for the hyperparameters of the gradient, and also
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


def _tuned_quantities(comparison: Comparison) -> dict:
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
