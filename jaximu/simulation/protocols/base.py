"""The interface of a protocol: a recipe of motion and temperature."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, fields, replace
from typing import Any, ClassVar

import numpy as np

from jaximu.ground.errors import InputError
from jaximu.ground.precision import require_float64
from jaximu.model.stimulus import Stimulus
from jaximu.recordings.entry import ScheduleEntry
from jaximu.simulation.protocols.course import Course, Environment
from jaximu.simulation.protocols.motion import Motion


@dataclass(frozen=True)
class Plan:
    """A protocol made out: its motion, its rests and turns, and what a log of it holds beside the sensors."""

    motion: Motion
    intervals: tuple[ScheduleEntry, ...]
    columns: tuple[str, ...] = ()  # of `Recording`: temperature, ambient_temperature, current, attitude, table_rate


def may_be_zero() -> Any:
    """Return a field of a protocol that may be zero and is unless stated, as others may not."""
    return field(default=0.0, metadata={"zero": True})


def signed(default: float | tuple[float, float, float]) -> Any:
    """Return a field of a protocol that may have any sign."""
    return field(default=default, metadata={"signed": True})


@dataclass(frozen=True)
class Protocol:
    """A recipe: its fields are numbers that a specification may set, `course` writes the motion down.

    `kind` is its name in a specification. Durations are in s, angles and rates in degrees and °/s.
    """

    kind: ClassVar[str]
    reference: ClassVar[tuple[str, ...]] = ()  # columns that a table tells

    def __post_init__(self) -> None:
        for parameter in fields(self):
            value = getattr(self, parameter.name)
            if isinstance(value, str) or "signed" in parameter.metadata:
                continue
            zero = "zero" in parameter.metadata
            for number in value if isinstance(value, Sequence) else (value,):
                if not np.isfinite(number) or number < 0 or (number == 0 and not zero):
                    bound = "must not be negative" if zero else "must be greater than zero"
                    raise InputError(f"protocol {self.kind}: {parameter.name} {bound}, found {number}.")

    def course(self, rng: np.random.Generator) -> Course:
        """Return the motion, segment by segment; `rng` draws what a person would do at will."""
        raise NotImplementedError

    def environment(self, environment: Environment) -> Environment:
        """Return the environment with what the protocol itself brings about (temperature, vibration)."""
        return environment

    def plan(self, rng: np.random.Generator, environment: Environment | None = None) -> Plan:
        """Return the protocol made out in an environment (standard gravity, 25 °C, no Earth rotation by default)."""
        course = self.course(rng)
        environment = self.environment(environment or Environment())
        conditions = {
            "temperature": environment.temperature,
            "ambient_temperature": environment.ambient,
            "current": environment.current,
        }
        logged = [name for name, value in conditions.items() if value is not None]
        return Plan(course.motion(environment, rng), tuple(course.intervals), (*logged, *self.reference))

    def stimulus(self, rate: float = 100.0, seed: int = 0, environment: Environment | None = None) -> Stimulus:
        """Return what the sensors go through, at `rate` (Hz); see `Stimulus` for its fields."""
        require_float64()
        return self.plan(np.random.default_rng(seed), environment).motion.stimulus(rate)

    def _own(self, environment: Environment, **values) -> Environment:
        """Fill in what the protocol brings about; raise where the environment sets it as well."""
        for name in values:
            if getattr(environment, name):
                raise InputError(f"protocol {self.kind} sets the {name} itself; leave it out of the environment.")
        return replace(environment, **values)
