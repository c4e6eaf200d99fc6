"""The sensor model: `Stimulus` in, output out (`respond`), and back (`recover`).

Forward, truth to output: y = K (u + Σ input effects) + b + Σ output effects. u is the specific force (m/s²) or the
angular rate (rad/s) in the body frame, y the output in `output_unit` (an SI unit or counts), K the 3×3 gain in output
units per SI unit, b the bias in output units. An effect says by `refers_to` whether it changes what the axes sense
(a lever arm, a lag) or what they put out (a nonlinearity, a bias over temperature). All effects see the true u: what
one adds, another does not feel, which would be of second order in small things. A `SetupEffect` changes neither: it
changes what the sensor goes through, as against what the set-up says.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from jaximu.ground.array_types import Array, FloatArray
from jaximu.ground.errors import InputError
from jaximu.ground.rotation import Matrix, Vector, apply_matrix, inverse_matrix
from jaximu.ground.units import SENSOR_UNITS
from jaximu.model.effects.base import Effect, SetupEffect
from jaximu.model.stimulus import REFERENCE_TEMPERATURE, Stimulus, rate_of_change

_REFRESHED = 3
"""Rounds of `recover` in which a derivative of the input is taken again. More would amplify what it cannot resolve:
a lag τ is undone up to (τ d/dt)³."""


class Triad(eqx.Module):
    """Three sensor axes: gain K (3, 3), bias b (3,), and the effects beyond them.

    `quantity` names what it senses, `specific_force`, `angular_rate` or `magnetic_field`. `temperature_reference` (°C)
    and `time_reference` (s) are where gain and bias hold.
    """

    gain: Matrix
    bias: Vector
    effects: tuple[Effect, ...] = ()
    quantity: str = eqx.field(static=True, default="specific_force")
    output_unit: str = eqx.field(static=True, default="m/s^2")
    iterations: int = eqx.field(static=True, default=16)
    temperature_reference: float = eqx.field(static=True, default=REFERENCE_TEMPERATURE)
    time_reference: float = eqx.field(static=True, default=0.0)

    def respond(self, stimulus: Stimulus) -> Vector:
        """Return the noise-free output (..., 3) in `output_unit`."""
        stimulus = self._referred(stimulus)
        true = getattr(stimulus, self.quantity)
        if true is None:
            raise InputError(f"the triad senses the {self.quantity.replace('_', ' ')}, which the stimulus lacks.")
        sensed = true + _total(self._effects("input"), stimulus)
        return apply_matrix(self.gain, sensed) + self.bias + _total(self._effects("output"), stimulus)

    def recover(self, output: Vector, stimulus: Stimulus | None = None) -> Vector:
        """Return the input (..., 3) in SI that gives `output`: the exact inverse of `respond`.

        Without effects this is K⁻¹(y − b). With effects it is the fixed point of
        u = K⁻¹(y − b − Σ output effects(u)) − Σ input effects(u), run for `iterations` rounds: each shrinks the error
        by the effects' slope against the gain, so slopes of 10 % leave 1e-16 after sixteen, and 20 % 1e-11. What an
        effect has destroyed (a dead band) stays lost; what it needs differentiated (a lag) comes back as far as the
        samples resolve it, see `Effect.recovery`. `stimulus` gives what else the effects depend on (temperature, the
        other triad's input …).
        """
        inverse = inverse_matrix(self.gain)
        stimulus = self._referred(Stimulus() if stimulus is None else stimulus)
        derived = self._derived(stimulus)
        sought = {self.quantity} | ({"angular_acceleration"} if derived else set())

        def parted(side: str) -> tuple[list[Effect], list[Effect]]:
            effects = [effect for effect in self._effects(side) if effect.invertible]
            moving = [effect for effect in effects if sought & set(effect.needs)]
            return moving, [effect for effect in effects if not sought & set(effect.needs)]

        (at_input, known_input), (at_output, known_output) = parted("input"), parted("output")
        # what does not depend on the input sought (a lagged temperature, say) is taken off once
        offset = _total(known_input, stimulus)
        centred = output - self.bias - _total(known_output, stimulus)
        value = apply_matrix(inverse, centred) - offset

        def round_(count, carried):
            value, derivative = carried
            context = replace(stimulus, **{self.quantity: value})
            if derived:
                derivative = jnp.where(count < _REFRESHED, rate_of_change(value, context.time), derivative)
                context = replace(context, angular_acceleration=derivative)
            value = apply_matrix(inverse, centred - _total(at_output, context)) - _total(at_input, context) - offset
            return value, derivative

        if at_input or at_output:
            # a loop, not its unrolled rounds: many effects compile ten times quicker
            value, _ = jax.lax.fori_loop(0, self.iterations, round_, (value, jnp.zeros_like(value)))
        return value

    def recover_on_host(self, output: FloatArray) -> FloatArray:
        """Return K⁻¹(y − b) (..., 3), effects left out, of outputs in NumPy, where nothing is to be traced."""
        return (np.asarray(output) - np.asarray(self.bias)) @ np.linalg.inv(np.asarray(self.gain)).T

    @property
    def scales(self) -> FloatArray:
        """How many output units each axis (3,) has per SI unit, in NumPy."""
        return np.linalg.norm(np.asarray(self.gain), axis=-1)

    def inverse(self) -> Float[Array, "3 4"]:
        """Return (A | c) of u = A y + c, the inverse without effects: A = K⁻¹ and c = −K⁻¹ b."""
        matrix = inverse_matrix(self.gain)
        return jnp.concatenate([matrix, -(matrix @ self.bias)[:, None]], axis=1)

    def memory(self, stimulus: Stimulus) -> dict[str, Float[Array, "... _"]]:
        """Return what the effects remember at the end of a path: the `memory` of the stimulus that goes on from it."""
        stimulus = self._referred(stimulus)
        return {effect.name: effect.remember(stimulus) for effect in self.effects if effect.memory}

    def _effects(self, side: str) -> tuple[Effect, ...]:
        return tuple(effect for effect in self.effects if effect.refers_to == side)

    def _referred(self, stimulus: Stimulus) -> Stimulus:
        return replace(stimulus, temperature_reference=self.temperature_reference, time_reference=self.time_reference)

    def _derived(self, context: Stimulus) -> bool:
        """Whether an effect needs the derivative of this triad's own input, which then follows from the iterate."""
        wanted = any("angular_acceleration" in effect.needs for effect in self.effects)
        return (
            wanted and context.on_a_path() and self.quantity == "angular_rate" and context.angular_acceleration is None
        )


def _total(effects: Iterable[Effect], stimulus: Stimulus) -> Vector | float:
    return sum((effect.term(stimulus) for effect in effects), start=0.0)


class Imu(eqx.Module):
    """An accelerometer triad and, unless None, a gyroscope triad in the same body frame; errors of the set-up.

    A magnetometer, unless None, senses the `magnetic_field` in µT; its gain holds soft iron, its bias hard iron.
    """

    accelerometer: Triad
    gyroscope: Triad | None
    setup: tuple[SetupEffect, ...] = ()
    magnetometer: Triad | None = None

    @classmethod
    def nominal(
        cls,
        accelerometer_scale=(1.0,) * 3,
        accelerometer_offset=(0.0,) * 3,
        accelerometer_unit="m/s^2",
        gyroscope_scale=(1.0,) * 3,
        gyroscope_offset=(0.0,) * 3,
        gyroscope_unit="rad/s",
    ) -> Imu:
        """Return the unit as its data sheet describes it: diagonal gains, the given offsets, no effects."""

        def triad(scale, offset, quantity, unit):
            gain = np.diag(np.asarray(scale, float))  # on the host: eager JAX operations each cost a compilation
            return Triad(gain, np.asarray(offset, float), quantity=quantity, output_unit=unit)

        return cls(
            triad(accelerometer_scale, accelerometer_offset, "specific_force", accelerometer_unit),
            triad(gyroscope_scale, gyroscope_offset, "angular_rate", gyroscope_unit),
        )

    def triads(self) -> dict[str, Triad]:
        """Return the triads that are there, by name."""
        return {name: triad for name in SENSOR_UNITS if (triad := getattr(self, name)) is not None}

    def triad(self, name: str) -> Triad:
        """Return a triad that is there."""
        return self.triads()[name]

    def all_effects(self) -> dict[tuple[str, int | None], Effect]:
        """Return all effects by owner and place, in the order of the unit's numbers."""
        owners = {name: triad.effects for name, triad in self.triads().items()} | {"setup": self.setup}
        return {(owner, index): effect for owner, effects in owners.items() for index, effect in enumerate(effects)}

    def coefficients(self, kind: type[Effect]) -> Array:
        """Return the coefficients (q,) of the unit's effect of a kind; zeros where it has none."""
        effects = (effect.coefficients for effect in self.all_effects().values() if isinstance(effect, kind))
        return next(effects, np.zeros(kind.size))

    def without(self, *kinds: type[Effect]) -> Imu:
        """Return the unit without its effects of some kinds."""
        return self.with_effects(*(effect for effect in self.all_effects().values() if not isinstance(effect, kinds)))

    def with_effects(self, *effects: Effect) -> Imu:
        """Return the unit with these effects and no others, each with its owner.

        Raises `InputError` for an effect of a gyroscope or magnetometer where there is none.
        """
        if not effects and not self.all_effects():
            return self
        triads = self.triads()
        owned: dict[str, tuple] = {name: () for name in (*triads, "setup")}
        for effect in effects:
            if effect.owner not in owned:
                raise InputError(f"the unit has no {effect.owner}, which the effect {effect.name} belongs to.")
            owned[effect.owner] += (effect,)
        changed: dict[str, Any] = {name: replace(triad, effects=owned[name]) for name, triad in triads.items()}
        return replace(self, **changed, setup=owned["setup"])

    def in_recording(self, number: int) -> Imu:
        """Return the unit as it was in the recording of this number: effects of another have coefficients of zero."""
        return self.with_effects(*(effect.in_recording(number) for effect in self.all_effects().values()))

    def respond(self, stimulus: Stimulus) -> tuple[Vector, Vector | None]:
        """Return the outputs of both triads to what the set-up says they go through."""

        def output(triad: Triad) -> Vector:
            return triad.respond(self.acted(stimulus, triad.quantity))

        return output(self.accelerometer), self.gyroscope and output(self.gyroscope)

    def acted(self, stimulus: Stimulus, quantity: str) -> Stimulus:
        """Return what the triad that senses `quantity` truly goes through where the set-up says `stimulus`."""
        for effect in self.setup:
            stimulus = effect.act(stimulus, quantity)
        return stimulus

    def recover(
        self,
        accelerometer_output: Vector,
        gyroscope_output: Vector | None,
        stimulus: Stimulus | None = None,
    ) -> tuple[Vector, Vector | None]:
        """Return specific force (m/s²) and angular rate (rad/s) from both outputs on the same stamps.

        Each triad's effects may depend on the other's input (g-sensitivity, lever arms). Then the two are recovered in
        turn until both stand: the error shrinks each time by the product of the two slopes, which is of the order of
        1e-3 or less for a unit that deserves calibration; eight turns leave nothing. Set-up effects are not undone.
        """
        stimulus = Stimulus() if stimulus is None else stimulus
        if gyroscope_output is None or self.gyroscope is None:
            return self.accelerometer.recover(accelerometer_output, stimulus), None
        crossed = any("angular_rate" in e.needs for e in self.accelerometer.effects) or any(
            "specific_force" in e.needs for e in self.gyroscope.effects
        )
        accelerometer, gyroscope = self.accelerometer, self.gyroscope
        derived = stimulus.angular_acceleration is None and stimulus.on_a_path()

        def turn(_, carried):
            _, rate = carried
            context = replace(stimulus, angular_rate=rate)
            if derived:
                context = replace(context, angular_acceleration=rate_of_change(rate, stimulus.time))
            force = accelerometer.recover(accelerometer_output, context)
            return force, gyroscope.recover(gyroscope_output, replace(stimulus, specific_force=force))

        rate = replace(gyroscope, effects=()).recover(gyroscope_output)
        start = (jnp.zeros_like(rate), rate)
        return turn(0, start) if not crossed else jax.lax.fori_loop(0, 8, turn, start)

    def transferable(self) -> Imu:
        """Return the unit without what does not belong to it: effects of a session and of the set-up."""
        return self.with_effects(*(effect for effect in self.all_effects().values() if effect.scope == "device"))


class Board(Imu):
    """A unit, and the others that are fixed to the same rigid body, each with its own axes, gains and biases.

    `setup.reference_rotation` in the set-up of each of the others says how it is turned against the first.
    """

    others: tuple[Imu, ...] = ()

    @classmethod
    def of(cls, units: Sequence[Imu]) -> Board:
        """Return units as a board; of the first the set-up is left out."""
        first, *others = units
        return cls(first.accelerometer, first.gyroscope, others=tuple(others))

    def units(self) -> tuple[Imu, ...]:
        """Return the units, the first one first."""
        return Imu(self.accelerometer, self.gyroscope), *self.others
