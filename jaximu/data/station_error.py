"""Known poses and turns: the mean outputs of a station must be what the model makes of what the set-up says (S8, S9).

Without effects this is the linear model ȳ = K ū + b, twelve parameters a triad: poses give the accelerometer's ū = g
up, turns the gyroscope's ū = axis · angle / duration, because a table's angle is better known than its rate. An effect
of the sensor or of the set-up enters through `Imu.respond` at the nodes of each station, averaged as the outputs are.
"""

import jax.numpy as jnp
from jaxtyping import Float

from jaximu.ground.array_types import Array
from jaximu.model.sensor import Imu
from jaximu.recordings.observations import Stations


def turntable_error(imu: Imu, stations: Stations) -> Float[Array, "6 S"]:
    """Return mean outputs less the model's (output units), accelerometer's three axes first; zero where not used."""
    outputs = imu.respond(stations.stimulus)
    means = stations.accelerometer_mean, stations.gyroscope_mean
    used = stations.accelerometer_used, stations.gyroscope_used
    rows = []
    for mean, output, there in zip(means, outputs, used, strict=True):
        expected = mean if output is None else (stations.weight[..., None] * output).sum(axis=-2)
        rows.append(jnp.where(there[:, None], mean - expected, 0.0).T)
    return jnp.concatenate(rows)
