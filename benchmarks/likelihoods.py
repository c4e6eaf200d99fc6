"""How likely the excess variances are where a fit ends: this version beside another, on measured recordings.

`--before FOLDER`: a checkout of the other version. The commands of `agreement.toml` that fit measured recordings run in
both, and so do fits of the eight units of the measured board. The restricted likelihood is that of the conditions with
gain, bias and what else is free fitted at these variances; where a version ends lower, it stopped short.
"""

import argparse
import json
import os
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np
from agreement_cases import cases
from common import Table, finish

VERBS = ("calibrate", "reference", "magnetometer", "turntable", "array")


def watched(arguments: list[str]) -> None:
    """Run a command; print the excess where its last fit that estimates one ended, and the likelihood there."""
    import jax

    from jaximu.estimation import fitting

    ends, plain = [], fitting.fit

    def fit(imu, data, *rest, **options):
        found = plain(imu, data, *rest, **options)
        if options.get("estimate_excess", True) and options.get("loss", "linear") == "linear":
            ends.append((found, (data,) if isinstance(data, fitting.Data) else tuple(data)))
        return found

    import jaximu.calibration.array_together
    import jaximu.calibration.attitude
    import jaximu.calibration.hand_held
    import jaximu.calibration.magnetometer
    import jaximu.calibration.recipe
    import jaximu.calibration.turntable  # noqa: F401 - so that each has `fit` to be replaced
    from jaximu.cli import main

    for module in list(sys.modules.values()):
        if module.__name__.startswith("jaximu") and getattr(module, "fit", None) is plain:
            module.fit = fit
    sys.stdout = open(os.devnull, "w", encoding="utf-8")
    main(arguments)
    sys.stdout = sys.__stdout__
    if not ends:
        return
    found, data = ends[-1]
    units = found.imu
    if np.ndim(units.accelerometer.bias) == 1:
        units = jax.tree.map(lambda leaf: np.asarray(leaf)[None], units)
    else:  # a batch of one
        found = jax.tree.map(lambda leaf: np.asarray(leaf)[0], found)
    excess, volume = np.asarray(found.excess), 0.0
    for kind in data:
        covariance = jax.tree.map(lambda leaf: np.asarray(leaf)[0], kind.about(units).covariance)
        covariance = covariance.dense() if hasattr(covariance, "dense") else covariance
        own, excess = np.split(excess, [covariance.components])
        weights = np.asarray(covariance.weights(own).root)
        volume += 2 * float(np.sum(np.log(np.abs(np.diag(weights) if weights.ndim == 2 else weights))))
    jacobian = np.asarray(found.jacobian)
    information = jacobian.T @ jacobian + np.eye(jacobian.shape[1]) / fitting.TOLERANCE**2
    likelihood = 0.5 * volume - 0.5 * float(np.linalg.slogdet(information)[1]) - float(found.cost)
    print(json.dumps({"excess": np.asarray(found.excess).tolist(), "likelihood": likelihood}))


def end_of(version: Path, arguments: list[str], folder: str) -> dict | None:
    """Where a version's fit ends; None where a command fits nothing."""
    environment = os.environ | {"PYTHONPATH": os.pathsep.join([str(version), str(Path(__file__).parent)])}
    done = subprocess.run(
        [sys.executable, __file__, "--watch", *arguments], env=environment, cwd=folder, capture_output=True, text=True
    )
    lines = [line for line in done.stdout.splitlines() if line.startswith("{")]
    return json.loads(lines[-1]) if lines else None


def commands(folders: dict[str, Path]) -> dict[str, list[str]]:
    """The command lines by name."""
    lines = {
        case.name: case.arguments(folders) for case in cases()
        if case.line.split()[0] in VERBS and "DATA/" in case.line and "MADE/" not in case.line
    }  # fmt: skip
    for unit in range(1, 9):
        log = folders["DATA"] / "mimu4444" / f"unit{unit}_session1.parquet"
        lines[f"unit {unit} of the board"] = [
            "calibrate", str(log), "--accel-scale", "2048 count/g", "--gyro-scale", "16.4 count/(deg/s)",
            "--gravity", "9.8184+-0.0005",
        ]  # fmt: skip
    return lines


def main() -> None:
    if sys.argv[1:2] == ["--watch"]:
        watched(sys.argv[2:])
        return
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--before", type=Path, required=True, help="checkout of the version that is compared")
    before, here = parser.parse_args().before.resolve(), Path(__file__).resolve().parents[1]
    table = Table(
        "Logarithm of the restricted likelihood where fits of measured recordings end",
        ["recording", "excess before", "excess now", "gain"],
        "Excess: variance of each kind of condition beyond the measured noise, in multiples of it.",
    )
    figures = {}
    with tempfile.TemporaryDirectory() as folder:
        folders = {name: Path(folder) for name in ("MADE", "OUT")} | {"DATA": Path(os.environ["JAXIMU_DATA"])}
        for name, arguments in commands(folders).items():
            old, new = (end_of(version, arguments, folder) for version in (before, here))
            if old is None or new is None:
                continue
            shown = [", ".join(f"{size:.3g}" for size in end["excess"]) for end in (old, new)]
            table.add(name, *shown, f"{new['likelihood'] - old['likelihood']:+.3f}")
            figures[name] = {"before": old, "now": new}
    finish("likelihoods", [table], figures)


if __name__ == "__main__":
    main()
