"""`jaximu consequences`: what the errors that are left do to position, velocity and attitude."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import jaximu
from jaximu.cli import options
from jaximu.cli.messages import progress
from jaximu.cli.options import option, takes_options
from jaximu.ground.errors import InputError
from jaximu.ground.reexport import later
from jaximu.ground.units import SENSOR_UNITS

if TYPE_CHECKING:
    from jaximu.navigation.estimator_noise import EstimatorNoise, MeasuredErrors
    from jaximu.navigation.trajectory import Place, Trajectory
    from jaximu.noise.stated import SensorNoise


_LATITUDE = 45.0


@takes_options
class ConsequencesCommand(options.Reads):
    """Show how far off position, velocity and attitude get by calibration errors and noise, and which dominates.

    DIR receives consequences.json, report.html, budget.png and tracks.png; with --noise-for estimator_noise.json and
    the estimators' files too.

    Examples:
      jaximu consequences results/calibration.json
      jaximu consequences results/calibration.json --noise noise/allan.json --path flight.csv -o consequences
      jaximu consequences results/calibration.json --diagnosis results/diagnosis.json
      jaximu consequences results/calibration.json --against old/calibration.json --duration 60
      jaximu consequences results/calibration.json --path flight.csv --noise noise/allan.json --noise-for vins,gtsam

    """

    calibration: options.CalibrationFile
    path: Path | None = option("SPEC|LOG", "The path (default: ten minutes of level driving).")
    noise_file: options.NoiseFile = None
    diagnosis: Path | None = option(*options.DIAGNOSIS)
    against: Path | None = option("CALIBRATION", "Compare with another calibration of the unit.")
    duration: float | None = option("S", "Length of the path; default 600 s, of a LOG 60 s, of a SPEC all.")
    temperature: float | None = option("DEGC", "Temperature of level driving (default: the calibration's).")
    accel_range: str | None = option("TEXT", 'Refuse a path beyond this range, such as "16 g".')
    gyro_range: str | None = option("TEXT", 'The same, such as "2000 deg/s".')
    draws: int = option("N", "Simulated flights with all errors drawn, beside the linear budget; 0 for none.", 100)
    seed: int = option("N", "Seed of these draws.", 0)
    noise_for: str | None = option(
        "LIST",
        "Noise for these estimators, enlarged for the motion of the path: gtsam, vins, openvins, lio-sam, "
        "kalibr, px4, ardupilot, separated by commas.",
    )
    noise_interval: float = option("S", "Time between two states (keyframes, fixes) of that estimator.", 1.0)
    reference: Path | None = option(
        "REF", "Attitude (and velocity or position) measured along LOG: noise from the errors seen."
    )

    def run(self) -> None:
        """Do what the command line says."""
        targets = self._targets()
        self.results.prepare()
        from jaximu.navigation.trajectory import Place

        model, hidden = options.allowing_for(jaximu.load_calibration(self.calibration), self.diagnosis)
        other = None if self.against is None else jaximu.load_calibration(self.against)
        noise = None if self.noise_file is None else options.stated_noise(self.noise_file)
        _require_densities(targets, noise or {})
        gravity = model.gravity if self.local == options.LOCAL else self.local.value()
        site = Place(_LATITUDE if self.local.latitude is None else self.local.latitude, self.local.height, gravity)
        limits = self._limits()
        measured = self._measured(model, site)
        trajectory, stated = self._trajectory(model, site, measured)
        trajectory.require_range(stated | limits)
        with progress("propagating errors"):
            result = jaximu.consequences(
                model,
                trajectory,
                noise,
                draws=self.draws,
                seed=self.seed,
                against=other,
                files=(str(self.calibration), str(self.against)),
            )
        result = replace(result, notes=(*result.notes, *hidden))
        names = "consequences.json, report.html and pictures"
        if not targets:
            self.results.present(result.summary, names, consequences=result)
            return
        assert noise is not None
        from jaximu.navigation.estimator_noise import ModelledErrors, estimator_noise

        with progress("finding the estimator's noise"):
            sources = {"expected": ModelledErrors(model, trajectory, str(self.calibration))}
            sources |= {} if measured is None else {"measured": measured}
            estimated = {
                origin: estimator_noise(source, noise, interval=self.noise_interval, seed=self.seed)
                for origin, source in sources.items()
            }
        final = estimated["expected" if measured is None else "measured"]
        files = _files(targets, final, site.gravity.value)

        def document() -> str:
            added = final.document() | {"files": {name: text.decode() for name, text in files.items()}}
            added |= {} if measured is None else {"expected": estimated["expected"].document()}
            return json.dumps(result.document() | {"estimator_noise": added}, indent=1, allow_nan=False)

        self.results.present(
            lambda: later("report.consequences", "page_of")(result, estimated, files),
            f"{names}, {', '.join(files)}",
            files,
            document,
            consequences=result,
            estimator_noise=final,
        )

    def _targets(self) -> list[str]:
        """Return the estimators asked for. Raises `InputError` where options contradict each other or lack one."""
        options.require_files(
            self.calibration, self.path, self.noise_file, self.diagnosis, self.against, self.reference
        )
        if self.duration is not None and not 0 < self.duration < math.inf:
            raise InputError(f"--duration: {self.duration:g} is no number of seconds.")
        if self.draws < 0 or self.seed < 0:
            raise InputError("--draws and --seed count from 0 up.")
        if self.temperature is not None and self.path is not None:
            raise InputError("--temperature goes with level driving; a SPEC or LOG states the temperature.")
        from jaximu.report.export.noise import target

        if self.reference is not None and (self.noise_for is None or self.path is None or options.is_toml(self.path)):
            raise InputError(
                "--reference goes with --path LOG and --noise-for: it is what was measured along that log."
            )
        if self.noise_for is None:
            return []
        targets = list(dict.fromkeys(target(name) for name in self.noise_for.split(",") if name.strip()))
        if not targets:
            raise InputError("--noise-for names no estimator.")
        if self.noise_file is None:
            raise InputError(
                "--noise-for multiplies known noise: give --noise allan.json, which `jaximu allan LOG -o DIR` writes, "
                "or a Kalibr imu.yaml with the data sheet's figures."
            )
        return targets

    def _limits(self) -> dict[str, float]:
        """Return the ranges that were stated, by triad in SI."""
        from jaximu.model.data_sheet import parse_quantity

        limits = {}
        for triad, name, text in (
            ("accelerometer", "--accel-range", self.accel_range),
            ("gyroscope", "--gyro-range", self.gyro_range),
        ):
            if text is not None:
                limits[triad] = parse_quantity(text, SENSOR_UNITS[triad], name)
                if not 0 < limits[triad] < math.inf:
                    raise InputError(f"{name}: {text!r} is no range.")
        return limits

    def _measured(self, model: jaximu.Calibration, site: Place) -> MeasuredErrors | None:
        """Return the errors of the calibrated unit along a log against what a reference measured; None without one."""
        if self.reference is None or self.path is None:
            return None
        from jaximu.navigation.estimator_noise import MeasuredErrors
        from jaximu.recordings.readers import read_attitude

        with progress("comparing with the reference"):
            return MeasuredErrors.of(
                model.inertial().imu,
                self.log.alike(model).read(self.path, site.gravity),
                read_attitude(self.reference),
                site.gravity,
            )

    def _trajectory(
        self, model: jaximu.Calibration, site: Place, measured: MeasuredErrors | None
    ) -> tuple[Trajectory, dict[str, float]]:
        """Return the path, and the ranges that it states."""
        from jaximu.navigation.trajectory import level_driving, of_recording, of_specification

        if self.path is None:
            reference = model.inertial().imu.accelerometer.temperature_reference
            return level_driving(
                site, self.duration or 600.0, reference if self.temperature is None else self.temperature
            ), {}
        with progress("reading the path"):
            if options.is_toml(self.path):
                from jaximu.simulation import read_specification

                return of_specification(read_specification(self.path), site, self.duration)
            try:
                recording = self.log.alike(model).read(self.path, site.gravity)
            except InputError as error:
                raise InputError(f"{self.path} is no specification, and as a log: {error}") from error
            if measured is not None and recording.attitude is None:
                recording = replace(recording, attitude=jaximu.Signal(measured.stamp, measured.rotation, ""))
            return of_recording(recording, model, site, self.duration or 60.0), {}


def _require_densities(targets: list[str], noise: SensorNoise) -> None:
    """Raise `NotPossibleError`, before anything is computed, where an estimator needs noise that is not known."""
    from jaximu.report.export.noise import noise_values

    known = {"update_rate": 1.0, "integration_covariance": 1.0}
    for triad, terms in noise.items():
        known[f"{triad}_noise_density"] = float("N" in terms)
        known[f"{triad}_random_walk"] = float("K" in terms or "B" in terms)
    for name in targets:
        noise_values(name, known, 1.0)


def _files(targets: list[str], noise: EstimatorNoise, gravity: float) -> dict[str, bytes]:
    """Return the estimators' files by name."""
    from jaximu._version import __version__
    from jaximu.report.export.noise import noise_files

    head = [f"By jaximu {__version__}. {noise.headline()}"]
    made: dict[str, bytes] = {}
    for name in targets:
        made |= noise_files(name, noise.densities(), noise.rate, head, gravity)
    return made
