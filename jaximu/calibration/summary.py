"""What a calibration says of itself: its parameters by name, and the summary that Python and the terminal print."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from jaximu.estimation.problem import Name
from jaximu.estimation.uncertainty import describe
from jaximu.ground.quantities import Z95, change, number, unit_text
from jaximu.ground.summary import Parameter, ParameterTable, Summary, sentence
from jaximu.ground.units import SENSOR_UNITS

if TYPE_CHECKING:
    from jaximu.calibration.calibration import Calibration

__all__ = ["parameters_of", "summary_of"]

_ERRORS = {
    "gravity_norm": "Error against gravity at rest",
    "gravity_direction": "Direction of gravity lost over a turn",
    "static_gyroscope": "Rate at rest",
    "specific_force": "Error of the specific force",
    "rate_at_rest": "Error of the rate in poses",
    "turn_angle": "Error of the angle of turns",
    "rotation": "Error of the rate against the reference",
    "field_strength": "Error of the field's strength",
    "accelerometer": "Specific force at rest over temperature",
    "gyroscope": "Rate at rest over temperature",
}
_BEYOND = 3.0  # excess variance, in multiples of the noise's, from which an unmodelled effect is suspected


def parameters_of(calibration: Calibration) -> ParameterTable:
    """Return the free parameters in the order of the covariance, in output units."""
    model, weak = calibration.imu, {name for each in calibration.weak for name, _ in each.parameters}
    triads, effects = model.triads(), model.all_effects()

    def parameter(name: Name, sigma: float) -> Parameter:
        output = "" if name.owner == "setup" else triads[name.owner].output_unit
        if name.effect is not None:
            effect = effects[name.owner, name.effect]
            value = effect.coefficients[name.axes] if name.part == "coefficients" else getattr(effect, name.part)
            unit = effect.coefficient_unit(output) if name.part == "coefficients" else effect.inner[name.part].unit
        else:
            value, si = getattr(triads[name.owner], name.part)[name.axes], SENSOR_UNITS[name.owner]
            unit = output if name.part == "bias" else "1" if output == si else f"{output} per {unit_text(si)}"
        return Parameter(str(name), describe(name, model), float(value), sigma, unit, name in weak)

    sigmas = np.sqrt(np.diagonal(calibration.covariance)).tolist()
    return ParameterTable([parameter(*each) for each in zip(calibration.names, sigmas, strict=True)])


def summary_of(calibration: Calibration) -> Summary:
    """Return the errors before and after, whether the fit is to be trusted, the parameters, and what is open."""
    data = calibration.data
    files = ", ".join(Path(str(each["file"])).name for each in data.get("files", ())) or "a recording"
    counts = [f"{data[each]} {each}" for each in ("poses", "turns", "intervals", "windows") if data.get(each)]
    title = f"Calibration of {files}: {', '.join([*counts, f'{calibration.method} fit'])}"
    verdict = []
    for name, (before, after, unit) in calibration.rms.items():
        verdict.append(f"{_ERRORS[name]}: {change(before, after, unit)} (rms, before → after calibration).")
    count, undetermined = len(calibration.names), sum(not each.determined for each in calibration.weak)
    if undetermined:
        what = f"{undetermined} combination{'s' * (undetermined > 1)} of the {count} parameters"
        verdict.append(f"The recording does not determine {what} (marked *).")
    elif calibration.weak:
        verdict.append("All parameters are determined, those marked * only weakly.")
    else:
        verdict.append(f"All {count} parameters are determined.")
    verdict += _scatter(calibration)
    if calibration.diagnosis:
        verdict.append(f"Diagnosis: {calibration.diagnosis['verdict']}.")
    notes = [*_gravity(calibration), *(sentence(each.text) for each in calibration.weak),
             *map(sentence, calibration.notes)]  # fmt: skip
    return Summary(title, tuple(verdict), parameters_of(calibration).block(), tuple(notes))


def _scatter(calibration: Calibration) -> list[str]:
    large = {name: np.sqrt(1 + excess) for name, excess in calibration.excess.items() if excess > _BEYOND}
    if not large:
        return []
    parts = ", ".join(f"{name} {times:.1f} × noise" for name, times in large.items())
    return [
        f"Residual scatter: {parts}. The uncertainties include it, but an unmodelled effect may bias the result: run "
        "`jaximu diagnose`."
    ]


def _gravity(calibration: Calibration) -> list[str]:
    gravity = calibration.gravity
    share = 100 * Z95 * gravity.sigma / gravity.value
    if "accelerometer" not in calibration.triads() or share <= 0.01:
        return []
    return [
        f"Gravity was taken as {gravity.value:.5f} ± {number(Z95 * gravity.sigma, 2)} m/s² (95 %). This alone leaves "
        f"the accelerometer's scale uncertain by ±{number(share, 2)} %; state local gravity (--gravity, or --latitude "
        "and --height) to narrow it."
    ]
