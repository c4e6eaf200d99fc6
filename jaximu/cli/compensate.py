"""`jaximu compensate`: apply a calibration to a recording."""

from pathlib import Path
from typing import Annotated

from tyro.conf import Positional

from jaximu.cli import options
from jaximu.cli.messages import progress, say
from jaximu.cli.options import option

__all__ = ["run"]


def run(
    calibration: options.CalibrationFile,
    recording: Annotated[Path, Positional, option("LOG", "The log to correct.")],
    /,
    *,
    output: Annotated[
        Path,
        option(
            "OUT",
            "File to write; the suffix sets the format. OUT.mcap, or OUT without a suffix for a ROS 2 bag, holds "
            "the log before and after, and how far its magnitude is from gravity.",
            name="output",
            aliases=["-o"],
        ),
    ],
    log: options.Reading = options.READING,
) -> None:
    """Apply a calibration to a log; the corrected log is in m/s² and rad/s.

    Examples:
      jaximu compensate results/calibration.json log.csv -o corrected.parquet
      jaximu compensate results/calibration.json log.csv -o corrected.mcap

    """
    options.require_files(calibration, recording)
    options.require_apart(output, calibration, recording, log.gyro_log)
    from jaximu.calibration import compensate, load_calibration
    from jaximu.recordings import write_recording
    from jaximu.report.export import is_messages, write_messages

    model = load_calibration(calibration)
    with progress("compensating"):
        raw = log.alike(model).read(recording, model.gravity, alone="accelerometer" not in model.triads())
        written = compensate(model, raw)
        if is_messages(output):
            write_messages(model, raw, written, output)
        else:
            write_recording(written, output)
    for note in written.notes:
        if note.startswith("extrapolated"):
            say(f"note: {note}.")
    say(f"Written: {output}")
