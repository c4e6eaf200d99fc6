"""Odd scale-factor nonlinearity: an output in proportion to the cube of each axis's input."""

from jaximu.model.effects.base import Effect, pair

__all__ = ["EFFECTS", "AccelCubic", "GyroCubic"]


class _Cubic(Effect):
    """c_i times the cube of each axis's input. With inputs of one size alone it cannot be told from scale."""

    common_name = "cubic nonlinearity"
    formula = "c_i {u}_i³"
    unit = "output/({SI})^3"
    scope = "device"
    needs = ("{input}",)

    def term(self, stimulus):
        return self.coefficients * stimulus.need(self.needs[0], self.name) ** 3


EFFECTS = AccelCubic, GyroCubic = pair(
    _Cubic, "cubic", (1e-5, 1e-4), excited_by=("orientations at rest off the axes", "turns at several rates"),
    source=("IEEE Std 1293-2018, third-order coefficient K3", "IEEE Std 528-2019, scale factor nonlinearity"),
)  # fmt: skip
