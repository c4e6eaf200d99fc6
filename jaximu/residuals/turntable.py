"""Known poses and turns: the mean outputs of a station must be what the model makes of what the set-up says (S8, S9).

Without effects this is the linear model ȳ = K ū + b, twelve parameters a triad: poses give the accelerometer's ū = g
up, turns the gyroscope's ū = axis · angle / duration, because a table's angle is better known than its rate. An effect
of the sensor or of the set-up enters through `Imu.respond` at the nodes of each station, averaged as the outputs are.
"""

import jax.numpy as jnp
from jaxtyping import Float

from jaximu._types import Array
from jaximu.observations import Stations
from jaximu.sensor import Imu
from jaximu.whitening import inverse_cholesky

__all__ = ["station_excess", "station_weights", "turntable", "turntable_error"]


def turntable_error(imu: Imu, stations: Stations) -> Float[Array, "6 S"]:
    """Return mean outputs less the model's (output units), accelerometer's three axes first; zero where not used."""
    outputs = imu.respond(stations.stimulus)
    means = stations.accelerometer_mean, stations.gyroscope_mean
    used = stations.accelerometer_used, stations.gyroscope_used
    rows = []
    for mean, output, there in zip(means, outputs, used, strict=True):
        expected = mean if output is None else jnp.sum(stations.weight[..., None] * output, axis=-2)
        rows.append(jnp.where(there[:, None], mean - expected, 0.0).T)
    return jnp.concatenate(rows)


def turntable(imu: Imu, stations: Stations, weights: Float[Array, "6 S S"]) -> Float[Array, " 6*S"]:
    """Return the whitened errors, axis after axis.

    **Arguments:** `weights`: the inverse Cholesky factor of each axis's covariance, from `station_weights`.
    """
    return jnp.sum(weights * turntable_error(imu, stations)[:, None, :], axis=-1).reshape(-1)


def station_excess(stations: Stations) -> Float[Array, "3 6 S"]:
    """Return the variances of a unit excess of accelerometer poses, of turns, and of gyroscope poses, by axis.

    A unit is the mean measured variance of the stations of a kind.
    """
    diagonal = jnp.concatenate([
        jnp.diagonal(each, axis1=-2, axis2=-1) for each in (stations.accelerometer_covariance,
                                                           stations.gyroscope_covariance)])  # fmt: skip
    accelerometer, gyroscope = stations.accelerometer_used, stations.gyroscope_used
    none = jnp.zeros_like(accelerometer)
    kinds = [(accelerometer, none), (none, gyroscope & stations.turn), (none, gyroscope & ~stations.turn)]
    units = []
    for first, second in kinds:
        member = jnp.repeat(jnp.stack([first, second]), 3, axis=0).astype(diagonal.dtype)
        mean = jnp.sum(member * diagonal, axis=-1) / jnp.maximum(jnp.sum(member, axis=-1), 1.0)
        units.append(member * mean[:, None])
    return jnp.stack(units)


def station_weights(stations: Stations, excess: Float[Array, " 3"]) -> Float[Array, "6 S S"]:
    """Return W with W C Wᵀ = I for each axis, C the measured covariance and the excess of `station_excess`."""
    measured = jnp.concatenate([stations.accelerometer_covariance, stations.gyroscope_covariance])
    added = jnp.einsum("k,kas->as", excess, station_excess(stations))
    return inverse_cholesky(measured + added[..., None] * jnp.eye(measured.shape[-1]))
