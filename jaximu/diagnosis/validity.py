"""The answer of a check: what moved, by how much and why, in sentences and as `check.json` has it."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field

import numpy as np

from jaximu.calibration import Calibration, History
from jaximu.diagnosis.experiment import Experiment
from jaximu.estimation.problem import Name
from jaximu.estimation.uncertainty import describe
from jaximu.ground.array_types import FloatArray
from jaximu.ground.distributions import chi2_sf
from jaximu.ground.document import SOFTWARE, Document, Json, entries
from jaximu.ground.page import Result
from jaximu.ground.quantities import probability, size, with_interval
from jaximu.mistakes.titles import effect_title

SCHEMA = "jaximu.check/1"
_TOGETHER = {
    "accelerometer.bias": "the accelerometer's biases",
    "accelerometer.gain": "the accelerometer's gains",
    "gyroscope.gain": "the gyroscope's gains",
    "accelerometer": "the accelerometer's gains and biases",
    "accelerometer and gyroscope": "gains and biases of accelerometer and gyroscope",
}
"""Parameters that may have moved together, in words."""


@dataclass(frozen=True)
class Shift:
    """How a parameter differs from the calibration's: new − old in its own unit, with the difference's sigma.

    name: `parameter` as documents have it. words: as a person reads it. in_si, sigma_in_si: what it changes in the
    calibrated output, m/s² or rad/s, at the input `at`; None for an effect's numbers. p_value: of no difference,
    corrected for the number of parameters (Holm). comparable: the recording tells the parameter at all. allowed: it may
    differ from one power-on to the next, and is not tested.
    """

    name: str
    words: str
    parameter: Name
    old: float
    difference: float
    sigma: float
    unit: str
    in_si: float | None
    sigma_in_si: float | None
    si_unit: str
    at: str
    p_value: float
    moved: bool
    comparable: bool
    allowed: bool

    @property
    def z(self) -> float:
        """The difference in standard deviations."""
        return self.difference / self.sigma

    @property
    def amount(self) -> str:
        """The difference with its 95 % interval."""
        return with_interval(self.difference, self.sigma, self.unit, sign=True)

    @property
    def output(self) -> str:
        """What it changes in the output, with its 95 % interval and at which input; empty for an effect's numbers."""
        if self.in_si is None or self.sigma_in_si is None:
            return ""
        return with_interval(self.in_si, self.sigma_in_si, self.si_unit, sign=True) + (self.at and f" at {self.at}")

    @property
    def tested(self) -> bool:
        """Whether it was tested."""
        return self.comparable and not self.allowed

    def document(self) -> Json:
        """Return the shift as `check.json` has it."""
        si = (
            None
            if self.in_si is None
            else {"value": self.in_si, "sigma": self.sigma_in_si, "unit": self.si_unit, "at": self.at}
        )
        return {
            **entries(self, "name", "old", "sigma", "unit", "z", "moved", "allowed"),
            "new": self.old + self.difference,
            "shift": self.difference,
            "si": si,
            "p_value": self.p_value if self.tested else None,
        }


@dataclass(frozen=True)
class Cause:
    """What explains the difference: parameters that moved, an effect of the catalogue, or a pose that was bumped.

    scope: "parameter", or "device", "session", "fixture" of an effect, "data" of a pose. parameters: those that moved.
    rivals: what explains the recording as well. p_value: of its absence, its grid allowed for.
    """

    name: str
    scope: str
    parameters: tuple[Name, ...]
    rivals: tuple[str, ...]
    p_value: float
    coefficients: FloatArray
    inner: dict[str, float]
    unit: str

    @property
    def title(self) -> str:
        """The parameter, the parameters together, or the effect in English."""
        if str(*self.parameters[:1]) == self.name:
            return describe(self.parameters[0])
        return _TOGETHER.get(self.name) or effect_title(self.name)

    @property
    def sentence(self) -> str:
        """The cause, and what its scope means."""
        meaning = {
            "parameter": "",
            "device": "an effect of the unit that the calibration lacks",
            "session": "belongs to this recording",
            "fixture": "gravity is another here, or all scales of the accelerometer changed alike",
            "data": "a pose that was bumped",
        }[self.scope]
        return f"{self.title}: {meaning}" if meaning else f"{self.title} moved"

    def document(self) -> Json:
        """Return the cause as `check.json` has it."""
        return {
            **entries(self, "name", "scope", "p_value", "coefficients", "inner", "unit"),
            "indistinguishable_from": list(self.rivals),
        }


@dataclass(frozen=True)
class OutputError:
    """The most that the old calibration's output differs from a fresh one's in the recording, and the sigma there."""

    value: float
    sigma: float
    unit: str


@dataclass(frozen=True, repr=False, eq=False)
class Validity(Result, Document, page="validity"):
    """Whether a calibration still holds for a recording.

    verdict: "valid"; "shifted" (parameters moved); "session" (the parameters hold, and what belongs to the recording
    explains the rest); "effect" (the unit has an effect that the calibration lacks, with parameters that may be off by
    it); or "unexplained" (no parameters fit the recording). p_value: family-wise, that nothing differs.
    chi_squared, freedom: of the conditions that the old calibration predicts, both its uncertainty and the recording's
    noise allowed for. difference: χ², degrees of freedom and p-value of all comparable parameters together, gyroscope
    bias apart. errors: rms by kind of residual, of the old calibration and of a fresh one, with its unit. scatter:
    factors by kind of residual on the noise, above one where the recording scatters more about any calibration.
    experiment: None where the recording has too few poses; then `history` is what a filter in use came to know.
    alone: by name, how far a parameter moved if it is the only one that did, with its sigma.
    """

    verdict: str
    p_value: float
    chi_squared: float
    freedom: int
    difference: tuple[float, int, float]
    shifts: tuple[Shift, ...]
    causes: tuple[Cause, ...]
    conditions: tuple[FloatArray, FloatArray]  # (n,) under the old calibration and under the fresh one
    scatter: dict[str, float]
    data: Json
    calibration: Calibration
    errors: dict[str, tuple[float, float, str]] = field(default_factory=dict)
    output_errors: dict[str, OutputError] = field(default_factory=dict)
    notes: tuple[str, ...] = ()
    experiment: Experiment | None = None
    history: History | None = None
    alone: dict[str, tuple[float, float]] = field(default_factory=dict)

    @property
    def moved(self) -> tuple[Shift, ...]:
        """Parameters that moved, most significant first."""
        return tuple(sorted((shift for shift in self.shifts if shift.moved), key=lambda shift: -abs(shift.z)))

    def bias_words(self) -> str:
        """Say how far the gyroscope's bias is off, which is no fault of the calibration."""
        shift = np.array([moved.in_si for moved in self.shifts if moved.allowed], float)
        return (
            f"It is {size(float(np.linalg.norm(shift)), 'rad/s', 2)} off the calibration's; it changes "
            "at power-on; re-zero it at rest."
        )

    def headline(self) -> str:
        """Return the one sentence a person wants first."""
        ratio = f"χ² per condition {self.chi_squared / self.freedom:.2f}, p {probability(self.p_value)}"
        if self.verdict != "valid" and self.chi_squared <= self.freedom:
            ratio = f"p {probability(self.p_value)} in one direction, though noise is expected to scatter more in all"
        if self.verdict == "valid":
            shown, count = sum(shift.comparable for shift in self.shifts), len(self.shifts)
            scope = "" if shown == count else f" in the {shown} of {count} numbers that this recording shows"
            return (
                f"The calibration is still valid{scope}: it predicts the recording to within its uncertainty ({ratio})."
            )
        if self.verdict == "unexplained" and self.history is not None:
            return (
                f"The calibration does not predict this recording ({ratio}), and no change of its parameters would: it "
                "is of another unit, or the unit was not at rest where it seemed to be."
            )
        if self.verdict == "unexplained":
            return (
                f"The calibration does not predict this recording ({ratio}), and no change of its parameters would: "
                "diagnose the recording to see why."
            )
        causes = ", ".join(cause.title for cause in self.causes if cause.scope != "parameter")
        if self.verdict == "session":
            return (
                f"The calibration still holds; what it does not predict ({ratio}) belongs to this recording: {causes}."
            )
        if self.verdict == "effect":
            what = "gain and bias, fitted without it, differ from a fresh fit's" if self.moved else "gain and bias hold"
            return (
                f"The calibration is missing an effect ({ratio}): {causes}; {what}. Diagnose a recording and keep "
                "the extended calibration."
            )
        words = [
            f"{shift.words} moved by {shift.output or shift.amount} ({abs(shift.z):.1f} σ)" for shift in self.moved[:3]
        ]
        words = words or [
            f"{cause.title} moved{self._alone(cause)}" for cause in self.causes if cause.scope == "parameter"
        ]
        if not words:
            few = "poses and turns are" if self.history is None else "rests and motion are"
            return (
                f"The calibration is no longer valid: it does not predict this recording ({ratio}), whose {few} too "
                "few or too alike to show which parameter moved."
            )
        rest = f" and {len(self.moved) - 3} more" if len(self.moved) > 3 else ""
        beyond = f"; beyond that the recording shows {causes}" if causes else ""
        return f"The calibration is no longer valid: {'; '.join(words)}{rest}{beyond} ({ratio})."

    def _alone(self, cause: Cause) -> str:
        """Say how far a parameter moved if it alone did."""
        if cause.name not in self.alone:
            return ""
        return f" by {with_interval(*self.alone[cause.name], cause.unit, sign=True)} if it alone did"

    @property
    def nis(self) -> float | None:
        """Squared innovations of the filter in use over what they are expected to be; None where poses were used."""
        if self.history is None:
            return None
        return float(self.history.innovations.sum() / max(self.history.freedom.sum(), 1))

    def document(self) -> Json:
        """Return the JSON document of schema `jaximu.check/1`."""
        statistic, freedom, p_value = self.difference
        return {
            "schema": SCHEMA,
            **entries(self, "verdict", "p_value", "scatter", "nis", "notes", "data"),
            "sentence": self.headline(),
            "prediction": {
                "chi_squared": self.chi_squared,
                "degrees_of_freedom": self.freedom,
                "p_value": float(chi2_sf(self.chi_squared, self.freedom)),
            },
            "difference": {"chi_squared": statistic, "degrees_of_freedom": freedom, "p_value": p_value},
            "parameters": [shift.document() for shift in self.shifts if shift.comparable],
            "not_comparable": [shift.name for shift in self.shifts if not shift.comparable],
            "causes": [cause.document() for cause in self.causes],
            "output_error": {name: asdict(error) for name, error in self.output_errors.items()},
            "errors": {
                name: {"old": old, "fresh": fresh, "unit": unit} for name, (old, fresh, unit) in self.errors.items()
            },
            "by": "poses" if self.history is None else "filter in use",
            "alone": {name: {"value": value, "sigma": sigma} for name, (value, sigma) in self.alone.items()},
            "calibration": self.calibration.data,
            "software": SOFTWARE,
        }
