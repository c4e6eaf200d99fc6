"""Even scale-factor nonlinearity: an output in proportion to the square of each axis's input."""

from jaximu.model.effects.base import InputEffect, pair


class _Quadratic(InputEffect):
    """c_i times the square of each axis's input: the gain grows with the input on one side, shrinks on the other."""

    common_name = "quadratic nonlinearity"
    formula = "c_i {u}_i²"
    unit = "output/({SI})^2"

    def term(self, stimulus):
        return self.coefficients * self.input(stimulus) ** 2


EFFECTS = AccelQuadratic, GyroQuadratic = pair(
    _Quadratic, "quadratic", (1e-3, 1e-3), "asymmetry",
    excited_by=("many orientations at rest", "turns at several rates, in both directions"),
    source=("IEEE Std 1293-2018, second-order coefficient K2", "IEEE Std 528-2019, scale factor nonlinearity"),
)  # fmt: skip
