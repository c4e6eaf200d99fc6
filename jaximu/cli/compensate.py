"""`jaximu compensate`: apply a calibration to a recording."""

from pathlib import Path
from typing import Annotated

import tyro

from jaximu.cli.options import LogOptions, progress, require_files, say

__all__ = ["run"]


def run(
    calibration: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="CALIBRATION")],
    recording: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="LOG")],
    /,
    *,
    output: Annotated[
        Path, tyro.conf.arg(name="output", aliases=["-o"], metavar="OUT", help="File; format by suffix.")
    ],
    log: Annotated[LogOptions, tyro.conf.arg(name="")] = LogOptions(),  # noqa: B008
) -> None:
    """Apply a calibration to a recording; the output is in m/s² and rad/s."""
    require_files(calibration, recording)
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
