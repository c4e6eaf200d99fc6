"""Scale factor over temperature."""

from jaximu.model.effects.base import Effect, pair

__all__ = ["EFFECTS", "AccelScaleTemperature", "GyroScaleTemperature"]


class _ScaleTemperature(Effect):
    """A scale factor that changes in proportion to temperature, counted from the reference temperature."""

    common_name = "scale over temperature"
    formula = "c_i (T − T_ref) {u}_i"
    unit = "output/({SI})/K"
    scope = "device"
    needs = ("temperature", "{input}")
    source = "IEEE Std 528-2019, scale factor temperature sensitivity"

    def term(self, stimulus):
        return self.coefficients * stimulus.warmth(self.name)[..., None] * stimulus.need(self.needs[1], self.name)


EFFECTS = AccelScaleTemperature, GyroScaleTemperature = pair(
    _ScaleTemperature, "scale_temperature", (1e-4, 1e-4), alike=(("temperature",), ()),
    excited_by=("poses at several temperatures", "turns at several temperatures"),
)  # fmt: skip
