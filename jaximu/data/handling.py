"""What hands add to a recording: poses that are not quite still, and turns that are too quick for the sample rate.

Both are seen in the samples, before anything is fitted, and neither is an effect of the unit. How much each pose and
each turn may be off by them is a variance; one size for each kind is estimated with the drift of the biases.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from jaximu.estimation.data import Handling
from jaximu.ground.array_types import FloatArray
from jaximu.ground.distributions import rms
from jaximu.ground.rotation import rotate
from jaximu.ground.vectors import dot_rows, lengths_of, sigmas_of
from jaximu.model.noise_model import AxisNoise, NoiseModel
from jaximu.model.sensor import Imu, Triad
from jaximu.recordings.finding import Finding
from jaximu.recordings.observations import Observations, Turns
from jaximu.recordings.segmentation import Segmentation

_SHORT = 0.25  # s
_SURE = 5.0
"""Standard deviations by which a pose must tilt to be called moving."""
_BOUND = 3.0
"""Standard deviations that one pose counts for at most, where it is asked whether poses move."""
_MANY = 0.2
"""Share of the turns that must be too quick for it to be said."""


def handling(
    segmentations: Sequence[Segmentation],
    observations: Observations,
    imu: Imu,
    running: FloatArray | None,
    noise: NoiseModel,
) -> Handling:
    """Measure how still the poses of a recording are, and how well its turns are sampled, at a unit close to it.

    A pose whose specific force turns from direction u₁ in its first half to u₂ in its second tilts by Δu × u per half
    its length: the gyroscope feels that rate, along gravity about as much, and the turns before and after begin off
    the pose's mean direction. Of a turn, Σ (−1)^i R_i ω_i Δt is what the rotations from every other sample differ by,
    halved: where sampling is dense enough it is noise. `running` (T, S, 4): the turns' rotations after each sample.
    """
    poses, turns = observations.poses, observations.turns
    count = len(poses.mask)
    tilting, spread = np.zeros(count), np.full(count, np.inf)
    tilts, sigma = _tilts(segmentations, imu, noise.accelerometer)
    tilting[: len(tilts)], spread[: len(tilts)] = lengths_of(tilts), sigma
    excess = np.maximum(tilting**2 - 2 * np.where(np.isfinite(spread), spread, 0.0) ** 2, 0.0)
    off = excess / 2 * ((poses.stop - poses.start) / 2) ** 2
    gyroscope = imu.triad("gyroscope")
    assert noise.gyroscope is not None
    rest = np.outer(excess / 2, gyroscope.scales**2)
    moving = np.concatenate([np.zeros(count), (off[:-1] + off[1:]).repeat(2), rest.ravel()])

    turned = missed_by_sampling(turns, gyroscope, np.asarray(running))
    known = float(noise.gyroscope.split(_SHORT)[0].mean()) * turns.interval.sum(axis=1)
    missed = (turned**2).sum(axis=1) - 3 * known
    missed = np.where(turns.mask, np.maximum(missed, 0.0), 0.0)
    sampling = np.pad((missed / 3).repeat(2), (count, 3 * count))
    return Handling(moving, sampling, np.sqrt(excess), spread, np.sqrt(missed), np.sqrt(known))


def sway(segmentations: Sequence[Segmentation], imu: Imu, noise: NoiseModel) -> list[Finding]:
    """Return whether hands turn the unit in its poses: both sensors agree on it, whose noises are independent.

    A pose's second half is turned against its first by the rates, weighted by a triangle, and the accelerometer sees
    gravity turn by as much. Along the direction that the rates say, what it sees of a pose at rest is standard normal.
    """
    turned = []
    for part in segmentations:
        gyroscope = part.recording.signals["gyroscope"]
        rate = imu.triad("gyroscope").recover_on_host(gyroscope.values)
        for start, stop in part.intervals:
            inside = (gyroscope.time >= start) & (gyroscope.time < stop)
            weight = 1 - abs(2 * (gyroscope.time[inside] - start) / (stop - start) - 1)
            turned.append(weight @ rate[inside] / max(float(weight.sum()), 1e-12))
    tilts, sigma = _tilts(segmentations, imu, noise.accelerometer)
    rates = np.array(turned) - np.median(turned, axis=0)
    both = dot_rows(tilts, rates)
    along = both / np.maximum(lengths_of(rates), 1e-300) / sigma
    along = along.clip(-_BOUND, _BOUND)  # one pose that was bumped is not all
    if along.sum() < _SURE * np.sqrt(len(along)):
        return []
    size = np.degrees(np.sqrt(max(1.5 * float(np.median(both)), 0.0)))
    return [
        Finding(
            "data.moving_pose",
            (),
            f"The unit is not still in its poses: both sensors see it sway, by about {size:.1g} °/s. What that adds to "
            "their noise was taken from the poses themselves. Put the unit down, or hold it against something solid.",
        )
    ]


def bend(turns: Turns) -> FloatArray:
    """Return a 24th of the second differences (T, S, 3) of the turns' samples: what means have over instants.

    The mean over an interval h is the rate in its middle and h²/24 of its second derivative, which over a turn about a
    moving axis does not vanish.
    """
    output, inside = turns.output, turns.interval > 0
    bent = np.zeros(output.shape)
    bent[:, 1:-1] = (output[:, 2:] - 2 * output[:, 1:-1] + output[:, :-2]) * inside[:, 2:, None] / 24
    return bent


def moved_by_hand(
    segmentations: Sequence[Segmentation], observations: Observations, imu: Imu, hands: Handling, undersampling: float
) -> list[Finding]:
    """Return the poses that move, and the turns that are too quick; `undersampling`: share of what samples miss."""
    findings = []
    poses = observations.poses
    start, stop = poses.start, poses.stop
    noise = rms(sigmas_of(poses.gyroscope_covariance) / imu.triad("gyroscope").scales, axis=1)
    moving = np.flatnonzero(poses.mask & (hands.tilting > _SURE * hands.noise) & (hands.tilting > noise))
    if len(moving):
        worst = moving[hands.tilting[moving].argmax()]
        times = [part.recording.accelerometer.time for part in segmentations for _ in part.intervals]
        findings.append(
            Finding(
                "data.moving_pose",
                tuple(int(times[pose].searchsorted(start[pose])) + 1 for pose in moving[:5]),
                f"{len(moving)} of {int(poses.mask.sum())} poses are not still: the one from {start[worst]:.1f} to "
                f"{stop[worst]:.1f} s tilts by {np.degrees(hands.tilting[worst]):.2g} °/s. They and the turns around "
                "them count for less. Put the unit down, or hold it against something solid.",
            )
        )
    real = observations.turns.mask
    expected, known = undersampling * hands.missed / np.sqrt(3), hands.turned
    coarse = real & (expected > 2 * known)
    if undersampling < 1 and coarse.sum() > _MANY * real.sum():
        rate = segmentations[0].recording.signals["gyroscope"].rate
        # what sampling misses falls with the rate's square
        needed = rate * np.sqrt(np.quantile(expected[coarse] / known[coarse], 0.9))
        findings.append(
            Finding(
                "data.sampling",
                (),
                f"{int(coarse.sum())} of {int(real.sum())} turns are too quick for a sample rate of {rate:.4g} Hz: "
                f"computed from every other sample they differ by up to {np.degrees(2 * hands.missed.max()):.2g}°, and "
                f"from all samples they are uncertain by about {np.degrees(np.median(expected[coarse])):.2g}° each. "
                f"They count for less. Log at {_rounded(needed)} Hz or more, or turn more slowly and put the unit down "
                "softly.",
            )
        )
    return findings


def _rounded(rate: float) -> str:
    """Return a rate, Hz, rounded up to two digits."""
    step = 10.0 ** (np.floor(np.log10(rate)) - 1)
    return f"{np.ceil(rate / step) * step:.0f}"


def _tilts(segmentations: Sequence[Segmentation], imu: Imu, noise: AxisNoise) -> tuple[FloatArray, FloatArray]:
    """Return the rate (P, 3), rad/s, at which each pose tilts, and its standard deviation (P,) for each component."""
    rates, spreads = [], []
    for part in segmentations:
        signal = part.recording.accelerometer
        force = imu.accelerometer.recover_on_host(signal.values)
        for start, stop in part.intervals:
            middle = (start + stop) / 2
            halves = [force[(signal.time >= a) & (signal.time < b)] for a, b in ((start, middle), (middle, stop))]
            if not all(map(len, halves)):
                rates.append(np.zeros(3))
                spreads.append(np.inf)
                continue
            before, after = (half.mean(axis=0) for half in halves)
            both = before + after
            turned = np.cross(after - before, both) / (both * both).sum() * 2
            covariance = noise.covariance([start, middle], [middle, stop]).mean(axis=0)
            variance = covariance[0, 0] + covariance[1, 1] - 2 * covariance[0, 1]
            rates.append(turned / (middle - start))
            spreads.append(float(np.sqrt(variance)) / (middle - start) / float(lengths_of(both) / 2))
    return np.array(rates), np.array(spreads)


def missed_by_sampling(turns: Turns, gyroscope: Triad, running: FloatArray) -> FloatArray:
    """Return half of what rotations (T, 3), rad, from even and from odd samples differ by: Σ (−1)^i R_i ω_i Δt.

    Where sampling is dense enough it is noise. running: the turns' rotations (T, S, 4) after each sample.
    """
    rates = gyroscope.recover_on_host(turns.output)
    interval = turns.interval
    sign = np.where(np.arange(interval.shape[1]) % 2 == 0, 1.0, -1.0)
    return dot_rows(np.asarray(rotate(running, rates)), (interval * sign)[..., None])
