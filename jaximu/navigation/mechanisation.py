"""Strapdown mechanisation in the local level frame on the WGS-84 ellipsoid, and its linear error model.

The level frame is x east, y north, z up. With C the attitude (body to level), v the velocity over ground, M and N the
radii of curvature in the meridian and across it, at latitude φ and height h (Savage, Strapdown Analytics, 2000, ch. 4;
Groves, Principles of GNSS, Inertial, and Multisensor Integrated Navigation Systems, 2013, sec. 5.4):

    ω_ie = Ω (0, cos φ, sin φ),   ω_en = (−v_n/(M + h), v_e/(N + h), v_e tan φ/(N + h)),
    C′ = C [ω]× − [ω_ie + ω_en]× C,   v′ = C f + γ − (2 ω_ie + ω_en) × v,   φ′ = v_n/(M + h), λ′ = v_e/((N + h) cos φ),

with γ normal gravity, straight down, plus a constant that makes it what it is stated to be at the start (its part to
the north, 8e-9 h, is left out). Coning and sculling are in the samples' increments (`increments`). Up to ten samples
are pre-integrated in the body frame and then put into the level frame at once, with its rates, radii and gravity half
way. Near the poles longitude is not defined: latitudes within ±85° are meant.

A step is written by component, so that a CPU computes draws and units side by side.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Float

from jaximu.ground.array_types import Array
from jaximu.ground.gravity import EQUATOR_RADIUS, SQUARED_ECCENTRICITY, normal_gravity
from jaximu.ground.rotation import (
    Numbers,
    Quaternion,
    Vector,
    Vectors,
    conjugate,
    exponential,
    logarithm,
    multiply,
    product,
    rotation_rows,
)
from jaximu.ground.tracing import array_module
from jaximu.model.effects.earth_rotation import EARTH_RATE
from jaximu.navigation.by_component import cross, matvec, right_jacobian, transpose, turn

_TOGETHER = 10
"""Samples that are put into the level frame at once, at the most."""


class Navigation(NamedTuple):
    """Where a unit is, how fast and how it stands; any leading axes.

    attitude: quaternion, body to level (east, north, up). velocity: east, north, up, m/s. latitude, longitude: rad.
    height: above the ellipsoid, m. anomaly: gravity at the start less normal gravity there, m/s².
    """

    attitude: Quaternion
    velocity: Vector
    latitude: Numbers
    longitude: Numbers
    height: Numbers
    anomaly: Numbers

    @classmethod
    def at(cls, attitude, velocity, latitude: float, height: float, gravity: float) -> Navigation:
        """Return a start at a latitude (rad) and height (m) where gravity (m/s²) has been stated; longitude zero."""
        numerics = array_module(attitude, velocity, latitude, height, gravity)
        numbers = (latitude, 0.0, height, gravity - normal_gravity(numerics.sin(latitude) ** 2, height))
        return cls(*map(numerics.asarray, (attitude, velocity)), *(numerics.asarray(one, float) for one in numbers))


def _radii(sine: Array, height: Array) -> tuple[Array, Array]:
    """Return M + h and N + h, m, of the sine of the latitude."""
    root = 1 - SQUARED_ECCENTRICITY * sine**2
    across = EQUATOR_RADIUS / jnp.sqrt(root)
    return across * (1 - SQUARED_ECCENTRICITY) / root + height, across + height


class _Sums(NamedTuple):
    """Samples since the last step, pre-integrated: ΔR, Δv (m/s), Δp (m), in the body frame at that step."""

    rotation: list[Array]
    velocity: list[Array]
    position: list[Array]
    duration: Array


def _none_yet(like: Array) -> _Sums:
    zero = jnp.zeros_like(like)
    return _Sums([zero + 1, zero, zero, zero], [zero] * 3, [zero] * 3, jnp.zeros(()))


def _add(sums: _Sums, rotation: list[Array], gained: list[Array], interval: Array) -> _Sums:
    """Add one sample: `jaximu.data.preintegration`'s sums, one term at a time."""
    rows = rotation_rows(sums.rotation)
    pushed = matvec(rows, matvec(transpose(right_jacobian(rotation)), gained))
    inside = matvec(rows, [g / 2 + c / 6 for g, c in zip(gained, cross(rotation, gained), strict=True)])
    position = [p + (v + d) * interval for p, v, d in zip(sums.position, sums.velocity, inside, strict=True)]
    velocity = [v + d for v, d in zip(sums.velocity, pushed, strict=True)]
    return _Sums(turn(sums.rotation, rotation), velocity, position, sums.duration + interval)


def _lagging(vector: list[Array], rate: list[Array], time: Array | float) -> list[Array]:
    """Return a vector as a frame sees it that has turned at a rate for some time, to first order."""
    return [component - time * swept for component, swept in zip(vector, cross(rate, vector), strict=True)]


def _step(state: Navigation, sums: _Sums) -> Navigation:
    """Advance by some samples; vectors are lists of components, arrays (...) of lanes."""
    east, north, up = state.velocity
    time = sums.duration
    latitude, height = state.latitude + north * time / (2 * EQUATOR_RADIUS), state.height + up * time / 2  # half way
    sine, cosine = jnp.sin(latitude), jnp.cos(latitude)
    meridian, across = _radii(sine, height)
    gravity = normal_gravity(sine**2, height) + state.anomaly
    attitude = rotation_rows(state.attitude)
    pushed = matvec(attitude, sums.velocity)
    carried = matvec(attitude, sums.position)
    earth = [jnp.zeros_like(sine), EARTH_RATE * cosine, EARTH_RATE * sine]
    pushed = _lagging(pushed, earth, time / 2)  # the frame turns meanwhile
    east, north, _ = (v + d / 2 for v, d in zip(state.velocity, pushed, strict=True))
    moving = [-north / meridian, east / across, east * sine / (cosine * across)]
    turning = [(a + b) * time for a, b in zip(earth, moving, strict=True)]
    pushed = _lagging(pushed, moving, time / 2)
    carried = _lagging(carried, turning, 1 / 3)
    pushed[2] -= gravity * time
    middle = [v + d / 2 for v, d in zip(state.velocity, pushed, strict=True)]
    coriolis = cross([2 * a + b for a, b in zip(earth, moving, strict=True)], middle)
    after = [v + d - c * time for v, d, c in zip(state.velocity, pushed, coriolis, strict=True)]
    moved = [v * time + p - c * time**2 / 2 for v, p, c in zip(state.velocity, carried, coriolis, strict=True)]
    moved[2] -= gravity * time**2 / 2
    w, x, y, z = product(state.attitude, sums.rotation)
    w, x, y, z = turn([w, -x, -y, -z], turning)  # exp(−ζ) ⊗ q = (q* ⊗ exp(ζ))*
    return Navigation(
        [w, -x, -y, -z],
        after,
        state.latitude + moved[1] / meridian,
        state.longitude + moved[0] / (across * cosine),
        state.height + moved[2],
        state.anomaly,
    )


def _parts(array: Array) -> list[Array]:
    return list(jnp.unstack(array, axis=-1))


def _split(state: Navigation) -> Navigation:
    return state._replace(attitude=_parts(state.attitude), velocity=_parts(state.velocity))


def _joined(state: Navigation) -> Navigation:
    return state._replace(attitude=jnp.stack(state.attitude, -1), velocity=jnp.stack(state.velocity, -1))


def mechanise(
    start: Navigation,
    rotation: Vectors,
    gained: Vectors,
    intervals: Float[Array, " S"],
    every: int = 1,
) -> Navigation:
    """Return the navigation after every so many samples: leading axes, then S / `every`.

    A pure function of its arrays: differentiable, and over leading axes (units, draws) computed side by side.

    **Arguments:** `rotation` (rad) and `gained` (m/s): each sample's `increments`; `intervals` in s, the same for all
    leading axes. `every` divides S.
    """
    lanes = jnp.broadcast_shapes(rotation.shape[:-2], start.velocity.shape[:-1])
    samples = rotation.shape[-2]
    together = next(size for size in range(_TOGETHER, 0, -1) if every % size == 0)

    def blocks(array):  # (..., S, 3) -> (S / every, every / together, together, ...) of each component
        moved = jnp.moveaxis(jnp.broadcast_to(array, (*lanes, samples, 3)), -2, 0)
        return [component.reshape(-1, every // together, together, *lanes) for component in _parts(moved)]

    def add(sums, sample):
        return _add(sums, *sample), None

    def advance(state, part):
        return _step(state, jax.lax.scan(add, _none_yet(state.height), part)[0]), None

    def block(state, part):
        state = jax.lax.scan(advance, state, part)[0]
        length = jnp.sqrt(sum(component**2 for component in state.attitude))
        state = state._replace(attitude=[component / length for component in state.attitude])
        return state, state

    return _scanned(
        block, start, lanes, (blocks(rotation), blocks(gained), intervals.reshape(-1, every // together, together))
    )


def _scanned(advance: Callable, start: Navigation, lanes: tuple, parts: tuple) -> Navigation:
    first = jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, lanes), _split(start))
    states = jax.lax.scan(advance, first, parts)[1]
    return jax.tree.map(lambda leaf: jnp.moveaxis(leaf, 0, len(lanes)), _joined(states))


def mechanise_increments(
    start: Navigation,
    rotation: Float[Array, "... B 4"],
    velocity: Float[Array, "... B 3"],
    displacement: Float[Array, "... B 3"],
    durations: Float[Array, " B"],
) -> Navigation:
    """Return the navigation after each of B pre-integrated stretches (`jaximu.navigation.preintegrate`); leading axes.

    Each is put into the level frame at once: a second is short enough. What an error of the unit changes in the
    increments is linear in it (`Preintegrated.moved`), so thousands of draws need the samples only once.
    """
    lanes = jnp.broadcast_shapes(rotation.shape[:-2], start.velocity.shape[:-1])

    def advance(state, stretch):
        state = _step(state, _Sums(*stretch))
        return state, state

    def parts(array):
        moved = jnp.moveaxis(array, -2, 0)
        return _parts(jnp.broadcast_to(moved, (len(moved), *lanes, array.shape[-1])))

    return _scanned(advance, start, lanes, (parts(rotation), parts(velocity), parts(displacement), durations))


def deviation(state: Navigation, reference: Navigation) -> Float[Array, "... 9"]:
    """Return position (m), velocity (m/s) and attitude (rad) less the reference's: east, north, up of each.

    Attitude: the rotation vector in the level frame that turns the reference's attitude into the other.
    """
    meridian, across = _radii(jnp.sin(reference.latitude), reference.height)
    position = [
        (state.longitude - reference.longitude) * across * jnp.cos(reference.latitude),
        (state.latitude - reference.latitude) * meridian,
        state.height - reference.height,
    ]
    attitude = logarithm(multiply(state.attitude, conjugate(reference.attitude)))
    return jnp.concatenate([jnp.stack(position, -1), state.velocity - reference.velocity, attitude], axis=-1)


def _moved(reference: Navigation, error: Float[Array, 9]) -> Navigation:
    """Return the state whose `deviation` from the reference is `error`."""
    meridian, across = _radii(jnp.sin(reference.latitude), reference.height)
    east, north, up = error[:3]
    return reference._replace(
        attitude=multiply(exponential(error[6:]), reference.attitude),
        velocity=reference.velocity + error[3:6],
        latitude=reference.latitude + north / meridian,
        longitude=reference.longitude + east / (across * jnp.cos(reference.latitude)),
        height=reference.height + up,
    )


def linearised(
    start: Navigation,
    rotation: Float[Array, "S 3"],
    gained: Float[Array, "S 3"],
    intervals: Float[Array, " S"],
) -> tuple[Float[Array, "S 9 9"], Float[Array, "S 9 6"]]:
    """Return F and G of the errors along a path, e ← F e + G (δω, δf), by forward-mode derivatives of the step.

    e: as `deviation` has it. δω, δf: of each sample's mean rate (rad/s) and specific force (m/s²); that a change of one
    sample moves the coning of its neighbours is left out, as in `jaximu.data.preintegration.turned_by_rates`.
    """
    states = mechanise(start, rotation, gained, intervals)
    before = jax.tree.map(lambda first, rest: jnp.concatenate([first[None], rest[:-1]]), start, states)

    def slopes(before, after, rotation, gained, interval):
        def error(change):
            state = _split(_moved(before, change[:9]))
            vectors = rotation + change[9:12] * interval, gained + change[12:] * interval
            sums = _add(_none_yet(before.height), _parts(vectors[0]), _parts(vectors[1]), interval)
            return deviation(_joined(_step(state, sums)), after)

        return jax.jacfwd(error)(jnp.zeros(15))

    whole = jax.vmap(slopes)(before, states, rotation, gained, intervals)
    return whole[..., :9], whole[..., 9:]
