"""Scale-factor asymmetry: another gain for positive than for negative input."""

import jax.numpy as jnp

from jaximu.model.effects.base import InputEffect, pair


class _Asymmetry(InputEffect):
    """c_i times the size of each axis's input: the gain is K + c for positive and K − c for negative input."""

    formula = "c_i |{u}_i|"
    unit = "output/({SI})"
    source = "IEEE Std 528-2019, scale factor asymmetry"

    def term(self, stimulus):
        return self.coefficients * jnp.abs(self.input(stimulus))


EFFECTS = AccelAsymmetry, GyroAsymmetry = pair(
    _Asymmetry, "asymmetry", (1e-3, 1e-3), "quadratic",
    excited_by=("many orientations at rest", "turns in both directions, also at one rate"),
)  # fmt: skip
