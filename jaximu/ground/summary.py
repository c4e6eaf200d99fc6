"""What an object says of itself in Python: `summary()` as text and as HTML, and parameters as a table by name."""

from __future__ import annotations

import difflib
import html
import re
import textwrap
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, fields
from typing import TYPE_CHECKING

import numpy as np

from jaximu.ground.errors import InputError, worded
from jaximu.ground.page import Table
from jaximu.ground.quantities import Z95, readable, with_interval

if TYPE_CHECKING:
    import pandas as pd  # pyright: ignore[reportMissingImports]
    import pyarrow as pa

__all__ = ["Block", "Described", "Parameter", "ParameterTable", "Summary", "data_frame", "sentence"]

_WIDTH = 100


def sentence(text: str) -> str:
    """Return the text with a capital at its start, unless it starts with the name of a file or an identifier."""
    return text if re.match(r"\S*[._/\\]\w", text) else text[:1].upper() + text[1:]


@dataclass(frozen=True)
class Block:
    """A table of texts under headers."""

    headers: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]

    def text(self) -> str:
        """Return the table in columns, the first to the left and the others to the right."""
        table = [self.headers, *self.rows] if any(self.headers) else list(self.rows)
        first, *others = (max(map(len, column)) for column in zip(*table, strict=True))
        lines = ["  ".join([head.ljust(first), *map(str.rjust, cells, others)]).rstrip() for head, *cells in table]
        if any(self.headers):
            lines.insert(1, "─" * (first + sum(width + 2 for width in others)))
        return "\n".join(lines)

    def html(self) -> str:
        """Return the table as HTML."""

        def row(cells: Iterable[str], tag: str) -> str:
            return "<tr>" + "".join(f"<{tag}>{html.escape(cell)}</{tag}>" for cell in cells) + "</tr>"

        rows = "".join(row(cells, "td") for cells in self.rows)
        return f"<table><thead>{row(self.headers, 'th')}</thead><tbody>{rows}</tbody></table>"


@dataclass(frozen=True)
class Summary:
    """A title, the verdict in sentences, a table, and notes below it: printed as text, in a notebook as HTML."""

    title: str
    verdict: tuple[str, ...]
    table: Block | None = None
    notes: tuple[str, ...] = ()

    def __str__(self) -> str:
        parts = [self.title, "═" * min(len(self.title), _WIDTH)]
        parts += map(_filled, self.verdict)
        if self.table is not None:
            parts += ["", self.table.text()]
        if self.notes:
            parts += ["", *(_filled(note, "- ") for note in self.notes)]
        return "\n".join(parts)

    __repr__ = __str__

    def _repr_html_(self) -> str:
        parts = [f"<p><b>{html.escape(self.title)}</b></p>"]
        parts += [f"<p>{html.escape(text)}</p>" for text in self.verdict]
        if self.table is not None:
            parts.append(self.table.html())
        if self.notes:
            parts.append(f"<ul>{''.join(f'<li>{html.escape(note)}</li>' for note in self.notes)}</ul>")
        return worded("\n".join(parts))


def _filled(text: str, start: str = "") -> str:
    return textwrap.fill(start + worded(text), _WIDTH, subsequent_indent="  ")


class Described:
    """Something with a `summary()`: a short `repr`, and the summary in a notebook."""

    def summary(self) -> Summary:
        """Return what a person wants to know of this, as text that prints itself and as HTML."""
        raise NotImplementedError

    def __repr__(self) -> str:
        summary = self.summary()
        return f"<{type(self).__name__}: {'. '.join((summary.title, *summary.verdict[:1]))}>"

    def _repr_html_(self) -> str:
        return self.summary()._repr_html_()


@dataclass(frozen=True)
class Parameter:
    """One fitted number: its name in documents, its name in words, value and standard deviation in `unit`.

    weak: the data hardly determine it.
    """

    name: str
    words: str
    value: float
    sigma: float
    unit: str
    weak: bool = False

    @property
    def different_from_zero(self) -> bool:
        """Whether zero lies outside the 95 % interval."""
        return abs(self.value) > Z95 * self.sigma

    @property
    def group(self) -> tuple[str, str]:
        """What parameters that are read in one unit share: their unit, and their words but for the axis."""
        return self.unit, self.words.rpartition(" ")[0]

    def cells(self, largest: float) -> tuple[str, str, str, str]:
        """Return words, value, standard uncertainty and unit as a person reads values up to `largest`."""
        factor, unit = readable(self.unit, largest)
        if self.unit == "1" and "misalignment" in self.words:
            factor, unit = 1e3, "mrad"
        value, _, sigma = with_interval(factor * self.value, factor * self.sigma / Z95).partition(" ± ")
        sigma, _, power = sigma.partition(")")  # (1.2 ± 0.1)·10⁻⁹
        return self.words, value.lstrip("(") + power, sigma + power, unit


class ParameterTable(Mapping[str, Parameter]):
    """Fitted numbers by name, in the order of the covariance; printed, and in a notebook, as a table.

    `table["accelerometer bias x"]` and `table["accelerometer.bias[0]"]` are the same number; an effect's is
    `table["accel.asymmetry[0]"]`.
    """

    def __init__(self, parameters: Sequence[Parameter]):
        self._parameters = {parameter.name: parameter for parameter in parameters}
        self._words = {parameter.words: parameter.name for parameter in parameters}
        self._words |= {words.rpartition("(")[2].removesuffix(")"): name for words, name in self._words.items()}

    def __getitem__(self, name: str) -> Parameter:
        parameter = self._parameters.get(self._words.get(name, name))
        if parameter is None:
            near = difflib.get_close_matches(str(name), [*self._words, *self._parameters], 3, 0.5)
            raise KeyError(f"no parameter {name!r}; near it: {', '.join(near) or 'none'}")
        return parameter

    def __iter__(self) -> Iterator[str]:
        return iter(self._parameters)

    def __len__(self) -> int:
        return len(self._parameters)

    def block(self) -> Table:
        """Return the table as texts; a star marks what is weakly determined."""
        largest: dict[tuple[str, str], float] = {}
        for one in self.values():
            largest[one.group] = max(largest.get(one.group, 0.0), abs(one.value), one.sigma)
        rows = []
        for one in self.values():
            words, *numbers = one.cells(largest[one.group])
            rows.append((words + " *" * one.weak, *numbers))
        return Table(("parameter", "value", "standard uncertainty", "unit"), tuple(rows))

    def __repr__(self) -> str:
        return str(self.block())

    def _repr_html_(self) -> str:
        return self.block()._repr_html_()

    def to_arrow(self) -> pa.Table:
        """Return name, words, value, sigma, unit and weak as an Arrow table, which polars and DuckDB read, too."""
        import pyarrow as pa

        return pa.table({key.name: [getattr(one, key.name) for one in self.values()] for key in fields(Parameter)})

    def to_pandas(self) -> pd.DataFrame:
        """Return the same as a pandas data frame by name. Raises `InputError` where pandas is not installed."""
        return data_frame(self.to_arrow()).set_index("name")

    @property
    def value(self) -> np.ndarray:
        """(p,) all values, in the order of the covariance."""
        return np.array([one.value for one in self.values()])

    @property
    def sigma(self) -> np.ndarray:
        """(p,) all standard deviations."""
        return np.array([one.sigma for one in self.values()])


def data_frame(table: pa.Table) -> pd.DataFrame:
    """Return an Arrow table as a pandas data frame. Raises `InputError` where pandas, which is optional, is missing."""
    try:
        import pandas  # noqa: F401  # pyright: ignore[reportMissingImports]
    except ModuleNotFoundError:
        raise InputError("pandas is not installed: pip install pandas, or use to_arrow().") from None
    return table.to_pandas()
