"""A recording against a measured attitude, asked for what the model lacks.

How the reference is mounted, late, smoothed and beside the unit is known to what set-ups usually are, and no more: that
is part of the conditions' covariance. So is what the fit says of the noise of unit and reference.
"""

from __future__ import annotations

import jax
import numpy as np

from jaximu.calibration import Calibration, calibrate_against_attitude
from jaximu.data.attitude import EXCESS_NAMES
from jaximu.diagnosis.diagnosis import Diagnosis, Examination, examine
from jaximu.diagnosis.experiment import Experiment
from jaximu.ground.errors import NotPossibleError
from jaximu.ground.gravity import STANDARD, Gravity, as_gravity
from jaximu.mistakes import inspect
from jaximu.model.noise_model import NoiseModel
from jaximu.noise.at_rest import noise_of
from jaximu.recordings.attitude import Attitude
from jaximu.recordings.recording import Recording

__all__ = ["diagnose_against_attitude"]


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
        setup = tuple(effect for effect in fitted.imu.all_effects().values() if effect.scope == "fixture")
        start = jax.tree.map(np.asarray, calibration.imu.with_effects())
        excess = np.array([fitted.excess[name] for name in EXCESS_NAMES])
        experiment = Experiment(measurement, start, setup=setup, excess=excess, reference=fitted.reference)
        return examine(
            Examination(
                calibration, noise, lambda noise: experiment, None, findings, calibration.notes, level, trusted=True
            )
        )

    diagnosis = examined(calibration)
    if not diagnosis.named:
        return diagnosis
    effects = [named.effect for named in diagnosis.named]
    try:
        calibrated = calibrate_against_attitude(
            recording, attitude, gravity, static=known, effects=effects, repair=repair
        )[0]
    except NotPossibleError:  # beside noise that is estimated with them they may be open: the first answer stands
        return diagnosis
    return examined(calibrated)
