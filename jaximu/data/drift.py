"""Slow drift of the biases, which poses cannot show but what lies between them does, as variance components.

Bias instability and random walk of each triad tie the means at rest, the norms and the turns of a recording together.
Their sizes are estimated by restricted likelihood, with what is known of the class of sensor as a prior.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from jaximu.data.poses_covariance import Sensitivities
from jaximu.estimation.covariance import Chain, Covariance
from jaximu.estimation.data import OutputMeans
from jaximu.estimation.fitting import Fit, unwhitened
from jaximu.estimation.leave_out import orthonormal
from jaximu.estimation.problem import Name
from jaximu.estimation.track import TRIADS
from jaximu.ground.array_types import BoolArray, FloatArray, IntArray
from jaximu.ground.quantities import size
from jaximu.ground.vectors import submatrix, variances_of
from jaximu.model.noise_model import AxisNoise, NoiseModel
from jaximu.model.processes import RATIO, correlation_times
from jaximu.recordings.observations import Observations
from jaximu.recordings.segmentation import Segmentation

_POWER_ON = "power-on"
USUAL_DRIFT = {"bias instability": (0.4, 1.2), "random walk": (0.1, 1.0), _POWER_ON: (5.0, 1.5)}
"""Median of each kind's standard deviation and the spread of its logarithm, of MEMS sensors: bias instability B over
white noise N, in 1/√s; and over N √(1/s) what a random walk gains over the recording, and what a bias changes by from
one power-on to the next, which is a few milligravity."""
_USUAL_EXCESS = 0.3, 2.0
"""The same of what scatters from pose to pose and from turn to turn, over the noise within them: next to nothing is
known beforehand."""
_ROUNDING = 1e-6
"""Of a bias's variance: less cannot be left where two nearly equal numbers are taken from one another."""
DRIFT_ESTIMATED = (
    "No recording at rest: noise and bias drift were estimated from this recording's rests. A recording at rest "
    "(--static LOG) would determine them better."
)
"""What is said where drift was estimated from the recording itself."""
_ASSUMED = (
    "Noise was estimated from the poses of this recording. Poses cannot show slow drift of the bias, so a typical "
    "drift was assumed; add --static LOG to measure it."
)
_FOREVER = 1e9
"""Correlation time (s) of a bias that is the same through a recording."""
_LONGEST = 4.0
"""Correlation time of a random walk's stand-in, in lengths of the recording."""
_SLOWEST = 16.0
"""Correlation time of the slowest part of flicker noise: what is slower still changes a recording by a hundredth."""
_STEPS, _STILL, _FARTHEST = 60, 3e-3, 3.0
"""Steps of a size's logarithm: how many at most, what ends them, and the longest."""


def slow_units(known: AxisNoise, shortest: float, duration: float) -> dict[str, AxisNoise]:
    """Return the slow noise of a triad at a size of one: bias instability and random walk, as `USUAL_DRIFT` has them.

    Flicker noise of bias instability B has the variance B² ln(r)/π in each of Gauss–Markov processes whose correlation
    times stand r apart, from `shortest` (s) on; a random walk is one slow process with the growth 2σ²/τ.
    """
    white = known.covariance([0.0], [1.0])[:, 0]
    times = correlation_times(shortest, max(_SLOWEST * duration, shortest))
    longest = np.array([_LONGEST * duration])

    def of(times: FloatArray, variance: FloatArray) -> AxisNoise:
        return AxisNoise(np.zeros(3), np.zeros(3), white * variance, np.asarray(times, np.float64))

    return {
        "bias instability": of(times, np.full(len(times), np.log(RATIO) / np.pi)),
        "random walk": of(longest, longest / (2 * duration)),
    }


def with_noise(noise: NoiseModel, triad: str, more: AxisNoise) -> NoiseModel:
    """Return a noise model with further slow noise of a triad."""
    known = getattr(noise, triad)
    variance = np.hstack([known.variance, more.variance])
    times = np.concatenate([known.correlation_time, more.correlation_time])
    return replace(noise, **{triad: replace(known, variance=variance, correlation_time=times)})


def with_usual_drift(noise: NoiseModel, shortest: float, duration: float) -> NoiseModel:
    """Return a noise model with the drift that is usual of MEMS sensors, slower than `shortest` (s)."""
    for triad in TRIADS:
        known = getattr(noise, triad)
        for name, unit in slow_units(known, shortest, duration).items() if known is not None else ():
            noise = with_noise(noise, triad, replace(unit, variance=USUAL_DRIFT[name][0] ** 2 * unit.variance))
    return replace(noise, notes=(*noise.notes, _ASSUMED))


def power_on_text(units: Mapping[str, AxisNoise], sizes: Mapping[str, float]) -> list[str]:
    """Say how a bias changes from recording to recording, where it does; `sizes` of the drifts `units`, by name."""
    changes = {
        name.removesuffix(_POWER_ON): size(sizes[name] * float(np.sqrt(unit.variance.mean())), "m/s^2", 2)
        for name, unit in units.items()
        if name.endswith(_POWER_ON)
    }
    return [
        f"Between the recordings the {triad.strip()}'s bias changes by about {change} (standard deviation), as it does "
        "when the power is switched on; the calibration has that of the first."
        for triad, change in changes.items()
    ]


def with_drift(
    fitted: Fit, covariance: Covariance | Chain, means: OutputMeans, noise: NoiseModel | None = None
) -> tuple[Fit, dict[str, FloatArray], tuple[str, ...]]:
    """Return a fit of one unit about its biases after the recording, sigmas of those in it, and what was estimated.

    The fit's weights know what `covariance`, of its conditions, knows, and the excess. Its estimate is linear in the
    conditions to first order, T = N⁻¹JᵀW, so that its covariance changes by T ΔC Tᵀ, ΔC what the conditions'
    covariance changes by once drift and excess are estimated together. `fitted`: of a linear loss; `noise`: what is
    known of the drift, and is in `covariance`; else it is estimated. The sigmas are as `about_biases` has them.
    """
    residual, jacobian = unwhitened(fitted, covariance)
    whole, excess = covariance.dense(), np.asarray(fitted.excess)
    used = whole.used > 0
    weighted = submatrix(whole.total(excess), used)
    total, sizes = np.asarray(fitted.covariance, np.float64), np.asarray(fitted.sizes)
    by_conditions = np.zeros((len(total), len(used)))
    by_conditions[:, used] = -total / sizes @ np.linalg.solve(weighted, jacobian[used]).T
    sentences: tuple[str, ...] = ()
    if noise is None:
        present = [submatrix(whole.component(k), used) for k in range(len(excess)) if (whole.group[used] == k).any()]
        bare = submatrix(whole.measured, used)
        estimated = estimated_drift(residual[used], jacobian[used], bare, present, means, used)
        total = total + by_conditions[:, used] @ (estimated.covariance - weighted) @ by_conditions[:, used].T
        noise, sentences = estimated.noise, estimated.notes
    total, sigmas = about_biases(fitted.names, total, by_conditions, means, noise)
    return replace(fitted, covariance=total), sigmas, sentences


class EstimatedDrift(NamedTuple):
    """The noise of a unit, drift included, as conditions of it show it; their covariance (n, n) then; and sentences.

    excess (k,): variances of each component of the excess, in multiples of it.
    """

    noise: NoiseModel
    covariance: FloatArray
    excess: FloatArray
    notes: tuple[str, ...]


def estimated_drift(
    residual: FloatArray,
    jacobian: FloatArray,
    measured: FloatArray,
    excess: Sequence[FloatArray],
    means: OutputMeans,
    used: BoolArray | slice = slice(None),
) -> EstimatedDrift:
    """Return the drift of biases that conditions show, estimated together with the excess of their noise.

    **Arguments:** `residual` (n,), `jacobian` (n, p) by what is fitted beside, `measured` (n, n): their covariance by
    the noise alone; `excess`: components (n, n) of what goes beyond; `used`: which of the conditions of `means` they
    are.
    """
    drifts, components = drift_components(means.noise, means)
    components = np.stack([*excess, *components[:, used][:, :, used]])
    priors = [_USUAL_EXCESS] * len(excess) + [USUAL_DRIFT[name.partition(" ")[2]] for name in drifts]
    log_size, _ = restricted_likelihood(residual, jacobian, measured, components, *_beforehand(priors))
    drift_sizes = dict(zip(drifts, np.exp(log_size[len(excess) :] / 2), strict=True))
    covariance = measured + np.einsum("k,kij->ij", np.exp(log_size), components)
    notes = DRIFT_ESTIMATED, *power_on_text(drifts, drift_sizes)
    noise = drifting(means.noise, drifts, drift_sizes)
    return EstimatedDrift(noise, covariance, np.exp(log_size[: len(excess)]), notes)


def drifting(noise: NoiseModel, drifts: Mapping[str, AxisNoise], sizes: Mapping[str, float]) -> NoiseModel:
    """Return a noise model with drifts, by name, of these standard deviations relative to their own."""
    for name, unit in drifts.items():
        noise = with_noise(noise, name.partition(" ")[0], replace(unit, variance=sizes[name] ** 2 * unit.variance))
    return noise


def about_biases(
    names: Sequence[Name], covariance: FloatArray, by_conditions: FloatArray, means: OutputMeans, noise: NoiseModel
) -> tuple[FloatArray, dict[str, FloatArray]]:
    """Return the covariance (p, p) about the biases after the recording, and the sigmas (3,) about those in it.

    A bias that drifts is one number only as a mean over a time: over the recording, or over as long again after it
    (the first of several). With d the drift in the mean outputs, t its mean over that time and S = −T R how the
    numbers react to the outputs, a number is off by S d − t, t for a bias alone:
    S C Sᵀ − S c eᵀ − e cᵀ Sᵀ + e v eᵀ, C of d, c of d and t, v of t; the first term is in `covariance` (p, p), which is
    about a bias that its process has in the mean. **Arguments:** `by_conditions` (p, n): how the numbers react to the
    conditions; `noise`: what drifts. Sigmas are by triad, in output units, of the triads whose biases are free.
    """
    first_one = means.recording == means.recording[0]
    begin, end = means.start[first_one].min(), means.stop[first_one].max()
    start, stop = np.append(means.start, [begin, end]), np.append(means.stop, [end, 2 * end - begin])
    during, after = np.array(covariance), np.array(covariance)
    known = {triad: getattr(noise, triad) for triad in means.reactions}
    slow = {triad: one.drift().covariance(start, stop) for triad, one in known.items() if one}
    biases: dict[str, list[int]] = {triad: [] for triad in slow}
    for row, name in enumerate(names):
        if name.part != "bias" or name.effect is not None or name.owner not in slow:
            continue
        biases[name.owner].append(row)
        (axis,) = name.axes
        of_times = means.scale[name.owner][axis] ** 2 * slow[name.owner][axis]
        by_outputs = by_conditions @ means.reactions[name.owner][:, :, axis]
        for kept, time in ((during, -2), (after, -1)):
            across = by_outputs @ (first_one * of_times[:-2, time])
            kept[:, row] -= across
            kept[row] -= across
            kept[row, row] += of_times[time, time]
    variances = np.maximum(np.diag(during), _ROUNDING * np.diag(after))
    return after, {triad: np.sqrt(variances[rows]) for triad, rows in biases.items() if rows}


def _beforehand(priors: Sequence[tuple[float, float]]) -> tuple[FloatArray, FloatArray]:
    """Return mean and spread (k,) of the logarithms of variances from medians and spreads of standard deviations."""
    median, spread = np.array(priors).T
    return 2 * np.log(median), 2 * spread


def drift_components(
    noise: NoiseModel, means: OutputMeans, within: bool = True
) -> tuple[dict[str, AxisNoise], FloatArray]:
    """Return drifts by name, at a size of one, and the covariance (k, n, n) of all conditions that each adds.

    Sizes are relative to what `noise` does in a second. Between recordings nothing is carried over, and of several the
    accelerometer's bias is another in each; the gyroscope's is measured at rest and was taken off. `within`: false
    where `noise` knows the drift in a recording.
    """
    start, stop, which = means.start, means.stop, means.recording
    parts = [which == number for number in np.unique(which)]
    duration = max(float(stop[part].max() - start[part].min()) for part in parts)
    units: dict[str, AxisNoise] = {}
    covariances = [np.zeros((0, *[len(rows) for rows in means.reactions.values()][:1] * 2))]
    for triad, by_output in means.reactions.items():
        known = getattr(noise, triad)
        drifts = slow_units(known, float(np.median(stop - start)), duration) if known and within else {}
        if known and len(parts) > 1 and triad == "accelerometer":
            # another bias in every recording, at a size of one, as `USUAL_DRIFT` has it
            drifts[_POWER_ON] = AxisNoise(
                np.zeros(3), np.zeros(3), known.covariance([0.0], [1.0])[:, 0], np.array([_FOREVER])
            )
        for kind, unit in drifts.items():
            slow = (means.scale[triad] ** 2)[:, None, None] * unit.covariance(start, stop)
            slow *= which[:, None] == which
            units[f"{triad} {kind}"] = unit
            covariances.append(np.einsum("npi,ipq,mqi->nm", by_output, slow, by_output, optimize=True)[None])
    return units, np.concatenate(covariances)


def means_by_hand(
    observations: Observations, segmentations: Sequence[Segmentation], reaction: Sensitivities
) -> OutputMeans:
    """Return the mean outputs in the poses. A gyroscope's bias in a turn is taken to be the mean of its neighbours'."""
    poses = observations.poses
    real = np.flatnonzero(poses.mask)
    scales = {name: signal.nominal_scale for name, signal in segmentations[0].recording.signals.items()}
    reactions = {
        name: rows[:, real]
        for name, rows in zip(TRIADS, mean_output_reactions(reaction), strict=True)
        if name in scales
    }
    scatter = {name: np.asarray(getattr(poses, f"{name}_covariance"))[real] for name in reactions}
    variances = {name: variances_of(covariance) for name, covariance in scatter.items()}
    start, stop = np.asarray(poses.start)[real], np.asarray(poses.stop)[real]
    return OutputMeans.of(start, stop, recordings_of_poses(segmentations)[real], reactions, scales, variances)


def recordings_of_poses(segmentations: Sequence[Segmentation]) -> IntArray:
    """Return the place (P,) of the recording that each pose is of."""
    counts = [len(part.intervals) for part in segmentations]
    return np.arange(len(counts)).repeat(counts)


def mean_output_reactions(reaction: Sensitivities) -> tuple[FloatArray, FloatArray]:
    """Return how all conditions react to the mean outputs (n, P, 3) of both triads.

    A gyroscope's output that is off in a pose is taken to be off by the mean of its neighbours in the turn between.
    """
    norm, after, before, turn = map(np.asarray, (reaction.norm, reaction.after, reaction.before, reaction.turn))
    poses = len(norm)
    at_rest = poses + 2 * (poses - 1)
    by_force, by_rate = np.zeros((2, at_rest + 3 * poses, poses, 3))
    pose, step = np.arange(poses)[:, None], np.arange(poses - 1)[:, None]
    by_force[pose, pose] = norm[:, None]
    rows = poses + 2 * step + np.arange(2)
    by_force[rows, step + 1], by_force[rows, step] = after, before
    by_rate[rows, step + 1] = by_rate[rows, step] = turn.sum(axis=2) / 2
    by_rate[at_rest + 3 * pose + np.arange(3), pose] = np.eye(3)
    return by_force, by_rate


def restricted_likelihood(
    residual: FloatArray,
    jacobian: FloatArray,
    bare: FloatArray,
    components: FloatArray,
    mean: FloatArray,
    spread: FloatArray,
) -> tuple[FloatArray, FloatArray]:
    """Return the log sizes (k,) that are likeliest a posteriori, and their covariance (k, k).

    Of residual (n,) with derivatives (n, p) by what is fitted beside, covariance `bare` (n, n) and `components`
    (k, n, n) at a size of one; the log sizes have `mean` and `spread` (k,) beforehand. With
    P = C⁻¹ − C⁻¹J(JᵀC⁻¹J)⁻¹JᵀC⁻¹ the restricted likelihood, −½ (rᵀPr + log |C| + log |JᵀC⁻¹J|), has by a size v_i the
    gradient ½ (rᵀPV_iPr − tr PV_i) and the information ½ tr PV_iPV_j (Förstner and Wrobel, Photogrammetric Computer
    Vision, 2016, sec. 4.2.4); by its logarithm both gain factors of v_i, and the curvature loses the gradient. On the
    way ½ rᵀPV_iPV_jPr serves as the information, which takes no product of matrices (Gilmour, Thompson and Cullis,
    Biometrics 51, 1995); a step that does not lead higher is shortened.
    """
    jacobian = orthonormal(jacobian)
    known = 1 / spread**2

    def at(log_size: FloatArray) -> tuple[float, FloatArray, FloatArray]:
        """Return the logarithm of the probability, P, and the sizes."""
        sizes = np.exp(log_size)
        projector, volume = _projector(bare + np.tensordot(sizes, components, 1), jacobian)
        off = log_size - mean
        return float(-0.5 * (residual @ projector @ residual + volume + known @ off**2)), projector, sizes

    log_size = mean.copy()
    best, projector, sizes = at(log_size)
    for _ in range(_STEPS):
        pulled = projector @ residual
        reached = sizes[:, None] * (components @ pulled)
        slope = 0.5 * (reached @ pulled - sizes * np.tensordot(components, projector, 2))
        curvature = 0.5 * reached @ projector @ reached.T + np.diag(known + np.maximum(-slope, 0.0))
        step = np.linalg.solve(curvature, slope - known * (log_size - mean))
        step /= max(1.0, float(abs(step).max()) / _FARTHEST)
        while abs(step).max() > _STILL:
            value, *there = at(log_size + step)
            if value >= best:
                break
            step /= 4
        else:
            break
        best, log_size, (projector, sizes) = value, log_size + step, there
    parts = sizes[:, None, None] * (projector @ components)
    information = 0.5 * np.einsum("kij,lji->kl", parts, parts) + np.diag(known)
    return log_size, np.asarray(np.linalg.inv(information), np.float64)


def _projector(covariance: FloatArray, jacobian: FloatArray) -> tuple[FloatArray, float]:
    """Return P = C⁻¹ − C⁻¹J(JᵀC⁻¹J)⁻¹JᵀC⁻¹ and log |C| + log |JᵀC⁻¹J|."""
    root = np.linalg.cholesky(covariance)
    white = np.linalg.inv(root)
    basis = white @ jacobian
    inner = np.linalg.cholesky(basis.T @ basis)
    volume = 2 * float(np.log(np.diagonal(root)).sum() + np.log(np.diagonal(inner)).sum())
    across = np.linalg.solve(inner, basis.T @ white)
    return white.T @ white - across.T @ across, volume
