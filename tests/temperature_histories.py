"""Units at rest under random temperatures, simulated from the physics alone: nothing here comes from the estimator.

A lag is a heat balance stepped through time, a hysteresis a slack that is pushed, slow noise a sum of filtered noises.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.signal import lfilter

from jaximu.recordings.recording import Recording, Signal

KINDS = ("sines", "steps", "walk", "day", "chamber", "soaks")
LOW, HIGH = -13.0, 42.0  # °C
AXES = 3
DENSITY = {"accelerometer": 1e-3, "gyroscope": 9e-5}  # m/s²/√Hz, rad/s/√Hz
FLICKER = {"accelerometer": 3e-5, "gyroscope": 3e-6}
SIZE = {"accelerometer": 1e-3, "gyroscope": 1e-4}  # SI per K


@dataclass(frozen=True)
class Unit:
    """What temperature does to a unit: by triad polynomials (3, 3) of T − 25 °C at once, and what is beyond (3,).

    beyond: "none", "lag", "hysteresis" or "both"; lag: s; width: K, half of the loop's.
    """

    polynomial: dict[str, np.ndarray]
    lagging: dict[str, np.ndarray]
    playing: dict[str, np.ndarray]
    lag: float
    width: float
    beyond: str


def draw_unit(rng: np.random.Generator, beyond: str) -> Unit:
    """Draw a unit; an axis in five has nothing beyond its polynomial."""
    scales = np.array([1.0, 0.012, 0.0002])[:, None]
    polynomial = {name: size * scales * rng.normal(size=(3, AXES)) for name, size in SIZE.items()}

    def part() -> dict[str, np.ndarray]:
        size = rng.uniform(0.3, 1.0, (2, AXES)) * rng.choice([-1, 1], (2, AXES)) * (rng.random((2, AXES)) > 0.2)
        return {name: SIZE[name] * own for name, own in zip(SIZE, size, strict=True)}

    return Unit(polynomial, part(), part(), float(np.exp(rng.uniform(np.log(30), np.log(300)))),
                float(rng.uniform(1.0, 6.0)), beyond)  # fmt: skip


def draw_history(rng: np.random.Generator, kind: str, hours: float, rate: float) -> tuple[np.ndarray, np.ndarray]:
    """Return times, s, and the temperatures, °C, of a history that spans LOW to HIGH."""
    time = np.arange(0.0, 3600 * hours, 1 / rate)
    length = time[-1]
    if kind == "sines":
        periods = np.exp(rng.uniform(np.log(900), np.log(7200), 6))
        waves = [rng.uniform(0.3, 1) * np.sin(2 * np.pi * time / p + rng.uniform(0, 2 * np.pi)) for p in periods]
        shape = np.sum(waves, axis=0)
    elif kind == "steps":
        ends = np.sort(rng.uniform(0, length, int(4 * hours)))
        target = rng.uniform(-1, 1, len(ends) + 1)[np.searchsorted(ends, time)]
        shape = _relaxed(target, rng.uniform(200, 500) * rate)
    elif kind == "walk":
        shape = _relaxed(np.cumsum(rng.normal(size=len(time))), 200 * rate)
    elif kind == "day":
        shape = np.sin(2 * np.pi * time / length + rng.uniform(0, 6)) + 0.1 * np.sin(
            2 * np.pi * time / 1700 + rng.uniform(0, 6)
        )
    elif kind == "chamber":
        knots, now, up = [(0.0, LOW)], 0.0, True
        while now < length:
            speed = rng.uniform(1.0, 6.0) / 60
            now += (HIGH - LOW) / speed
            knots += [(now, HIGH if up else LOW), (now + 600, HIGH if up else LOW)]
            now, up = now + 600, not up
        shape = _relaxed(np.interp(time, *np.transpose(knots)), 60 * rate)
    else:
        levels = rng.permutation(np.linspace(-1, 1, int(3 * hours)))
        held = np.linspace(0, length, 2 * len(levels))
        shape = _relaxed(np.interp(time, held, np.repeat(levels, 2)), 120 * rate)
    low, high = shape.min(), shape.max()
    return time, LOW + (HIGH - LOW) * (shape - low) / (high - low)


def record(unit: Unit, kind: str, seed: int, hours: float = 3.0, rate: float = 10.0) -> tuple[Recording, Recording]:
    """Return a recording of a unit under a new history, and its noise alone beside gravity."""
    rng = np.random.default_rng(seed)
    time, celsius = draw_history(rng, kind, hours, rate)
    warmth = celsius - 25.0
    late, slack = _relaxed(warmth, unit.lag * rate), _pushed(warmth, unit.width)
    outputs, quiet = {}, {}
    for name, unit_name in (("accelerometer", "m/s^2"), ("gyroscope", "rad/s")):
        added = np.stack([warmth, warmth**2, warmth**3], axis=1) @ unit.polynomial[name]
        if unit.beyond in ("lag", "both"):
            added += np.multiply.outer(late, unit.lagging[name])
        if unit.beyond in ("hysteresis", "both"):
            added += np.multiply.outer(slack, unit.playing[name])
        noise = DENSITY[name] * np.sqrt(rate) * rng.normal(size=(len(time), AXES))
        for span in (10.0, 100.0, 1000.0, 10000.0):
            noise += _slow(rng, len(time), span * rate, FLICKER[name])
        still = noise + ([0, 0, 9.80665] if name == "accelerometer" else [0.01, -0.02, 0.005])
        outputs[name], quiet[name] = Signal(time, still + added, unit_name), Signal(time, still, unit_name)
    thermometer = Signal(time[::10], (celsius[::10] + 0.01 * rng.normal(size=len(time[::10])))[:, None], "degC")
    return (Recording(**outputs, temperature=thermometer), Recording(**quiet, temperature=thermometer))


def _relaxed(value: np.ndarray, steps: float) -> np.ndarray:
    """Follow a value by the share 1/steps of the difference each step, from where it starts."""
    share = 1 - np.exp(-1 / steps)
    return np.asarray(lfilter([share], [1, share - 1], value, zi=[(1 - share) * value[0]])[0])


def _pushed(value: np.ndarray, width: float) -> np.ndarray:
    """Follow a value that pushes a slack of half-width `width`."""
    found, now = np.empty_like(value), float(value[0])
    for k, each in enumerate(value.tolist()):
        now = each - width if each - width > now else (each + width if each + width < now else now)
        found[k] = now
    return found


def _slow(rng: np.random.Generator, count: int, steps: float, size: float) -> np.ndarray:
    share = np.exp(-1 / steps)
    drive = size * np.sqrt(1 - share**2) * rng.normal(size=(count, AXES))
    drive[0] = size * rng.normal(size=AXES)
    return np.asarray(lfilter([1.0], [1, -share], drive, axis=0))
