"""Cross-coupling: an output in proportion to the product of the inputs along two axes."""

import jax.numpy as jnp

from jaximu.ground.rotation import apply_matrix
from jaximu.model.effects.base import InputEffect, pair


class _CrossCoupling(InputEffect):
    """Products of two components of the input in every output (not the linear gain from one axis to another).

    Coefficients by output axis, each for the products yz, zx, xy.
    """

    formula = "Σ_jk c_ijk {u}_j {u}_k, j ≠ k"
    unit = "output/({SI})^2"
    size = 9

    def term(self, stimulus):
        vector = self.input(stimulus)
        return apply_matrix(self.coefficients.reshape(3, 3), jnp.roll(vector, -1, -1) * jnp.roll(vector, 1, -1))


EFFECTS = AccelCrossCoupling, GyroCrossCoupling = pair(
    _CrossCoupling, "cross_coupling", (1e-4, 1e-3), alike=((), ("lag",)),
    excited_by=("many orientations at rest, off the axes", "turns about axes between the sensor's"),
    source=("IEEE Std 1293-2018, cross-coupling coefficients Kip, Kio, Kpo",
            "IEEE Std 528-2019, cross-axis terms of the rate model; kept apart from misalignment by the product"),
)  # fmt: skip
