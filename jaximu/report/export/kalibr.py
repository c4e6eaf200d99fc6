"""Kalibr's `imu.yaml` with the scale-misalignment intrinsics of its results.

Keys `accelerometers: M` and `gyroscopes: M, A, C_gyro_i`, and y_a = M_a f + b_a, y_g = M_g C ω + A C f + b_g, as
kalibr_calibrate_imu_camera writes and uses them with `--imu-models scale-misalignment` (github.com/ethz-asl/kalibr,
wiki pages "Yaml formats" and "Multi IMU and IMU intrinsic calibration"; Rehder et al., ICRA 2016).
"""

from __future__ import annotations

import numpy as np

from jaximu.recordings.readers.kalibr import KALIBR_UNITS
from jaximu.report.export.base import (
    Correction,
    ExportedUnit,
    Written,
    comments,
    exact_text,
    text_file,
    yaml_matrices,
)

SUFFIX = ".yaml"
NOISE = True
SUMMARY = "Kalibr: imu.yaml with M, C_gyro_i, A"


def write(parameters: ExportedUnit) -> Written:
    """Write both triads in kalibr's frame, noise densities as far as they are known."""
    view = parameters.kalibr()
    frame, accel, accel_bias = view["body_rotation"], view["accel_matrix"], exact_text(view["accel_bias"])
    lines = [
        comments(parameters),
        "# y = M f + bias (accelerometer), y = M C_gyro_i w + A C_gyro_i f + bias (gyroscope).",
        "# The keys named bias are not Kalibr's: it estimates biases itself and passes over them.",
        "imu0:",
        *yaml_matrices({"T_i_b": np.eye(4)}, 2, 2),
        "  accelerometers:",
        *yaml_matrices({"M": accel}, 4, 4),
        f"    bias: {accel_bias}",
    ]
    corrections = {
        "accelerometer": Correction(np.asarray(np.linalg.inv(accel), float), view["accel_bias"], frame=frame)
    }
    equation = f"f = inverse(M) (y - b)\nM = {exact_text(accel)}\nb = {accel_bias}"
    if "gyroscope" in parameters.triads:
        gyro, rotation, sensitivity = view["gyro_matrix"], view["gyro_rotation"], view["g_sensitivity"]
        blocks = {"M": gyro, "A": sensitivity, "C_gyro_i": rotation}
        bias = exact_text(view["gyro_bias"])
        lines += ["  gyroscopes:", *yaml_matrices(blocks, 4, 4), f"    bias: {bias}"]
        corrections["gyroscope"] = Correction(
            rotation.T @ np.linalg.inv(gyro), view["gyro_bias"], sensitivity @ rotation, frame
        )
        equation += (
            f"\nw = transpose(C_gyro_i) inverse(M) (y - b - A C_gyro_i f)\nM = {exact_text(gyro)}"
            f"\nC_gyro_i = {exact_text(rotation)}\nA = {exact_text(sensitivity)}\nb = {bias}"
        )
    lines += noise_lines(parameters)
    lines += ["  model: scale-misalignment", "  rostopic: /imu0", "  time_offset: 0.0"]
    turned = not np.allclose(frame, np.eye(3), atol=1e-9)
    convention = (
        "forward: y = M u + b, M lower-triangular, in output units per SI unit; A is applied to the rotated specific "
        "force. rostopic is a placeholder: set yours."
        + (f" Kalibr's frame is not the calibration's: u_kalibr = Q u, Q = {exact_text(frame)}." if turned else "")
        + ("" if parameters.noise else " Kalibr needs noise densities: give --noise IMU.YAML from jaximu allan.")
    )
    return Written(text_file(lines), convention, equation, corrections, frozenset({"gyro.g_sensitivity"}))


def noise_lines(parameters: ExportedUnit) -> list[str]:
    """The four densities and the rate as YAML; a number that is not known is a comment, never made up."""
    rate, known = parameters.rate, parameters.noise
    lines = [
        f"  {key}: {known[key]:.9e}" if key in known else f"  # {key}: not known [{unit}]"
        for key, unit in KALIBR_UNITS.items()
    ]
    return lines if rate is None else [*lines, f"  update_rate: {float(rate)!r}"]
