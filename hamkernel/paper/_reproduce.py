"""All experiments, readings and kernels; the results as plain numbers."""

import json
import pathlib
from collections.abc import Mapping

import jax
import jax.numpy as jnp
import numpy as np
from tqdm import tqdm

from hamkernel.paper._evaluate import Outcome, datasets, evaluate
from hamkernel.paper._experiments import READINGS, experiments
from hamkernel.paper._report import Results, report

# experiment -> reading -> model -> its tests
Outcomes = dict[str, dict[str, dict[str, Outcome]]]


def reproduce(
    out: str | pathlib.Path = "results", seeds: int = 100, *, progress: bool = True
) -> tuple[str, list[pathlib.Path]]:
    """Run the paper's experiments, write `results.json` and the figures, return a report.

    Noise seed i is `jax.random.key(i)`, i = 0 … seeds − 1, the same for all kernels and readings.

    Args:
        out: folder for the files, made if it is missing.
        seeds: number of noise seeds, ≥ 1.
        progress: show a progress bar where the standard error is a terminal.

    Returns:
        The report, for printing, and the files written.

    Raises:
        ValueError: seeds < 1. RuntimeError: JAX is not in float64, or a fit failed.
    """
    from hamkernel.paper._figures import figures  # matplotlib loads after the numbers are safe

    if seeds < 1:
        raise ValueError(f"seeds is {seeds}; at least one noise seed is needed.")
    if jnp.result_type(float) != jnp.float64:
        raise RuntimeError(
            "the paper's regularisation is below the rounding of float32: run "
            "jax.config.update('jax_enable_x64', True) first."
        )
    out = pathlib.Path(out)
    out.mkdir(parents=True, exist_ok=True)
    outcomes = _outcomes(seeds, progress)
    results = summarise(outcomes)
    path = out / "results.json"
    path.write_text(json.dumps(results, indent=2, allow_nan=False) + "\n")
    return report(results, experiments(), seeds), [path, *figures(outcomes, out, progress)]


def _outcomes(seeds: int, progress: bool) -> Outcomes:
    outcomes: Outcomes = {}
    keys = jax.vmap(jax.random.key)(np.arange(seeds))
    runs = [
        (name, experiment, reading, model)
        for name, experiment in experiments().items()
        for reading in READINGS
        for model in experiment.models
    ]
    data = {}
    bar = tqdm(runs, desc="fits and tests", disable=None if progress else True)
    for name, experiment, reading, model in bar:
        if name not in data:
            data[name] = datasets(experiment, keys)
        chosen = experiment.models[model]
        regularization = READINGS[reading](chosen.regularization, experiment.size)
        X, Y = data[name]
        outcome = evaluate(experiment, chosen.kernel, X, Y, regularization)
        outcomes.setdefault(name, {}).setdefault(reading, {})[model] = outcome
    return outcomes


def summarise(outcomes: Mapping[str, Mapping[str, Mapping[str, Outcome]]]) -> Results:
    """Return median, 10 % and 90 % quantile over the seeds of every quantity.

    Args:
        outcomes: by experiment, reading and model.
    """
    return {
        name: {
            reading: {
                model: {
                    quantity: _spread(np.asarray(values))
                    for quantity, values in outcome.quantities.items()
                }
                for model, outcome in models.items()
            }
            for reading, models in readings.items()
        }
        for name, readings in outcomes.items()
    }


def _spread(values: np.ndarray) -> dict[str, float]:
    p10, median, p90 = np.percentile(values, [10, 50, 90])
    return {"median": float(median), "p10": float(p10), "p90": float(p90)}
