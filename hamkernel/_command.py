"""`python -m hamkernel learn`: from CSV files to a report, a field and a script."""

from __future__ import annotations

import argparse
import codecs
import csv
import io
import pathlib
import warnings
from collections.abc import Callable
from typing import get_args

import numpy as np
from jaxtyping import Float
from numpy.lib.recfunctions import unstructured_to_structured

from hamkernel._kernels.built_in import Gaussian
from hamkernel._kernels.transforms import Select
from hamkernel._learn import learn
from hamkernel._learned.result import Learned
from hamkernel._learned.score import Score
from hamkernel._report import report, script
from hamkernel._runs.runs import Between, Runs
from hamkernel._save import save
from hamkernel._structures.base import AbstractMatrixKernel
from hamkernel._structures.friction import Friction
from hamkernel._structures.joined import Controlled, InputMatrix
from hamkernel._structures.structure import Symplectic


def parser() -> argparse.ArgumentParser:
    """The options of the command."""
    options = argparse.ArgumentParser(
        prog="python -m hamkernel learn",
        description="Learn a field from logged runs in CSV files with a header row, score it on "
        "the last fifth of each run, and write report.html, learned.hk and simulate.py.",
    )
    options.add_argument("files", nargs="+", help="one CSV file a run, with a row of names")
    options.add_argument("--time", required=True, help="the column of times")
    options.add_argument(
        "--states",
        required=True,
        nargs="+",
        help="the columns of the state: all positions, then all momenta; or the positions alone "
        "with --mass and one mass for each",
    )
    options.add_argument(
        "--inputs", nargs="+", default=[], help="the columns of the inputs, such as torques"
    )
    options.add_argument(
        "--between",
        choices=[*get_args(Between), "auto"],
        default="held",
        help="the inputs between two samples; auto takes the likeliest (%(default)s)",
    )
    options.add_argument("--friction", action="store_true", help="there is friction")
    options.add_argument(
        "--mass",
        type=float,
        nargs="+",
        help="the known masses, one number or one for each position; the potential U(q) is learned",
    )
    options.add_argument(
        "--noise",
        type=float,
        nargs="+",
        help="the known standard deviation of the noise, one number or one for each state",
    )
    options.add_argument("--out", default="results", help="folder for the files (%(default)s)")
    return options


def columns(path: str, names: list[str]) -> Float[np.ndarray, "T k"]:
    """The named columns of a CSV file; an empty cell is NaN.

    The header is the first row that has all the names, with commas, semicolons or tabs between
    cells. We skip the lines above it, which oscilloscopes write, and rows without a number below
    it, such as one of units. Between semicolons a comma is a decimal point.

    Raises:
        ValueError: the file is no CSV file, or has no such column, no rows, or a cell that is no
            number. OSError: the file cannot be read.
    """
    text, widest = _text(path), []
    for mark in ",;\t":
        try:
            rows = [*csv.reader(io.StringIO(text, newline=""), delimiter=mark)]
        except csv.Error as error:
            raise ValueError(f"{path} is no CSV file: {error}.") from error
        headers = [[name.strip() for name in row] for row in rows]
        first = next((i for i, row in enumerate(headers) if {*names} <= {*row}), None)
        if first is not None:
            break
        widest = max(widest, *headers, [], key=lambda row: sum(x[:1].isalpha() for x in row))
    else:
        missing = next((name for name in names if name not in widest), names[0])
        if widest:
            said = f"its columns are {', '.join(widest)}"
        else:
            said = (
                "the first line must have the names of columns" if text.strip() else "it is empty"
            )
        raise ValueError(f"{path} has no column {missing!r}; {said}.")
    header = headers[first]
    if twice := [name for name in names if header.count(name) > 1]:
        raise ValueError(f"{path} has {header.count(twice[0])} columns named {twice[0]!r}.")
    places, table = [header.index(name) for name in names], []
    for number, row in enumerate(rows[first + 1 :], start=first + 2):
        cells = [row[place].strip() if place < len(row) else "" for place in places]
        cells = [cell.replace(",", ".") if mark == ";" else cell for cell in cells]
        if not any(row) or (not table and not any(map(_is_number, cells))):
            continue
        try:
            table.append([float(cell) if cell else np.nan for cell in cells])
        except ValueError as error:
            said = f"{error}; numbers are needed, such as seconds in place of dates"
            raise ValueError(f"{path}, line {number}: {said}.") from error
    if not table:
        raise ValueError(f"{path} has a header and no rows of numbers.")
    return np.array(table)


def _text(path: str) -> str:
    """The text of a file in UTF-8, in UTF-16 with its mark, or in the Latin-1 of older programs."""
    if not pathlib.Path(path).exists():
        raise FileNotFoundError(f"there is no file {path}.")
    content = pathlib.Path(path).read_bytes()
    if content.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):
        return content.decode("utf-16")
    try:
        return content.decode("utf-8-sig")
    except UnicodeDecodeError:
        return content.decode("latin-1")


def _is_number(cell: str) -> bool:
    try:
        float(cell)
    except ValueError:
        return False
    return True


def kernel(
    state_count: int, input_count: int, friction: bool, has_mass: bool = False
) -> AbstractMatrixKernel:
    """The kernel of the options: an energy, friction if asked for, and inputs that push momenta.

    If the masses are known, the kernel has the potential of the positions alone. An unknown kinetic
    energy as well would leave momenta that were not measured undetermined up to a constant.
    """
    k = 1.0 * Gaussian(np.ones(state_count))
    if has_mass:
        m = state_count // 2
        k = 1.0 * Select(Gaussian(np.ones(m)), tuple(range(m)))
    K: AbstractMatrixKernel = Symplectic(k)
    K = K + Friction() if friction else K
    if not input_count:
        return K
    momenta = tuple(range(state_count // 2, state_count))
    return Controlled(K, inputs=InputMatrix(1.0, acts_on=momenta))


def run(arguments: list[str], show: Callable[[str], None]) -> None:
    """Learn, score and write the files. `show` prints progress and warnings, in plain sentences.

    Raises:
        SystemExit: an option or a file does not fit, with a sentence.
    """
    with warnings.catch_warnings():
        warnings.simplefilter("always", UserWarning)
        warnings.showwarning = lambda message, *place, **more: show(f"Warning: {message}")
        _run(arguments, show)


def _run(arguments: list[str], show: Callable[[str], None]) -> None:
    """Learn, score and write the files."""
    options = parser()
    asked = options.parse_args(arguments)
    try:
        runs, out = _runs(asked), pathlib.Path(asked.out)
        count = len(asked.states)
        if count % 2 and asked.mass is None:
            raise ValueError(
                f"--states names {count} column{'s' * (count > 1)}: all positions and then all "
                "momenta are needed, or the positions alone with --mass."
            )
        masses = len(asked.mass or [])
        if masses not in (0, 1, count, count / 2):
            raise ValueError(f"--mass names {masses} masses and --states {count} columns.")
        is_position = masses == count or (masses == 1 and count % 2 == 1)
        state_count = 2 * count if is_position else count
        K = kernel(state_count, runs.input_count, asked.friction, bool(masses))
        out.mkdir(parents=True, exist_ok=True)
        show(f"Learning from {runs!r}.")
        learned = learn(K, runs, noise=_number(asked.noise), mass=_number(asked.mass))
        save(out / "learned.hk", learned)
        (out / "simulate.py").write_text(script("learned.hk", learned, True), encoding="utf-8")
        report(learned, out / "report.html")
        show(f"{learned!r}\nScoring on the last fifth of each run, which learns once more.")
        if (score := _score(learned, show)) is not None:
            report(learned, out / "report.html", score)
    except (ValueError, TypeError, OSError) as error:
        options.error(str(error))
    show(f"Written: report.html, learned.hk and simulate.py in {out}/.")


def _score(learned: Learned, show: Callable[[str], None]) -> Score | None:
    """The score on the last fifth of each run; None if the runs are too short."""
    try:
        score = learned.score()
    except ValueError as error:
        show(f"No score: {error}")
        return None
    show(repr(score))
    return score


def _runs(asked: argparse.Namespace) -> Runs:
    """The runs of the files, one each, with the names of their columns."""
    names, k = [asked.time, *asked.states, *asked.inputs], 1 + len(asked.states)
    twice = [name for name in dict.fromkeys(names) if names.count(name) > 1]
    if twice:
        raise ValueError(
            f"the column {twice[0]!r} is named twice: times, states and inputs must be different."
        )
    tables = [columns(file, names) for file in asked.files]
    states = [unstructured_to_structured(x[:, 1:k], names=asked.states) for x in tables]
    inputs = None
    if asked.inputs:
        inputs = [unstructured_to_structured(x[:, k:], names=asked.inputs) for x in tables]
    return Runs([table[:, 0] for table in tables], states, inputs, between=asked.between)


def _number(values: list[float] | None) -> float | np.ndarray | None:
    """One number, or one for each coordinate."""
    if values is None:
        return None
    return values[0] if len(values) == 1 else np.array(values)
