"""`jaximu compensate`: apply a calibration to a recording."""

from dataclasses import MISSING
from pathlib import Path

from tyro.conf import Positional

import jaximu
from jaximu.cli import options
from jaximu.cli.messages import progress, say
from jaximu.cli.options import option, takes_options


@takes_options
class CompensateCommand:
    """Apply a calibration to a log; the corrected log is in m/s² and rad/s.

    Examples:
      jaximu compensate results/calibration.json log.csv -o corrected.parquet
      jaximu compensate results/calibration.json log.csv -o corrected.mcap

    """

    calibration: options.CalibrationFile
    recording: Path = option("LOG", "The log to correct.", MISSING, Positional)
    output: Path = option(
        "OUT",
        "File to write; the suffix sets the format. OUT.mcap, or OUT without a suffix for a ROS 2 bag, holds "
        "the log before and after, and how far its magnitude is from gravity.",
        MISSING,
        aliases=["-o"],
    )
    log: options.LogOptions = options.READING

    def run(self) -> None:
        """Do what the command line says."""
        options.require_files(self.calibration, self.recording)
        options.require_apart(self.output, self.calibration, self.recording, self.log.gyro_log)
        from jaximu.ground.quantities import sentence
        from jaximu.mistakes import prepare
        from jaximu.report.export import is_messages, write_messages

        model = jaximu.load_calibration(self.calibration)
        with progress("compensating"):
            raw = self.log.alike(model).read(self.recording, model.gravity, alone="accelerometer" not in model.triads())
            written = jaximu.compensate(model, raw)
            noticed = prepare(raw).notes
            if is_messages(self.output):
                write_messages(model, raw, written, self.output)
            else:
                jaximu.write_recording(written, self.output)
        for note in (*noticed, *(note for note in written.notes if note.startswith(("extrapolated", "Against")))):
            say(f"note: {sentence(note)}")
        if noticed:
            say("note: that is what a fit makes of the log. Here every row is corrected and written.")
        say(f"Written: {self.output}")
