"""Table rate scale: the table turns quicker or slower than it says."""

from jaximu.model.effects.base import SetupEffect


class SetupTableRateScale(SetupEffect):
    """True rates are (1 + c) times what the table says.

    Structurally blind: it is the gyroscope's scale. It adds to that scale's uncertainty and cannot be fitted beside it.
    """

    name = "setup.table_rate_scale"
    formula = "ω = (1 + c) ω_said"
    unit = "1"
    size = 1
    needs = ("angular_rate",)
    excited_by = "nothing: blind inside the gyroscope's scale"
    look_alikes = ("setup.clock_scale",)
    source = "definition; IEEE Std 1431-2004, rate accuracy of the table"
    typical = 1e-4

    def act(self, stimulus, quantity):
        stimulus.need("angular_rate", self.name)
        scale = 1 + self.coefficients[0]
        return stimulus.changed(lambda vectors: scale * vectors, "angular_rate", "angular_acceleration")


EFFECTS = (SetupTableRateScale,)
