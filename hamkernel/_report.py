"""`report`: the result of `learn` as one page that a browser shows, without Python."""

from __future__ import annotations

import html
import os
import pathlib
from typing import TYPE_CHECKING, Any

import numpy as np

from hamkernel import _require as require
from hamkernel._learned.result import AbstractLearned

if TYPE_CHECKING:
    from hamkernel._learned.score import Score
    from hamkernel._runs.runs import Runs

_STYLE = """
body { font: 16px/1.5 system-ui, sans-serif; max-width: 60rem; margin: 2rem auto; padding: 0 1rem;
       color: #222; }
h1 { font-size: 1.6rem; } h2 { font-size: 1.15rem; margin-top: 2.2rem; }
pre { background: #f5f6f7; padding: .8rem 1rem; overflow-x: auto; font-size: .85rem; }
table { border-collapse: collapse; font-size: .85rem; }
th, td { padding: .3rem .7rem .3rem 0; border-bottom: 1px solid #ddd; vertical-align: top;
         text-align: left; }
img { max-width: 100%; }
.verdict { padding: .6rem 1rem; border-left: .4rem solid; }
.yes { border-color: #009E73; background: #eef8f4; }
.no { border-color: #D55E00; background: #fdf1ea; }
"""


def script(file: str, learned: AbstractLearned, is_beside: bool = False) -> str:
    """Ten lines that load the result in `file` and simulate its first run, with its inputs.

    Args:
        file: the file, or its name where `is_beside`.
        learned: the result.
        is_beside: whether the lines are a script that lies in the folder of the file.
    """
    runs = learned.runs
    lines = [
        *["from pathlib import Path"] * is_beside,
        "import jax",
        'jax.config.update("jax_enable_x64", True)  # before any array',
        "import jax.numpy as jnp",
        "import hamkernel as hk",
        f"learned = hk.load({f'Path(__file__).with_name({file!r})' if is_beside else repr(file)})",
        "x0, ts = learned.states[0][0], learned.runs.times[0]  # any state and times will do",
    ]
    inputs = ""
    if runs.parameters is not None:
        lines.append("theta = learned.runs.parameters[0]  # of the first run")
        inputs = ", inputs=lambda t: theta"
    elif runs.inputs is not None and runs.input_times is not None:
        lines.append("u = learned.runs.inputs[0]  # what was applied in the first run")
        if runs.delay or not np.array_equal(runs.input_times[0], runs.times[0]):
            at = f"ts - {runs.delay}, learned.runs.input_times[0]"
            lines.append(f"u = jax.vmap(lambda c: jnp.interp({at}, c), 1, 1)(u)  # at the times ts")
        between = "held" if runs.between == "held" else "linear"
        inputs = f', inputs=u, between="{between}"'
    return "\n".join([*lines, f"print(hk.simulate(learned.field, x0, ts{inputs}).ys)"]) + "\n"


def report(
    learned: AbstractLearned,
    path: str | os.PathLike[str],
    score: Score | None = None,
    held_out: Runs | None = None,
    file: str = "learned.hk",
) -> None:
    """Write one self-contained page of HTML about a learned field, for readers without Python.

    It has the verdict, the picture of `learned.plot()`, the table of `learned.diagnostics`, the
    score, and ten lines that load and simulate the field. The picture of a machine
    has no free run of `held_out`.

    Args:
        learned: the result of `hk.learn`.
        path: the file to write, such as "report.html".
        score: the result of `learned.score(…)`, if it shall be shown.
        held_out: runs that were not learned from; a free run of the first is drawn.
        file: the name under which `hk.save` wrote the result, for the ten lines.

    Raises:
        TypeError: `learned` is no result of `hk.learn`. OSError: the file cannot be written.
    """
    if not isinstance(learned, AbstractLearned):
        raise TypeError(
            "report takes the result of hk.learn and then a path; got a "
            f"{type(learned).__name__} and a {type(path).__name__}."
        )
    require.no_tracers("hk.report", "Call it outside.", learned)
    verdict = "may be used" if learned.converged else "must not be used as it is"
    short = [row.meaning.rstrip(".") for row in learned.diagnostics if not row.passes]
    said = "No diagnostic falls short."
    if short:
        said = f"Falls short: {'; '.join(short)}. The diagnostics below say what to do."
    parts = [
        f"<h1>A field learned from {len(learned.runs)} run{'s' * (len(learned.runs) != 1)}</h1>",
        f'<p class="verdict {"yes" if learned.converged else "no"}"><b>The field {verdict}.</b> '
        f"{html.escape(said)}</p>",
        f"<pre>{html.escape(repr(learned))}</pre>",
    ]
    if score is not None:
        parts.append("<h2>Prediction of data that were not learned from</h2>")
        parts.append(f"<pre>{html.escape(repr(score))}</pre>")
    parts += [
        "<h2>The runs and the field</h2>",
        _picture(learned, held_out),
        "<h2>Diagnostics</h2>",
        learned.diagnostics._repr_html_(),
        "<h2>Load and simulate</h2>",
        f"<pre>{html.escape(script(file, learned))}</pre>",
    ]
    page = "\n".join(parts)
    pathlib.Path(path).write_text(
        '<!DOCTYPE html>\n<html lang="en"><head><meta charset="utf-8">'
        f"<title>Learned field</title><style>{_STYLE}</style></head>\n<body>\n{page}\n"
        "</body></html>\n",
        encoding="utf-8",
    )


def _picture(learned: AbstractLearned, held_out: Runs | None) -> str:
    """The picture of the result, inside of HTML."""
    import matplotlib.pyplot as plt

    from hamkernel.plot._result import image

    options: dict[str, Any] = {} if held_out is None else {"held_out": held_out}
    figure = learned.plot(**options)
    try:
        return image(figure, "fit, residuals, law")
    finally:
        plt.close(figure)
