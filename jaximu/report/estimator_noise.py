"""The page of noise for estimators: by how much white noise is multiplied, what that is made of, where it holds."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from jaximu.ground.page import Page, Statement, Table
from jaximu.ground.quantities import number, sentence
from jaximu.navigation.estimator_noise import EstimatorNoise

_LEAST = 0.05
"""Terms that stay below this multiple of N are not shown."""
_QUIETER = 0.99
"""A multiplier whose whole interval lies below this is reported, because N is not made smaller."""
_HOLDS = (0.8, 1.25)
"""NEES that counts as one: elsewhere the numbers do not hold."""


def page_of(noise: EstimatorNoise) -> Page:
    """Return the multipliers of white noise by length, and the NEES with them."""
    at = noise.chosen
    name, triad = max(noise.triads.items(), key=lambda item: item[1].applied[at])
    return Page(
        f"Noise for an estimator whose states are {_length(noise)} apart",
        (noise.headline(),),
        f"{number(triad.applied[at])} (95 %: {number(triad.low[at])} to {number(triad.high[at])})",
        f"times the {name}'s white noise N",
        (*statements(noise), _table(noise)),
        notes=noise.notes,
    )


def _length(noise: EstimatorNoise) -> str:
    return f"{noise.lengths[noise.chosen]:g} s"


def statements(noise: EstimatorNoise) -> Iterator[Statement]:
    """Say which noise is left as it is, and at which lengths the numbers do not hold."""
    at = _length(noise)
    for name, triad in noise.triads.items():
        if triad.high[noise.chosen] < _QUIETER:
            yield Statement(
                sentence(name),
                f"The errors in motion are {number(triad.multiplier[noise.chosen])} times the white noise over {at}. "
                "The noise is left as it is, because in motion a sensor is no quieter than at rest.",
            )
    for name, values in noise.nees.items():
        off = [
            f"{number(value, 2)} at {length:g} s"
            for length, value in zip(noise.lengths, values[:, 1], strict=True)
            if not _HOLDS[0] <= value <= _HOLDS[1]
        ]
        if off:
            yield Statement(
                f"NEES of {name}",
                f"No white noise makes the NEES of {name} one at every length: with the numbers for {at} it is "
                f"{', '.join(off)}. Above one the estimator trusts the unit too much, below one too little.",
            )


def _table(noise: EstimatorNoise) -> Table:
    rows = []
    for name, triad in noise.triads.items():
        intervals = zip(triad.multiplier, triad.low, triad.high, strict=True)
        texts = ("{} ({} to {})".format(*map(number, interval)) for interval in intervals)
        rows.append((f"{name}, N times (95 %)", *texts))
        rows += [
            (f"– {term}", *(f"{value:.2f}" for value in values))
            for term, values in triad.terms.items()
            if np.max(values) >= _LEAST
        ]
    for name, values in noise.nees.items():
        for with_noise, row in zip(("as stated", "multiplied"), values.T, strict=True):
            rows.append((f"NEES of {name}, {with_noise}", *(number(value, 2) for value in row)))
    return Table(
        ("", *(f"over {length:g} s" for length in noise.lengths)),
        rows,
        "Terms after a dash: what each would make by itself, as a multiple of N. NEES: squared error over what the "
        "estimator expects; it should be one.",
    )
