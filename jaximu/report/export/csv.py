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

    def add(triad: str, name: str, index: tuple[int, ...], value: float, sigma: float | None, unit: str) -> None:
        row, column = (*map(str, index), "", "")[:2]
        rows.append(
            f"{triad},{name},{row},{column},{float(value)!r},{'' if sigma is None else repr(float(sigma))},{unit}"
        )

    document = parameters.calibration.document()
    for name, triad in parameters.triads.items():
        # signed permutations take standard deviations along without signs
        map_, frame = (np.abs(axes[name]) for axes in (parameters.maps, parameters.frames))
        gain_sigma, bias_sigma = parameters.calibration.sigma(name)
        gain_sigma = map_.T @ gain_sigma @ frame
        bias_sigma = map_.T @ bias_sigma
        for index, value in np.ndenumerate(triad.gain):
            add(name, "gain", index, value, float(gain_sigma[index]), f"{triad.unit}/({SENSOR_UNITS[name]})")
        for index, value in np.ndenumerate(triad.bias):
            add(name, "bias", index, value, float(bias_sigma[index]), triad.unit)
        for index, value in np.ndenumerate(triad.inverse):
            add(name, "inverse_gain", index, value, None, f"({SENSOR_UNITS[name]})/{triad.unit}")
        add(name, "temperature_reference", (), document[name]["temperature_reference"], None, "degC")
        for effect, entry in document[name]["effects"].items():
            spread = entry["sigma"] or [None] * len(entry["coefficients"])
            for index, (value, one) in enumerate(zip(entry["coefficients"], spread, strict=True)):
                add(name, effect, (index,), value, one, entry["unit"])
            for inner, item in entry["inner"].items():
                add(name, f"{effect}.{inner}", (), item["value"], item["sigma"], item["unit"])
    convention = (
        "forward: y = gain u + bias + effects; inverse_gain is inverse(gain), ready to apply. Effects' formulas: "
        "jaximu effects NAME, in body axes; applying gain and bias alone leaves the errors listed here."
    )
    return Written(
        text_file(rows), convention, parameters.equation("inverse_gain"), parameters.corrections(), uncertainty=True
    )
