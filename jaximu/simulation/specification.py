"""A simulation written down in TOML: protocol, unit, effects, noise, artefacts; numbers or ranges to draw from.

    seed = 1
    units = 20                       # a fleet: every range below is drawn for each unit; 1 by default
    recordings = 2                   # power-ons of each unit; 1 by default
    rate = 100                       # Hz

    [protocol]
    kind = "hand-held"               # its other keys are the protocol's, see `jaximu simulate --protocols`
    poses = 24

    [environment]                    # all optional
    gravity = 9.80943                # m/s²
    latitude = 48.2                  # degrees: the Earth turns
    temperature = [[0, 22], [300, 31]]   # knots [s, °C], or one number; ambient likewise
    vibration = [{ frequency = 40, acceleration = [0, 0, 1], start = 10, stop = 20 }]

    field = 48                       # µT, the Earth's; dip = 62, degrees; current = [[0, 0], [60, 3]], knots [s, A]

    [accelerometer]                  # [gyroscope] likewise; without a table the sensor is perfect; [magnetometer]:
                                     # without a table there is none, its SI unit is µT, its bias hard iron
    output_unit = "count"            # or SI, the default
    counts = 2048                    # counts per SI unit
    scale = { low = -0.02, high = 0.02 }          # deviation from one, of each axis
    misalignment = { mean = 0, sigma = 0.005 }    # rad; accelerometer: below the diagonal
    bias = ["30 mg", { low = -0.3, high = 0.3 }, 0]   # in SI, or with a unit
    noise = { white = "100 ug/sqrt(Hz)", density = "one-sided", bias_instability = "20 ug", bias_instability_is = "B" }

    [effects."accel.quadratic"]      # any effect of the catalogue, see `jaximu effects`
    coefficients = [1e-3, 0, { low = -1e-3, high = 1e-3 }]

    [artefacts]
    clipping = { accelerometer = 39.2 }
    gap = [{ start = 10, stop = 12 }, { start = 50, stop = 50.5 }]

A number may be a range: `{ low, high }` is drawn evenly, `{ mean, sigma }` from a normal distribution. Each draw has a
stream of its own, by the key's name and the unit's number, so that adding a key changes no other draw.
"""

from __future__ import annotations

import inspect
import os
import zlib
from collections.abc import Iterable
from dataclasses import MISSING, Field, fields
from typing import Any

import numpy as np

from jaximu.ground.document import Json, read_toml
from jaximu.ground.errors import FilePath, InputError, nearest, only
from jaximu.ground.units import SENSOR_QUANTITIES, SENSOR_UNITS
from jaximu.model import Noise, parse_quantity
from jaximu.model.data_sheet import SI_UNITS
from jaximu.model.effects import CATALOGUE, Effect
from jaximu.model.noise import FIGURE_TERMS
from jaximu.model.sensor import Imu, Triad
from jaximu.model.stimulus import REFERENCE_TEMPERATURE
from jaximu.simulation.artefacts import ARTEFACTS, Artefact
from jaximu.simulation.engine import Case
from jaximu.simulation.protocols import PROTOCOLS, Environment, Protocol, Tone

_TRIAD_KEYS = ("output_unit", "counts", "gain", "scale", "misalignment", "bias", "temperature_reference", "noise")
_NOISE_KEYS = inspect.getfullargspec(Noise.from_datasheet).kwonlyargs
_TOP_KEYS = ("seed", "units", "recordings", "rate", "protocol", "environment", *SENSOR_UNITS, "effects", "artefacts")


def read_specification(path: FilePath) -> Specification:
    """Read and check a specification. Raises `InputError`, naming file and key, for anything that is not understood."""
    return Specification(read_toml(path), os.fspath(path))


class Specification:
    """A checked specification: `case(unit, recording)` draws one recording of it."""

    def __init__(self, document: Json, name: str = "specification"):
        self.document, self.name = document, name
        self._known(document, _TOP_KEYS, "")
        self.seed = self._count("seed", 0, least=0)
        self.units = self._count("units", 1)
        self.recordings = self._count("recordings", 1)
        if "protocol" not in document:
            raise InputError(f"{name}: there is no [protocol] table; its kind is one of {', '.join(PROTOCOLS)}.")
        self.case(0, 0)  # what is wrong in general is wrong for the first unit

    def case(self, unit: int, recording: int = 0) -> Case:
        """Return one recording of one unit, its ranges drawn."""
        draw = Draw(self.seed, unit)
        try:
            imu, noise = self._imu(draw)
            return Case.of(
                imu,
                self._protocol(draw),
                noise,
                draw.number(self.document.get("rate", 100.0), "rate"),
                (self.seed, unit),
                recording,
                self.environment_of(draw),
                self._artefacts(draw),
            )
        except InputError as error:
            text = str(error)
            raise (error if text.startswith(self.name) else InputError(f"{self.name}: {text}")) from error

    def cases(self) -> list[list[Case]]:
        """Return all cases, by unit and recording."""
        return [[self.case(unit, recording) for recording in range(self.recordings)] for unit in range(self.units)]

    # --- parts: `case` puts the name of the specification before what they say is wrong --------------------------

    def _known(self, table: Any, known: Iterable[str], where: str) -> Json:
        return only(table, known, self.name, where and f"[{where}]")

    def _table(self, key: str, known: Iterable[str]) -> Json:
        return self._known(self.document.get(key, {}), known, key)

    def _count(self, key: str, default: int, least: int = 1) -> int:
        value = self.document.get(key, default)
        if isinstance(value, bool) or not isinstance(value, int) or value < least:
            raise InputError(f"{self.name}: {key} must be a whole number of at least {least}, found {value!r}.")
        return value

    def _protocol(self, draw: Draw) -> Protocol:
        table = self.document["protocol"]
        kind = table.get("kind") if isinstance(table, dict) else None
        if kind not in PROTOCOLS:
            raise InputError(f"protocol.kind is {kind!r}; {nearest(kind, PROTOCOLS)}")
        return self._build(PROTOCOLS[kind], {k: v for k, v in table.items() if k != "kind"}, "protocol", draw)

    def environment_of(self, draw: Draw) -> Environment:
        return self._build(Environment, self.document.get("environment", {}), "environment", draw)

    def _imu(self, draw: Draw) -> tuple[Imu, dict[str, Noise]]:
        names = [name for name in SENSOR_UNITS if name != "magnetometer" or name in self.document]
        effects = [self._effect(name, entry, draw) for name, entry in self._table("effects", CATALOGUE).items()]
        triads: dict[str, Any] = {name: self._triad(name, draw) for name in names}
        noise = {name: self._noise(name, draw) for name in names}
        return (
            Imu(**triads).with_effects(*effects),
            {name: random for name, random in noise.items() if random.processes},
        )

    def _effect(self, name: str, entry: Any, draw: Draw) -> Effect:
        kind, where = CATALOGUE[name], f"effects.{name}"
        table = self._known(entry, ("coefficients", *kind.inner), where)
        if "coefficients" not in table:
            raise InputError(f"[{where}] needs coefficients, {kind.size} or one for all.")
        coefficients = draw.several(table["coefficients"], kind.size, f"{where}.coefficients")
        inner = {key: draw.number(value, f"{where}.{key}") for key, value in table.items() if key in kind.inner}
        for key, value in inner.items():
            if value < 0 or (value == 0 and kind.inner[key].low > 0):
                raise InputError(f"{where}.{key} must be greater than zero, found {value}.")
        return kind.make(coefficients, **inner)

    def _triad(self, name: str, draw: Draw) -> Triad:
        si, table = SENSOR_UNITS[name], self._table(name, _TRIAD_KEYS)
        unit = table.get("output_unit", si)
        if unit not in (si, "count"):
            raise InputError(f"{name}.output_unit must be {si!r} or 'count', found {unit!r}.")
        if (unit == "count") != ("counts" in table):
            raise InputError(f"{name}: output_unit = 'count' and counts (per {si}) go together.")
        counts = draw.number(table.get("counts", 1.0), f"{name}.counts")
        if not counts > 0:
            raise InputError(f"{name}.counts must be greater than zero, found {counts}.")
        if "gain" in table:
            if "scale" in table or "misalignment" in table:
                raise InputError(f"{name}: give either gain or scale and misalignment.")
            gain = np.array(draw.nested(table["gain"], f"{name}.gain"), float)
            if gain.shape != (3, 3) or abs(np.linalg.det(gain)) < 1e-12:
                raise InputError(f"{name}.gain must be an invertible 3×3 matrix.")
        else:
            rows, columns = np.tril_indices(3, -1) if name == "accelerometer" else (1 - np.eye(3)).nonzero()
            gain = np.diag(1 + draw.several(table.get("scale", 0.0), 3, f"{name}.scale"))
            gain[rows, columns] = draw.several(table.get("misalignment", 0.0), len(rows), f"{name}.misalignment")
            gain = counts * gain
        bias = counts * draw.several(table.get("bias", 0.0), 3, f"{name}.bias", si)
        reference = table.get("temperature_reference", REFERENCE_TEMPERATURE)
        return Triad(
            gain,
            bias,
            quantity=SENSOR_QUANTITIES[name],
            output_unit=unit,
            temperature_reference=draw.number(reference, f"{name}.temperature_reference"),
        )

    def _noise(self, name: str, draw: Draw) -> Noise:
        quantity, where = SENSOR_QUANTITIES[name], f"{name}.noise"
        figures: dict[str, Any] = {}
        for key, value in self._known(self._table(name, _TRIAD_KEYS).get("noise", {}), _NOISE_KEYS, where).items():
            unit = SI_UNITS[quantity].get(FIGURE_TERMS.get(key, ""), "1")
            figures[key] = draw.number(value, f"{where}.{key}", unit) if isinstance(value, dict) else value
        try:
            return Noise.from_datasheet(quantity, **figures)
        except (InputError, TypeError) as error:
            raise InputError(f"[{where}] {error}") from error

    def _artefacts(self, draw: Draw) -> list[Artefact]:
        return [
            self._build(ARTEFACTS[name], table, f"artefacts.{name}[{k}]", draw)
            for name, entry in self._table("artefacts", ARTEFACTS).items()
            for k, table in enumerate(entry if isinstance(entry, list) else [entry])
        ]

    def _build(self, kind: type, table: Any, where: str, draw: Draw) -> Any:
        """Return a dataclass from a table, its numbers drawn; the kind of each value is that of the field's type."""
        keys = {key.name: key for key in fields(kind)}
        table = self._known(table, keys, where)
        for name, key in keys.items():
            if name not in table and key.default is MISSING:
                raise InputError(f"{where} needs the key {name!r}.")
        return kind(**{name: self._value(keys[name], value, f"{where}.{name}", draw) for name, value in table.items()})

    def _value(self, key: Field, value: Any, path: str, draw: Draw) -> Any:
        type_ = key.type.__name__ if isinstance(key.type, type) else str(key.type).removeprefix("collections.abc.")
        if type_ == "str":
            if not isinstance(value, str):
                raise InputError(f"{path} must be text, found {value!r}.")
            return value
        if type_.startswith("tuple"):
            return tuple(draw.several(value, type_.count("float"), path).tolist())
        if type_ == "Sequence[Tone]":
            tones = value if isinstance(value, list) else [value]
            return tuple(self._build(Tone, tone, f"{path}[{k}]", draw) for k, tone in enumerate(tones))
        if type_.startswith("Sequence[") or ("Sequence[" in type_ and isinstance(value, list)):
            return tuple(draw.nested(value if isinstance(value, list) else [value], path))
        number = draw.number(value, path)
        if type_ != "int":
            return number
        if number != round(number):
            raise InputError(f"{path} must be a whole number, found {value!r}.")
        return round(number)


class Draw:
    """Numbers of a specification, for one unit: as they stand, from text with a unit, or drawn from a range."""

    def __init__(self, seed: int, unit: int):
        self.seed, self.unit = seed, unit

    def number(self, value: Any, where: str, unit: str = "") -> float:
        if isinstance(value, dict):
            if set(value) not in ({"low", "high"}, {"mean", "sigma"}):
                raise InputError(f"{where}: a range is {{ low, high }} or {{ mean, sigma }}, found {value!r}.")
            parts = {key: self.number(part, f"{where}.{key}", unit) for key, part in value.items()}
            rng = np.random.default_rng([self.seed, zlib.crc32(where.encode()), self.unit])
            if "low" in parts:
                if parts["low"] > parts["high"]:
                    raise InputError(f"{where}: low is above high in {value!r}.")
                return float(rng.uniform(parts["low"], parts["high"]))
            if parts["sigma"] < 0:
                raise InputError(f"{where}: sigma must not be negative, found {value!r}.")
            return float(rng.normal(parts["mean"], parts["sigma"]))
        if isinstance(value, str) and unit:
            return parse_quantity(value, unit, where)
        if isinstance(value, bool) or not isinstance(value, int | float) or not np.isfinite(value):
            raise InputError(f"{where} must be a number{' or text with a unit' if unit else ''}, found {value!r}.")
        return float(value)

    def several(self, value: Any, count: int, where: str, unit: str = "") -> np.ndarray:
        """Return `count` numbers, from as many or from one that stands for all (a range is drawn for each)."""
        entries = value if isinstance(value, list) else [value] * count
        if len(entries) != count:
            raise InputError(f"{where} must be {count} numbers or one, found {len(entries)}.")
        return np.array([self.number(entry, f"{where}[{k}]", unit) for k, entry in enumerate(entries)])

    def nested(self, value: Any, where: str) -> Any:
        """Return lists of numbers, as deep as they are."""
        if isinstance(value, list):
            return [self.nested(entry, f"{where}[{k}]") for k, entry in enumerate(value)]
        return self.number(value, where)
