"""The noise of a unit from its own poses, and whether it is the noise that a recording at rest told.

What is quicker than a pose is compared in the still parts themselves: means over an eighth of a second, whitened by
the covariance that the noise model gives them, are independent and of variance one, so that sums of their squares are
χ² with exact degrees of freedom. What is slower shows in the fit: a further bias instability or random walk adds a
known covariance, times a variance, to the conditions; the score test of that variance being zero is a quadratic form
in normal numbers (its tail by Kuonen, Biometrika 86, 1999), and its likelihood competes with that of effects.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np
import scipy

from jaximu.data.drift import with_usual_drift
from jaximu.diagnosis.evidence import Evidence
from jaximu.diagnosis.experiment import Experiment, State
from jaximu.diagnosis.learned import curves
from jaximu.diagnosis.selection import Selection
from jaximu.ground.array_types import FloatArray
from jaximu.ground.distributions import chi2_median, f_tails, normal_isf, normal_sf
from jaximu.ground.document import Json, entries
from jaximu.ground.quantities import number, with_interval
from jaximu.mistakes.titles import effect_title
from jaximu.model.noise_model import AxisNoise, NoiseModel, fit_bank

NOISE_NAMES = ("noise.white", "noise.correlated", "noise.bias_instability", "noise.rate_random_walk")
_SHARE = 0.1
"""Share of the level of all tests together that the noise model's tests may use."""
_TESTS = 14  # white and correlated on six axes, two kinds of slow bias of the gyroscope
_WIDTH = 0.125
"""Seconds of a mean: poses and parts of turns hardly feel what is faster, and a noise model may leave it aside."""
_MEANS = (8, 64)  # in a part, at least and at most
_TREND = 3
"""Slowest shapes in a part that are left aside: an effect may bend its mean."""
_LEAST = {"noise.white": 0.05, "noise.correlated": 0.1}
"""Shares by which standard deviations must differ: below, tests of effects do not feel it."""
_TIE = 6.0
"""Difference of the information criterion up to which explanations are taken for equally good."""
_BESIDE = 0.1
"""Share of the level at which something must stand out beside slow noise for that not to explain the misfit."""
_LONG = 4.0
"""Correlation time of a random walk's stand-in, in lengths of the recording."""

_FEWEST, _SHORTEST = 8, 64
"""Samples that a part at rest must exceed for its scatter to count, and hold for its spectrum to count."""


def own_noise(experiment: Experiment) -> NoiseModel:
    """Fit a noise model to the scatter inside the parts at rest, which knows nothing of what is slower than a part."""
    noise: dict[str, AxisNoise] = {}
    for name in ("accelerometer", "gyroscope"):
        parts, rate = experiment.still_parts(name)
        parts = [values for values in parts if len(values) > _FEWEST]
        length = int(np.median([len(values) for values in parts]))
        whole = [values[:length] for values in parts if len(values) >= max(length, _SHORTEST)]
        if len(whole) >= 4:
            bank = fit_bank(np.stack([values.T for values in whole]), rate)
            kept = bank.correlation_time < length / rate
            triad = replace(bank, variance=bank.variance[:, kept], correlation_time=bank.correlation_time[kept])
        else:
            triad = AxisNoise.of_white(np.mean([values.var(axis=0) for values in parts], axis=0) / rate)
        # output that never changes at rest is known to its steps and no better
        steps = experiment.recordings[0].signals[name].rounding_variance / 3
        noise[name] = replace(triad, white=np.maximum(triad.white, steps / rate))
    return NoiseModel(noise["accelerometer"], noise["gyroscope"])


def usual_noise(experiment: Experiment) -> NoiseModel:
    """Return the noise that the parts at rest show, and the drift that sensors usually have beyond them."""
    return with_usual_drift(own_noise(experiment), experiment.shortest(), experiment.extent().duration)


@dataclass(frozen=True)
class NoiseFinding:
    """A noise model that is wrong by a factor or a kind, listed among a diagnosis's effects.

    factor, sigma: of the standard deviation of each of the `axes`, against the model: of all that is quicker than a
    pose (`noise.white`), of what is slower than half a second against what is quicker (`noise.correlated`), or of the
    Allan deviation at a quarter of the recording's length (the slow kinds).
    """

    name: str
    axes: tuple[str, ...]
    factor: FloatArray
    sigma: FloatArray
    p_value: float
    weak: bool
    evidence: str
    rivals: tuple[str, ...] = ()

    scope: ClassVar[str] = "session"
    unit: ClassVar[str] = "1"
    gain: ClassVar[None] = None

    def sentence(self) -> str:
        """Return what was found, for the verdict."""
        worst = int(np.argmax(np.abs(np.log(self.factor))))
        triad, _, axis = self.axes[worst].rpartition(" ")
        times = number(self.factor[worst])
        return f"{effect_title(self.name)}: the noise of the {triad}'s {axis} axis is {times} times what the model says"

    def numbers(self) -> list[str]:
        """Return the factors with half their 95 % intervals."""
        values = zip(self.axes, self.factor, self.sigma, strict=True)
        return [f"{axis} {with_interval(value, sigma)}" for axis, value, sigma in values]

    def document(self) -> Json:
        """Return the finding as `diagnosis.json` has it among the effects."""
        return {
            **entries(self, "name", "p_value", "weak", "scope", "axes", "sigma", "unit", "evidence"),
            "indistinguishable_from": list(self.rivals),
            "coefficients": self.factor.tolist(),
            "inner": {},
            "improvement": None,
        }


def quick_noise(experiment: Experiment, noise: NoiseModel, level: float) -> tuple[list[NoiseFinding], NoiseModel]:
    """Compare the still parts with a noise model from elsewhere, in what is quicker than a pose.

    **Returns:** what is wrong with the model, and the model put right: what is quicker than a pose is scaled, or where
    its kind is wrong taken from the still parts. `level`: of all tests of a diagnosis together.
    """
    alpha = level * _SHARE / _TESTS
    rows: dict[str, list[tuple]] = {name: [] for name in _LEAST}
    changed: dict[str, AxisNoise | None] = {"accelerometer": noise.accelerometer, "gyroscope": noise.gyroscope}
    for triad, known in list(changed.items()):
        if known is None:
            continue
        parts, rate = experiment.still_parts(triad)
        counts = _bands(parts, rate, known)
        if counts is None:
            continue
        (low, few, usual_low), (high, many, usual_high) = counts
        means = known.duration / _WIDTH if known.duration else np.inf
        variances = [1 / (1 / few + 4 / means), 1 / (1 / many + 4 / 3 / means)]  # the model, too, is known so well only
        wrong = {}
        for name, ratio, usual, freedom in (
            ("noise.correlated", (low / few) / (high / many), usual_low / usual_high, (variances[0], variances[1])),
            ("noise.white", high / many, usual_high, (many, means * 3 / 4)),
        ):
            p_value = np.minimum(2 * np.minimum(*f_tails(ratio, *freedom)), 1.0)
            factor = np.sqrt(ratio)
            sigma = factor * np.sqrt((1 / freedom[0] + 1 / freedom[1]) / 2)
            off = (p_value < alpha) & (np.abs(np.log(factor)) > np.log1p(_LEAST[name]))
            off &= np.log(usual) * np.log(ratio) > 0.5 * np.log(ratio) ** 2  # noise is in all parts, an effect in some
            off &= not wrong.get("noise.correlated", False)  # a kind that is wrong has no level to compare
            wrong[name] = bool(off.any())
            rows[name] += list(zip((f"{triad} {axis}" for axis in "xyz"), factor, sigma, p_value, off, strict=True))
        length = float(np.median([len(part) for part in parts])) / rate
        if wrong["noise.correlated"]:
            changed[triad] = _with_own(known, parts, rate, length)
        elif wrong["noise.white"]:
            changed[triad] = _scaled(known, high / many, length)
    findings = []
    for name, tested in rows.items():
        hit = [float(p) for *_, p, off in tested if off]
        if hit:
            axes, factor, sigma, *_ = zip(*tested, strict=True)
            what = "means over 1/8 s" if name == "noise.white" else "what is slower than half a second"
            text = f"{what} in the still parts against the noise model, {len(hit)} of {len(axes)} axes off"
            findings.append(
                NoiseFinding(name, axes, np.array(factor), np.array(sigma), min(hit), _weak(min(hit), alpha), text)
            )
    accelerometer = changed["accelerometer"]
    assert accelerometer is not None
    return findings, replace(noise, accelerometer=accelerometer, gyroscope=changed["gyroscope"])


def slow_noise(
    experiment: Experiment,
    state: State,
    selection: Selection,
    noise: NoiseModel,
    remade: Callable[[NoiseModel], Experiment],
    level: float,
) -> tuple[NoiseFinding | None, NoiseModel, str]:
    """Ask whether the gyroscope's slow bias beyond a noise model explains a misfit, and better than what was selected.

    Better, too, than a smooth curve of any covariate, and than poses that are each off by themselves: these are effects
    without a name. Of the accelerometer it is not asked, whose bias at rest no direction but gravity's shows.

    **Arguments:** `state`, `selection`: a fit that leaves something, and the effects that may explain it; `remade`:
    makes the experiment anew with another noise. **Returns:** the finding or None, the noise model with it, and what
    is to be said where slow bias and effects explain the misfit about as well.
    """
    nothing = None, noise, ""
    known, evidence = noise.gyroscope, state.evidence
    tried = [] if known is None else _slow_processes(experiment, state, noise, remade, level * _SHARE / _TESTS)
    if known is None or not tried:
        return nothing
    gained, name, p_value, strength, spread, unit, added = tried[0]
    rival = _criterion(evidence, selection) if selection.complete else -np.inf
    if gained <= rival - _TIE or any(
        gained < _variance(*_parted(evidence, columns @ columns.T), evidence.freedom)[2] + _TIE
        for columns in _otherwise(experiment, state)
    ):
        return nothing
    root = np.linalg.inv(state.weights)
    weights = np.linalg.inv(np.linalg.cholesky(root @ root.T + strength * added)) @ root
    blocks = [replace(block, columns=weights @ block.columns) for block in evidence.blocks]
    left = Evidence(weights @ evidence.residual, weights @ evidence.jacobian, blocks)
    if left.family_wise(left.scores().smallest) < _BESIDE * level:
        return nothing
    if gained < rival + _TIE:
        text = (
            f"a {name.partition('.')[2].replace('_', ' ')} of the gyroscope's bias beyond the recording at rest would "
            "explain what was found about as well: repeat the recording."
        )
        return None, noise, text
    corrected = _joined(known, replace(unit, variance=strength * unit.variance))
    tau = experiment.extent().duration / 4
    before, extra = known.allan_variance([tau])[0], strength * unit.allan_variance([tau])[0]
    factor = np.sqrt((before + extra) / before)
    sigma = 0.5 * spread * extra / before / factor
    axes = tuple(f"gyroscope {axis}" for axis in "xyz")
    rivals = tuple(entry[1] for entry in tried[1:] if entry[0] > gained - _TIE)
    text = (
        f"the bias at rest and over the turns drifts more than the recording at rest showed: log-likelihood "
        f"{(gained + np.log(evidence.freedom)) / 2:+.1f}, p {p_value:.2g}"
    )
    finding = NoiseFinding(name, axes, factor, sigma, p_value, _weak(p_value, level * _SHARE / _TESTS), text, rivals)
    return finding, replace(noise, gyroscope=corrected), ""


def _slow_processes(
    experiment: Experiment,
    state: State,
    noise: NoiseModel,
    remade: Callable[[NoiseModel], Experiment],
    alpha: float,
) -> list[tuple[float, str, float, float, float, AxisNoise, FloatArray]]:
    """Return what the gyroscope's slow bias may be that the data ask for at a level `alpha`, likeliest first.

    Of each: log-likelihood gained, name, p-value, variance in that of the process and its sigma, the process, and the
    covariance (c, c) that it adds.
    """
    known, tried = noise.gyroscope, []
    assert known is not None
    for name, unit in _slow_units(known, experiment.extent().duration).items():
        added = remade(replace(noise, gyroscope=_joined(known, unit))).linearise(state.imu).covariance
        added = (added - state.linear.covariance)[np.ix_(experiment.used, experiment.used)]
        parts = _parted(state.evidence, state.weights @ added @ state.weights.T)
        p_value = quadratic_tail(float(np.sum(parts[0] * parts[1])), parts[0])
        strength, spread, gained = _variance(*parts, state.evidence.freedom)
        if p_value < alpha and strength > 0:
            tried.append((gained, name, p_value, strength, spread, unit, added))
    return sorted(tried, key=lambda entry: -entry[0])


def _otherwise(experiment: Experiment, state: State) -> Iterator[FloatArray]:
    """Return whitened columns (n, k) of what else may look like slow bias, without a name.

    Each pose by itself, or each mean at rest; shapes in orientation; curves of a covariate, which take long.
    """
    blocks = state.evidence.blocks
    yield np.concatenate([block.columns for block in blocks if block.name == "data.bumped_pose"], axis=1)
    for block in blocks:
        if block.kind == "generic" and "orientation" in block.name:
            yield block.columns
    yield state.weights[:, experiment.real.of_kind("static_gyroscope")]
    for _, columns, _ in curves(experiment, state):
        yield columns


def _weak(p_value: float, alpha: float) -> bool:
    return bool(normal_isf(p_value / 2) < 2 * normal_isf(alpha / 2))


def _bands(parts: list[FloatArray], rate: float, known: AxisNoise):
    """Return sums of squares of the slowest quarter of each part's means, freed of a trend, and of the rest.

    Of each: the sum over all parts (3,), how many squares it is of, and the variance (3,) that the middle part tells.
    """
    width = max(1, round(_WIDTH * rate))
    if not parts:
        return None
    count = int(np.clip(np.median([len(part) for part in parts]) // width, *_MEANS))
    pieces = [
        part[a : a + count * width].reshape(count, width, 3).mean(axis=1)
        for part in parts
        for a in range(0, len(part) - count * width + 1, count * width)
    ]
    if not pieces:
        return None
    edges = np.arange(count + 1) * width / rate
    whitening = known.whitening(edges[:-1], edges[1:])
    wave = np.cos(np.pi / count * np.outer(np.arange(count) + 0.5, np.arange(count)))
    few = (count - _TREND) // 4
    sums = np.zeros((2, len(pieces), 3))
    for axis in range(3):
        # in order of frequency
        basis = np.linalg.qr(whitening[axis] @ wave)[0][:, _TREND:]
        squares = (basis.T @ whitening[axis] @ np.stack(pieces)[..., axis].T) ** 2
        sums[:, :, axis] = squares[:few].sum(axis=0), squares[few:].sum(axis=0)
    return [
        (part.sum(axis=0), freedom * len(pieces), np.median(part, axis=0) / chi2_median(freedom))
        for part, freedom in zip(sums, (few, count - _TREND - few), strict=True)
    ]


def _scaled(known: AxisNoise, ratio: FloatArray, length: float) -> AxisNoise:
    """Return the noise with variances of what is quicker than `length` (s) times `ratio` (3,)."""
    quick = known.correlation_time < length
    variance = np.where(quick, known.variance * ratio[:, None], known.variance)
    return replace(known, white=known.white * ratio, quantisation=known.quantisation * ratio, variance=variance)


def _with_own(known: AxisNoise, parts: list[FloatArray], rate: float, length: float) -> AxisNoise:
    """Return the noise with what is quicker than `length` (s) taken from the still parts."""
    samples = round(length * rate)
    bank = fit_bank(np.stack([part[:samples].T for part in parts if len(part) >= samples]), rate)
    quick, slow = bank.correlation_time < length, known.correlation_time >= length
    return AxisNoise(
        bank.white,
        bank.quantisation,
        np.concatenate([bank.variance[:, quick], known.variance[:, slow]], axis=1),
        np.concatenate([bank.correlation_time[quick], known.correlation_time[slow]]),
        known.duration,
    )


def _slow_units(known: AxisNoise, duration: float) -> dict[str, AxisNoise]:
    """Return slow noise of either kind, as large as white noise is over the recording (for its scale)."""
    size = (known.integrated([1.0])[0] * 2 / duration)[:, None]

    def of(times: FloatArray, variance: FloatArray) -> AxisNoise:
        return AxisNoise(np.zeros(3), np.zeros(3), size * variance, times)

    # flicker noise is alike in every octave; a random walk is a slow process with the growth 2σ²/τ
    times = np.asarray(4.0 * duration / 4.0 ** np.arange(int(np.log(2.0 * duration) / np.log(4.0))), np.float64)
    longest = np.array([_LONG * duration], np.float64)
    return {
        "noise.bias_instability": of(times, np.ones(len(times))),
        "noise.rate_random_walk": of(longest, longest / duration),
    }


def _joined(known: AxisNoise, more: AxisNoise) -> AxisNoise:
    return replace(
        known,
        variance=np.concatenate([known.variance, more.variance], axis=1),
        correlation_time=np.concatenate([known.correlation_time, more.correlation_time]),
    )


def _parted(evidence: Evidence, added: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the sizes (k,) of a whitened covariance (n, n) off the base, and the residual's squares (k,) along it."""
    sizes, vectors = np.linalg.eigh(evidence.off_base(evidence.off_base(added).T))
    keep = sizes > 1e-12 * sizes[-1]
    return sizes[keep], (vectors[:, keep].T @ evidence.residual) ** 2


def _variance(sizes: FloatArray, squares: FloatArray, freedom: int) -> tuple[float, float, float]:
    """Return the likeliest multiple of a covariance, its relative standard deviation, and 2 ln L − ln dof against none.

    Zero where none is likeliest.
    """

    def cost(log_strength: float) -> float:
        whole = 1 + np.exp(log_strength) * sizes
        return float(0.5 * np.sum(np.log(whole) + squares / whole))

    middle = -np.log(sizes[-1])
    best = scipy.optimize.minimize_scalar(cost, bounds=(middle - 12, middle + 20), method="bounded")
    strength, gained = float(np.exp(best.x)), 2 * (0.5 * float(np.sum(squares)) - best.fun)
    if gained <= 0:
        return 0.0, 0.0, 0.0
    information = 0.5 * float(np.sum((strength * sizes / (1 + strength * sizes)) ** 2))
    return strength, 1 / np.sqrt(information), gained - float(np.log(freedom))


def quadratic_tail(value: float, sizes: FloatArray) -> float:
    """Return the probability that Σ b_j z_j² of standard normal z exceeds a value, b_j > 0 the `sizes` (k,).

    Saddlepoint approximation (Kuonen, Biometrika 86, 1999), good to a few per cent of itself in the far tail.
    """
    mean = float(np.sum(sizes))
    bracket = (0.0, 0.5 / float(sizes.max()) * (1 - 1e-12)) if value > mean else (-0.5 * len(sizes) / value, 0.0)
    t = scipy.optimize.root_scalar(lambda t: np.sum(sizes / (1 - 2 * t * sizes)) - value, bracket=bracket).root
    cumulant = -0.5 * float(np.sum(np.log1p(-2 * t * sizes)))
    curvature = 2 * float(np.sum((sizes / (1 - 2 * t * sizes)) ** 2))
    w, v = np.sign(t) * np.sqrt(2 * max(t * value - cumulant, 0.0)), t * np.sqrt(curvature)
    return float(normal_sf(w + np.log(v / w) / w)) if abs(w) > 1e-3 else 0.5


def _criterion(evidence: Evidence, selection: Selection) -> float:
    """Return S − q ln(dof) of the causes selected, and −2 ln of the number of places for one of many."""
    blocks = [cause.block for cause in selection.causes]
    statistic = (
        float(evidence.residual @ evidence.columns[:, evidence.span(blocks)] @ evidence.coefficients(blocks))
        / selection.scores.unit**2
    )
    places = [
        sum(other.name == evidence.blocks[k].name for other in evidence.blocks) if evidence.blocks[k].position else 1
        for k in blocks
    ]
    numbers = sum(
        len(evidence.blocks[k].sizes) + (not evidence.blocks[k].position) * len(evidence.blocks[k].inner)
        for k in blocks
    )
    return statistic - numbers * float(np.log(evidence.freedom)) - 2 * float(np.sum(np.log(places)))
