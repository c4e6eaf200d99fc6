"""Bias over the rate of temperature: the sensor's parts are not equally warm while it warms."""

from jaximu.model.effects.base import BiasEffect, pair


class _TemperatureRate(BiasEffect):
    """A bias in proportion to how quickly the temperature changes."""

    common_name = "bias over the rate of temperature"
    formula = "c_i Ṫ"
    unit = "output/(K/s)"
    needs = ("temperature_rate",)
    excited_by = "ramps of several rates, up and down"
    source = "IEEE Std 952-2020, bias temperature-ramp sensitivity"


class _TemperatureRateSquared(_TemperatureRate):
    """A bias in proportion to the square of how quickly the temperature changes."""

    common_name = "bias over the squared rate of temperature"
    formula = "c_i Ṫ²"
    unit = "output/(K/s)^2"
    source = "IEEE Std 952-2020, bias temperature-ramp sensitivity, second order"

    def factor(self, stimulus):
        return super().factor(stimulus) ** 2


class _TemperatureTimesRate(_TemperatureRate):
    """A temperature-rate sensitivity that itself changes with temperature."""

    common_name = "bias over temperature times its rate"
    formula = "c_i (T − T_ref) Ṫ"
    unit = "output/(K^2/s)"
    needs = ("temperature", "temperature_rate")
    excited_by = "ramps of several rates over a wide range, up and down"
    source = "IEEE Std 952-2020, bias temperature-ramp sensitivity, its change over temperature"

    def factor(self, stimulus):
        return stimulus.warmth(self.name) * stimulus.need("temperature_rate", self.name)


AccelTemperatureRate, GyroTemperatureRate = pair(
    _TemperatureRate, "temperature_rate", (0.3, 0.03), "thermal_lag", "temperature"
)
AccelTemperatureRateSquared, GyroTemperatureRateSquared = pair(
    _TemperatureRateSquared, "temperature_rate_squared", (10.0, 1.0), "temperature_rate", "thermal_lag"
)
AccelTemperatureTimesRate, GyroTemperatureTimesRate = pair(
    _TemperatureTimesRate, "temperature_times_rate", (0.01, 0.001), "temperature_rate", "thermal_hysteresis"
)
EFFECTS = (
    AccelTemperatureRate,
    GyroTemperatureRate,
    AccelTemperatureRateSquared,
    GyroTemperatureRateSquared,
    AccelTemperatureTimesRate,
    GyroTemperatureTimesRate,
)
