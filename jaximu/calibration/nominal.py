"""Where a fit starts: the data sheet's unit, its gyroscope scale checked against gravity."""

from jaximu.recording import Recording
from jaximu.sensor import Imu

__all__ = ["nominal_imu"]


def nominal_imu(recording: Recording) -> tuple[Imu, tuple[str, ...]]:
    """Return the unit as the recording's nominal scales and offsets describe it, and notes for the user.

    A stated gyroscope scale that is off by tens of percent (another range was set, or the factory corrected it) leads a
    fit over turns of 180° into a wrong minimum. Gravity turning in the accelerometer tells the true one to some
    percent, so the start is taken from there where the two differ by 15 % or more.
    """
    accelerometer, gyroscope = recording.accelerometer, recording.gyroscope
    if gyroscope is None:
        return Imu.nominal(accelerometer.nominal_scale, accelerometer.nominal_offset, accelerometer.unit), ()
    scale, notes = gyroscope.nominal_scale, ()
    slope, correlation = recording.turning
    if correlation > 0.6 and abs(slope - 1) > 0.15:
        scale = scale / slope
        notes = (
            f"the gyroscope reads {100 / slope:.0f} % of the rate at which gravity turns in the accelerometer: "
            "the fit starts from the latter.",
        )
    return Imu.nominal(
        accelerometer.nominal_scale, accelerometer.nominal_offset, accelerometer.unit,
        scale, gyroscope.nominal_offset, gyroscope.unit,
    ), notes  # fmt: skip
