"""The cases of `agreement.toml`, and the inputs that are made for them."""

from __future__ import annotations

import shlex
import struct
import tomllib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from string import Template

import numpy as np
from scipy.spatial.transform import Rotation

DOCUMENT = tomllib.loads(Path(__file__).with_name("agreement.toml").read_text(encoding="utf-8"))


@dataclass(frozen=True)
class Case:
    """A command line under a name; `group`: what runs in order in one process; `quick`: whether in both records."""

    name: str
    line: str
    group: str
    quick: bool

    @property
    def simulates(self) -> bool:
        """Whether it makes an input of other cases."""
        return self.line.startswith("simulate")

    @property
    def files(self) -> str:
        """How the line of another case that reads this one's files names them."""
        return f"MADE/{self.group}" if self.simulates else f"OUT/{self.name}/"

    def arguments(self, folders: dict[str, Path]) -> list[str]:
        """The line's words, with `DATA/`, `MADE/`, `OUT/` and `HERE/` as paths."""
        folders = folders | {"HERE": folders["OUT"] / self.name}
        words = []
        for word in shlex.split(self.line):
            start, _, rest = word.partition("/")
            words.append(str(folders[start] / rest) if start in folders else word)
        return words


def cases() -> Iterator[Case]:
    """All cases; those that simulate inputs come first."""
    for size in ("quick", "full"):
        for name in DOCUMENT["inputs"][size]:
            line = f'simulate "MADE/{name}.toml" -o "MADE/{name}.parquet"'
            yield Case(f"simulate {name}", line, name, size == "quick")
    for size in ("quick", "full"):
        for group, lines in DOCUMENT[size].items():
            for name, line in lines.items():
                yield Case(name, filled(line, DOCUMENT["texts"]), f"{size} {group}", size == "quick")


def with_needed(chosen: list[Case]) -> list[Case]:
    """The chosen cases and all whose files they read, in order."""
    listed = list(cases())
    names = {case.name for case in chosen}
    for case in reversed(listed):  # a case reads the files of earlier ones only
        if case.name in names:
            names |= {other.name for other in listed if other.files in case.line}
    return [case for case in listed if case.name in names]


def filled(text: str, texts: dict[str, str]) -> str:
    """A text with those that it names put in, and those that they name."""
    return Template(Template(text).substitute(texts)).substitute(texts)


def make_inputs(folder: Path) -> None:
    """Write the specifications, and inputs that share nothing with the library."""
    inputs = DOCUMENT["inputs"]
    texts = {f"{name}.toml": text for size in ("quick", "full") for name, text in inputs[size].items()}
    for name, text in (texts | DOCUMENT["files"]).items():
        (folder / name).write_text(filled(text, inputs["texts"]), encoding="utf-8")
    _write_means(folder / "means.csv")
    _write_tracked(folder)
    _write_ulog(folder / "held.ulg")


def _write_means(path: Path) -> None:
    """Mean outputs in twenty poses, as papers print them."""
    random = np.random.default_rng(26)
    force = 9.81 * Rotation.random(20, random_state=27).inv().apply([0.0, 0.0, 1.0])
    gain = np.tril(np.eye(3) + 0.02 * random.standard_normal((3, 3)))
    rows = force @ gain.T + 0.2 * random.standard_normal(3) + 2e-3 * random.standard_normal((20, 3))
    np.savetxt(path, rows / 9.80665, "%.6f", ",", header="accel_x [g],accel_y [g],accel_z [g]", comments="")


def _write_tracked(folder: Path) -> None:
    """A unit moved by a robot and its tracker's report; the unit's gyroscope is sensitive to specific force."""
    import attitude_motion  # of the tests; loading it takes a second

    moved = attitude_motion.move(28, duration=40.0, g_sensitivity=2e-4)
    axes = [f"{sensor}_{axis} [{unit}]" for sensor, unit in (("accel", "m/s^2"), ("gyro", "rad/s")) for axis in "xyz"]
    log = np.column_stack([moved.time, moved.force, moved.rate])
    np.savetxt(folder / "moved.csv", log, "%.9g", ",", header=",".join(["time [s]", *axes]), comments="")
    names = ["time [s]", "qw", "qx", "qy", "qz"]
    tracked = np.column_stack([moved.stamp, moved.quaternion])
    np.savetxt(folder / "tracked.csv", tracked, "%.9g", ",", header=",".join(names), comments="")
    names += [f"velocity_{axis} [m/s]" for axis in "xyz"]
    tracked = np.column_stack([tracked, moved.velocity])
    np.savetxt(folder / "tracked with velocity.csv", tracked, "%.9g", ",", header=",".join(names), comments="")


def _write_ulog(path: Path) -> None:
    """PX4's log of a unit that is held in sixteen poses by hand, by the published file format; its axes are FRD."""
    import array_motion

    (unit,) = array_motion.array(29, units=1)
    layout = np.dtype([("id", "<u2"), ("stamps", "<u8", 2), ("values", "<f4", 3), ("temperature", "<f4")])
    fields = "uint64_t timestamp;uint64_t timestamp_sample;float x;float y;float z;float temperature;"
    names = {"sensor_accel": unit.force, "sensor_gyro": unit.rate}
    messages = [(b"B", bytes(40)), *((b"F", f"{name}:{fields}".encode()) for name in names)]
    messages += [(b"A", struct.pack("<BH", 0, number) + name.encode()) for number, name in enumerate(names)]
    rows = np.zeros((len(unit.time), len(names)), layout)
    rows["id"] = np.arange(len(names))
    rows["stamps"] = np.round(1e6 * unit.time)[:, None, None]
    rows["values"] = np.stack(list(names.values()), axis=1) * [1.0, -1.0, -1.0]
    rows["temperature"] = 25.0
    messages += [(b"D", row.tobytes()) for row in rows.ravel()]
    head = b"ULog\x01\x12\x35\x01" + bytes(8)
    path.write_bytes(head + b"".join(struct.pack("<Hc", len(body), kind) + body for kind, body in messages))
