"""The effects that the catalogue must hold; what stands beside them is tried by the laws for all effects."""

BOTH = (
    "temperature temperature_squared temperature_cubed temperature_rate temperature_rate_squared "
    "temperature_times_rate thermal_lag thermal_hysteresis scale_temperature misalignment_temperature bias_ramp "
    "scale_ramp warm_up step scale_step vibration_rectification quadratic cubic asymmetry cross_coupling"
)
OWN = {
    "accel": "size_effect lever_arm",
    "gyro": "g_sensitivity g_squared_sensitivity lag dead_band earth_rotation",
    "mag": "temperature hard_iron_step current lag",
    "setup": "time_offset reference_delay clock_scale table_tilt table_axis table_rate_scale gravity field_disturbance",
}
DEMANDED = {f"{prefix}.{name}" for prefix in ("accel", "gyro") for name in BOTH.split()} | {
    f"{prefix}.{name}" for prefix, names in OWN.items() for name in names.split()
}
LEARNED = {"temperature", "temperature_rate", "time", "force", "force_x", "force_y", "force_z"}
CURVES = {f"{prefix}.learned_{name}" for prefix in ("accel", "gyro") for name in LEARNED} | {"gyro.learned_rate"}
NETWORKS = ("accel.learned_network", "gyro.learned_network")
KNOWN = DEMANDED | CURVES | set(NETWORKS)
