"""Bias over temperature: the first three powers of T − T_ref."""

from typing import ClassVar

from jaximu.model.effects.base import Effect, on_triad, pair

__all__ = [
    "EFFECTS",
    "AccelTemperature",
    "AccelTemperatureCubed",
    "AccelTemperatureSquared",
    "GyroTemperature",
    "GyroTemperatureCubed",
    "GyroTemperatureSquared",
    "MagTemperature",
]


class _Power(Effect):
    scope = "device"
    needs = ("temperature",)
    power: ClassVar[int]

    def term(self, stimulus):
        return self.coefficients * stimulus.warmth(self.name)[..., None] ** self.power


class _Temperature(_Power):
    """A bias in proportion to temperature, counted from the reference temperature."""

    common_name = "bias over temperature"
    formula = "c_i (T − T_ref)"
    unit = "output/K"
    excited_by = "a change of temperature"
    source = "IEEE Std 528-2019, bias temperature sensitivity"
    power = 1


class _TemperatureSquared(_Power):
    """A bias in proportion to the square of temperature, counted from the reference temperature."""

    common_name = "bias over temperature squared"
    formula = "c_i (T − T_ref)²"
    unit = "output/K^2"
    excited_by = "a wide range of temperature, on both sides of the reference"
    source = "IEEE Std 528-2019, bias temperature sensitivity, second order"
    power = 2


class _TemperatureCubed(_Power):
    """A bias in proportion to the cube of temperature, counted from the reference temperature."""

    common_name = "bias over temperature cubed"
    formula = "c_i (T − T_ref)³"
    unit = "output/K^3"
    excited_by = "a wide range of temperature, on both sides of the reference"
    source = "IEEE Std 528-2019, bias temperature sensitivity, third order"
    power = 3


EFFECTS = (
    AccelTemperature, GyroTemperature, MagTemperature, AccelTemperatureSquared, GyroTemperatureSquared,
    AccelTemperatureCubed, GyroTemperatureCubed,
) = (
    *pair(_Temperature, "temperature", (1e-3, 1e-4), "bias_ramp", "warm_up", "thermal_lag"),
    on_triad(_Temperature, "mag.temperature", 0.05, ("hard_iron_step", "current")),
    *pair(_TemperatureSquared, "temperature_squared", (3e-5, 3e-6), "temperature"),
    *pair(_TemperatureCubed, "temperature_cubed", (1e-6, 1e-7), "temperature"),
)  # fmt: skip
