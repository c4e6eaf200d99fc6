"""A unit at rest over temperature, both triads at once: mean outputs of blocks less those of the unit in its poses.

The unit lies still in each rest, in a pose that nothing tells exactly: what it puts out there at the reference
temperature is free (a level of large variance in the covariance), and only what changes within a rest is evidence.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from jaximu.data.recorded_stations import output_reaction
from jaximu.data.rest_blocks import WAYS, RestBlocks, folds_of
from jaximu.data.twin_signal import twin_signal
from jaximu.estimation.covariance import Covariance
from jaximu.estimation.data import About, Conditions, Observed, OfOneUnit
from jaximu.estimation.problem import Name
from jaximu.estimation.rows import TIME, ResidualKind, Rows
from jaximu.estimation.track import TRIADS, Track, added, mean_outputs
from jaximu.estimation.uncertainty import pose_advice
from jaximu.ground.array_types import Array, FloatArray, IntArray
from jaximu.ground.distributions import rms
from jaximu.ground.rotation import Number, apply_matrix
from jaximu.ground.vectors import sigmas_of
from jaximu.model.effects.base import Extent
from jaximu.model.noise_model import NoiseModel
from jaximu.model.sensor import Imu
from jaximu.recordings.recording import Recording

_FREE = (1.0, 0.1)  # m/s² and rad/s: how far a rest, or a smooth function of temperature, may lie off, as good as free
_IN_POSES = ("accel.scale_temperature", "accel.misalignment_temperature")
_PLACES = 40  # at which a step is sought
_RESIDUALS = (
    ResidualKind("accelerometer", "specific force at rest", "m/s^2", 3, centred=True),
    ResidualKind("static_gyroscope", "rate at rest", "rad/s", 3, centred=True),
)


class RestingConditions(Conditions):
    """Mean outputs (n, 6) of blocks, without what effects add, less those of a unit at rest under the force (n, 3).

    magnitude: of nothing, as the force is the measured one.
    """

    output: Float[Array, "n 6"]
    force: Float[Array, "n 3"]
    magnitude: Number

    def __call__(self, imu: Imu) -> Float[Array, " 6*n"]:
        """Return the errors of the mean outputs, accelerometer and gyroscope of one block after another."""
        force = apply_matrix(imu.accelerometer.gain, self.force) + imu.accelerometer.bias
        rate = jnp.broadcast_to(imu.triad("gyroscope").bias, force.shape)
        return (self.output - jnp.hstack([force, rate])).ravel()


@dataclass(frozen=True)
class _AtRests:
    """What the unit went through, recording by recording."""

    tracks: list[dict[str, Track]]


@dataclass
class Resting(OfOneUnit):
    """A unit at rest over temperature, its noise known.

    curves (n, k): smooth functions of temperature over the blocks. smooth: whether any sum of them is allowed
    beforehand, so that only what goes beyond is asked.
    """

    blocks: RestBlocks
    noise: NoiseModel
    curves: FloatArray
    smooth: bool = False

    excess_names = TRIADS
    coarse = (0.0, 0.0)
    no_fixture = "a recording at rest has no set-up to compare with"
    advice = staticmethod(pose_advice)

    def rows(self, imu: Imu) -> Rows:
        """Return what each condition is: three of the accelerometer, then three of the gyroscope, of each block."""
        count, blocks = len(self.blocks), self.blocks
        block = np.arange(count).repeat(6)
        return Rows(
            kinds=_RESIDUALS,
            kind=np.tile(np.repeat([0, 1], 3), count),
            first=block,
            last=block,
            to_si=np.tile(1 / self._scale, count),
            used=np.ones(6 * count, bool),
            covariates={
                TIME: blocks.time.repeat(6),
                "temperature [°C]": blocks.temperature.repeat(6),
                "rate of temperature [K/min]": (60 * blocks.rate).repeat(6),
            },
            spans=np.column_stack([blocks.start, blocks.stop]),
            observation="block",
        )

    def free(self, name: Name) -> bool:
        """Return whether a number is free: gain does not show at rest."""
        return name.part != "gain"

    def about_one(self, imu: Imu) -> About:
        """Return the mean outputs less those of the unit, and its effects' columns."""
        force = self._force(imu)
        tracks = self.blocks.tracks(force, imu.accelerometer.temperature_reference)
        details = _AtRests([dict.fromkeys(TRIADS, track) for track in tracks])
        output = self._outputs - (self._added(imu, details.tracks) if imu.all_effects() else 0.0)
        conditions = RestingConditions(output, force, np.float64(0.0))
        return About(conditions, self._covariance, self.own_columns(imu, details, output.size), details)

    def reactions(self, details: _AtRests):
        """Return how the mean outputs react to effects, recording by recording."""
        count = len(self.blocks)

        def of(effect, imu, tracks):
            return mean_outputs(tracks, added(imu.with_effects(effect), tracks), count).ravel()

        return f"rest {count}", of, details.tracks

    @property
    def recordings(self) -> tuple[Recording, ...]:
        """What was recorded."""
        return self.blocks.recordings

    def spans(self) -> list[FloatArray]:
        """Return start and stop (k, 2), s, of the blocks of each recording."""
        edges = np.column_stack([self.blocks.start, self.blocks.stop])
        return [edges[rows] for rows in self.blocks.by_recording]

    def extent(self, recording: int = 0) -> Extent:
        """Return what the recordings span: effects may begin with some of the blocks."""
        edges = np.sort(np.unique(self.blocks.start))[1:]
        every = -(-len(edges) // _PLACES)
        return Extent(
            max(self.blocks.spans),
            tuple(float(edge) for edge in edges[::every]),
            float(np.ptp(self.blocks.range)),
        )

    def hidden(self) -> dict[str, str]:
        """Return what in one pose is a part of bias over temperature there."""
        if self.blocks.several_poses:
            return {}
        return dict.fromkeys(_IN_POSES, "in one pose it is a bias over temperature: poses tell them apart")

    def parts(self, real: Rows, count: int, interleaved: bool = False) -> list[IntArray]:
        """Return whole ways of the temperature, where there are enough, unless parts are to be interleaved."""
        legs = self.blocks.legs()
        return super().parts(real, count, interleaved) if interleaved or len(legs) < WAYS else folds_of(legs)

    def observed(self, imu: Imu, details: _AtRests) -> Observed:
        """Return the blocks; a smooth function of temperature is a shape where it is not allowed beforehand."""
        blocks, count = self.blocks, len(self.blocks)
        gone = blocks.time - blocks.time.min()
        return Observed(
            lambda triad, shape: output_reaction(triad, shape, np.ones(count, bool)),
            gone / gone.max(),
            number=np.arange(count),
            alone=np.arange(count),
            curves=None if self.smooth else self.curves,
        )

    def without(self, observation: int) -> Resting:
        """Return the recordings with a block left out."""
        kept = np.arange(len(self.blocks)) != observation
        return replace(self, blocks=self.blocks.only(kept), curves=self.curves[kept])

    def twin(self, imu: Imu, details: _AtRests, conditions: FloatArray, noise: NoiseModel, seed: int) -> Resting:
        """Return the recordings of a unit without effects, noise included."""
        blocks, made = self.blocks, []
        means: dict[str, list[FloatArray]] = {name: [] for name in blocks.means}
        for log, (recording, mine) in enumerate(zip(blocks.recordings, blocks.by_recording, strict=True)):
            changed = {}
            start, stop = blocks.start[mine], blocks.stop[mine]
            for number, (name, triad) in enumerate(imu.triads().items()):
                signal = recording.signals[name]
                nearest = (start.searchsorted(signal.time, side="right") - 1).clip(0, len(start) - 1)
                true = self._force(imu)[mine][nearest] if name == "accelerometer" else np.zeros((len(signal), 3))
                changed[name] = twin_signal(signal, triad, true, getattr(noise, name), [seed, log, number])
                values, edges = changed[name].si(), signal.time.searchsorted(np.column_stack([start, stop]))
                means[name] += [values[a:b].mean(axis=0) for a, b in edges]
            made.append(replace(recording, **changed, notes=()))
        whole = {name: np.stack(parts) for name, parts in means.items()}
        return replace(self, blocks=replace(blocks, recordings=tuple(made), means=whole), noise=noise)

    @property
    def _scale(self) -> FloatArray:
        return np.concatenate([self.recordings[0].signals[name].nominal_scale for name in TRIADS])

    @property
    def _outputs(self) -> FloatArray:
        """Mean outputs (n, 6), in output units."""
        offset = np.concatenate([self.recordings[0].signals[name].nominal_offset for name in TRIADS])
        return np.hstack([self.blocks.means[name] for name in TRIADS]) * self._scale + offset

    def _force(self, imu: Imu) -> FloatArray:
        """The specific force (n, 3) of each block's rest, by the mean over it."""
        return imu.accelerometer.recover_on_host(self.blocks.by_rest(self._outputs[:, :3]))

    @property
    def _covariance(self) -> Covariance:
        """Noise, the levels of the rests and what is smooth; an excess of each triad's noise, in means over blocks."""
        count, blocks = len(self.blocks), self.blocks
        whole = np.zeros((count, 6, count, 6))
        unit = np.zeros((2, count, 6))
        same = (blocks.level[:, None] == blocks.level).astype(float)
        curved = self.curves @ self.curves.T if self.smooth else 0.0
        for triad, name in enumerate(TRIADS):
            noise = blocks.covariance(getattr(self.noise, name))
            columns = 3 * triad + np.arange(3)
            scale = self._scale[columns]
            covariance = noise + _FREE[triad] ** 2 * (same + curved)
            whole[:, columns, :, columns] = covariance * scale[:, None, None] ** 2
            unit[triad, :, columns] = (rms(sigmas_of(noise), axis=1) * scale)[:, None]
        size = 6 * count
        group = np.tile(np.repeat([0, 1], 3), count)
        return Covariance(whole.reshape(size, size), tuple(unit.reshape(2, size)), np.ones(size), group)

    def allowed(self, count: int) -> FloatArray:
        """Return the columns (count, k) of the levels of the rests and of smooth functions, in standard deviations."""
        blocks = self.blocks
        levels = np.equal(blocks.level[:, None], np.unique(blocks.level)).astype(float)
        shapes = np.hstack([levels, self.curves]) if self.smooth else levels
        columns = np.zeros((len(blocks), 6, shapes.shape[1], 6))
        columns[:, range(6), :, range(6)] = (np.repeat(_FREE, 3) * self._scale)[:, None, None] * shapes
        return columns.reshape(count, -1)

    def _added(self, imu: Imu, tracks: Sequence[dict[str, Track]]) -> FloatArray:
        """What the unit's effects add to the mean outputs (n, 6)."""
        count = len(self.blocks)
        return np.sum([np.asarray(mean_outputs(track, added(imu, track), count)) for track in tracks], axis=0)
