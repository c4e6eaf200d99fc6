"""`jaximu fleet`: thousands of units, one command."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import MISSING
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from tyro.conf import Positional

from jaximu.cli import options
from jaximu.cli.messages import progress, say
from jaximu.cli.options import option, switch, takes_options
from jaximu.ground.errors import InputError
from jaximu.ground.stored import compiling

if TYPE_CHECKING:
    from jaximu.acceptance.limits import Limits
    from jaximu.fleets.jobs import Settings
    from jaximu.fleets.population import Fleet
    from jaximu.ground.page import Page


_EVERY = 10.0
"""Seconds between two lines of progress where stderr is no terminal."""
_TOGETHER = 1.0
"""Seconds within which processes that start together give their first rows."""


@takes_options
class FleetCommand:
    """Calibrate many units: one row per recording in one Parquet table, and a report on the population.

    A magnetometer in a log gets its hard and soft iron from the rests; --field states the strength where all were.

    A manifest (CSV) has the columns device (or unit) and file, and optionally session, date, lot, static (a recording
    of the device at rest) and options (such as --rate 100). With sessions, jaximu diagnose TABLE.parquet says what
    belongs to which unit and session. A recording that fails costs only its own row; a run that was stopped
    resumes. Beside the table, TABLE.html shows the population, units that do not belong, and differences between lots
    and dates; TABLE.json holds the same, and TABLE.shrunk.parquet has each unit with the population as prior.

    Examples:
      jaximu fleet logs/ -o fleet.parquet
      jaximu fleet "logs/*.csv" -o fleet.parquet --workers 8 --diagnose
      jaximu fleet manifest.csv -o fleet.parquet --engine ray

    """

    logs: tuple[str, ...] = option(
        "LOGS...", "Logs, folders, patterns in quotes, or a manifest (CSV).", MISSING, Positional
    )
    log: options.LogOptions = options.READING
    local: options.GravityOptions = options.LOCAL
    output: Path | None = option("TABLE.parquet", "The table to write.", aliases=["-o"])
    static: Path | None = option(
        "LOG|DIR", "A recording at rest to measure the noise, or a folder of them, each named after its device."
    )
    diagnose: bool = switch("Also diagnose each recording.")
    engine: Literal["local", "ray"] = switch("Processes on this machine, or a Ray cluster.", "local")
    workers: int | None = option("N", "Number of processes (default: one per core).")
    field: options.FieldText = None
    poses: options.PoseOptions = options.POSES
    limits: Path | None = option(
        "LIMITS.toml", "Hold every unit to these limits, and follow the line; see jaximu accept --explain."
    )
    golden: str = option("DEVICE", "With --limits: the unit that watches the line.", "")
    as_json: options.JsonFlag = False

    def run(self) -> None:
        """Do what the command line says."""
        output, held, settings = self._table(), self._limits(), self._settings()
        from jaximu.fleets import find_jobs, run_fleet
        from jaximu.fleets.store import kept_rows

        jobs = find_jobs(self.logs, output, self.static)
        if self.static is not None and (without := sum(not job.static for job in jobs)):
            say(f"{without} of {len(jobs)} have no recording at rest: their noise is estimated from their own poses.")
        try:
            with _progress(len(jobs)) as show:
                statuses = run_fleet(jobs, output, settings, self.engine, self.workers, show)
        except KeyboardInterrupt:
            say(f"{kept_rows(output)} of {len(jobs)} rows are kept: the same command goes on from there.")
            raise
        from jaximu.fleets.field import field_words
        from jaximu.fleets.population import read_fleet  # only now: what it imports takes a second
        from jaximu.report.fleet import page_of

        with progress("questioning the fleet"):
            fleet = read_fleet(output)
        page, html = page_of(fleet, field_words(output), options.typed(self.local)), output.with_suffix(".html")
        written = options.draw(lambda: _write(fleet, page, output), html)
        line = None
        if held is not None and statuses["ok"]:
            from jaximu.acceptance.line import follow, read_table
            from jaximu.cli.accept import write_line

            with progress("following the line"):
                line = follow(read_table(output), held, self.golden)
            line_html, document = (output.with_suffix(f".acceptance{suffix}") for suffix in (".html", ".json"))
            line.save(document)
            written += [*options.draw(lambda: write_line(line, line_html, output)[-1:], line_html), document]
        if self.as_json:
            options.print_json(fleet.document() | ({"acceptance": line.document()} if line else {}))
            return
        from jaximu.report.terminal import show as show_page

        show_page(page)
        if line is not None:
            print()
            show_page(line.summary())
        print(f"Written: {', '.join(map(str, (output, *written)))}")

    def _table(self) -> Path:
        """Return the table to write. Raises `InputError` where options contradict each other or it is not named."""
        if self.output is None:
            raise InputError("name the table to write: jaximu fleet LOGS -o TABLE.parquet.")
        if self.output.suffix.lower() != ".parquet":
            raise InputError(f"{self.output}: the table is written as Parquet; let its name end in .parquet.")
        if self.workers is not None and self.workers < 1:
            raise InputError(f"--workers must be 1 or more, not {self.workers}.")
        if self.golden and self.limits is None:
            raise InputError("--golden goes with --limits.")
        return self.output

    def _limits(self) -> Limits | None:
        """Return the limits, before anything is computed."""
        if self.limits is None:
            return None
        from jaximu.cli.accept import limits_of

        options.require_files(self.limits)
        return limits_of(self.limits, None, None)

    def _settings(self) -> Settings:
        """Return what holds for every unit."""
        from jaximu.fleets import Settings

        return Settings(
            options=self.log.stated(),
            gravity=self.local.value(),
            diagnose=self.diagnose,
            segmentation=self.poses.value(),
            field=options.field_strength(self.field),
        )


def _write(fleet: Fleet, page: Page, table: Path) -> tuple[Path, ...]:
    """Write, beside the table, its page, its findings and, where there is a population, its units with it as prior."""
    from jaximu.fleets.population import write_shrunk
    from jaximu.ground.atomic import write_files
    from jaximu.report.html import encoded

    html, document = table.with_suffix(".html"), table.with_suffix(".json")
    fleet.save(document)
    shrunk = () if fleet.population is None else (table.with_suffix(".shrunk.parquet"),)
    for path in shrunk:
        write_shrunk(fleet, path)
    write_files({html: encoded(page)[0]})  # drawn when all else is there
    return html, document, *shrunk


@contextmanager
def _progress(total: int) -> Iterator[Callable[[int, int, Counter], None]]:
    """Show how far the run is, its rate and the time that is left, on stderr.

    The time of compiling, once on a machine, does not count: nothing is computed meanwhile.
    """
    last, working = time.monotonic(), 0.0
    arrivals: list[tuple[int, float]] = []
    with progress("calibrating", _EVERY) as report:

        def show(done: int, kept: int, statuses: Counter) -> None:
            nonlocal last, working
            now, programs = time.monotonic(), compiling()
            working += 0.0 if programs else now - last
            last = now
            if done > (arrivals[-1][0] if arrivals else kept):
                together = bool(arrivals) and working - arrivals[-1][1] < _TOGETHER
                arrivals.append((done, arrivals.pop()[1] if together else working))
            rate = _recent_rate(arrivals)
            failed = sum(count for status, count in statuses.items() if status != "ok")
            text = f"{done} of {total} recordings" + (f" ({kept} kept from before)" if kept else "")
            if rate > 0.0:
                left = (total - done) / rate - (working - arrivals[-1][1])
                text += f", {rate:.3g} a second, {max(left, 0.0):.0f} s left"
            text += f", compiling {programs} program{'s' * (programs > 1)} once for this machine" if programs else ""
            (report if done < total else say)(text + (f", {failed} failed" if failed else ""))

        yield show


def _recent_rate(arrivals: Sequence[tuple[int, float]]) -> float:
    """Return rows a second over the later half of the rows, 0 where it is not known yet.

    The first rows wait for processes to start, and early ones for programs to be loaded. `arrivals`: how many rows
    there were, and when [s].
    """
    if len(arrivals) < 2:
        return 0.0
    middle = (arrivals[0][0] + arrivals[-1][0]) / 2.0
    rows, moment = next(arrival for arrival in reversed(arrivals[:-1]) if arrival[0] <= middle)
    return (arrivals[-1][0] - rows) / (arrivals[-1][1] - moment)
