"""What is wrong with a set-up: errors of known size, and what stations observe where they are there.

Every error is a number that is zero if nothing is wrong; `Scheme.observed` is the whole simulation as a function of all
of them, differentiable. A source of error is a matrix that makes errors of independent standard normal draws.
"""

from __future__ import annotations

import difflib
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int
from scipy.linalg import block_diag
from scipy.spatial.transform import Rotation

from jaximu.data.observe_stations import TYPICAL_NOISE, scheme_stations
from jaximu.ground.array_types import Array, FloatArray, IntArray
from jaximu.ground.document import Json, read_toml
from jaximu.ground.errors import FilePath, InputError, NotPossibleError, only
from jaximu.ground.rotation import UP, apply_matrix, conjugate, exponential, logarithm, multiply, right_jacobian, rotate
from jaximu.ground.units import INERTIAL_QUANTITIES, PREFIXES, SENSOR_UNITS
from jaximu.model import AxisNoise, BiasInstability, parse_quantity
from jaximu.model.effects import CATALOGUE, Effect
from jaximu.model.effects.earth_rotation import EARTH_RATE
from jaximu.model.processes import MEMBER_VARIANCE
from jaximu.model.sensor import Imu
from jaximu.model.stimulus import Stimulus
from jaximu.planning.information import root_of
from jaximu.recordings.entry import ScheduleEntry, times_of
from jaximu.recordings.observations import Stations
from jaximu.simulation import Case, Specification
from jaximu.simulation.protocols import Environment, Motion, Plan
from jaximu.simulation.specification import Draw

_TURN_ONLY = ("rate-table", "single-axis-table")  # their angle about the vertical is all that is set
_FLICKER_INTERVAL = 0.01  # s; flicker noise faster than this averages out like white noise


@dataclass(frozen=True)
class ErrorSource:
    """One error of the set-up, or of the unit.

    size: as it was stated. value, unit: its standard deviation in SI where one number says it, else None. root (n, k):
    the errors (see `Scheme`) that k independent standard normal draws make.
    """

    name: str
    words: str
    size: str
    value: float | None
    unit: str
    root: FloatArray

    def draw(self, rng: np.random.Generator, count: int) -> FloatArray:
        """Return errors (count, n) drawn from this source."""
        normal = rng.standard_normal((count, self.root.shape[1]))
        if self.name == "earth_rotation":  # its size is known; only the heading is not
            heading = rng.uniform(0, 2 * np.pi, count)
            normal = np.stack([np.sqrt(2) * np.cos(heading), np.sqrt(2) * np.sin(heading), np.ones(count)], axis=1)
        return normal @ self.root.T


# --- the specification ------------------------------------------------------------------------------------------------

_ANGLE, _NONE = "rad", "1"
_SINGLE = {
    "tilt": _ANGLE,
    "angle_setting": _ANGLE,
    "mounting": _ANGLE,
    "orthogonality": _ANGLE,
    "gravity": "m/s^2",
    "rate": _NONE,
    "timing": "s",
}
_TABLES = {
    "drift": {"accelerometer": "m/s^3", "gyroscope": "rad/s^2"},
    "temperature": {"accelerometer": "m/s^2/K", "gyroscope": "rad/s/K", "span": "K"},
    "vibration": {"rms": "m/s^2", "rectification": "rad*s^3/m^2", "noise": "rad/s/sqrt(Hz)"},
}
_ERRORS = (*_SINGLE, *_TABLES, "earth_rotation", "truncated")
_WORDS = {
    "tilt": "tilt of the table",
    "angle_setting": "angle setting",
    "mounting": "mounting",
    "orthogonality": "orthogonality of axes",
    "gravity": "local gravity",
    "rate": "rate or angle scale",
    "timing": "timing",
    "earth_rotation": "Earth's rotation ignored",
    "drift": "drift",
    "temperature": "temperature",
    "vibration": "vibration in turns",
    "noise": "white noise",
    "bias_instability": "bias instability",
}


StatedErrors = Mapping[str, tuple[Any, str]]
"""By name, sizes of errors in SI and the text that stated them."""


@dataclass(frozen=True)
class Task:
    """A specification read for a budget: the unit and its scheme, sizes of errors in SI with the text that stated them,
    effects that are fitted as well, goals (what, how much).
    """

    case: Case
    environment: Environment
    errors: StatedErrors
    fitted: tuple[str, ...]
    goals: tuple[tuple[str, str], ...]
    name: str


def read_task(path: FilePath) -> Task:
    """Read and check a specification with its errors and goals.

    Raises `InputError`, naming file and key, for anything that is not understood.
    """
    return task(read_toml(path), os.fspath(path))


def task(document: Mapping[str, Any], name: str = "specification") -> Task:
    """Check a specification that was read already; as [`read_task`]."""
    extra = ("errors", "goal", "fitted")
    for key in document:
        if key not in extra and (near := difflib.get_close_matches(key, extra, n=1, cutoff=0.75)):
            raise InputError(f"{name}: unknown key {key!r}; did you mean {near[0]!r}?")
    specification = Specification({key: value for key, value in document.items() if key not in extra}, name)
    fitted = document.get("fitted", [])
    if not isinstance(fitted, list):
        raise InputError(f"{name}: fitted must be a list of effects, found {fitted!r}.")
    only({str(effect): None for effect in fitted}, CATALOGUE, name, "fitted")
    goals = document.get("goal", {})
    if not isinstance(goals, dict):
        raise InputError(f'{name}: goal must be a table such as [goal] "accelerometer.bias" = "0.2 mg".')
    if "errors" not in document:
        raise InputError(f"{name}: there is no [errors] table; its keys are {', '.join(_ERRORS)}.")
    errors = _errors(document["errors"], name, document.get("environment", {}))
    stated = tuple((str(key), str(value)) for key, value in goals.items())
    environment = specification.environment_of(Draw(specification.seed, 0))
    return Task(specification.case(0), environment, errors, tuple(fitted), stated, name)


def _stated(errors: StatedErrors, name: str) -> dict[str, float]:
    """The sizes of a table of errors, SI; empty where it is not stated."""
    return errors.get(name, ({}, ""))[0]


def quantity(value: Any, unit: str, where: str) -> float:
    """Return a size in SI.

    Raises `InputError`, saying `where`, for another unit and for a size below zero.
    """
    if isinstance(value, bool) or not isinstance(value, int | float | str):
        raise InputError(f"{where} must be a number or text with a unit such as {unit}, found {value!r}.")
    parsed = parse_quantity(value, unit, where)
    if not np.isfinite(parsed) or parsed < 0:
        raise InputError(f"{where} is a standard deviation: it must be finite and not negative, found {value!r}.")
    return parsed


def _errors(table: Any, name: str, environment: Mapping[str, Any]) -> Json:
    sizes_of = {}
    latitude = "latitude" in environment
    for key, value in only(table, _ERRORS, name, "[errors]").items():
        where = f"{name}: errors.{key}"
        if key in _SINGLE:
            sizes_of[key] = quantity(value, _SINGLE[key], where), str(value)
        elif key in _TABLES:
            entries = only(value, _TABLES[key], name, f"errors.{key}")
            sizes = {part: quantity(size, _TABLES[key][part], f"{where}.{part}") for part, size in entries.items()}
            sizes_of[key] = sizes, ", ".join(f"{part} {size}" for part, size in entries.items())
        elif key == "earth_rotation":
            if value not in ("ignored", "modelled"):
                raise InputError(f"{where} must be 'ignored' or 'modelled', found {value!r}.")
            if not latitude:
                raise InputError(f"{where}: how the Earth turns depends on the latitude; state it in [environment].")
        else:
            effects = [effect for effect, kind in CATALOGUE.items() if kind.owner in INERTIAL_QUANTITIES]
            for effect, stated in only(value, effects, name, "[errors.truncated]").items():
                entry = f"{where}.{effect}"
                kind = CATALOGUE[effect]
                unit = kind.coefficient_unit(SENSOR_UNITS[kind.owner])
                sizes = stated if isinstance(stated, list) else [stated] * kind.size
                if len(sizes) != kind.size:
                    raise InputError(f"{entry} must be {kind.size} sizes or one, found {len(sizes)}.")
                sizes_of[effect] = np.array([quantity(one, unit, entry) for one in sizes]), f"{stated} {unit}"
    if latitude and table.get("earth_rotation", "ignored") == "ignored":
        sizes_of["earth_rotation"] = float(environment["latitude"]), f"latitude {environment['latitude']}°"
    vibration = _stated(sizes_of, "vibration")
    if ("rectification" in vibration) != ("rms" in vibration):
        raise InputError(f"{name}: errors.vibration: rms and rectification go together.")
    knots = isinstance(environment.get("temperature"), list)
    if "temperature" in sizes_of and knots == ("span" in sizes_of["temperature"][0]):
        text = "both are there; leave one out" if knots else "neither is there"
        raise InputError(f"{name}: errors.temperature needs a span, or a path [environment] temperature: {text}.")
    return sizes_of


# --- the set-up and what its errors do --------------------------------------------------------------------------------


class ErrorScheme(eqx.Module):
    """What the stations go through, and the n errors that may be in it.

    Errors are, one after the other: how late the schedule is against the log (s); how far the unit's attitude is off at
    A stops (rotation vectors, rad, body frame); the coefficients of `effects`; what is added to the mean outputs
    (6, S), axis by axis. `ends`: stops at which a station begins and ends; `done`, `pace`: how much of a turn is done
    at its nodes, and its rate of change (1/s); `power`: of the vibration, (m/s²)².
    """

    unit: Imu
    effects: tuple[Effect, ...]
    stations: Stations
    motion: Motion
    ends: Int[Array, "S 2"]
    done: Float[Array, "S Q"]
    pace: Float[Array, "S Q"]
    power: Float[Array, "S Q"]
    stops: int = eqx.field(static=True)

    @property
    def sizes(self) -> tuple[int, int, int, int]:
        """How many errors of each kind."""
        return 1, 3 * self.stops, sum(effect.size for effect in self.effects), 6 * self.stations.turn.shape[0]

    @property
    def simulated(self) -> int:
        """How many errors act by the simulation: all but what is added."""
        return sum(self.sizes[:3])

    def stimulus(self, delay: Float[Array, ""] | float, turned: Float[Array, "A 3"]) -> Stimulus:
        """Return what the unit goes through where stations begin `delay` (s) and its attitude is off by `turned` at the
        stops, and between in proportion to how much of a turn is done.
        """
        stations = self.stations
        nodes = self.done.shape[1]
        step = jnp.where(stations.stop > stations.start, stations.stop - stations.start, 1.0) / nodes
        edges = stations.start[:, None] + delay + step[:, None] * jnp.arange(nodes + 1)
        edge = self.motion.attitude_at(edges.ravel()).reshape(*edges.shape, 4)
        middle = (edges[:, 1:] + edges[:, :-1]) / 2
        attitude = self.motion.attitude_at(middle.ravel()).reshape(*middle.shape, 4)
        rate = logarithm(multiply(conjugate(edge[:, :-1]), edge[:, 1:])) / step[:, None, None]
        up = jnp.broadcast_to(UP, rate.shape)

        begin, end = turned[self.ends[:, 0]][:, None], turned[self.ends[:, 1]][:, None]
        off = begin + self.done[..., None] * (end - begin)
        # R exp(off) has the body rate exp(−off) ω + J_r(off) d(off)/dt
        moving = apply_matrix(right_jacobian(off), self.pace[..., None] * (end - begin))
        attitude = multiply(attitude, exponential(off))
        return replace(
            stations.stimulus,
            specific_force=stations.gravity * rotate(conjugate(attitude), up),
            angular_rate=rotate(conjugate(exponential(off)), rate) + moving,
            attitude=attitude,
            vibration_power=self.power,
        )

    def means(self, errors: Float[Array, " n"]) -> Float[Array, "2 S 3"]:
        """Return the mean outputs, accelerometer's first, where the set-up has these errors (those simulated)."""
        delay, turned, coefficients = jnp.split(errors, np.cumsum(self.sizes[:2]))
        first = np.cumsum([0, *(effect.size for effect in self.effects)])
        parts = [coefficients[low:high] for low, high in pairwise(first)]
        outputs = with_effects(self.unit, self.effects, parts).respond(self.stimulus(delay[0], turned.reshape(-1, 3)))
        return jnp.stack([jnp.sum(self.stations.weight[..., None] * output, axis=-2) for output in outputs])


def with_effects(unit: Imu, effects: Sequence[Effect], coefficients: Sequence[Array]) -> Imu:
    """Return the unit with more effects beside those it has."""
    made = [
        eqx.tree_at(lambda e: e.coefficients, effect, values)
        for effect, values in zip(effects, coefficients, strict=True)
    ]
    return unit.with_effects(*unit.all_effects().values(), *made)


def _stops(intervals: tuple[ScheduleEntry, ...], motion: Motion) -> tuple[FloatArray, IntArray, IntArray]:
    """Where the table is set: body directions (A, 3) that point up, which setting of the axes that are not vertical
    (A,); and at which stops an interval begins and ends (S, 2).
    """
    segment = np.searchsorted(motion.start, [interval.start + 1e-9 for interval in intervals], side="right") - 1
    begin = [Rotation.from_quat(motion.attitude[row], scalar_first=True) for row in segment]
    up = []
    setting = []
    ends = []
    last: Rotation | None = None

    def stop(attitude: Rotation, new: bool) -> None:
        up.append(attitude.inv().apply([0.0, 0.0, 1.0]))
        setting.append((setting[-1] + new) if setting else 0)

    for interval, attitude in zip(intervals, begin, strict=True):
        if last is None or (last.inv() * attitude).magnitude() > 1e-6:  # moved meanwhile
            stop(attitude, True)
        first, last = len(up) - 1, attitude
        if interval.kind == "turn":
            last = attitude * Rotation.from_rotvec(interval.angle * interval.vector)
            stop(last, abs(attitude.apply(interval.vector)[2]) < 1 - 1e-9)
        ends.append((first, len(up) - 1))
    return np.array(up), np.array(setting), np.array(ends)


def _attitude_roots(up: FloatArray, setting: IntArray, kind: str) -> dict[str, FloatArray]:
    """How unit draws of each kind of error turn the unit at the stops: (3 A, k)."""
    count = len(up)
    member = setting[:, None] == np.arange(int(setting.max()) + 1)  # (A, settings)
    across = np.eye(3) - up[:, :, None] * up[:, None, :]
    about = np.eye(count)[:, None, :] * up[:, :, None]  # (A, 3, A)
    others = np.einsum("aij,as->aisj", across, member).reshape(count, 3, -1)
    mounted = np.ones((count, 1)) if kind == "dividing-head" else member  # one mounting
    mounting = np.einsum("as,ij->aisj", mounted, np.eye(3)).reshape(count, 3, -1)
    polar = np.arccos(np.clip(up[:, 2], -1, 1))
    azimuth = np.where(np.hypot(up[:, 0], up[:, 1]) < 1e-9, 0.0, np.arctan2(up[:, 1], up[:, 0]))
    turned = Rotation.from_euler("z", azimuth[:, None])
    tilting = turned.apply(np.stack([np.cos(polar), np.zeros(count), -np.sin(polar)], axis=1))
    roots = {
        "angle_setting": about if kind in _TURN_ONLY else np.concatenate([about, others], axis=2),
        "mounting": mounting,
        "orthogonality": np.stack([tilting, turned.apply([1.0, 0.0, 0.0])], axis=2),
    }
    return {name: np.asarray(root.reshape(3 * count, -1), np.float64) for name, root in roots.items()}


def _mean_covariances(squares: Mapping[str, FloatArray], start: FloatArray, stop: FloatArray):
    """Covariances (3, n, n), SI², of means by white noise and by slow bias; squares: of the terms, by letter."""
    none = np.zeros(3)
    fast = replace(AxisNoise.of_white(squares["N"]), quantisation=squares.get("Q", none))
    times = BiasInstability(1.0).bank(_FLICKER_INTERVAL)
    flicker = np.outer(MEMBER_VARIANCE * squares.get("B", none), np.ones(len(times)))

    # of a walk, the means of min(s, t) = (s + t)/2 − |s − t|/2; the latter's second integral is −|h|³/12
    def cube(first, second):
        return np.abs(second[None, :] - first[:, None]) ** 3 / 12

    apart = cube(start, start) + cube(stop, stop) - cube(start, stop) - cube(stop, start)
    shared = np.add.outer(start + stop, start + stop) / 4 + apart / np.outer(stop - start, stop - start)
    walk = squares.get("K", none)[:, None, None] * shared
    return fast.covariance(start, stop), AxisNoise(none, none, flicker, times).covariance(start, stop) + walk


def scheme_and_sources(task: Task) -> tuple[ErrorScheme, tuple[ErrorSource, ...], tuple[str, ...]]:
    """Return the scheme, its sources of error, and notes on what was assumed.

    Raises `NotPossibleError` for a protocol whose poses and turns are not known.
    """
    case, errors, environment = task.case, task.errors, replace(task.environment, latitude=None)
    protocol = case.protocol
    assert protocol is not None
    if not protocol.reference:
        raise NotPossibleError(
            f"{task.name}: a budget needs poses and turns that a table knows, and the protocol {protocol.kind} has "
            "none: take positions, dividing-head, single-axis-table or rate-table."
        )
    temperature = _stated(errors, "temperature")
    if "span" in temperature:
        knots = ((0.0, 25.0), (case.plan.motion.length, 25.0 + temperature["span"]))
        environment = replace(environment, temperature=knots)
    plan = protocol.plan(np.random.default_rng(0), environment)
    stations = scheme_stations(protocol, case.imu, TYPICAL_NOISE, environment)
    size = stations.turn.shape[0]
    stations, fast, slow, ramps, notes = _with_noise(case, stations, plan.intervals)

    effects = _effects_by_source(errors, case.imu, ramps)
    up, setting, ends = _stops(plan.intervals, plan.motion)
    kinds = tuple(effect for group in effects.values() for effect, _ in group)
    scheme = _scheme(case.imu, plan, kinds, stations, ends, len(up), _stated(errors, "vibration").get("rms", 0.0))
    delay, turned, coefficient, added = np.cumsum([0, *scheme.sizes])[:4]  # where each kind of error begins
    roots = {}

    def add(name: str, block: FloatArray, first: int) -> None:
        root = np.zeros((sum(scheme.sizes), block.shape[1]))
        root[first : first + len(block)] = block
        root = np.concatenate([roots[name], root], axis=1) if name in roots else root
        roots[name] = root[:, np.any(root != 0, axis=0)]

    for name, root in _attitude_roots(up, setting, protocol.kind).items():
        if name in errors:
            add(name, errors[name][0] * root, turned)
    if "timing" in errors:
        add("timing", np.array([[errors["timing"][0]]]), delay)
    for name, group in effects.items():
        sizes = np.concatenate([size for _, size in group])
        add(name, np.diag(sizes), coefficient)
        coefficient += len(sizes)
    if shaken := _stated(errors, "vibration").get("noise", 0.0):
        during = np.asarray(stations.turn & stations.gyroscope_used) / np.sqrt(_durations(stations))
        scale = case.imu.triads()["gyroscope"].scales
        add("vibration", np.diag((shaken * scale[:, None] * during).ravel()), added + 3 * size)
    for name, covariances in (("noise", fast), ("bias_instability", slow)):
        add(name, np.asarray(block_diag(*root_of(covariances))), added)

    return scheme, tuple(_source(errors, name, root) for name, root in roots.items() if root.size), notes


def _source(errors: StatedErrors, name: str, root: FloatArray) -> ErrorSource:
    value, text = errors.get(name, (None, "by the noise"))
    single = value if name in _SINGLE else None
    return ErrorSource(name, _WORDS.get(name, f"{name} not modelled"), text, single, _SINGLE.get(name, ""), root)


def _durations(stations: Stations) -> FloatArray:
    """Durations (S,), s; one for padding."""
    duration = np.asarray(stations.stop) - np.asarray(stations.start)
    return np.where(duration > 0, duration, 1.0)


def noise_squares(case: Case, triad: str) -> dict[str, FloatArray]:
    """Return the squares (3,), SI, of the sizes of the noise terms that are stated for a triad, by letter."""
    return case.noise[triad].squares() if triad in case.noise else {}


def _with_noise(case: Case, stations: Stations, intervals: Sequence[ScheduleEntry]):
    """The stations with the covariances of the noise that is stated; those (6, S, S) of its white part and of its slow
    bias, zero where not used; rate ramps (3,), SI, by triad; notes.
    """
    span = times_of(intervals)
    count = len(span)
    size = stations.turn.shape[0]
    notes, ramps, fast, slow = [], {}, np.zeros((6, size, size)), np.zeros((6, size, size))
    used = {"accelerometer": stations.accelerometer_used, "gyroscope": stations.gyroscope_used}
    for number, (name, triad) in enumerate(case.imu.triads().items()):
        squares = noise_squares(case, name)
        if "N" not in squares:
            density = squares["N"] = getattr(TYPICAL_NOISE, name).white
            unit = "m/s²/√Hz" if name == "accelerometer" else "rad/s/√Hz"
            notes.append(f"no white noise is stated for the {name}: {np.sqrt(density[0]):.2g} {unit} is assumed.")
        parts, ramps[name] = _mean_covariances(squares, *span.T), np.sqrt(squares.get("R", np.zeros(3)))
        scale = triad.scales[:, None, None]
        there = np.asarray(used[name])[:count]
        for whole, part in zip((fast, slow), parts, strict=True):
            whole[3 * number : 3 * number + 3, :count, :count] = np.where(there[:, None] & there, part * scale**2, 0.0)
    total = fast + slow
    total += np.concatenate([np.tile(~np.asarray(mask), (3, 1)) for mask in used.values()])[:, :, None] * np.eye(size)
    stations = replace(stations, accelerometer_covariance=total[:3], gyroscope_covariance=total[3:])
    return stations, fast, slow, ramps, tuple(notes)


def _effects_by_source(errors: StatedErrors, unit: Imu, ramps: Mapping[str, FloatArray]):
    """By source: effects that make its errors, each with the sizes of its coefficients."""

    def effect(name: str, sizes) -> tuple[Effect, FloatArray]:
        made = CATALOGUE[name].dormant()
        scale = np.ones(made.size)
        if made.unit.startswith("output"):  # stated for an SI output
            axes = unit.triads()[made.owner].scales
            scale = np.repeat(axes, made.size // 3) if made.size % 3 == 0 else np.full(made.size, axes.mean())
        return made, scale * np.broadcast_to(sizes, (made.size,))

    setup = {"tilt": "setup.table_tilt", "gravity": "setup.gravity", "rate": "setup.table_rate_scale"}
    sources = {source: [effect(name, errors[source][0])] for source, name in setup.items() if source in errors}
    if "earth_rotation" in errors:
        latitude = np.radians(errors["earth_rotation"][0])
        level = np.cos(latitude) / np.sqrt(2)
        sources["earth_rotation"] = [
            effect("gyro.earth_rotation", EARTH_RATE * np.abs([level, level, np.sin(latitude)]))
        ]
    drifts, temperature = (_stated(errors, name) for name in ("drift", "temperature"))
    drifts = {name: np.hypot(drifts.get(name, 0.0), ramp) for name, ramp in ramps.items()}
    for source, stem, sizes in (("drift", "bias_ramp", drifts), ("temperature", "temperature", temperature)):
        sources[source] = [effect(f"{PREFIXES[name]}.{stem}", sizes.get(name, 0.0)) for name in INERTIAL_QUANTITIES]
    rectified = _stated(errors, "vibration").get("rectification", 0.0)
    sources["vibration"] = [effect("gyro.vibration_rectification", rectified)]
    sources |= {name: [effect(name, size)] for name, (size, _) in errors.items() if name in CATALOGUE}
    return {
        source: kept for source, pairs in sources.items() if (kept := [(e, size) for e, size in pairs if size.any()])
    }


def _scheme(
    unit: Imu, plan: Plan, effects: tuple[Effect, ...], stations: Stations, ends: IntArray, stops: int, rms: float
) -> ErrorScheme:
    """Return the scheme of a plan. **Arguments:** `rms`: of the vibration, m/s²."""
    count = len(ends)
    size = stations.turn.shape[0]
    whole, axis, angle = np.zeros((size, 2), np.int64), np.zeros((size, 3)), np.full(size, np.inf)
    whole[:count], axis[:count] = ends, [interval.vector for interval in plan.intervals]
    angle[:count] = [interval.angle if interval.kind == "turn" else np.inf for interval in plan.intervals]
    pace = np.einsum("sqi,si->sq", np.asarray(stations.stimulus.angular_rate), axis) / angle[:, None]
    done = (pace.cumsum(axis=1) - pace / 2) * (_durations(stations) / pace.shape[1])[:, None]
    power = np.where(np.asarray(stations.turn)[:, None], rms**2, np.zeros_like(pace))
    return ErrorScheme(unit, effects, stations, plan.motion, whole, done, pace, power, stops)
