"""Poses that a person can set: rounded angles, an order with short ways, and words."""

from __future__ import annotations

from itertools import combinations

import numpy as np
from scipy.spatial.transform import Rotation

from jaximu.ground.array_types import FloatArray, IntArray
from jaximu.simulation.protocols.course import attitude_of


def up_of(attitude: FloatArray) -> FloatArray:
    """Return the body's upward direction (..., 3) of quaternions (..., 4), scalar first, body to level frame."""
    return Rotation.from_quat(attitude, scalar_first=True).as_matrix()[..., 2, :]


def turned_to(attitude: FloatArray, up: FloatArray) -> FloatArray:
    """Return the attitude (4,) that is reached from another (4,) by the shortest turn that brings `up` (3,) upwards."""
    before = up_of(attitude)
    cross = np.cross(before, up)
    cosine = float(before @ up)
    size = float(np.linalg.norm(cross))
    axis = cross / size if size > 1e-9 else np.roll(before, 1)
    # the body turns by −angle about this axis for the level frame's up to come from `before` to `up`
    step = Rotation.from_rotvec(-np.arctan2(size, cosine) * axis)
    turned = (Rotation.from_quat(attitude, scalar_first=True) * step).as_quat(scalar_first=True)
    return turned * (1.0 if attitude @ turned >= 0 else -1.0)


def _polar(up: FloatArray) -> tuple[int, float, float, float]:
    """The axis nearest to "up", its sign, the angle to it and the direction in which "up" leaves it (rad)."""
    axis = int((np.abs(up) + [0, 1e-9, 2e-9]).argmax())  # halfway between two, rounding must not decide
    sign = 1.0 if up[axis] > 0 else -1.0
    _, j, k = np.roll(up, -axis)
    return axis, sign, float(np.arctan2(np.hypot(j, k), abs(up[axis]))), float(np.arctan2(k, j))


def round_direction(up: FloatArray, step: float) -> FloatArray:
    """Return "up" (3,) with its tilt from the nearest body axis, and the tilt's direction, rounded to `step` (rad)."""
    axis, sign, tilt, azimuth = _polar(up)
    tilt, azimuth = (round(angle / step) * step for angle in (tilt, azimuth))
    while True:
        across = np.sin(tilt) * np.cos(azimuth), np.sin(tilt) * np.sin(azimuth)
        rounded = np.roll([sign * np.cos(tilt), *across], axis)
        rounded = np.where(np.abs(rounded) < 1e-12, 0.0, rounded)
        if _polar(rounded)[0] == axis:
            return rounded
        tilt -= step  # near a corner of the cube: words about another axis would not be round


def _seen(up: FloatArray) -> tuple[int, FloatArray]:
    """A body axis that is nearly level, and its level direction in the body frame: what a heading is told by."""
    axis = (_polar(up)[0] + 1) % 3
    level = np.eye(3)[axis] - up[axis] * up
    return axis, level / np.linalg.norm(level)


def _heading(attitude: FloatArray, up: FloatArray) -> float:
    """Angle (rad) from "away from the person" (the level frame's y) to the seen axis, anticlockwise from above."""
    x, y, _ = Rotation.from_quat(attitude, scalar_first=True).apply(_seen(up)[1])
    return float(np.arctan2(-x, y))


def round_attitude(attitude: FloatArray, step: float, zero: float = 0.0) -> FloatArray:
    """Return an attitude (4,) with its upward direction and its heading, less `zero`, rounded to `step` (rad)."""
    up = round_direction(up_of(attitude), step)
    heading = round((_heading(attitude, up) - zero) / step) * step
    _, level = _seen(up)
    away = np.cos(heading) * level - np.sin(heading) * np.cross(up, level)
    return Rotation.from_matrix(np.stack([np.cross(away, up), away, up])).as_quat(scalar_first=True)


def first_heading(attitude: FloatArray) -> float:
    """Return the heading of the first attitude, from which all may be counted."""
    return _heading(attitude, up_of(attitude))


def heading_of(attitude: FloatArray) -> float:
    """Return the heading (degrees) of an attitude about "up", as schedules have it (`attitude_of`)."""
    turned = Rotation.from_quat(attitude, scalar_first=True) * attitude_of(up_of(attitude)).inv()
    return float(np.degrees(turned.as_rotvec()[2]))


def short_order(up: FloatArray) -> IntArray:
    """Return an order of directions (P, 3) with little turning between neighbours: nearest next, then 2-opt."""
    angle = np.arccos((up @ up.T).clip(-1, 1))
    order = [int(up[:, 2].argmax())]
    while len(order) < len(up):
        left = [index for index in range(len(up)) if index not in order]
        order.append(min(left, key=lambda index: angle[order[-1], index]))

    def length(order):
        return float(angle[order[:-1], order[1:]].sum())

    improved = True
    while improved:
        improved = False
        for first, last in combinations(range(1, len(order)), 2):
            other = order[:first] + order[first : last + 1][::-1] + order[last + 1 :]
            if length(other) < length(order) - 1e-9:
                order = other
                improved = True
    return np.array(order)


def _degrees(angle: float) -> str:
    return f"{np.degrees(angle):.4g}°"


def _lifted(azimuth: float, j: str, k: str) -> str:
    """Name the side, corner or edge of a level box that lies in a direction, counted from axis j towards axis k."""
    quarter, rest = divmod(azimuth, np.pi / 2)
    if np.pi / 2 - rest < 1e-9:
        quarter, rest = quarter + 1, 0.0
    names = f"+{j}", f"+{k}", f"−{j}", f"−{k}"
    side, following = (names[int(quarter + step) % 4] for step in (0, 1))
    if rest < 1e-9:
        return f"{side} side"
    if abs(rest - np.pi / 4) < 1e-9:
        return f"{side}/{following} corner"
    return f"edge {_degrees(rest)} from {side} towards {following}"


_LYING = {"z up": "on its bottom", "z down": "on its top"}


def pose_words(up: FloatArray) -> str:
    """Say how a box lies whose body direction (3,) points up: "on its bottom (z up), +x side lifted by 35°".

    Its top is the face that +z leaves. A corner is halfway between two sides.
    """
    axis, sign, tilt, azimuth = _polar(up)
    name, j, k = ("xyz"[(axis + step) % 3] for step in range(3))
    upward = f"{name} {'up' if sign > 0 else 'down'}"
    lying = _LYING.get(upward, f"on its {'−' if sign > 0 else '+'}{name} side")
    lifted = f", {_lifted(azimuth, j, k)} lifted by {_degrees(tilt)}" if tilt >= 1e-6 else ""
    return f"{lying} ({upward}){lifted}"


def box_words(up: FloatArray) -> str:
    """Say which face, edge or corner of a box, its faces across the body's axes, points up in a direction (3,)."""
    faces = [f"{'+' if up[axis] > 0 else '−'}{'xyz'[axis]}" for axis in range(3) if abs(up[axis]) > 0.25]
    if len(faces) == 1:
        return f"face {faces[0]} up"
    return f"the {('edge', 'corner')[len(faces) - 2]} of faces {' and '.join([', '.join(faces[:-1]), faces[-1]])} up"


def attitude_words(attitude: FloatArray) -> str:
    """Say how a unit is held, seen by the person who holds it: which way is up, and where an axis points."""
    up = up_of(attitude)
    heading = _heading(attitude, up)
    name = f"+{'xyz'[_seen(up)[0]]}"
    turned = round(np.degrees(heading), 6)
    way, off = ("away from", abs(turned)) if abs(turned) < 90 else ("towards", 180 - abs(turned))
    hand = "left" if turned > 0 else "right"
    side = f"{way} you"
    if off == 90:
        side = f"to your {hand}"
    elif off > 0:
        side += f", {off:.4g}° to the {hand}"
    return f"{pose_words(up)}; {name} points {side}"
