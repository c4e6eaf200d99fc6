"""When two results are equal: in every field, arrays in every element."""

from dataclasses import fields, is_dataclass
from typing import Any


class Comparable:
    """A dataclass with arrays in it, equal to another whose fields are all equal; a missing value (NaN) equals another.

    Declare it with `eq=False`: the comparison that `dataclass` writes asks an array whether it is true.
    """

    def __eq__(self, other: object) -> bool:
        return _equal(self, other)


def _equal(one: Any, other: Any) -> bool:
    if type(one) is not type(other):
        return False
    if isinstance(one, tuple | list):
        return len(one) == len(other) and all(map(_equal, one, other))
    if isinstance(one, dict):
        return one.keys() == other.keys() and all(_equal(value, other[key]) for key, value in one.items())
    if hasattr(one, "dtype"):
        import numpy as np

        return np.array_equal(one, other, equal_nan=np.issubdtype(one.dtype, np.inexact))
    if is_dataclass(one):
        return all(
            _equal(getattr(one, field.name), getattr(other, field.name)) for field in fields(one) if field.compare
        )
    return one == other
