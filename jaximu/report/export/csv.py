"""Every parameter as one line of CSV, with its unit and standard deviation; the effects' coefficients too."""

from __future__ import annotations

import numpy as np

from jaximu.ground.units import SENSOR_UNITS
from jaximu.report.export.base import ExportedUnit, Written, text_file

SUFFIX = ".csv"
MAGNETIC = True
SUMMARY = "every parameter with its unit and standard deviation"


def write(parameters: ExportedUnit) -> Written:
    """Write `triad,parameter,row,column,value,sigma,unit`: gain, bias, the matrix to apply, effects (row: place)."""
    rows = ["triad,parameter,row,column,value,sigma,unit"]

    def add(triad: str, name: str, place: tuple[int, ...], value: float, sigma: float | None, unit: str) -> None:
        row, column = (*map(str, place), "", "")[:2]
        rows.append(
            f"{triad},{name},{row},{column},{float(value)!r},{'' if sigma is None else repr(float(sigma))},{unit}"
        )

    document = parameters.calibration.document()
    for name, triad in parameters.triads.items():
        # signed permutations take standard deviations along without signs
        map_, frame = (np.abs(axes[name]) for axes in (parameters.maps, parameters.frames))
        sigma = dict(zip(("gain", "bias"), parameters.calibration.sigma(name), strict=True))
        gain_sigma, bias_sigma = map_.T @ sigma["gain"] @ frame, map_.T @ sigma["bias"]
        for place, value in np.ndenumerate(triad.gain):
            add(name, "gain", place, value, float(gain_sigma[place]), f"{triad.unit}/({SENSOR_UNITS[name]})")
        for place, value in np.ndenumerate(triad.bias):
            add(name, "bias", place, value, float(bias_sigma[place]), triad.unit)
        for place, value in np.ndenumerate(triad.inverse):
            add(name, "inverse_gain", place, value, None, f"({SENSOR_UNITS[name]})/{triad.unit}")
        add(name, "temperature_reference", (), document[name]["temperature_reference"], None, "degC")
        for effect, each in document[name]["effects"].items():
            spread = each["sigma"] or [None] * len(each["coefficients"])
            for place, (value, one) in enumerate(zip(each["coefficients"], spread, strict=True)):
                add(name, effect, (place,), value, one, each["unit"])
            for inner, item in each["inner"].items():
                add(name, f"{effect}.{inner}", (), item["value"], item["sigma"], item["unit"])
    convention = (
        "forward: y = gain u + bias + effects; inverse_gain is inverse(gain), ready to apply. Effects' formulas: "
        "jaximu effects NAME, in body axes; applying gain and bias alone leaves the errors listed here."
    )
    return Written(
        text_file(rows), convention, parameters.equation("inverse_gain"), parameters.corrections(), uncertainty=True
    )
