"""Bias over temperature: the first three powers of T − T_ref."""

from typing import ClassVar

from jaximu.effects.base import Effect

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
    size = 3
    scope = "device"
    needs = ("temperature",)
    power: ClassVar[int]

    def term(self, stimulus):
        return self.coefficients * stimulus.warmth(self.name)[..., None] ** self.power


class _Linear(_Power):
    """A bias in proportion to temperature, counted from the reference temperature."""

    formula = "c_i (T − T_ref)"
    unit = "output/K"
    excited_by = "a change of temperature"
    source = "IEEE Std 528-2019, bias temperature sensitivity"
    power = 1


class _Squared(_Power):
    """A bias in proportion to the square of temperature, counted from the reference temperature."""

    formula = "c_i (T − T_ref)²"
    unit = "output/K^2"
    excited_by = "a wide range of temperature, on both sides of the reference"
    source = "IEEE Std 528-2019, bias temperature sensitivity, second order"
    power = 2


class _Cubed(_Power):
    """A bias in proportion to the cube of temperature, counted from the reference temperature."""

    formula = "c_i (T − T_ref)³"
    unit = "output/K^3"
    excited_by = "a wide range of temperature, on both sides of the reference"
    source = "IEEE Std 528-2019, bias temperature sensitivity, third order"
    power = 3


class AccelTemperature(_Linear):
    __doc__ = _Linear.__doc__
    name = "accel.temperature"
    look_alikes = ("accel.bias_ramp", "accel.warm_up", "accel.thermal_lag")
    typical = 1e-3


class GyroTemperature(_Linear):
    __doc__ = _Linear.__doc__
    name = "gyro.temperature"
    look_alikes = ("gyro.bias_ramp", "gyro.warm_up", "gyro.thermal_lag")
    typical = 1e-4


class MagTemperature(_Linear):
    __doc__ = _Linear.__doc__
    name = "mag.temperature"
    look_alikes = ("mag.hard_iron_step", "mag.current")
    typical = 0.05


class AccelTemperatureSquared(_Squared):
    __doc__ = _Squared.__doc__
    name = "accel.temperature_squared"
    look_alikes = ("accel.temperature",)
    typical = 3e-5


class GyroTemperatureSquared(_Squared):
    __doc__ = _Squared.__doc__
    name = "gyro.temperature_squared"
    look_alikes = ("gyro.temperature",)
    typical = 3e-6


class AccelTemperatureCubed(_Cubed):
    __doc__ = _Cubed.__doc__
    name = "accel.temperature_cubed"
    look_alikes = ("accel.temperature",)
    typical = 1e-6


class GyroTemperatureCubed(_Cubed):
    __doc__ = _Cubed.__doc__
    name = "gyro.temperature_cubed"
    look_alikes = ("gyro.temperature",)
    typical = 1e-7


EFFECTS = (
    AccelTemperature,
    GyroTemperature,
    AccelTemperatureSquared,
    GyroTemperatureSquared,
    AccelTemperatureCubed,
    GyroTemperatureCubed,
    MagTemperature,
)
