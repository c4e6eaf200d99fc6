"""The report of a magnetometer: how good a heading becomes, where the field was seen, and what is not known."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import partial

import numpy as np

from jaximu.calibration import Calibration, Heading
from jaximu.calibration.magnetometer import hard_iron, open_heading
from jaximu.data.field import MagneticField
from jaximu.estimation.uncertainty import signed_axes
from jaximu.ground.document import Json
from jaximu.ground.page import Page, Picture, Statement
from jaximu.ground.quantities import Z95, number, sentence
from jaximu.ground.vectors import lengths_of
from jaximu.report.calibration import calibration_page
from jaximu.report.canvas import Figure
from jaximu.report.figures import dressed, hemispheres, new_figure

_PAYS = 0.8
"""Share of what is uncertain of a heading that must be left for further directions to be worth a turn."""
_ENOUGH = 0.6
"""Share of all directions from which on the field counts as seen all round."""


def _lead(calibration: Calibration) -> tuple[str, str, str]:
    facts = calibration.magnetic
    assert facts is not None
    spread = facts["norm_spread"]
    heading = facts["heading_error"]
    strength = (
        f"the field's strength scatters by {100 * spread['after']:.2g} % instead of {100 * spread['before']:.2g} % on "
        "parts left out"
    )
    if heading is None:
        return (
            f"After calibration {strength}.",
            f"{100 * spread['after']:.2g} %",
            "scatter of the field's strength on parts of the recording that were left out of the fit",
        )
    now, before = (f"{number(value, 2)}°" for value in (heading["rms"], heading["before"]["rms"]))
    improved = (
        f"known to {now} only (one standard deviation), more than the {before} (rms) by which calibrating changes it"
        if open_heading(heading)
        else f"good to {now} (one standard deviation); without calibration it is off by {before} (rms)"
    )
    return (
        f"A level heading in this recording's surroundings is {improved}. Iron elsewhere, which one recording does not "
        f"show, is not in the figure. After calibration {strength}.",
        now,
        "standard deviation of the heading of a level unit whose vertical is known, in this field",
    )


def statements(calibration: Calibration) -> Iterator[Statement]:
    """Say what the field is, what the iron does, and where the field was seen."""
    facts = calibration.magnetic
    triad = calibration.imu.magnetometer
    assert facts is not None and triad is not None
    gain = np.asarray(triad.gain)
    strength = facts["field"]["strength"]
    dip = facts["field"]["dip"]
    # a field's image is an ellipsoid; how far from round it is, is soft iron and scale
    axes = np.linalg.svd(gain, compute_uv=False)
    iron, sigma = hard_iron(calibration)
    text = f"{number(strength['value'], 3)} ± {number(Z95 * strength['sigma'], 2)} µT"
    if dip is not None:
        way = "below" if dip["value"] > 0 else "above"
        text += f", pointing {number(abs(dip['value']), 3)} ± {number(Z95 * dip['sigma'], 2)}° {way} the level"
    text += " (95 %)"
    if strength["sigma"] > 0.01 * strength["value"]:
        text += "; every gain shares the uncertainty of the strength, which --field or --longitude would narrow"
    yield Statement("The field", f"{text}.")
    yield Statement(
        "Hard iron",
        f"{number(iron, 3)} ± {number(Z95 * sigma, 2)} µT (95 %), {number(100 * iron / strength['value'], 2)} % of the "
        "field.",
    )
    yield Statement(
        "Soft iron and scale",
        f"The output changes {number(100 * (axes[0] / axes[-1] - 1), 2)} % more with a field along one direction than "
        "along another.",
    )
    share = facts["coverage"]
    words = "all round" if share > 0.9 else "from most directions" if share > _ENOUGH else "from some directions only"
    yield Statement(
        "Directions",
        f"The field was seen {words}: {100 * share:.0f} % of the sphere lies within 15° of a measured direction.",
        share < _ENOUGH,
    )
    if (plan := facts.get("next")) is not None:
        yield Statement("Next", sentence(next_words(plan)))
    if (worst := facts["heading_error"]) is not None:
        yield Statement(
            "Heading in other attitudes",
            f"Rolled or pitched by 45°, or upside down, it is good to {number(worst['worst'], 2)}° at the worst "
            f"(before: off by up to {number(worst['before']['worst'], 2)}°).",
        )
    spread = facts["norm_spread"]
    if spread["algebraic"] is not None:
        yield Statement(
            "Other tools",
            f"An algebraic ellipsoid, as most tools fit it, leaves {number(100 * spread['algebraic'], 2)} % of the "
            f"strength on the same parts left out, this calibration {number(100 * spread['after'], 2)} %; the "
            f"sensor's noise alone makes {number(100 * spread['noise'], 2)} %.",
        )


def next_words(plan: Json) -> str:
    """Say how to hold the unit next and what that buys, or that it buys little; plan: `next` of `magnetic`."""
    now, then = (number(plan[key], 2) for key in ("heading_now", "heading_then"))
    if plan["heading_then"] >= _PAYS * plan["heading_now"]:
        return f"more orientations buy little: six would take a level heading from {now}° to {then}° only."
    listed = ", ".join(dict.fromkeys("".join(signed_axes(direction)) for direction in plan["directions"]))
    return (
        f"hold the unit so that the field points along its {listed}: {len(plan['directions'])} such directions, a "
        f"second each, take what is uncertain of a level heading from {now}° to {then}°."
    )


def page_of(
    calibration: Calibration, measurement: MagneticField, heading: Heading | None, remarks: Sequence[str] = ()
) -> Page:
    """Return the page of a magnetometer's calibration; `remarks`: what a check and a diagnosis say, in sentences."""
    caption = (
        "Left and middle: the directions that the field had, in the unit's axes, the two halves of the sphere seen "
        "along z; colours show how far the strength is off after calibration."
    )
    if heading is not None:
        caption += " Right: how good a heading is, one standard deviation, by where the unit points."
    verdict, number, meaning = _lead(calibration)
    return calibration_page(
        calibration,
        [Picture("residuals", partial(_figure, calibration, measurement, heading), "Directions and headings", caption)],
        (),
        tuple,
        (verdict, *remarks),
        (number, meaning),
        statements(calibration),
    )


def _figure(calibration: Calibration, measurement: MagneticField, heading: Heading | None) -> Figure:
    windows = measurement.windows
    field = windows.field(calibration.imu)[windows.used]
    length = lengths_of(field)
    off = 100 * (length / measurement.strength - 1)
    figure = new_figure(3.6)
    limit = np.quantile(np.abs(off), 0.98)
    panels, grid = hemispheres(
        figure,
        2 if heading is None else 3,
        field / length[:, None],
        [f"window {index}: {number(value, 2)} %" for index, value in enumerate(off, 1)],
        off,
        cmap="PuOr_r",
        vmin=-limit,
        vmax=limit,
        s=18,
        edgecolors="#555555",
        linewidths=0.3,
    )
    for axes, sign, *_ in panels:
        axes.set_title(f"field along {'+z' if sign > 0 else '−z'}", fontsize=10)
    bar = figure.colorbar(axes.collections[0], cax=figure.add_subplot(grid[1, :2]), orientation="horizontal")
    bar.set_label("strength off after calibration (%)")
    if heading is not None:
        axes = figure.add_subplot(grid[:, 2])
        turned = np.append(heading.heading, 360.0)
        names = ["level", "rolled 45°", "rolled −45°", "pitched 45°", "pitched −45°", "upside down"]
        for row, name in zip(np.hypot(heading.sigma, heading.scatter), names, strict=True):
            axes.plot(turned, np.append(row, row[0]), label=name, linewidth=2.2 if name == "level" else 1.0)
        dressed(axes, key=1, xlabel="heading [°]", ylim=(0, None))
        axes.set_title("heading good to [°]")
        axes.set_xticks([0, 90, 180, 270, 360], ["N", "E", "S", "W", "N"])
    return figure
