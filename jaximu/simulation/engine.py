"""From a protocol, a unit, its noise and a seed to a recording and its truth, block by block."""

from __future__ import annotations

import zlib
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import cached_property, partial
from pathlib import Path
from typing import Any

import jax
import numpy as np

from jaximu.ground import stored
from jaximu.ground.array_types import FloatArray, IntArray
from jaximu.ground.atomic import atomic_write
from jaximu.ground.document import SOFTWARE, Document, Json, entries
from jaximu.ground.errors import FilePath, InputError
from jaximu.ground.precision import require_float64
from jaximu.ground.rotation import rotate
from jaximu.ground.tracing import is_traced, part_of
from jaximu.ground.units import SENSOR_UNITS
from jaximu.model import Noise
from jaximu.model.effects import Effect
from jaximu.model.sensor import Imu, Triad
from jaximu.model.state_space import BLOCK
from jaximu.model.stimulus import Stimulus
from jaximu.recordings import write_recording
from jaximu.recordings.entry import ScheduleEntry, times_of
from jaximu.recordings.recording import Recording, Signal
from jaximu.recordings.write import write_parts
from jaximu.simulation.artefacts import ARTEFACTS, Artefact, LoggedRows
from jaximu.simulation.protocols import Environment, Motion, Plan, Protocol, block_length

TRUTH_SCHEMA = "jaximu.truth/1"


@dataclass(frozen=True)
class Case:
    """One recording to be simulated, everything drawn: the same case gives the same recording, bit for bit.

    noise: by triad, in SI (a field: µT). rate: Hz. seed: any integers. power_on: the number of this
    recording among those of the same unit; what belongs to the unit does not depend on it.
    """

    imu: Imu
    plan: Plan
    noise: Mapping[str, Noise]
    rate: float
    seed: tuple[int, ...]
    power_on: int = 0
    artefacts: tuple[Artefact, ...] = ()
    protocol: Protocol | None = None

    @classmethod
    def of(
        cls,
        imu: Imu,
        protocol: Protocol,
        noise: Mapping[str, Noise] | None = None,
        rate: float = 100.0,
        seed: int | Sequence[int] = 0,
        power_on: int = 0,
        environment: Environment | None = None,
        artefacts: Sequence[Artefact] = (),
    ) -> Case:
        """Make out the protocol and check what goes with it. Arguments as for `simulate`."""
        require_float64()
        if is_traced(imu):
            raise InputError(
                "a unit that is traced cannot be simulated, which draws noise and cuts logs on the host: what it puts "
                "out along a path is jaximu.Imu.respond."
            )
        seeds = tuple(seed) if isinstance(seed, Sequence) else (seed,)
        plan = protocol.plan(_generator(seeds, "motion", power_on), environment)
        noise = dict(noise or {})
        quantities = {name: triad.quantity for name, triad in imu.triads().items()}
        for name, random in noise.items():
            if quantities.get(name) != random.quantity:
                raise InputError(f"noise of {name!r} is given for {random.quantity}.")
        if plan.motion.samples(rate) < 2:
            raise InputError(f"the protocol lasts {plan.motion.length:g} s: less than two samples at {rate:g} Hz.")
        order = list(ARTEFACTS.values())
        artefacts = tuple(sorted(artefacts, key=lambda artefact: order.index(type(artefact))))
        return cls(imu, plan, noise, float(rate), seeds, power_on, artefacts, protocol)

    @property
    def samples(self) -> int:
        """Number of samples before artefacts."""
        return self.plan.motion.samples(self.rate)


@dataclass(frozen=True, eq=False)
class Truth(Document):
    """What a simulated recording was made from, and what its artefacts did (`notes`)."""

    case: Case
    notes: tuple[str, ...] = ()

    @cached_property
    def stimulus(self) -> Stimulus:
        """What the set-up says the sensors went through, at every sample before artefacts."""
        return self.case.plan.motion.stimulus(self.case.rate)

    @property
    def imu(self) -> Imu:
        """The true unit."""
        return self.case.imu

    @property
    def schedule(self) -> list[ScheduleEntry]:
        """Rests and turns, on the recording's clock."""
        half = 0.5 / self.case.rate
        return [
            replace(interval, start=interval.start - half, stop=interval.stop - half)
            for interval in self.case.plan.intervals
        ]

    @property
    def intervals(self) -> FloatArray:
        """(P, 2) start and stop of each rest (s, on the recording's clock), at the edges of samples."""
        return times_of([interval for interval in self.schedule if interval.kind == "pose"])

    def document(self) -> Json:
        """Return the truth as the JSON document of schema `jaximu.truth/1`."""
        case, motion = self.case, self.case.plan.motion

        def documents(effects: Iterable[Effect], output_unit: str = "") -> Json:
            return {effect.name: effect.document(output_unit) for effect in effects}

        triads = {
            name: {
                **entries(triad, "output_unit", "gain", "bias", "temperature_reference", "time_reference"),
                "effects": documents(triad.effects, triad.output_unit),
                "noise": [
                    {"process": type(process).__name__}
                    | {parameter: np.asarray(value).tolist() for parameter, value in asdict(process).items()}
                    for process in case.noise.get(name, Noise()).processes
                ],
            }
            for name, triad in case.imu.triads().items()
        }
        return {
            "schema": TRUTH_SCHEMA,
            **triads,
            "setup": {"effects": documents(case.imu.setup)},
            "protocol": {"kind": case.protocol.kind, **asdict(case.protocol)} if case.protocol else None,
            "gravity": float(motion.gravity),
            "earth_rotation": np.asarray(motion.earth).tolist(),
            "magnetic_field": np.asarray(motion.field).tolist(),
            "schedule": [
                {
                    **entries(entry, "start", "stop", "kind", "vector", "angle"),
                    "heading": entry.heading or 0.0,
                }
                for entry in self.schedule
            ],
            "artefacts": [
                {"name": artefact.name} | {k: None if v == np.inf else v for k, v in asdict(artefact).items()}
                for artefact in case.artefacts
            ],
            **entries(case, "rate", "samples", "seed", "power_on"),
            "notes": list(self.notes),
            "software": SOFTWARE,
        }

    def save_schedule(self, path: FilePath) -> None:
        """Write rests and turns as a turntable schedule (CSV, angles in degrees), as `--reference` reads it."""
        lines = ["start [s],stop [s],kind,x,y,z,angle [deg],heading [deg]"]
        for interval in self.schedule:
            x, y, z = interval.vector
            angle, heading = np.degrees(interval.angle), np.degrees(interval.heading or 0.0)
            extra = f"{angle:.12g}," if interval.kind == "turn" else f",{heading:.12g}"
            times = f"{interval.start:.9g},{interval.stop:.9g}"
            lines.append(f"{times},{interval.kind},{x:.12g},{y:.12g},{z:.12g},{extra}")
        with atomic_write(path) as temporary:
            temporary.write_text("\n".join(lines) + "\n", encoding="utf-8")


def _generator(seed: Sequence[int], purpose: str, power_on: int) -> np.random.Generator:
    return np.random.default_rng([*seed, zlib.crc32(purpose.encode()), power_on])


def _respond_batch(length: int, halo: int, columns: tuple[str, ...], imus, motions, memory, first, rate):
    """Of units stacked along a leading axis: outputs of one block, the columns beside them, what effects remember."""

    def one(imu: Imu, motion: Motion, memory):
        inside = slice(halo, halo + length)
        whole = motion.block(first - halo, rate, length + 2 * halo)
        values, kept = {}, {}
        for name, triad in imu.triads().items():
            felt = replace(part_of(imu.acted(whole, triad.quantity), inside), memory=memory)
            values[name] = triad.respond(felt)
            kept |= triad.memory(felt)
        intended = part_of(whole, inside)
        beside = {
            "temperature": intended.temperature[:, None],
            "current": intended.current[:, None],
            "ambient_temperature": motion.ambient_at(intended.time + 0.5 / rate)[:, None],
            "attitude": intended.attitude,
            "table_rate": rotate(intended.attitude, intended.angular_rate)[:, 2:] - motion.earth[2],
        }  # what is not logged is not compiled
        return values | {name: beside[name] for name in columns}, kept

    return jax.vmap(one)(imus, motions, memory)


def _stack(trees: Sequence[Any]) -> Any:
    """Stack the numbers of like trees along a new leading axis."""
    return jax.tree.map(lambda *leaves: np.stack([np.asarray(leaf, float) for leaf in leaves]), *trees)


def _alike(cases: Sequence[Case]) -> None:
    def shape(case: Case):
        numbers = (case.imu, case.plan.motion)
        sizes = [np.shape(leaf) for leaf in jax.tree.leaves(numbers)]
        return jax.tree.structure(numbers), sizes, case.plan.columns, case.samples, case.rate

    if any(shape(case) != shape(cases[0]) for case in cases[1:]):
        raise ValueError("cases that are simulated together must share effects, protocol, duration and rate")


class Stream:
    """Like cases simulated together, block by block: iterate for a list of samples, one each case.

    Memory is bounded by the block, whatever the duration. Cases must share effects, protocol, duration and rate.
    `block`, a multiple of 64, is the number of samples at once; samples do not depend on it beyond rounding. `notes`
    holds for each case, once iterated, what its artefacts did.
    """

    def __init__(self, cases: Sequence[Case], block: int | None = None):
        _alike(cases)
        self.cases = list(cases)
        self.samples, self.rate = cases[0].samples, cases[0].rate
        self.length = block or block_length(self.samples)
        self.notes: list[tuple[str, ...]] = [() for _ in cases]
        margins = [effect.reach(self.samples / self.rate) for case in cases for effect in case.imu.setup]
        self._halo = -(-(round(max(margins) * self.rate) + 3) // BLOCK) * BLOCK if margins else 0

    def __iter__(self) -> Iterator[list[LoggedRows]]:
        cases = self.cases
        imus, motions = _stack([case.imu for case in cases]), _stack([case.plan.motion.padded() for case in cases])
        loggers = [_Logger(case) for case in cases]
        memory: Any = {
            effect.name: np.full((len(cases), effect.memory), np.nan)
            for effect in cases[0].imu.all_effects().values()
            if effect.memory
        }
        once = len(cases) == 1 and self.samples <= self.length
        settings = self.length, self._halo, cases[0].plan.columns
        respond, description = partial(_respond_batch, *settings), f"respond {settings}"
        for first in range(0, self.samples, self.length):
            columns, memory = stored.call(
                respond, description, imus, motions, memory, float(first), self.rate, quick=once
            )
            rows = np.arange(first, min(first + self.length, self.samples))
            yield [
                logger.logged(rows, {name: column[unit] for name, column in columns.items()})
                for unit, logger in enumerate(loggers)
            ]
        self.notes = [logger.notes() for logger in loggers]


class _Logger:
    """What happens to the outputs of one case, block after block: noise and artefacts."""

    def __init__(self, case: Case):
        self.case, triads = case, case.imu.triads()
        self.noise = {
            name: (_per_output(triad), case.noise[name].stream(case.rate, case.seed, case.power_on))
            for name, triad in triads.items()
            if name in case.noise
        }
        self.draws = [
            _generator(case.seed, f"{k}.{artefact.name}", case.power_on) for k, artefact in enumerate(case.artefacts)
        ]
        self.kept: list[Any] = [None] * len(case.artefacts)

    def logged(self, rows: IntArray, columns: Mapping[str, FloatArray]) -> LoggedRows:
        """Return what is logged in the rows of a block where these are the outputs."""
        values = {name: np.array(column)[: len(rows)] for name, column in columns.items()}
        for name, (scale, stream) in self.noise.items():
            values[name] += scale * stream.take(len(columns[name]))[: len(rows)]
        samples = LoggedRows(rows, rows / self.case.rate, values)
        for k, artefact in enumerate(self.case.artefacts):
            self.kept[k] = artefact.apply(samples, self.draws[k], self.kept[k])
        return samples

    def notes(self) -> tuple[str, ...]:
        """Return what the artefacts did."""
        reports = (artefact.report(kept) for artefact, kept in zip(self.case.artefacts, self.kept, strict=True))
        return tuple(filter(None, reports))


def _per_output(triad: Triad) -> FloatArray | float:
    """Noise is in SI: per axis, the output units of one SI unit."""
    return triad.scales if triad.output_unit == "count" else 1.0


_UNITS = {"temperature": "degC", "ambient_temperature": "degC", "current": "A", "attitude": "1", "table_rate": "rad/s"}


def _recording(case: Case, parts: Sequence[LoggedRows]) -> Recording:
    time = np.concatenate([part.time for part in parts])

    def signal(name: str) -> Signal | None:
        if name not in parts[0].values:
            return None
        triad = case.imu.triads().get(name)
        unit, scale = (_UNITS[name], 1.0) if triad is None else (triad.output_unit, _per_output(triad))
        values = np.concatenate([part.values[name] for part in parts])
        return Signal(time, values, unit, np.broadcast_to(scale, values.shape[1]))

    signals: dict[str, Any] = {name: signal(name) for name in (*SENSOR_UNITS, *_UNITS)}
    return Recording(**signals)


def simulate(
    imu: Imu,
    protocol: Protocol,
    noise: Mapping[str, Noise] | None = None,
    *,
    rate: float = 100.0,
    seed: int | Sequence[int] = 0,
    power_on: int = 0,
    environment: Environment | None = None,
    artefacts: Sequence[Artefact] = (),
) -> tuple[Recording, Truth]:
    """Simulate one recording of a unit going through a protocol.

    Sample k stands for the time from half an interval before its stamp to half after: its angular rate is the mean over
    that time, its specific force belongs to the stamp. The same arguments give the same recording, bit for bit.

    **Arguments:**

    - `imu`: the true unit: gain, bias, effects of its triads, effects of the set-up.
    - `protocol`: what is done with it, see `jaximu.simulation.protocols`.
    - `noise`: by triad ("accelerometer", "gyroscope", "magnetometer"), in SI, of a field in µT; a missing one is
      silent. For outputs in counts it is scaled by the axis's gain.
    - `rate`: Hz. `seed`: an integer or several. `power_on`: which recording of this unit; what belongs to the unit
      does not depend on it.
    - `environment`: gravity, Earth rotation, temperature, vibration. `artefacts`: what happens to the samples.

    **Returns** the recording and its truth. Raises `InputError` for what makes no sense.
    """
    case = Case.of(imu, protocol, noise, rate, seed, power_on, environment, artefacts)
    return simulate_cases([case])[0]


def simulate_cases(cases: Sequence[Case]) -> list[tuple[Recording, Truth]]:
    """Simulate like cases together, in memory."""
    source = Stream(cases)
    blocks = list(source)
    units = zip(cases, zip(*blocks, strict=True), source.notes, strict=True)
    return [(_recording(case, parts), Truth(case, notes)) for case, parts, notes in units]


def write_case(case: Case, path: FilePath) -> Truth:
    """Simulate a case into a file, by its suffix; Parquet in bounded memory, whole or not at all. Return the truth."""
    if Path(path).suffix.lower() == ".parquet":
        source = Stream([case])
        write_parts((_recording(case, block) for block in source if len(block[0].time)), path)
        return Truth(case, source.notes[0])
    recording, truth = simulate_cases([case])[0]
    write_recording(recording, path)
    return truth
