"""Limits on what navigation with a calibrated unit is off after a time: position and heading along level driving.

What the calibration leaves open, and the sensors' noise where an allan.json is given, are carried along the path by
`jaximu.navigation.consequences`. The expected error is zero, its standard deviation is the item's uncertainty, and the
probability of conformity is that of an error within the limits.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from jaximu.acceptance.decision import UNDECIDED, Rule
from jaximu.acceptance.epochs import without_gravity
from jaximu.acceptance.item import Item, deciding
from jaximu.acceptance.limits import Limit
from jaximu.calibration import Calibration
from jaximu.ground.distributions import normal_isf
from jaximu.ground.errors import NotPossibleError
from jaximu.ground.vectors import root_or_zero
from jaximu.navigation.consequences import consequences
from jaximu.navigation.trajectory import Place, level_driving
from jaximu.noise.stated import sensor_noise

_LATITUDE = 45.0  # deg, of the path


def navigation_items(
    limits: Sequence[Limit], rule: Rule, calibration: Calibration, noise: Mapping[str, Any] | None, file: str
) -> tuple[list[Item], list[str]]:
    """Return the items of limits on navigation, and notes on the path.

    **Arguments:** `noise`: an `allan.json` as a dictionary; `file`: what the calibration is called.
    """
    items = []
    notes = []
    known = None if noise is None else sensor_noise(noise, "the allan.json")
    site = Place(_LATITUDE, 0.0, calibration.gravity)
    for after in dict.fromkeys(limit.after for limit in limits):
        here = [limit for limit in limits if limit.after == after]
        try:
            outcome = consequences(calibration, level_driving(site, after), known, draws=0, files=(file, ""))
        except NotPossibleError as error:
            items += [Item.of(limit, limit.key, reason=str(error).rstrip(".")) for limit in here]
            continue
        exact = consequences(without_gravity(calibration), level_driving(site, after), draws=0, files=(file, ""))
        errors = [  # of position, and of the rotation about the vertical
            (np.sqrt(variances[-1, :3]), np.degrees(np.sqrt(variances[-1, -1:])))
            for variances in (outcome.calibration, exact.calibration, outcome.noise)
        ]
        for limit in here:
            parts = [pair[limit.part == "heading"] for pair in errors]
            for axis in limit.axes or range(len(parts[0])):
                name = f"navigation.{limit.part}" + (f"[{axis}]" if limit.part == "position" else "")
                total, recording, rest = (float(sigma[axis]) for sigma in parts)
                of_gravity = float(root_or_zero(total**2 - recording**2))
                items.append(_item(limit, name, rule, recording, of_gravity, rest, calibration.gravity.sigma))
        notes.append(f"{', '.join(limit.key for limit in here)}: after {outcome.trajectory.words}.")
        notes += [] if known else [f"{here[0].key}: without --noise the sensors' noise is left out."]
    return items, notes


def _item(
    limit: Limit, name: str, rule: Rule, recording: float, gravity: float, noise: float, gravity_sigma: float
) -> Item:
    """Return the item of an error about zero with these standard deviations; gravity_sigma: m/s²."""
    judged = limit.judged(rule, 0.0, float(np.sqrt(recording**2 + gravity**2 + noise**2)))
    advice = ""
    if judged["verdict"] == UNDECIDED:
        needed = limit.nearest(0.0) / float(normal_isf(rule.risk / 2))  # both sides of zero count, hence half the risk
        left = needed**2 - noise**2
        advice = "The sensors' noise alone is too much for this limit."
        if left > 0:
            advice = deciding(float(np.sqrt(left)), recording, gravity, gravity_sigma, "longer rests.")
    return Item.of(
        limit,
        name,
        **judged,
        gravity=gravity,
        recording=float(np.hypot(recording, noise)),
        advice=advice,
    )
