"""Tables of diagnostics: a value, its limit, its meaning, and advice."""

import dataclasses
import html
import textwrap
from collections.abc import Iterator
from typing import NamedTuple

from hamkernel._show import printable


class Diagnostic(NamedTuple):
    """One row: the answer to one question about a learned field, or about a log.

    Attributes:
        name: the question, in a word or two.
        value: the value found.
        limit: the limit of the value.
        passes: whether the value is within the limit.
        meaning: the meaning of the value, in one sentence.
        advice: the remedy, in one sentence; "" if none is needed.
        decides: whether a field that fails this row must not be used.
    """

    name: str
    value: str
    limit: str
    passes: bool
    meaning: str
    advice: str = ""
    decides: bool = False


@dataclasses.dataclass(frozen=True, repr=False)
class Diagnostics:
    """A table with one row for each question about a learned field, or about a log.

    `diagnostics["noise"]` returns the row of that name, `print(diagnostics)` prints the table, and
    a notebook shows the table in HTML.

    Attributes:
        rows: the rows, each a `Diagnostic`.
    """

    rows: tuple[Diagnostic, ...]

    @property
    def failing(self) -> tuple[str, ...]:
        """The names of the rows that fail."""
        return tuple(row.name for row in self.rows if not row.passes)

    @property
    def is_usable(self) -> bool:
        """Whether every row with `decides` passes."""
        return all(row.passes or not row.decides for row in self.rows)

    @property
    def warning(self) -> str:
        """The rows that fail, in a line or two; "" if none does."""
        short = [row for row in self.rows if not row.passes]
        if not short:
            return ""
        decide = [row for row in short if row.decides]
        qualify = [row for row in short if not row.decides]
        shown = [*decide[:1], *qualify[:1]] if decide and qualify else short[:2]
        said = "; ".join(row.meaning.rstrip(".") for row in shown)
        names = ", ".join(row.name for row in short if row not in shown)
        more = f"; and {names}" if names else ""
        verdict = "look at" if self.is_usable else "do not use this field"
        return f"{verdict}: {said}{more}. learned.diagnostics says what to do."

    def __getitem__(self, name: str) -> Diagnostic:
        for row in self.rows:
            if row.name == name:
                return row
        raise KeyError(f"no row {name!r}; there are {', '.join(row.name for row in self.rows)}.")

    def __iter__(self) -> Iterator[Diagnostic]:
        return iter(self.rows)

    def __len__(self) -> int:
        return len(self.rows)

    def __repr__(self) -> str:
        shown = [(row.name, row.value, row.limit) for row in self.rows]
        widths = [max(map(len, column)) for column in zip(*shown, strict=True)]
        lines = []
        for row, words in zip(self.rows, shown, strict=True):
            cells = [word.ljust(width) for word, width in zip(words, widths, strict=True)]
            lines.append(f"{' ' if row.passes else '!'} {'  '.join(cells)}".rstrip())
            if not row.passes:
                said = f"{row.meaning}. {row.advice}".strip()
                lines += textwrap.wrap(said, 84, initial_indent="    ", subsequent_indent="    ")
        return printable("\n".join(lines))

    def _repr_html_(self) -> str:
        head = "".join(f"<th>{name}</th>" for name in ("", "found", "limit", "meaning", "to do"))
        body = ""
        for row in self.rows:
            style = "" if row.passes else ' style="font-weight:bold"'
            shown = (row.name, row.value, row.limit, row.meaning, "" if row.passes else row.advice)
            cells = "".join(
                f'<td style="text-align:left">{html.escape(cell)}</td>' for cell in shown
            )
            body += f"<tr{style}>{cells}</tr>"
        return f"<table><thead><tr>{head}</tr></thead><tbody>{body}</tbody></table>"
