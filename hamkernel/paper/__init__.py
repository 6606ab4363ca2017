"""The experiments of Smith & Egeland (2023), end to end, over many noise seeds.

`python -m hamkernel` runs `reproduce`, then `retune`, and prints their reports. An `Experiment`
is data alone: the system, how it is sampled, the kernels and what the paper publishes. `datasets`
draws the data of many seeds, `evaluate` fits and tests one kernel on all of them in one compiled
program, `compare` tunes it on each by the paper's grid search and by `hamkernel.tune`.

The paper leaves three things open, so they are run side by side or stated with the results:

- Its text solves (G + NλI) a = y, its tables fit (G + λI) a = y. `READINGS` has both.
- Its text gives the pendulum the mass 0.5, its tables fit 1. Both are experiments here.
- It does not give the box of the odd error. `Experiment.box` is the box of the portraits.

Everything here needs float64: `jax.config.update("jax_enable_x64", True)` before arrays are made.
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
