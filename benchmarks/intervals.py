"""Do stated intervals hold where biases drift? By hand and on a table; biases by both of their meanings.

Units with gains and biases of their own are simulated without drift. A drift that another program would draw (a random
walk, or flicker noise as a sum of first-order processes, at a sample a quarter of a second) is added to their samples;
it goes on as long again after the recording ends. Errors are those of gains, of the bias as its mean over the
recording, and of the bias as its mean over the time after it. Numbers that a recording leaves open are left out.
"""

import os

os.environ.setdefault("JAX_PLATFORMS", "cpu")

from dataclasses import replace

import equinox as eqx
import jax
import numpy as np
from common import Table, arguments, finish
from scipy.signal import lfilter

from jaximu import LocalGravity, calibrate
from jaximu.calibration.turntable import calibrate_turntable
from jaximu.ground.units import STANDARD_GRAVITY
from jaximu.model.noise import Noise
from jaximu.model.processes import White
from jaximu.model.sensor import Imu
from jaximu.noise.at_rest import noise_of
from jaximu.simulation import simulate
from jaximu.simulation.protocols import HandHeld, Positions, RateTable, Static

jax.config.update("jax_enable_x64", True)

EXACT = LocalGravity(STANDARD_GRAVITY, 0.0)
RATE, STEP = 50.0, 0.25
DENSITY = {"accelerometer": 1e-3, "gyroscope": 1.7e-4}
WHITE = {
    "accelerometer": Noise((White(DENSITY["accelerometer"]),), "specific_force"),
    "gyroscope": Noise((White(DENSITY["gyroscope"]),), "angular_rate"),
}
WALK = 1.0
"""What a random walk gains over the recording, relative to the white noise of a second."""
FLICKER = 0.4
"""Bias instability relative to the same, as MEMS sensors have it."""
DRIFTS = ("none", "flicker", "random walk")
AT_REST = 1800.0
"""Seconds of the recording at rest."""


def drift(kind, duration, over, rng):
    """Return a drift (k, 3) over `duration` (s) in units of the white noise of a second; `over`: of the recording."""
    count = int(np.ceil(duration / STEP)) + 1
    steps = rng.standard_normal((count, 3))
    if kind == "random walk":
        return WALK * np.sqrt(STEP / over) * np.cumsum(steps, axis=0)
    values = np.zeros((count, 3))
    for time in 2.0 ** np.arange(0, np.ceil(np.log2(16 * over)) + 1) if kind == "flicker" else ():
        decay = np.exp(-STEP / time)
        process = rng.standard_normal((count, 3))
        process[1:] *= np.sqrt(1 - decay**2)
        values += FLICKER * np.sqrt(np.log(2) / np.pi) * lfilter([1.0], [1.0, -decay], process, axis=0)
    return values


def drawn_unit(rng):
    """Return a unit: gains off by percents, the accelerometer's lower triangular, and biases."""
    gains = np.eye(3) + 0.02 * rng.uniform(-1, 1, (2, 3, 3))
    gains[0] = np.tril(gains[0])
    biases = rng.uniform(-1, 1, (2, 3)) * np.array([[0.3], [0.02]])
    where = lambda i: (i.accelerometer.gain, i.accelerometer.bias, i.gyroscope.gain, i.gyroscope.bias)  # noqa: E731
    return eqx.tree_at(where, Imu.nominal(), (gains[0], biases[0], gains[1], biases[1]))


def drifted(recording, imu, kind, rng):
    """Return a recording with drift, and the true biases (3,) in and after it, by triad."""
    signals, during, after = {}, {}, {}
    for name, signal in ((name, recording.signals[name]) for name in DENSITY):
        over = float(signal.time[-1] - signal.time[0])
        grid = np.arange(int(np.ceil(2 * over / STEP)) + 1) * STEP
        values = DENSITY[name] * drift(kind, 2 * over, over, rng)
        at = np.stack([np.interp(signal.time - signal.time[0], grid, axis) for axis in values.T], axis=1)
        signals[name] = replace(signal, values=signal.values + at)
        bias, inside = np.asarray(getattr(imu, name).bias), grid <= over
        during[name], after[name] = bias + at.mean(axis=0), bias + values[~inside].mean(axis=0)
    return replace(recording, **signals), during, after


def resting(kind, over, rng):
    """Return a recording at rest of a unit; a walk is as strong as in its other recording, of `over` seconds."""
    rest, _ = simulate(Imu.nominal(), Static(AT_REST), WHITE, rate=RATE, seed=int(rng.integers(1 << 30)))
    signals, grid = {}, np.arange(int(np.ceil(AT_REST / STEP)) + 1) * STEP
    for name in DENSITY:
        signal, values = rest.signals[name], DENSITY[name] * drift(kind, AT_REST, over, rng)
        at = np.stack([np.interp(signal.time - signal.time[0], grid, axis) for axis in values.T], axis=1)
        signals[name] = replace(signal, values=signal.values + at)
    return replace(rest, **signals)


def recipes():
    """Return by name a protocol and how its recordings are calibrated."""
    hand = HandHeld(poses=24)

    def by_hand(recording, truth, static):
        return calibrate(recording, EXACT, static=static)

    def on_table(recording, truth, static):
        return calibrate_turntable(recording, truth.schedule, EXACT, static=static)

    return {
        "24 poses by hand": (hand, by_hand),
        "12 positions": (Positions(12, duration=10.0), on_table),
        "rate table": (RateTable(rates=(45.0, 90.0)), on_table),
    }


def errors(kind, protocol, recipe, at_rest, units):
    """Return errors in stated sigmas by group of numbers: a row (n,) a unit."""
    rows = {}
    long = float(simulate(Imu.nominal(), protocol, {}, rate=RATE, seed=0)[0].accelerometer.time[-1])
    for number in range(units):
        rng = np.random.default_rng([number, DRIFTS.index(kind)])
        imu = drawn_unit(rng)
        recording, truth = simulate(imu, protocol, WHITE, rate=RATE, seed=number)
        static = noise_of(resting(kind, long, rng)) if at_rest else None
        recording, during, after = drifted(recording, imu, kind, rng)
        calibration = recipe(recording, truth, static)
        gains = {name: np.asarray(triad.gain) for name, triad in imu.triads().items()}
        for group, values in in_sigmas(calibration, gains, during, after).items():
            rows.setdefault(group, []).append(values)
    return rows


def in_sigmas(calibration, gains, during, after):
    """Return a unit's errors in stated sigmas by group of numbers, those left open not counted.

    gains, during, after: the true gains, and biases as means over the recording and over as long again, by triad.
    """
    errors, left = {}, calibration.open_numbers
    for name, triad in calibration.triads().items():
        gain, bias = calibration.sigma(name)
        known = (gain > 0) & [[f"{name}.gain[{i},{j}]" not in left for j in range(3)] for i in range(3)]
        sure = np.array([f"{name}.bias[{i}]" not in left for i in range(3)])
        found, recorded = np.asarray(triad.bias), calibration.bias_sigma_recording[name]
        errors[f"{name}, gains"] = ((np.asarray(triad.gain) - gains[name]) / np.where(known, gain, 1))[known]
        errors[f"{name}, bias in the recording"] = ((found - during[name]) / recorded)[sure]
        errors[f"{name}, bias after it"] = ((found - after[name]) / bias)[sure]
    return {group: values for group, values in errors.items() if len(values)}


def bounds(rows, rng):
    """Return the root mean square, the share within 1.96, and its 99 % bounds by resampling units."""
    inside = np.array([np.mean(np.abs(row) < 1.959964) for row in rows])
    counts = np.array([len(row) for row in rows], float)
    drawn = rng.integers(len(rows), size=(4000, len(rows)))
    shares = np.sum((inside * counts)[drawn], axis=1) / np.sum(counts[drawn], axis=1)
    whole = np.concatenate(rows)
    share = float(np.mean(np.abs(whole) < 1.959964))
    return float(np.sqrt(np.mean(whole**2))), share, *map(float, np.quantile(shares, [0.005, 0.995]))


def main() -> None:
    options = arguments(__doc__)
    units = 6 if options.small else 40
    table = Table(
        f"Stated intervals of {units} units a setting (goal: 93 to 97 % within the 99 % bounds)",
        [
            "recording",
            "drift",
            "noise from",
            "numbers",
            "rms of error / sigma",
            "95 % intervals that hold, 99 % bounds",
        ],
    )
    figures, rng = {}, np.random.default_rng(0)
    for name, (protocol, recipe) in recipes().items():
        for kind in DRIFTS:
            for at_rest in (False, True):
                source = "half an hour at rest" if at_rest else "the recording"
                for group, rows in errors(kind, protocol, recipe, at_rest, units).items():
                    rms, share, low, high = bounds(rows, rng)
                    missed = "" if low <= 0.97 and high >= 0.93 else " (missed)"
                    cell = f"{100 * share:.1f} % ({100 * low:.1f} … {100 * high:.1f}){missed}"
                    table.add(name, kind, source, group, f"{rms:.2f}", cell)
                    figures[f"{name}, {kind}, {source}, {group}"] = [rms, share, low, high]
                print(name, kind, source, flush=True)
    finish("intervals", [table], figures, keep=not options.small)


if __name__ == "__main__":
    main()
