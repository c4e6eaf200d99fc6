"""Scale ramp: a scale factor that drifts in proportion to time."""

from jaximu.model.effects.base import ScaleEffect, pair


class _ScaleRamp(ScaleEffect):
    """A scale factor that changes in proportion to time, counted from the reference time (warming up, ageing)."""

    formula = "c_i t {u}_i"
    unit = "output/({SI})/s"
    scope = "session"
    needs = ("time", "{input}")
    excited_by = "{motions}, early and late"
    source = "IEEE Std 528-2019, scale factor stability"

    def factor(self, stimulus):
        return stimulus.elapsed(self.name)


EFFECTS = AccelScaleRamp, GyroScaleRamp = pair(
    _ScaleRamp, "scale_ramp", (1e-5, 1e-5), "scale_temperature", "scale_step"
)
