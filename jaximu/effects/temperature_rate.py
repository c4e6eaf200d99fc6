"""Bias over the rate of temperature: the sensor's parts are not equally warm while it warms."""

from jaximu.effects.base import Effect

__all__ = [
    "EFFECTS",
    "AccelTemperatureRate",
    "AccelTemperatureRateSquared",
    "AccelTemperatureTimesRate",
    "GyroTemperatureRate",
    "GyroTemperatureRateSquared",
    "GyroTemperatureTimesRate",
]


class _Rate(Effect):
    """A bias in proportion to how quickly the temperature changes."""

    formula = "c_i Ṫ"
    unit = "output/(K/s)"
    size = 3
    scope = "device"
    needs = ("temperature_rate",)
    excited_by = "ramps of several rates, up and down"
    source = "IEEE Std 952-2020, bias temperature-ramp sensitivity"

    def term(self, stimulus):
        return self.coefficients * stimulus.need("temperature_rate", self.name)[..., None]


class _RateSquared(Effect):
    """A bias in proportion to the square of how quickly the temperature changes."""

    formula = "c_i Ṫ²"
    unit = "output/(K/s)^2"
    size = 3
    scope = "device"
    needs = ("temperature_rate",)
    excited_by = "ramps of several rates, up and down"
    source = "IEEE Std 952-2020, bias temperature-ramp sensitivity, second order"

    def term(self, stimulus):
        return self.coefficients * stimulus.need("temperature_rate", self.name)[..., None] ** 2


class _TimesRate(Effect):
    """A temperature-rate sensitivity that itself changes with temperature."""

    formula = "c_i (T − T_ref) Ṫ"
    unit = "output/(K^2/s)"
    size = 3
    scope = "device"
    needs = ("temperature", "temperature_rate")
    excited_by = "ramps of several rates over a wide range, up and down"
    source = "IEEE Std 952-2020, bias temperature-ramp sensitivity, its change over temperature"

    def term(self, stimulus):
        rate = stimulus.need("temperature_rate", self.name)
        return self.coefficients * (stimulus.warmth(self.name) * rate)[..., None]


class AccelTemperatureRate(_Rate):
    __doc__ = _Rate.__doc__
    name = "accel.temperature_rate"
    common_name = "bias over the rate of temperature"
    look_alikes = ("accel.thermal_lag", "accel.temperature")
    typical = 0.3


class GyroTemperatureRate(_Rate):
    __doc__ = _Rate.__doc__
    name = "gyro.temperature_rate"
    common_name = "bias over the rate of temperature"
    look_alikes = ("gyro.thermal_lag", "gyro.temperature")
    typical = 0.03


class AccelTemperatureRateSquared(_RateSquared):
    __doc__ = _RateSquared.__doc__
    name = "accel.temperature_rate_squared"
    common_name = "bias over the squared rate of temperature"
    look_alikes = ("accel.temperature_rate", "accel.thermal_lag")
    typical = 10.0


class GyroTemperatureRateSquared(_RateSquared):
    __doc__ = _RateSquared.__doc__
    name = "gyro.temperature_rate_squared"
    common_name = "bias over the squared rate of temperature"
    look_alikes = ("gyro.temperature_rate", "gyro.thermal_lag")
    typical = 1.0


class AccelTemperatureTimesRate(_TimesRate):
    __doc__ = _TimesRate.__doc__
    name = "accel.temperature_times_rate"
    common_name = "bias over temperature times its rate"
    look_alikes = ("accel.temperature_rate", "accel.thermal_hysteresis")
    typical = 0.01


class GyroTemperatureTimesRate(_TimesRate):
    __doc__ = _TimesRate.__doc__
    name = "gyro.temperature_times_rate"
    common_name = "bias over temperature times its rate"
    look_alikes = ("gyro.temperature_rate", "gyro.thermal_hysteresis")
    typical = 0.001


EFFECTS = (
    AccelTemperatureRate,
    GyroTemperatureRate,
    AccelTemperatureRateSquared,
    GyroTemperatureRateSquared,
    AccelTemperatureTimesRate,
    GyroTemperatureTimesRate,
)
