"""The experiments of Smith & Egeland (2023), end to end, over many noise seeds.

`python -m hamkernel` runs `reproduce`, then `retune`, and prints their reports. An `Experiment`
contains data only: the system, its sampling, the kernels and the published numbers. `datasets`
draws the data of many seeds. `evaluate` fits and tests one kernel on all of them in one compiled
program. `compare` tunes a kernel on each data set, by the paper's grid search and by
`hamkernel.tune`.

The paper leaves three choices open:

- The text of the paper solves (G + NλI) a = y, the tables agree with (G + λI) a = y. `READINGS` has
  both.
- The text gives the pendulum the mass 0.5, the tables agree with 1. We run both experiments.
- The paper does not give the box of the odd error. We take `Experiment.box`, that of the portraits.

This module needs float64: call `jax.config.update("jax_enable_x64", True)` before you make arrays.
"""

from hamkernel.paper._experiments import (
    READINGS,
    Choice,
    Comparison,
    Experiment,
    Model,
    Outcome,
    Published,
    compare,
    datasets,
    evaluate,
    experiments,
)
from hamkernel.paper._reproduce import report, reproduce, retune, summarise, tuning_report

__all__ = [
    "READINGS",
    "Choice",
    "Comparison",
    "Experiment",
    "Model",
    "Outcome",
    "Published",
    "compare",
    "datasets",
    "evaluate",
    "experiments",
    "report",
    "reproduce",
    "retune",
    "summarise",
    "tuning_report",
]
