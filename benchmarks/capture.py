"""Guided recording against a fixed list of 24 poses, by a simulated person with a person's mistakes.

The person (`tests/simulated_person.py`) holds some rests too short and turns slowly in others, one in four in all. A
fixed list is gone through without a look at what was recorded; the uncertainty it ends with is the goal of a guided
recording of the same unit by the same person, who is asked pose after pose, those that do not count included. Lists: 24
of a box's faces, edges and corners, in the order with short ways; and each face up at four headings, which tables use.
Moving poses: rests in which the unit turns by more than 0.5°, and whether one of them counted.
"""

import os

os.environ.setdefault("JAX_PLATFORMS", "cpu")
os.environ.setdefault("OMP_NUM_THREADS", "1")

import sys
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from itertools import chain
from multiprocessing import get_context
from pathlib import Path

import jax
import numpy as np
from common import Table, arguments, finish, share

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))
from simulated_person import GRAVITY as STANDARD
from simulated_person import Person

from jaximu import LocalGravity, calibrate
from jaximu.estimation.problem import flatten, names_of
from jaximu.planning.goals import group_of, per_si, unit_of
from jaximu.planning.guide import Guide
from jaximu.planning.poses import short_order
from jaximu.recordings.segmentation import SegmentationOptions, segment
from jaximu.simulation.protocols.positions import directions

jax.config.update("jax_enable_x64", True)

GRAVITY = LocalGravity(STANDARD, 0.0)
MOVING = 0.5  # degrees within a rest, from which a pose is one that moves
MOST = 60


def box(count=24):
    ups = np.array([up for up, _ in directions(26)])[:count]
    return ups[short_order(ups)]


LISTS = {"faces, edges and six corners": box(), "each face at four headings": [up for up, _ in directions(24)]}


def sigmas(calibration):
    """The largest standard uncertainty of each kind of parameter, and its unit; inf where it is not determined."""
    found = {}
    for name, variance in zip(calibration.names, np.diagonal(calibration.covariance), strict=True):
        size = float(np.sqrt(variance)) / per_si(name, calibration.imu)
        kind = group_of(name)
        found[kind] = max(found.get(kind, (0.0, ""))[0], size), unit_of(name, calibration.imu)
    return found


GOALS = {
    "accelerometer bias": ("accelerometer.bias",),
    "accelerometer, everything": ("accelerometer.bias", "accelerometer.scale", "accelerometer.misalignment"),
    "gyroscope scale and misalignment": ("gyroscope.scale", "gyroscope.misalignment"),
    "everything": ("accelerometer.bias", "accelerometer.scale", "accelerometer.misalignment", "gyroscope.scale",
                   "gyroscope.misalignment", "gyroscope.bias"),
}  # fmt: skip


def session(task):
    """One person's fixed list, and the guided recordings to its uncertainty."""
    seed, name = task
    person = Person(seed)
    for up in LISTS[name]:
        person.pose(up)
    wanted, found = sigmas(calibrate(person.recording(), GRAVITY)), []
    for goal, kinds in GOALS.items():
        guide = Guide([f"{kind} {wanted[kind][0]:.6g} {wanted[kind][1]}" for kind in kinds], GRAVITY)
        guided, asked, up = Person(seed + 500), 0, np.array([0.0, 0.0, 1.0])
        guided.gains, guided.bias = person.gains, person.bias
        moment = None
        while asked < MOST and (moment is None or not moment.done):
            guided.pose(up)
            asked += 1
            moment = guide.update(guided.recording())
            up = up if moment.up is None else moment.up
        found.append({"seed": seed, "list": name, "goal": goal, "asked": asked, "taken": len(moment.taken),
                      "reached": moment.done, "seconds": guided.time / person.time,
                      "errors": errors(moment.calibration, guided)})  # fmt: skip
    return found


def errors(calibration, person):
    """Errors of the calibrated parameters in their standard uncertainties."""
    if calibration is None:
        return []
    truth = replace(calibration.imu, accelerometer=replace(calibration.imu.accelerometer, gain=person.gains[0],
                    bias=person.bias[0]), gyroscope=replace(calibration.imu.gyroscope, gain=person.gains[1],
                    bias=person.bias[1]))  # fmt: skip
    places = [names_of(calibration.imu).index(name) for name in calibration.names]
    off = (flatten(calibration.imu) - flatten(truth))[places]
    return (np.abs(off) / np.sqrt(np.diagonal(calibration.covariance))).tolist()


def moving(seed):
    """How many rests turned, and how many of these counted, of a person who is careless in half of them."""
    person = Person(seed, careless=0.25)
    ups = box(26)
    for place in person.rng.permutation(26):
        person.pose(ups[place])
    found = segment(person.recording(), SegmentationOptions(fewest=1)).intervals
    found = found[found[:, 1] - found[:, 0] >= person.rest]
    bad = [(start, stop) for start, stop, angle in person.moved if angle > MOVING]
    hits = sum(any(min(stop, end) - max(start, begin) > 1.0 for begin, end in found) for start, stop in bad)
    good = [(start, stop) for start, stop, angle in person.moved if angle == 0 and stop - start > person.rest + 0.4]
    counted = sum(any(min(stop, end) - max(start, begin) > 1.0 for begin, end in found) for start, stop in good)
    return len(bad), hits, len(good), counted


def main():
    """Run both parts in two processes and keep the tables."""
    options = arguments(__doc__)
    sessions, repeats = (2, 10) if options.small else (12, 1500)
    with ProcessPoolExecutor(os.cpu_count(), mp_context=get_context("spawn")) as pool:
        todo = [(seed, name) for seed in range(sessions) for name in LISTS]
        done = list(chain.from_iterable(pool.map(session, todo)))
        counts = np.sum(list(pool.map(moving, range(repeats), chunksize=10)), axis=0)
    table = Table("A guided recording that reaches a fixed list's uncertainty",
                  ["fixed list of 24", "goal: its uncertainty of", "reached", "poses asked, median (range)",
                   "share of 24", "duration over the list's", "errors within 1.96 σ"])  # fmt: skip
    figures = {"sessions": done, "moving": counts.tolist()}
    for name in LISTS:
        for goal in GOALS:
            some = [each for each in done if each["list"] == name and each["goal"] == goal]
            asked = [each["asked"] for each in some]
            off = np.concatenate([each["errors"] for each in some])
            table.add(name, goal, f"{sum(each['reached'] for each in some)} of {len(some)}",
                      f"{np.median(asked):g} ({min(asked)} to {max(asked)})", f"{100 * np.median(asked) / 24:.0f} %",
                      f"{np.median([each['seconds'] for each in some]):.2f}",
                      f"{100 * np.mean(off < 1.96):.1f} %")  # fmt: skip
    still = Table("Rests of a careless person", ["rests", "in all", "counted as a pose"])
    still.add(f"that turn by more than {MOVING:g}°", int(counts[0]), share(int(counts[1]), int(counts[0]), 2))
    still.add("that are still and long enough", int(counts[2]), share(int(counts[3]), int(counts[2]), 2))
    finish("capture", [table, still], figures, keep=not options.small)


if __name__ == "__main__":
    main()
