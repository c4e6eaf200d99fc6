"""Fitted numbers by name, as a table that prints itself."""

from __future__ import annotations

import difflib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, fields
from typing import TYPE_CHECKING

import numpy as np

from jaximu.ground.errors import InputError
from jaximu.ground.page import Table
from jaximu.ground.quantities import Z95, readable, with_interval

if TYPE_CHECKING:
    import pandas as pd  # pyright: ignore[reportMissingImports]
    import pyarrow as pa


@dataclass(frozen=True)
class Parameter:
    """One fitted number: its name in documents, its name in words, value and standard deviation in `unit`.

    weak: the data hardly determine it. determined: False where they do not, and `sigma` is the data sheet's.
    """

    name: str
    words: str
    value: float
    sigma: float
    unit: str
    weak: bool = False
    determined: bool = True

    @property
    def different_from_zero(self) -> bool:
        """Whether zero lies outside the 95 % interval."""
        return self.determined and abs(self.value) > Z95 * self.sigma

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
        return self.words, value.lstrip("(") + power, sigma + power if self.determined else "not determined", unit


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
        """Return the fields of every parameter as an Arrow table, which polars and DuckDB read, too."""
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
