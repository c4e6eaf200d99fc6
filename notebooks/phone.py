"""Write the phone recording that comes with the package: `python notebooks/phone.py`; see `jaximu demo --data`.

A simulated phone is held in 24 orientations and turned in between. As phyphox exports them, accelerometer and
gyroscope are two files, each with stamps and a rate of its own. The same script gives the same file.
"""

import io
import zipfile
from pathlib import Path

import jax

from jaximu.ground.units import STANDARD_GRAVITY
from jaximu.model.effects import CATALOGUE
from jaximu.simulation import consumer_noise, draw_imu, simulate
from jaximu.simulation.artefacts import Jitter, QuantisedOutput
from jaximu.simulation.protocols import HandHeld

PATH = Path(__file__).parents[1] / "jaximu" / "simulation" / "phone.zip"
RATES = {"Accelerometer": 99.6, "Gyroscope": 100.3}  # Hz
UNITS = {"Accelerometer": "m/s^2", "Gyroscope": "rad/s"}
STEPS = QuantisedOutput(STANDARD_GRAVITY / 8192, 1000 / 32768 * 3.14159 / 180)
HIDDEN = "accel.asymmetry"


def files() -> dict[str, str]:
    """Return the text of each file by its name."""
    phone = draw_imu(21).with_effects(CATALOGUE[HIDDEN].make([2e-3, -1e-3, 1.5e-3]))
    protocol = HandHeld(24, 3.0, 1.5, initial_rest=4.0, displacement=0.1, bend=20.0)
    written = {}
    for sensor, rate in RATES.items():
        recording, _ = simulate(
            phone, protocol, consumer_noise(), rate=rate, seed=21, artefacts=(STEPS, Jitter(0.0003))
        )  # fmt: skip
        signal = recording.signals[sensor.lower()]
        lines = [",".join(["Time (s)", *(f"{axis} ({UNITS[sensor]})" for axis in "XYZ")])]
        lines += [",".join(f"{value:.6E}" for value in (time, *row))
                  for time, row in zip(signal.time, signal.values, strict=True)]  # fmt: skip
        written[f"{sensor}.csv"] = "\n".join(lines) + "\n"
    return written


if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED, compresslevel=9) as archive:
        for name, text in files().items():
            archive.writestr(zipfile.ZipInfo(name), text, zipfile.ZIP_DEFLATED)
    PATH.write_bytes(buffer.getvalue())
    print(f"{PATH.name}: {len(buffer.getvalue()) / 1e3:.0f} kB")
