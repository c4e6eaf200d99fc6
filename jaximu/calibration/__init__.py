"""Recipes from recordings to a `Calibration`."""

from typing import TYPE_CHECKING

from jaximu.ground.reexport import lazily

if TYPE_CHECKING:
    from jaximu.calibration.array import calibrate_array
    from jaximu.calibration.array_together import Together, fit_together
    from jaximu.calibration.array_units import Array, ArrayUnit
    from jaximu.calibration.attitude import calibrate_against_attitude
    from jaximu.calibration.calibration import Calibration, load_calibration
    from jaximu.calibration.closed_form import ferraris, linear_least_squares, six_position, turn_pairs
    from jaximu.calibration.compensation import compensate
    from jaximu.calibration.filter_history import History
    from jaximu.calibration.hand_held import Method, fit_hand_held
    from jaximu.calibration.identifiability import Identifiability
    from jaximu.calibration.in_use import FilterInUse, FilterState, followed_in_use
    from jaximu.calibration.magnetometer import FieldStrength, Heading, MagneticLog, calibrate_magnetometer
    from jaximu.calibration.means import calibrate_means
    from jaximu.calibration.nominal import nominal_imu
    from jaximu.calibration.recipe import calibrate
    from jaximu.calibration.refusals import require_carried, require_spanning
    from jaximu.calibration.scheme import Scheme, describe_scheme
    from jaximu.calibration.systematic import calibrate_by_filter
    from jaximu.calibration.thermal import ThermalCalibration, calibrate_thermal
    from jaximu.calibration.thermal_triad import TriadFit
    from jaximu.calibration.turntable import calibrate_turntable, fit_turntable

__all__ = [
    "Array",
    "ArrayUnit",
    "Calibration",
    "FieldStrength",
    "FilterInUse",
    "FilterState",
    "Heading",
    "History",
    "Identifiability",
    "MagneticLog",
    "Method",
    "Scheme",
    "ThermalCalibration",
    "Together",
    "TriadFit",
    "calibrate",
    "calibrate_against_attitude",
    "calibrate_array",
    "calibrate_by_filter",
    "calibrate_magnetometer",
    "calibrate_means",
    "calibrate_thermal",
    "calibrate_turntable",
    "compensate",
    "describe_scheme",
    "ferraris",
    "fit_hand_held",
    "fit_together",
    "fit_turntable",
    "followed_in_use",
    "linear_least_squares",
    "load_calibration",
    "nominal_imu",
    "require_carried",
    "require_spanning",
    "six_position",
    "turn_pairs",
]

__getattr__ = lazily(
    __name__,
    {
        "jaximu.calibration.array": "calibrate_array",
        "jaximu.calibration.array_together": "Together, fit_together",
        "jaximu.calibration.array_units": "Array, ArrayUnit",
        "jaximu.calibration.attitude": "calibrate_against_attitude",
        "jaximu.calibration.calibration": "Calibration, load_calibration",
        "jaximu.calibration.closed_form": "ferraris, linear_least_squares, six_position, turn_pairs",
        "jaximu.calibration.compensation": "compensate",
        "jaximu.calibration.hand_held": "Method, fit_hand_held",
        "jaximu.calibration.filter_history": "History",
        "jaximu.calibration.identifiability": "Identifiability",
        "jaximu.calibration.in_use": "FilterInUse, FilterState, followed_in_use",
        "jaximu.calibration.magnetometer": "FieldStrength, Heading, MagneticLog, calibrate_magnetometer",
        "jaximu.calibration.means": "calibrate_means",
        "jaximu.calibration.nominal": "nominal_imu",
        "jaximu.calibration.recipe": "calibrate",
        "jaximu.calibration.refusals": "require_carried, require_spanning",
        "jaximu.calibration.scheme": "Scheme, describe_scheme",
        "jaximu.calibration.systematic": "calibrate_by_filter",
        "jaximu.calibration.thermal": "ThermalCalibration, calibrate_thermal",
        "jaximu.calibration.thermal_triad": "TriadFit",
        "jaximu.calibration.turntable": "calibrate_turntable, fit_turntable",
    },
)
