"""Cross-coupling: an output in proportion to the product of the inputs along two axes."""

import jax.numpy as jnp

from jaximu.effects.base import Effect

__all__ = ["EFFECTS", "AccelCrossCoupling", "GyroCrossCoupling"]


def _products(coefficients, vector):
    """Row i of the coefficients (3, 3) weighs the products yz, zx, xy into output i."""
    products = vector[..., (1, 2, 0)] * vector[..., (2, 0, 1)]
    matrix = coefficients.reshape(3, 3)
    return jnp.stack([jnp.sum(matrix[i] * products, axis=-1) for i in range(3)], axis=-1)


class AccelCrossCoupling(Effect):
    """Products of two force components in every output (not the linear gain from one axis to another).

    Coefficients by output axis, each for the products f_y f_z, f_z f_x, f_x f_y.
    """

    name = "accel.cross_coupling"
    formula = "Σ_jk c_ijk f_j f_k, j ≠ k"
    unit = "output/(m/s^2)^2"
    size = 9
    scope = "device"
    needs = ("specific_force",)
    excited_by = "many orientations at rest, off the axes"
    look_alikes = ()
    source = "IEEE Std 1293-2018, cross-coupling coefficients Kip, Kio, Kpo"
    typical = 1e-4

    def term(self, stimulus):
        return _products(self.coefficients, stimulus.need("specific_force", self.name))


class GyroCrossCoupling(Effect):
    """Products of two rate components in every output.

    Coefficients by output axis, each for the products ω_y ω_z, ω_z ω_x, ω_x ω_y.
    """

    name = "gyro.cross_coupling"
    formula = "Σ_jk c_ijk ω_j ω_k, j ≠ k"
    unit = "output/(rad/s)^2"
    size = 9
    scope = "device"
    needs = ("angular_rate",)
    excited_by = "turns about axes between the sensor's"
    look_alikes = ("gyro.lag",)
    source = "IEEE Std 528-2019, cross-axis terms of the rate model; kept apart from misalignment by the product"
    typical = 1e-3

    def term(self, stimulus):
        return _products(self.coefficients, stimulus.need("angular_rate", self.name))


EFFECTS = (AccelCrossCoupling, GyroCrossCoupling)
