"""A random unit with one verb or one chain of verbs, all of it from one integer: what is run, and what must hold.

`python tests/random_units.py [--short] SEED …` runs draws again, prints them in a line each with what went wrong, and
keeps the files of the last in a folder that it names. `--short`: with logs as short as the tests take them.
"""

from __future__ import annotations

import os
import sys

from environment import environment, few_memory_maps

if __name__ == "__main__":
    os.environ.update(environment())

import csv
import json
import shutil
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import array_motion
import attitude_motion
import every_verb
import jax
import magnetic_motion
import numpy as np
import pyarrow as pa
import pyarrow.csv
import pyarrow.parquet
import sample_logs
import scipy.io
import written_files

from jaximu.calibration import load_calibration
from jaximu.ground import stored
from jaximu.ground.gravity import wgs84_gravity
from jaximu.model.effects import CATALOGUE
from jaximu.recordings.recording import Recording, Signal
from jaximu.report.export import WRITERS
from jaximu.simulation import Specification, Truth, simulate_cases

GRAVITY = 9.80665
FIVE_SIGMA = 5.0
FEWEST = 9  # orientations of a plain setting
SHORT = 1 / 3  # of the length of a log that is heated, in the tests
HIDDEN = (
    "accel.quadratic",
    "accel.cubic",
    "accel.asymmetry",
    "accel.cross_coupling",
    "accel.temperature",
    "accel.bias_ramp",
    "accel.warm_up",
    "accel.step",
    "accel.scale_step",
    "accel.lever_arm",
    "gyro.quadratic",
    "gyro.asymmetry",
    "gyro.temperature",
    "gyro.g_sensitivity",
    "gyro.bias_ramp",
    "gyro.scale_temperature",
    "gyro.lag",
    "gyro.dead_band",
    "setup.time_offset",
)
"""Effects that a unit may have without anybody saying so."""
ARTEFACTS = {
    "gap": {"start": 7.0, "stop": 7.8},
    "repeated": {"share": 0.01},
    "dropped": {"share": 0.01},
    "jitter": {"sigma": 1e-4},
    "clipping": {"accelerometer": 10.5},
}
BEYOND = (None, "temperature_squared", "thermal_lag", "thermal_hysteresis", "temperature_rate")
"""What temperature may do to a bias beyond a straight line."""
AXES = ("FRD", "y,-x,z", "-x,-y,z", "z,x,y", "-y,x,z", "accel=x,y,-z;gyro=-x,-y,z", "x,-z,y;-f", "FLU;-f")
FORCE = {"m/s^2": 1.0, "g": GRAVITY, "mg": GRAVITY / 1e3}
RATE = {"rad/s": 1.0, "deg/s": np.pi / 180, "mdps": np.pi / 180e3}
SECONDS = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}
COUNTS = ("16384 count/g", 16384 / GRAVITY), ("131 count/(deg/s)", 131 * 180 / np.pi)
GROUPS = {"accelerometer": "accel", "gyroscope": "gyro", "magnetometer": "mag"}
LIMITS = """[limits]
"accelerometer.bias" = "60 mg"
"accelerometer.scale" = "3 %"
"accelerometer.misalignment" = "30 mrad"
"""
GYROSCOPE_LIMITS = """"gyroscope.bias" = "2 deg/s"
"gyroscope.scale" = { typical = "1 %" }
"gyroscope.output" = { within = "2 deg/s", over = "300 deg/s" }
"""
TRACE = """serial = "A-0017"
model = "MPU-9150 on carrier B"
lot = "2026-11"
operator = "J. Doe"
station = "bench 2"
fixture = "cube 7"
date = "2026-03-04"
received = "2026-03-01"

[environment]
temperature = "(23.1 ± 0.5) °C"

[[reference]]
name = "local gravity"
certificate = "survey 2024-118"
expires = "2030-01-01"

[certificate]
number = "C-2026-0017"
laboratory = "Example Laboratory"
address = "1 Example Street, Example Town"
customer = "Example Customer, 2 Example Street"
authorised_by = "A. Smith"
"""


class Ended(Exception):
    """The first verb of a chain did not do its work, so that there is nothing to go on with."""


@dataclass(frozen=True)
class Reading:
    """How a log is written: its suffix, units, axes, and whether its columns are named in the file."""

    suffix: str = ".csv"
    force: str = "m/s^2"
    rate: str = "rad/s"
    time: str = "s"
    axes: str | None = None
    named: bool = True

    @property
    def options(self) -> list[str]:
        """What must be said for it to be read."""
        said = []
        if not self.named:
            said += ["--columns", f"time [{self.time}],accel [{self.force}],gyro [{self.rate}]"]
        if self.force == "count":
            said += ["--accel-scale", COUNTS[0][0], "--gyro-scale", COUNTS[1][0]]
        return said + (["--axes", self.axes] if self.axes else [])

    def maps(self) -> dict[str, np.ndarray]:
        """By sensor the (3, 3) map from the log's axes to the body's, by the words of the option."""
        maps = {name: np.eye(3) for name in GROUPS}
        for part in (self.axes or "").split(";"):
            sensor, _, text = part.rpartition("=")
            if part == "-f":
                maps["accelerometer"] = -maps["accelerometer"]
            elif part:
                matrix = np.zeros((3, 3))
                for row, term in enumerate({"FRD": "x,-y,-z", "FLU": "x,y,z"}.get(text, text).split(",")):
                    matrix[row, "xyz".index(term[-1])] = -1.0 if term.startswith("-") else 1.0
                maps |= {name: matrix for name, short in GROUPS.items() if sensor in ("", short)}
        return maps

    def per_si(self) -> dict[str, float]:
        """By sensor the units of the log in one SI unit."""
        if self.force == "count":
            return {"accelerometer": COUNTS[0][1], "gyroscope": COUNTS[1][1], "magnetometer": 1.0}
        return {"accelerometer": 1 / FORCE[self.force], "gyroscope": 1 / RATE[self.rate], "magnetometer": 1.0}

    def write(self, recording: Recording, folder: Path, name: str) -> Path:
        """Write a recording in body axes and SI units as this logger would."""
        path = folder / f"{name}{self.suffix}"
        maps, scales = self.maps(), self.per_si()
        units = {"accelerometer": self.force, "gyroscope": self.rate, "magnetometer": "uT"}
        clock = recording.accelerometer.time if len(recording.accelerometer) else recording.gyroscope.time
        parts = {"time": (self.time, clock[:, None] / SECONDS[self.time])}
        if self.time in ("us", "ns"):
            parts["time"] = self.time, np.round(parts["time"][1]).astype(np.int64)
        for field_name, signal in recording.signals.items():
            values = np.asarray(signal.values)
            if field_name in GROUPS:
                values = values @ maps[field_name] * scales[field_name]
                values = (
                    np.round(values).astype(np.int64)
                    if self.force == "count" and field_name != "magnetometer"
                    else values
                )
                parts[GROUPS[field_name]] = units[field_name], values
            else:
                parts[field_name] = signal.unit, values
        WRITE[self.suffix](path, parts, self.named)
        return path


Parts = dict[str, tuple[str, np.ndarray]]


def _columns(parts: Parts) -> dict[str, np.ndarray]:
    columns = {}
    for name, (unit, values) in parts.items():
        axes = {1: [""], 3: ["_x", "_y", "_z"], 4: ["_w", "_x", "_y", "_z"]}[values.shape[1]]
        bracket = "" if unit == "1" else f" [{unit}]"
        columns |= {f"{name}{axis}{bracket}": np.ascontiguousarray(values[:, at]) for at, axis in enumerate(axes)}
    return columns


def _text(delimiter: str) -> Callable[[Path, Parts, bool], None]:
    def write(path: Path, parts: Parts, named: bool) -> None:
        options = pa.csv.WriteOptions(include_header=named, delimiter=delimiter)
        if not named:  # what --columns names, and no more
            parts = {name: part for name, part in parts.items() if name in ("time", "accel", "gyro")}
        pa.csv.write_csv(pa.table(_columns(parts)), path, options)

    return write


def _mat(path: Path, parts: Parts, named: bool) -> None:
    units = {name: unit for name, (unit, _) in parts.items()}
    scipy.io.savemat(path, {**{name: values for name, (_, values) in parts.items()}, "units": units})


def _ulog(path: Path, parts: Parts, named: bool) -> None:
    # a schedule is on this clock, which has no stamps before zero
    time_us = np.maximum(np.round(parts["time"][1][:, 0] * 1e6), 0).astype(np.int64)
    warmth = parts.get("temperature", ("degC", np.full((len(time_us), 1), 25.0)))[1][:, 0]
    rows = []
    for at, force, rate, degrees in zip(time_us.tolist(), parts["accel"][1], parts["gyro"][1], warmth, strict=True):
        rows += [("sensor_accel", 0, (at, at, *force, degrees)), ("sensor_gyro", 0, (at, at, *rate, degrees))]
    sample_logs.write_ulog(path, {"sensor_accel": sample_logs.RAW, "sensor_gyro": sample_logs.RAW}, rows)


WRITE: dict[str, Callable[[Path, Parts, bool], None]] = {
    ".csv": _text(","),
    ".tsv": _text("\t"),
    ".parquet": lambda path, parts, named: pa.parquet.write_table(pa.table(_columns(parts)), path),
    ".npz": lambda path, parts, named: np.savez(path, **_columns(parts)),
    ".mat": _mat,
    ".ulg": _ulog,
}


@dataclass
class Failure:
    """Something that must not be: its kind, in which run, and what it looked like."""

    kind: str
    run: str
    text: str


@dataclass
class Draw:
    """A unit, its logs and a verb, drawn from a seed; what was chosen stands in `settings`."""

    seed: int
    folder: Path
    random: np.random.Generator
    settings: dict[str, Any] = field(default_factory=dict)
    plain: bool = True
    failures: list[Failure] = field(default_factory=list)
    seconds: dict[str, float] = field(default_factory=dict)  # by verb, and of all; of the processor's time
    statuses: list[tuple[str, int]] = field(default_factory=list)
    reading: Reading = field(default_factory=Reading)
    truths: dict[str, np.ndarray] = field(default_factory=dict)
    truths_of: str = "calibration.json"
    last: list[str] = field(default_factory=list)
    short: bool = False

    # --- choices

    def length(self, drawn: float) -> float:
        """The length of a log that is heated: what was drawn, or less where logs are to be short."""
        return drawn * SHORT if self.short else drawn

    def pick(self, name: str, options: Sequence[Any], weights: Sequence[float] | None = None) -> Any:
        """Choose one, and note it."""
        shares = None if weights is None else np.asarray(weights, float) / np.sum(weights)
        value = options[int(self.random.choice(len(options), p=shares))]
        self.settings[name] = value
        return value

    def chance(self, name: str, share: float) -> bool:
        """Choose yes with a probability; a yes is noted."""
        happens = bool(self.random.random() < share)
        if happens:
            self.settings[name] = True
        return happens

    def size(self, name: str, low: float, high: float) -> float:
        """Choose a number, and note it."""
        value = round(float(self.random.uniform(low, high)), 3)
        self.settings[name] = value
        return value

    @property
    def line(self) -> str:
        """The draw in one line."""
        settings = ", ".join(f"{name} {value}" for name, value in self.settings.items() if value is not None)
        return f"{self.seed}: {settings}"

    # --- what is recorded

    def draw_reading(self, bare: bool = False, counts: bool = True, gyroscope: bool = True) -> None:
        """Choose the format; `bare`: nothing beside time, accelerometer and gyroscope is in the log."""
        suffix = self.pick("format", [".csv", ".parquet", ".npz", ".tsv", ".mat", ".ulg"], [5, 4, 1, 1, 1, 1])
        if suffix == ".ulg" and not gyroscope:
            suffix = ".csv"
        if suffix == ".ulg":
            self.reading = Reading(suffix, axes=self.pick("axes", [None, "FRD"]))
            return
        force = self.pick("force", ["m/s^2", "g", "mg", "count"], [4, 2, 1, 2])
        if force == "count":
            force = force if counts else "g"
        rate = "count" if force == "count" else self.pick("rate of turn", list(RATE), [3, 2, 1])
        clock = self.pick("time", list(SECONDS), [4, 1, 1, 1])
        if suffix == ".mat" and clock == "ns":
            clock = "s"
        axes = self.pick("axes", [None, *AXES], [12, *[1] * len(AXES)])
        named = not (bare and gyroscope and suffix in (".csv", ".tsv") and self.chance("unnamed", 0.3))
        self.reading = Reading(suffix, force, rate, clock, axes, named)

    def draw_unit(self, temperature: bool = False, magnetometer: bool = False, hidden: float = 0.3) -> dict[str, Any]:
        """Choose a unit: a specification without protocol. Sizes are of consumer grade."""
        grade = self.size("grade", 0.5, 2.0)
        white = {"accelerometer": 100e-6 * GRAVITY, "gyroscope": float(np.radians(0.005)), "magnetometer": 0.02}
        sizes = {"accelerometer": (0.02, 0.3), "gyroscope": (0.02, 0.02), "magnetometer": (0.05, 20.0)}
        document: dict[str, Any] = {"seed": self.seed}
        for name in ("accelerometer", "gyroscope", *(["magnetometer"] if magnetometer else [])):
            gain, bias = sizes[name]
            density = {"white": grade * white[name], "density": "two-sided"}
            document[name] = {
                "scale": {"low": -gain, "high": gain},
                "misalignment": {"low": -gain, "high": gain},
                "bias": {"low": -bias, "high": bias},
                "noise": density if name != "magnetometer" else {"white": white[name], "density": "two-sided"},
            }
        effect = self.pick("hidden", HIDDEN) if self.random.random() < hidden else None
        if effect:
            self.plain = False
            kind, share = CATALOGUE[effect], self.size("hidden size", 0.3, 3.0)
            signs = self.random.choice([-1, 1], kind.size) * self.random.uniform(0.3, 1, kind.size)
            inner = {name: value.typical for name, value in kind.inner.items()}
            document["effects"] = {effect: {"coefficients": (share * kind.typical * signs).tolist(), **inner}}
        if temperature or (effect and "temperature" in effect) or effect == "accel.warm_up":
            document["environment"] = {"temperature": [[0, 22], [40, 31], [100, 25]]}
        return document

    def draw_artefact(self, document: dict[str, Any], share: float = 0.1) -> None:
        """Choose what may go wrong while a log is written."""
        if self.random.random() < share:
            name = self.pick("artefact", list(ARTEFACTS))
            document["artefacts"] = {name: ARTEFACTS[name]}
            self.plain = False

    def draw_rate(
        self,
        options: Sequence[float] = (12.5, 25, 50, 100, 200, 400, 1000),
        weights: Sequence[float] | None = (1, 2, 4, 4, 2, 1, 1),
    ) -> float:
        """Choose the rate of the samples, Hz."""
        return float(self.pick("rate", options, weights if weights and len(weights) == len(options) else None))

    def draw_gravity(self, document: dict[str, Any]) -> list[str]:
        """Choose the gravity of the place and how it is stated."""
        place = document.setdefault("environment", {})
        kind = self.pick("gravity", ["unstated", "stated", "latitude"], [3, 2, 1])
        if kind == "unstated":
            place["gravity"] = GRAVITY + float(np.clip(self.random.normal(0, 0.01), -0.03, 0.03))
            return []
        if kind == "stated":
            place["gravity"] = 9.81 + float(self.random.normal(0, 0.0005))
            return ["--gravity", "9.81+-0.0005"]
        place["gravity"], place["latitude"] = wgs84_gravity(48.1, 500.0).value, 48.1
        return ["--latitude", "48.1", "--height", "500"]

    def draw_hands(self, most: int = 24) -> dict[str, Any]:
        """Choose a protocol by hand."""
        counts = {6: 1, 9: 1, 12: 6, 16: 3, 24: 2}
        allowed = [count for count in counts if count <= most]
        poses = self.pick("poses", allowed, [counts[count] for count in allowed])
        rest = self.pick("rest", [1.5, 2.0, 3.0], [1, 5, 2])
        bend = self.pick("bend", [0.0, 10.0], [3, 1])
        self.plain &= poses >= FEWEST and rest >= 2.0
        return {
            "kind": "hand-held",
            "poses": poses,
            "pose_duration": rest,
            "turn_duration": 1.5,
            "initial_rest": 2.0,
            "bend": bend,
        }

    def simulate(
        self, document: dict[str, Any], protocol: dict[str, Any], rate: float, power_on: int = 0, unit: int = 0
    ) -> tuple[Recording, Truth]:
        """Simulate one recording of the unit, in SI units and body axes."""
        whole = Specification({**document, "protocol": protocol, "rate": rate, "units": 8})
        return simulate_cases([whole.case(unit, power_on)])[0]

    def keep_truth(self, gains: dict[str, np.ndarray], file: str = "calibration.json") -> None:
        """Keep the gains that a calibration in `file` must find, in units of the output."""
        scales = self.reading.per_si() if self.reading.force == "count" else dict.fromkeys(GROUPS, 1.0)
        self.truths, self.truths_of = {name: scales[name] * gain for name, gain in gains.items()}, file

    def log(
        self,
        name: str,
        document: dict[str, Any],
        protocol: dict[str, Any],
        rate: float,
        power_on: int = 0,
        without: Sequence[str] = (),
        unit: int = 0,
    ) -> Path:
        """Simulate a recording and write it; its truth is kept."""
        recording, truth = self.simulate(document, protocol, rate, power_on, unit)
        return self.write(name, recording, truth, without)

    def write(self, name: str, recording: Recording, truth: Truth | None = None, without: Sequence[str] = ()) -> Path:
        """Write a recording as the unit's logger would."""
        recording = replace(recording, **dict.fromkeys(without))
        if truth is not None:
            gains = {key: np.asarray(triad.gain) for key, triad in truth.imu.triads().items() if key not in without}
            self.keep_truth(gains)
        return self.reading.write(recording, self.folder, name)

    def by_hand(self, sensors: str | None = None, hidden: float = 0.3, bare: bool = True, **options: Any) -> ByHand:
        """Draw a unit, its reading, and a first log of poses at rest."""
        sensors = sensors or self.pick(
            "sensors", ["both", "accelerometer", "temperature", "magnetometer"], [6, 1, 2, 1]
        )
        self.draw_reading(bare and sensors in ("both", "accelerometer"), gyroscope=sensors != "accelerometer")
        document = self.draw_unit(sensors == "temperature", sensors == "magnetometer", hidden)
        if sensors == "magnetometer":
            document.setdefault("environment", {}).update(field=48.0, dip=62.0)
        local = self.draw_gravity(document)
        self.draw_artefact(document)
        protocol, rate = self.draw_hands(**options), self.draw_rate()
        without = {"accelerometer": ["gyroscope"], "both": ["temperature"]}.get(sensors, [])
        unit = ByHand(self, document, protocol, rate, local, without)
        unit.log = unit.another("log", 0)
        return unit

    # --- what is run

    def prepared(self, line: list[str], folder: str, file: str | None = None) -> Path:
        """Run the first verb of a chain into a folder. Raises `Ended` where it refuses."""
        output = self.folder / folder
        outcome = self._run("first", line, output, True, file)
        self._check_files(outcome, output)
        self._check_gains(output)
        if outcome.refused:
            self._refused(outcome)
            raise Ended
        return output

    def tried(self, line: list[str], file: str | None = None, only_with_output: bool = False) -> None:
        """Run the verb plain, with --json and with -o, and compare them; plain only if logs need not be short."""
        verb, output = line[0], self.folder / "out"
        self.last = line
        ways = [("plain", None, False), ("--json", None, True), ("-o", output, False)]
        if only_with_output:
            ways = [("-o", output, False), ("-o --json", self.folder / "out2", True)]
        if verb in every_verb.WITHOUT_JSON:
            ways = [way for way in ways if not way[2]]
        if verb in every_verb.WITHOUT_OUTPUT:
            ways = [way for way in ways if way[1] is None]
        if self.short and any(way[1] for way in ways):  # what prints the same and writes it, too, is enough
            ways = [way for way in ways if way[1] or way[2]]
        outcomes = {name: self._run(name, line, folder, as_json, file) for name, folder, as_json in ways}
        if len({outcome.status for outcome in outcomes.values()}) > 1:
            said = ", ".join(f"{name} {outcome.status} ({outcome.short[:80]})" for name, outcome in outcomes.items())
            self.failures.append(Failure("statuses differ", verb, said))
        printed = next((outcome for name, outcome in outcomes.items() if "--json" in name), None)
        kept = outcomes.get("-o")
        if kept is not None:
            self._check_files(kept, output)
            self._check_gains(output)
        if printed is not None and kept is not None and not printed.refused and not kept.refused:
            document = self._json(printed)
            if isinstance(document, dict):
                for text in written_files.disagreement(output, kept.written, document):
                    self.failures.append(Failure("file and --json differ", verb, text))
        if all(outcome.refused for outcome in outcomes.values()):
            self._refused(next(iter(outcomes.values())))

    def _run(
        self, name: str, line: list[str], output: Path | None, as_json: bool, file: str | None = None
    ) -> every_verb.Outcome:
        outcome = every_verb.run(line, output, as_json, file)
        verb = line[0]
        self.seconds[verb] = self.seconds.get(verb, 0.0) + outcome.seconds
        self.statuses.append((f"{verb} {name}", outcome.status))
        for text in outcome.faults:
            self.failures.append(Failure(_kind(text), f"{verb} {name}", text))
        if as_json and verb not in every_verb.WITHOUT_JSON:
            self._json(outcome)
        return outcome

    def _json(self, outcome: every_verb.Outcome) -> Any:
        try:
            document = written_files.strict(outcome.stdout)
        except ValueError as error:
            self.failures.append(Failure("--json is not JSON", outcome.verb, f"{error}: {outcome.stdout[:80]!r}"))
            return None
        for text in written_files.faults_of_document(document):
            self.failures.append(Failure("--json is damaged", outcome.verb, text))
        if outcome.refused and document.get("error") not in outcome.stderr:
            self.failures.append(Failure("stdout and stderr differ", outcome.verb, str(document)[:200]))
        return document

    def _check_files(self, outcome: every_verb.Outcome, folder: Path) -> None:
        if outcome.status == 0 and outcome.verb not in every_verb.WITHOUT_OUTPUT and not outcome.written:
            self.failures.append(Failure("nothing written", outcome.verb, outcome.stderr[-200:]))
        for text in written_files.faults_of_files(folder, outcome.written):
            self.failures.append(Failure("file", outcome.verb, text))

    def _check_gains(self, folder: Path) -> None:
        """In a plain setting gains lie within five stated sigmas of the truth."""
        path = folder / self.truths_of
        if not self.plain or not self.truths or not path.is_file():
            return
        calibration = load_calibration(path)
        for name, truth in self.truths.items():
            triad = calibration.triads().get(name)
            if triad is None:
                continue
            sigma = calibration.sigma(name)[0]
            error = np.abs(np.asarray(triad.gain) - truth) / np.where(sigma > 0, sigma, np.inf)
            if error.max() > FIVE_SIGMA:
                row, column = np.unravel_index(error.argmax(), error.shape)
                text = f"{name} gain[{row},{column}] is {error.max():.1f} sigma off its truth"
                self.failures.append(Failure("gain off", "calibration", text))

    def _refused(self, outcome: every_verb.Outcome) -> None:
        self.settings["refused"] = f"{outcome.verb}: {outcome.short[:160]}"
        if self.plain:
            self.failures.append(Failure("refused a plain setting", outcome.verb, outcome.short))


def _kind(text: str) -> str:
    for word, kind in (
        ("should not happen", "this should not happen"),
        ("Traceback", "this should not happen"),
        ("warned", "warning"),
        ("Warning:", "warning"),
        ("could not be drawn", "not drawn"),
        ("failed and left", "failed and left files"),
        ("without a word", "failed without a word"),
        ("exit status", "exit status"),
    ):
        if word in text:
            return kind
    return "other"


@dataclass
class ByHand:
    """A unit that is held in poses by hand: where its logs come from."""

    draw: Draw
    document: dict[str, Any]
    protocol: dict[str, Any]
    rate: float
    local: list[str]
    without: list[str]
    log: Path = Path()

    @property
    def options(self) -> list[str]:
        """How its logs are read, and the gravity where they were recorded."""
        return [*self.draw.reading.options, *self.local]

    def another(self, name: str, power_on: int, unit: int = 0) -> Path:
        """Record it once more."""
        return self.draw.log(name, self.document, self.protocol, self.rate, power_on, self.without, unit)

    def at_rest(self, minutes: float = 5.0, rate: float | None = None) -> Path:
        """Record it at rest, without the effect that it may have."""
        document = {key: value for key, value in self.document.items() if key not in ("effects", "artefacts")}
        truths = self.draw.truths
        path = self.draw.log(
            "rest", document, {"kind": "static", "duration": 60 * minutes}, rate or self.rate, 7, self.without
        )
        self.draw.truths = truths
        return path

    def calibrated(self) -> Path:
        """Calibrate it; return the file."""
        return self.draw.prepared(["calibrate", str(self.log), *self.options], "first") / "calibration.json"


# --- verbs and chains -------------------------------------------------------------------------------------------------

Recipe = Callable[[Draw], None]


def info(draw: Draw) -> None:
    kind = draw.pick("log of", ["hands", "rest", "heat", "table"])
    if kind == "hands":
        unit = draw.by_hand()
        logs = [str(unit.log)] + ([str(unit.another("second", 1))] if draw.chance("two logs", 0.2) else [])
        draw.tried(["info", *logs, *draw.reading.options])
    elif kind == "rest":
        draw.draw_reading(True)
        log = draw.log("log", draw.draw_unit(), {"kind": "static", "duration": 60.0}, draw.draw_rate())
        draw.tried(["info", str(log), *draw.reading.options])
    elif kind == "heat":
        log = Heated.of(draw).log()
        draw.tried(["info", str(log), *draw.reading.options])
    else:
        log, _ = on_table(draw, "columns")
        draw.tried(["info", str(log), *draw.reading.options])


def calibrate(draw: Draw) -> None:
    unit = draw.by_hand()
    line = ["calibrate", str(unit.log), *unit.options]
    more = draw.pick("calibrate with", ["", "static", "several", "effect", "repair", "trace"], [4, 1, 1, 1, 1, 1])
    if more == "static":
        line += ["--static", str(unit.at_rest())]
    if more == "several":
        line[2:2] = [str(unit.another(f"log{number}", number)) for number in (1, 2)]
    if more == "effect":
        line += ["--effect", draw.pick("effect", ["accel.asymmetry", "accel.quadratic", "gyro.g_sensitivity"])]
        draw.plain = False
    if more == "repair":
        line += ["--repair"]
    if more == "trace":
        (draw.folder / "trace.toml").write_text(TRACE)
        line += ["--trace", str(draw.folder / "trace.toml"), "--serial", "A-9"]
    method = draw.pick("method", ["joint", "two-step", "two-step-rk4", "accelerometer"], [8, 1, 1, 1])
    loss = draw.pick("loss", ["linear", "huber", "cauchy"], [8, 1, 1])
    draw.plain &= method in ("joint", "accelerometer") and loss == "linear"
    if method != "joint":
        line += ["--method", method]
    if loss != "linear":
        line += ["--loss", loss]
    draw.tried(line)


def calibrate_means(draw: Draw) -> None:
    unit = draw.draw_unit(hidden=0.0)
    local = draw.draw_gravity(unit)
    poses = draw.pick("poses", [6, 9, 12, 18, 26])
    spread = draw.chance("deviations", 0.5)
    draw.plain = poses >= FEWEST + (0 if spread else 3)  # without them the poses must show the noise, too
    _, truth = draw.simulate(unit, {"kind": "positions", "count": 6, "duration": 1.0, "turn_duration": 1.0}, 25.0)
    gyroscope = draw.chance("gyroscope", 0.6)
    up = draw.random.standard_normal((poses, 3))
    up[:6] = np.vstack([np.eye(3), -np.eye(3)]) + 0.1 * draw.random.standard_normal((6, 3))
    up /= np.linalg.norm(up, axis=1)[:, None]
    triads = truth.imu.triads()
    force = unit["environment"]["gravity"] * up @ np.asarray(triads["accelerometer"].gain).T
    force += np.asarray(triads["accelerometer"].bias) + 2e-3 * draw.random.standard_normal((poses, 3))
    names = draw.pick("force", ["m/s^2", "g", "mg"])
    columns = {f"accel_{axis} [{names}]": force[:, at] / FORCE[names] for at, axis in enumerate("xyz")}
    if spread:
        columns |= {f"accel_sigma_{axis} [{names}]": np.full(poses, 0.02 / FORCE[names]) for axis in "xyz"}
        columns["samples"] = np.full(poses, 100)
    if gyroscope:
        still = np.asarray(triads["gyroscope"].bias) + 1e-4 * draw.random.standard_normal((poses, 3))
        columns |= {f"gyro_{axis} [rad/s]": still[:, at] for at, axis in enumerate("xyz")}
    path = draw.folder / "means.csv"
    pa.csv.write_csv(pa.table(columns), path)
    draw.keep_truth({"accelerometer": np.asarray(triads["accelerometer"].gain)})
    draw.tried(["calibrate", str(path), "--means", *local])


def diagnose(draw: Draw) -> None:
    unit = draw.by_hand(hidden=0.6)
    draw.plain &= "gyroscope" not in unit.without  # the turns tell causes apart
    line = ["diagnose", str(unit.log), *unit.options]
    more = draw.pick("diagnose with", ["", "static", "heldout", "several", "repair"], [3, 2, 2, 1, 1])
    if more == "static":
        line += ["--static", str(unit.at_rest())]
    if more == "heldout":
        line += ["--heldout", str(unit.another("heldout", 1))]
    if more == "several":
        line[2:2] = [str(unit.another("second", 1))]
    if more == "repair":
        line += ["--repair"]
    draw.tried(line)


@dataclass
class Heated:
    """A unit at rest while its temperature goes up and down twice."""

    draw: Draw
    document: dict[str, Any]
    minutes: float
    rate: float

    @classmethod
    def of(cls, draw: Draw) -> Heated:
        """Draw the unit, its reading, and the path of its temperature."""
        draw.draw_reading()
        document, minutes = draw.draw_unit(hidden=0.0), draw.pick("minutes", [15, 30])
        which = draw.pick("depends on temperature", ["both", "accelerometer", "gyroscope", "none"], [5, 1, 1, 1])
        document["effects"] = {}
        for short, triad in (("accel", "accelerometer"), ("gyro", "gyroscope")):
            if which in ("both", triad):
                beyond = draw.pick(f"{short} beyond", BEYOND)
                for name in filter(None, ("temperature", beyond)):
                    kind = CATALOGUE[f"{short}.{name}"]
                    inner = {key: value.typical for key, value in kind.inner.items()}
                    sizes = 2 * kind.typical * draw.random.uniform(-1, 1, kind.size)
                    document["effects"][kind.name] = {"coefficients": sizes.tolist(), **inner}
        low, high = draw.size("low", -10, 20), draw.size("high", 35, 60)
        minutes = draw.length(minutes)
        knots = zip(np.linspace(0, 60 * minutes, 5).tolist(), (low, high, low, high, low), strict=True)
        document["environment"] = {"temperature": [list(knot) for knot in knots]}
        return cls(draw, document, minutes, draw.draw_rate((12.5, 25), None))

    def log(self, name: str = "log", power_on: int = 0) -> Path:
        """Record it at rest."""
        protocol = {"kind": "static", "duration": 60.0 * self.minutes}
        path = self.draw.log(name, self.document, protocol, self.rate, power_on)
        self.draw.truths = {}
        return path

    def by_hand(self) -> Path:
        """Record it in poses, at nearly one temperature."""
        document = {**self.document, "environment": {"temperature": [[0, 24], [40, 29], [100, 25]]}}
        protocol = {"kind": "hand-held", "poses": 12, "pose_duration": 2.0, "turn_duration": 1.5, "initial_rest": 2.0}
        path = self.draw.log("hands", document, protocol, 4 * self.rate, 3)
        self.draw.truths = {}  # what temperature does to them is not in the first calibration
        return path


def diagnose_thermal(draw: Draw) -> None:
    log = Heated.of(draw).log()
    draw.tried(["diagnose", "--thermal", str(log), *draw.reading.options])


def thermal(draw: Draw) -> None:
    unit = Heated.of(draw)
    logs = [str(unit.log())]
    if draw.chance("two logs", 0.3):
        logs += [str(unit.log("second", 1))]
    line = ["thermal", *logs, *draw.reading.options]
    to = draw.pick("to", [None, "px4", "ardupilot"])
    draw.tried([*line, *(["--to", to] if to else [])], only_with_output=to is not None)


def thermal_of(draw: Draw) -> tuple[Path, Path]:
    """Calibrate a unit by hand, add its thermal part; return the log by hand and the calibration."""
    unit = Heated.of(draw)
    hot, log = unit.log(), unit.by_hand()
    first = draw.prepared(["calibrate", str(log), *draw.reading.options], "first")
    line = ["thermal", str(hot), *draw.reading.options, "--calibration", str(first / "calibration.json")]
    draw.last = line
    return log, draw.prepared(line, "thermal") / "calibration.json"


def thermal_calibration(draw: Draw) -> None:
    thermal_of(draw)
    draw.tried(draw.last)


def thermal_by_hand(draw: Draw) -> None:
    draw.plain = False
    draw.draw_reading()
    document = draw.draw_unit(hidden=0.0)
    local = draw.draw_gravity(document)
    document["effects"] = {
        "accel.temperature": {"coefficients": (3e-3 * draw.random.uniform(-1, 1, 3)).tolist()},
        "gyro.scale_temperature": {"coefficients": (2e-4 * draw.random.uniform(-1, 1, 3)).tolist()},
    }
    protocol = {"kind": "hand-held", "poses": draw.pick("poses", [24, 40]), "pose_duration": 3.0, "turn_duration": 1.5}
    length = 4.5 * protocol["poses"]
    document["environment"]["temperature"] = [[0, 15], [length / 2, 45], [length, 18]]
    log = draw.log("log", document, protocol, draw.draw_rate((25, 50), None))
    draw.tried(["thermal", str(log), *draw.reading.options, *local])


def check(draw: Draw) -> None:
    unit = draw.by_hand()
    calibration = unit.calibrated()
    if draw.chance("changed", 0.3):
        unit.document["seed"] += 1
        draw.plain = False
    if "gyroscope" in unit.without:  # of which a check says that it needs one
        draw.plain = False
    new = unit.another("new", 1)
    line = ["check", str(calibration), str(new), *unit.options]
    if draw.chance("static", 0.3):
        line += ["--static", str(unit.at_rest())]
    draw.tried(line)


def check_in_use(draw: Draw) -> None:
    unit = draw.by_hand("both", hidden=0.1)
    calibration = unit.calibrated()
    motion = {"kind": "hand-held", "poses": 3, "pose_duration": 2.0, "turn_duration": 4.0, "initial_rest": 4.0}
    draw.plain = False
    new = draw.log("new", unit.document, motion, unit.rate, 1, unit.without)
    draw.tried(["check", str(calibration), str(new), *unit.options])


def check_extended(draw: Draw) -> None:
    unit = draw.by_hand(hidden=0.9)
    extended = draw.prepared(["diagnose", str(unit.log), *unit.options], "first") / "calibration.json"
    draw.tried(["check", str(extended), str(unit.another("new", 1)), *unit.options])


def check_thermal(draw: Draw) -> None:
    log, calibration = thermal_of(draw)
    draw.tried(["check", str(calibration), str(log), *draw.reading.options])


def compensate(draw: Draw) -> None:
    unit = draw.by_hand()
    calibration = unit.calibrated()
    file = draw.pick("into", ["out.csv", "out.parquet", "out.npz", "out.mat", "out.mcap", "bag"], [3, 3, 1, 1, 1, 1])
    log = unit.another("new", 1) if draw.chance("new log", 0.5) else unit.log
    draw.tried(["compensate", str(calibration), str(log), *draw.reading.options], file, True)


def compensate_thermal(draw: Draw) -> None:
    log, calibration = thermal_of(draw)
    draw.tried(["compensate", str(calibration), str(log), *draw.reading.options], "out.parquet", True)


def allan(draw: Draw) -> None:
    draw.draw_reading(True)
    document = draw.draw_unit(hidden=0.0)
    if draw.chance("flicker", 0.5):
        document["gyroscope"]["noise"] |= {"bias_instability": "10 deg/h", "bias_instability_is": "B"}
    protocol = {"kind": "static", "duration": 60.0 * draw.pick("minutes", [2, 5, 15])}
    rate = draw.draw_rate((12.5, 25, 50, 100), None)
    logs = [
        str(draw.log(f"log{number}", document, protocol, rate, number)) for number in range(draw.pick("logs", [1, 3]))
    ]
    draw.tried(["allan", *logs, *draw.reading.options])


def effects(draw: Draw) -> None:
    name = draw.pick("effect", [None, *CATALOGUE])
    draw.tried(["effects", *([name] if name else [])])


def toml(table: dict[str, Any], head: str = "") -> str:
    """A nested table as TOML."""
    lines, tables = [], []
    for key, value in table.items():
        quoted = json.dumps(key) if "." in key else key
        if isinstance(value, dict) and not set(value) <= {"low", "high", "white", "density"}:
            name = f"{head}.{quoted}" if head else quoted
            tables.append(f"[{name}]\n{toml(value, name)}")
        elif isinstance(value, dict):
            lines.append(f"{quoted} = {{ {', '.join(f'{k} = {json.dumps(v)}' for k, v in value.items())} }}")
        else:
            lines.append(f"{quoted} = {json.dumps(value)}")
    return "\n".join([*lines, *tables]) + "\n"


def specification(draw: Draw, protocol: dict[str, Any], rate: float, **more: Any) -> Path:
    """Write a specification of a drawn unit."""
    path = draw.folder / "unit.toml"
    path.write_text(toml({"rate": rate, **draw.draw_unit(**more), "protocol": protocol}), encoding="utf-8")
    return path


def simulate(draw: Draw) -> None:
    protocol = draw.pick(
        "protocol",
        [
            {"kind": "static", "duration": 20.0},
            {"kind": "positions", "count": 6, "duration": 2.0},
            {"kind": "hand-held", "poses": 8},
            {"kind": "rate-table", "rates": [90.0]},
            {"kind": "ferraris", "duration": 2.0},
            {"kind": "dividing-head", "duration": 2.0},
            {"kind": "single-axis-table", "duration": 2.0},
            {"kind": "rotations", "duration": 2.0},
            {"kind": "vibration", "duration": 5.0},
            {"kind": "soak-and-ramp", "rates": [200.0], "soak_duration": 30.0},
        ],
    )
    path = specification(draw, protocol, draw.draw_rate((12.5, 50, 100), None), hidden=0.5)
    if draw.chance("units", 0.3):
        path.write_text("units = 2\nrecordings = 2\n" + path.read_text())
    file = draw.pick("into", ["log.csv", "log.parquet", "log.npz", "log.mat", "log.tsv", "log.txt"])
    draw.tried(["simulate", str(path)], file, True)


TABLES = {
    "rate-table": {"rates": [60.0, 120.0], "revolutions": 0.5, "rest_duration": 2.5, "ramp_duration": 0.5},
    "positions": {"count": 12, "duration": 3.0, "turn_duration": 2.0},
    "dividing-head": {"duration": 4.0},
    "single-axis-table": {"duration": 4.0, "rate": 60.0},
    "ferraris": {"duration": 3.0, "turn_duration": 4.0},
    "rotations": {"duration": 4.0, "turn_duration": 5.0},
}


def on_table(draw: Draw, reference: str | None = None) -> tuple[Path, list[str]]:
    """Record a unit on a table; return the log and how its reference and gravity are stated."""
    draw.draw_reading()
    document = draw.draw_unit(hidden=0.2)
    local = draw.draw_gravity(document) if draw.chance("place", 0.5) else []
    place = document.setdefault("environment", {})
    place.setdefault("gravity", GRAVITY)
    kind = draw.pick("protocol", list(TABLES))
    recording, truth = draw.simulate(document, {"kind": kind, **TABLES[kind]}, draw.draw_rate((25, 50, 100, 200), None))
    columns = (
        recording.attitude is not None and (reference or draw.pick("reference", ["schedule", "columns"])) == "columns"
    )
    columns &= draw.reading.suffix != ".ulg"
    if columns:
        return draw.write("log", recording, truth), local
    log = draw.write("log", recording, truth, ["attitude", "table_rate", "table_angle"])
    schedule = draw.folder / "schedule.csv"
    truth.save_schedule(schedule)
    return log, ["--reference", str(schedule), *local]


def turntable(draw: Draw) -> None:
    log, stated = on_table(draw)
    draw.plain &= draw.settings["protocol"] in ("positions", "rate-table", "rotations", "single-axis-table")
    line = ["turntable", str(log), *draw.reading.options, *stated]
    if draw.chance("tilt fitted", 0.2):
        line += ["--fit", "setup.table_tilt"]
    draw.tried(line)


def turntable_gyroscope(draw: Draw) -> None:
    draw.reading = Reading(draw.pick("format", [".csv", ".parquet"]), rate=draw.pick("rate of turn", list(RATE)))
    document = draw.draw_unit(hidden=0.0)
    protocol = {"kind": "rate-table", **TABLES["rate-table"]}
    recording, truth = draw.simulate(document, protocol, draw.draw_rate((25, 50, 100), None))
    nothing = Signal(np.empty(0), np.empty((0, 3)), "m/s^2")
    gains = {"gyroscope": np.asarray(truth.imu.gyroscope.gain)}
    alone = replace(recording, accelerometer=nothing, attitude=None, table_rate=None)
    log = draw.reading.write(alone, draw.folder, "log")
    draw.keep_truth(gains)
    truth.save_schedule(draw.folder / "schedule.csv")
    draw.tried(["turntable", str(log), "--reference", str(draw.folder / "schedule.csv")])


def diagnose_reference(draw: Draw) -> None:
    log, stated = on_table(draw)
    if "--reference" not in stated:
        stated = ["--reference", str(log), *stated]
    draw.plain &= draw.settings["protocol"] in ("positions", "rate-table", "rotations", "single-axis-table")
    draw.tried(["diagnose", str(log), *draw.reading.options, *stated])


def tracked(draw: Draw) -> tuple[Path, Path]:
    """Move a unit and track it; return the log and the tracker's."""
    draw.draw_reading(True)
    rate = draw.draw_rate((50, 100, 125, 200), None)
    made = attitude_motion.move(
        draw.seed, float(draw.pick("seconds", [40, 60])), rate, float(draw.pick("tracked", [25, 50, 100]))
    )
    recording = Recording(Signal(made.time, made.force, "m/s^2"), Signal(made.time, made.rate, "rad/s"))
    log = draw.write("log", recording)
    draw.keep_truth({"accelerometer": made.truth["gain_a"], "gyroscope": made.truth["gain_g"]})
    columns = {"time [s]": made.stamp} | {f"q{part}": made.quaternion[:, at] for at, part in enumerate("wxyz")}
    if draw.chance("velocity", 0.5):
        columns |= {f"v{axis} [m/s]": made.velocity[:, at] for at, axis in enumerate("xyz")}
    pa.csv.write_csv(pa.table({k: np.ascontiguousarray(v) for k, v in columns.items()}), draw.folder / "tracker.csv")
    return log, draw.folder / "tracker.csv"


def reference(draw: Draw) -> None:
    log, tracker = tracked(draw)
    draw.tried(
        [
            "reference",
            str(log),
            "--reference",
            str(tracker),
            "--gravity",
            f"{attitude_motion.GRAVITY}+-0.001",
            *draw.reading.options,
        ]
    )


def diagnose_attitude(draw: Draw) -> None:
    log, tracker = tracked(draw)
    draw.tried(
        [
            "diagnose",
            str(log),
            "--reference",
            str(tracker),
            "--gravity",
            f"{attitude_motion.GRAVITY}+-0.001",
            *draw.reading.options,
        ]
    )


def array(draw: Draw) -> None:
    draw.draw_reading(True)
    rate = draw.draw_rate((50, 100), None)
    units = array_motion.array(draw.seed, draw.pick("units", [2, 3, 4]), draw.pick("poses", [12, 16]), rate=rate)
    logs = []
    for number, unit in enumerate(units, 1):
        recording = Recording(Signal(unit.time, unit.force, "m/s^2"), Signal(unit.time, unit.rate, "rad/s"))
        logs.append(str(draw.write(f"unit{number}", recording)))
    first = units[0].gains
    draw.keep_truth({"accelerometer": first[0], "gyroscope": first[1]}, "calibration_1.json")
    draw.tried(["array", *logs, "--gravity", f"{array_motion.GRAVITY}+-0.001", *draw.reading.options])


ROTATIONS = {
    "of nineteen positions": "y90 y90 y90 y-90 y-90 y-90 z90 x90 x90 x90 x-90 x-90 x-90 z90 z90 z-90 z-90 z-90",
    "of twelve positions": "y90 y90 x90 x90 z90 z90 y-90 x-90 z-90 y180 x180",
}


def systematic(draw: Draw, attitude: bool = False) -> tuple[Path, list[str]]:
    """Record a good unit through positions and rotations; return the log and how gravity is stated.

    attitude: it stands in the log, too.
    """
    draw.draw_reading(not attitude)
    if attitude and draw.reading.suffix == ".ulg":
        draw.reading = Reading()
    document = draw.draw_unit(hidden=0.2)
    for name in ("accelerometer", "gyroscope"):
        document[name]["noise"]["white"] *= 0.1
        document[name]["bias"] = {part: 0.1 * value for part, value in document[name]["bias"].items()}
        document[name]["scale"] = document[name]["misalignment"] = {"low": -0.003, "high": 0.003}
    local = draw.draw_gravity(document)
    rotations = draw.pick("rotations", list(ROTATIONS))
    protocol = {"kind": "rotations", "rotations": ROTATIONS[rotations], "duration": 5.0, "turn_duration": 4.0}
    return draw.log("log", document, protocol, draw.draw_rate((25, 50), None)), local


def filtered(draw: Draw) -> None:
    log, local = systematic(draw)
    line = ["filter", str(log), *draw.reading.options, *local]
    effect = draw.pick("effect", [None, "accel.size_effect", "setup.time_offset"], [3, 1, 1])
    # no drawn gyroscope feels the Earth turn, and then these leave its scales open: the filter says so and refuses
    draw.plain &= effect is None and draw.settings["rotations"] != "of nineteen positions"
    draw.tried([*line, *(["--effect", effect] if effect else [])])


def filter_reference(draw: Draw) -> None:
    draw.plain = False
    if draw.chance("table", 0.6):
        log, local = systematic(draw, attitude=True)
        reference = log
    else:  # a unit that never rests: refused
        log, reference = tracked(draw)
        local = ["--gravity", f"{attitude_motion.GRAVITY}+-0.001"]
    draw.tried(["filter", str(log), "--reference", str(reference), *local, *draw.reading.options])


def filter_online(draw: Draw) -> None:
    unit = draw.by_hand("both", hidden=0.2)
    calibration = unit.calibrated()
    new = unit.another("new", 1)
    draw.truths = {}
    draw.tried(["filter", str(new), "--online", str(calibration), *unit.options])


def magnetic(draw: Draw, name: str = "log", seed: int | None = None) -> tuple[Path, magnetic_motion.Turned]:
    """Record a unit that is turned about in a magnetic field."""
    made = magnetic_motion.turned(
        draw.seed if seed is None else seed,
        draw.settings["seconds"],
        disturbed=(20.0, 25.0) if draw.settings["disturbed"] else None,
    )
    whole = made.recording
    force, rate, field_at = whole.accelerometer, whole.gyroscope, made.magnetometer
    kept = slice(None, None, 4)  # the magnetometer's rate
    even = Recording(
        replace(force, time=force.time[kept], values=force.values[kept]),
        replace(rate, time=force.time[kept], values=rate.values.reshape(-1, 4, 3).mean(axis=1)),
        magnetometer=replace(field_at, time=force.time[kept]),
    )
    return draw.write(name, even), made


def magnetometer(draw: Draw) -> None:
    draw.draw_reading(counts=False)
    if draw.reading.suffix == ".ulg":
        draw.reading = Reading()
    draw.pick("seconds", [40.0, 60.0, 90.0])
    draw.pick("disturbed", [False, True], [4, 1])
    draw.plain = False  # its alignment is another's truth: only that it works is asked for
    log, _ = magnetic(draw)
    line = ["magnetometer", str(log), *draw.reading.options]
    line += draw.pick(
        "field",
        [
            [],
            ["--field", "48+-0.2"],
            ["--effect", "mag.lag"],
            ["--latitude", "52.5", "--longitude", "13.4", "--date", "2026-03-04"],
        ],
    )
    if draw.chance("check", 0.3):
        first = draw.prepared(line, "first") / "calibration.json"
        new, _ = magnetic(draw, "new")
        line = ["magnetometer", str(new), *draw.reading.options, "--check", str(first)]
    draw.tried(line)


def magnetometer_of_rests(draw: Draw) -> None:
    draw.plain = False
    unit = draw.by_hand("magnetometer", hidden=0.1)
    if unit.draw.reading.suffix == ".ulg":
        draw.reading = Reading()
        unit.log = unit.another("log", 0)
    line = ["magnetometer", str(unit.log), *unit.options]
    if draw.chance("calibration", 0.4):
        line += ["--calibration", str(unit.calibrated())]
    draw.tried(line)


def plan(draw: Draw) -> None:
    source = draw.pick("plan of", ["calibration", "log", "specification", "thermal"], [4, 2, 3, 1])
    if source == "specification":
        protocol = {"kind": "hand-held", "poses": 12, "pose_duration": 2.0}
        line = ["plan", str(specification(draw, protocol, 50.0, hidden=0.0))]
    elif source == "thermal":
        line = ["plan", str(thermal_of(draw)[1])]
    else:
        unit = draw.by_hand()
        line = ["plan", str(unit.calibrated())] if source == "calibration" else ["plan", str(unit.log), *unit.options]
    equipment = draw.pick("equipment", ["hands", "table", "dividing-head", "robot"], [4, 1, 1, 1])
    line += ["--equipment", equipment] if equipment != "hands" else []
    line += draw.pick("plan with", [[], ["--poses", "6"], ["--criterion", "A"]], [4, 1, 1])
    draw.tried(line)


def budget(draw: Draw) -> None:
    kind = draw.pick("protocol", ["dividing-head", "positions", "rate-table", "single-axis-table"])
    errors = {
        "tilt": "0.02 deg",
        "angle_setting": "0.01 deg",
        "gravity": "1e-4 m/s^2",
        "timing": "5 ms",
        "mounting": "0.05 deg",
    }
    kept = {name: value for name, value in errors.items() if draw.random.random() < 0.7}
    draw.settings["errors"] = list(kept)
    document = draw.draw_unit(hidden=0.0)
    table = {
        "rate": draw.draw_rate((25, 50, 100), None),
        **document,
        "protocol": {"kind": kind, **TABLES[kind]},
        "errors": kept,
        "goal": {"accelerometer.bias": "0.2 mg"},
    }
    path = draw.folder / "setup.toml"
    path.write_text(toml(table), encoding="utf-8")
    line = ["budget", str(path)]
    if draw.chance("check", 0.1):
        line += ["--check", "50"]
    draw.tried(line)


def fleet_logs(draw: Draw) -> tuple[ByHand, list[str]]:
    """Record several units; return the first and what `fleet` is given."""
    unit = draw.by_hand(
        draw.pick("sensors", ["both", "accelerometer", "magnetometer"], [4, 1, 1]), hidden=0.15, most=12
    )
    unit.document.pop("artefacts", None)
    draw.truths = {}
    count = draw.pick("units", [2, 4, 6])
    folder = draw.folder / "logs"
    folder.mkdir()
    for number in range(count):
        path = unit.another(f"unit{number}", 0, number)
        path.rename(folder / path.name)
    if draw.chance("a bad file", 0.2):
        (folder / f"bad{draw.reading.suffix}").write_bytes(b"time,accel\n1,2\n")
        draw.plain = False
    draw.truths = {}
    given = [str(folder)]
    if draw.chance("manifest", 0.3):
        manifest = draw.folder / "manifest.csv"
        with manifest.open("w", newline="") as file:
            rows = csv.writer(file)
            rows.writerow(["device", "file", "date", "lot"])
            for number, path in enumerate(sorted(folder.iterdir())):
                rows.writerow([path.stem, str(path), f"2026-03-{number + 1:02d}", "AB"[number % 2]])
        given = [str(manifest)]
    return unit, given


def fleet(draw: Draw) -> None:
    unit, given = fleet_logs(draw)
    line = ["fleet", *given, *unit.options, "--workers", "1"]
    if draw.chance("static", 0.2):
        line += ["--static", str(unit.at_rest(2.0))]
        draw.truths = {}
    if draw.chance("limits", 0.2):
        line += ["--limits", str(limits(draw, draw.settings["sensors"] != "accelerometer"))]
    draw.tried(line, only_with_output=True)


def fleet_diagnose(draw: Draw) -> None:
    unit, given = fleet_logs(draw)
    draw.tried(["fleet", *given, *unit.options, "--workers", "1", "--diagnose"], only_with_output=True)


def limits(draw: Draw, gyroscope: bool = True) -> Path:
    """Write limits, and what else decides."""
    path = draw.folder / "limits.toml"
    rule = draw.pick("rule", ["guarded", "simple"])
    path.write_text(f'rule = "{rule}"\n{LIMITS}{GYROSCOPE_LIMITS if gyroscope else ""}', encoding="utf-8")
    return path


def accept(draw: Draw) -> None:
    unit = draw.by_hand()
    calibration = unit.calibrated()
    line = ["accept", str(calibration), "--limits", str(limits(draw, draw.settings["sensors"] != "accelerometer"))]
    if draw.chance("noise", 0.2):
        first = draw.prepared(["allan", str(unit.at_rest(5.0, 25.0)), *draw.reading.options], "noise")
        line += ["--noise", str(first / "allan.json")]
    if draw.chance("trace", 0.7):
        (draw.folder / "trace.toml").write_text(TRACE, encoding="utf-8")
        line += ["--trace", str(draw.folder / "trace.toml")]
    else:
        line += ["--without-certificate"]
    if draw.chance("measurements", 0.3):
        line += ["--measurements", str(draw.folder / draw.pick("into", ["m.csv", "m.xml", "m.json"]))]
    draw.tried(line)


def accept_fleet(draw: Draw) -> None:
    unit, given = fleet_logs(draw)
    table = draw.prepared(["fleet", *given, *unit.options, "--workers", "1"], "fleet") / "table.parquet"
    if draw.chance("limits of the table", 0.3):
        draw.plain = False
        line = ["accept", str(unit.calibrated()), "--limits", str(table), "--without-certificate"]
    else:
        line = ["accept", str(table), "--limits", str(limits(draw, draw.settings["sensors"] != "accelerometer"))]
    draw.tried(line)


def verify(draw: Draw) -> None:
    unit = draw.by_hand()
    calibration = unit.calibrated()
    if draw.chance("changed", 0.3):
        calibration.write_text(calibration.read_text().replace('"rank": ', '"rank": 1'))
    draw.tried(["verify", str(calibration)])


def export(draw: Draw) -> None:
    unit = draw.by_hand()
    calibration = unit.calibrated()
    export_of(draw, calibration, unit.draw.reading.axes)


def export_of(draw: Draw, calibration: Path, axes: str | None) -> None:
    """Write a calibration for a tool; units in counts, or without a sensor, are refused by some."""
    draw.plain = False
    line = ["export", str(calibration), "--to", draw.pick("to", list(WRITERS))]
    line += ["--axes", axes] if axes else []
    draw.tried(line, f"exported{draw.random.integers(10)}")


def export_thermal(draw: Draw) -> None:
    _, calibration = thermal_of(draw)
    export_of(draw, calibration, draw.reading.axes)


def export_extended(draw: Draw) -> None:
    unit = draw.by_hand("both", hidden=0.9)
    extended = draw.prepared(["diagnose", str(unit.log), *unit.options], "first") / "calibration.json"
    export_of(draw, extended, draw.reading.axes)


def consequences(draw: Draw) -> None:
    unit = draw.by_hand("both")
    calibration = unit.calibrated()
    line = ["consequences", str(calibration), "--duration", str(draw.pick("seconds", [20, 60]))]
    if draw.chance("noise", 0.5):
        noise = draw.prepared(["allan", str(unit.at_rest(5.0, 25.0)), *draw.reading.options], "noise")
        line += ["--noise", str(noise / "allan.json")]
    more = draw.pick("along", ["driving", "log", "specification", "against", "estimators"])
    if more in ("log", "estimators"):
        line += ["--path", str(unit.another("path", 1)), *draw.reading.options]
    if more == "estimators":
        draw.plain = False  # few minutes at rest do not show the random walk, which most of them need
        line += ["--noise-for", draw.pick("for", ["vins,gtsam", "px4", "kalibr,openvins", "ardupilot,lio-sam"])]
    if more == "specification":
        path = draw.folder / "path.toml"
        path.write_text('rate = 50\n[protocol]\nkind = "hand-held"\nposes = 8\n')
        line += ["--path", str(path)]
    if more == "against":
        second = draw.prepared(["calibrate", str(unit.another("other", 1)), *unit.options], "second")
        line += ["--against", str(second / "calibration.json")]
    line += ["--draws", draw.pick("draws", ["0", "20"])]
    draw.truths = {}
    draw.tried(line)


def record(draw: Draw) -> None:
    unit = draw.by_hand(draw.pick("sensors", ["both"]))
    draw.reading = replace(draw.reading, suffix=".csv", named=True)
    log = unit.another("log", 0)
    draw.plain = False
    line = ["record", "--from", str(log), "--rest", "1.5", *unit.options]
    draw.tried(line, only_with_output=True)


def demo(draw: Draw) -> None:
    draw.tried(["demo", "--seed", str(draw.seed % 1000)], only_with_output=True)


RECIPES: dict[Recipe, float] = {
    info: 2,
    calibrate: 4,
    calibrate_means: 2,
    diagnose: 2,
    diagnose_thermal: 1,
    diagnose_reference: 1,
    diagnose_attitude: 0.5,
    thermal: 2,
    thermal_calibration: 2,
    thermal_by_hand: 0.5,
    check: 3,
    check_in_use: 1,
    check_extended: 1.5,
    check_thermal: 1,
    compensate: 3,
    compensate_thermal: 1,
    allan: 2,
    effects: 0.5,
    simulate: 2,
    turntable: 3,
    turntable_gyroscope: 1,
    reference: 1,
    array: 1.5,
    filtered: 1,
    filter_reference: 0.5,
    filter_online: 1.5,
    magnetometer: 2,
    magnetometer_of_rests: 1,
    plan: 1.5,
    budget: 1.5,
    fleet: 2,
    fleet_diagnose: 0.5,
    accept: 2,
    accept_fleet: 1.5,
    verify: 1,
    export: 3,
    export_thermal: 1,
    export_extended: 1,
    consequences: 2,
    record: 1,
    demo: 0.1,
}
"""Every verb and chain, and how often it is drawn beside the others."""


def _first(seed: int) -> tuple[Recipe, np.random.Generator]:
    """The verb or chain that a seed draws, and the generator that draws all else."""
    random, shares = np.random.default_rng([seed, 48]), np.array(list(RECIPES.values()))
    return list(RECIPES)[int(random.choice(len(RECIPES), p=shares / shares.sum()))], random


def recipe_of(seed: int) -> Recipe:
    """Return the verb or chain that a seed draws."""
    return _first(seed)[0]


def run_draw(seed: int, folder: Path, recipe: Recipe | None = None, short: bool = False) -> Draw:
    """Run the draw of a seed, or of a recipe with a seed, in a folder, which is emptied first.

    short: on logs as short as the suite takes them.
    """
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    chosen, random = _first(seed)
    draw, recipe = Draw(seed, folder, random, short=short), recipe or chosen
    draw.settings["recipe"] = recipe.__name__
    began = time.perf_counter(), time.process_time()
    try:
        recipe(draw)
    except Ended:
        draw.settings["ended"] = True
    draw.seconds |= {"all": time.perf_counter() - began[0], "processor": time.process_time() - began[1]}
    few_memory_maps()
    return draw


def prepare_process() -> None:
    """Get a process ready: float64, and one folder of compiled code for all processes."""
    jax.config.update("jax_enable_x64", True)
    folder = Path(os.environ["XDG_CACHE_HOME"]) / "jaximu"
    folder.mkdir(mode=0o700, exist_ok=True)
    stored.cache(folder)


def main() -> None:
    """Run the draws of the seeds that are named, or of a recipe that is named after a seed."""
    prepare_process()
    recipes = {recipe.__name__: recipe for recipe in RECIPES}
    named = [recipes[text] for text in sys.argv[1:] if text in recipes]
    kept = Path(tempfile.mkdtemp(prefix="random-unit-"))
    failed = False
    for text in sys.argv[1:]:
        if text in recipes or text == "--short":
            continue
        draw = run_draw(int(text), kept / "draw", named[0] if named else None, "--short" in sys.argv)
        print(draw.line, f"[{draw.seconds['processor']:.1f} s]", [status for _, status in draw.statuses])
        for failure in draw.failures:
            failed = True
            print(f"  {failure.kind}: {failure.run}: {failure.text}")
        if draw.failures and draw.last:
            print("  jaximu", " ".join(draw.last))
    print(f"Its files: {kept}")
    raise SystemExit(failed)


if __name__ == "__main__":
    main()
