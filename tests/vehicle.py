"""A unit in a vehicle on a road: independent of the library, NumPy alone; the truth is in what is returned."""

from dataclasses import dataclass

import numpy as np

GRAVITY, EARTH = 9.81, 7.292115e-5
RATE = 50.0


@dataclass(frozen=True)
class Drive:
    """time (n,) s; force (n, 3) m/s² and rate (n, 3) rad/s as the unit reports them; stops (S, 2): start and stop, s.

    mounting (3, 3): the vehicle's axes (forward, left, up) to the unit's. bias: of the gyroscope, rad/s, at the times.
    tilt (S, 2): true pitch and roll of the vehicle at its stops, rad.
    """

    time: np.ndarray
    force: np.ndarray
    rate: np.ndarray
    stops: np.ndarray
    mounting: np.ndarray
    bias: np.ndarray
    tilt: np.ndarray

    def frame(self):
        """The log, as a table."""
        columns = {"time [s]": self.time}
        for name, unit, values in (("accel", "m/s^2", self.force), ("gyro", "rad/s", self.rate)):
            columns |= {f"{name}_{axis} [{unit}]": values[:, number] for number, axis in enumerate("xyz")}
        return columns

    def save(self, path):
        """Write the log as CSV."""
        columns = self.frame()
        np.savetxt(path, np.column_stack([*columns.values()]), "%.7g", ",", header=",".join(columns), comments="")
        return path


def about(axis, angle):
    """The rotation matrices (…, 3, 3) about an axis."""
    c, s = np.cos(angle), np.sin(angle)
    first, second = (axis + 1) % 3, (axis + 2) % 3
    matrix = np.zeros((*np.shape(angle), 3, 3))
    matrix[..., axis, axis] = 1.0
    matrix[..., first, first] = matrix[..., second, second] = c
    matrix[..., second, first], matrix[..., first, second] = s, -s
    return matrix


def _smooth(rng, count, length, size):
    """A stationary random course of so many samples that changes over `length` of them."""
    knots = rng.normal(0.0, size, int(count / length) + 4)
    place = np.arange(count) / length
    return np.interp(place, np.arange(len(knots)), knots)


def drive(
    seed=0,
    stops=8,
    lengths=(5.0, 30.0),
    tilt=(4.0, -7.0),
    yaw=25.0,
    bias=(0.004, -0.006, 0.009),
    accelerometer_bias=(0.0, 0.0, 0.0),
    drift=0.0,
    slope=0.015,
    idle=1.0,
    latitude=48.0,
    cruise=(15.0, 50.0),
    noise=(0.01, 0.0008),
    road=(0.8, 0.04),
    reverse=0,
    leg=None,
):
    """Return a drive that begins and ends with a stop.

    **Arguments:** `lengths`: of stops, s; `tilt`: roll and pitch of the unit, degrees; `yaw`: degrees; `drift`:
    rad/s by which the bias grows over the drive; `slope`: rms of roads; `idle`: noise at stops, in multiples;
    `cruise`: seconds of driving between stops; `reverse`: how many of the legs are driven backwards.
    """
    rng = np.random.default_rng(seed)
    speed, turn, edges, now = [], [], [], 0
    backwards = set(rng.permutation(max(stops - 1, 0))[:reverse])
    for number in range(stops):
        still = int(rng.uniform(*lengths) * RATE)
        edges.append((now / RATE, (now + still) / RATE))
        speed.append(np.zeros(still))
        turn.append(np.zeros(still))
        if number == stops - 1:
            break
        top = rng.uniform(8.0, 18.0) if number not in backwards else -rng.uniform(1.5, 3.0)
        up, down = (int(abs(top) / rng.uniform(1.0, 2.5) * RATE) for _ in range(2))
        long = int(rng.uniform(*(cruise if top > 0 else (2.0, 4.0))) * RATE)  # nobody drives backwards for long
        ramp = [0.5 - 0.5 * np.cos(np.pi * (np.arange(part) + 0.5) / part) for part in (up, down)]
        speed.append(top * np.concatenate([ramp[0], np.ones(long), ramp[1][::-1]]))
        bend = np.zeros(up + long + down)  # a turn of up to a right angle, slower where it is quick
        start = up + int(rng.uniform(0.1, 0.5) * long)
        width = min(int(rng.uniform(4.0, 9.0) * RATE), up + long - start)
        angle = rng.choice([-1, 1]) * rng.uniform(0.3, 1.7)
        bend[start : start + width] = angle * RATE / width * (1 - np.cos(2 * np.pi * (np.arange(width) + 0.5) / width))
        turn.append(bend)
        now += still + len(bend)
    speed, turn = np.concatenate(speed), np.concatenate(turn)
    count = len(speed)
    time = np.arange(count) / RATE
    moving = speed != 0
    metres = int(np.abs(speed).sum() / RATE) + 30
    travelled = np.cumsum(np.abs(speed)) / RATE
    grade, fall = (
        np.interp(
            travelled, np.arange(metres), np.convolve(_smooth(rng, metres, 60.0, slope), np.ones(20) / 20, "same")
        )
        for _ in range(2)
    )
    acceleration, lateral = np.gradient(speed, 1 / RATE), speed * turn
    pitch = -grade - 0.02 * acceleration / GRAVITY  # nose up is negative about the left axis; it squats and dives
    roll = fall + 0.06 * lateral / GRAVITY
    heading = rng.uniform(0, 2 * np.pi) + np.cumsum(turn) / RATE
    attitude = about(2, heading) @ about(1, pitch) @ about(0, roll)  # vehicle to level: north, west, up
    level_acceleration = attitude @ np.stack([acceleration, lateral, np.zeros(count)], 1)[..., None]
    up_axis = np.array([0.0, 0.0, GRAVITY])[:, None]
    force = (attitude.swapaxes(1, 2) @ (level_acceleration + up_axis))[..., 0]
    step = attitude[:-1].swapaxes(1, 2) @ attitude[1:]
    turning = np.stack([step[:, 2, 1] - step[:, 1, 2], step[:, 0, 2] - step[:, 2, 0], step[:, 1, 0] - step[:, 0, 1]], 1)
    rate = np.vstack([turning, turning[-1:]]) * RATE / 2
    angle = np.radians(latitude)
    rate += (attitude.swapaxes(1, 2) @ (EARTH * np.array([np.cos(angle), 0, np.sin(angle)]))[:, None])[..., 0]
    roll_of, pitch_of = np.radians(tilt)
    mounting = (about(2, np.radians(yaw)) @ about(1, pitch_of) @ about(0, roll_of)).T
    bias = np.asarray(bias) + np.outer(time / time[-1], np.full(3, drift))
    shaking = np.sqrt(np.clip(np.abs(speed) / 10, 0.1, None))[:, None] * moving[:, None]
    outputs = []
    for true, offset, white, rough in zip(
        (force, rate), (np.asarray(accelerometer_bias), bias), noise, road, strict=True
    ):
        still = white * np.where(moving, 1.0, idle)[:, None] * rng.normal(size=(count, 3))
        outputs.append(true @ mounting.T + offset + still + rough * shaking * rng.normal(size=(count, 3)))
    middle = [int((a + b) / 2 * RATE) for a, b in edges]
    return Drive(time, *outputs, np.array(edges), mounting, bias, np.stack([pitch, roll], 1)[middle])
