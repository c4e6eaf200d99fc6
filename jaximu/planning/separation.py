"""Which recording would tell tied causes apart, or settle a weak one, and with what power.

Candidates are recordings a person could make next: the same again and longer, with the temperature taken up and down,
with quicker turns, on a table. Each is simulated with the calibrated unit, and the linear problem that a diagnosis
would ask is made from it. If cause i is there with coefficients c_i and the model holds its rival j, the rest of i,
δ² = ‖P A_i c_i‖² with P projecting off gain, bias and A_j, is the noncentrality of i's own score test: its power is
that of finding out that j does not explain the recording; of i for j and j for i the lesser counts.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import orth

from jaximu.data.by_hand import RecordedByHand
from jaximu.data.observe_stations import observe_stations
from jaximu.data.recorded_stations import RecordedStations
from jaximu.diagnosis.diagnosis import Diagnosis, Named, Option
from jaximu.diagnosis.evidence import LIMIT_LEVEL, LIMIT_POWER
from jaximu.diagnosis.experiment import Experiment
from jaximu.estimation.leave_out import off
from jaximu.ground.array_types import FloatArray
from jaximu.ground.distributions import chi2_isf, noncentral_chi2_sf
from jaximu.ground.vectors import submatrix
from jaximu.mistakes.titles import effect_title
from jaximu.model.effects import CATALOGUE, Effect
from jaximu.model.noise import drawn_noise
from jaximu.model.sensor import Imu
from jaximu.recordings.segmentation import observed_poses, segment
from jaximu.simulation import simulate
from jaximu.simulation.protocols import Environment, Positions, Protocol, RateTable
from jaximu.simulation.protocols import HandHeld as TurnedByHand

_LEVEL = 0.01  # of the test that rules a rival out
_WARMING = 20.0  # K, what a hair dryer or a cold box gives
_POSES = 40


def options(diagnosis: Diagnosis, cause: Named) -> tuple[Option, ...]:
    """Return recordings that would settle a cause of a diagnosis, least effort first, each with its power.

    A cause with rivals is to be told from them; one without is to be found (again) at the level of detection limits.
    The sizes of the causes are taken as this recording tells them.
    """
    effects = [cause.effect, *(_rival(diagnosis, cause, name) for name in cause.rivals if name in CATALOGUE)]
    imu = diagnosis.base.imu
    before = _powers(diagnosis.experiment, imu, effects)
    return tuple(
        Option(text, _powers(_experiment(diagnosis, protocol, environment, imu), imu, effects), before)
        for text, protocol, environment in _candidates(diagnosis, effects)
    )


def advised(diagnosis: Diagnosis) -> Diagnosis:
    """Return a diagnosis that says what would settle its first cause with rivals, or else its first weak one.

    Where a set-up's own error is the cause or a rival it is left as it is: no recording that is tried here shows one.
    It is left as well where none of the recordings that are tried would show more than this one does.
    """
    unsettled = [cause for cause in diagnosis.named if cause.rivals] or [
        cause for cause in diagnosis.named if cause.weak
    ]
    causes = [CATALOGUE[name] for cause in unsettled[:1] for name in (cause.name, *cause.rivals) if name in CATALOGUE]
    if not causes or any(cause.scope == "fixture" for cause in causes):
        return diagnosis
    cause = unsettled[0]
    candidates = options(diagnosis, cause)
    better = [option for option in candidates if option.better]
    words = suggestion(cause, better) if better else diagnosis.suggestion
    return replace(diagnosis, suggestion=words, options=candidates)


def suggestion(cause: Named, candidates: Sequence[Option]) -> str:
    """Return one sentence: the least effort that settles most, and what it leaves open."""
    best = max(
        candidates, key=lambda option: (len(option.told), sum(option.powers.values()) if not option.told else 0.0)
    )

    def listed(names: Sequence[str], powers: dict[str, float]) -> str:
        return ", ".join(f"{effect_title(name)} with {100 * powers[name]:.0f} % probability" for name in names)

    if list(best.powers) == [cause.name]:
        (power,) = best.powers.values()
        return (
            f"To decide about {cause.effect.title}, {best.text}. That would show it with {100 * power:.0f} % "
            f"probability; this recording, with {100 * best.before[cause.name]:.0f} %."
        )
    open_ = [name for name in best.powers if name not in best.told]
    if not best.told:
        return (
            f"No recording that was tried distinguishes {cause.effect.title} from its rivals with "
            f"{100 * LIMIT_POWER:.0f} % probability; best: {best.text}, which rules out {listed(open_, best.powers)}."
        )
    text = (
        f"To distinguish {cause.effect.title} from others, {best.text}. That would rule out "
        f"{listed(best.told, best.powers)}; this recording rules out {listed(best.told, best.before)}"
    )
    return text + (f". It would hardly distinguish it from {listed(open_, best.powers)}." if open_ else ".")


def _rival(diagnosis: Diagnosis, cause: Named, name: str) -> Effect:
    """The rival as this recording would have it in the cause's place, beside the other causes."""
    evidence = diagnosis.base.evidence
    statistic = evidence.scores().statistic

    def best(name: str) -> int:
        return max([k for k, block in enumerate(evidence.blocks) if block.name == name], key=lambda k: statistic[k])

    others = [other.name for other in diagnosis.effects if other.name != cause.name]
    indices = [best(wanted) for wanted in (name, *others) if any(block.name == wanted for block in evidence.blocks)]
    block = evidence.blocks[indices[0]]
    return CATALOGUE[name].make(evidence.coefficients(indices)[: len(block.sizes)] * block.sizes, **block.inner)


def _candidates(diagnosis: Diagnosis, effects: Sequence[Effect]) -> Iterator[tuple[str, Protocol, Environment]]:
    """Recordings that excite the effects, in words: by hand, over temperature, on a table."""
    needs = {need for effect in effects for need in effect.needs}
    gravity = diagnosis.calibration.gravity.value
    logged = diagnosis.experiment.recordings[0].temperature
    middle = diagnosis.calibration.imu.accelerometer.temperature_reference
    middle = middle if logged is None else float(np.mean(logged.values))
    warm = any("temperature" in need for need in needs)
    level = Environment(gravity=gravity, temperature=None if logged is None else middle)
    plain = TurnedByHand(_POSES)
    long = TurnedByHand(2 * _POSES)
    if warm or "time" in needs:
        for protocol, cycles, times in ((plain, 1, "up and down again"), (long, 2, "up and down twice")):
            length = protocol.poses * (protocol.pose_duration + protocol.turn_duration)
            knots = [
                [float(time), middle + (_WARMING if k % 2 else 0.0)]
                for k, time in enumerate(np.linspace(0.0, length, 2 * cycles + 1))
            ]
            text = f"record {protocol.poses} poses by hand while the temperature goes {_WARMING:g} K {times}"
            yield text, protocol, Environment(gravity=gravity, temperature=knots)
    if not warm:
        yield f"record {_POSES} poses by hand", plain, level
    if {"angular_rate", "angular_acceleration"} & needs:
        quick = replace(plain, turn_duration=plain.turn_duration / 2)
        yield f"record {_POSES} poses by hand with turns twice as quick", quick, level
        yield "turn the unit on a rate table, each axis at 30, 90 and 180 °/s both ways", RateTable(), level
    elif not warm:
        yield "put the unit on a level table in 26 positions, 10 s each", Positions(26), level
    if not warm:
        long = replace(long, pose_duration=2 * plain.pose_duration)
        yield f"record {2 * _POSES} poses by hand, twice as long in each", long, level


def _experiment(diagnosis: Diagnosis, protocol: Protocol, environment: Environment, imu: Imu) -> Experiment:
    noise = diagnosis.noise
    gravity = diagnosis.calibration.gravity.value
    rate = round(diagnosis.experiment.recordings[0].accelerometer.rate, 3)
    recording, truth = simulate(imu, protocol, rate=rate, seed=1, environment=environment)
    for number, name in enumerate(("accelerometer", "gyroscope")):
        signal = getattr(recording, name)
        drawn = drawn_noise(getattr(noise, name), len(signal), signal.rate, [1, number]) * signal.nominal_scale
        recording = replace(recording, **{name: replace(signal, values=signal.values + drawn)})
    if protocol.reference:
        stations, _ = observe_stations(recording, truth.schedule, gravity, noise)
        return Experiment(RecordedStations(recording, stations), imu)
    parts = (segment(recording),)
    return Experiment(RecordedByHand(parts, observed_poses(parts, gravity, noise=noise)), imu)


def _powers(experiment: Experiment, imu: Imu, effects: Sequence[Effect]) -> dict[str, float]:
    """By rival of the first effect: the least power, either way, to rule the one out if the other is there."""
    linear = experiment.linearise(imu)
    used = experiment.used
    root = np.linalg.cholesky(submatrix(linear.covariance, used))
    base = _basis(np.linalg.solve(root, linear.slope[used]))
    kinds = [type(effect) for effect in effects]
    if len(experiment.recordings) < 2:  # a recording that could be made is none of those that were
        kinds = [kind.within(0) for kind in kinds]
    if any(experiment.lacking(kind, linear) for kind in kinds):
        return {effect.name: 0.0 for effect in (effects[1:] or effects)}

    def columns(kind: type[Effect], inner: Sequence[dict[str, float]]) -> FloatArray:
        matrices = experiment.dormant_columns(imu, linear.details, {kind: inner})[kind]
        return np.stack([np.linalg.solve(root, matrix[used]) for matrix in matrices])

    signals = []
    for effect, kind in zip(effects, kinds, strict=True):
        inner = {name: float(getattr(effect, name)) for name in effect.inner}
        signals.append(off(base, columns(kind, [inner])[0] @ np.asarray(effect.coefficients)))
    if len(effects) == 1:
        return {effects[0].name: _detected(float(signals[0] @ signals[0]), effects[0].size, LIMIT_LEVEL)}
    # a rival may take any inner parameters: the ones that imitate best count
    spans = [
        [_basis(off(base, matrix)) for matrix in columns(kind, list(kind.grid(experiment.extent(kind.recording))))]
        for kind in kinds
    ]

    def ruled_out(rival: int, there: int) -> float:
        rest = min(float((off(span, signals[there]) ** 2).sum()) for span in spans[rival])
        return _detected(rest, effects[there].size, _LEVEL)

    return {effects[k].name: min(ruled_out(k, 0), ruled_out(0, k)) for k in range(1, len(effects))}


def _basis(columns: NDArray[np.floating]) -> FloatArray:
    return orth(np.asarray(columns, float), rcond=1e-6)


def _detected(noncentrality: float, freedom: int, level: float) -> float:
    return float(noncentral_chi2_sf(chi2_isf(level, freedom), freedom, max(noncentrality, 1e-12)))
