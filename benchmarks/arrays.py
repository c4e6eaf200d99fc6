"""Units on one rigid body: intervals against simulated truth, and a measured board of eight in four sessions.

`python benchmarks/arrays.py [--small]`; with `JAXIMU_DATA` the measured board. `--together`: what the units gain by
being calibrated together, from the motion that they share, as a table of its own.
"""

import os
import sys
from pathlib import Path

os.environ.setdefault("JAX_PLATFORMS", "cpu")
sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))

import array_motion
import jax
import numpy as np
from common import Table, arguments, finish, share
from scipy.spatial.transform import Rotation
from scipy.stats import chi2
from turns_left_out import leave_out_turns

from jaximu import LocalGravity, Recording, wgs84_gravity
from jaximu.calibration import calibrate_array, fit_together
from jaximu.ground.errors import NotPossibleError
from jaximu.recordings.readers import ReadOptions, read_recording
from jaximu.recordings.recording import Signal

jax.config.update("jax_enable_x64", True)
DRAWING = 9.45e-3 * np.array([[-1, 1], [-1, 1], [-1, -1], [-1, -1], [1, 1], [1, 1], [1, -1], [1, -1]])
"""Nominal places of the board's units (m) in x and y; z is 1 mm above and below in turn."""


def simulated(seeds):
    """Errors over stated standard deviations: rotation, position, clock; and the mean's noise over the expected."""
    errors = {"rotation": [], "position": [], "clock": []}
    gains = []
    for seed in seeds:
        made = array_motion.array(seed, units=3)
        found = calibrate_array(
            [Recording(Signal(unit.time, unit.force, "m/s^2"), Signal(unit.time, unit.rate, "rad/s")) for unit in made],
            LocalGravity(array_motion.GRAVITY, 0.0),
        )
        for unit, truth in zip(found.units[1:], made[1:], strict=True):
            off = Rotation.from_quat(unit.rotation, scalar_first=True) * truth.turned
            errors["rotation"] += (off.as_rotvec() / unit.rotation_sigma).tolist()
            errors["position"] += ((unit.position - truth.place) / unit.position_sigma).tolist()
            errors["clock"].append((unit.time_offset - truth.late) / unit.time_offset_sigma)
        gains.append(found.averaged.rate[1] / found.averaged.rate[2])
    return errors, gains


def measured(folder, sessions, gravity):
    """The board's arrays, a session each."""
    options = ReadOptions(accel_scale="2048 count/g", gyro_scale="16.4 count/(deg/s)", gravity=gravity)
    return [
        calibrate_array([read_recording(folder / f"unit{number}_session{session}.parquet", None, options)
                         for number in range(1, 9)], gravity)
        for session in sessions
    ]  # fmt: skip


def together(seeds, folder, sessions, gravity):
    """Table of errors in turns that were not fitted, units calibrated alone and together; and its figures."""
    table = Table("Units on one body, calibrated alone and together: errors in turns that were not fitted, rms",
                  ("array", "turns times units", "gravity carried [°]: alone", "together", "turn against unit 1's [°]: "
                   "alone", "together", "share of turns' variance that all have in common"),
                  "Every second turn is left out, then the others. Simulated: three units, noise alone.")  # fmt: skip
    figures = {}

    def add(name, found):
        try:
            left = leave_out_turns(found, fit_together(found))
        except NotPossibleError as error:
            why = str(error).partition(": ")[2].partition(":")[0]  # without the files' names, and what is usually done
            figures[name] = {"refused": why}
            table.add(name, *[""] * 5, f"refused: {why}")
            return print(name, error, flush=True)
        table.add(name, left.count, *(float(np.degrees(each)) for each in (*left.gravity, *left.apart)),
                  f"{100 * left.in_common:.0f} %")  # fmt: skip
        figures[name] = {"gravity": left.gravity, "apart": left.apart, "in_common": left.in_common, "of": left.count}
        print(name, figures[name], flush=True)

    for seed in seeds:
        recordings = [
            Recording(Signal(unit.time, unit.force, "m/s^2"), Signal(unit.time, unit.rate, "rad/s"))
            for unit in array_motion.array(seed, units=3)
        ]
        add(f"simulated, seed {seed}", calibrate_array(recordings, LocalGravity(array_motion.GRAVITY, 0.0)))
    for session in sessions:
        (found,) = measured(folder, [session], gravity)
        add(f"MIMU4444, session {session}", found)
    return table, figures


def main():
    asked = arguments(__doc__, together="what calibrating units together gains, and nothing else")
    if asked.together:
        folder = os.environ.get("JAXIMU_DATA")
        sessions = () if folder is None else range(1, 2 if asked.small else 5)
        board = Path(folder or ".") / "mimu4444"
        table, figures = together(range(1 if asked.small else 4), board, sessions, wgs84_gravity(59.35))
        finish("arrays_together", [table], figures, keep=not asked.small, script="arrays")
        return
    errors, gains = simulated(range(3 if asked.small else 30))
    table = Table("Simulated arrays of three units: 16 rests, turns of a second, 100 Hz",
                  ("", "numbers", "95 % intervals hold", "error over its σ, rms"))  # fmt: skip
    figures = {}
    for name, values in errors.items():
        hold = int(np.sum(np.abs(values) < 1.96))
        table.add(name, len(values), share(hold, len(values)), float(np.sqrt(np.mean(np.square(values)))))
        figures[name] = {"hold": hold, "of": len(values)}
    table.add("noise of the mean over that of independent units", len(gains), "", float(np.mean(gains)))
    tables = [table]
    if "JAXIMU_DATA" in os.environ:
        found = measured(Path(os.environ["JAXIMU_DATA"]) / "mimu4444", range(1, 3 if asked.small else 5),
                         wgs84_gravity(59.35))  # fmt: skip
        board, figures["board"] = agreement(found)
        tables += board
    finish("arrays", tables, figures, keep=not asked.small)


def agreement(found):
    """Tables of the board: do sessions agree within what they state, and are the units where the drawing has them."""
    table = Table("Eight units on one board (MIMU4444), four sessions, against unit 1",
                  ("unit", "turned [°], mean", "spread of sessions [°]", "stated σ [°]", "χ²/dof of the rotation",
                   "position, mean [mm]", "by the drawing [mm]"))  # fmt: skip
    total, freedom, off = 0.0, 0, []
    for number in range(1, 8):
        units = [each.units[number] for each in found]
        rotations = Rotation.from_quat([unit.rotation for unit in units], scalar_first=True)
        mean = rotations.mean()
        apart = (rotations * mean.inv()).as_rotvec()
        sigma = np.array([unit.rotation_sigma for unit in units])
        weighted = apart - np.sum(apart / sigma**2, axis=0) / np.sum(1 / sigma**2, axis=0)
        chi = float(np.sum((weighted / sigma) ** 2))
        own = 3 * (len(units) - 1)
        total, freedom = total + chi, freedom + own
        place = 1e3 * np.mean([unit.position for unit in units], axis=0)
        drawn = 1e3 * np.array([*(DRAWING[number] - DRAWING[0]), 0.0 if number % 2 == 0 else -2e-3])
        off.append(place - drawn)
        table.add(number + 1, np.round(np.degrees(mean.as_rotvec()), 2).tolist(),
                  float(np.degrees(np.sqrt(np.sum(apart**2) / own))), float(np.degrees(np.sqrt(np.mean(sigma**2)))),
                  chi / own, np.round(place, 2).tolist(), np.round(drawn, 2).tolist())  # fmt: skip
    bent, figures = bend(found)
    probability = float(chi2.sf(total, freedom))
    averaged = Table("What averaging the eight gains at rest (means of 0.25 s)",
                     ("session", "gyroscope: one [°/s]", "mean", "if independent", "accelerometer: one [mm/s²]", "mean",
                      "if independent"))  # fmt: skip
    for session, each in enumerate(found, 1):
        averaged.add(session, *(float(np.degrees(value)) for value in each.averaged.rate),
                     *(1e3 * value for value in each.averaged.force))  # fmt: skip
    figures |= {"chi_squared": total, "freedom": freedom, "probability": probability,
               "position_rms_mm": float(np.sqrt(np.mean(np.square(off))))}  # fmt: skip
    table.note = (f"χ² of all rotations between sessions {total:.0f} of {freedom} degrees of freedom; places are off "
                  f"the drawing by {figures['position_rms_mm']:.2f} mm (rms).")  # fmt: skip
    return [table, bent, averaged], figures


def bend(found):
    """Table of what two units back to back turn by together, from session to session, and what they differ by.

    The board carries them both: what is common is its own bend, and what differs is the error of the calibrations.
    """
    table = Table("The same by places: two units back to back, on the board's axes",
                  ("units", *(f"session {k}: both turned [0.001°]" for k in range(1, len(found) + 1)),
                   "χ²/dof of what is common", "χ²/dof of what differs"))  # fmt: skip
    total = 0.0
    for pair in ((1,), (2, 3), (4, 5), (6, 7)):
        turned, sigma = np.transpose([_on_board([each.units[k] for each in found]) for k in pair], (1, 0, 2, 3))
        both = np.sum(turned / sigma**2, axis=0) / np.sum(1 / sigma**2, axis=0)
        common = _scatter(both, 1 / np.sqrt(np.sum(1 / sigma**2, axis=0)))
        differ = _scatter(turned[0] - turned[-1], np.linalg.norm(sigma, axis=0)) if len(pair) > 1 else common
        total += differ
        freedom = 3 * (len(found) - 1)
        table.add(" and ".join(str(k + 1) for k in ((0, 1) if pair == (1,) else pair)),
                  *(np.round(1e3 * np.degrees(each), 1).tolist() for each in both),
                  "" if pair == (1,) else common / freedom, differ / freedom)  # fmt: skip
    table.note = (f"Unit 2 lies behind unit 1, against which all turn. χ² of what differs {total:.0f} of {4 * freedom} "
                  "degrees of freedom: the calibrations scatter as they state, and what is common is the board, which "
                  "bends between its rows.")  # fmt: skip
    return table, {"differing": total / (4 * freedom)}


def _on_board(units):
    """Return what a unit turned by (sessions, 3) from its mean, on the axes of the first, and its deviations."""
    rotations = Rotation.from_quat([unit.rotation for unit in units], scalar_first=True)
    back = rotations.mean().inv()
    sigma = np.sqrt(np.array([unit.rotation_sigma for unit in units]) ** 2 @ np.square(back.as_matrix()).T)
    return back.apply((rotations * back).as_rotvec()), sigma


def _scatter(values, sigma):
    """Return χ² of values (n, 3) about their weighted mean."""
    mean = np.sum(values / sigma**2, axis=0) / np.sum(1 / sigma**2, axis=0)
    return float(np.sum(((values - mean) / sigma) ** 2))


if __name__ == "__main__":
    main()
