"""A C99 header with `static inline` functions that apply the calibration: double, float, and 32-bit fixed point.

Fixed point: the input is the raw count (or, where the outputs are in SI, the value times 2¹⁶), the answer the value
times 2¹⁶ (m/s², µT) or 2²⁰ (rad/s). Inside, offsets keep 2⁻⁵ of an input unit and the matrix 24 bits, so that no input
of 32 bits overflows the 64 bits of the sum.
"""

from __future__ import annotations

import math

import numpy as np

from jaximu.ground.units import SENSOR_UNITS
from jaximu.report.export.base import ExportedUnit, LinearTriad, Written, comments

SUFFIX = ".h"
SUMMARY = "C header: apply in double, float and fixed point"
INPUT_BITS = 16  # fixed-point inputs in SI; counts have none
MAGNETIC = True
OUTPUT_BITS = {"accelerometer": 16, "gyroscope": 20, "magnetometer": 16}
_OFFSET_BITS = 5
_MATRIX_BITS = 24


def write(parameters: ExportedUnit) -> Written:
    """Write three functions a triad: `jaximu_<triad>`, `…_float`, `…_fixed`, each (const y[3], u[3])."""
    body = []
    remarks = []
    gravity = parameters.calibration.gravity.value
    extents = {"accelerometer": gravity, "gyroscope": math.radians(250.0), "magnetometer": 100.0}
    for name, triad in parameters.triads.items():
        text, bound = _functions(name, triad, extents[name])
        body.append(text)
        remarks.append(f"{bound:.2g} {SENSOR_UNITS[name]}")
    text = "\n".join(
        [
            comments(parameters, "/*") + " */",
            "/* u = T (y - b): y the raw output in the unit named below, u in m/s^2, rad/s or uT. Safe for u == y. */",
            "#ifndef JAXIMU_CALIBRATION_H",
            "#define JAXIMU_CALIBRATION_H",
            "#include <stdint.h>",
            "",
            *body,
            "#endif",
            "",
        ]
    )
    return Written(
        {"": text.encode()},
        "inverse: u = T (y - b), the exact inverse of the gain, y in output units. The fixed-point functions are off "
        f"by at most {' and '.join(remarks)} at gravity, at 250 deg/s and at 100 uT, float by some 1e-6 of a value.",
        parameters.equation(),
        parameters.corrections(),
    )


def _functions(name: str, triad: LinearTriad, extent: float) -> tuple[str, float]:
    """The three functions of a triad, and the bound of the fixed-point error for inputs up to `extent`, SI."""
    matrix = triad.inverse
    offset = triad.bias
    input_bits = 0 if triad.unit == "count" else INPUT_BITS
    out = OUTPUT_BITS[name]
    # matrix entries are kept as integers of 24 bits: M 2^(out - given + more)
    more = _MATRIX_BITS - (out - input_bits) - math.ceil(math.log2(np.abs(matrix).max()))
    whole = np.rint(np.ldexp(matrix, out - input_bits + more)).astype(np.int64)
    shifted = np.rint(np.ldexp(offset, input_bits + _OFFSET_BITS)).astype(np.int64)
    shift = more + _OFFSET_BITS
    largest = np.abs(triad.gain) @ np.full(3, extent)
    bound = (
        np.abs(matrix).sum(1).max() * 0.5 ** (1 + input_bits + _OFFSET_BITS)
        + largest.sum() * 0.5 ** (1 + out - input_bits + more)
        + 0.5 ** (1 + out)
    )
    scale = "the count" if input_bits == 0 else f"2^{input_bits} times the value"

    def floating(kind: str, ending: str, literal: str) -> list[str]:
        rows = [" + ".join(f"{_number(cell, literal)} * d{at}" for at, cell in enumerate(row)) for row in matrix]
        return [
            f"static inline void jaximu_{name}{ending}(const {kind} y[3], {kind} u[3])",
            "{",
            *(f"    const {kind} d{at} = y[{at}] - {_number(value, literal)};" for at, value in enumerate(offset)),
            *(f"    u[{at}] = {row};" for at, row in enumerate(rows)),
            "}",
            "",
        ]

    lines = [f"/* {name}: y in {triad.unit}, u in {SENSOR_UNITS[name]} */", *floating("double", "", "")]
    lines += floating("float", "_float", "f")
    half = 1 << (shift - 1)
    lines += [
        f"/* fixed point: y is {scale}, u is 2^{out} times the value in {SENSOR_UNITS[name]} */",
        f"static inline void jaximu_{name}_fixed(const int32_t y[3], int32_t u[3])",
        "{",
        *(
            f"    const int64_t d{at} = (int64_t)y[{at}] * {1 << _OFFSET_BITS} - INT64_C({value});"
            for at, value in enumerate(shifted)
        ),
    ]
    for at, row in enumerate(whole):
        total = " + ".join(f"INT64_C({cell}) * d{column}" for column, cell in enumerate(row))
        lines += [f"    const int64_t s{at} = {total};"]
    lines += [
        f"    u[{at}] = (int32_t)((s{at} + (s{at} < 0 ? -INT64_C({half}) : INT64_C({half}))) / INT64_C({1 << shift}));"
        for at in range(3)
    ]
    return "\n".join([*lines, "}", ""]), float(bound)


def _number(value: float, literal: str) -> str:
    return f"({float(value)!r}{literal})"
