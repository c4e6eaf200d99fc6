"""A recording against a measured attitude, asked for what the model lacks."""

from __future__ import annotations

from functools import partial

from jaximu.calibration import calibrate_against_attitude
from jaximu.calibration.attitude import prepared_against
from jaximu.diagnosis.diagnosis import Diagnosis, diagnose_data
from jaximu.ground.gravity import STANDARD, Gravity
from jaximu.model.noise_model import NoiseModel
from jaximu.noise.at_rest import noise_of
from jaximu.recordings.attitude import Attitude
from jaximu.recordings.recording import Recording


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
    known = noise_of(static)
    with prepared_against(recording, attitude, repair) as (ready,):
        calibrated = partial(calibrate_against_attitude, ready, attitude, gravity, static=known)
        calibration, measurement = calibrated()
        return diagnose_data(
            calibration,
            measurement,
            known or measurement.white_noise(calibration.excess),
            lambda effects: calibrated(effects=effects)[0],
            findings=ready.findings,
            notes=calibration.notes,
            level=level,
        )
