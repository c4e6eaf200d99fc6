"""Kalibr's `imu.yaml`: one noise density and one bias random walk a triad, continuous.

Keys and units as Kalibr documents them (github.com/ethz-asl/kalibr, wiki pages "Yaml formats" and "IMU Noise Model"):
there white noise has E[n(t₁) n(t₂)] = σ² δ(t₁ − t₂), which is this library's two-sided N, and the bias is a random walk
of this library's K. A number that comes from anything else is to say so in its comment.
"""

from __future__ import annotations

import math
import os
import re
from collections.abc import Mapping, Sequence
from pathlib import Path

from jaximu.ground.errors import FilePath, InputError, readable

KALIBR_UNITS = {
    "accelerometer_noise_density": "m/s^2/sqrt(Hz)",
    "accelerometer_random_walk": "m/s^3/sqrt(Hz)",
    "gyroscope_noise_density": "rad/s/sqrt(Hz)",
    "gyroscope_random_walk": "rad/s^2/sqrt(Hz)",
}
"""The unit of each number that Kalibr needs."""


def kalibr_yaml(
    numbers: Mapping[str, tuple[float, str]], rate: float, topic: str = "/imu0", comments: Sequence[str] = ()
) -> str:
    """Return the text of an `imu.yaml`.

    **Arguments:**

    - `numbers`: value and a comment for each key of `KALIBR_UNITS`. One that is missing is left out and a comment
      says so: Kalibr does not start without it, and that is better than with a number made up here.
    - `rate`: of the messages, Hz. `topic`: the ROS topic that carries them. `comments`: lines at the top.

    Raises `InputError` for an unknown key, a number that is not positive and finite, or a topic that is not one.
    """
    unknown = set(numbers) - set(KALIBR_UNITS)
    if unknown:
        raise InputError(f"Kalibr's imu.yaml has no key {', '.join(sorted(unknown))}.")
    if not topic.isprintable() or not topic.replace("/", "").replace("_", "").replace("~", "").isalnum():
        raise InputError(f"a ROS topic is letters, digits, _ and /, found {topic!r}.")
    lines = [f"# {_line(comment)}" for comment in comments]
    for key, unit in KALIBR_UNITS.items():
        if key not in numbers:
            lines.append(f"# {key}: not known from the recording; Kalibr needs it [{unit}]")
            continue
        value, comment = numbers[key]
        lines += [f"# {_line(comment)}"] if comment else []
        lines.append(f"{key}: {_number(value, key)}  # {unit}")
    lines += [f"rostopic: {topic}", f"update_rate: {float(_number(rate, 'update_rate'))}  # Hz"]
    return "\n".join(lines) + "\n"


def _number(value: float, key: str) -> str:
    if not (math.isfinite(value) and value > 0):
        raise InputError(f"Kalibr needs a positive {key}, found {value}.")
    return f"{value:.5e}"  # YAML 1.1 takes 5e-05 for text: a number has a point before its power


def _line(text: str) -> str:
    """Return text as one line: names of files may hold line breaks, and a comment must not end early."""
    return "".join(letter if letter.isprintable() else "?" for letter in text)


def read_noise(path: FilePath) -> dict[str, float]:
    """The noise densities in an `imu.yaml` such as `jaximu allan -o DIR` writes. Raises `InputError` without any."""
    with readable(path):
        text = Path(path).read_text(encoding="utf-8", errors="replace")
    pattern = r"^\s*(\w+)\s*:\s*([0-9.]+(?:[eE][+-]?[0-9]+)?)\s*(?:#.*)?$"
    numbers = {key: float(value) for key, value in re.findall(pattern, text[: 1 << 20], re.MULTILINE)}
    noise = {key: value for key, value in numbers.items() if key in KALIBR_UNITS and 0.0 < value < 1e9}
    if not noise:
        raise InputError(
            f"{os.fspath(path)}: holds none of {', '.join(KALIBR_UNITS)}; give the imu.yaml that jaximu allan -o DIR "
            "writes."
        )
    return noise | ({"update_rate": numbers["update_rate"]} if numbers.get("update_rate", 0.0) > 0.0 else {})
