"""Misalignment over temperature: the off-diagonal gain changes with temperature."""

from typing import ClassVar

import jax.numpy as jnp

from jaximu.effects.base import Effect

__all__ = ["EFFECTS", "AccelMisalignmentTemperature", "GyroMisalignmentTemperature"]


class _MisalignmentTemperature(Effect):
    common_name = "misalignment over temperature"
    scope = "device"
    look_alikes = ()
    source = "IEEE Std 528-2019, misalignment temperature sensitivity"
    typical = 1e-4
    places: ClassVar[tuple[tuple[int, int], ...]]  # (i, j) of each coefficient: output i from input j

    def term(self, stimulus):
        into, of = jnp.array(self.places).T
        vector = stimulus.warmth(self.name)[..., None] * stimulus.need(self.needs[1], self.name)
        return jnp.zeros_like(vector).at[..., into].add(self.coefficients * vector[..., of])


class AccelMisalignmentTemperature(_MisalignmentTemperature):
    """Off-diagonal gains that change in proportion to temperature.

    Coefficients: output y from f_x, z from f_x, z from f_y; the frame is the accelerometer's own at any temperature, so
    there are no others.
    """

    name = "accel.misalignment_temperature"
    formula = "Σ_j c_ij (T − T_ref) f_j, j < i"
    unit = "output/(m/s^2)/K"
    size, places = 3, ((1, 0), (2, 0), (2, 1))
    needs = ("temperature", "specific_force")
    excited_by = "poses off the axes at several temperatures"


class GyroMisalignmentTemperature(_MisalignmentTemperature):
    """Off-diagonal gains that change in proportion to temperature.

    Coefficients by output axis: x from ω_y, ω_z; y from ω_x, ω_z; z from ω_x, ω_y.
    """

    name = "gyro.misalignment_temperature"
    formula = "Σ_j c_ij (T − T_ref) ω_j, j ≠ i"
    unit = "output/(rad/s)/K"
    size, places = 6, ((0, 1), (0, 2), (1, 0), (1, 2), (2, 0), (2, 1))
    needs = ("temperature", "angular_rate")
    excited_by = "turns about every axis at several temperatures"


EFFECTS = (AccelMisalignmentTemperature, GyroMisalignmentTemperature)
