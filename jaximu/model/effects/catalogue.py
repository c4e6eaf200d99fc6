"""The catalogue of effects: one line a file, each file listing its effects in `EFFECTS`."""

from importlib import import_module

from jaximu.model.effects.base import Effect

__all__ = ["CATALOGUE"]

_FILES = (
    "quadratic",
    "cubic",
    "asymmetry",
    "cross_coupling",
    "size_effect",
    "lever_arm",
    "temperature",
    "temperature_rate",
    "thermal_lag",
    "thermal_hysteresis",
    "scale_temperature",
    "misalignment_temperature",
    "bias_ramp",
    "warm_up",
    "step",
    "scale_ramp",
    "scale_step",
    "vibration_rectification",
    "g_sensitivity",
    "lag",
    "dead_band",
    "earth_rotation",
    "time_offset",
    "reference_delay",
    "reference_filter",
    "reference_rotation",
    "clock_scale",
    "table_tilt",
    "table_axis",
    "table_rate_scale",
    "local_gravity",
    "current",
    "field_disturbance",
    "magnetic_field",
    "learned",
    "network",
)

CATALOGUE: dict[str, type[Effect]] = {
    effect.name: effect for file in _FILES for effect in import_module(f"jaximu.model.effects.{file}").EFFECTS
}
"""Every effect by name."""
