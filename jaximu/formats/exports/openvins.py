"""OpenVINS's `kalibr_imu_chain.yaml`: noise densities and the intrinsics Tw, Ta, R_IMUtoGYRO, R_IMUtoACC, Tg.

ω = R_IMUtoGYROᵀ Tw⁻¹ (y_g − b_g − Tg f), f = R_IMUtoACCᵀ Ta⁻¹ (y_a − b_a), with the keys as its loader reads them
(docs.openvins.com, "IMU Propagation", section on intrinsics; ov_msckf/src/core/VioManagerOptions.h inverts Tw and Ta).
Model "kalibr" keeps both triangles lower and R_IMUtoACC the identity. OpenVINS multiplies Tg with the specific force in
its IMU frame, where Kalibr multiplies A with the one that C_gyro_i has rotated: Tg = A C_gyro_i.
"""

from __future__ import annotations

import numpy as np

from jaximu.formats.exports.base import Correction, Parameters, Written, comments, matrix_text, vector_text, yaml_matrix
from jaximu.formats.exports.kalibr import noise_lines

SUFFIX = ".yaml"
NOISE = True
SUMMARY = "OpenVINS: kalibr_imu_chain.yaml with Tw, Ta, Tg and rotations"


def write(parameters: Parameters) -> Written:
    """Write the intrinsics in OpenVINS's "kalibr" model; its loader needs every key, so an identity stays written."""
    parameters.require_si("OpenVINS")
    view = parameters.kalibr()
    frame, gyroscope = view["body_rotation"], parameters.gyroscope
    sensitivity = view["g_sensitivity"] @ view["gyro_rotation"]
    blocks = {
        "Tw": view["gyro_matrix"],
        "R_IMUtoGYRO": view["gyro_rotation"],
        "Ta": view["accel_matrix"],
        "R_IMUtoACC": np.eye(3),
        "Tg": sensitivity,
    }
    lines = ["%YAML:1.0", "", comments(parameters), "imu0:", "  T_i_b:", yaml_matrix(np.eye(4), 4)]
    lines += [*noise_lines(parameters, "  "), "  rostopic: /imu0", "  time_offset: 0.0", '  model: "kalibr"']
    for key, matrix in blocks.items():
        lines += [f"  {key}:", yaml_matrix(matrix, 4)]
    # no key of the file holds a bias: the filter starts from these, if its launch file is told, or finds them itself
    lines += [
        f"  # accelerometer bias {vector_text(view['accel_bias'])} m/s^2: OpenVINS estimates it, see init_dyn_bias_a"
    ]
    if gyroscope is not None:
        lines += [
            f"  # gyroscope bias {vector_text(view['gyro_bias'])} rad/s: OpenVINS estimates it, see init_dyn_bias_g"
        ]
    equation = (
        "f = transpose(R_IMUtoACC) inverse(Ta) (y_a - b_a); w = transpose(R_IMUtoGYRO) inverse(Tw) (y_g - b_g - Tg f)\n"
        + "\n".join(f"{key} = {matrix_text(matrix)}" for key, matrix in blocks.items())
        + f"\nb_a = {vector_text(view['accel_bias'])}\nb_g = {vector_text(view['gyro_bias'])}"
    )
    zero = np.zeros(3)
    corrections = {
        "accelerometer": Correction(np.asarray(np.linalg.inv(view["accel_matrix"]), np.float64), zero, frame=frame)
    }
    if gyroscope is not None:
        inverse = view["gyro_rotation"].T @ np.linalg.inv(view["gyro_matrix"])
        corrections["gyroscope"] = Correction(inverse, zero, sensitivity, frame)
    convention = (
        "forward: y = T R u + b, T lower-triangular. The file has no place for biases, which the filter estimates; "
        "the loss below counts them. Set rostopic, and calib_imu_intrinsics: false to keep these values."
        + ("" if parameters.noise else " It needs noise densities: give --noise IMU.YAML from jaximu allan.")
    )
    return Written(
        {"": ("\n".join(lines) + "\n").encode()}, convention, equation, corrections, frozenset({"gyro.g_sensitivity"})
    )
