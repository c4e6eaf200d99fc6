"""The report of a calibration against a measured attitude: what is left over time, and whose fault it is."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial

import numpy as np

from jaximu.calibration import Calibration
from jaximu.calibration.attitude import fitted_mounting
from jaximu.data.attitude import AgainstAttitude
from jaximu.ground.page import Page, Picture, Statement
from jaximu.ground.quantities import Z95, sentence, unit_text, with_interval
from jaximu.ground.vectors import root_or_zero
from jaximu.report.calibration import calibration_page
from jaximu.report.canvas import Figure
from jaximu.report.figures import AFTER, BEFORE, dressed, legend, stacked
from jaximu.report.words import gravity_statements, limits

_PANELS = {
    "rotation": "Rate off the reference's, mean of each interval",
    "specific_force": "Specific force off gravity and the reference's acceleration",
}
_SIZES = {
    "gyroscope": ("white noise of the gyroscope", 1e-4, 60 * np.degrees(1.0), "°/√h"),
    "reference attitude": ("noise of the reference's attitude", 1e-3, np.degrees(1.0), "°"),
    "gyroscope bias walk": ("drift of the gyroscope's bias over a minute", 1e-5, np.degrees(np.sqrt(60)), "°/s"),
    "accelerometer": ("white noise of the accelerometer", 1e-3, 1e3, "mm/s² over a second"),
    "reference velocity": ("velocity that the reference does not know", 1e-2, 1.0, "m/s"),
}
"""What each component is in words, its standard deviation at an excess of one, and how a person reads it."""


def mounting_words(calibration: Calibration) -> Iterator[str]:
    """Say how the reference is mounted, how late and smoothed it is, and how its vertical stands."""
    alignment = calibration.reference
    assert alignment is not None
    offset = alignment["time_offset"]
    delay = 1e3 * offset["value"]
    yield (
        f"The reference's stamps are {abs(delay):.3g} ± {1.96e3 * offset['sigma']:.2g} ms "
        f"{'late' if delay > 0 else 'early'} where the log begins. The unit is turned by "
        f"{np.degrees(2 * np.arccos(min(1.0, abs(alignment['rotation'][0])))):.3g}° relative to the body of the "
        "reference."
    )
    mounting, covariance = fitted_mounting(calibration.imu, calibration.names, calibration.covariance)
    if sigma := np.sqrt(covariance.clock_scale[0, 0]):
        yield (
            f"The log's clock runs {with_interval(1e6 * abs(mounting.clock_scale), 1e6 * sigma, 'ppm')} "
            f"{'fast' if mounting.clock_scale > 0 else 'slow'} against the reference's."
        )
    wide = alignment["filter"]["variance"]
    half = Z95 * alignment["filter"]["sigma"]
    # a straight line between samples smooths as a lag whose square is a sixth of the interval's, and so may samples
    between = 0.0 if wide > 0 else calibration.data["gyroscope_rate"] ** -2 / 6
    least, most = (1e3 * root_or_zero(abs(wide) + end) for end in (-half - between, half))
    if least:
        smoothed, beyond = ("reference", "") if wide > 0 else ("gyroscope", " beyond the reference")
        yield f"The {smoothed} is smoothed as by a first-order lag of {least:.3g} to {most:.3g} ms (95 %){beyond}."
    else:
        yield f"No filter of the reference shows; a first-order lag is below {most:.3g} ms."
    if arm := alignment["lever_arm"]:
        places = ", ".join(
            f"{1e3 * value:.3g} ± {1.96e3 * sigma:.2g}" for value, sigma in zip(arm["value"], arm["sigma"], strict=True)
        )
        yield f"The unit lies {places} mm (95 %) from the point that is tracked, along the reference's x, y, z."
    yield f"The reference's vertical is off by {np.degrees(np.linalg.norm(mounting.tilt)):.2g}°."


def page_of(calibration: Calibration, measurement: AgainstAttitude) -> Page:
    """Return the page of a calibration against a measured attitude."""
    shares = [
        f"{words}: {factor * unit * np.sqrt(size):.2g} {spoken}"
        for name, (words, unit, factor, spoken) in _SIZES.items()
        if (size := calibration.excess.get(name, 0.0)) > 0
    ]
    return calibration_page(
        calibration,
        [
            Picture(
                "residuals",
                partial(_figure, calibration, measurement),
                "Errors against the reference before and after",
                "Grey: the data sheet's unit, mounted as was coarsely found. Blue: calibrated. All three axes.",
            )
        ],
        gravity_statements(calibration),
        partial(limits, calibration),
        findings=[
            Statement("The reference", " ".join(mounting_words(calibration))),
            Statement(
                "What the misfit is made of",
                f"{sentence('; '.join(shares))}. The intervals contain all of it.",
            ),
        ],
    )


def _figure(calibration: Calibration, measurement: AgainstAttitude) -> Figure:
    assert calibration.nominal is not None
    nominal = calibration.nominal.with_effects(*calibration.imu.setup)
    figure, panels = stacked(2, 2.2, across="time [s]", sharex=True)
    before_after = [measurement.errors(imu) for imu in (nominal, calibration.imu)]
    for panel, (name, title) in zip(panels, _PANELS.items(), strict=True):
        for errors, colour, label in zip(before_after, (BEFORE, AFTER), ("before", "calibrated"), strict=True):
            time, values, unit = errors[name]
            panel.plot(time, values, ".", color=colour, markersize=4)
            panel.plot([], [], ".", color=colour, label=label)
        dressed(panel, title, 0.0, ylabel=f"error [{unit_text(unit)}]")
    legend(panels[0], 2, "upper right")
    return figure
