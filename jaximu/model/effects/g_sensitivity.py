"""g-sensitivity: a gyroscope that also feels specific force."""

from jaximu.ground.rotation import apply_matrix
from jaximu.model.effects.base import Effect


class GyroGSensitivity(Effect):
    """G f: a gyroscope bias in proportion to specific force. Coefficients: G (3, 3), row by row."""

    name = "gyro.g_sensitivity"
    common_name = "g-sensitivity"
    formula = "Σ_j G_ij f_j"
    unit = "output/(m/s^2)"
    size = 9
    scope = "device"
    needs = ("specific_force",)
    excited_by = "orientations at rest"
    look_alikes = ("gyro.earth_rotation",)
    source = "IEEE Std 1431-2004, acceleration-sensitive drift rate; kalibr's gyroscope model"
    typical = 2e-4

    def term(self, stimulus):
        return apply_matrix(self.coefficients.reshape(3, 3), stimulus.need("specific_force", self.name))


class GyroGSquaredSensitivity(Effect):
    """A gyroscope bias in proportion to the square of the specific force along each axis."""

    name = "gyro.g_squared_sensitivity"
    common_name = "g²-sensitivity"
    formula = "c_i f_i²"
    unit = "output/(m/s^2)^2"
    scope = "device"
    needs = ("specific_force",)
    excited_by = "orientations at rest"
    source = "IEEE Std 1431-2004, acceleration-squared-sensitive drift rate"
    typical = 1e-5

    def term(self, stimulus):
        return self.coefficients * stimulus.need("specific_force", self.name) ** 2


EFFECTS = (GyroGSensitivity, GyroGSquaredSensitivity)
