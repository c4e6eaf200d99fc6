"""What a scheme of poses and turns determines, how well conditioned it is, and which pose or turn adds the rest (S8).

Without effects the three axes of a triad share one design: the mean inputs ū of its stations, each with a one for the
bias. A combination n of the four columns that no station excites, [ū 1] n = 0, is open in every axis: three parameters.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from jaximu.estimation.problem import Name
from jaximu.ground.array_types import FloatArray
from jaximu.ground.quantities import listed
from jaximu.ground.vectors import column_lengths, dot_rows, lengths_of
from jaximu.recordings.observations import Stations
from jaximu.simulation.protocols.positions import FACES

_OPEN = 1e-6  # singular value, as a share of the largest, below which nothing is determined


@dataclass(frozen=True)
class Scheme:
    """A triad in a scheme: `rank` of `parameters`; `condition` number of the design, inputs scaled to order one, in
    what is determined; `undetermined` names of parameters; `remedy` poses or turns that add them; `text`: all this in
    words.
    """

    triad: str
    rank: int
    parameters: int
    condition: float
    undetermined: tuple[str, ...]
    remedy: tuple[str, ...]
    text: str


def describe_scheme(stations: Stations) -> tuple[Scheme, ...]:
    """Return what the stations determine of the accelerometer and of the gyroscope, 12 parameters each."""
    weight = np.asarray(stations.weight)[..., None]
    stimulus = stations.stimulus
    return tuple(
        _scheme(triad, dot_rows(weight, np.asarray(quantity))[np.asarray(used)])
        for triad, quantity, used in (
            ("accelerometer", stimulus.specific_force, stations.accelerometer_used),
            ("gyroscope", stimulus.angular_rate, stations.gyroscope_used),
        )
    )


def _spectrum(design: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the four singular values of a design (n, 4), and its right singular vectors, a row each."""
    _, values, right = np.linalg.svd(design)
    return np.pad(values, (0, 4 - len(values))), right


def _scheme(triad: str, inputs: FloatArray) -> Scheme:
    size = lengths_of(inputs).max(initial=0.0)
    design = np.column_stack([inputs / (size or 1.0), np.ones(len(inputs))]).reshape(-1, 4)
    values, right = _spectrum(design)
    rank = int((values > _OPEN * values[0]).sum())
    condition = float(values[0] / values[rank - 1]) if rank else np.inf
    share = column_lengths(right[rank:])
    open_columns = [k for k in range(4) if share[k] > 1e-3]
    undetermined = tuple(
        Name(triad, "gain", (row, k)) if k < 3 else Name(triad, "bias", (row,))
        for k in open_columns
        for row in range(3)
    )
    remedy = _remedies(triad, design)
    known = f"the scheme determines {'all 12' if rank == 4 else f'{3 * rank} of 12'} parameters of the {triad}"
    if rank == 4:
        text = f"{known}; condition number {condition:.3g}."
    else:
        alone = [_column(k) for k in open_columns if share[k] > 1 - 1e-6]
        tied = [_column(k) for k in open_columns if share[k] <= 1 - 1e-6]
        parts = [f"nothing determines {listed(alone)}"] if alone else []
        parts += [f"{listed(tied)} cannot be told apart"] if tied else []
        text = f"{known}: {'; '.join(parts)}. What adds them: {'; '.join(remedy)}."
    return Scheme(triad, 3 * rank, 12, condition, undetermined, remedy, text)


def _column(column: int) -> str:
    if column == 3:
        return "the bias"
    axis = "xyz"[column]
    others = [f"{other} from {axis}" for other in "xyz" if other != axis]
    return f"the response to {axis} (scale {axis}, misalignments {' and '.join(others)})"


def _remedies(triad: str, design: FloatArray) -> tuple[str, ...]:
    """Add, one after the other, the pose or turn that excites most of what is still open."""
    names: Sequence[str]
    if triad == "accelerometer":
        rows = [np.append(up, 1.0) for up in FACES]
        names = [f"a pose with {sign}{axis} up" for axis in "xyz" for sign in "+−"]
    else:
        rows = [np.append(axis, 1.0) for axis in (np.zeros(3), *FACES)]
        names = ["a rest", *(f"a turn about {sign}{axis}" for axis in "xyz" for sign in "+−")]
    added = []
    for _ in range(4):
        values, right = _spectrum(design)
        left = right[values <= _OPEN * max(values[0], 1e-300)]
        if not len(left):
            break
        gain = [np.linalg.norm(left @ row) / np.linalg.norm(row) for row in rows]
        best = int(np.argmax(np.round(gain, 9)))
        added.append(names[best])
        design = np.vstack([design, rows[best]])
    return tuple(added)
