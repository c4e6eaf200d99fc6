"""Misalignment over temperature: the off-diagonal gain changes with temperature."""

import jax.numpy as jnp

from jaximu.effects.base import Effect

__all__ = ["EFFECTS", "AccelMisalignmentTemperature", "GyroMisalignmentTemperature"]


def _off_diagonal(coefficients, places, vector):
    """Add c · u_j into output i, for each coefficient at its place (i, j)."""
    rows = [jnp.zeros_like(vector[..., 0])] * 3
    for coefficient, (i, j) in zip(coefficients, places, strict=True):
        rows[i] = rows[i] + coefficient * vector[..., j]
    return jnp.stack(rows, axis=-1)


class AccelMisalignmentTemperature(Effect):
    """Off-diagonal gains that change in proportion to temperature.

    Coefficients: output y from f_x, z from f_x, z from f_y; the frame is the accelerometer's own at any temperature, so
    there are no others.
    """

    name = "accel.misalignment_temperature"
    common_name = "misalignment over temperature"
    formula = "Σ_j c_ij (T − T_ref) f_j, j < i"
    unit = "output/(m/s^2)/K"
    size = 3
    scope = "device"
    needs = ("temperature", "specific_force")
    excited_by = "poses off the axes at several temperatures"
    look_alikes = ()
    source = "IEEE Std 528-2019, misalignment temperature sensitivity"
    typical = 1e-4

    def term(self, stimulus):
        force = stimulus.warmth(self.name)[..., None] * stimulus.need("specific_force", self.name)
        return _off_diagonal(self.coefficients, ((1, 0), (2, 0), (2, 1)), force)


class GyroMisalignmentTemperature(Effect):
    """Off-diagonal gains that change in proportion to temperature.

    Coefficients by output axis: x from ω_y, ω_z; y from ω_x, ω_z; z from ω_x, ω_y.
    """

    name = "gyro.misalignment_temperature"
    common_name = "misalignment over temperature"
    formula = "Σ_j c_ij (T − T_ref) ω_j, j ≠ i"
    unit = "output/(rad/s)/K"
    size = 6
    scope = "device"
    needs = ("temperature", "angular_rate")
    excited_by = "turns about every axis at several temperatures"
    look_alikes = ()
    source = "IEEE Std 528-2019, misalignment temperature sensitivity"
    typical = 1e-4

    def term(self, stimulus):
        rate = stimulus.warmth(self.name)[..., None] * stimulus.need("angular_rate", self.name)
        return _off_diagonal(self.coefficients, ((0, 1), (0, 2), (1, 0), (1, 2), (2, 0), (2, 1)), rate)


EFFECTS = (AccelMisalignmentTemperature, GyroMisalignmentTemperature)
