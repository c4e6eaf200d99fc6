"""Covariance, rank and weak directions of a solved problem, and what to record against them."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from jaximu.problem import TOLERANCE, Parameters
from jaximu.sensor import Imu

__all__ = ["WeakDirection", "describe", "weak_directions"]

FloatArray = NDArray[np.float64]

# Standard deviations along a direction, in typical sizes (10 % of a scale, 1 m/s², 0.1 rad/s).
UNDETERMINED = 1.0  # the data say no more than the data sheet
WEAK = 0.05


@dataclass(frozen=True)
class WeakDirection:
    """A combination of parameters that the data leave (nearly) open.

    sigma: standard deviation along it, as a share of the parameters' typical size. determined: False where the data say
    next to nothing. parameters: the names that make up most of it, with their weights (unit vector in typical sizes).
    text: the same in words, and what to record.
    """

    sigma: float
    determined: bool
    parameters: tuple[tuple[str, float], ...]
    text: str


def weak_directions(jacobian: FloatArray, parameters: Parameters, model: Imu) -> tuple[int, tuple[WeakDirection, ...]]:
    """Return the rank and the weak directions, weakest first.

    The Jacobian's columns are scaled by typical sizes, so a singular value is how many times better the data know a
    direction than the data sheet did: rank counts those above `1 / UNDETERMINED`, weak are those below `1 / WEAK`.
    """
    _, values, right = np.linalg.svd(np.asarray(jacobian), full_matrices=jacobian.shape[0] < jacobian.shape[1])
    values = np.pad(values, (0, len(right) - len(values)))  # fewer residuals than parameters
    found = []
    for value, vector in sorted(zip(values, right, strict=True), key=lambda pair: pair[0]):
        sigma = 1 / np.hypot(value, 1 / TOLERANCE)
        if sigma < WEAK:
            break
        order = np.argsort(-np.abs(vector))
        main = [place for place in order if abs(vector[place]) > 0.3][:4]
        named = tuple((parameters.names[place], float(vector[place])) for place in main)
        amounts = 1.96 * sigma * np.abs(vector) * np.asarray(parameters.size)
        moves = [(parameters.names[place], float(amounts[place])) for place in main]
        what = _words(moves, bool(sigma <= UNDETERMINED), model)
        text = f"{what} What to record: {_advice(vector, parameters, model)}"
        found.append(WeakDirection(float(sigma), bool(sigma <= UNDETERMINED), named, text))
    rank = int(np.sum(1 / np.hypot(values, 1 / TOLERANCE) <= UNDETERMINED))
    return rank, tuple(found)


def describe(name: str) -> str:
    """Turn `accelerometer.gain[1,0]` into words."""
    triad, _, rest = name.partition(".")
    stem, _, places = rest.partition("[")
    axes = ["xyz"[int(place)] for place in places.rstrip("]").split(",") if place.isdigit()]
    if stem == "gain":
        return f"{triad} scale {axes[0]}" if axes[0] == axes[1] else f"{triad} misalignment {axes[0]} from {axes[1]}"
    if stem == "bias":
        return f"{triad} bias {axes[0]}"
    return f"{triad} {rest}"


def _words(moves: list[tuple[str, float]], determined: bool, model: Imu) -> str:
    """Say how far (95 %) the parameters of a direction can move together; amounts in the parameters' own units."""
    if len(moves) == 1:
        known = f"{describe(moves[0][0])} is only known to ±{_amount(*moves[0], model)} (95 %)"
        return f"{known}." if determined else f"{known}: this recording does not determine it."
    named = [f"{describe(name)} (±{_amount(name, amount, model)})" for name, amount in moves]
    together = (
        f"{', '.join(named[:-1])} and {named[-1]} can shift together by so much (95 %) and the recording looks the same"
    )
    return f"{together}." if determined else f"{together}: it does not determine them."


def _amount(name: str, amount: float, model: Imu) -> str:
    """An amount of a parameter in units a person knows: % of a scale, mrad of a misalignment, SI of a bias."""
    triad, _, rest = name.partition(".")
    stem, _, places = rest.rstrip("]").partition("[")
    if stem not in ("gain", "bias"):
        return f"{amount:.2g}"
    axes = [int(place) for place in places.split(",")]
    amount /= float(np.linalg.norm(np.asarray(getattr(model, triad).gain)[axes[0]]))
    if stem == "bias":
        return f"{amount:.2g} {'m/s²' if triad == 'accelerometer' else 'rad/s'}"
    return f"{100 * amount:.2g} %" if axes[0] == axes[1] else f"{1e3 * amount:.2g} mrad"


def _advice(vector: FloatArray, parameters: Parameters, model: Imu) -> str:
    """Say which poses or turns would excite a direction most."""
    change = {"accelerometer": [np.zeros((3, 3)), np.zeros(3)], "gyroscope": [np.zeros((3, 3)), np.zeros(3)]}
    for name, weight, size in zip(parameters.names, vector, np.asarray(parameters.size), strict=True):
        triad, _, rest = name.partition(".")
        stem, _, places = rest.partition("[")
        if stem in ("gain", "bias"):
            index = tuple(int(place) for place in places.rstrip("]").split(","))
            change[triad][stem == "bias"][index] += weight * size
    scale = {
        "accelerometer": np.linalg.norm(np.asarray(model.accelerometer.gain), axis=1),
        "gyroscope": np.ones(3)
        if model.gyroscope is None
        else np.linalg.norm(np.asarray(model.gyroscope.gain), axis=1),
    }
    gain, bias = (part / (scale["accelerometer"][:, None] if part.ndim == 2 else scale["accelerometer"])
                  for part in change["accelerometer"])  # fmt: skip
    # norm change at gravity direction u: u·(δK u g + δb)
    grid = np.array([(x, y, z) for x in (-1, 0, 1) for y in (-1, 0, 1) for z in (-1, 0, 1) if x or y or z], float)
    grid /= np.linalg.norm(grid, axis=1, keepdims=True)
    effect = np.abs(np.einsum("ni,ij,nj->n", grid, gain * 9.80665, grid) + grid @ bias)
    gyro = change["gyroscope"][0] / scale["gyroscope"][:, None]
    turning = np.linalg.norm(gyro, axis=0)
    if np.linalg.norm(gyro) > 0.5 * np.linalg.norm(vector) * 0.1:
        axis = "xyz"[int(np.argmax(turning))]
        return f"turns of 90° or more about the {axis} axis, in both directions, with that axis horizontal."
    if effect.max() > 0.03:
        strongest = effect >= 0.9 * effect.max()
        return "poses with this body direction up: " + "; or ".join(_pointing(u) for u in grid[strongest][:3]) + "."
    return "more poses, and longer rests in them."


def _pointing(direction: FloatArray) -> str:
    parts = [
        ("+" if value > 0 else "−") + axis for axis, value in zip("xyz", direction, strict=True) if abs(value) > 0.1
    ]
    return parts[0] if len(parts) == 1 else f"halfway between {', '.join(parts[:-1])} and {parts[-1]}"
