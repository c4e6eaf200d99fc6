"""Limits on what navigation with a calibrated unit is off after a time: position and heading along level driving.

What the calibration leaves open, and the sensors' noise where an allan.json is given, are carried along the path by
`jaximu.planning.consequences`. The expected error is zero, its standard deviation is the item's uncertainty, and the
probability of conformity is that of an error within the limits.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from jaximu.acceptance.decision import UNDECIDED, Rule, probability_of_conformity
from jaximu.acceptance.item import Item
from jaximu.acceptance.limits import Limit
from jaximu.calibration import Calibration
from jaximu.distributions import normal_isf
from jaximu.errors import NotPossibleError
from jaximu.planning.consequences import consequences, sensor_noise
from jaximu.planning.trajectory import Place, level_driving

__all__ = ["navigation_items"]

_LATITUDE = 45.0  # deg, of the path
_UP = 8  # of the nine errors: the rotation about the vertical


def navigation_items(
    limits: Sequence[Limit], rule: Rule, calibration: Calibration, noise: Mapping[str, Any] | None, file: str
) -> tuple[list[Item], list[str]]:
    """Return the items of limits on navigation, and notes on the path.

    **Arguments:** `noise`: an `allan.json` as a dictionary; `file`: what the calibration is called.
    """
    items, notes = [], []
    known = None if noise is None else sensor_noise(noise, "the allan.json")
    place = Place(_LATITUDE, 0.0, calibration.gravity)
    for after in dict.fromkeys(limit.after for limit in limits):
        here = [limit for limit in limits if limit.after == after]
        try:
            found = consequences(calibration, level_driving(place, after), known, draws=0, files=(file, ""))
        except NotPossibleError as error:
            items += [Item.of(limit, limit.key, reason=str(error).rstrip(".")) for limit in here]
            continue
        errors = [(np.sqrt(each[-1, :3]), np.degrees(np.sqrt(each[-1, _UP:])))
                  for each in (found.total, found.calibration, found.noise)]  # fmt: skip
        for limit in here:
            total, own, rest = (each[limit.part == "heading"] for each in errors)
            for axis in limit.axes or range(len(total)):
                name = f"navigation.{limit.part}" + (f"[{axis}]" if limit.part == "position" else "")
                items.append(_item(limit, name, rule, *(float(each[axis]) for each in (total, own, rest))))
        notes.append(f"{', '.join(limit.key for limit in here)}: after {found.trajectory.words}.")
        notes += [] if known else [f"{here[0].key}: without --noise the sensors' noise is left out."]
    return items, notes


def _item(limit: Limit, name: str, rule: Rule, sigma: float, own: float, noise: float) -> Item:
    probability = float(probability_of_conformity(0.0, sigma, limit.low, limit.high))
    verdict, advice = str(rule.verdicts(probability, limit.low <= 0 <= limit.high)), ""
    if verdict == UNDECIDED:
        needed = limit.nearest(0.0) / float(normal_isf(rule.risk / 2))
        left = needed**2 - noise**2  # both sides of zero count, hence half the risk
        advice = "The sensors' noise alone is too much for this limit."
        if left > 0:
            advice = f"Record about {max(1.1, own**2 / left):.2g} times as much for the calibration."
    return Item.of(limit, name, value=0.0, sigma=sigma, probability=probability, verdict=verdict, recording=sigma,
                   advice=advice)  # fmt: skip
