"""The page of a vehicle that stops: the gyroscope's bias, how the unit is mounted, and what stays open."""

from collections.abc import Iterator, Mapping
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np

from jaximu.calibration import Calibration, History
from jaximu.ground.page import Items, Page, Part, Picture, Section, Statement
from jaximu.ground.quantities import Z95, counted, listed, size, with_interval, with_intervals
from jaximu.model.effects.earth_rotation import EARTH_RATE
from jaximu.report.calibration import calibration_page
from jaximu.report.canvas import Figure
from jaximu.report.figures import AXES, band, dressed, legend, stacked
from jaximu.report.words import compensation, limits

_SURE = 4.0
"""Standard deviations from which on a change of the bias is a caution."""


def vehicle_page(calibration: Calibration, history: History) -> Page:
    """Return the page of a gyroscope that was calibrated by the stops of a vehicle."""
    assert calibration.filter is not None
    vehicle = calibration.filter["vehicle"]
    scale = calibration.triads()["gyroscope"].scales
    worst = float(np.max(Z95 * calibration.bias_sigma_recording["gyroscope"] / scale))
    page = calibration_page(
        calibration,
        [
            Picture(
                "vehicle",
                partial(_figure, calibration, vehicle, history),
                "Gyroscope bias and tilt at each stop, and the speeds gained and lost beside stops",
                "Top: the bias as a filter knew it after each stop, with 95 % bands. Middle: how much more than on "
                "average the vehicle tilts at each stop, which is the slope of the road. Bottom: speeds gained in the "
                "seconds after a stop and lost in those before one, along the vehicle and to its left; backwards they "
                "are negative.",
            )
        ],
        [],
        partial(limits, calibration),
        (f"The vehicle stood still at {counted(len(vehicle['stops']), 'stop')}, {vehicle['seconds']:.0f} s in all.",),
        (f"±{size(worst, 'rad/s', 2)}", "how well the gyroscope's bias over the drive is known (95 %, the worst axis)"),
        [*_statements(calibration, vehicle), Section("What stays open", [Items(calibration.filter["open"])], 3)],
    )
    return replace(page, next=compensation(calibration.files, "takes the gyroscope's bias off"))


def _statements(calibration: Calibration, vehicle: Mapping[str, Any]) -> Iterator[Part]:
    yield Statement("Mounting", _mounting(vehicle))
    if (yaw := vehicle["yaw"]) is not None:
        share = f"{100 * vehicle['forward_share']:.0f} %"
        yield Statement(
            "Forward",
            f"Yaw {_interval(yaw)}, by the speeds gained and lost beside the stops. {share} of their squares are one "
            "way, which is taken for forwards.",
        )
    yield Statement(
        "Gravity",
        f"The accelerometer reads {_interval(vehicle['norm_error'], sign=True)} more than gravity at the stops: its "
        "scale and bias along the vertical.",
    )
    change = vehicle["bias_change"]
    if change["value"] is not None:
        texts = with_intervals(change["value"], change["sigma"], "rad/s")
        moved = (np.abs(change["value"]) / np.array(change["sigma"])).max() > _SURE
        advice = " Use it for this drive, and let the unit warm up before the next." * bool(moved)
        yield Statement(
            "Bias over the drive",
            "From the first stop to the last it changed by "
            f"{listed([f'{axis} {text}' for axis, text in zip('xyz', texts, strict=True)])}.{advice}",
            bool(moved),
        )
    yield Statement("Earth's rotation", _earth(calibration))


def _interval(entry: Mapping[str, Any], sign: bool = False) -> str:
    if entry["sigma"] is None:
        return f"{size(entry['value'], entry['unit'])} (without an interval)"
    return with_interval(entry["value"], entry["sigma"], entry["unit"], sign)


def _mounting(vehicle: Mapping[str, Any]) -> str:
    slope = vehicle["slope"]
    known = "" if slope is None else f" The ground there sloped by {size(slope, 'rad', 2)} (rms), which is in it."
    roll = vehicle["roll"]["value"]
    pitch = vehicle["pitch"]["value"]
    up = np.array([-np.sin(pitch), np.sin(roll) * np.cos(pitch), np.cos(roll) * np.cos(pitch)])  # in the unit
    axis = int(np.abs(up).argmax())
    return (
        f"The unit's {'xyz'[axis]} axis points {'up' if up[axis] > 0 else 'down'}. "
        f"Roll {_interval(vehicle['roll'])} and pitch {_interval(vehicle['pitch'])} against the horizontal: the unit's "
        f"axes are those of the vehicle (forward, left, up) turned by yaw, pitch and roll.{known} A slope that all "
        "stops share, such as a road's fall to its side, and the accelerometer's bias (0.6° for 0.1 m/s²) are not."
    )


def _earth(calibration: Calibration) -> str:
    latitude = calibration.gravity.latitude
    if latitude is None:
        return (
            f"Up to {size(EARTH_RATE, 'rad/s', 2)} of it are in the bias, and its interval allows for that. With "
            "--latitude its vertical part is taken off."
        )
    return (
        "Its vertical part was taken off. Of the horizontal part up to "
        f"{size(EARTH_RATE * np.cos(np.radians(latitude)), 'rad/s', 2)} are in the bias, as the heading is unknown, "
        "and its interval allows for that."
    )


def _figure(calibration: Calibration, vehicle: Mapping[str, Any], history: History) -> Figure:
    scale = calibration.triads()["gyroscope"].scales
    figure, (bias, tilt, speed) = stacked(3, 2.5, 0.0)
    for row, (axis, color) in enumerate(AXES.items()):
        values, sigmas = (np.degrees(part[:, row] / scale[row]) for part in (history.values, history.sigmas))
        band(bias, history.time, values - values[-1], Z95 * sigmas, color, label=axis)
    limit = 3 * np.degrees(Z95 * np.max(history.sigmas[len(history.time) // 2 :] / scale))
    bias.set_ylim(-limit, limit)
    dressed(bias, "Gyroscope bias less its last value [°/s]", 0.0)
    tilts = np.degrees([stop["tilt"] for stop in vehicle["stops"]])
    middle = [(stop["start"] + stop["stop"]) / 2 for stop in vehicle["stops"]]
    for column, name in enumerate(("forward", "to the left")):
        tilt.plot(middle, tilts[:, column], "o", label=name, markersize=4)
    dressed(tilt, "Tilt at each stop less the mean: lean of the vertical [°]", 0.0, xlabel="time [s]")
    speeds = np.array([[entry["along"], entry["left"]] for entry in vehicle["speeds"]]).reshape(-1, 2)
    speed.plot(*speeds.T, "o", markersize=4)
    dressed(speed, "Speeds beside stops", 0.0, xlabel="along the vehicle [m/s]", ylabel="to its left [m/s]")
    legend(bias, 3, "upper right")
    legend(tilt, 2, "upper right")
    return figure
