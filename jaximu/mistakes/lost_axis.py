"""`data.dead_axis` and `data.copied_axis`: an axis that does not answer, or repeats another one."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import combinations

import numpy as np

from jaximu.ground.array_types import FloatArray
from jaximu.ground.distributions import rms
from jaximu.ground.units import STANDARD_GRAVITY
from jaximu.ground.vectors import dot_rows, lengths_of
from jaximu.mistakes.base import Samples, Sensor
from jaximu.recordings.finding import Finding

TITLES = {"data.copied_axis": "copied axis", "data.dead_axis": "dead axis"}

_SLOW = 0.15
"""Radians of a block from which on samples at a low rate need not tell how far it turned."""
_LEAK = 2e-3
"""Share of the others' motion that misalignment gives to any axis that lives."""
_NO_BIAS = 0.2
"""rad/s that an axis reads which turns steadily, and no bias is."""
_ROUND, _OFF = 0.15, 3.0
"""Share of gravity by which its norm at rest may change, and m/s² that biases of a live sensor may be."""
_OF_REST = 0.6
"""Share of what the other axes leave of gravity's turning that rotation about the dead one must explain."""


def find(samples: Samples) -> list[Finding]:
    """Return the axes that are dead or copies."""
    copies = [finding for sensor in samples.sensors.values() for finding in _copied(sensor)]
    return copies or [*_dead_force(samples), *_dead_rate(samples)]


def _copied(sensor: Sensor) -> Iterator[Finding]:
    """Two axes with the same noise, or exactly proportional ones."""
    # in motion about one axis the others may be proportional, too: their noise is not
    noise = sensor.curvature[sensor.quiet]
    products, of_noise = sensor.difference.T @ sensor.difference, noise.T @ noise
    for first, second in combinations(range(3), 2):
        if not products[first, first] * products[second, second] > 0:
            continue
        whole, same = (
            abs(table[first, second]) / np.sqrt(table[first, first] * table[second, second])
            for table in (products, of_noise if of_noise[first, first] * of_noise[second, second] > 0 else products)
        )
        wide = np.ptp(sensor.values[:, second]) >= 20 * sensor.noise[second]
        if wide and whole > 0.98 and same > 0.9 and len(noise) > 50:
            factor = products[first, second] / products[first, first]
            yield Finding(
                "data.copied_axis",
                (),
                f"{sensor.name}: {'xyz'[second]} is {factor:.3g} times {'xyz'[first]}, noise included: one of the "
                "two was not recorded. Check the columns, and record again.",
                spoils=True,
                refuses=sensor.name,
            )


def _dead_force(samples: Samples) -> Iterator[Finding]:
    """An axis that stays put while the other two turn through gravity, so that the norm at rest does not stay g."""
    sensor = samples.accelerometer
    if sensor is None:
        return
    _, mean, variance = sensor.blocks
    mean = mean[variance.sum(axis=1) < 4 * np.quantile(variance.sum(axis=1), 0.3)]
    if len(mean) < 12:
        return
    span = np.ptp(np.quantile(mean, [0.02, 0.98], axis=0), axis=0)
    axis = int(np.argmin(span))
    turns = span[axis] <= 0.05 * STANDARD_GRAVITY and np.min(np.delete(span, axis)) >= 0.8 * STANDARD_GRAVITY
    if not turns or _turned_about(mean, axis):
        return
    yield Finding(
        "data.dead_axis",
        (),
        f"accelerometer {'xyz'[axis]}: it stays within {span[axis]:.2g} m/s² while the other axes turn through "
        "gravity, and the norm at rest does not stay that of gravity: the axis is dead. Check the sensor and the "
        "columns.",
        spoils=True,
        refuses="accelerometer",
    )


def _turned_about(mean: FloatArray, axis: int) -> bool:
    """Whether the unit was turned about a level axis: forces at rest (n, 3) lie on gravity's circle, biases apart."""
    if np.ptp(np.quantile(lengths_of(mean), [0.05, 0.95])) < _ROUND * STANDARD_GRAVITY:
        return True
    plane = np.delete(mean, axis, axis=1)
    system = np.column_stack([2 * plane, np.ones(len(plane))])  # |p|² = 2 c·p + (r² − |c|²)
    *centre, rest = np.linalg.lstsq(system, np.sum(plane**2, axis=1))[0]
    radius = np.sqrt(max(rest + np.dot(centre, centre), 0.0)) / STANDARD_GRAVITY
    spread = np.ptp(np.quantile(lengths_of(plane - centre), [0.05, 0.95])) / STANDARD_GRAVITY
    return bool(spread < _ROUND / 3 and abs(radius - 1) < _ROUND and np.linalg.norm(centre) < _OFF)


def _dead_rate(samples: Samples) -> Iterator[Finding]:
    """An axis of the gyroscope without motion, about which gravity turns."""
    sensor, blocks = samples.gyroscope, samples.turning
    if sensor is None or blocks is None:
        return
    moved = rms(sensor.values - np.median(sensor.values, axis=0), axis=0)
    axis = np.argmin(moved)
    others = np.min(np.delete(moved, axis))
    if others < 0.05 or moved[axis] > 0.02 * others or abs(np.median(sensor.values[:, axis])) > _NO_BIAS:
        return
    unexplained = blocks.change + np.cross(blocks.turned(), blocks.force)
    about = -np.cross(np.eye(3)[axis], blocks.force)  # what a rotation about the dead axis would do
    power = np.sum(about**2, axis=1)
    good = (power > 1e-6 * np.max(power)) & (lengths_of(blocks.turned()) < _SLOW)
    along = np.sum(dot_rows(unexplained, about)[good] ** 2 / power[good])
    needed = _OF_REST if moved[axis] > _LEAK * others else _OF_REST / 3
    if along < 0.1 * np.sum(blocks.change[good] ** 2) or along < needed * np.sum(unexplained[good] ** 2):
        return
    yield Finding(
        "data.dead_axis",
        (),
        f"gyroscope {'xyz'[axis]}: it hardly moves, but gravity turns about this axis: the axis is dead. Check the "
        "sensor and the columns.",
        spoils=True,
        refuses="gyroscope",
    )
