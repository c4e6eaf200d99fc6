"""A temperature chamber: soaks and ramps of several rates, up and down (S15)."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from jaximu.ground.errors import InputError
from jaximu.simulation.protocols.base import Protocol, may_be_zero, signed
from jaximu.simulation.protocols.course import Course, attitude_of
from jaximu.simulation.protocols.positions import directions


@dataclass(frozen=True)
class SoakAndRamp(Protocol):
    """From `low` to `high` (°C) and back once for each of `rates` (K/min), soaking for `soak_duration` at each end.

    The chamber's air runs along straight ramps (`ambient`); the sensor follows it with the time constant `device_lag`
    (s) and is warmer by `self_heating` (K). With `positions` 6, 8, 12, 24 or 26 the unit goes through that many
    positions, moved within `turn_duration`, during every soak; with 1 it rests with z up.
    """

    low: float = signed(-20.0)
    high: float = signed(60.0)
    rates: Sequence[float] = (1.0, 2.0, 4.0)
    soak_duration: float = 900.0
    device_lag: float = may_be_zero()
    self_heating: float = may_be_zero()
    positions: int = 1
    turn_duration: float = 2.0

    kind = "soak-and-ramp"

    def __post_init__(self):
        super().__post_init__()
        if not -273.15 <= self.low < self.high:
            raise InputError(
                f"protocol soak-and-ramp: low must be above absolute zero (-273.15 degC) and below high, found low "
                f"{self.low} and high {self.high}."
            )

    def _knots(self) -> np.ndarray:
        """Ends of the chamber's ramps and soaks, (n, 2) s and °C."""
        time, table = self.soak_duration, [(0.0, self.low), (self.soak_duration, self.low)]
        for rate in self.rates:
            for end in (self.high, self.low):
                reached = time + (self.high - self.low) / rate * 60
                time = reached + self.soak_duration
                table += [(reached, end), (time, end)]
        return np.array(table)

    def environment(self, environment):
        ambient = self._knots()
        lagged = _lagged(ambient, self.device_lag) if self.device_lag > 0 else ambient
        sensor = lagged + [0.0, self.self_heating]
        return self._own(environment, temperature=sensor.tolist(), ambient=ambient.tolist())

    def course(self, rng):
        course = Course(attitude_of([0.0, 0.0, 1.0]))
        ends = self._knots()[:, 0]
        for start, stop, soak in zip(ends[:-1], ends[1:], np.arange(len(ends) - 1) % 2 == 0, strict=True):
            if self.positions == 1 or not soak:
                course.rest(stop - start)
                continue
            rest = (stop - start) / self.positions - self.turn_duration
            if rest <= 0:
                raise InputError(
                    f"protocol soak-and-ramp: a soak of {self.soak_duration} s is too short for {self.positions} "
                    "positions."
                )
            for up, heading in directions(self.positions):
                course.to(attitude_of(up, heading), self.turn_duration)
                course.rest(rest)
        return course


def _lagged(knots: np.ndarray, time_constant: float) -> np.ndarray:
    """First-order lag of a broken line, exact at knots a twentieth of the time constant apart."""
    count = int(np.ceil(knots[-1, 0] / (time_constant / 20))) + 1
    time = np.union1d(np.linspace(0.0, knots[-1, 0], count), knots[:, 0])
    air = np.interp(time, knots[:, 0], knots[:, 1])
    state = air.copy()
    for k, step in enumerate(np.diff(time)):
        decay, slope = np.exp(-step / time_constant), (air[k + 1] - air[k]) / step
        state[k + 1] = air[k + 1] - slope * time_constant + (state[k] - air[k] + slope * time_constant) * decay
    return np.stack([time, state], axis=1)
