"""`jaximu compensate`: apply a calibration to a recording."""

from pathlib import Path
from typing import Annotated

import tyro

from jaximu.cli import options
from jaximu.cli.messages import progress, say

__all__ = ["run"]


def run(
    calibration: options.CalibrationFile,
    recording: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="LOG", help="The log to correct.")],
    /,
    *,
    output: Annotated[
        Path,
        tyro.conf.arg(name="output", aliases=["-o"], metavar="OUT", help="File to write; the suffix sets the format."),
    ],
    log: options.Reading = options.READING,
) -> None:
    """Apply a calibration to a log; the corrected log is in m/s² and rad/s.

    Examples:
      jaximu compensate results/calibration.json log.csv -o corrected.parquet

    """
    options.require_files(calibration, recording)
    from jaximu.calibration import compensate, load_calibration
    from jaximu.formats import write_recording

    model = load_calibration(calibration)
    with progress("compensating"):
        written = compensate(model, log.read(recording, model.gravity, alone="accelerometer" not in model.triads()))
        write_recording(written, output)
    for note in written.notes:
        if note.startswith("extrapolated"):
            say(f"note: {note}.")
    say(f"Written: {output}")
