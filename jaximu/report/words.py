"""What the report says in sentences: what came out, what to trust, what the data cannot tell."""

from __future__ import annotations

import shlex
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from jaximu.calibration import Calibration
from jaximu.estimation.problem import Name
from jaximu.estimation.uncertainty import direction_words
from jaximu.ground.distributions import chi2_sf
from jaximu.ground.page import Statement
from jaximu.ground.quantities import Z95, number, sentence, size
from jaximu.ground.vectors import sigmas_of
from jaximu.report.evidence import PoseAndTurnErrors, largest_gap

BEYOND = 2.0  # scatter in multiples of the noise from which a cause beyond noise is named
_CHANCE = 0.01
"""Share of recordings in which noise alone scatters more than a scatter that is called noise."""


def file_names(paths: Sequence[str]) -> str:
    """Return the names of recordings' files, without their folders."""
    return ", ".join(Path(path).name for path in paths) or "a recording"


def compensation(paths: Sequence[str], does: str) -> str:
    """Return the command that applies a calibration to the first recording, and what it does."""
    return f"`jaximu compensate CALIBRATION {shlex.quote(paths[0]) if paths else 'LOG'} -o CORRECTED.csv` {does}."


def counts(calibration: Calibration) -> tuple[int, int]:
    """Return the number of poses and of turns that a calibration was made from."""
    return calibration.data.get("poses", 0), calibration.data.get("turns", 0)


def how_much_smaller(before: float, after: float) -> str:
    """Say how much smaller `after` is, in two digits."""
    if not after > 0:
        return "all of it gone"
    if before < 1.05 * after:
        return "not smaller"
    if before < 2 * after:
        return f"{100 * (1 - after / before):.0f} % smaller"
    ratio = before / after
    digits = 1 - int(np.floor(np.log10(ratio)))
    return f"{round(ratio, digits):,.{max(0, digits)}f} times smaller"


_SCATTER = {
    "accelerometer": (
        "Accelerometer at rest",
        "the poses' averages",
        "such as a nonlinear axis, temperature, a unit that was still warming up, a drifting bias, or steps coarser "
        "than the noise",
    ),
    "turns": (
        "Turns",
        "the turns",
        "such as timing, a nonlinear or acceleration-sensitive gyroscope, a filter's lag, or a bias that drifts",
    ),
    "gyroscope": (
        "Gyroscope at rest",
        "the gyroscope's averages at rest",
        "such as a bias that wanders with time or temperature, or depends on orientation, or steps coarser than the "
        "noise",
    ),
}


def trust(calibration: Calibration) -> Iterator[Statement]:
    """Say what to trust: where noise explains the errors, where not, and what no interval contains."""
    by_hand = "gravity_norm" in calibration.rms
    yield from scatter_statements(calibration)
    if by_hand and not calibration.exact:
        yield new_poses(calibration)
    yield from gravity_statements(calibration)
    if not by_hand and "poses" in calibration.data:
        yield Statement(
            "The set-up",
            "What the set-up gets wrong every time (a table that is not level, axes that are not square, a wrong "
            "angle) shifts the parameters by as much and is in no interval; `jaximu budget` computes how much.",
            not calibration.imu.setup,
        )
    if calibration.method.startswith("two-step"):
        yield Statement(
            "Method",
            "The gyroscope was fitted with the accelerometer held fixed: its intervals leave out what the "
            "accelerometer's uncertainty adds.",
        )
    yield Statement(
        "Two kinds of error",
        "The intervals are sampling error: how far the numbers would scatter if the same unit were recorded again in "
        "the same way. Model error is another thing: what this model (scale, misalignment and bias, near "
        f"{_temperature(calibration)}, at these rates and accelerations) leaves out. No interval contains it.",
    )


def scatter_statements(calibration: Calibration) -> list[Statement]:
    """Say of each kind of error how much it scatters, in multiples of the noise."""
    entries, (poses, turns) = [], counts(calibration)
    norms = 1 if "gravity_norm" in calibration.rms else 3
    conditions = {"accelerometer": norms * poses - 9, "turns": 2 * turns - 9, "gyroscope": 3 * poses - 3}
    freedom = {name: max(left, 1) for name, left in conditions.items()}
    for name, (about, subject, causes) in _SCATTER.items():
        excess = calibration.excess.get(name)
        if excess is None or (name == "turns" and not turns):
            continue
        times = np.sqrt(1 + excess)
        large = times >= BEYOND
        how = "as much as" if times < 1.1 else f"{times:.1f} times as much as"
        why = "there is a little more than noise, and the intervals include it."
        if large:
            why = f"something beyond noise is there, {causes}."
        elif chi2_sf(times**2 * freedom[name], freedom[name]) > _CHANCE:
            why = "noise explains what the model leaves."
        entries.append(Statement(about, f"{sentence(subject)} scatter {how} their measured noise: {why}", large))
    if any(entry.caution for entry in entries):
        entries.append(
            Statement(
                "What scatter beyond noise means",
                "The intervals below include it as if it were random. A cause that repeats may have shifted the "
                "parameters by more than they say, and will act again when the calibration is used. Run `jaximu "
                "diagnose` to find it.",
                True,
            )
        )
    return entries


def new_poses(calibration: Calibration) -> Statement:
    """Say what the errors of the fitted poses tell about others: with n poses and p parameters √((n + p)/(n − p))."""
    poses, _ = counts(calibration)
    fitted = sum(name.owner == "accelerometer" for name in calibration.names)
    if poses <= fitted + 2:
        return Statement(
            "New poses",
            f"{poses} poses leave hardly any degrees of freedom to check {fitted} numbers by: however small the errors "
            "above, they do not show that the calibration is right. Record more poses.",
            True,
        )
    grown = np.sqrt((poses + fitted) / (poses - fitted))
    return Statement(
        "New poses",
        f"The errors above are those of the poses that were fitted. {fitted} numbers of the accelerometer were chosen "
        f"to suit {poses} poses, so poses that were not fitted should show roughly {grown:.1f} times as much, about "
        f"{size(grown * calibration.rms['gravity_norm'][1], 'm/s^2', 2)} (rms).",
        poses < 2 * fitted,
    )


def gravity_statements(calibration: Calibration) -> Iterator[Statement]:
    """Say how far gravity leaves the scales uncertain; nothing where they are known from other forces."""
    gravity = calibration.gravity
    triads = calibration.triads()
    if "accelerometer" not in triads:
        return
    if not gravity.sigma > 0:
        yield Statement(
            "Gravity",
            f"Gravity was taken as exactly {gravity.value:.5f} m/s². Were it off by 0.001 m/s², all three scales of "
            "the accelerometer would be off by 0.01 %; the intervals do not include that.",
        )
        return
    share = 100 * Z95 * gravity.sigma / gravity.value
    sigmas = sigmas_of(calibration.covariance_of([Name("accelerometer", "gain", (k, k)) for k in range(3)]))
    if (100 * Z95 * sigmas < 0.9 * share * np.diag(triads["accelerometer"].gain)).all():  # what was felt is not gravity
        return
    text = (
        f"Gravity was taken as {gravity.value:.5f} ± {number(Z95 * gravity.sigma, 2)} m/s² (95 %). This alone leaves "
        f"all three scales of the accelerometer uncertain by ±{number(share, 2)} %, which the intervals include."
    )
    if share > 0.01:
        text += " State the gravity of your place (--gravity, or --latitude and --height) to narrow it."
    yield Statement("Gravity", text, share > 0.01)


def _temperature(calibration: Calibration) -> str:
    logged = [part.recording.temperature for part in calibration.segmentations]
    warmth = [signal.values for signal in logged if signal is not None and len(signal)]
    if not warmth:
        return "the temperature of the recording, which is not known"
    low, high = min(values.min() for values in warmth), max(values.max() for values in warmth)
    return f"{low:.1f} °C" if high - low < 0.1 else f"{low:.1f} to {high:.1f} °C"


def limits(calibration: Calibration, errors: PoseAndTurnErrors | None = None) -> Iterator[Statement]:
    """Say what the data cannot tell."""
    triads = calibration.triads()
    if errors is not None:
        gap, where = largest_gap(errors.directions)
        if gap > 60:
            yield Statement(
                "Orientations",
                f"The direction {direction_words(where)} is {gap:.0f}° away from every direction that pointed up in a "
                "pose: what the accelerometer does there is extrapolated. Record poses there.",
                True,
            )
    if "gravity_norm" in calibration.rms:
        yield Statement(
            "The case",
            "The body frame is the accelerometer's: x along its x axis, y in the plane of its x and y axes. How it is "
            "turned against the case cannot be seen without a reference; three entries of the accelerometer's gain are "
            "zero for this reason.",
        )
    elif "poses" in calibration.data:
        yield Statement(
            "The fixture",
            "The body frame is the fixture's, in which the reference states its directions; how the fixture is turned "
            "against the table cannot be distinguished from misalignment.",
        )
    missing = "temperature, nonlinearity, time lags, ageing"
    if "gyroscope" in triads:
        missing += ", the gyroscope's sensitivity to acceleration"
    else:
        yield Statement("Gyroscope", "It is not part of this calibration: the accelerometer alone was calibrated.")
    effects = ", ".join(effect.title for triad in triads.values() for effect in triad.effects)
    yield Statement(
        "Not modelled",
        f"Effects other than {effects} were not tested."
        if effects
        else f"Effects beyond scale, misalignment and bias were not tested ({missing}).",
    )
