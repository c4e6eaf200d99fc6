"""Recordings of simulated units with effects hidden in them by their physics, to be found from the files alone.

NumPy, SciPy and PyArrow only; nothing comes from the library under test. `draw_case` draws a unit, its motion, noise
and hidden effects from a seed; `Case.write` writes what a user would have: a recording to fit, a held-out one, and one
at rest.

Conventions. SI units; body frame of the accelerometer; level frame with z up; specific force at rest is +g on what
points up. y = K u + b + Σ effects + noise, on the true specific force or rate u. A sample stamped t is the mean of its
sensor's output over [t − Δt/2, t + Δt/2]. Inside it physics runs in sub-steps; the rate is constant within each, so an
attitude is an exact product of exponentials, and each leg of a turn keeps its axis, so that the sampled rate integrates
exactly too; with `two_axes` the axis moves, and a sub-step has the mean of the rate. Temperatures act as T − 25 °C.
"""

import sys
import tempfile
import time
import zlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property, lru_cache
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from scipy.signal import lfilter
from scipy.spatial.transform import Rotation

SESSIONS = {"fit": 10, "heldout": 11, "static": 12} | {f"power-on {k}": 12 + k for k in range(1, 9)}  # a stream each
REFERENCE_TEMPERATURE = 25.0  # °C
EARTH_RATE = 7.292115e-5  # rad/s
GRAVITY = 9.80665  # m/s²
WHITE = {"accel": 100e-6 * GRAVITY, "gyro": np.radians(0.005)}  # root of the two-sided density, (m/s²)/√Hz, (rad/s)/√Hz
FLICKER = {"accel": 20e-6 * GRAVITY, "gyro": np.radians(5.0) / 3600}  # B: two-sided density B²/(2π|f|); m/s², rad/s
RANGE = {"accel": 4 * GRAVITY, "gyro": np.radians(500.0)}  # full scale of a 16-bit output, m/s², rad/s
FLICKER_SPAN = 13107.2  # s: flicker noise is flat below its inverse; 2^17 samples at 10 Hz
FASTEST = 6.5  # rad/s; turns are slowed down to stay below it


# Motion ---------------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Protocol:
    """What is done with the unit. Durations in s, rate in Hz, gravity in m/s²; `temperature`: see `draw_case`."""

    seed: int
    poses: int = 40
    pose_duration: float = 4.0
    turn_duration: float = 1.5
    rate: float = 100.0
    static_minutes: float = 60
    temperature: bool | str = False
    first_pose_duration: float | None = None
    oversampling: int = 4
    gravity: float = GRAVITY
    two_axes: bool = False
    flicker: float = 1.0
    noise: float = 1.0

    def random(self, session: str, stream: int) -> np.random.Generator:
        return np.random.default_rng([self.seed, SESSIONS[session], stream])

    @property
    def layout(self) -> tuple[int, int, int]:
        """Samples of the first pose, of each later pose, and of the time allowed for a turn."""
        first = self.pose_duration if self.first_pose_duration is None else self.first_pose_duration
        return tuple(round(duration * self.rate) for duration in (first, self.pose_duration, self.turn_duration))

    @property
    def samples(self) -> int:
        first, pose, turn = self.layout
        return first + (self.poses - 1) * (pose + turn)

    @property
    def duration(self) -> float:
        return self.samples / self.rate


@dataclass(frozen=True, eq=False)
class World:
    """What truly happens in a session, in n sub-steps of `step` seconds; every array is constant within a sub-step."""

    session: str
    step: float
    time: np.ndarray  # (n,) s, the middle of each sub-step
    attitude: np.ndarray  # (n, 3, 3) body to level, in the middle of each sub-step
    rate: np.ndarray  # (n, 3) rad/s, body
    angular_acceleration: np.ndarray  # (n, 3) rad/s², body
    force: np.ndarray  # (n, 3) specific force, m/s², body
    temperature: np.ndarray  # (n,) °C
    poses: np.ndarray  # (P, 3, 3) attitudes at rest
    rests: np.ndarray  # (P, 2) first sample at rest and the one after the last
    duration: float  # s

    @property
    def warmth(self) -> np.ndarray:
        return self.temperature - REFERENCE_TEMPERATURE

    @property
    def temperature_rate(self) -> np.ndarray:
        """dT/dt, K/s."""
        return np.gradient(self.temperature, self.step)

    def in_body(self, level: np.ndarray) -> np.ndarray:
        """A constant vector of the level frame, as the turning body sees it (n, 3)."""
        return level @ self.attitude

    def sensed(self, sensor: str) -> np.ndarray:
        return self.force if sensor == "accel" else self.rate


def spread_attitudes(random: np.random.Generator, count: int) -> np.ndarray:
    """Attitudes (count, 3, 3), body to level: "up" spread evenly over the sphere, any heading, in any order."""
    index = np.arange(count) + 0.5
    height, turn = 1 - 2 * index / count, np.pi * (1 + np.sqrt(5)) * index
    ups = np.stack([np.cos(turn) * np.sqrt(1 - height**2), np.sin(turn) * np.sqrt(1 - height**2), height], axis=-1)
    ups = Rotation.random(rng=random).apply(random.permutation(ups))
    tilt = np.arccos(np.clip(ups[:, 2], -1, 1))
    lean = np.stack([ups[:, 1], -ups[:, 0], np.zeros(count)], axis=-1)  # up × z: turns "up" onto z
    lean *= (tilt / np.linalg.norm(lean, axis=1))[:, None]
    heading = Rotation.from_rotvec(random.uniform(-np.pi, np.pi, (count, 1)) * [0.0, 0.0, 1.0])
    return (heading * Rotation.from_rotvec(lean)).as_matrix()


def log(rotation: np.ndarray) -> np.ndarray:
    return Rotation.from_matrix(rotation).as_rotvec()


def exp(vector: np.ndarray) -> np.ndarray:
    return Rotation.from_rotvec(vector).as_matrix()


def minimum_jerk(count: int) -> tuple[np.ndarray, np.ndarray]:
    """Share of a way from rest to rest, and its derivative by share of the time, at the `count` + 1 edges."""
    s = np.linspace(0, 1, count + 1)
    return s**3 * (10 - 15 * s + 6 * s**2), 30 * s**2 * (1 - s) ** 2


def draw_legs(random: np.random.Generator, before: np.ndarray, after: np.ndarray) -> list[np.ndarray]:
    """Rotation vectors (rad) of the one or two turns about fixed body axes that lead from one attitude to another."""
    direct = log(before.T @ after)
    if random.random() < 0.5:
        return [direct]
    detour = random.standard_normal(3)
    detour *= random.uniform(0.3, 0.8) / np.linalg.norm(detour)
    between = before @ exp(random.uniform(0.35, 0.65) * direct) @ exp(detour)
    return [log(before.T @ between), log(between.T @ after)]


def bent_leg(now, leg, random: np.random.Generator, count: int, step: float):
    """Attitudes, mean rates and angular accelerations of a leg that leans aside half way, by up to a third of it."""
    inner = 16
    share = np.linspace(0, 1, count * inner + 1)
    aside = random.standard_normal(3)
    aside *= random.uniform(0.15, 0.35) * np.linalg.norm(leg) / np.linalg.norm(aside)
    way = minimum_jerk(count * inner)[0]
    edges = now @ exp(np.outer(way, leg)) @ exp(np.outer(64 * (share * (1 - share)) ** 3, aside))
    rate = log(edges[:-1].swapaxes(-1, -2) @ edges[1:]) * inner / step
    mean = rate.reshape(count, inner, 3).mean(axis=1)
    return edges[inner // 2 :: inner], mean, np.gradient(mean, step, axis=0)


@lru_cache(maxsize=4)
def simulate_world(protocol: Protocol, session: str) -> World:
    """Rests in evenly spread attitudes, turns from rest to rest between them, small shifts of place while turning."""
    random, fine = protocol.random(session, 0), protocol.oversampling
    first, pose, slot = protocol.layout
    step, count = 1 / (protocol.rate * fine), protocol.samples * fine
    time = (np.arange(count) + 0.5) * step - 0.5 / protocol.rate
    poses = spread_attitudes(random, protocol.poses)
    bends = protocol.random(session, 3)
    attitude = np.empty((count, 3, 3))
    rate, angular_acceleration, acceleration = np.zeros((3, count, 3))
    rests, start = [], 0
    for index in range(protocol.poses - 1):
        slot_start = first + index * (pose + slot)
        legs = draw_legs(random, poses[index], poses[index + 1])
        angles = np.array([np.linalg.norm(leg) for leg in legs])
        slowest_allowed = 1.875 * angles.sum() / FASTEST * protocol.rate  # 1.875: peak over mean of a minimum-jerk rate
        moving = round(max(slot * random.uniform(0.6, 1.0), slowest_allowed))
        if moving > slot:
            raise ValueError(
                f"turn_duration={protocol.turn_duration} s is too short to turn by {angles.sum():.1f} rad; take 1.4 s"
            )
        edge = slot_start + (slot - moving) // 2
        rests.append((start, edge))
        attitude[start * fine : edge * fine] = poses[index]
        # The unit is carried a little way while it turns; it stands still again at the end.
        moved, shift = slice(edge * fine, (edge + moving) * fine), random.standard_normal(3)
        shift *= random.uniform(0.02, 0.12) / np.linalg.norm(shift)
        speed = minimum_jerk(moving * fine)[1] / (moving * fine * step)
        acceleration[moved] = np.outer(np.diff(speed) / step, shift)
        lengths = [moving] if len(legs) == 1 else [n := round(moving * angles[0] / angles.sum()), moving - n]
        now = poses[index]
        for leg, length in zip(legs, lengths, strict=True):
            part = slice(edge * fine, (edge + length) * fine)
            way, speed = minimum_jerk(length * fine)
            if protocol.two_axes:
                attitude[part], rate[part], angular_acceleration[part] = bent_leg(now, leg, bends, length * fine, step)
                now, edge = now @ exp(leg), edge + length
                continue
            attitude[part] = now @ exp(np.outer((way[1:] + way[:-1]) / 2, leg))
            rate[part] = np.outer(np.diff(way) / step, leg)
            angular_acceleration[part] = np.outer(np.diff(speed) / (length * fine * step**2), leg)
            now, edge = now @ exp(leg), edge + length
        start = edge
    rests.append((start, protocol.samples))
    attitude[start * fine :] = poses[-1]
    acceleration[:, 2] += protocol.gravity
    force = np.einsum("nji,nj->ni", attitude, acceleration)
    temperature = draw_temperature(protocol.random(session, 1), protocol, time, step)
    rests = np.array(rests)
    return World(
        session, step, time, attitude, rate, angular_acceleration, force, temperature, poses, rests, protocol.duration
    )


def relax(values: np.ndarray, step: float, time_constant: float) -> np.ndarray:
    """State x at the end of each sub-step, of τ x' = value − x from equilibrium; exact for stepwise constant values."""
    kept = np.exp(-step / time_constant)
    start = kept * values[:1]
    return lfilter([1 - kept], [1, -kept], values, axis=0, zi=start)[0]


def draw_temperature(random: np.random.Generator, protocol: Protocol, time: np.ndarray, step: float) -> np.ndarray:
    """Temperature of the unit, °C: constant, a straight line, or as in a chamber whose setpoint changes four times."""
    share = time / protocol.duration
    if not protocol.temperature:
        return np.full_like(time, REFERENCE_TEMPERATURE)
    sign = random.choice([-1, 1])
    if protocol.temperature == "linear":
        return REFERENCE_TEMPERATURE + sign * random.uniform(8, 12) * (share - 0.5)
    switches = np.array([0.04, 0.34, 0.54, 0.78]) + random.uniform(-0.03, 0.03, 4)
    setpoints = REFERENCE_TEMPERATURE + sign * (np.array([-4, 7, 2, -6, 1]) + random.uniform(-1, 1, 5))
    chamber = relax(setpoints[np.searchsorted(switches, share)], step, 0.03 * protocol.duration)
    return relax(chamber, step, 0.08 * protocol.duration)


# Effects --------------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Kind:
    """How one effect works: `act(world, u, c, inner)` is what it adds (n, 3), for the true input u and coefficients c.

    `unit`: norm of c at scale one. `mask`: where c may differ from zero; its first axis is the output axis. `inner`:
    other numbers with lowest and highest value, in SI or as a share of the "duration". `at`: whether it changes the
    "input", ahead of gain and bias, or adds to the "output".
    """

    sensor: str
    act: Callable
    unit: float
    mask: np.ndarray
    meaning: str
    inner: dict[str, tuple] = field(default_factory=dict)
    at: str = "output"
    needs_temperature: bool = False
    single: bool = False  # always one coefficient, never a random direction
    positive: bool = False
    suite: str = "observable"  # or "blind", "nonlinear", "outside", "everyday"


@dataclass(frozen=True, eq=False)
class Hidden:
    """One hidden effect as drawn: `unit_coefficients` at scale one, and inner numbers that scale does not touch."""

    name: str
    unit_coefficients: np.ndarray
    inner: dict[str, float]
    scale: float = 1.0

    @property
    def coefficients(self) -> np.ndarray:
        return self.scale * self.unit_coefficients

    @property
    def size(self) -> float:
        """Norm of the coefficients, SI; what they multiply: `meaning`."""
        return float(np.linalg.norm(self.coefficients))

    @property
    def meaning(self) -> str:
        return KINDS[self.name].meaning

    @property
    def _largest(self) -> tuple:
        return np.unravel_index(np.argmax(np.abs(self.unit_coefficients)), self.unit_coefficients.shape)

    @property
    def axis(self) -> str:
        """The output axis with the largest coefficient; empty where the effect has none."""
        return "xyz"[self._largest[0]] if len(self.unit_coefficients) == 3 else ""

    @property
    def sign(self) -> int:
        return int(np.sign(self.coefficients[self._largest]))

    def added(self, world: World) -> np.ndarray:
        """What the effect adds in each sub-step (n, 3), m/s² or rad/s, ahead of the gain if it acts on the input."""
        kind = KINDS[self.name]
        return kind.act(world, world.sensed(kind.sensor), self.coefficients, self.inner)


EACH, ALL = np.ones(3), np.ones((3, 3))
LOWER, OTHERS, COMMON = np.tril(ALL, -1), 1 - np.eye(3), np.ones(1)
AFTER, NEXT = [1, 2, 0], [2, 0, 1]  # the pairs yz, zx, xy


# Biases that follow one function of the session (n,), alike on the axes but for the coefficients.


def ramp(world, inner):
    return world.time


def warm_up(world, inner):
    return np.exp(-world.time / inner["time_constant"])


def step_at(world, inner):
    return np.asarray(world.time >= inner[f"at_share_{world.session}"] * world.duration, float)


def warmth(world, inner):
    return world.warmth


def warmth_squared(world, inner):
    return world.warmth**2


def warmth_cubed(world, inner):
    return world.warmth**3


def temperature_rate(world, inner):
    return world.temperature_rate


def temperature_rate_squared(world, inner):
    return world.temperature_rate**2


def warmth_times_rate(world, inner):
    return world.warmth * world.temperature_rate


def lagged_warmth(world, inner):
    return relax(world.warmth, world.step, inner["time_constant"])


def played_warmth(world, inner):
    """A pin with play in a slot: it moves only when an end of the slot, of half width r in K, pushes it."""
    half, pin, path = inner["half_width"], world.warmth[0], np.empty_like(world.warmth)
    for index, pushed in enumerate(world.warmth.tolist()):
        pin = min(max(pin, pushed - half), pushed + half)
        path[index] = pin
    return path


# Terms that see the true input u or another signal, each axis in its own way.


def add_quadratic(world, u, c, inner):
    return c * u**2


def add_cubic(world, u, c, inner):
    return c * u**3


def add_asymmetry(world, u, c, inner):
    return c * np.abs(u)


def add_cross_coupling(world, u, c, inner):
    return (u[:, AFTER] * u[:, NEXT]) @ c.T


def add_scale_temperature(world, u, c, inner):
    return world.warmth[:, None] * c * u


def add_misalignment_temperature(world, u, c, inner):
    return world.warmth[:, None] * (u @ c.T)


def add_g_sensitivity(world, u, c, inner):
    return world.force @ c.T


def add_g_squared_sensitivity(world, u, c, inner):
    return c * world.force**2


def add_lag(world, u, c, inner):
    """Each axis follows the rate through its own low-pass: mean over each sub-step, exact for its constant rate."""
    change = np.zeros_like(u)
    for axis in np.flatnonzero(c):
        ends = relax(u[:, axis], world.step, c[axis])
        starts = np.concatenate([u[:1, axis], ends[:-1]])
        change[:, axis] = (starts - u[:, axis]) * -np.expm1(-world.step / c[axis]) * c[axis] / world.step
    return change


def add_dead_band(world, u, c, inner):
    return np.where(np.abs(u) < np.abs(c), -u, 0.0)


def add_earth_rotation(world, u, c, inner):
    latitude, heading = inner["latitude"], inner[f"heading_{world.session}"]
    north = np.cos(latitude) * np.array([np.cos(heading), np.sin(heading), 0.0])
    return c[0] * world.in_body(north + [0.0, 0.0, np.sin(latitude)])


def add_time_offset(world, u, c, inner):
    """Stamps late by c: what is stamped t was the rate at t − c. Angles are exact, so nothing is lost to the shift."""
    edges = np.append(world.time, world.time[-1] + world.step) - world.step / 2
    angles = np.concatenate([np.zeros((1, 3)), np.cumsum(u * world.step, axis=0)])
    shifted = np.stack([np.interp(edges - c[0], edges, angle) for angle in angles.T], axis=-1)
    return np.diff(shifted, axis=0) / world.step - u


def add_size_effect(world, u, c, inner):
    """Row i of c: where the element of axis i sits, as seen from the point that the motion describes; m."""
    rate, turning = world.rate, world.angular_acceleration
    return np.stack(
        [(np.cross(turning, arm) + np.cross(rate, np.cross(rate, arm)))[:, i] for i, arm in enumerate(c)], -1
    )


def add_lever_arm(world, u, c, inner):
    return add_size_effect(world, u, np.tile(c, (3, 1)), inner)


# Outside the catalogue. Each says what it is, what it is easily taken for, and why no catalogue term is it.


def add_looseness(world, u, c, inner):
    """An element with a little play rests on one stop or the other, as gravity along another axis decides.

    Taken for misalignment, which absorbs most of it; it saturates at once, and no term has the sign of another axis.
    """
    return np.tanh(8 * world.force / GRAVITY) @ c.T


def add_fringe(world, u, c, inner):
    """A periodic pick-off: residual error of its fringe interpolation, one and a half waves from −1 g to +1 g.

    Taken for accel.cubic, which it resembles below half g and misses beyond; the catalogue has no periodic term.
    """
    return c * np.sin(1.5 * np.pi * world.force / GRAVITY)


def add_square_root(world, u, c, inner):
    """A contact that stiffens as it closes (deflection goes as a root of the load, with its sign).

    Taken for accel.cubic with a scale error; its slope at zero is unbounded, which no polynomial term has.
    """
    return c * np.sign(world.force) * np.sqrt(np.abs(world.force) / GRAVITY)


def add_creep(world, u, c, inner):
    """The glue of the package yields to its new load for seconds after each turn (force along another axis).

    Taken for misalignment, of which it is a slow one; the catalogue's memories follow temperature, none follows force.
    """
    return relax(world.force, world.step, inner["time_constant"]) @ c.T


def add_cycle(world, u, c, inner):
    """A bias that follows a periodic supply or draught, about three cycles in a recording, not seen by the thermometer.

    Taken for a step, a ramp or bias instability; the catalogue has no periodic bias.
    """
    phase = 2 * np.pi * world.time / (inner["period_share"] * world.duration)
    return np.outer(np.sin(phase + inner[f"phase_{world.session}"]), c)


def add_azimuth(world, u, c, inner):
    """A slightly magnetic proof mass is pulled along horizontal north: the bias depends on heading, not on tilt alone.

    Taken for noise, or by chance for any term; the catalogue has no accelerometer term that knows a heading.
    """
    heading = inner[f"heading_{world.session}"]
    return world.in_body(np.array([np.cos(heading), np.sin(heading), 0.0])) @ c.T


def add_magnetic(world, u, c, inner):
    """One gyroscope axis picks up the magnetic field along another one; the field dips by 50 to 70 degrees.

    Taken for gyro.earth_rotation and gyro.g_sensitivity (its vertical part is just that); the catalogue's level vector
    reaches all axes alike.
    """
    heading, dip = inner[f"heading_{world.session}"], inner["dip"]
    field_direction = [np.cos(dip) * np.cos(heading), np.cos(dip) * np.sin(heading), -np.sin(dip)]
    return world.in_body(np.array(field_direction)) @ c.T


def add_hinge(world, u, c, inner):
    """A suspension whose compliance differs between pull and push: bias |f_j| f_k / g (one pair for each output axis).

    Taken for gyro.g_sensitivity along k; the catalogue's products of forces act on the accelerometer only.
    """
    return (np.abs(world.force[:, AFTER]) * world.force[:, NEXT] / GRAVITY) @ c.T


def add_odd_square(world, u, c, inner):
    """Drive leakage that is rectified with the sign of the rate: c ω |ω|.

    Taken for gyro.cubic, of the same sign and nearly the same shape; the catalogue's only odd term is the cubic.
    """
    return c * u * np.abs(u)


# Everyday: what units and rooms do, and a curve that the catalogue lacks.


def add_quartic(world, u, c, inner):
    return c * u**4


def add_scale_jump(world, u, c, inner):
    return (world.time > world.duration / 2)[:, None] * c * u


def add_scale_drift(world, u, c, inner):
    return (world.time / world.duration)[:, None] * c * u


def add_sine(world, u, c, inner):
    return np.outer(np.sin(2 * np.pi * world.time / inner["period"] + inner["phase"]), c)


def each_session(key: str, low: float, high: float) -> dict[str, tuple]:
    return {f"{key}_{session}": (low, high) for session in ("fit", "heldout")}


def follow(function: Callable) -> Callable:
    """The term of an effect whose bias is c_i times a function of the session."""
    return lambda world, u, c, inner: np.outer(function(world, inner), c)


def shared_kinds(sensor: str, unit: str, output: float, typical: float) -> dict[str, Kind]:
    """The effects both sensors have. Unit sizes make `output` at input `typical`, 100 s, 5 K and 0.2 K/s."""
    lag, play = {"time_constant": (0.07, 0.18, "duration")}, {"half_width": (1.0, 2.5)}
    heating, jump = {"time_constant": (0.1, 0.3, "duration")}, each_session("at_share", 0.3, 0.7)
    # The accelerometer's axes define the body frame, so only the lower triangle of its gain can change.
    triangle = LOWER if sensor == "accel" else OTHERS
    kinds = {
        "quadratic": Kind(sensor, add_quadratic, output / typical**2, EACH, f"1/({unit})"),
        "cubic": Kind(sensor, add_cubic, output / typical**3, EACH, f"1/({unit})²"),
        "asymmetry": Kind(sensor, add_asymmetry, output / typical, EACH, "1"),
        "cross_coupling": Kind(sensor, add_cross_coupling, 2 * output / typical**2, ALL, f"1/({unit}); yz, zx, xy"),
        "bias_ramp": Kind(sensor, follow(ramp), output / 100, EACH, f"{unit}/s"),
        "warm_up": Kind(sensor, follow(warm_up), output, EACH, unit, heating),
        "step": Kind(sensor, follow(step_at), output, EACH, unit, jump),
    }
    thermal = {
        "temperature": Kind(sensor, follow(warmth), output / 5, EACH, f"({unit})/K"),
        "temperature_squared": Kind(sensor, follow(warmth_squared), output / 25, EACH, f"({unit})/K²"),
        "temperature_cubed": Kind(sensor, follow(warmth_cubed), output / 125, EACH, f"({unit})/K³"),
        "temperature_rate": Kind(sensor, follow(temperature_rate), output / 0.2, EACH, f"({unit})/(K/s)"),
        "temperature_rate_squared": Kind(
            sensor, follow(temperature_rate_squared), output / 0.04, EACH, f"({unit})/(K/s)²"
        ),
        "temperature_times_rate": Kind(sensor, follow(warmth_times_rate), output, EACH, f"({unit})/(K²/s)"),
        "thermal_lag": Kind(sensor, follow(lagged_warmth), output / 5, EACH, f"({unit})/K", lag),
        "thermal_hysteresis": Kind(sensor, follow(played_warmth), output / 5, EACH, f"({unit})/K", play),
        "scale_temperature": Kind(sensor, add_scale_temperature, output / (5 * typical), EACH, "1/K"),
        "misalignment_temperature": Kind(sensor, add_misalignment_temperature, output / (5 * typical), triangle, "1/K"),
    }
    thermal = {name: replace(kind, needs_temperature=True) for name, kind in thermal.items()}
    return {f"{sensor}.{name}": kind for name, kind in (kinds | thermal).items()}


def own_kinds(accel: float, gyro: float) -> dict[str, Kind]:
    """Effects of one sensor or of the set-up; where gravity drives them, unit sizes make `accel` or `gyro` at 1 g."""
    earth = {"latitude": (np.radians(25), np.radians(65))} | each_session("heading", -np.pi, np.pi)
    g_unit = "(rad/s)/(m/s²)"
    kinds = {
        "gyro.g_sensitivity": Kind("gyro", add_g_sensitivity, gyro / GRAVITY, ALL, g_unit),
        "gyro.g_squared_sensitivity": Kind("gyro", add_g_squared_sensitivity, gyro / GRAVITY**2, EACH, f"{g_unit}²"),
        "gyro.dead_band": Kind("gyro", add_dead_band, 0.02, EACH, "rad/s", positive=True, suite="nonlinear"),
    }
    inputs = {
        "gyro.lag": Kind("gyro", add_lag, 5e-4, EACH, "s, late", positive=True),
        "gyro.earth_rotation": Kind(
            "gyro", add_earth_rotation, EARTH_RATE, COMMON, "rad/s, whole vector", earth, positive=True
        ),
        "setup.time_offset": Kind("gyro", add_time_offset, 3e-3, COMMON, "s, gyroscope late", suite="blind"),
        "accel.size_effect": Kind("accel", add_size_effect, 2e-3, ALL, "m; a place a row", suite="blind"),
        "accel.lever_arm": Kind("accel", add_lever_arm, 1e-2, EACH, "m", suite="blind"),
    }
    return kinds | {name: replace(kind, at="input") for name, kind in inputs.items()}


def outside_kinds(accel: float, gyro: float) -> dict[str, Kind]:
    """What the catalogue lacks, always with a single coefficient."""
    heading = each_session("heading", -np.pi, np.pi)
    field = {"dip": (np.radians(50), np.radians(70))} | heading
    cycle = {"period_share": (0.3, 0.36)} | each_session("phase", -np.pi, np.pi)
    kinds = {
        "looseness": Kind("accel", add_looseness, accel, OTHERS, "m/s²"),
        "fringe": Kind("accel", add_fringe, accel, EACH, "m/s²"),
        "square_root": Kind("accel", add_square_root, accel, EACH, "m/s²"),
        "creep": Kind("accel", add_creep, accel / GRAVITY, OTHERS, "1", {"time_constant": (3.0, 8.0)}),
        "cycle": Kind("accel", add_cycle, accel, EACH, "m/s²", cycle),
        "azimuth": Kind("accel", add_azimuth, accel, ALL, "m/s²", heading),
        "magnetic": Kind("gyro", add_magnetic, gyro, OTHERS, "rad/s", field),
        "hinge": Kind("gyro", add_hinge, gyro / GRAVITY, ALL, "(rad/s)/(m/s²)"),
        "odd_square": Kind("gyro", add_odd_square, gyro / 4, EACH, "1/(rad/s)"),
    }
    return {f"outside.{name}": replace(kind, single=True, suite="outside") for name, kind in kinds.items()}


def everyday_kinds(sensor: str, unit: str, output: float, typical: float) -> dict[str, Kind]:
    """What is asked beside the suites; always a single coefficient."""
    swing = {"period": (37.0, 61.0), "phase": (-np.pi, np.pi)}
    kinds = {
        "quartic": Kind(sensor, add_quartic, output / typical**4, EACH, f"1/({unit})³"),
        "scale_jump": Kind(sensor, add_scale_jump, output / typical, EACH, "1"),
        "scale_drift": Kind(sensor, add_scale_drift, output / typical, EACH, "1, over the recording"),
        "sine": Kind(sensor, add_sine, output, EACH, unit, swing),
    }
    return {f"everyday.{sensor}_{name}": replace(kind, single=True, suite="everyday") for name, kind in kinds.items()}


KINDS: dict[str, Kind] = (
    shared_kinds("accel", "m/s²", 3e-3, GRAVITY)
    | shared_kinds("gyro", "rad/s", np.radians(0.01), 2.0)
    | own_kinds(3e-3, np.radians(0.01))
    | outside_kinds(3e-3, np.radians(0.01))
    | everyday_kinds("accel", "m/s²", 3e-3, GRAVITY)
    | everyday_kinds("gyro", "rad/s", np.radians(0.01), 2.0)
)


def named(suite: str) -> list[str]:
    return [name for name, kind in KINDS.items() if kind.suite == suite]


BLIND, OUTSIDE = named("blind"), named("outside")


@dataclass(frozen=True)
class Tie:
    """A case that the data cannot decide: `draw_case(seed, tie.hidden, temperature="linear", inner=tie.inner)`.

    `twins`: names that explain it as well, up to the bias: every one of them and the hidden one belong in the answer.
    """

    hidden: tuple[str, ...]
    twins: tuple[str, ...]
    inner: dict[str, dict[str, float]] = field(default_factory=dict, hash=False)


# On a straight line T − 25 = s (t − D/2): T, t and T·dT/dt are one regressor; dT/dt is a constant, that is, bias.
TIES = tuple(
    tie
    for sensor in ("accel", "gyro")
    for tie in (
        Tie((f"{sensor}.temperature",), (f"{sensor}.bias_ramp", f"{sensor}.temperature_times_rate")),
        Tie((f"{sensor}.bias_ramp",), (f"{sensor}.temperature", f"{sensor}.temperature_times_rate")),
        Tie(
            (f"{sensor}.thermal_lag",),
            (f"{sensor}.temperature", f"{sensor}.bias_ramp"),
            {f"{sensor}.thermal_lag": {"time_constant": 0.5}},
        ),
    )
)


def observable(protocol_temperature: bool) -> list[str]:
    """Names for a suite with one effect; those driven by temperature only where the protocol varies it."""
    return [name for name in named("observable") if protocol_temperature or not KINDS[name].needs_temperature]


def draw_effect(seed: int, name: str, protocol: Protocol, inner: Mapping[str, float] | None = None) -> Hidden:
    """An effect of unit size: one coefficient or a random direction of all; `inner` stands in for what is drawn."""
    if name not in KINDS:
        raise ValueError(f"no effect is called {name!r}; there are {', '.join(KINDS)}")
    kind = KINDS[name]
    if kind.needs_temperature and not protocol.temperature:
        raise ValueError(f"{name} hides nothing while the temperature is constant: pass temperature=True")
    random = np.random.default_rng([seed, 1, zlib.crc32(name.encode())])
    if kind.single or random.random() < 0.5:
        direction = np.zeros_like(kind.mask)
        direction[tuple(random.choice(np.argwhere(kind.mask)))] = random.choice([-1.0, 1.0])
    else:
        direction = kind.mask * random.standard_normal(kind.mask.shape)
        if name == "gyro.lag":  # a lag common to all axes is blind from rest to rest, so one axis is prompt
            direction[random.integers(3)] = 0.0
        direction /= np.linalg.norm(direction)
    if kind.positive:
        direction = np.abs(direction)
    drawn = {}
    for key, (low, high, *share) in kind.inner.items():
        drawn[key] = float(random.uniform(low, high)) * (protocol.duration if share else 1.0)
    if unknown := set(inner or {}) - set(drawn):
        raise ValueError(f"{name} has no inner number {', '.join(sorted(unknown))}")
    return Hidden(name, kind.unit * direction, drawn | dict(inner or {}))


# Units and recordings -------------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Truth:
    """Gains (3, 3) and biases (3,) of y = gain·u + bias, biases in m/s² and rad/s, and what is hidden."""

    accel_gain: np.ndarray
    accel_bias: np.ndarray
    gyro_gain: np.ndarray
    gyro_bias: np.ndarray
    hidden: tuple[Hidden, ...]

    def as_dict(self) -> dict:
        """For JSON."""
        unit = {key: getattr(self, key).tolist() for key in ("accel_gain", "accel_bias", "gyro_gain", "gyro_bias")}
        keys = ("name", "axis", "sign", "size", "meaning", "inner", "scale")
        effects = [
            {key: getattr(effect, key) for key in keys} | {"coefficients": effect.coefficients.tolist()}
            for effect in self.hidden
        ]
        return unit | {"hidden": effects}


@dataclass(frozen=True, eq=False)
class Recording:
    """What a logger would have written: time (n,) s, accel (n, 3) m/s², gyro (n, 3) rad/s, temperature (n,) °C.

    drift: by sensor, the flicker noise's means (2, 3) over the recording and over as long again after it.
    """

    time: np.ndarray
    accel: np.ndarray
    gyro: np.ndarray
    temperature: np.ndarray
    drift: Mapping[str, np.ndarray] = field(default_factory=dict)

    def write(self, path: Path) -> Path:
        columns = {"time [s]": self.time}
        columns |= {f"accel_{axis} [m/s^2]": self.accel[:, i] for i, axis in enumerate("xyz")}
        columns |= {f"gyro_{axis} [rad/s]": self.gyro[:, i] for i, axis in enumerate("xyz")}
        pq.write_table(pa.table(columns | {"temperature [degC]": self.temperature}), path)
        return path


def flicker(random: np.random.Generator, samples: int, rate: float, size: float) -> np.ndarray:
    """Three columns of 1/f noise over the samples and as many after them, two-sided density size²/(2π|f|), flat below
    1/(3.6 h); size in the output's unit.

    Made at 10 Hz by shaping a random spectrum; above 5 Hz it would be lost in the white noise, a thousand times denser.
    """
    slow = 10.0
    count = max(round(FLICKER_SPAN * slow), 2 ** int(np.ceil(np.log2(2 * samples / rate * slow))))
    frequency = np.fft.rfftfreq(count, 1 / slow)[1:]
    spectrum = np.zeros((3, len(frequency) + 1), complex)
    spectrum[:, 1:] = random.standard_normal((3, len(frequency), 2)) @ [1, 1j]
    spectrum[:, 1:] *= size * np.sqrt(count * slow / (4 * np.pi * np.maximum(frequency, 1 / FLICKER_SPAN)))
    noise, knots = np.fft.irfft(spectrum, count), np.arange(count) / slow
    return np.stack([np.interp(np.arange(2 * samples) / rate, knots, each) for each in noise], axis=-1)


def quantised(output: np.ndarray, full_scale: float) -> np.ndarray:
    step = full_scale / 2**15
    return np.clip(np.round(output / step), -(2**15), 2**15 - 1) * step


@dataclass(frozen=True, eq=False)
class Case:
    """One unit with its recordings `fit`, `heldout` and `static`, made when first asked for, and its `truth`."""

    protocol: Protocol
    hidden: tuple[Hidden, ...]
    noisy: bool = True
    quantise: bool = True

    @cached_property
    def truth(self) -> Truth:
        random, eye = np.random.default_rng([self.protocol.seed, 0]), np.eye(3)
        accel_gain = eye + np.tril(random.uniform(-0.02, 0.02, (3, 3)))
        gyro_gain = eye + random.uniform(-0.02, 0.02, (3, 3))
        return Truth(accel_gain, random.uniform(-0.3, 0.3, 3), gyro_gain, random.uniform(-0.02, 0.02, 3), self.hidden)

    def world(self, session: str) -> World:
        """True motion and temperature of session "fit" or "heldout"."""
        return simulate_world(self.protocol, session)

    @cached_property
    def fit(self) -> Recording:
        return self._moving("fit")

    @cached_property
    def heldout(self) -> Recording:
        """The same unit and effects in another motion, temperature and noise. What belongs to a session is drawn anew:
        the heading, the time of a step, the phase of a cycle."""
        return self._moving("heldout")

    def powered_on(self, spread: Mapping[str, float], count: int = 3) -> list[Recording]:
        """So many sessions, each with another motion, and with biases that `spread` (SI, by sensor) sets anew."""
        found = []
        for number in range(1, count + 1):
            session = f"power-on {number}"
            recording, random = self._moving(session), self.protocol.random(session, 3)
            shifts = {sensor: size * random.standard_normal(3) for sensor, size in spread.items()}
            found.append(replace(recording, **{sensor: getattr(recording, sensor) + shift
                                               for sensor, shift in shifts.items()}))  # fmt: skip
        return found

    @cached_property
    def static(self) -> Recording:
        """The unit at rest at 25 °C without hidden effects."""
        samples = round(self.protocol.static_minutes * 60 * self.protocol.rate)
        up = spread_attitudes(self.protocol.random("static", 0), 1)[0][2]
        still = {"accel": self.protocol.gravity * up, "gyro": np.zeros(3)}
        outputs = {sensor: np.tile(self._respond(sensor, true), (samples, 1)) for sensor, true in still.items()}
        return self._logged("static", outputs, np.full(samples, REFERENCE_TEMPERATURE))

    def with_size(self, scale: float | Mapping[str, float]) -> "Case":
        """The same seeds, motion and noise, with the hidden effects at `scale` times unit size (by name, if a mapping).

        Scales count from the unit size as drawn, not from this case's.
        """
        sizes = dict(scale) if isinstance(scale, Mapping) else {effect.name: scale for effect in self.hidden}
        if unknown := set(sizes) - {effect.name for effect in self.hidden}:
            raise ValueError(f"not hidden here: {', '.join(sorted(unknown))}")
        hidden = tuple(replace(effect, scale=sizes.get(effect.name, effect.scale)) for effect in self.hidden)
        return replace(self, hidden=hidden)

    def write(self, folder: Path | str, parts: tuple[str, ...] = ("fit", "heldout", "static")) -> dict[str, Path]:
        """Write <part>.parquet into the folder, which is made if need be; the paths by part."""
        folder = Path(folder)
        folder.mkdir(parents=True, exist_ok=True)
        return {part: getattr(self, part).write(folder / f"{part}.parquet") for part in parts}

    def _respond(self, sensor: str, true: np.ndarray) -> np.ndarray:
        return true @ getattr(self.truth, f"{sensor}_gain").T + getattr(self.truth, f"{sensor}_bias")

    def _moving(self, session: str) -> Recording:
        world = self.world(session)

        def sampled(fine: np.ndarray) -> np.ndarray:
            return fine.reshape(self.protocol.samples, self.protocol.oversampling, -1).mean(axis=1)

        outputs = {}
        for sensor in ("accel", "gyro"):
            added = {"input": np.zeros_like(world.rate), "output": np.zeros_like(world.rate)}
            for effect in self.hidden:
                if KINDS[effect.name].sensor == sensor:
                    added[KINDS[effect.name].at] += effect.added(world)
            outputs[sensor] = sampled(self._respond(sensor, world.sensed(sensor) + added["input"]) + added["output"])
        return self._logged(session, outputs, sampled(world.temperature)[:, 0])

    def _logged(self, session: str, outputs: dict[str, np.ndarray], temperature: np.ndarray) -> Recording:
        samples, rate = len(temperature), self.protocol.rate
        random, drift = self.protocol.random(session, 2), {}
        for sensor, output in outputs.items():
            if self.noisy:
                noise = self.protocol.noise
                output += noise * WHITE[sensor] * np.sqrt(rate) * random.standard_normal(output.shape)
                slow = flicker(random, samples, rate, noise * FLICKER[sensor] * self.protocol.flicker)
                output += slow[:samples]
                drift[sensor] = slow.reshape(2, samples, 3).mean(axis=1)
            if self.quantise:
                outputs[sensor] = quantised(output, RANGE[sensor])
        return Recording(np.arange(samples) / rate, outputs["accel"], outputs["gyro"], temperature, drift)


def draw_case(
    seed: int,
    hidden: tuple[str, ...] | None = None,
    poses: int = 40,
    pose_duration: float = 4.0,
    turn_duration: float = 1.5,
    rate: float = 100.0,
    static_minutes: float = 60,
    temperature: bool | str = False,
    *,
    first_pose_duration: float | None = None,
    oversampling: int = 4,
    quantise: bool = True,
    inner: Mapping[str, Mapping[str, float]] | None = None,
    two_axes: bool = False,
    flicker: float = 1.0,
    noise: float = 1.0,
) -> Case:
    """Draw a unit, its motion, noise and the named hidden effects, at unit size, from the seed.

    Durations in s, rate in Hz. `temperature`: False for 25 °C, True for some 10 K up and down at several rates,
    "linear" for a straight line. `first_pose_duration`: of the first pose, where it differs. `inner`: inner numbers by
    effect, such as {"accel.thermal_lag": {"time_constant": 0.5}}, in place of drawn ones. `two_axes`: turns' axes move.
    `flicker`: times the usual bias instability. `noise`: of a better grade of sensor, times the usual.
    """
    if temperature not in (False, True, "linear"):
        raise ValueError(f'temperature must be False, True or "linear", not {temperature!r}')
    names = tuple(hidden or ())
    if len(set(names)) < len(names):
        raise ValueError("an effect is hidden once at most")
    if unknown := set(inner or {}) - set(names):
        raise ValueError(f"inner numbers for what is not hidden: {', '.join(sorted(unknown))}")
    protocol = Protocol(
        seed,
        poses,
        pose_duration,
        turn_duration,
        rate,
        static_minutes,
        temperature,
        first_pose_duration,
        oversampling,
        two_axes=two_axes,
        flicker=flicker,
        noise=noise,
    )
    effects = tuple(draw_effect(seed, name, protocol, (inner or {}).get(name)) for name in names)
    return Case(protocol, effects, quantise=quantise)


def response(case: Case, hidden: Hidden, session: str = "fit") -> tuple[Recording, Recording]:
    """The case's recording without noise and quantisation: without any effect, and with this one at its own scale.

    Their difference, whitened by the caller, is the effect's size. All effects are linear in scale but the dead band;
    the lag and the time offset nearly so.
    """
    pure = replace(case, hidden=(), noisy=False, quantise=False)
    return getattr(pure, session), getattr(replace(pure, hidden=(hidden,)), session)


# Self check -----------------------------------------------------------------------------------------------------------


def largest_attitude_error(case: Case, session: str = "fit") -> float:
    """Rad: turns integrated from the noise-free samples with true gain and bias, against the true attitudes."""
    pure = replace(case, hidden=(), noisy=False, quantise=False)
    world, truth = case.world(session), case.truth
    rates = np.linalg.solve(truth.gyro_gain, (getattr(pure, session).gyro - truth.gyro_bias).T).T
    errors = []
    for turn in range(len(world.poses) - 1):
        attitude = world.poses[turn]
        for small in exp(rates[world.rests[turn, 1] : world.rests[turn + 1, 0]] / case.protocol.rate):
            attitude = attitude @ small
        errors.append(np.linalg.norm(log(world.poses[turn + 1].T @ attitude)))
    return max(errors)


def rest_norm_scores(case: Case, session: str = "fit") -> np.ndarray:
    """Norms of the corrected specific force averaged over each rest, less g, in standard deviations of white noise."""
    world, truth = case.world(session), case.truth
    forces = np.linalg.solve(truth.accel_gain, (getattr(case, session).accel - truth.accel_bias).T).T
    norms = np.array([np.linalg.norm(forces[slice(*rest)].mean(axis=0)) for rest in world.rests])
    sigma = WHITE["accel"] * np.sqrt(case.protocol.rate / np.diff(world.rests)[:, 0])
    return (norms - case.protocol.gravity) / sigma


def timed(label: str, task: Callable):
    """The task's result; its wall time is printed."""
    start = time.perf_counter()
    result = task()
    print(f"  {label:<28} {time.perf_counter() - start:7.3f} s")
    return result


def self_check(seed: int) -> None:
    """Print what a reader can check by eye: consistency, timings, and how much each effect adds."""
    case = draw_case(seed, temperature=True)
    print(f"seed {seed}: {case.protocol.poses} poses, {case.protocol.duration:.1f} s")
    timed("fit recording", lambda: case.fit)
    timed("held-out recording", lambda: case.heldout)
    timed("static recording", lambda: case.static)
    with tempfile.TemporaryDirectory() as folder:
        timed("all three written", lambda: case.write(folder))
    scores = rest_norm_scores(case)
    print(f"  norms at rest less g: mean {scores.mean():+.2f} σ, standard deviation {scores.std():.2f} σ (white only)")
    print(f"  turns integrated from noise-free samples: off by {largest_attitude_error(case):.1e} rad at most")
    print(f"  fastest turn {np.degrees(np.abs(case.world('fit').rate).max()):.0f} °/s")
    temperature = case.world("fit").temperature
    print(f"  temperature from {temperature.min():.1f} to {temperature.max():.1f} °C")
    print(f"{'effect':<34}{'suite':<12}{'unit size':>11}  {'of':<24}{'largest':>10}{'at rest':>10}")
    for name, kind in KINDS.items():
        effect = draw_effect(seed, name, case.protocol)
        without, added = response(case, effect)
        change = np.abs(getattr(added, kind.sensor) - getattr(without, kind.sensor)).max(axis=1)
        still = np.concatenate([change[slice(*rest)] for rest in case.world("fit").rests])
        unit, factor = ("mm/s²", 1e3) if kind.sensor == "accel" else ("°/s", np.degrees(1))
        figures = f"{factor * change.max():10.4f}{factor * still.max():10.4f} {unit}"
        print(f"{name:<34}{kind.suite:<12}{effect.size:11.3g}  {effect.meaning:<24}{figures}")


if __name__ == "__main__":
    self_check(int(sys.argv[1]) if len(sys.argv) > 1 else 0)
