"""OpenVINS's `kalibr_imu_chain.yaml`: noise densities and the intrinsics Tw, Ta, R_IMUtoGYRO, R_IMUtoACC, Tg.

ω = R_IMUtoGYROᵀ Tw⁻¹ (y_g − b_g − Tg f), f = R_IMUtoACCᵀ Ta⁻¹ (y_a − b_a), with the keys as its loader reads them
(docs.openvins.com, "IMU Propagation", section on intrinsics; ov_msckf/src/core/VioManagerOptions.h inverts Tw and Ta).
Model "kalibr" keeps both triangles lower and R_IMUtoACC the identity. OpenVINS multiplies Tg with the specific force in
its IMU frame, where Kalibr multiplies A with the one that C_gyro_i has rotated: Tg = A C_gyro_i.
"""

from __future__ import annotations

import numpy as np

from jaximu.report.export.base import (
    Correction,
    ExportedUnit,
    Written,
    comments,
    exact_text,
    text_file,
    yaml_matrices,
)
from jaximu.report.export.kalibr import noise_lines

SUFFIX = ".yaml"
NOISE = True
SUMMARY = "OpenVINS: kalibr_imu_chain.yaml with Tw, Ta, Tg and rotations"


def write(parameters: ExportedUnit) -> Written:
    """Write the intrinsics in OpenVINS's "kalibr" model; its loader needs every key, so an identity stays written."""
    parameters.require_si("OpenVINS")
    view = parameters.kalibr()
    frame = view["body_rotation"]
    rotation = view["gyro_rotation"]
    sensitivity = view["g_sensitivity"] @ rotation
    zero = np.zeros(3)
    blocks = {
        "Tw": view["gyro_matrix"],
        "R_IMUtoGYRO": rotation,
        "Ta": view["accel_matrix"],
        "R_IMUtoACC": np.eye(3),
        "Tg": sensitivity,
    }
    # no key of the file holds a bias: the filter starts from these, if its launch file is told, or finds them itself
    accel_bias = exact_text(view["accel_bias"])
    gyro_bias = exact_text(view["gyro_bias"])
    biases = [f"  # accelerometer bias {accel_bias} m/s^2: OpenVINS estimates it, see init_dyn_bias_a"]
    corrections = {"accelerometer": Correction(np.linalg.inv(blocks["Ta"]), zero, frame=frame)}
    if "gyroscope" in parameters.triads:
        biases.append(f"  # gyroscope bias {gyro_bias} rad/s: OpenVINS estimates it, see init_dyn_bias_g")
        corrections["gyroscope"] = Correction(rotation.T @ np.linalg.inv(blocks["Tw"]), zero, sensitivity, frame)
    lines = ["%YAML:1.0", "", comments(parameters), "imu0:", *yaml_matrices({"T_i_b": np.eye(4)}, 2, 4)]
    lines += [*noise_lines(parameters), "  rostopic: /imu0", "  time_offset: 0.0", '  model: "kalibr"']
    lines += [*yaml_matrices(blocks, 2, 4), *biases]
    equation = (
        "f = transpose(R_IMUtoACC) inverse(Ta) (y_a - b_a); w = transpose(R_IMUtoGYRO) inverse(Tw) (y_g - b_g - Tg f)\n"
        + "\n".join(f"{key} = {exact_text(matrix)}" for key, matrix in blocks.items())
        + f"\nb_a = {accel_bias}\nb_g = {gyro_bias}"
    )
    convention = (
        "forward: y = T R u + b, T lower-triangular. The file has no place for biases, which the filter estimates; "
        "the loss below counts them. Set rostopic, and calib_imu_intrinsics: false to keep these values."
        + ("" if parameters.noise else " It needs noise densities: give --noise IMU.YAML from jaximu allan.")
    )
    return Written(text_file(lines), convention, equation, corrections, frozenset({"gyro.g_sensitivity"}))
