"""jaximu: calibrates inertial measurement units by differentiable estimation on JAX.

Conventions, everywhere:

- Units are SI: m/s², rad/s, s; temperatures in °C. Raw outputs may be counts; a model's `output_unit` says which.
- The body frame is right-handed and fixed to the sensor. Turntable-free, it is the accelerometer's: x along its x axis,
  y in the plane of its x and y axes, so the accelerometer's gain is lower triangular; the gyroscope's gain is full.
- Specific force f = a − g: an accelerometer at rest reads +g on the axis that points up.
- The sensor model is forward, truth to output: y = K u + b + Σ effects. `respond` computes it, `recover` inverts it.
- Quaternions are scalar first, body to reference.

Float64 is required: `jax.config.update("jax_enable_x64", True)`. Importing jaximu changes no global state.
Names load their modules when they are first used: `import jaximu` takes no time.
"""

from typing import TYPE_CHECKING

from jaximu._version import __version__
from jaximu.ground.reexport import lazily

if TYPE_CHECKING:
    from jaximu.acceptance import accept
    from jaximu.acceptance.history import compare
    from jaximu.acceptance.verify import verify
    from jaximu.calibration import Calibration, calibrate, compensate, load_calibration
    from jaximu.calibration import calibrate_against_attitude as reference
    from jaximu.calibration import calibrate_array as array
    from jaximu.calibration import calibrate_by_filter as filter
    from jaximu.calibration import calibrate_magnetometer as magnetometer
    from jaximu.calibration import calibrate_thermal as thermal
    from jaximu.calibration import calibrate_turntable as turntable
    from jaximu.data.poses import observe, stack
    from jaximu.diagnosis import check, diagnose
    from jaximu.estimation.fitting import Fit, Prior, fit
    from jaximu.estimation.problem import Parameters, Problem
    from jaximu.estimation.solver import solve
    from jaximu.fleets import run_fleet as fleet
    from jaximu.ground.errors import InputError, JaximuError, NotPossibleError
    from jaximu.ground.gravity import LocalGravity, parse_gravity, wgs84_gravity
    from jaximu.ground.stored import cache
    from jaximu.model.effects import CATALOGUE, Effect, register
    from jaximu.model.sensor import Imu, Triad
    from jaximu.model.stimulus import Stimulus
    from jaximu.navigation.consequences import consequences
    from jaximu.noise.analysis import analyse_noise as allan
    from jaximu.planning import propose as plan
    from jaximu.planning.budget import budget
    from jaximu.recordings import write_recording
    from jaximu.recordings.readers import ReadOptions, read_recording
    from jaximu.recordings.recording import Recording, Signal
    from jaximu.recordings.segmentation import Segmentation, SegmentationOptions, segment
    from jaximu.report.export import export
    from jaximu.simulation import simulate

__all__ = [
    "CATALOGUE",
    "Calibration",
    "Effect",
    "Fit",
    "Imu",
    "InputError",
    "JaximuError",
    "LocalGravity",
    "NotPossibleError",
    "Parameters",
    "Prior",
    "Problem",
    "ReadOptions",
    "Recording",
    "Segmentation",
    "SegmentationOptions",
    "Signal",
    "Stimulus",
    "Triad",
    "__version__",
    "accept",
    "allan",
    "array",
    "budget",
    "cache",
    "calibrate",
    "check",
    "compare",
    "compensate",
    "consequences",
    "diagnose",
    "export",
    "filter",
    "fit",
    "fleet",
    "load_calibration",
    "magnetometer",
    "observe",
    "parse_gravity",
    "plan",
    "read_recording",
    "reference",
    "register",
    "segment",
    "simulate",
    "solve",
    "stack",
    "thermal",
    "turntable",
    "verify",
    "wgs84_gravity",
    "write_recording",
]

__getattr__ = lazily(
    __name__,
    {
        "jaximu.acceptance": "accept",
        "jaximu.acceptance.history": "compare",
        "jaximu.acceptance.verify": "verify",
        "jaximu.calibration": (
            "Calibration, calibrate, compensate, load_calibration, calibrate_against_attitude as reference, "
            "calibrate_array as array, calibrate_by_filter as filter, calibrate_magnetometer as magnetometer, "
            "calibrate_thermal as thermal, calibrate_turntable as turntable"
        ),
        "jaximu.data.poses": "observe, stack",
        "jaximu.diagnosis": "check, diagnose",
        "jaximu.estimation.fitting": "Fit, Prior, fit",
        "jaximu.estimation.problem": "Parameters, Problem",
        "jaximu.estimation.solver": "solve",
        "jaximu.fleets": "run_fleet as fleet",
        "jaximu.ground.errors": "InputError, JaximuError, NotPossibleError",
        "jaximu.ground.gravity": "LocalGravity, parse_gravity, wgs84_gravity",
        "jaximu.ground.stored": "cache",
        "jaximu.model.effects": "CATALOGUE, Effect, register",
        "jaximu.model.sensor": "Imu, Triad",
        "jaximu.model.stimulus": "Stimulus",
        "jaximu.navigation.consequences": "consequences",
        "jaximu.noise.analysis": "analyse_noise as allan",
        "jaximu.planning": "propose as plan",
        "jaximu.planning.budget": "budget",
        "jaximu.recordings": "write_recording",
        "jaximu.recordings.readers": "ReadOptions, read_recording",
        "jaximu.recordings.recording": "Recording, Signal",
        "jaximu.recordings.segmentation": "Segmentation, SegmentationOptions, segment",
        "jaximu.report.export": "export",
        "jaximu.simulation": "simulate",
    },
)


def __dir__() -> list[str]:
    return __all__
