"""Bias ramp: a bias that drifts in proportion to time."""

from jaximu.model.effects.base import BiasEffect, pair


class _BiasRamp(BiasEffect):
    """A bias in proportion to time, counted from the reference time: the rate ramp R of an Allan deviation."""

    formula = "c_i t"
    unit = "output/s"
    scope = "session"
    carries_on = True
    needs = ("time",)
    excited_by = "time"
    source = "IEEE Std 952-2020, rate ramp"

    def factor(self, stimulus):
        return stimulus.elapsed(self.name)


EFFECTS = AccelBiasRamp, GyroBiasRamp = pair(_BiasRamp, "bias_ramp", (1e-4, 1e-5), "warm_up", "temperature", "step")
