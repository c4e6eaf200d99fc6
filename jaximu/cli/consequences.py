"""`jaximu consequences`: what the errors that are left do to position, velocity and attitude."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from jaximu.cli import options
from jaximu.cli.messages import progress
from jaximu.errors import InputError

if TYPE_CHECKING:
    from jaximu.calibration import Calibration
    from jaximu.planning.consequences import Consequences
    from jaximu.planning.trajectory import Place, Trajectory

__all__ = ["run"]

_LATITUDE = 45.0
_LIMITS = {"accelerometer": ("--accel-range", "specific_force"), "gyroscope": ("--gyro-range", "angular_rate")}


def run(
    calibration: options.CalibrationFile,
    /,
    *,
    path: Annotated[
        Path | None, tyro.conf.arg(metavar="SPEC|LOG", help="The path (default: ten minutes of level driving).")
    ] = None,
    allan: Annotated[
        Path | None, tyro.conf.arg(metavar="ALLAN.JSON", help="Noise, as jaximu allan -o DIR writes it.")
    ] = None,
    against: Annotated[
        Path | None, tyro.conf.arg(metavar="CALIBRATION", help="Compare with another calibration of the unit.")
    ] = None,
    duration: Annotated[
        float | None,
        tyro.conf.arg(metavar="S", help="Length of the path; default 600 s, of a LOG 60 s, of a SPEC all."),
    ] = None,
    temperature: Annotated[
        float | None, tyro.conf.arg(metavar="DEGC", help="Temperature of level driving (default: the calibration's).")
    ] = None,
    accel_range: Annotated[
        str | None, tyro.conf.arg(metavar="TEXT", help='Refuse a path beyond this range, such as "16 g".')
    ] = None,
    gyro_range: Annotated[str | None, tyro.conf.arg(metavar="TEXT", help='The same, such as "2000 deg/s".')] = None,
    draws: Annotated[
        int,
        tyro.conf.arg(
            metavar="N", help="Simulated flights with all errors drawn, beside the linear budget; 0 for none."
        ),
    ] = 100,
    seed: Annotated[int, tyro.conf.arg(metavar="N", help="Seed of these draws.")] = 0,
    log: options.Reading = options.READING,
    local: options.Local = options.LOCAL,
    results: options.Output = options.RESULTS,
) -> None:
    """Show how far off position, velocity and attitude get by calibration errors and noise, and which dominates.

    DIR receives consequences.json, report.html, budget.png and tracks.png.

    Examples:
      jaximu consequences results/calibration.json
      jaximu consequences results/calibration.json --allan noise/allan.json --path flight.csv -o consequences
      jaximu consequences results/calibration.json --against old/calibration.json --duration 60

    """
    options.require_files(calibration, path, allan, against)
    if duration is not None and not 0 < duration < math.inf:
        raise InputError(f"--duration: {duration:g} is no number of seconds.")
    if draws < 0 or seed < 0:
        raise InputError("--draws and --seed count from 0 up.")
    if temperature is not None and path is not None:
        raise InputError("--temperature goes with level driving; a SPEC or LOG states the temperature.")
    results.prepare()
    from jaximu.calibration import load_calibration
    from jaximu.planning.consequences import consequences, read_sensor_noise
    from jaximu.planning.trajectory import Place

    model = load_calibration(calibration)
    other = None if against is None else load_calibration(against)
    noise = None if allan is None else read_sensor_noise(allan)
    gravity = model.gravity if local == options.LOCAL else local.value()
    place = Place(_LATITUDE if local.latitude is None else local.latitude, local.height, gravity)
    limits = _limits({"accelerometer": accel_range, "gyroscope": gyro_range})
    trajectory, stated = _trajectory(path, model, place, duration, temperature, log)
    trajectory.require_range(stated | limits)
    with progress("propagating errors"):
        found = consequences(
            model, trajectory, noise, draws=draws, seed=seed, against=other, files=(str(calibration), str(against))
        )
    write = options.drawn("consequences", "write_consequences", found)
    results.give(found.text, lambda: _print(found), write, "consequences.json, report.html and pictures")


def _limits(stated: dict[str, str | None]) -> dict[str, float]:
    """Return the ranges that were stated, by triad in SI."""
    from jaximu.noise.datasheet import SI_UNITS, parse_quantity

    found = {}
    for triad, text in stated.items():
        if text is not None:
            option, quantity = _LIMITS[triad]
            found[triad] = parse_quantity(text, SI_UNITS[quantity]["B"], option)
            if not 0 < found[triad] < math.inf:
                raise InputError(f"{option}: {text!r} is no range.")
    return found


def _trajectory(
    path: Path | None, model: Calibration, place: Place, duration: float | None, temperature: float | None,
    log: options.LogOptions,
) -> tuple[Trajectory, dict[str, float]]:  # fmt: skip
    """Return the path, and the ranges that it states."""
    from jaximu.planning.trajectory import level_driving, of_recording, of_specification

    if path is None:
        reference = model.inertial().imu.accelerometer.temperature_reference
        return level_driving(place, duration or 600.0, reference if temperature is None else temperature), {}
    with progress("reading the path"):
        if options.is_toml(path):
            from jaximu.simulation import read_specification

            return of_specification(read_specification(path), place, duration)
        try:
            recording = log.read(path, place.gravity)
        except InputError as error:
            raise InputError(f"{path} is no specification, and as a log: {error}") from error
        return of_recording(recording, model, place, duration or 60.0), {}


def _print(found: Consequences) -> None:
    from jaximu.cli.shown import console as screen
    from jaximu.cli.shown import table
    from jaximu.report.consequences import budget_rows, headers, headline, statements, total_rows

    console = screen()
    console.print(headline(found))
    console.print(f"Path: {found.trajectory.words}. Its start is taken as known exactly.\n")
    table(console, ("position error, 1σ", *headers(found)), budget_rows(found))
    console.print()
    table(console, ("everything, 1σ", *headers(found)), total_rows(found))
    console.print()
    for about, text in statements(found):
        console.print(f"{about}: {text}")
    for note in found.notes:
        console.print(f"note: {note}")
