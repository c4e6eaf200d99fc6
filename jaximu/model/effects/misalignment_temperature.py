"""Misalignment over temperature: the off-diagonal gain changes with temperature."""

from typing import ClassVar

import jax.numpy as jnp

from jaximu.model.effects.base import InputEffect, pair


class _MisalignmentTemperature(InputEffect):
    """Off-diagonal gains that change in proportion to temperature.

    Coefficients of an accelerometer: output y from x, z from x, z from y; the frame is its own at any temperature, so
    there are no others. Of a gyroscope by output axis: x from y, z; y from x, z; z from x, y.
    """

    common_name = "misalignment over temperature"
    unit = "output/({SI})/K"
    needs = ("temperature", "{input}")
    source = "IEEE Std 528-2019, misalignment temperature sensitivity"
    entries: ClassVar[tuple[tuple[int, int], ...]]  # of each coefficient in the gain

    def term(self, stimulus):
        vector = stimulus.warmth(self.name)[..., None] * self.input(stimulus)
        rows = [jnp.zeros_like(vector[..., 0])] * 3
        for coefficient, (i, j) in zip(self.coefficients, self.entries, strict=True):
            rows[i] = rows[i] + coefficient * vector[..., j]
        return jnp.stack(rows, axis=-1)


EFFECTS = AccelMisalignmentTemperature, GyroMisalignmentTemperature = pair(
    _MisalignmentTemperature, "misalignment_temperature", (1e-4, 1e-4), size=(3, 6),
    formula=("Σ_j c_ij (T − T_ref) f_j, j < i", "Σ_j c_ij (T − T_ref) ω_j, j ≠ i"),
    entries=(((1, 0), (2, 0), (2, 1)), ((0, 1), (0, 2), (1, 0), (1, 2), (2, 0), (2, 1))),
    excited_by=("poses off the axes at several temperatures", "turns about every axis at several temperatures"),
)  # fmt: skip
