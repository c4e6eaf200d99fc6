"""Slow drift of the biases, which poses cannot show but what lies between them does, as variance components.

Bias instability and random walk of each triad tie the means at rest, the norms and the turns of a recording together.
Their sizes are estimated by restricted likelihood, with what is known of the class of sensor as a prior.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from jaximu.data.poses import condensed, with_gyroscope
from jaximu.data.poses_covariance import Sensitivities
from jaximu.data.rest_blocks import RATIO, correlation_times
from jaximu.estimation.fitting import Fit, unwhitened
from jaximu.estimation.leave_out import orthonormal
from jaximu.estimation.track import TRIADS
from jaximu.ground.array_types import FloatArray
from jaximu.ground.quantities import size
from jaximu.ground.tracing import first, lifted
from jaximu.model.noise_model import AxisNoise, NoiseModel
from jaximu.recordings.observations import Observations
from jaximu.recordings.recording import Recording, Signal
from jaximu.recordings.segmentation import Segmentation

__all__ = [
    "DRIFT_ESTIMATED",
    "USUAL_DRIFT",
    "drift_components",
    "mean_output_reactions",
    "power_on_text",
    "restricted_likelihood",
    "slow_units",
    "with_drift",
    "with_noise",
    "with_usual_drift",
]

_POWER_ON = "power-on"
USUAL_DRIFT = {"bias instability": (0.4, 1.2), "random walk": (0.1, 1.0), _POWER_ON: (5.0, 1.5)}
"""Median of each kind's standard deviation and the spread of its logarithm, of MEMS sensors: bias instability B over
white noise N, in 1/√s; and over N √(1/s) what a random walk gains over the recording, and what a bias changes by from
one power-on to the next, which is a few milligravity."""
_USUAL_EXCESS = 0.3, 2.0
"""The same of what scatters from pose to pose and from turn to turn, over the noise within them: next to nothing is
known beforehand."""
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


def _power_on(known: AxisNoise) -> AxisNoise:
    """Return a triad's bias that is another in every recording, at a size of one, as `USUAL_DRIFT` has it."""
    return AxisNoise(np.zeros(3), np.zeros(3), known.covariance([0.0], [1.0])[:, 0], np.array([_FOREVER]))


def with_noise(noise: NoiseModel, triad: str, more: AxisNoise) -> NoiseModel:
    """Return a noise model with further slow noise of a triad."""
    known = getattr(noise, triad)
    variance = np.concatenate([known.variance, more.variance], axis=1)
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
        name.removesuffix(_POWER_ON): size(sizes[name] * float(np.sqrt(np.mean(unit.variance))), "m/s^2", 2)
        for name, unit in units.items()
        if name.endswith(_POWER_ON)
    }
    return [
        f"Between the recordings the {triad.strip()}'s bias changes by about {change} (standard deviation), as it does "
        "when the power is switched on; the calibration has that of the first."
        for triad, change in changes.items()
    ]


def with_drift(
    fitted: Fit, observations: Observations, segmentations: Sequence[Segmentation]
) -> tuple[Fit, tuple[str, ...]]:
    """Return a fit of one unit whose covariance knows how the biases drift, and what was estimated, in sentences.

    The fit's weights know white noise and the excess alone. Its estimate is linear in the conditions to first order,
    T = N⁻¹JᵀW, so its covariance changes by T ΔC Tᵀ, ΔC what the conditions' covariance changes by once drift and
    excess are estimated together. `fitted`: of a linear loss, to poses and turns or to poses alone; `observations`:
    with what its effects add taken off.
    """
    rows = "all" if "gyroscope" in fitted.imu.triads() else "norm"
    about = condensed(*lifted((with_gyroscope(fitted.imu).with_effects(), observations)), rows)
    assert about.reaction is not None
    chain = first(about.covariance)
    residual, jacobian = unwhitened(fitted, chain)
    covariance = chain.dense()
    used = covariance.used > 0
    bare = covariance.measured[np.ix_(used, used)]
    present = [k for k in range(len(covariance.factors)) if np.any(covariance.group[used] == k)]
    excess = [covariance.component(k)[np.ix_(used, used)] for k in present]
    weighted = bare + np.einsum("k,kij->ij", np.asarray(fitted.excess)[present], np.stack(excess))
    noise = _noise_of_scatter(observations, segmentations[0].recording)
    drifts, components = drift_components(noise, observations, segmentations, about.reaction)
    priors = [_USUAL_EXCESS] * len(excess) + [USUAL_DRIFT[name.partition(" ")[2]] for name in drifts]
    components = np.concatenate([np.stack(excess), components[:, used][:, :, used]])
    log_size, _ = restricted_likelihood(residual[used], jacobian[used], bare, components, *_beforehand(priors))
    changed = bare + np.einsum("k,kij->ij", np.exp(log_size), components) - weighted
    sizes = np.asarray(fitted.sizes)
    react = np.asarray(fitted.covariance) / sizes @ np.linalg.solve(weighted, jacobian[used]).T
    drift_sizes = dict(zip(drifts, np.exp(log_size[len(excess) :] / 2), strict=True))
    total = np.asarray(fitted.covariance) + react @ changed @ react.T
    return replace(fitted, covariance=total), (DRIFT_ESTIMATED, *power_on_text(drifts, drift_sizes))


def _beforehand(priors: Sequence[tuple[float, float]]) -> tuple[FloatArray, FloatArray]:
    """Return mean and spread (k,) of the logarithms of variances from medians and spreads of standard deviations."""
    median, spread = np.array(priors).T
    return 2 * np.log(median), 2 * spread


def _noise_of_scatter(observations: Observations, recording: Recording) -> NoiseModel:
    """Return white noise as the scatter in the poses tells it."""
    poses = observations.poses
    real = poses.mask
    duration = (poses.stop - poses.start)[real]

    def white(signal: Signal, covariance) -> AxisNoise:
        scatter = np.diagonal(covariance[real], axis1=1, axis2=2) / np.square(signal.nominal_scale)
        return AxisNoise.of_white(np.mean(scatter * duration[:, None], axis=0))

    gyroscope = recording.gyroscope
    return NoiseModel(
        white(recording.accelerometer, poses.accelerometer_covariance),
        None if gyroscope is None else white(gyroscope, poses.gyroscope_covariance),
    )


def drift_components(
    noise: NoiseModel,
    observations: Observations,
    segmentations: Sequence[Segmentation],
    reaction: Sensitivities,
    within: bool = True,
) -> tuple[dict[str, AxisNoise], FloatArray]:
    """Return drifts by name, at a size of one, and the covariance (k, n, n) of all conditions that each adds.

    Sizes are relative to what `noise` does in a second. Between recordings nothing is carried over, and of several the
    accelerometer's bias is another in each; the gyroscope's is measured at rest and was taken off. A gyroscope's bias
    in a turn is taken to be the mean of its neighbours'. `within`: false where `noise` knows the drift in a recording.
    """
    poses = observations.poses
    real = np.flatnonzero(poses.mask)
    start, stop = poses.start[real], poses.stop[real]
    counts = [len(part.intervals) for part in segmentations]
    which = np.repeat(np.arange(len(counts)), counts)
    duration = max(float(part.intervals[-1, 1] - part.intervals[0, 0]) for part in segmentations)
    reactions = mean_output_reactions(reaction)
    units, covariances = {}, [np.zeros((0, *[len(reactions[0])] * 2))]
    for triad, output_reaction in zip(TRIADS, reactions, strict=True):
        known, by_output = getattr(noise, triad), output_reaction[:, real]
        drifts = slow_units(known, float(np.median(stop - start)), duration) if known and within else {}
        if known and len(segmentations) > 1 and triad == "accelerometer":
            drifts[_POWER_ON] = _power_on(known)
        for kind, unit in drifts.items():
            scale = segmentations[0].recording.signals[triad].nominal_scale
            slow = np.square(scale)[:, None, None] * unit.covariance(start, stop)
            slow *= which[:, None] == which
            units[f"{triad} {kind}"] = unit
            covariances.append(np.einsum("npi,ipq,mqi->nm", by_output, slow, by_output, optimize=True)[None])
    return units, np.concatenate(covariances)


def mean_output_reactions(reaction: Sensitivities) -> tuple[FloatArray, FloatArray]:
    """Return how all conditions react to the mean outputs (n, P, 3) of both triads.

    A gyroscope's output that is off in a pose is taken to be off by the mean of its neighbours in the turn between.
    """
    norm, after, before, turn = map(np.asarray, (reaction.norm, reaction.after, reaction.before, reaction.turn))
    poses = len(norm)
    conditions = poses + 2 * (poses - 1) + 3 * poses
    by_force, by_rate = np.zeros((conditions, poses, 3)), np.zeros((conditions, poses, 3))
    pose, step = np.arange(poses), np.arange(poses - 1)
    by_force[pose, pose] = norm
    half = turn.sum(axis=2) / 2
    for component in range(2):
        rows = poses + 2 * step + component
        by_force[rows, step + 1] = after[:, component]
        by_force[rows, step] = before[:, component]
        by_rate[rows, step + 1] = by_rate[rows, step] = half[:, component]
    rest = poses + 2 * (poses - 1) + 3 * pose[:, None] + np.arange(3)
    by_rate[rest, pose[:, None]] = np.eye(3)
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
        step /= max(1.0, float(np.max(np.abs(step))) / _FARTHEST)
        while np.max(np.abs(step)) > _STILL:
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
    volume = 2 * float(np.sum(np.log(np.diagonal(root))) + np.sum(np.log(np.diagonal(inner))))
    across = np.linalg.solve(inner, basis.T @ white)
    return white.T @ white - across.T @ across, volume
