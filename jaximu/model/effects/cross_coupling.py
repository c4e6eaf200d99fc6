"""Cross-coupling: an output in proportion to the product of the inputs along two axes."""

import jax.numpy as jnp

from jaximu.model.effects.base import Effect, pair

__all__ = ["EFFECTS", "AccelCrossCoupling", "GyroCrossCoupling"]


class _CrossCoupling(Effect):
    """Products of two components of the input in every output (not the linear gain from one axis to another).

    Coefficients by output axis, each for the products yz, zx, xy.
    """

    formula = "Σ_jk c_ijk {u}_j {u}_k, j ≠ k"
    unit = "output/({SI})^2"
    size = 9
    scope = "device"
    needs = ("{input}",)

    def term(self, stimulus):
        vector, matrix = stimulus.need(self.needs[0], self.name), self.coefficients.reshape(3, 3)
        products = vector[..., (1, 2, 0)] * vector[..., (2, 0, 1)]
        return jnp.stack([jnp.sum(matrix[i] * products, axis=-1) for i in range(3)], axis=-1)


EFFECTS = AccelCrossCoupling, GyroCrossCoupling = pair(
    _CrossCoupling, "cross_coupling", (1e-4, 1e-3), alike=((), ("lag",)),
    excited_by=("many orientations at rest, off the axes", "turns about axes between the sensor's"),
    source=("IEEE Std 1293-2018, cross-coupling coefficients Kip, Kio, Kpo",
            "IEEE Std 528-2019, cross-axis terms of the rate model; kept apart from misalignment by the product"),
)  # fmt: skip
