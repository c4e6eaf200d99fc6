"""Standard deviations that are wanted of parameters: "accelerometer.bias 0.2 mg", for all alike or for one."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from jaximu.estimation.problem import Name
from jaximu.ground.array_types import FloatArray
from jaximu.ground.errors import InputError, nearest
from jaximu.ground.units import SENSOR_UNITS
from jaximu.model.sensor import Imu
from jaximu.planning.setup_errors import quantity


def parse_goal(text: str) -> tuple[str, str]:
    """Split "accelerometer.bias 0.001 m/s^2" into what and how much. Raises `InputError` where one is missing."""
    what, _, size = text.strip().partition(" ")
    if not size.strip():
        raise InputError(f"the goal {text!r} is not understood: write what and how much, accelerometer.bias 0.2 mg.")
    return what, size.strip()


def per_si(name: Name, unit: Imu) -> float:
    """Return output units per SI unit of a gain's or a bias's axis; one for effects."""
    if name.effect is not None:
        return 1.0
    return float(unit.triads()[name.owner].scales[name.axes[0]])


def group_of(name: Name) -> str:
    """Return what parameters alike are called: accelerometer.scale, gyroscope.bias …; effects are by themselves."""
    if name.effect is not None:
        return name
    kind = "bias" if name.part == "bias" else "scale" if name.is_scale else "misalignment"
    return f"{name.owner}.{kind}"


def unit_of(name: Name, unit: Imu) -> str:
    """Return the unit of a parameter's standard deviation, gains being relative to their axis's scale."""
    if name.effect is not None:
        triad = unit.triads().get(name.owner)
        return unit.all_effects()[name.key].coefficient_unit("SI" if triad is None else triad.output_unit)
    if name.part == "bias":
        return SENSOR_UNITS[name.owner]
    return "1" if name.is_scale else "rad"


def goal_sigmas(what: str, text: str, names: Sequence[Name], unit: Imu, sigma: FloatArray) -> tuple[float, FloatArray]:
    """Return the size of a goal, and the standard deviations of what it is for, both in its unit.

    **Arguments:** `sigma` (p,): of the parameters, in output units; else, and errors, as of [`goal_of`].
    """
    indices, size = goal_of(what, text, names, unit)
    return size, np.array([sigma[index] / per_si(names[index], unit) for index in indices])


def goal_of(what: str, text: str, names: Sequence[Name], unit: Imu, where: str = "") -> tuple[list[int], float]:
    """Return which parameters a goal is for, as places in `names`, and its size in their unit.

    Raises `InputError`, beginning with `where`, where there is no such parameter or the size is none.
    """
    indices = [index for index, name in enumerate(names) if what in (name, group_of(name))]
    if not indices:
        hint = nearest(what, [*dict.fromkeys(map(group_of, names)), *names])
        raise InputError(f"{where}there is no parameter {what!r} to set a goal for; {hint}")
    size = quantity(text, unit_of(names[indices[0]], unit), f"{where}goal {what}")
    if size == 0:
        raise InputError(f"{where}goal {what} must be greater than zero.")
    return indices, size
