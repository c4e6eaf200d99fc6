"""A kind of data that the library has not, whole: mean outputs on a centrifuge, where force and rate are known."""

from __future__ import annotations

from dataclasses import dataclass, replace

import jax
import jax.numpy as jnp
import numpy as np

from jaximu.data.recorded_stations import output_reaction
from jaximu.estimation.covariance import Covariance
from jaximu.estimation.data import About, Conditions, Data, Observed
from jaximu.estimation.rows import TIME, ResidualKind, Rows
from jaximu.estimation.track import Track, added, mean_outputs
from jaximu.ground.array_types import Array
from jaximu.model.stimulus import Stimulus

KINDS = (
    ResidualKind("force", "force on the centrifuge", "m/s^2", 3),
    ResidualKind("rate", "rate on the centrifuge", "rad/s", 3),
)


class OutputErrors(Conditions):
    """Mean outputs less those of a unit without effects, accelerometer and gyroscope of one speed after another."""

    output: Array
    stimulus: Stimulus
    magnitude: Array

    def __call__(self, imu):
        outputs = [triad.respond(self.stimulus) for triad in imu.with_effects().triads().values()]
        return (self.output - jnp.concatenate(outputs, axis=1)).ravel()


@dataclass
class Centrifuge(Data):
    """Mean outputs (n, 6), m/s² and rad/s, at speeds where force and rate (n, 3) are known, between spans (n, 2), s.

    sigma (6,): standard deviation of a mean output.
    """

    output: np.ndarray
    force: np.ndarray
    rate: np.ndarray
    between: np.ndarray
    sigma: np.ndarray
    gravity: float = 9.80665

    excess_names, coarse = ("centrifuge",), (0.0,)

    def free(self, name):
        return True  # the axes are the arm's

    def about(self, imu):
        unit = jax.tree.map(lambda leaf: leaf[0], imu)
        stimulus = Stimulus(self.force, self.rate, np.zeros_like(self.rate), time=self.between.mean(axis=1))
        tracks = dict.fromkeys(("accelerometer", "gyroscope"), Track(stimulus, np.arange(len(self.force))))
        left = self.output - np.asarray(mean_outputs(tracks, added(unit, tracks), len(self.force)))
        sigma = np.tile(self.sigma, len(self.force))
        covariance = Covariance(np.diag(sigma**2), (sigma,), np.ones(len(sigma)), np.zeros(len(sigma), int))
        parts = OutputErrors(left, stimulus, np.asarray(self.gravity)), covariance
        conditions, covariance = jax.tree.map(lambda leaf: np.asarray(leaf)[None], parts)
        return About(conditions, covariance, self.own_columns(unit, tracks, len(sigma))[None], tracks)

    def reactions(self, details):
        count = len(self.force)

        def of(effect, imu, tracks):
            return mean_outputs(tracks, added(imu.with_effects(effect), tracks), count).ravel()

        return f"centrifuge {count}", of, [details]

    def rows(self, imu):
        speed = np.repeat(np.arange(len(self.force)), 6)
        ones, times = np.ones(len(speed)), {TIME: self.between.mean(axis=1)[speed]}
        return Rows(
            KINDS, np.tile([0, 0, 0, 1, 1, 1], len(self.force)), speed, speed, ones, ones > 0, times, self.between
        )

    def spans(self):
        return [self.between]

    def tracks(self, details):
        return [details]

    def observed(self, imu, details):
        used = np.ones(len(self.force), bool)
        return Observed(lambda triad, shape: output_reaction(triad, shape, used), np.linspace(0, 1, len(used)))

    def without(self, observation):
        names = "output", "force", "rate", "between"
        return replace(self, **{name: np.delete(getattr(self, name), observation, axis=0) for name in names})
