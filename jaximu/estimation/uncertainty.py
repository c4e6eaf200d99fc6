"""Covariance, rank and weak directions of a solved problem, and what to record against them."""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

import numpy as np
import scipy

from jaximu.estimation.problem import TOLERANCE, Name
from jaximu.ground.array_types import Array, FloatArray, IntArray
from jaximu.ground.distributions import chi2_sf
from jaximu.ground.quantities import counted, listed, number, size
from jaximu.ground.units import SENSOR_UNITS, STANDARD_GRAVITY
from jaximu.ground.vectors import column_lengths, lengths_of
from jaximu.model.sensor import Imu

# Standard deviations along a direction, in typical sizes (10 % of a scale, 1 m/s², 0.1 rad/s).
UNDETERMINED = 1.0  # the data say no more than the data sheet
WEAK = 0.05
MOSTLY = 0.5
"""Share of a number's variance in open directions above which the data sheet, not the data, states it."""
_GRID = np.array([(x, y, z) for x in (-1, 0, 1) for y in (-1, 0, 1) for z in (-1, 0, 1) if x or y or z], float)
_GRID /= np.linalg.norm(_GRID, axis=1, keepdims=True)


@dataclass(frozen=True)
class WeakDirection:
    """A combination of parameters that the data leave (nearly) open.

    sigma: standard deviation along it, as a share of the parameters' typical size. determined: False where the data say
    next to nothing. parameters: the names that make up most of it, with their weights (unit vector in typical sizes);
    where it is open also the numbers that are known no better than from a data sheet, mostly for it.
    text: the same in words, and what to record.
    """

    sigma: float
    determined: bool
    parameters: tuple[tuple[str, float], ...]
    text: str


def open_numbers(weak: Sequence[WeakDirection]) -> frozenset[str]:
    """Return the names of the numbers that the data do not determine: those of open directions."""
    return frozenset(name for direction in weak if not direction.determined for name, _ in direction.parameters)


def gains_open(weak: Sequence[WeakDirection]) -> bool:
    """Return whether a gain is part of a combination that the data do not determine."""
    return any(".gain[" in name for name in open_numbers(weak))


def pose_advice(vector: FloatArray, names: Sequence[Name], sizes: FloatArray, model: Imu) -> str:
    """Say which poses by hand, or turns between them, would excite a direction most."""
    change, bias = _in_si(vector, names, sizes, model, "accelerometer")
    # norm change at gravity direction u: u·(δK u g + δb)
    effect = np.abs(np.einsum("ni,ij,nj->n", _GRID, change * STANDARD_GRAVITY, _GRID) + _GRID @ bias)
    gyro, _ = _in_si(vector, names, sizes, model, "gyroscope")
    turning = column_lengths(gyro)
    if np.linalg.norm(gyro) > 0.5 * np.linalg.norm(vector) * 0.1:
        axis = "xyz"[int(np.argmax(turning))]
        return f"turns of 90° or more about the {axis} axis, in both directions, with that axis horizontal."
    if effect.max() > 0.03:
        return f"poses with this body direction up: {_strongest(effect)}."
    return "more poses, and longer rests in them."


def station_advice(vector: FloatArray, names: Sequence[Name], sizes: FloatArray, model: Imu) -> str:
    """Say which known poses or turns would excite a direction most."""
    change, bias = _in_si(vector, names, sizes, model, "accelerometer")
    force = lengths_of(_GRID @ change.T * STANDARD_GRAVITY + bias)
    gyro, drift = _in_si(vector, names, sizes, model, "gyroscope")
    turning = column_lengths(gyro)
    remedies = []
    if force.max() > 0.1:
        remedies.append(f"a pose with this body direction up: {_strongest(force)}")
    if turning.max() > 0.01:
        remedies.append(f"a full turn each way about the {'xyz'[int(np.argmax(turning))]} axis")
    elif np.linalg.norm(drift) > 0.01:
        remedies.append("a rest in any pose")
    return ", and ".join(remedies or ["more of these poses and turns, and longer rests"]) + "."


def weak_directions(
    jacobian: Array,
    names: Sequence[Name],
    sizes: Array,
    model: Imu,
    advice: Callable[..., str] = pose_advice,
) -> tuple[int, tuple[WeakDirection, ...]]:
    """Return the rank and the weak directions, weakest first; `advice` says what to record against one.

    The Jacobian's columns are scaled by typical sizes, so a singular value is how many times better the data know a
    direction than the data sheet did: rank counts those above `1 / UNDETERMINED`, weak are those below `1 / WEAK`.
    Together the open directions span a subspace whose singular vectors are arbitrary mixtures; it is stated by a basis
    of few numbers each, the reduced row echelon form with columns pivoted (Businger and Golub, 1965).
    """
    _, values, right = np.linalg.svd(np.asarray(jacobian), full_matrices=jacobian.shape[0] < jacobian.shape[1])
    values = np.pad(values, (0, len(right) - len(values)))  # fewer residuals than parameters
    spread = right / np.hypot(values, 1 / TOLERANCE)[:, None]  # covariance: spread.T @ spread
    sigmas, variance = lengths_of(spread), np.sum(spread**2, axis=0)
    known = sigmas <= UNDETERMINED
    basis = _of_few_numbers(right[~known])
    lost = (variance > UNDETERMINED**2) & (np.sum(spread[~known] ** 2, axis=0) > MOSTLY * variance)
    holder = np.argmax(np.abs(basis), axis=0) if len(basis) else np.full(len(names), -1)
    weak = []
    for index, vector in enumerate([*basis, *right[known & (sigmas >= WEAK)][::-1]]):
        sigma = float(np.linalg.norm(spread @ vector))
        order = np.argsort(-np.abs(vector))
        vector = vector * np.sign(vector[order[0]])  # either sign is the same direction
        main = [k for k in order[:4] if abs(vector[k]) > 0.3] or order[:4]  # many may take part a little
        others = [k for k in order if lost[k] and holder[k] == index and k not in main]
        named = tuple((names[k], float(vector[k])) for k in (*main, *others))
        amounts = 1.96 * sigma * np.abs(vector) * np.asarray(sizes)
        determined = index >= len(basis)
        what = _words([(names[k], float(amounts[k])) for k in main], len(others), determined, model)
        text = f"{what} What to record: {advice(vector, names, sizes, model)}"
        weak.append(WeakDirection(sigma, determined, named, text))
    return int(np.sum(known)), tuple(weak)


def _of_few_numbers(basis: FloatArray) -> FloatArray:
    """Return unit vectors (k, p) that span the same as a basis (k, p), each zero at the others' pivots."""
    pivots = scipy.linalg.qr(basis, mode="r", pivoting=True)[1][: len(basis)]
    reduced = np.linalg.solve(basis[:, pivots], basis)
    return reduced / np.linalg.norm(reduced, axis=1, keepdims=True)


def describe(name: Name, model: Imu | None = None) -> str:
    """Turn `accelerometer.gain[1,0]` into words."""
    axes = ["xyz"[axis] for axis in name.axes] if name.part in ("gain", "bias") else []
    if name.part == "gain":
        scale = axes[0] == axes[1]
        return f"{name.owner} scale {axes[0]}" if scale else f"{name.owner} misalignment {axes[0]} from {axes[1]}"
    if name.part == "bias":
        return f"{name.owner} bias {axes[0]}"
    assert model is not None and name.effect is not None, "the name of an effect's number needs the model"
    return f"{model.all_effects()[name.owner, name.effect].english} ({label(name, model)})"


def label(name: Name, model: Imu) -> str:
    """Return a parameter as documents have it: `accelerometer.gain[1,0]`, `accel.temperature[0]`, `gyro.lag.tau`."""
    if name.effect is None:
        return str(name)
    effect = model.all_effects()[name.owner, name.effect].name
    return f"{effect}[{name.axes[0]}]" if name.part == "coefficients" else f"{effect}.{name.part}"


def _words(moves: list[tuple[Name, float]], others: int, determined: bool, model: Imu) -> str:
    """Say how far (95 %) the parameters of a direction can move together; amounts in the parameters' own units."""
    if len(moves) + others == 1:
        known = f"{describe(moves[0][0], model)} is only known to ±{spoken_amount(*moves[0], model)} (95 %)"
        return f"{known}." if determined else f"{known}: this recording does not determine it."
    named = [f"{describe(name, model)} (±{spoken_amount(name, amount, model)})" for name, amount in moves]
    named += [counted(others, "other")] * (others > 0)
    together = f"{listed(named)} can trade off by these amounts (95 %) without changing the fit"
    return f"{together}." if determined else f"{together}: it does not determine them."


def spoken_amount(name: Name, amount: float, model: Imu) -> str:
    """Return an amount of a parameter in units a person knows: % of a scale, mrad of a misalignment, SI of a bias."""
    if name.effect is not None:
        effect = model.all_effects()[name.owner, name.effect]
        output = model.triads()[effect.owner].output_unit if effect.owner in model.triads() else ""
        unit = effect.coefficient_unit(output) if name.part == "coefficients" else effect.inner[name.part].unit
        return size(amount, unit, 2)
    amount /= float(model.triads()[name.owner].scales[name.axes[0]])
    if name.part == "bias":
        return size(amount, SENSOR_UNITS[name.owner], 2)
    return f"{number(100 * amount, 2)} %" if name.axes[0] == name.axes[1] else f"{number(1e3 * amount, 2)} mrad"


def _in_si(
    vector: FloatArray, names: Sequence[Name], sizes: FloatArray, model: Imu, triad: str
) -> tuple[FloatArray, FloatArray]:
    """A direction's change of a triad's gain (relative) and bias (SI)."""
    parts = {"gain": np.zeros((3, 3)), "bias": np.zeros(3)}
    for name, weight, typical in zip(names, vector, np.asarray(sizes), strict=True):
        if name.owner == triad and name.effect is None:
            parts[name.part][name.axes] += weight * typical
    scale = model.triads()[triad].scales if triad in model.triads() else np.ones(3)
    return parts["gain"] / scale[:, None], parts["bias"] / scale


def _strongest(effect: FloatArray) -> str:
    """The body directions of `_GRID` at which an effect is largest, three at most."""
    return "; or ".join(direction_words(u) for u in _GRID[effect >= 0.9 * effect.max()][:3])


def direction_words(vector: FloatArray) -> str:
    """Put a direction into words, by its axes longer than a third of it."""
    axes = signed_axes(vector)
    return axes[0] if len(axes) == 1 else f"between {listed(axes)}"


def signed_axes(vector: Iterable[float]) -> list[str]:
    """Return the axes, "+x" or "−x", along which a unit vector has more than a third of its length."""
    return [("+" if value > 0 else "−") + axis for axis, value in zip("xyz", vector, strict=True) if abs(value) > 0.33]


_LAGS = 15
"""Neighbours on either side of which an error may be like its own."""
_CHANCE = 1e-3
"""Probability below which errors that are like their neighbours' are no chance."""


def allowing_for_neighbours(
    covariance: Array, sizes: Array, residual: Array, jacobian: Array, order: IntArray
) -> FloatArray | None:
    """Return a covariance (p, p) for errors of which neighbours in time are alike; None where they are not.

    Neighbours are asked by Ljung and Box (1978). The covariance is the sandwich of Newey and West (1987), in no
    direction smaller than the one for independent errors.

    **Arguments:** `covariance`: of the numbers, for independent errors; `residual` (n,), `jacobian` (n, p): whitened,
    the latter by numbers over their `sizes` (p,); `order`: of each row in time, counted from zero.
    """
    count = int(order.max()) + 1
    scores = np.zeros((count, jacobian.shape[1]))
    np.add.at(scores, order, jacobian * residual[:, None])
    error = residual[np.unique(order, return_index=True)[1]]  # of each time the first kind of its rows
    error = error[error != 0]  # padding, and what was left out
    error = error - error.mean()
    lags = np.arange(1, min(_LAGS, len(error) // 4) + 1)
    alike = np.array([error[lag:] @ error[:-lag] for lag in lags]) / (error @ error)
    statistic = len(error) * (len(error) + 2) * np.sum(alike**2 / (len(error) - lags))
    if not len(lags) or chi2_sf(statistic, len(lags)) > _CHANCE:
        return None
    middle = scores.T @ scores
    for lag in lags:
        beside = scores[lag:].T @ scores[:-lag]
        middle += (1 - lag / (len(lags) + 1)) * (beside + beside.T)
    root = np.linalg.cholesky(covariance / sizes[:, None] / sizes)
    values, vectors = np.linalg.eigh(root.T @ middle @ root)
    wider = root @ (vectors * np.sqrt(np.maximum(values, 1.0))) * sizes[:, None]
    return wider @ wider.T
