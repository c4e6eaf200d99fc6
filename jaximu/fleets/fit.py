"""The fit of many units: one compiled program for each padded shape, units side by side.

The estimate is that of [`jaximu.fit_hand_held`][], joint maximum likelihood with the excess of each kind of noise.
There every solver step integrates all samples of all turns, and whitens with the covariance of all conditions; the
passes of `jaximu.fleets.lanes` are built for many units. A unit that these do not settle is fitted by the recipe.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache, partial
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh, PartitionSpec

from jaximu.calibration import fit_hand_held, residual_rms
from jaximu.data.poses import resized
from jaximu.estimation.problem import Name, Parameters, without_equipment
from jaximu.fleets.lanes import Lanes, fit_lanes
from jaximu.ground import stored
from jaximu.ground.array_types import FloatArray
from jaximu.ground.precision import require_float64
from jaximu.model.sensor import Imu, Triad
from jaximu.recordings.observations import Observations, Poses, Turns

__all__ = ["Fitted", "FleetUnit", "fit_units", "parameter_set", "shape_of"]

_CHUNKS = {True: (8, 32), False: (8, 64)}
"""Units that one call of a compiled program takes, with a gyroscope and without: a handful, or as many as lie in the
cache with their samples."""
_PASSES = (6, 30)
"""Passes for all, and for those that these do not settle: units side by side wait for the slowest."""
_ALIGNMENT = 64  # bytes
_BLOCKS, _BLOCK_SECONDS, _BLOCK_SHARE = (32, 16, 8, 4), 0.17, 0.15
"""Samples that slopes take together: as many as last so long, in which a hand turns by a radian at the most, and no
more than this share of a turn."""

_get = object.__getattribute__  # equinox looks at every access to an attribute, which takes longer than all else here


@dataclass(frozen=True)
class FleetUnit:
    """One unit to be fitted: its observations in output units, and the data sheet's scales and offsets.

    gyroscope: whether it has one; its observations are then used.
    """

    observations: Observations
    nominal: Imu
    gyroscope: bool


@dataclass(frozen=True)
class Fitted:
    """What a fit tells of one unit, in its output units.

    numbers: (24,) gain (row-major) and bias of the accelerometer, then of the gyroscope. covariance: of `names`,
    without gravity's uncertainty, to which they react by `gravity_reach` (per m/s²). information: JᵀJ in typical sizes.
    rms: of the norm of gravity (m/s²), of carried gravity (degrees) and of the rate at rest (rad/s).
    """

    nominal: Imu
    gyroscope: bool
    numbers: FloatArray
    names: tuple[Name, ...]
    covariance: FloatArray
    gravity_reach: FloatArray
    information: FloatArray
    excess: FloatArray
    rms: FloatArray
    converged: bool
    finite: bool

    @property
    def imu(self) -> Imu:
        """The calibrated unit."""

        def triad(nominal: Triad, numbers: FloatArray) -> Triad:
            return replace(nominal, gain=numbers[:9].reshape(3, 3), bias=numbers[9:])

        gyroscope = self.nominal.gyroscope if self.gyroscope else None
        return Imu(
            triad(self.nominal.accelerometer, self.numbers[:12]),
            None if gyroscope is None else triad(gyroscope, self.numbers[12:]),
        )

    def total_covariance(self, gravity_sigma: float) -> FloatArray:
        """Return the covariance (p, p) with what an uncertain gravity (m/s², one sigma) adds."""
        reach = self.gravity_reach * gravity_sigma
        return self.covariance + reach[:, None] * reach


@cache
def parameter_set(gyroscope: bool) -> tuple[Imu, Parameters]:
    """Return the model that all units are brought to, unit gains and no bias, and what is free in it."""
    like = jax.tree.map(np.asarray, Imu.nominal())
    return like, Parameters.select(
        like, lambda name: without_equipment(name) and (gyroscope or name.owner == "accelerometer")
    )


class Shape(NamedTuple):
    """What must agree for units to share a program."""

    gyroscope: bool
    poses: int  # padded
    samples: int  # of a turn, padded
    block: int  # samples that slopes of turns take together


def shape_of(unit: FleetUnit) -> Shape:
    """Return a unit's shape."""
    mask = _get(_get(unit.observations, "poses"), "mask")
    poses = _padded(len(mask) - int(mask[::-1].argmax()), 8)
    if not unit.gyroscope:
        return Shape(False, poses, 0, 1)
    turns = _get(unit.observations, "turns")
    interval = _get(turns, "interval")
    samples = max(np.count_nonzero(interval.sum(axis=0)), 1)  # those of a turn come first
    count, turns = max(np.count_nonzero(interval), 1), max(np.count_nonzero(_get(turns, "mask")), 1)
    most = min(_BLOCK_SECONDS * count / max(interval.sum(), 1e-9), _BLOCK_SHARE * count / turns)
    block = next((size for size in _BLOCKS if size <= most), _BLOCKS[-1])
    return Shape(True, poses, _padded(samples, 32), block)


@cache
def _padded(count: int, least: int) -> int:
    """The next of 4, 5, 6, 7 times a power of two: a quarter more at most, and few shapes to compile."""
    size = least
    while size < count:
        size += 2 ** ((size // 4).bit_length() - 1)
    return size


def fit_units(units: Sequence[FleetUnit]) -> list[Fitted]:
    """Fit units of any shapes; those of one shape are fitted together, and none changes another's result.

    Failures do not raise: look at `converged` and `finite`. A unit that many passes do not settle, or whose noise is a
    model of slow bias, is fitted by `fit_hand_held`. Where JAX has several local devices, they share every chunk;
    devices that XLA makes of one CPU do so where NPROC gives its pool four threads each or more.
    """
    require_float64()
    found: dict[int, Fitted] = {}
    shapes: dict[Shape, list[int]] = {}
    for place, unit in enumerate(units):
        if _get(unit.observations, "slow") is not None:  # it ties poses and turns that are not neighbours
            found[place] = _fit_by_recipe(unit)
        else:
            shapes.setdefault(shape_of(unit), []).append(place)
    for shape, places in shapes.items():
        left, stacked = places, _Stacked()
        for passes in _PASSES:
            places, left = left, []
            while places:
                few, many = (size * len(_devices()) for size in _CHUNKS[shape.gyroscope])
                size = many if 2 * len(places) > many else few
                part, places = places[:size], places[size:]
                fitted = _fit_chunk([units[place] for place in part], shape, passes, stacked)
                found |= zip(part, fitted, strict=True)
                left += [place for place, each in zip(part, fitted, strict=True) if not each.converged]
        for place in left:
            found[place] = _fit_by_recipe(units[place])
    return [found[place] for place in range(len(units))]


class _Stacked:
    """Memory for the arrays of a chunk: aligned as JAX wants it, which then makes no copy, and not asked for anew."""

    def __init__(self):
        self.buffers: dict[tuple, np.ndarray] = {}

    def __call__(self, place: int, arrays: Sequence[np.ndarray], size: int) -> np.ndarray:
        """Return arrays (one shape) as one of `size`, the last repeated; it lasts until the place's next call."""
        like = arrays[0]
        key = place, size, like.shape
        if key not in self.buffers:
            memory = np.empty(size * like.nbytes + _ALIGNMENT, np.uint8)
            memory = memory[-memory.ctypes.data % _ALIGNMENT :][: size * like.nbytes]
            self.buffers[key] = memory.view(like.dtype).reshape(size, *like.shape)
        return np.stack([*arrays, *[arrays[-1]] * (size - len(arrays))], out=self.buffers[key])


def _fit_chunk(units: Sequence[FleetUnit], shape: Shape, passes: int, stacked: _Stacked) -> list[Fitted]:
    gyroscope, poses, samples, block = shape
    devices = len(_devices())
    size = devices * next(size for size in _CHUNKS[gyroscope] if devices * size >= len(units))
    arrays = [_arrays(unit.observations, gyroscope, poses, samples) for unit in units]
    batch = [stacked(place, each, size) for place, each in enumerate(zip(*arrays, strict=True))]
    scales = _scales([unit.nominal for unit in units])
    padded = [np.concatenate([each, np.repeat(each[-1:], size - len(units), axis=0)]) for each in scales]
    if devices > 1:
        found = _over_devices(gyroscope, block)(np.asarray(passes), padded, batch)
    else:
        description = f"fleet {gyroscope} {block}"
        program = partial(_program, gyroscope, block)
        found = stored.call(program, description, np.asarray(passes), padded, batch, quick=False)
    return _fitted(jax.tree.map(lambda leaf: np.asarray(leaf)[: len(units)], found), scales, units)


@cache
def _devices() -> list[Any]:
    """Local devices that share a chunk.

    Those that XLA makes of one CPU run on threads of one pool, and a loop holds its thread while others do its work: a
    pool that is not larger by far waits for itself for ever, so that then one device does it all.
    """
    devices = jax.local_devices()
    if devices[0].platform == "cpu" and _pool_threads() < 4 * len(devices):
        return devices[:1]
    return devices


def _pool_threads() -> int:
    """Threads of XLA's pool on the CPU: what NPROC says, or a core each."""
    stated = os.environ.get("NPROC", "")
    return int(stated) if stated.isdigit() else len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else 1


@cache
def _over_devices(gyroscope: bool, block: int):
    """The same program with the units spread over all local devices, each of which stops when its own are done."""
    mesh = Mesh(np.array(_devices()), ("units",))
    none, units = PartitionSpec(), PartitionSpec("units")
    program = partial(_program, gyroscope, block)
    return jax.jit(jax.shard_map(program, mesh=mesh, in_specs=(none, units, units), out_specs=units, check_vma=False))


def _arrays(observations: Observations, gyroscope: bool, count: int, samples: int) -> list[np.ndarray]:
    """What a fit needs of a unit, with padding cut off or added: P poses, S samples a turn."""
    poses, turns = _get(observations, "poses"), _get(observations, "turns")
    found = [_get(observations, "gravity")]
    found += [resized(_get(poses, name), count) for name in ("mask", "accelerometer_mean", "accelerometer_covariance")]
    if gyroscope:
        steps = count - 1
        found += [resized(_get(poses, name), count) for name in ("gyroscope_mean", "gyroscope_covariance")]
        found += [_get(turns, "noise"), *(resized(_get(turns, name), steps) for name in ("mask", "basis"))]
        found += [resized(_get(turns, name), steps, samples) for name in ("interval", "output")]
    return found


def _program(gyroscope: bool, block: int, passes, scales, batch) -> Lanes:
    def observations(scales, gravity, used, mean_a, covariance_a, *rest):
        if not gyroscope:
            turns = len(used) - 1
            rest = [jnp.zeros_like(each) for each in (mean_a, covariance_a, covariance_a[0])]
            rest += [jnp.zeros((turns, *shape)) for shape in ((), (2, 3), (0,), (0, 3))]
        mean_g, covariance_g, noise, turned, basis, interval, output = rest
        clock = jnp.zeros_like(used, float)
        poses = Poses(mean_a, covariance_a, mean_g, covariance_g, clock, clock, clock, used)
        return _in_si(Observations(poses, Turns(output, interval, noise, basis, turned > 0), gravity), *scales)

    seen = jax.vmap(observations)(scales, *batch)
    return fit_lanes(gyroscope, block, parameter_set(gyroscope)[1], seen, passes)


def _fit_by_recipe(unit: FleetUnit) -> Fitted:
    """Fit one unit by `fit_hand_held`, which integrates every sample in every step and knows of slow noise."""
    fit = fit_hand_held(unit.nominal, unit.observations, "joint" if unit.gyroscope else "accelerometer")
    kinds = ("gravity_norm", "gravity_direction", "static_gyroscope")
    rms = residual_rms(fit.imu, unit.observations, unit.gyroscope)
    jacobian = np.asarray(fit.jacobian)
    return Fitted(
        unit.nominal,
        unit.gyroscope,
        np.concatenate([np.ravel(leaf) for leaf in jax.tree.leaves(fit.imu)]),
        fit.names,
        np.asarray(fit.covariance),
        np.asarray(fit.magnitude_sensitivity),
        jacobian.T @ jacobian,
        np.asarray(fit.excess),
        np.array([rms[kind][0] if kind in rms else 0.0 for kind in kinds]),
        bool(fit.converged),
        bool(fit.finite),
    )


def _scales(nominals: Sequence[Imu]) -> list[FloatArray]:
    """Scales and offsets (N, 3) of the accelerometer, then of the gyroscope, as the data sheets have them."""
    parts = []
    for name in ("accelerometer", "gyroscope"):
        triads = [_get(nominal, name) for nominal in nominals]
        gain = np.array([_get(triad, "gain") for triad in triads])
        parts += [np.sqrt((gain**2).sum(axis=2)), np.array([_get(triad, "bias") for triad in triads])]
    return parts


def _in_si(observations: Observations, scale_a, offset_a, scale_g, offset_g) -> Observations:
    """Bring observations (and scales) with any leading axes to what the data sheet makes of them.

    All units then share one start and one scaling.
    """
    poses, turns = observations.poses, observations.turns

    def mean(values, scale, offset):
        return (values - offset[..., None, :]) / scale[..., None, :]

    def square(values, scale):
        return values / (scale[..., :, None] * scale[..., None, :])

    changed = (
        mean(poses.accelerometer_mean, scale_a, offset_a),
        square(poses.accelerometer_covariance, scale_a[..., None, :]),
        mean(poses.gyroscope_mean, scale_g, offset_g),
        square(poses.gyroscope_covariance, scale_g[..., None, :]),
        mean(turns.output, scale_g[..., None, :], offset_g[..., None, :]),
        square(turns.noise, scale_g),
    )
    return eqx.tree_at(
        lambda o: (
            o.poses.accelerometer_mean,
            o.poses.accelerometer_covariance,
            o.poses.gyroscope_mean,
            o.poses.gyroscope_covariance,
            o.turns.output,
            o.turns.noise,
        ),
        observations,
        changed,
    )


def _fitted(lanes: Lanes, scales: Sequence[np.ndarray], units: Sequence[FleetUnit]) -> list[Fitted]:
    """Bring what a program found back into output units: row i of a gain, entry i of a bias by the scale of axis i."""
    scale_a, offset_a, scale_g, offset_g = scales
    _, parameters = parameter_set(units[0].gyroscope)
    index, size, count = list(parameters.index), np.asarray(parameters.size), len(units)
    factor = np.concatenate([np.repeat(scale_a, 3, axis=1), scale_a, np.repeat(scale_g, 3, axis=1), scale_g], axis=1)
    offset = np.zeros_like(factor)
    offset[:, 9:12], offset[:, 21:] = offset_a, offset_g
    numbers = np.tile(np.asarray(parameters.reference), (count, 1))
    numbers[:, index] += size * lanes.z
    numbers = numbers * factor + offset
    factor = factor[:, index] * size
    covariance = lanes.covariance * factor[:, :, None] * factor[:, None, :]
    gravity, converged, finite = lanes.gravity * factor, lanes.converged.tolist(), lanes.finite.tolist()
    return [
        Fitted(unit.nominal, unit.gyroscope, numbers[k], parameters.names, covariance[k], gravity[k],
               lanes.information[k], lanes.excess[k], lanes.rms[k], converged[k], finite[k])
        for k, unit in enumerate(units)
    ]  # fmt: skip
