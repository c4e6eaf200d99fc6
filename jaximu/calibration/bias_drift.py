"""A calibration whose biases are those of a time: after the recording, and in it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from jaximu.calibration.calibration import Calibration
from jaximu.data.drift import with_drift
from jaximu.estimation.covariance import Chain, Covariance
from jaximu.estimation.data import OutputMeans
from jaximu.estimation.fitting import Fit
from jaximu.ground.array_types import FloatArray
from jaximu.ground.gravity import LocalGravity
from jaximu.model.noise_model import NoiseModel


def knowing_drift(
    calibration: Calibration,
    covariance: Covariance | Chain,
    means: OutputMeans,
    noise: NoiseModel | None,
    clock: float = 0.0,
) -> Calibration:
    """Return a calibration whose uncertainty knows how biases drift, as [`jaximu.data.drift.with_drift`][] has it.

    `covariance`: of its fit's conditions; `clock`: one sigma of the gyroscope's clock, a share.
    """
    assert calibration.fit is not None
    fitted, sigmas, sentences = with_drift(calibration.fit, covariance, means, noise)
    return replace(
        calibration,
        fit=fitted,
        covariance=fitted.total_covariance(calibration.gravity.sigma, clock),
        bias_sigma_recording=with_gravity(fitted, sigmas, calibration.gravity),
        notes=(*calibration.notes, *sentences),
    )


def with_gravity(fitted: Fit, sigmas: Mapping[str, FloatArray], gravity: LocalGravity) -> dict[str, FloatArray]:
    """Return standard deviations (3,) of biases, by triad, with what gravity's uncertainty adds."""
    shift = np.asarray(fitted.magnitude_sensitivity) * gravity.sigma
    biases = {
        triad: [k for k, name in enumerate(fitted.names) if name.owner == triad and name.part == "bias"]
        for triad in sigmas
    }
    return {triad: np.hypot(sigma, shift[biases[triad]]) for triad, sigma in sigmas.items()}
