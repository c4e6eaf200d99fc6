"""Scale factor over temperature."""

from jaximu.model.effects.base import ScaleEffect, pair


class _ScaleTemperature(ScaleEffect):
    """A scale factor that changes in proportion to temperature, counted from the reference temperature."""

    common_name = "scale over temperature"
    formula = "c_i (T − T_ref) {u}_i"
    unit = "output/({SI})/K"
    needs = ("temperature", "{input}")
    source = "IEEE Std 528-2019, scale factor temperature sensitivity"

    def factor(self, stimulus):
        return stimulus.warmth(self.name)


EFFECTS = AccelScaleTemperature, GyroScaleTemperature = pair(
    _ScaleTemperature, "scale_temperature", (1e-4, 1e-4), alike=(("temperature",), ()),
    excited_by=("poses at several temperatures", "turns at several temperatures"),
)  # fmt: skip
