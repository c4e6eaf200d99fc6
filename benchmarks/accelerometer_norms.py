"""Accelerometer windows at rest in many poses over temperature, by the norm of gravity alone: wearables, mostly."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Float

from jaximu.calibration.calibration import effect_named
from jaximu.calibration.refusals import require_solved
from jaximu.data.gravity_norm import gravity_norm_error
from jaximu.estimation.covariance import Covariance
from jaximu.estimation.data import About, Conditions, OfOneUnit
from jaximu.estimation.fitting import Fit, fit
from jaximu.estimation.problem import Name, without_equipment
from jaximu.ground.array_types import Array
from jaximu.ground.errors import NotPossibleError
from jaximu.ground.gravity import STANDARD
from jaximu.ground.rotation import Number
from jaximu.model.sensor import Imu
from jaximu.model.stimulus import REFERENCE_TEMPERATURE, Stimulus

_NOISE = 1e-4
"""m/s², of a norm at an excess of zero: less than any window's, whose scatter is found."""
_BLIND = 1e-7  # share of the largest singular value below which a combination of numbers is not determined


class _Norms(Conditions):
    mean: Float[Array, "n 3"]
    celsius: Float[Array, " n"]
    magnitude: Number

    def __call__(self, imu: Imu) -> Float[Array, " n"]:
        """Return the errors of gravity's norm, m/s²."""
        force = imu.accelerometer.recover(self.mean, Stimulus(temperature=self.celsius))
        return gravity_norm_error(force, self.magnitude)


class _Windows(OfOneUnit):
    effects_inside = True
    excess_names = ("accelerometer",)
    coarse = (1e6,)

    def __init__(self, conditions: _Norms):
        self.conditions = conditions

    def about_one(self, imu: Imu) -> About:
        """Return the norms, whatever the unit."""
        one = np.ones(len(self.conditions.celsius))
        covariance = Covariance(_NOISE**2 * one, (_NOISE * one,), one, np.zeros(len(one), int))
        return About(self.conditions, covariance, np.zeros((len(one), 0)))


def calibrate_norms(
    means: Float[np.ndarray, "n 3"],
    celsius: Float[np.ndarray, " n"],
    effects: Sequence[str] = ("accel.temperature",),
    loss: str = "cauchy",
    gravity: float = STANDARD.value,
    reference: float = REFERENCE_TEMPERATURE,
) -> Fit:
    """Fit an accelerometer to windows at rest: means (n, 3), m/s², and temperatures (n,), °C.

    Bias, gain (lower triangular, as no attitude is known) and what temperature does to both are fitted together.

    **Arguments:** `effects`: of the catalogue; `loss`: as of `fit`; windows that moved hurt a robust one less;
    `reference`: °C from which effects count.

    Raises `NotPossibleError` where the windows do not determine all that is asked.
    """
    unit = Imu.nominal()
    triad = replace(unit.accelerometer, temperature_reference=reference)
    unit = replace(unit, accelerometer=triad).with_effects(*map(effect_named, effects))
    measured = _Windows(_Norms(np.asarray(means, float), np.asarray(celsius, float), np.asarray(gravity)))

    def free(name: Name) -> bool:
        return name.owner == "accelerometer" and (name.part == "coefficients" or without_equipment(name))

    fitted = fit(unit, measured, free, loss=loss)
    require_solved(fitted, f"{len(means)} windows")
    sizes = np.linalg.svd(fitted.jacobian, compute_uv=False)
    if sizes[-1] < _BLIND * sizes[0]:
        raise NotPossibleError(
            "the windows do not determine bias, gain and what temperature does to them: more poses at more "
            "temperatures are needed, each axis up and down."
        )
    return fitted
