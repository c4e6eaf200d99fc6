"""Bias over temperature: the first three powers of T − T_ref."""

from jaximu.model.effects.base import BiasEffect, on_triad, pair


class _Temperature(BiasEffect):
    """A bias in proportion to temperature, counted from the reference temperature."""

    common_name = "bias over temperature"
    formula = "c_i (T − T_ref)"
    unit = "output/K"
    needs = ("temperature",)
    excited_by = "a change of temperature"
    source = "IEEE Std 528-2019, bias temperature sensitivity"

    def factor(self, stimulus):
        return stimulus.warmth(self.name)


class _TemperatureSquared(_Temperature):
    """A bias in proportion to the square of temperature, counted from the reference temperature."""

    common_name = "bias over temperature squared"
    formula = "c_i (T − T_ref)²"
    unit = "output/K^2"
    excited_by = "a wide range of temperature, on both sides of the reference"
    source = "IEEE Std 528-2019, bias temperature sensitivity, second order"

    def factor(self, stimulus):
        return super().factor(stimulus) ** 2


class _TemperatureCubed(_Temperature):
    """A bias in proportion to the cube of temperature, counted from the reference temperature."""

    common_name = "bias over temperature cubed"
    formula = "c_i (T − T_ref)³"
    unit = "output/K^3"
    excited_by = "a wide range of temperature, on both sides of the reference"
    source = "IEEE Std 528-2019, bias temperature sensitivity, third order"

    def factor(self, stimulus):
        return super().factor(stimulus) ** 3


AccelTemperature, GyroTemperature = pair(
    _Temperature, "temperature", (1e-3, 1e-4), "bias_ramp", "warm_up", "thermal_lag"
)
MagTemperature = on_triad(_Temperature, "mag.temperature", 0.05, ("hard_iron_step", "current"))
AccelTemperatureSquared, GyroTemperatureSquared = pair(
    _TemperatureSquared, "temperature_squared", (3e-5, 3e-6), "temperature"
)
AccelTemperatureCubed, GyroTemperatureCubed = pair(_TemperatureCubed, "temperature_cubed", (1e-6, 1e-7), "temperature")
EFFECTS = (
    AccelTemperature,
    GyroTemperature,
    MagTemperature,
    AccelTemperatureSquared,
    GyroTemperatureSquared,
    AccelTemperatureCubed,
    GyroTemperatureCubed,
)
