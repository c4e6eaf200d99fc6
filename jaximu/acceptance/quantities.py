"""What limits are put on, computed from calibrated units with its uncertainty: one formula for a unit and a fleet.

Every quantity is a function q(θ) of the model's numbers; its variance is ∂q C ∂qᵀ with the covariance C of the fit
(law of propagation, GUM 5.1.2), by automatic differentiation. *Bias* is what an axis puts out at zero input, over its
gain; *scale* its gain over the nominal one, less one; *misalignment* a cross-axis gain over the axis's own. *Output* is
the error of the corrected output, were the unit θ and not what was estimated, θ̂ (`jaximu.estimation.projection`): zero
at θ̂, with its uncertainty; *raw output* is what the output is off without any calibration. Of both the input of the
range counts at which |error| + 2 standard uncertainties is greatest.

Gravity acts on the accelerometer's gain as a whole, K ∝ 1/g. The rest of the variance is the recording's; as far as it
rests on the scatter of n conditions beyond their known noise (a share s of it), it has n − p degrees of freedom, and
the whole ν = (n − p) u⁴ / (s u²_recording)² (Welch and Satterthwaite, GUM G.4.1).
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import product

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree

from jaximu.acceptance.limits import Limit, Scales
from jaximu.acceptance.words import parts_of
from jaximu.calibration import Calibration
from jaximu.estimation.problem import Name, flatten, names_of, typical_sizes, unflatten
from jaximu.estimation.projection import output_error
from jaximu.estimation.uncertainty import UNDETERMINED
from jaximu.ground import stored
from jaximu.ground.array_types import BoolArray, FloatArray
from jaximu.ground.document import Json
from jaximu.ground.errors import InputError
from jaximu.ground.precision import require_float64
from jaximu.ground.units import SENSOR_QUANTITIES, SENSORS
from jaximu.ground.vectors import sigmas_of
from jaximu.model.sensor import Imu
from jaximu.model.stimulus import Stimulus
from jaximu.planning.chunks import in_chunks

_CHUNK = 512  # units that are computed at once
_GRID = np.array([point for point in product(range(-2, 3), repeat=3) if max(map(abs, point)) == 2], float)
_GRID /= np.linalg.norm(_GRID, axis=1, keepdims=True)
"""98 directions: the largest standard deviation among them is within 3 % of the largest of all."""


@dataclass(frozen=True)
class Units:
    """Calibrated units of one structure.

    like: the structure. numbers: (n, m) all numbers of each model; names: the free ones (p,); covariance (n, p, p),
    gravity's part included. gravity: (n,) standard deviation of gravity relative to it. conditions: by triad and
    "gain" or "bias", the degrees of freedom (n,) of the scatter beyond the noise, and its share (n,) of the variance.
    """

    like: Imu
    numbers: FloatArray
    names: tuple[Name, ...]
    covariance: FloatArray
    gravity: FloatArray
    conditions: Mapping[tuple[str, str], tuple[FloatArray, FloatArray]]


@dataclass(frozen=True)
class Measured:
    """Quantities (q) of n units. value, sigma, gravity (its part of sigma), freedom: (n, q) in SI.

    determined: (n, q) False for what the data leave open. fixed: (q,) True for what a convention sets. slope (n, q, p):
    by the free numbers.
    """

    names: tuple[str, ...]
    value: FloatArray
    sigma: FloatArray
    gravity: FloatArray
    freedom: FloatArray
    determined: BoolArray
    fixed: BoolArray
    slope: FloatArray


def of_calibration(calibration: Calibration) -> Units:
    """Return a calibration as one unit, without effects of a session or of the set-up."""
    imu = calibration.imu
    names = calibration.names
    data = calibration.data
    excess = calibration.excess
    fitted = sum(name.owner == "accelerometer" for name in names)
    poses = data.get("poses")
    turns = data.get("turns")
    counts = {}
    if poses is not None:
        # by hand a pose tells the norm alone; a known pose tells all three axes
        by_pose = 1 if fitted <= 9 else 3
        counts["accelerometer", "gain"] = counts["accelerometer", "bias"] = "accelerometer", by_pose * poses
        counts["gyroscope", "bias"] = "gyroscope", 3 * poses
        counts["gyroscope", "gain"] = "turns", None if turns is None else 2 * turns
    conditions = {}
    for (owner, part), (kind, count) in counts.items():
        if count is not None and kind in excess:
            free = fitted if owner == "accelerometer" else 9 if part == "gain" else 3
            conditions[owner, part] = np.array([max(1.0, count - free)]), share_of(np.array([excess[kind]]))
    gravity = calibration.gravity.sigma / calibration.gravity.value
    return Units(imu, flatten(imu)[None], names, calibration.covariance[None], np.array([gravity]), conditions)


def share_of(excess: FloatArray) -> FloatArray:
    """Return the share of the variance that scatter beyond the noise has."""
    return excess / (1 + excess)


def measure(units: Units, nominal: Scales, outputs: Sequence[Limit]) -> Measured:
    """Return all parameters of units, and the outputs that limits ask for, with their uncertainty.

    **Arguments:** `nominal`: by triad in counts, scale (3,) and offset (3,); `outputs`: limits of outputs.

    Raises `InputError` where an effect needs what an output's range does not state.
    """
    require_float64()
    known = units.like.triads()
    si = np.ones(3), np.zeros(3)
    scales = {name: nominal.get(name, si) if triad.output_unit == "count" else si for name, triad in known.items()}
    indices = np.array([names_of(units.like).index(name) for name in units.names], int)
    ranges = [(limit, output_stimulus(limit, units.like)) for limit in outputs if limit.owner in known]

    # one standard deviation of gravity changes these in proportion
    of_gravity = np.array([name.startswith("accelerometer.gain") for name in names_of(units.like)])

    def all_of(flat, covariance, gravity, like, scales, stimuli):
        def quantities(flat):
            imu = ravel_pytree(like)[1](flat)
            values = [_parameters(triad, *scales[name]) for name, triad in imu.triads().items()]
            values += [effect.coefficients for triad in imu.triads().values() for effect in triad.effects]
            return jnp.concatenate([jnp.ravel(value) for value in values])

        parts = [(quantities(flat), jax.jacfwd(quantities)(flat))]
        for (limit, _), stimulus in zip(ranges, stimuli, strict=True):
            error = _error_of_output(limit, like, flat, scales, stimulus)
            value, slope = error(flat), jax.jacfwd(error)(flat)  # (points, 3), (points, 3, m)
            worst = jnp.argmax(jnp.abs(value) + 2 * _sigma(slope[..., indices], covariance), axis=0)
            parts.append((value[worst, jnp.arange(3)], slope[worst, jnp.arange(3)]))
        value, slope = (jnp.concatenate(column) for column in zip(*parts, strict=True))
        free = slope[:, indices]
        return value, _sigma(free, covariance), jnp.abs(slope @ jnp.where(of_gravity, flat, 0.0)) * gravity, free

    stimuli = [stimulus for _, stimulus in ranges]
    description = f"accept {indices.tolist()} {[(limit.part, limit.owner) for limit, _ in ranges]}"
    batched = jax.vmap(all_of, (0, 0, 0, None, None, None))
    value, sigma, gravity, slope = in_chunks(
        lambda *rows: stored.call(batched, description, *rows, units.like, scales, stimuli),
        min(_CHUNK, len(units.numbers)),
        units.numbers,
        units.covariance,
        units.gravity,
    )
    names = (*_parameter_names(units.like), *(f"{limit.key}[{axis}]" for limit, _ in ranges for axis in range(3)))
    sizes = flatten(typical_sizes(unflatten(units.like, np.median(units.numbers, axis=0))))[indices]
    open_ = sigmas_of(units.covariance) > UNDETERMINED * sizes
    return Measured(
        names,
        value,
        sigma,
        gravity,
        _freedom(units, names, sigma, gravity),
        ~((np.abs(slope) > 0) & open_[:, None]).any(axis=2),
        np.all(slope == 0, axis=(0, 2)),
        slope,
    )


def _sigma(slope, covariance):
    return jnp.sqrt(jnp.maximum(jnp.einsum("...i,ij,...j->...", slope, covariance, slope), 0.0))


def _parameters(triad, scale, offset):
    """Return bias (3,), scale (3,) and misalignment (6,) of a triad, one after the other."""
    diagonal = jnp.diagonal(triad.gain)
    crossed = (triad.gain / diagonal[:, None])[~np.eye(3, dtype=bool)]
    return jnp.concatenate([(triad.bias - offset) / diagonal, diagonal / scale - 1, crossed])


def _parameter_names(imu: Imu) -> Iterator[str]:
    for owner in imu.triads():
        yield from (f"{owner}.{part}[{axis}]" for part in ("bias", "scale") for axis in range(3))
        yield from (f"{owner}.misalignment[{i},{j}]" for i in range(3) for j in range(3) if i != j)
    for triad in imu.triads().values():
        yield from (f"{effect.name}[{k}]" for effect in triad.effects for k in range(effect.size))


def output_stimulus(limit: Limit, imu: Imu) -> Stimulus:
    """Return the inputs (points, 3) of a range: 98 directions at its end, at the ends and the middle of temperature."""
    inputs: Json = {SENSOR_QUANTITIES[limit.owner]: limit.over * _GRID}
    if limit.temperature is not None:
        low, high = limit.temperature
        warmth = np.repeat([low, (low + high) / 2, high], len(_GRID))
        inputs = {name: np.tile(values, (3, 1)) for name, values in inputs.items()} | {"temperature": warmth}
    stimulus = Stimulus(**inputs)
    try:
        jax.eval_shape(imu.transferable().triads()[limit.owner].respond, stimulus)
    except InputError as error:
        raise InputError(f"{limit.key}: {error} State it beside `over`, or limit the parameters.") from error
    return stimulus


def _error_of_output(limit: Limit, like, flat, scales, stimulus):
    """Return the function of a model's numbers that gives the output's error (points, 3), in SI."""
    restore = ravel_pytree(like)[1]

    def raw(numbers):
        scale, offset = scales[limit.owner]
        triad = restore(numbers).transferable().triads()[limit.owner]
        return (triad.respond(stimulus) - offset) / scale - getattr(stimulus, triad.quantity)

    def corrected(numbers):
        error = output_error(restore(flat), restore(numbers), stimulus)[limit.owner]
        return error - output_error(restore(flat), restore(flat), stimulus)[limit.owner]

    return raw if limit.part == "raw_output" else corrected


def _freedom(units: Units, names: Sequence[str], sigma: FloatArray, gravity: FloatArray) -> FloatArray:
    """Return the effective degrees of freedom (n, q)."""
    effective = np.full(sigma.shape, np.inf)
    for column, name in enumerate(names):
        _, owner, part, _ = parts_of(name)
        known = units.conditions.get((SENSORS.get(owner, owner), "bias" if part == "bias" else "gain"))
        if known is None:
            continue
        freedom, share = known
        total = sigma[:, column] ** 2
        scattered = share * np.maximum(total - gravity[:, column] ** 2, 0.0)
        has = scattered > 1e-9 * total
        effective[has, column] = (freedom * total**2)[has] / scattered[has] ** 2
    return np.maximum(effective, 1.0)
