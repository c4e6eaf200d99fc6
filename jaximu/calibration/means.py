"""Calibration from a table of pose means, as papers print them: gravity's norm, and the gyroscope's bias at rest."""

from __future__ import annotations

from dataclasses import replace

from jaximu.calibration.calibration import Calibration, concluded, provenance
from jaximu.calibration.hand_held import fit_hand_held
from jaximu.calibration.nominal import nominal_imu
from jaximu.calibration.refusals import relative_covariance, require_solved, require_spanning
from jaximu.data.poses import EXCESS_NAMES, residual_rms
from jaximu.estimation.problem import Loss
from jaximu.ground.errors import NotPossibleError
from jaximu.ground.gravity import STANDARD, Gravity, as_gravity
from jaximu.ground.precision import require_float64
from jaximu.model.sensor import Imu
from jaximu.recordings.recording import PoseMeans
from jaximu.recordings.segmentation import observe_means

__all__ = ["calibrate_means"]

_SPARE = 3
"""Poses beyond the parameters, from whose misfit an unknown noise is taken."""


def calibrate_means(means: PoseMeans, gravity: Gravity = STANDARD, loss: Loss = "linear") -> Calibration:
    """Calibrate an accelerometer, and a gyroscope's bias, from a table of mean outputs at rest.

    **Arguments:**

    - `means`: a row a pose. Where it does not state how far its means are off, their misfit tells it.
    - `gravity`: local gravity, m/s²; its uncertainty goes into the accelerometer's scales.
    - `loss`: `"linear"`, `"huber"` or `"cauchy"`.

    Raises `NotPossibleError` where the poses do not span enough orientations, are too few to tell their own noise, or
    the fit does not converge.
    """
    require_float64()
    gravity = as_gravity(gravity)
    recording = means.recording
    where, poses = recording.name, len(recording.accelerometer)
    observations = observe_means(means, gravity.value)
    nominal, notes = nominal_imu(recording)
    method = "accelerometer" if recording.gyroscope is None else "joint"
    found = fit_hand_held(nominal, observations, method, loss)
    if bool(found.finite):
        require_spanning(relative_covariance(found), found.names, poses, where)
    free = sum(name.owner == "accelerometer" for name in found.names)
    if means.accelerometer_sigma is None and poses < free + _SPARE:
        raise NotPossibleError(
            f"{where}: {poses} poses for {free} parameters do not show how uncertain the means are: "
            f"add {free + _SPARE - poses} poses, or columns accel_sigma_x [m/s^2], … with the samples' standard "
            "deviations, and samples, their number. Poses known beforehand (six positions) are for `jaximu turntable`."
        )
    require_solved(found, where)
    if method == "accelerometer":
        found = replace(found, imu=Imu(found.imu.accelerometer, None))
    before, after = (residual_rms(imu, observations, method == "joint") for imu in (nominal, found.imu))
    stated = {"accelerometer": means.accelerometer_sigma is not None}
    if method == "joint":
        stated["gyroscope"] = means.gyroscope_sigma is not None
        notes += ("a table of means has no turns: the gyroscope's gain stays at the data sheet's.",)
    if not all(stated.values()):
        unknown = " and the ".join(name for name, known in stated.items() if not known)
        notes += (f"how far the means of the {unknown} are off is not stated: intervals are from their misfit.",)
    data = {key: value for key, value in provenance([recording]).items() if "rate" not in key}
    calibration = concluded(
        found, gravity=gravity, method=method, loss=loss, excess_names=EXCESS_NAMES,
        rms={name: (before[name][0], value, unit) for name, (value, unit) in after.items()},
        data=data | {"poses": poses, "turns": 0}, notes=(*recording.notes, *notes), observations=observations,
        nominal=nominal, reading=recording.reading,
    )  # fmt: skip
    known = {name: size for name, size in calibration.excess.items() if stated.get(name)}
    return replace(calibration, excess=known)
