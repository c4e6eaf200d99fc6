"""Odd scale-factor nonlinearity: an output in proportion to the cube of each axis's input."""

from jaximu.model.effects.base import InputEffect, pair


class _Cubic(InputEffect):
    """c_i times the cube of each axis's input. With inputs of one size alone it cannot be told from scale."""

    common_name = "cubic nonlinearity"
    formula = "c_i {u}_i³"
    unit = "output/({SI})^3"

    def term(self, stimulus):
        return self.coefficients * self.input(stimulus) ** 3


EFFECTS = AccelCubic, GyroCubic = pair(
    _Cubic, "cubic", (1e-5, 1e-4), excited_by=("orientations at rest off the axes", "turns at several rates"),
    source=("IEEE Std 1293-2018, third-order coefficient K3", "IEEE Std 528-2019, scale factor nonlinearity"),
)  # fmt: skip
