"""Known poses and turns: mean outputs less what the model makes of what the set-up says, effects of either included."""

from __future__ import annotations

from dataclasses import dataclass

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from jaximu.data.station_error import turntable_error
from jaximu.estimation.covariance import Covariance, inverse_cholesky
from jaximu.estimation.data import About, Conditions, Data
from jaximu.estimation.rows import TEMPERATURE, TIME, ResidualKind, Rows, Sizes, by_axis
from jaximu.ground import stored
from jaximu.ground.array_types import Array, IntArray
from jaximu.ground.distributions import rms
from jaximu.ground.rotation import Number
from jaximu.ground.tracing import lifted, on_host, part_of
from jaximu.ground.vectors import column_lengths
from jaximu.model.sensor import Imu
from jaximu.recordings.observations import Stations

RESIDUALS = (
    ResidualKind("accelerometer", "specific force in the poses", "m/s^2", 3),
    ResidualKind("turns", "rate over the turns", "rad/s", 3),
    ResidualKind("static_gyroscope", "rate at rest", "rad/s", 3, centred=True),
)


class StationConditions(Conditions):
    """The errors of the stations' mean outputs (output units), accelerometer and gyroscope of one after another."""

    stations: Stations

    @property
    def magnitude(self) -> Array:
        """Local gravity, m/s²."""
        return self.stations.gravity

    def __call__(self, imu: Imu) -> Float[Array, " 6*S"]:
        """Return the errors, zero where a station is not used."""
        return turntable_error(imu, self.stations).T.ravel()

    def at_magnitude(self, magnitude: Number) -> StationConditions:
        """Return the same with another gravity: specific force is in proportion to it."""
        stations = self.stations
        force = stations.stimulus.specific_force * (magnitude / stations.gravity)
        return StationConditions(eqx.tree_at(lambda s: s.stimulus.specific_force, stations, force))


def station_rows(imu: Imu, stations: Stations) -> Rows:
    """Return what each error of a mean output is, by a unit close to this one."""
    stations = on_host(stations)
    count, turn, start, stop = len(stations.turn), stations.turn, stations.start, stations.stop
    station, stimulus = np.arange(count).repeat(6), stations.stimulus
    kind = np.column_stack([np.zeros(count, np.int64), np.where(turn, 1, 2)]).repeat(3, axis=1).ravel()
    covariates = {TIME: ((start + stop) / 2).repeat(6)}
    if stimulus.temperature is not None:
        covariates[TEMPERATURE] = np.asarray(stimulus.temperature).mean(axis=1).repeat(6)
    force, rate = (
        np.asarray(vectors).mean(axis=1).repeat(6, axis=0)
        for vectors in (stimulus.specific_force, stimulus.angular_rate)
    )
    turning = (kind == 1)[:, None]
    covariates |= by_axis("specific force", "m/s²", np.where(turning, np.nan, force))
    covariates |= by_axis("rate", "°/s", np.where(turning, np.degrees(rate), np.nan))
    scale = [triad.scales for triad in imu.triads().values()]
    used = np.column_stack([stations.accelerometer_used, stations.gyroscope_used])
    return Rows(
        kinds=RESIDUALS,
        kind=kind,
        first=station,
        last=station,
        to_si=1 / np.tile(np.concatenate([*scale, np.ones(3)])[:6], count),
        used=used.repeat(3, axis=1).ravel(),
        covariates=covariates,
        spans=np.column_stack([start, stop]),
    )


def station_excess(stations: Stations) -> Float[Array, "3 6 S"]:
    """Return the variances of a unit excess of accelerometer poses, of turns, and of gyroscope poses, by axis.

    A unit is the mean measured variance of the stations of a kind.
    """
    covariance = jnp.concatenate([stations.accelerometer_covariance, stations.gyroscope_covariance])
    accelerometer, gyroscope = stations.accelerometer_used, stations.gyroscope_used
    none = jnp.zeros_like(accelerometer)
    kinds = [[accelerometer, none], [none, gyroscope & stations.turn], [none, gyroscope & ~stations.turn]]
    diagonal = covariance.diagonal(axis1=-2, axis2=-1)
    member = jnp.array(kinds).repeat(3, axis=1).astype(diagonal.dtype)
    mean = (member * diagonal).sum(axis=-1) / jnp.maximum(member.sum(axis=-1), 1.0)
    return member * mean[..., None]


def station_weights(stations: Stations, excess: Float[Array, " 3"]) -> Float[Array, "6 S S"]:
    """Return W with W C Wᵀ = I for each axis, C the measured covariance and the excess of `station_excess`."""
    measured = jnp.concatenate([stations.accelerometer_covariance, stations.gyroscope_covariance])
    added = jnp.einsum("k,kas->as", excess, station_excess(stations))
    return inverse_cholesky(measured + added[..., None] * jnp.eye(measured.shape[-1]))


def turntable(imu: Imu, stations: Stations, weights: Float[Array, "6 S S"]) -> Float[Array, " 6*S"]:
    """Return the whitened errors, axis after axis.

    **Arguments:** `weights`: the inverse Cholesky factor of each axis's covariance, from `station_weights`.
    """
    return (weights * turntable_error(imu, stations)[:, None, :]).sum(axis=-1).ravel()


def station_covariance(stations: Stations) -> Covariance:
    """Return the covariance of the errors, with an excess of poses, of turns and of the gyroscope at rest."""
    measured = jnp.concatenate([stations.accelerometer_covariance, stations.gyroscope_covariance])
    used = jnp.stack([stations.accelerometer_used, stations.gyroscope_used]).repeat(3, axis=0).astype(float)
    masked = used[:, :, None] * used[:, None, :] * measured
    whole = jnp.einsum("ast,ab->satb", masked, jnp.eye(len(masked))).reshape((used.size,) * 2)
    factors = tuple(jnp.sqrt(unit.T.ravel()) for unit in station_excess(stations))
    kind = jnp.where(stations.turn, 1, 2)
    group = jnp.column_stack([jnp.zeros_like(kind), kind]).repeat(3, axis=1).ravel()
    return Covariance(whole, factors, used.T.ravel(), group)


class KnownStations(Data):
    """Stations of a unit, or of units with a leading axis on every array."""

    effects_inside = True
    coarse = (0.0, 0.0, 0.0)

    def __init__(self, stations: Stations):
        self.stations = lifted(stations) if np.ndim(stations.gravity) == 0 else stations

    def take(self, lanes: IntArray) -> KnownStations:
        """Return the measurement of some of the units."""
        return KnownStations(part_of(self.stations, lanes))

    def about(self, imu: Imu) -> About:
        """Return the errors, whatever the unit."""
        covariance = station_covariances(self.stations)
        return About(StationConditions(self.stations), covariance, np.zeros((*covariance.used.shape, 0)))


def station_covariances(stations: Stations) -> Covariance:
    """Return the covariances of the stations of units, the leading axis of every array, compiled."""

    def batch(stations):
        return jax.lax.map(station_covariance, stations)

    return stored.call(batch, "station covariance", stations, quick=np.shape(stations.gravity)[0] == 1)


@dataclass(frozen=True)
class StationErrors:
    """Errors of one kind, by station: `name`, `unit`, index `station` (n,), `error` and `sigma` (3, n)."""

    name: str
    unit: str
    station: np.ndarray
    error: np.ndarray
    sigma: np.ndarray


def station_errors(imu: Imu, stations: Stations, excess: np.ndarray) -> list[StationErrors]:
    """Return the errors of each kind in SI: force and rate in poses, and the angle of turns (degrees)."""

    def compute(imu, stations, excess):
        variance = jnp.diagonal(station_covariance(stations).total(excess)).reshape(-1, 6).T
        return turntable_error(imu, stations), jnp.sqrt(variance)

    error, sigma = map(np.asarray, stored.call(compute, "station errors", imu, stations, excess))
    stations = on_host(stations)
    scale = [triad.scales[:, None] for triad in imu.triads().values()]
    gyroscope, turn = stations.gyroscope_used, stations.turn
    degrees = np.degrees(stations.stop - stations.start)
    kinds = [("specific_force", "m/s^2", stations.accelerometer_used, slice(3), 1.0)]
    if len(scale) > 1:
        kinds += [
            ("rate_at_rest", "rad/s", gyroscope & ~turn, slice(3, 6), 1.0),
            ("turn_angle", "deg", gyroscope & turn, slice(3, 6), degrees),
        ]
    errors = []
    for name, unit, used, rows, factor in kinds:
        station, per = np.flatnonzero(used), factor / scale[rows.start is not None]
        values = ((part[rows] * per)[:, station] for part in (error, sigma))
        errors.append(StationErrors(name, unit, station, *values))
    return errors


def station_rms(imu: Imu, stations: Stations) -> Sizes:
    """Return the rms of each kind of error, as vectors, with its unit."""
    return {
        kind.name: (rms(column_lengths(kind.error)), kind.unit)
        for kind in station_errors(imu, stations, np.zeros(len(KnownStations.coarse)))
        if len(kind.station)
    }
