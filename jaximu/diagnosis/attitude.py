"""A recording against a measured attitude as the linear problem that a diagnosis asks questions of.

How the reference is mounted, late, smoothed and beside the unit is known to what set-ups usually are, and no more: that
is part of the conditions' covariance. So is what the fit says of the noise of unit and reference.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import equinox as eqx
import jax
import numpy as np
from numpy.typing import NDArray

from jaximu.calibration import Calibration, calibrate_against_attitude
from jaximu.data.attitude import EXCESS_NAMES, AgainstAttitude, AttitudeConditions
from jaximu.data.track import Track
from jaximu.diagnosis.diagnosis import Diagnosis, Examination, examine
from jaximu.diagnosis.evidence import EffectBlock
from jaximu.diagnosis.experiment import Experiment, State
from jaximu.diagnosis.shapes import Shapes
from jaximu.estimation.data import About
from jaximu.estimation.fitting import Linear, Prior, effect_numbers
from jaximu.estimation.rows import Rows
from jaximu.estimation.uncertainty import station_advice
from jaximu.ground.array_types import FloatArray
from jaximu.ground.errors import NotPossibleError
from jaximu.ground.gravity import STANDARD, Gravity, as_gravity
from jaximu.mistakes import inspect
from jaximu.model.effects import Effect
from jaximu.model.effects.base import Extent
from jaximu.model.noise_model import NoiseModel
from jaximu.model.sensor import Imu
from jaximu.noise.at_rest import noise_of
from jaximu.recordings.attitude import Attitude
from jaximu.recordings.recording import Recording

__all__ = ["MeasuredAttitude", "diagnose_against_attitude"]


@dataclass
class MeasuredAttitude(Experiment):
    """A recording whose attitude was measured.

    setup: effects of the fixture, as calibrated. excess (5,): of the noise, as the calibration has it. shift (n,):
    added to the conditions. reference: how it is mounted and late, as `calibration.json` has it.
    """

    measurement: AgainstAttitude
    setup: tuple[Effect, ...]
    excess: FloatArray
    start: Imu
    shift: FloatArray | float = 0.0
    reference: dict[str, Any] | None = None

    excess_names = EXCESS_NAMES
    coarse = AgainstAttitude.coarse
    advice = staticmethod(station_advice)
    no_fixture = "how the reference is mounted, late and smoothed is estimated in any case"

    def rows(self, imu: Imu) -> Rows:
        """Return what each condition is."""
        return self.measurement.rows(imu)

    def about(self, imu: Imu) -> About:
        """Return the conditions about one unit, the leading axis, its effects' columns, and all that is not known."""
        found, noise, unknown, mine = self._evaluated(jax.tree.map(lambda leaf: np.asarray(leaf)[0], imu))
        covariance = eqx.tree_at(lambda each: each.measured, found.covariance, (noise + unknown @ unknown.T)[None])
        assert isinstance(found.conditions, AttitudeConditions)
        shift = found.conditions.shift + self.shift
        conditions = eqx.tree_at(lambda each: each.shift, found.conditions, shift)
        return About(conditions, covariance, found.columns[..., mine], found.details)

    def _evaluated(self, imu: Imu) -> tuple[About, FloatArray, FloatArray, NDArray[np.bool_]]:
        """Return the measurement about a unit and the fixture, as a batch of one, and what of it is noise.

        With it the covariance (n, n) of noise, what the fixture may do (n, q) at one standard deviation of each of its
        numbers, and which of the columns are the unit's own.
        """
        own = imu.all_effects()
        whole = imu.with_effects(*own.values(), *self.setup)
        found = self.measurement.about(jax.tree.map(lambda leaf: np.asarray(leaf)[None], whole))
        names = effect_numbers(whole)[0]
        mine = np.array([(name.owner, name.effect) in own for name in names], bool)
        prior = Prior.of_effects(whole)
        assert prior is not None
        known = dict(zip(prior.names, 1 / np.diag(prior.root), strict=True))
        covariance = jax.tree.map(lambda leaf: np.asarray(leaf)[0], found.covariance)
        noise = np.asarray(covariance.total(self.excess)) - np.diag(1 - covariance.used)
        unknown = found.columns[0][:, ~mine] * [known[name] for name, kept in zip(names, mine, strict=True) if not kept]
        return found, noise, unknown, mine

    def reactions(self, details):
        """Return how the conditions react to effects."""
        return self.measurement.reactions(details)

    def by_setup(self, state: State) -> FloatArray:
        """Return what the fixture most likely adds to the real conditions: its numbers' mean, given the conditions.

        Near the level a tilted reference looks like a bias of the accelerometer; which of both it is, nothing tells.
        """
        unknown = self._evaluated(state.model)[2][self.used]
        return unknown @ ((state.weights @ unknown).T @ (state.weights @ state.conditions))

    def generic(self, imu: Imu, linear: Linear) -> list[EffectBlock]:
        """Return shapes without a cause: slow changes, and what depends on orientation."""
        reactions, stimulus = linear.details.reactions, linear.details.tracks["gyroscope"].stimulus
        time, stamps = np.asarray(stimulus.time), np.asarray(self.measurement.intervals.stamp)
        force = np.asarray(stimulus.specific_force)
        windows = len(self.measurement.intervals.used) // self.measurement.group

        def react(triad: str, shape: FloatArray) -> FloatArray:
            columns = []
            for axis in np.eye(3):
                along = axis[:, None] * shape[:, None, :]
                none = np.zeros_like(along)
                both = (along, none) if triad == "accelerometer" else (none, along)
                columns.append(np.asarray(reactions.react(*both, windows)))
            return np.concatenate(columns, axis=1)

        shapes = Shapes(react)
        up = force / np.linalg.norm(force, axis=1, keepdims=True)
        return shapes.slow_changes((time - stamps[0]) / np.ptp(stamps)) + shapes.orientations(up)

    def extent(self) -> Extent:
        """Return what the recording spans."""
        stamps = np.asarray(self.measurement.intervals.stamp)[:: self.measurement.group]
        warm = self.measurement.recording.temperature
        return Extent(float(np.ptp(stamps)), tuple(stamps[1:-1].tolist()),
                      0.0 if warm is None else float(np.ptp(warm.values)))  # fmt: skip

    def tracks(self, linear: Linear) -> list[dict[str, Track]]:
        """Return what the unit went through, part by part."""
        return [linear.details.tracks]

    def without(self, place: int) -> MeasuredAttitude:
        """Return the recording with a window of the force left out, and the rotations in it."""
        return replace(self, measurement=replace(self.measurement, left_out=(*self.measurement.left_out, place)))

    def rms(self, imu: Imu, linear: Linear) -> dict[str, tuple[float, str]]:
        """Return the rms of each kind of residual, with its unit, as a calibration has it."""
        found = self.real.rms(linear.conditions[self.used])
        return found | {"rotation": (float(np.degrees(found["rotation"][0])), "deg/s")}

    def twin(self, state: State, noise: NoiseModel, seed: int) -> MeasuredAttitude:
        """Return the recording as a fit without effects would have it, along the same motion, noise included."""
        # not what the fixture might do: how this one is mounted and late was found, and taken off
        covariance = self._evaluated(jax.tree.map(np.asarray, state.imu))[1] + np.diag((~self.used).astype(float))
        drawn = np.linalg.cholesky(covariance) @ np.random.default_rng(seed).normal(size=len(self.used))
        return replace(self, start=state.imu, shift=self.shift + drawn * self.used - state.linear.conditions)

    def still_parts(self, triad: str) -> tuple[list[FloatArray], float]:
        """Return no parts: the unit is in motion, and its noise the calibration's."""
        return [], getattr(self.measurement.recording, triad).rate

    @property
    def recordings(self) -> tuple[Recording, ...]:
        """What is diagnosed, as it was recorded."""
        return (self.measurement.recording,)


def diagnose_against_attitude(
    recording: Recording,
    attitude: Attitude,
    gravity: Gravity = STANDARD,
    *,
    static: Recording | NoiseModel | None = None,
    level: float = 0.05,
    repair: bool = False,
) -> Diagnosis:
    """Calibrate a unit against a measured attitude, ask for everything that the model lacks, measure the gain.

    **Arguments:** as for [`jaximu.calibration.calibrate_against_attitude`][] and [`jaximu.diagnosis.diagnose`][]. The
    gain is measured on parts left out.

    What explains the misfit is taken out of the noise, and the rest is asked again. Raises what these two raise.
    """
    gravity = as_gravity(gravity)
    known = noise_of(static)
    calibration, measurement = calibrate_against_attitude(recording, attitude, gravity, static=known, repair=repair)
    findings, noise = tuple(inspect(recording)), known or measurement.white_noise(calibration.excess)

    def examined(fitted: Calibration) -> Diagnosis:
        setup = tuple(each for each in fitted.imu.all_effects().values() if each.scope == "fixture")
        start = jax.tree.map(np.asarray, calibration.imu.with_effects())
        excess = np.array([fitted.excess[name] for name in EXCESS_NAMES])
        experiment = MeasuredAttitude(measurement, setup, excess, start, reference=fitted.reference)
        return examine(Examination(
            calibration, noise, lambda noise: experiment, None, findings, calibration.notes, level, trusted=True
        ))  # fmt: skip

    found = examined(calibration)
    if not found.named:
        return found
    effects = [each.effect for each in found.named]
    try:
        calibrated = calibrate_against_attitude(
            recording, attitude, gravity, static=known, effects=effects, repair=repair
        )[0]
    except NotPossibleError:  # beside noise that is estimated with them they may be open: the first answer stands
        return found
    return examined(calibrated)
