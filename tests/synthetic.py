"""Small simulated units, independent of the library's own simulation: NumPy and SciPy, motion written out in full."""

from dataclasses import dataclass

import jax.numpy as jnp
import numpy as np
from scipy.spatial.transform import Rotation

from jaximu.model.sensor import Imu, Triad
from jaximu.recordings.observations import Observations, Poses, Turns
from jaximu.recordings.recording import Recording, Signal

GRAVITY = 9.80665
POSES, SAMPLES = 12, 48  # one padded shape for all tests, so that compiled functions are shared


def unit(seed: int, size: float = 0.02) -> Imu:
    """A unit with gains off by `size` and biases to match; the accelerometer's gain lower triangular."""
    random = np.random.default_rng([seed, 1])
    gain_a = np.eye(3) + size * np.tril(random.uniform(-1, 1, (3, 3)))
    gain_g = np.eye(3) + size * random.uniform(-1, 1, (3, 3))
    bias_a, bias_g = 10 * size * random.uniform(-1, 1, 3), size * random.uniform(-1, 1, 3)
    arrays = [jnp.asarray(part) for part in (gain_a, bias_a, gain_g, bias_g)]
    return Imu(Triad(*arrays[:2]), Triad(*arrays[2:], quantity="angular_rate", output_unit="rad/s"))


def spread_directions(count: int, seed: int) -> np.ndarray:
    """The first of 26 directions (faces, edges and corners of a cube) tipped at random, neighbours far apart."""
    random = np.random.default_rng([seed, 2])
    grid = np.array([(x, y, z) for x in (-1, 0, 1) for y in (-1, 0, 1) for z in (-1, 0, 1) if x or y or z], float)
    grid = grid[np.argsort(np.abs(grid).sum(axis=1), kind="stable")]
    chosen = grid[:6] if count <= 6 else grid[: max(count, 18)]
    chosen = chosen[random.permutation(len(chosen))]
    chosen = chosen + 0.15 * random.standard_normal(chosen.shape)
    chosen = np.resize(chosen, (count, 3)) + 1e-3 * random.standard_normal((count, 3))
    return chosen / np.linalg.norm(chosen, axis=1, keepdims=True)


def turn_parts(before: np.ndarray, after: np.ndarray, twist: float) -> tuple[np.ndarray, np.ndarray]:
    """Two body rotation vectors, made one after the other, that take "up" from `before` to `after` in the body.

    The first turns about "up" (which moves nothing but the heading), the second is the shortest way.
    """
    axis = np.cross(after, before)  # the body turns against the way that "up" seems to go
    sine, cosine = np.linalg.norm(axis), before @ after
    if sine < 1e-6:
        axis, sine = np.cross(before, [0.6, -0.48, 0.64]), 1.0
        axis = axis / np.linalg.norm(axis)
    else:
        axis = axis / sine
    return twist * before, np.arctan2(np.linalg.norm(np.cross(after, before)), cosine) * axis


def smooth(samples: int) -> np.ndarray:
    """Shares of a turn made in each sample, of a rate that swells and ebbs: they sum up to one."""
    edges = np.linspace(0, 1, samples + 1)
    return np.diff(edges - np.sin(2 * np.pi * edges) / (2 * np.pi))


def turn_rates(first: np.ndarray, second: np.ndarray, samples: int, interval: float) -> np.ndarray:
    """Mean rate (samples, 3) over each sample of two rotations made one after the other.

    Two samples at rest in between: each of the others has neighbours that turn about its own axis.
    """
    half = (samples - 2) // 2
    parts = np.outer(smooth(half), first), np.zeros((2, 3)), np.outer(smooth(samples - 2 - half), second)
    return np.concatenate(parts) / interval


@dataclass(frozen=True)
class Simulated:
    """Observations of a unit, and the truth behind them."""

    observations: Observations
    imu: Imu
    up: np.ndarray  # (P, 3) direction of the specific force, body frame
    attitudes: Rotation  # of each pose, body to lab


def simulated(
    seed: int,
    poses: int = POSES,
    noise: float = 1.0,
    accelerometer_sigma: float = 1e-3,
    gyroscope_sigma: float = 1e-4,
    gyroscope_density: float = 1e-7,
    directions: np.ndarray | None = None,
    imu: Imu | None = None,
    used_samples: int = SAMPLES,
    interval: float = 0.03,
    padded: int = POSES,
) -> Simulated:
    """Observations at rest and in turns: sigmas of pose means (m/s², rad/s), density of rate noise ((rad/s)² s).

    `noise` multiplies the noise drawn, not the covariances stated: zero gives exact data.
    """
    random = np.random.default_rng([seed, 3])
    imu = unit(seed) if imu is None else imu
    gain_a, bias_a = np.asarray(imu.accelerometer.gain), np.asarray(imu.accelerometer.bias)
    gain_g, bias_g = np.asarray(imu.gyroscope.gain), np.asarray(imu.gyroscope.bias)
    up = spread_directions(poses, seed) if directions is None else directions
    poses = len(up)
    # noise of pose means: not the same on all axes and in all poses, so that weights matter
    share = random.uniform(0.5, 2.0, poses)
    shape = np.array([[1.0, 0, 0], [0.3, 0.8, 0], [0, -0.2, 1.3]])
    factor_a = accelerometer_sigma * np.sqrt(share)[:, None, None] * shape
    factor_g = gyroscope_sigma * np.sqrt(share)[:, None, None] * shape
    factor_n = np.sqrt(gyroscope_density) * shape

    def draw(factor):
        return noise * np.einsum("...ij,...j->...i", factor, random.standard_normal((len(factor), 3)))

    mean_a = np.tile([0.0, 0.0, GRAVITY], (padded, 1))
    mean_a[:poses] = GRAVITY * up @ gain_a.T + bias_a + draw(factor_a)
    mean_g = np.zeros((padded, 3))
    mean_g[:poses] = bias_g + draw(factor_g)
    output, intervals = np.zeros((padded - 1, SAMPLES, 3)), np.zeros((padded - 1, SAMPLES))
    attitudes = [Rotation.align_vectors([[0, 0, 1.0]], [up[0]])[0]]
    for k in range(poses - 1):
        first, second = turn_parts(up[k], up[k + 1], random.uniform(-2, 2))
        rates = turn_rates(first, second, used_samples, interval)
        white = noise * random.standard_normal((used_samples, 3)) @ factor_n.T / np.sqrt(interval)
        output[k, :used_samples] = rates @ gain_g.T + bias_g + white
        intervals[k, :used_samples] = interval
        attitudes.append(attitudes[-1] * Rotation.from_rotvec(first) * Rotation.from_rotvec(second))

    def covariances(factor):
        covariance = np.tile(np.eye(3), (padded, 1, 1))
        covariance[:poses] = factor @ np.swapaxes(factor, -1, -2)
        return jnp.asarray(covariance)

    mask = np.arange(padded) < poses
    observations = Observations(
        Poses(
            jnp.asarray(mean_a), covariances(factor_a), jnp.asarray(mean_g), covariances(factor_g),
            jnp.arange(padded) * 4.0, jnp.arange(padded) * 4.0 + 2.0, jnp.full(padded, 25.0), jnp.asarray(mask),
        ),
        Turns(
            jnp.asarray(output), jnp.asarray(intervals), jnp.asarray(factor_n @ factor_n.T),
            jnp.asarray(np.linalg.svd(mean_a[1:, None, :])[2][:, 1:, :]), jnp.asarray(mask[1:]),
        ),
        jnp.asarray(GRAVITY),
    )  # fmt: skip
    return Simulated(observations, imu, up, Rotation.concatenate(attitudes))


def recording(
    seed: int,
    directions: np.ndarray | None = None,
    poses: int = POSES,
    rest: float = 2.0,
    turn: float = 1.5,
    rates: tuple[float, float] = (100.0, 100.0),
    jitter: float = 0.0,
    density: tuple[float, float] = (2e-6, 1e-8),
    quantum: tuple[float, float] = (0.0, 0.0),
    slow: tuple[tuple[int, float, np.ndarray, float], ...] = (),
    imu: Imu | None = None,
) -> tuple[Recording, np.ndarray]:
    """A recording of rests and turns, and the start and stop (s) of each rest's still part.

    **Arguments:** `rates`: Hz of accelerometer and gyroscope, each on stamps of its own, shifted and jittered by
    `jitter` sample periods. `density`: white noise, (m/s²)² s and (rad/s)² s. `quantum`: steps of the outputs.
    `slow`: (k, rate in rad/s, lab axis, share) turns the unit evenly through the last share of rest k.
    """
    random = np.random.default_rng([seed, 4])
    imu = unit(seed) if imu is None else imu
    up = spread_directions(poses, seed) if directions is None else directions
    drifts = {k: (rate, axis / np.linalg.norm(axis), share) for k, rate, axis, share in slow}
    # the path of attitudes: at each knot a time and a rotation, between them a constant axis and a stated profile
    start, attitude = 0.0, Rotation.align_vectors([[0, 0, 1.0]], [up[0]])[0]
    pieces, rests = [], []
    for k in range(len(up)):
        rate, axis, share = drifts.get(k, (0.0, np.zeros(3), 0.0))
        still = rest * (1 - share)
        pieces.append((start, start + still, attitude, np.zeros(3), False))
        rests.append((start, start + still))
        if share:
            vector = attitude.inv().apply(rate * rest * share * axis)
            pieces.append((start + still, start + rest, attitude, vector, False))
            attitude = attitude * Rotation.from_rotvec(vector)
        start += rest
        if k + 1 < len(up):
            now = attitude.inv().apply([0, 0, 1.0])
            for part in turn_parts(now, up[k + 1], random.uniform(-2, 2)):
                pieces.append((start, start + turn / 2, attitude, part, True))
                attitude, start = attitude * Rotation.from_rotvec(part), start + turn / 2
    begins = np.array([piece[0] for piece in pieces])

    def angle(at, piece, swelling):
        share = np.clip((at - piece[0]) / max(piece[1] - piece[0], 1e-9), 0, 1)
        return np.where(swelling, share - np.sin(2 * np.pi * share) / (2 * np.pi), share)

    def stamps(rate, shift):
        time = shift + np.arange(int((start - shift) * rate)) / rate
        return time + jitter / rate * random.uniform(-0.5, 0.5, len(time))

    def noise(count, density, rate):
        return np.sqrt(density * rate) * random.standard_normal((count, 3))

    time_a, time_g = stamps(rates[0], 0.0), stamps(rates[1], 0.0 if rates[0] == rates[1] else 0.0037)
    force, rate = np.empty((len(time_a), 3)), np.zeros((len(time_g), 3))
    for i, piece in enumerate(pieces):
        end = begins[i + 1] if i + 1 < len(begins) else np.inf
        inside = (time_a >= piece[0]) & (time_a < end)
        if i == 0:
            inside |= time_a < piece[0]
        vectors = angle(time_a[inside], piece, piece[4])[:, None] * piece[3]
        force[inside] = GRAVITY * (piece[2] * Rotation.from_rotvec(vectors)).inv().apply([0, 0, 1.0])
        # a gyroscope's sample is the mean rate over its interval, which may reach over a piece's end
        middle = (time_g[1:] + time_g[:-1]) / 2
        edges = np.concatenate([[time_g[0] - 0.5 / rates[1]], middle, [time_g[-1] + 0.5 / rates[1]]])
        rate += (np.diff(angle(edges, piece, piece[4])) / np.diff(edges))[:, None] * piece[3]
    output_a = np.asarray(imu.accelerometer.gain) @ force.T + np.asarray(imu.accelerometer.bias)[:, None]
    output_g = np.asarray(imu.gyroscope.gain) @ rate.T + np.asarray(imu.gyroscope.bias)[:, None]
    output_a = output_a.T + noise(len(time_a), density[0], rates[0])
    output_g = output_g.T + noise(len(time_g), density[1], rates[1])
    for output, step in ((output_a, quantum[0]), (output_g, quantum[1])):
        if step:
            np.copyto(output, np.round(output / step) * step)
    return Recording(Signal(time_a, output_a, "m/s^2"), Signal(time_g, output_g, "rad/s")), np.array(rests)
