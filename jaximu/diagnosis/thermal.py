"""Recordings at rest over temperature as the linear problem that a diagnosis asks questions of.

The unit lies still in each rest, in a pose that nothing tells exactly: what it puts out there at the reference
temperature is free (a level of large variance in the covariance), and only what changes within a rest is evidence.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float
from numpy.typing import NDArray

from jaximu.calibration import calibrate_thermal
from jaximu.calibration.thermal_selection import folds_of
from jaximu.calibration.thermal_shapes import ThermalShapes
from jaximu.calibration.thermal_terms import HISTORY, RATES
from jaximu.data import RestBlocks
from jaximu.data.rest_blocks import rest_blocks
from jaximu.data.track import Track, added, mean_outputs
from jaximu.diagnosis.diagnosis import Diagnosis, Examination, examine
from jaximu.diagnosis.evidence import EffectBlock
from jaximu.diagnosis.experiment import Experiment, State
from jaximu.diagnosis.learned import left_out
from jaximu.diagnosis.shapes import Shapes, placed
from jaximu.diagnosis.twin import drawn_noise
from jaximu.estimation.covariance import Covariance
from jaximu.estimation.data import About, Conditions
from jaximu.estimation.fitting import Linear
from jaximu.estimation.problem import Name
from jaximu.estimation.rows import TIME, ResidualKind, Rows
from jaximu.ground.array_types import Array, FloatArray
from jaximu.ground.errors import NotPossibleError
from jaximu.ground.rotation import apply_matrix
from jaximu.mistakes import inspect
from jaximu.model.effects import Effect
from jaximu.model.effects.base import Extent
from jaximu.model.noise_model import NoiseModel
from jaximu.model.sensor import Imu
from jaximu.noise.at_rest import noise_of
from jaximu.recordings.recording import Recording, recordings_of

__all__ = ["Resting", "RestingConditions", "diagnose_thermal"]

_TRIADS = ("accelerometer", "gyroscope")
_LEVEL = (1.0, 0.1)  # m/s² and rad/s: how far a rest may lie from another, as good as free
_SMOOTH = (1.0, 0.1)  # m/s² and rad/s: the same of a smooth function of temperature
_BLOCKS = 120
_IN_POSES = ("accel.scale_temperature", "accel.misalignment_temperature")
_PLACES = 40  # at which a step is sought
_WAYS = 4  # of the temperature, from which on they are left out whole
_NAMED = 3  # effects that can be named one by one
_CYCLE = (
    "Record a cycle: the same temperatures up and down, then again at another rate; what depends on time or on "
    "power-on does not come back with the temperature, and what depends on its rate changes sign."
)


_RESIDUALS = (
    ResidualKind("accelerometer", "specific force at rest", "m/s^2", 3, centred=True),
    ResidualKind("static_gyroscope", "rate at rest", "rad/s", 3, centred=True),
)


class RestingConditions(Conditions):
    """Mean outputs (n, 6) of blocks, without what effects add, less those of a unit at rest under the force (n, 3)."""

    output: Float[Array, "n 6"]
    force: Float[Array, "n 3"]
    magnitude: Float[Array, ""]

    def __call__(self, imu: Imu) -> Float[Array, " 6*n"]:
        """Return the errors of the mean outputs, accelerometer and gyroscope of one block after another."""
        assert imu.gyroscope is not None
        force = apply_matrix(imu.accelerometer.gain, self.force) + imu.accelerometer.bias
        rate = jnp.broadcast_to(imu.gyroscope.bias, force.shape)
        return (self.output - jnp.concatenate([force, rate], axis=-1)).reshape(-1)

    def at_magnitude(self, magnitude: Float[Array, ""]) -> RestingConditions:
        """Return the same: the force is the measured one."""
        return self


@dataclass
class Resting(Experiment):
    """A unit at rest over temperature, its noise known.

    smooth: whether any smooth function of temperature is allowed beforehand, so that only what goes beyond is asked.
    """

    blocks: RestBlocks
    noise: NoiseModel
    start: Imu
    smooth: bool = False

    excess_names = _TRIADS
    coarse = (0.0, 0.0)
    no_fixture = "a recording at rest has no set-up to compare with"

    def askable(self, linear: Linear) -> tuple[dict[str, type[Effect]], dict[str, str]]:
        """Return the effects that can be asked; in one pose none that is a part of bias over temperature there."""
        asked, refused = super().askable(linear)
        if not self.blocks.several_poses:
            for name in _IN_POSES:
                if asked.pop(name, None) is not None:
                    refused[name] = "in one pose it is a bias over temperature: poses tell them apart"
        return asked, refused

    def rows(self, imu: Imu) -> Rows:
        """Return what each condition is: three of the accelerometer, then three of the gyroscope, of each block."""
        count, blocks = len(self.blocks), self.blocks
        block = np.repeat(np.arange(count), 6)
        return Rows(
            kinds=_RESIDUALS,
            kind=np.tile(np.repeat([0, 1], 3), count),
            first=block,
            last=block,
            to_si=np.tile(1 / self._scale, count),
            used=np.ones(6 * count, bool),
            covariates={
                TIME: np.repeat(blocks.time, 6),
                "temperature [°C]": np.repeat(blocks.temperature, 6),
                "rate of temperature [K/min]": np.repeat(60 * blocks.rate, 6),
            },
            spans=np.stack([blocks.start, blocks.stop], axis=1),
            observation="block",
        )

    def free(self, name: Name) -> bool:
        """Return whether a number is free: gain does not show at rest."""
        return name.part != "gain"

    def about(self, imu: Imu) -> About:
        """Return the mean outputs less those of one unit, the leading axis, and its effects' columns."""
        unit = jax.tree.map(lambda leaf: leaf[0], imu)
        tracks = self._tracks(unit)
        output = self._outputs - (self._added(unit, tracks) if unit.all_effects() else 0.0)
        conditions = RestingConditions(output[None], self._force(unit)[None], np.zeros(1))  # pyright: ignore[reportArgumentType]
        return About(conditions, self._covariance, self.own_columns(unit, tracks, output.size)[None], tracks)

    def reactions(self, details: list[dict[str, Track]]):
        """Return how the mean outputs react to effects, recording by recording."""
        count = len(self.blocks)

        def of(effect, imu, tracks):
            return mean_outputs(tracks, added(imu.with_effects(effect), tracks), count).reshape(-1)

        return f"rest {count}", of, details

    def generic(self, imu: Imu, linear: Linear) -> list[EffectBlock]:
        """Return shapes without a cause, and blocks in which the unit was knocked."""
        blocks, count = self.blocks, len(self.blocks)
        shapes = Shapes(lambda triad, shape: placed(triad, shape, np.ones(count, bool)))
        share = blocks.time - blocks.time.min()
        questions = shapes.slow_changes(share / share.max())
        if not self.smooth:
            curves = ThermalShapes(blocks, imu.accelerometer.temperature_reference).smooth()
            questions += [
                shapes.block(triad, f"the {triad} depends smoothly on temperature", curves) for triad in _TRIADS
            ]
        return questions + shapes.bumped(np.arange(count), np.arange(count))

    def extent(self) -> Extent:
        """Return what the recordings span."""
        edges = np.sort(np.unique(self.blocks.start))[1:]
        every = -(-len(edges) // _PLACES)
        return Extent(
            max(self.blocks.spans),
            tuple(float(edge) for edge in edges[::every]),
            float(np.ptp(self.blocks.range)),
        )

    def tracks(self, linear: Linear) -> list[dict[str, Track]]:
        """Return what the unit went through, part by part."""
        return linear.details

    def lacks(self, linear: Linear) -> dict[str, str]:
        """Return fields of the stimulus that are not known along the path, and why."""
        return {
            "vibration_power": "the unit was at rest",
            "attitude": "at rest, the attitude about the vertical is unknown",
        }

    def largest(self, state: State, effect: Effect) -> dict[str, float]:
        """Return the most (SI) that an effect adds to each triad's mean output."""
        most = np.abs(self._added(state.imu.with_effects(effect), state.linear.details)) / self._scale
        return {"accelerometer": float(most[:, :3].max()), "gyroscope": float(most[:, 3:].max())}

    def without(self, place: int) -> Resting:
        """Return the recordings with a block left out."""
        return replace(self, blocks=self.blocks.only(np.arange(len(self.blocks)) != place))

    def parts(self) -> list[NDArray[np.int64]]:
        """Return whole ways of the temperature, where there are enough."""
        legs = self.blocks.legs()
        return folds_of(self.blocks, legs) if len(legs) >= _WAYS else super().parts()

    def rms(self, imu: Imu, linear: Linear) -> dict[str, tuple[float, str]]:
        """Return the rms of each kind of residual, with its unit."""
        return self.real.rms(linear.conditions)

    def twin(self, state: State, noise: NoiseModel, seed: int) -> Resting:
        """Return the recordings as a fit without effects would have them, noise included."""
        made = []
        for log, recording in enumerate(self.blocks.recordings):
            changed = {}
            for number, (name, triad) in enumerate(state.imu.triads().items()):
                signal = getattr(recording, name)
                drawn = drawn_noise(getattr(noise, name), signal, [seed, log, number]) * signal.nominal_scale
                level = np.asarray(triad.bias)
                if name == "accelerometer":
                    own = self.blocks.start[self.blocks.log == log]
                    nearest = np.clip(np.searchsorted(own, signal.time, side="right") - 1, 0, len(own) - 1)
                    force = self._force(state.imu)[self.blocks.log == log][nearest]
                    level = level + force @ np.asarray(triad.gain).T
                changed[name] = replace(signal, values=level + drawn)
            made.append(replace(recording, **changed, notes=()))
        twin = replace(self, blocks=replace(self.blocks, recordings=tuple(made)), noise=noise, start=state.imu)
        means = {
            name: np.stack([part.mean(axis=0) for part in twin.still_parts(name)[0]]) for name in self.blocks.means
        }
        return replace(twin, blocks=replace(twin.blocks, means=means))

    def still_parts(self, triad: str) -> tuple[list[FloatArray], float]:
        """Return what a triad put out (k, 3) in each block, in SI, and its rate, Hz."""
        parts: list[FloatArray] = []
        rate = 1.0
        for log, recording in enumerate(self.blocks.recordings):
            signal = getattr(recording, triad)
            rate, values = signal.rate, signal.si()
            own = self.blocks.log == log
            edges = np.searchsorted(signal.time, np.stack([self.blocks.start[own], self.blocks.stop[own]], axis=1))
            parts += [values[a:b] for a, b in edges]
        return parts, rate

    @property
    def recordings(self) -> tuple[Recording, ...]:
        """What is diagnosed, as it was recorded."""
        return self.blocks.recordings

    @property
    def _scale(self) -> FloatArray:
        signals = [getattr(self.blocks.recordings[0], name) for name in _TRIADS]
        return np.concatenate([signal.nominal_scale for signal in signals])

    @property
    def _outputs(self) -> FloatArray:
        """Mean outputs (n, 6), in output units."""
        offset = np.concatenate([getattr(self.blocks.recordings[0], name).nominal_offset for name in _TRIADS])
        return np.concatenate([self.blocks.means[name] for name in _TRIADS], axis=1) * self._scale + offset

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
        curves = ThermalShapes(blocks, self.start.accelerometer.temperature_reference).smooth() if self.smooth else None
        for triad, name in enumerate(_TRIADS):
            noise = blocks.covariance(getattr(self.noise, name))
            covariance = noise + _LEVEL[triad] ** 2 * same
            if curves is not None:
                covariance = covariance + _SMOOTH[triad] ** 2 * curves @ curves.T
            for axis in range(3):
                place = 3 * triad + axis
                whole[:, place, :, place] = covariance[axis] * self._scale[place] ** 2
                unit[triad, :, place] = np.sqrt(np.mean(np.diag(noise[axis]))) * self._scale[place]
        size = 6 * count
        factors = tuple(each.ravel()[None] for each in unit)
        group = np.tile(np.repeat([0, 1], 3), count)[None]
        return Covariance(whole.reshape(size, size)[None], factors, np.ones((1, size)), group)  # pyright: ignore[reportArgumentType]

    def _tracks(self, imu: Imu) -> list[dict[str, Track]]:
        made = self.blocks.tracks(self._force(imu), imu.accelerometer.temperature_reference)
        return [dict.fromkeys(_TRIADS, track) for track in made]

    def _added(self, imu: Imu, tracks: Sequence[dict[str, Track]]) -> FloatArray:
        """What the unit's effects add to the mean outputs (n, 6)."""
        count = len(self.blocks)
        return np.sum([np.asarray(mean_outputs(each, added(imu, each), count)) for each in tracks], axis=0)


def diagnose_thermal(
    recordings: Recording | Sequence[Recording],
    *,
    static: Recording | NoiseModel | None = None,
    heldout: Recording | Sequence[Recording] | None = None,
    level: float = 0.05,
) -> Diagnosis:
    """Ask recordings at rest over temperature for everything that changes a unit's output there, and name it.

    The model is that which `calibrate_thermal` selects. Where it is a few effects, every effect is asked of a unit of
    constant bias. Else bias may be any smooth function of temperature beforehand; the lag, hysteresis and rates that
    were selected are in the model, and what goes beyond is asked: warm-up, drift, steps. The gain is measured on whole
    ways of the temperature left out in turn. In one way of the temperature a lag is not observable then, and the
    suggestion asks for a cycle.

    **Arguments:** as for [`jaximu.calibration.calibrate_thermal`]; `heldout`: other such recordings of the unit, to
    measure the gain on. Raises what that raises, and `NotPossibleError` without a gyroscope.
    """
    given = recordings_of(recordings)
    if any(recording.gyroscope is None for recording in given):
        raise NotPossibleError("a diagnosis needs accelerometer and gyroscope.")
    noise = noise_of(static)
    thermal = calibrate_thermal(given, static=noise)
    start = jax.tree.map(np.asarray, thermal.calibration.imu.with_effects())
    calibration = thermal.calibration.of_numbers(lambda name: name.effect is None, imu=start)
    known = thermal.noise if noise is None else noise
    blocks = _apart(_coarse(given), thermal.jumps)
    findings = [finding for recording in given for finding in inspect(recording)]
    held = None if heldout is None else _coarse(recordings_of(heldout))
    notes = [*thermal.blocks.notes, *known.notes, *(note for note in thermal.notes if "jumps by" in note)]
    chosen = [effect for triad in thermal.calibration.triads().values() for effect in triad.effects]
    beyond = [effect for effect in chosen if effect.plain in (*RATES, *HISTORY)]

    def asked(smooth: bool, taken: Sequence[Effect]) -> Diagnosis:
        def made(of: RestBlocks) -> Callable[[NoiseModel], Resting]:
            return lambda noise: Resting(of, noise, start, smooth)

        other = None if held is None else made(held)
        said = ["bias was allowed to be any smooth function of temperature; what is named goes beyond that."]
        told = (*dict.fromkeys(notes), *(said if smooth else []))
        return examine(Examination(calibration, known, made(blocks), other, tuple(findings), told, level,
                                   trusted=noise is None, taken=tuple(taken), measured=left_out))  # fmt: skip

    wanted = {effect.name for effect in beyond}

    def misses(found: Diagnosis) -> bool:
        return not wanted <= {name for each in found.named for name in (each.name, *each.rivals)}

    first = asked(False, ()) if len(chosen) <= _NAMED else None
    found = first
    if first is None or first.verdict == "unexplained" or (first.verdict == "effects" and misses(first)):
        found = asked(True, beyond)
        if first is not None and first.verdict == "effects" and misses(found):  # any smooth function hides its cause
            found = first
    assert found is not None
    if "thermal_lag" not in thermal.identifiability.told:  # temperature, its rate and time go together
        found = replace(found, suggestion=f"{found.suggestion} {_CYCLE}".strip())
    return found


def _apart(blocks: RestBlocks, jumps: Sequence[tuple[int, float]]) -> RestBlocks:
    """Return blocks with a rest of its own after each jump (recording, s); the block in which it lies is left out."""
    for log, time in jumps:
        slack = 1e-6 * blocks.duration
        blocks = blocks.only((blocks.log != log) | (blocks.stop <= time + slack) | (blocks.start >= time - slack))
        later = np.flatnonzero((blocks.log == log) & (blocks.start >= time - slack))
        if len(later) and blocks.level[later[0]] == blocks.level[max(later[0] - 1, 0)]:
            blocks = blocks.parted([int(later[0])])
    return blocks


def _coarse(recordings: Sequence[Recording]) -> RestBlocks:
    span = sum(float(np.ptp(recording.accelerometer.time)) for recording in recordings)
    rate = min(recording.accelerometer.rate for recording in recordings)
    return rest_blocks(recordings, max(span / _BLOCKS, 2 / rate))
