"""Accept or reject calibrated units: every limit an item with value, uncertainty, probability and verdict."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from jaximu.acceptance.decision import UNDECIDED, Rule, probability_of_conformity, worst
from jaximu.acceptance.item import Item, deciding
from jaximu.acceptance.limits import FROM_ALLAN, OF_ONE_UNIT, OUTPUTS, Limit, Limits
from jaximu.acceptance.navigation import navigation_items
from jaximu.acceptance.quantities import Measured, Units, measure, of_calibration
from jaximu.acceptance.words import parts_of
from jaximu.calibration import Calibration
from jaximu.estimation.problem import flatten, names_of, typical_sizes
from jaximu.estimation.uncertainty import pose_advice, station_advice
from jaximu.ground.array_types import FloatArray
from jaximu.ground.document import SOFTWARE, Document, Json, entries
from jaximu.ground.errors import FilePath
from jaximu.ground.page import Result
from jaximu.ground.quantities import Z95
from jaximu.ground.vectors import root_or_zero

SCHEMA = "jaximu.acceptance/1"
_TERM = ("value", "low", "high")
_BY_HAND = ("joint", "two-step", "two-step-rk4", "accelerometer")


@dataclass(frozen=True, eq=False, repr=False)
class Acceptance(Result, Document, page="certificate"):
    """The verdict on one unit. trace: what is known of the unit and of how it was calibrated."""

    items: tuple[Item, ...]
    rule: Rule
    file: str
    limits: Mapping[str, str]
    trace: Json | None = None
    digest: str | None = None
    notes: tuple[str, ...] = ()

    @property
    def verdict(self) -> str:
        """Fail if any item fails, else undecided if any is, else pass."""
        return worst([item.verdict for item in self.items])

    @property
    def serial(self) -> str:
        """The unit's serial number, "" where it is not known."""
        return str((self.trace or {}).get("serial", ""))

    def document(self) -> Json:
        """Return the verdict as the JSON document of schema `jaximu.acceptance/1`."""
        return {
            "schema": SCHEMA,
            **entries(self, "verdict", "trace", "notes"),
            "serial": self.serial or None,
            "calibration": {"file": self.file, "digest": self.digest},
            "limits": dict(self.limits),
            "decision": self.rule.document(),
            "items": [item.document() for item in self.items],
            "software": SOFTWARE,
        }


@dataclass(frozen=True)
class Judged:
    """Limits on every axis that has them, for n units. limits, names, places: by item; -1: units have no such thing.

    value, sigma, probability: (n, k); verdict: (n, k).
    """

    measured: Measured
    limits: tuple[Limit, ...]
    names: tuple[str, ...]
    places: tuple[int, ...]
    probability: FloatArray
    verdict: NDArray[np.str_]

    def result(self, row: int, index: int) -> Json:
        """Return what an item of a unit says of its value."""
        at = row, self.places[index]
        numbers = {key: float(getattr(self.measured, key)[at]) for key in ("value", "sigma", "freedom")}
        return numbers | {"probability": float(self.probability[row, index]), "verdict": str(self.verdict[row, index])}


def judge(units: Units, limits: Limits) -> Judged:
    """Hold units of one structure to limits of parameters and outputs; other limits are left alone."""
    held = {name.owner for name in units.names}
    outputs = [limit for limit in limits.limits if limit.part in OUTPUTS and limit.owner in held]
    measured = measure(units, limits.nominal, outputs)
    first = len(measured.names) - 3 * len(outputs)
    questions = []
    for limit in limits.limits:
        if limit.part in OF_ONE_UNIT:
            continue
        if limit in outputs:
            start = first + 3 * outputs.index(limit)
            columns = {(axis,): start + axis for axis in range(3)}
        else:
            columns = {
                named.axes: column
                for column, named in enumerate(map(parts_of, measured.names[:first]))
                if named.stem == limit.stem and limit.owner in held
            }
        for axes, column in columns.items():
            name = f"{limit.stem}[{','.join(map(str, axes))}]"
            # the convention's zeros are no result; who names one is told so
            if limits.applies(limit, name) and (limit.axes or limit in outputs or not measured.fixed[column]):
                questions.append((limit, name, column))
        if not columns or (limit.axes and limit.axes not in columns):
            questions.append((limit, limit.key, -1))
    indices = [column for _, _, column in questions]
    value, sigma, freedom = (array[:, indices] for array in (measured.value, measured.sigma, measured.freedom))
    low, high = (np.array([getattr(limit, end) for limit, _, _ in questions]) for end in ("low", "high"))
    probability = probability_of_conformity(value, sigma, low, high, freedom)
    verdict = limits.rule.verdicts(probability, (low <= value) & (value <= high))
    open_ = ~measured.determined[:, indices] | measured.fixed[indices]
    unknown = np.array([bool(_not_stated(limit, units, limits)) or column < 0 for limit, _, column in questions], bool)
    verdict = np.where(open_ | unknown, UNDECIDED, verdict)
    return Judged(
        measured,
        tuple(limit for limit, _, _ in questions),
        tuple(name for _, name, _ in questions),
        tuple(indices),
        probability,
        verdict,
    )


def _not_stated(limit: Limit, units: Units, limits: Limits) -> str:
    """Say what a limit needs to know beyond the calibration, "" where nothing."""
    triad = units.like.triads().get(limit.owner)
    if triad is None or limit.owner not in {name.owner for name in units.names}:
        return f"the calibration holds no {limit.owner}"
    if limit.part in ("scale", "raw_output") and triad.output_unit == "count" and limit.owner not in limits.nominal:
        example = {"accelerometer": "2048 count/g", "gyroscope": "16.4 count/(deg/s)"}.get(limit.owner, "10 count/uT")
        return (
            f"the {limit.owner} was logged in counts: state its nominal scale below [nominal], "
            f'{limit.owner} = "{example}"'
        )
    if "." in limit.part and limit.part not in {effect.name for effect in triad.effects}:
        return f"{limit.part} is not part of this calibration; jaximu calibrate --effect {limit.part} fits it"
    if "." in limit.part and triad.output_unit == "count":
        return f"{limit.part} was calibrated in counts; limit the output instead"
    return ""


def accept(
    calibration: Calibration,
    limits: Limits,
    noise: Mapping[str, Any] | None = None,
    file: FilePath = "calibration",
) -> Acceptance:
    """Hold a calibrated unit to limits.

    **Arguments:** `noise`: an `allan.json` as a dictionary, for limits of noise and repeatability; `file`: what the
    calibration is called.

    **Returns:** a verdict on every limit and on the unit. What was not determined is undecided, with the reason. Raises
    `InputError` where a limit's range does not state what an effect of the calibration depends on.
    """
    units = of_calibration(calibration)
    judged = judge(units, limits)
    items = [_item(calibration, units, limits, judged, index) for index in range(len(judged.names))]
    items += [
        item for limit in limits.limits if limit.part in FROM_ALLAN for item in _noise_items(limit, limits.rule, noise)
    ]
    along = [limit for limit in limits.limits if limit.owner == "navigation"]
    navigated, on_the_path = navigation_items(along, limits.rule, calibration, noise, os.fspath(file))
    items += navigated
    notes = [f"{len(limits.limits)} limits on {len(items)} items."]
    if "temperature_range" not in calibration.data:
        warm = calibration.data.get("temperature")
        at = "at one temperature" if warm is None else f"at {warm:.1f} °C"
        notes += [
            f"{limit.key}: the unit was calibrated {at}, and its uncertainty at others is not known."
            for limit in limits.limits
            if limit.temperature
        ]
    notes += on_the_path
    return Acceptance(
        tuple(items),
        limits.rule,
        os.fspath(file),
        {"file": limits.file, "sha256": limits.sha256},
        calibration.trace,
        calibration.digest,
        tuple(notes),
    )


def _item(calibration: Calibration, units: Units, limits: Limits, judged: Judged, index: int) -> Item:
    limit, at, measured, name = judged.limits[index], judged.places[index], judged.measured, judged.names[index]
    calibrated = calibration.data.get("temperature_range")
    warm = limit.temperature
    reason = _not_stated(limit, units, limits)
    if not reason and at < 0:
        reason = "the calibration has no such axis"
    elif not reason and measured.fixed[at]:
        reason = "this entry is zero by convention, which fixes the body frame"
    if reason:
        return Item.of(limit, name, reason=reason)
    record = _record(calibration, units, measured.slope[0, at])
    if not measured.determined[0, at]:
        return Item.of(limit, name, reason="the recording does not determine it", advice=record)
    if warm and calibrated and not calibrated[0] <= warm[0] <= warm[1] <= calibrated[1]:
        beyond = f"{calibrated[0]:.1f} to {calibrated[1]:.1f} °C that were calibrated"
        return Item.of(limit, name, reason=f"the limit's temperatures go beyond the {beyond}")
    result, gravity, advice = judged.result(0, index), float(measured.gravity[0, at]), ""
    recording = float(root_or_zero(result["sigma"] ** 2 - gravity**2))
    if result["verdict"] == UNDECIDED:
        needed = limit.nearest(result["value"]) / float(limits.rule.multiple(result["freedom"]))
        advice = deciding(needed, recording, gravity, calibration.gravity.sigma, record)
    return Item.of(limit, name, **result, gravity=gravity, recording=recording, advice=advice)


def _record(calibration: Calibration, units: Units, slope: FloatArray) -> str:
    """Say which poses or turns tell most of a quantity: those that excite the direction in which it is uncertain."""
    imu = calibration.imu
    known = names_of(imu)
    sizes = flatten(typical_sizes(imu))[[known.index(name) for name in units.names]]
    direction = calibration.covariance @ slope / sizes
    size = np.linalg.norm(direction)
    if not size > 0:
        return "longer rests."
    advice: Callable[..., str] = pose_advice if calibration.method in _BY_HAND else station_advice
    return advice(direction / size, units.names, sizes, imu)


# --- noise ------------------------------------------------------------------------------------------------------------


def _noise_items(limit: Limit, rule: Rule, noise: Mapping[str, Any] | None) -> Iterator[Item]:
    for axis in limit.axes or range(3):
        name, (reason, advice, term) = f"{limit.owner}.{limit.part}[{axis}]", _noise_term(limit, axis, noise)
        if reason:
            yield Item.of(limit, name, reason=reason, advice=advice)
            continue
        value, low, high = (float(term[key]) for key in _TERM)
        sigma = (high - low) / (2 * Z95)
        advice = ""
        judged = limit.judged(rule, value, sigma)
        if judged["verdict"] == UNDECIDED:
            needed = limit.nearest(value) / float(rule.multiple())
            advice = f"Record about {max(1.1, (sigma / needed) ** 2):.2g} times as long at rest."
        yield Item.of(limit, name, **judged, recording=sigma, advice=advice)


def _noise_term(limit: Limit, axis: int, noise: Mapping[str, Any] | None) -> tuple[str, str, Mapping[str, Any]]:
    """Return why an axis has no such term, and what to record, both "" where there is one; and the term (95 %)."""
    several = limit.part == "repeatability"
    if noise is None:
        what = "several recordings at rest, one a power-on" if several else "a recording at rest"
        logs = "LOG LOG …" if several else "LOG"
        return f"it takes {what}", f"Run jaximu allan {logs} -o noise, and add --noise noise/allan.json.", {}
    if several:
        known = (noise.get("repeatability") or {}).get(limit.owner)
        if known is None:
            return "allan.json is of one recording", "Give jaximu allan one recording at rest a power-on.", {}
        return "", "", {key: known[key][axis] for key in _TERM}
    axes = noise.get(limit.owner)
    if axes is None:
        return f"allan.json holds no {limit.owner}", "", {}
    term = axes[axis]["terms"].get(limit.part)
    if term is None:
        return "the recording at rest does not show this term", "Record longer at rest.", {}
    return "", "", term
