"""The catalogue of effects: one line a file, each file listing its effects in `EFFECTS`."""

from importlib import import_module

from jaximu.effects.base import Effect

__all__ = ["CATALOGUE", "effect_title"]

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
    "reference_rotation",
    "clock_scale",
    "table_tilt",
    "table_axis",
    "table_rate_scale",
    "local_gravity",
    "current",
    "field_disturbance",
    "learned",
    "network",
)

CATALOGUE: dict[str, type[Effect]] = {
    effect.name: effect for file in _FILES for effect in import_module(f"jaximu.effects.{file}").EFFECTS
}
"""Every effect by name."""


_OTHERS = {
    "data.auto_zero": "automatic zero at rest", "data.bandwidth": "low-pass filter", "data.bumped_pose": "bumped pose",
    "data.bursts": "stamps in bursts", "data.clipping": "clipped output", "data.clocks": "clocks apart",
    "data.copied_axis": "copied axis", "data.dead_axis": "dead axis", "data.duplicate": "repeated rows",
    "data.gap": "gaps", "data.gravity_free": "gravity taken out", "data.jitter": "jittering stamps",
    "data.lost_samples": "lost samples", "data.mixed_devices": "sensors of different devices",
    "data.moving_pose": "moving pose", "data.normalised": "directions without size", "data.order": "rows out of order",
    "data.periodic": "periodic disturbance", "data.quantisation": "coarse steps", "data.range": "another range",
    "data.resampled": "resampled output", "data.sampling": "turns too quick for the rate",
    "data.saturation": "saturated turns", "data.spikes": "outliers", "data.stuck_axis": "stuck output",
    "data.swapped_axes": "swapped axes", "data.time_scale": "time scale", "data.units": "change of unit",
    "data.wrap": "integer overflow", "data.zeros": "rows of zeros", "setup.mounting": "rotated mounting",
    "noise.white": "white noise", "noise.correlated": "correlated noise",
    "noise.bias_instability": "bias instability", "noise.rate_random_walk": "rate random walk",
}  # fmt: skip
"""In English, what a diagnosis names that is no effect: mistakes in a recording, kinds of noise."""


def effect_title(name: str) -> str:
    """Return an effect, a mistake in the data or a kind of noise in English, with its name after it."""
    return CATALOGUE[name].title if name in CATALOGUE else f"{_OTHERS[name]} ({name})" if name in _OTHERS else name
