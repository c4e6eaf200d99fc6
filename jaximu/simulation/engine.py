"""From a protocol, a unit, its noise and a seed to a recording and its truth, block by block."""

from __future__ import annotations

import os
import zlib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import cached_property, partial
from pathlib import Path
from typing import Any

import jax
import numpy as np

from jaximu.ground import stored
from jaximu.ground.array_types import FloatArray
from jaximu.ground.atomic import atomic_write
from jaximu.ground.document import SOFTWARE, Document
from jaximu.ground.errors import InputError
from jaximu.ground.precision import require_float64
from jaximu.ground.rotation import rotate
from jaximu.ground.tracing import is_traced
from jaximu.model import Noise
from jaximu.model.sensor import Imu
from jaximu.model.stimulus import Stimulus
from jaximu.recordings import write_recording
from jaximu.recordings.recording import Recording, Signal
from jaximu.recordings.write import write_parts
from jaximu.simulation.artefacts import ARTEFACTS, Artefact, LoggedRows
from jaximu.simulation.protocols import Environment, Interval, Motion, Plan, Protocol, block_length

__all__ = ["Case", "Stream", "Truth", "simulate", "simulate_cases", "write_case"]

_HALO_STEP = 64
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
        if not (np.isfinite(rate) and rate > 0):
            raise InputError(f"the sample rate must be a positive number of Hz, found {rate}.")
        seeds = tuple(seed) if isinstance(seed, Sequence) else (seed,)
        plan = protocol.plan(_generator(seeds, "motion", power_on), environment)
        found = dict(noise or {})
        quantities = {name: triad.quantity for name, triad in imu.triads().items()}
        for name, each in found.items():
            if quantities.get(name) != each.quantity:
                raise InputError(f"noise of {name!r} is given for {each.quantity}.")
        if plan.motion.samples(rate) < 2:
            raise InputError(f"the protocol lasts {plan.motion.length:g} s: less than two samples at {rate:g} Hz.")
        order = list(ARTEFACTS.values())
        artefacts = tuple(sorted(artefacts, key=lambda artefact: order.index(type(artefact))))
        return cls(imu, plan, found, float(rate), seeds, power_on, artefacts, protocol)

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
    def schedule(self) -> list[Interval]:
        """Rests and turns, on the recording's clock."""
        half = 0.5 / self.case.rate
        return [replace(each, start=each.start - half, stop=each.stop - half) for each in self.case.plan.intervals]

    @property
    def intervals(self) -> FloatArray:
        """(P, 2) start and stop of each rest (s, on the recording's clock), at the edges of samples."""
        return np.array([(each.start, each.stop) for each in self.schedule if each.kind == "pose"]).reshape(-1, 2)

    def document(self) -> dict[str, Any]:
        """Return the truth as the JSON document of schema `jaximu.truth/1`."""
        case = self.case

        def effects(found, output_unit: str) -> dict[str, Any]:
            return {effect.name: effect.document(output_unit) for effect in found}

        triads = {
            name: {
                "output_unit": triad.output_unit,
                "gain": np.asarray(triad.gain).tolist(),
                "bias": np.asarray(triad.bias).tolist(),
                "temperature_reference": triad.temperature_reference,
                "time_reference": triad.time_reference,
                "effects": effects(triad.effects, triad.output_unit),
                "noise": [
                    {"process": type(process).__name__}
                    | {name: np.asarray(value).tolist() for name, value in asdict(process).items()}
                    for process in (case.noise[name].processes if name in case.noise else ())
                ],
            }
            for name, triad in case.imu.triads().items()
        }
        return {
            "schema": TRUTH_SCHEMA,
            **triads,
            "setup": {"effects": effects(case.imu.setup, "")},
            "protocol": {"kind": case.protocol.kind, **asdict(case.protocol)} if case.protocol else None,
            "gravity": float(case.plan.motion.gravity),
            "earth_rotation": np.asarray(case.plan.motion.earth).tolist(),
            "magnetic_field": np.asarray(case.plan.motion.field).tolist(),
            "schedule": [
                {"start": each.start, "stop": each.stop, "kind": each.kind, "vector": each.vector.tolist(),
                 "angle": each.angle, "heading": each.heading}
                for each in self.schedule
            ],
            "artefacts": [
                {"name": each.name} | {k: None if v == np.inf else v for k, v in asdict(each).items()}
                for each in case.artefacts
            ],
            "rate": case.rate,
            "samples": case.samples,
            "seed": list(case.seed),
            "power_on": case.power_on,
            "notes": list(self.notes),
            "software": SOFTWARE,
        }  # fmt: skip

    def save_schedule(self, path: str | os.PathLike[str]) -> None:
        """Write rests and turns as a turntable schedule (CSV, angles in degrees), as `--reference` reads it."""
        lines = ["start [s],stop [s],kind,x,y,z,angle [deg],heading [deg]"]
        for each in self.schedule:
            x, y, z = each.vector
            angle, heading = np.degrees(each.angle), np.degrees(each.heading)
            extra = f"{angle:.12g}," if each.kind == "turn" else f",{heading:.12g}"
            lines.append(f"{each.start:.9g},{each.stop:.9g},{each.kind},{x:.12g},{y:.12g},{z:.12g},{extra}")
        with atomic_write(path) as temporary:
            temporary.write_text("\n".join(lines) + "\n", encoding="utf-8")


def _generator(seed: Sequence[int], purpose: str, power_on: int) -> np.random.Generator:
    return np.random.default_rng([*seed, zlib.crc32(purpose.encode()), power_on])


def _respond_batch(length: int, halo: int, columns: tuple[str, ...], imus, motions, memory, first, rate):
    """Of units stacked along a leading axis: outputs of one block, the columns beside them, what effects remember."""

    def one(imu: Imu, motion: Motion, memory):
        def crop(stimulus):
            return jax.tree.map(lambda leaf: leaf[halo : halo + length], stimulus)

        whole = motion.block(first - halo, rate, length + 2 * halo)
        values, kept = {}, {}
        for name, triad in imu.triads().items():
            felt = replace(crop(imu.acted(whole, triad.quantity)), memory=memory)
            values[name] = triad.respond(felt)
            kept |= triad.memory(felt)
        said = crop(whole)
        beside = {
            "temperature": lambda: said.temperature[:, None],
            "current": lambda: said.current[:, None],
            "ambient_temperature": lambda: motion.ambient_at(said.time + 0.5 / rate)[:, None],
            "attitude": lambda: said.attitude,
            "table_rate": lambda: rotate(said.attitude, said.angular_rate)[:, 2:] - motion.earth[2],
        }
        return values | {name: beside[name]() for name in columns}, kept

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
        reach = max(
            (effect.reach(self.samples / self.rate) for case in cases for effect in case.imu.setup), default=None
        )
        self._halo = 0 if reach is None else -(-(round(reach * self.rate) + 3) // _HALO_STEP) * _HALO_STEP

    def __iter__(self) -> Iterator[list[LoggedRows]]:
        cases = self.cases
        imus, motions = _stack([case.imu for case in cases]), _stack([case.plan.motion for case in cases])
        noises = [
            {
                name: case.noise[name].stream(self.rate, case.seed, case.power_on)
                for name in case.imu.triads()
                if name in case.noise
            }
            for case in cases
        ]
        draws = [
            [_generator(case.seed, f"{place}.{each.name}", case.power_on) for place, each in enumerate(case.artefacts)]
            for case in cases
        ]
        kept: list[list[Any]] = [[None] * len(case.artefacts) for case in cases]
        memory: Any = {
            effect.name: np.full((len(cases), effect.memory), np.nan)
            for triad in cases[0].imu.triads().values()
            for effect in triad.effects
            if effect.memory
        }
        settings = self.length, self._halo, cases[0].plan.columns
        respond, description = partial(_respond_batch, *settings), f"respond {settings}"
        for first in range(0, self.samples, self.length):
            rows = np.arange(first, min(first + self.length, self.samples))
            columns, memory = stored.call(
                respond, description, imus, motions, memory, float(first), self.rate, quick=False
            )
            block = []
            for unit, case in enumerate(cases):
                values = {name: np.array(column[unit])[: len(rows)] for name, column in columns.items()}
                for name, noise in noises[unit].items():
                    values[name] += _per_output(case.imu, name) * noise.take(self.length)[: len(rows)]
                samples = LoggedRows(rows, rows / self.rate, values)
                for place, artefact in enumerate(case.artefacts):
                    kept[unit][place] = artefact.apply(samples, draws[unit][place], kept[unit][place])
                block.append(samples)
            yield block
        self.notes = [
            tuple(text for a, state in zip(case.artefacts, states, strict=True) if (text := a.report(state)))
            for case, states in zip(cases, kept, strict=True)
        ]


def _per_output(imu: Imu, name: str) -> FloatArray | float:
    """Noise is in SI: per axis, the output units of one SI unit."""
    triad = imu.triads()[name]
    return np.linalg.norm(np.asarray(triad.gain), axis=1) if triad.output_unit == "count" else 1.0


_UNITS = {"temperature": "degC", "ambient_temperature": "degC", "current": "A", "attitude": "1", "table_rate": "rad/s"}


def _recording(case: Case, parts: Sequence[LoggedRows]) -> Recording:
    time = np.concatenate([part.time for part in parts])

    def signal(name: str) -> Signal | None:
        if name not in parts[0].values:
            return None
        triad = case.imu.triads().get(name)
        unit = _UNITS[name] if triad is None else triad.output_unit
        values = np.concatenate([part.values[name] for part in parts])
        scale = _per_output(case.imu, name) if triad is not None else 1.0
        return Signal(time, values, unit, np.broadcast_to(scale, values.shape[1]))

    accelerometer = signal("accelerometer")
    assert accelerometer is not None
    return Recording(
        accelerometer,
        **{name: signal(name) for name in ("gyroscope", "magnetometer", *_UNITS)},  # pyright: ignore[reportArgumentType]
    )


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
    found = []
    for unit, case in enumerate(cases):
        parts = [block[unit] for block in blocks]
        found.append((_recording(case, parts), Truth(case, source.notes[unit])))
    return found


def write_case(case: Case, path: str | os.PathLike[str]) -> Truth:
    """Simulate a case into a file, by its suffix; Parquet in bounded memory, whole or not at all. Return the truth."""
    if Path(path).suffix.lower() == ".parquet":
        source = Stream([case])
        write_parts((_recording(case, block) for block in source if len(block[0].time)), path)
        return Truth(case, source.notes[0])
    recording, truth = simulate_cases([case])[0]
    write_recording(recording, path)
    return truth
