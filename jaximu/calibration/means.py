"""Calibration from a table of pose means, as papers print them: gravity's norm, and the gyroscope's bias at rest."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from jaximu.calibration.calibration import Calibration, concluded, provenance
from jaximu.calibration.hand_held import MISALIGNMENTS_HELD, known_misalignments
from jaximu.calibration.nominal import nominal_imu
from jaximu.calibration.refusals import require_determined
from jaximu.data.poses import EXCESS_NAMES, PosesAndTurns, residual_rms
from jaximu.estimation.fitting import fit
from jaximu.estimation.problem import Loss, names_of, without_equipment_or_effects
from jaximu.ground.errors import NotPossibleError
from jaximu.ground.gravity import STANDARD, Gravity, as_gravity
from jaximu.ground.quantities import listed
from jaximu.ground.rotation import unit_vectors
from jaximu.ground.units import STANDARD_GRAVITY
from jaximu.model.sensor import Imu
from jaximu.recordings.recording import PoseMeans
from jaximu.recordings.segmentation import observe_means

_SPARE = 3
"""Poses beyond the parameters, from whose misfit an unknown noise is taken."""
_SPANNED, _ON = 0.1, 0.5
"""Least singular value of squares and directions that determine scale and bias, and cosine of a row on an axis."""
_FACES, _UPRIGHT = 6, 0.1
"""Faces of a box, and the sine of the tilt below which all poses are on one."""


def calibrate_means(means: PoseMeans, gravity: Gravity = STANDARD, loss: Loss = "linear") -> Calibration:
    """Calibrate an accelerometer, and a gyroscope's bias, from a table of mean outputs at rest.

    **Arguments:**

    - `means`: a row a pose. Where it does not state how far its means are off, their misfit tells it.
    - `gravity`: local gravity, m/s²; its uncertainty goes into the accelerometer's scales.
    - `loss`: `"linear"`, `"huber"` or `"cauchy"`.

    Where there are too few poses to tell their own noise, or all are a box's faces, misalignments are held near zero.
    Raises `NotPossibleError` where the poses do not span enough orientations or are fewer, or the fit does not
    converge.
    """
    gravity, recording = as_gravity(gravity), means.recording
    poses, observations = len(recording.accelerometer), observe_means(means, gravity.value)
    nominal, notes = nominal_imu(recording), ()
    method = "accelerometer" if recording.gyroscope is None else "joint"
    free = [name for name in names_of(nominal) if name.owner == "accelerometer" and without_equipment_or_effects(name)]
    few = means.accelerometer_sigma is None and poses < len(free) + _SPARE
    prior, excess = None, None
    if few or (poses >= _FACES and _open(means)):
        prior = known_misalignments(nominal, free)
        spare = poses - (len(free) - len(prior.names))
        _require_axes(means, len(free), spare)
        excess = None if spare >= _SPARE else np.zeros(len(EXCESS_NAMES))
        written = few * " The means are taken to be as good as their digits."
        notes += (MISALIGNMENTS_HELD.format(poses) + written,)
    at_rest = PosesAndTurns.of(observations, "norm" if method == "accelerometer" else "all")
    fitted = fit(nominal, at_rest, prior=prior, loss=loss, excess=excess, estimate_excess=excess is None)
    require_determined(fitted, recording.name, poses=poses)
    if method == "accelerometer":
        fitted = replace(fitted, imu=Imu(fitted.imu.accelerometer, None))
    stated = {"accelerometer": means.accelerometer_sigma is not None or few}
    if method == "joint":
        stated["gyroscope"] = means.gyroscope_sigma is not None
        notes += ("a table of means has no turns: the gyroscope's gain stays at the data sheet's.",)
    if not all(stated.values()):
        unknown = " and the ".join(name for name, known in stated.items() if not known)
        notes += (f"how far the means of the {unknown} are off is not stated: intervals are from their misfit.",)
    data = {key: value for key, value in provenance([recording]).items() if "rate" not in key}
    calibration = concluded(
        fitted,
        gravity=gravity,
        method=method,
        loss=loss,
        excess_names=EXCESS_NAMES,
        rms=[residual_rms(imu, observations, method == "joint") for imu in (nominal, fitted.imu)],
        prior=prior,
        data=data | {"poses": poses, "turns": 0},
        notes=(*recording.notes, *notes),
        observations=observations,
        nominal=nominal,
        reading=recording.reading,
    )
    return replace(calibration, excess={name: size for name, size in calibration.excess.items() if stated.get(name)})


def _open(means: PoseMeans) -> bool:
    """Whether every pose has one axis upright, as six faces have however often they are repeated.

    Such poses differ in the products of two axes, from which misalignments are known, by the misalignments alone.
    """
    values = means.recording.accelerometer.si()
    upright = (values - (values.max(axis=0) + values.min(axis=0)) / 2) / STANDARD_GRAVITY
    return bool(np.sort(abs(upright), axis=1)[:, 1].max() < _UPRIGHT)


def _require_axes(means: PoseMeans, parameters: int, spare: int) -> None:
    """Refuse poses that leave scale or bias of an axis open; `spare`: more poses than these numbers are."""
    where, signal = means.recording.name, means.recording.accelerometer
    if spare < 0:
        raise NotPossibleError(
            f"{where}: {len(signal)} poses for {parameters} parameters do not show how uncertain the "
            f"means are: add {-spare} poses or more (each axis up and down once are six), or columns "
            "accel_sigma_x [m/s^2], … with the samples' standard deviations, and samples, their number."
        )
    up = unit_vectors(signal.si())
    if np.linalg.svd(np.hstack([up**2, up]), compute_uv=False)[-1] < _SPANNED:
        lacks = [
            f"{axis} {way}"
            for way, side in (("up", up), ("down", -up))
            for axis, part in zip("xyz", side.T, strict=True)
            if part.max() < _ON
        ]
        raise NotPossibleError(
            f"{where}: the rows do not determine every axis' scale and bias: "
            f"{f'none has {listed(lacks)}' if lacks else 'their directions are too much alike'}. "
            "Check the signs of the rows, and measure each axis up and down."
        )
