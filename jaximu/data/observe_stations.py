"""From a reference to `Stations`: what a recording, or a protocol that is only planned, tells at known poses and turns.

A recording's stations are its mean outputs between a schedule's start and stop. Of a turn the set-up knows axis and
angle; how the rate went in between comes from the gyroscope, scaled so that it adds up to that angle. Samples are taken
to hold from half way to their neighbour before to half way to the one after. NumPy, host side.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise
from typing import TYPE_CHECKING

import jax
import numpy as np
import scipy

from jaximu.estimation.track import TRIADS
from jaximu.ground import stored
from jaximu.ground.array_types import BoolArray, FloatArray, IntArray
from jaximu.ground.errors import NotPossibleError
from jaximu.ground.precision import require_float64
from jaximu.ground.rotation import UP, rotations_of, unit_vectors
from jaximu.ground.vectors import variances_of
from jaximu.model.noise_model import AxisNoise, NoiseModel
from jaximu.model.sensor import Imu
from jaximu.model.stimulus import REFERENCE_TEMPERATURE, Stimulus
from jaximu.recordings.entry import ScheduleEntry, times_of
from jaximu.recordings.observations import POWER_ON, Stations
from jaximu.recordings.recording import Recording, Signal
from jaximu.recordings.reference import Integral, match_reference, means_over, rest_rate
from jaximu.recordings.segmentation import noise_by_model, rest_statistics
from jaximu.simulation.protocols import Environment, Protocol, attitude_of
from jaximu.simulation.protocols.motion import smooth_course

if TYPE_CHECKING:
    from scipy.spatial.transform import Rotation

NODES = 32
"""Nodes of a station: a mean square rate over a turn that ramps is right to some 1e-3."""
TYPICAL_NOISE = NoiseModel(AxisNoise.of_white(1e-3**2), AxisNoise.of_white(1e-4**2))
"""White noise of a consumer's unit, 100 µg/√Hz and 0.34 °/√h, for schemes that are only planned."""
_FEWEST = 32  # stations, padding included: with powers of two above it few shapes are compiled
_STILL = 1.0  # s; between entries closer than this nothing happens


def attitudes(entries: Sequence[ScheduleEntry]) -> list[Rotation | None]:
    """Return the attitude (body to level frame) in which each entry begins, None where nothing tells its heading.

    A pose's heading is stated, or follows through the turns from a neighbour that has one. Without any stated heading
    the first pose's is the zero.
    """
    starts: list[Rotation | None] = [
        attitude_of(entry.vector, entry.heading) if entry.kind == "pose" and entry.heading is not None else None
        for entry in entries
    ]
    if all(attitude is None for attitude in starts):
        first = next((k for k, entry in enumerate(entries) if entry.kind == "pose"), None)
        if first is not None:
            starts[first] = attitude_of(entries[first].vector)
    for order in (1, -1):
        for before, here in pairwise(range(len(entries))[::order]):
            known, (entry, following) = starts[before], (entries[k] for k in sorted((before, here)))
            if known is None or starts[here] is not None or following.start - entry.stop > _STILL:
                continue
            angle = entry.angle if entry.kind == "turn" else 0.0
            turned = scipy.spatial.transform.Rotation.from_rotvec(angle * np.asarray(entry.vector))
            carried = known * (turned if order > 0 else turned.inv())
            if entries[here].kind == "pose":  # its own "up" is what the set-up says; only the heading is carried
                up = entries[here].vector
                carried = attitude_of(up, (carried * attitude_of(up).inv()).as_rotvec()[2])
            starts[here] = carried
    return starts


def observe_stations(
    recordings: Recording | Sequence[Recording],
    references: Sequence[ScheduleEntry] | Sequence[Sequence[ScheduleEntry]],
    gravity: float,
    noise: NoiseModel | None = None,
) -> tuple[Stations, tuple[str, ...]]:
    """Distil recordings of one unit at known poses and turns into padded `Stations`, and notes for the user.

    **Arguments:**

    - `recordings`, `references`: the recordings and the entries of each, on its own clock; one recording may stand
      alone. Where a recording has an attitude, turns follow it, else axis and angle of the entries.
    - `noise`: a model fitted to the unit at rest; without one the scatter within the poses tells the noise, as if it
      were white.

    Raises `InputError` where a reference does not match its recording (in time, in units, in its axes), saying how,
    `NotPossibleError` where nothing can be used.
    """
    require_float64()
    if isinstance(recordings, Recording):
        recordings, references = [recordings], [references]  # pyright: ignore[reportAssignmentType]
    parts, notes = [], []
    for recording, entries in zip(recordings, references, strict=True):
        matched, remarks = match_reference(recording, entries)  # pyright: ignore[reportArgumentType]
        parts.append((recording, matched))
        notes += remarks
    first = parts[0][0]
    known = all(None not in attitudes(entries) for recording, entries in parts if recording.attitude is None)
    stimuli, means, covariances, spans, turns = [], [], [], [], []
    for recording, entries in parts:
        span = times_of(entries)
        turn = np.array([entry.kind == "turn" for entry in entries])
        stimulus = _recorded_stimulus(recording, entries, span, gravity)
        stimuli.append(stimulus if known else replace(stimulus, attitude=None))
        signals = [signal for signal in (recording.accelerometer, recording.gyroscope) if signal is not None]
        means.append([_means(signal, span) for signal in signals])
        if noise is None:
            covariances.append([_mean_covariance(signal, span, turn, recording.name) for signal in signals])
        spans.append(span)
        turns.append(turn)
    owner = np.arange(len(parts)).repeat([len(span) for span in spans])
    together = owner[:, None] == owner
    span, turn = np.concatenate(spans), np.concatenate(turns)
    stacked = [np.concatenate(of_triad) for of_triad in zip(*means, strict=False)]
    if noise is None:
        measured = [
            np.array([scipy.linalg.block_diag(*blocks) for blocks in zip(*of_triad, strict=True)])
            for of_triad in zip(*covariances, strict=False)
        ]
    else:
        measured = [
            _known_covariance(getattr(first, name), getattr(noise, name), name, span, together)
            for name in TRIADS[: len(stacked)]
        ]
    if len(stacked) > 1 and first.gyroscope is not None:  # a later power-on has another bias
        later = together & (owner > 0)
        measured[1] += later * ((POWER_ON["gyroscope"] * first.gyroscope.nominal_scale) ** 2)[:, None, None]
    stimulus = jax.tree.map(lambda *leaves: np.concatenate(leaves), *stimuli)
    force = ~turn & (len(first.accelerometer) > 0)
    return assembled(stacked, measured, stimulus, span, turn, gravity, force, owner), tuple(dict.fromkeys(notes))


def _means(signal: Signal, span: FloatArray) -> FloatArray:
    """Return the means (n, 3) of a signal over spans; zero where it has no samples."""
    if not len(signal):
        return np.zeros((len(span), 3))
    return means_over(signal, span)


def _mean_covariance(signal: Signal, span: FloatArray, turn: BoolArray, name: str) -> FloatArray:
    """Covariance (3, n, n) of means as the scatter within the poses tells it; turns are as noisy as rests."""
    if not len(signal):
        return np.zeros((3, len(span), len(span)))
    if turn.all():
        raise NotPossibleError(
            f"{name}: the reference has no pose, so the noise is unknown: add a rest to it, or give a recording of "
            "the unit at rest with --static."
        )
    density, _, in_poses = rest_statistics(signal, span[~turn])
    variance = np.diagonal(density) / np.diff(span)
    variance[~turn] = variances_of(in_poses)
    return variance.T[:, :, None] * np.eye(len(span))


def _known_covariance(
    signal: Signal, noise: AxisNoise | None, name: str, span: FloatArray, together: BoolArray
) -> FloatArray:
    """Covariance (3, n, n) of means by a noise model; slow noise ties those of one recording, `together` (n, n)."""
    if not len(signal):
        return np.zeros((3, len(span), len(span)))
    white, slow = noise_by_model(signal, noise, name, span[:, 0], span[:, 1], together)
    return slow + (np.diag(white)[:, None] / np.diff(span)[:, 0])[:, :, None] * np.eye(len(span))


def _recorded_stimulus(
    recording: Recording, entries: Sequence[ScheduleEntry], span: FloatArray, gravity: float
) -> Stimulus:
    course = np.linspace(0.0, 1.0, 2 * NODES + 1)
    nodes = span[:, :1] + np.diff(span) * course
    time = nodes[:, 1::2]
    if recording.attitude is not None:
        stimulus = _along(recording.attitude, nodes, gravity)
    else:
        course = np.tile(course, (len(entries), 1))
        if recording.gyroscope is not None:
            integral = Integral(recording.gyroscope)
            bias = rest_rate(integral, entries)
            for k, entry in enumerate(entries):
                if entry.kind == "turn":
                    moved = integral.over(span[k, :1], nodes[k]) - bias * (nodes[k] - span[k, 0])[:, None]
                    course[k] = moved @ entry.vector / (moved[-1] @ entry.vector)
        stimulus = _stimulus(entries, attitudes(entries), course, gravity)
    temperature = np.full(time.shape, REFERENCE_TEMPERATURE)
    if recording.temperature is not None:
        temperature = recording.temperature.at(time)[..., 0]
    return replace(stimulus, time=time, temperature=temperature)


def _along(attitude: Signal, nodes: FloatArray, gravity: float) -> Stimulus:
    """Force, rate and attitude (S, Q) where the reference tells the attitude at all times."""
    quaternion = unit_vectors(attitude.values)
    clipped = nodes.clip(attitude.time[0], attitude.time[-1])
    rotations = scipy.spatial.transform.Slerp(attitude.time, rotations_of(quaternion))(clipped.ravel())
    whole = rotations.as_quat(scalar_first=True).reshape(*clipped.shape, 4)
    edges, middle = whole[:, ::2], whole[:, 1::2]
    step = (rotations_of(edges[:, :-1]).inv() * rotations_of(edges[:, 1:])).as_rotvec().reshape(*middle.shape[:2], 3)
    return Stimulus(
        specific_force=gravity * _up(middle), angular_rate=step / np.diff(nodes[:, ::2])[..., None], attitude=middle
    )


def _up(attitude: FloatArray) -> FloatArray:
    """Return what points up (S, Q, 3) in the body frame, at attitudes (S, Q, 4)."""
    return rotations_of(attitude).inv().apply(UP).reshape(*attitude.shape[:2], 3)


def scheme_stations(
    protocol: Protocol,
    imu: Imu | None = None,
    noise: NoiseModel = TYPICAL_NOISE,
    environment: Environment | None = None,
) -> Stations:
    """Return the stations of a scheme without simulating samples: its means are free of noise.

    **Arguments:**

    - `protocol`: the scheme, with its rests and turns as it marks them.
    - `imu`: the unit, whose outputs the means are; the nominal one in SI if left out.
    - `noise`: gives the covariances.
    - `environment`: gravity and temperature. Its Earth rotation is left out: that is the effect `gyro.earth_rotation`
      of `imu`.
    """
    require_float64()
    imu = Imu.nominal() if imu is None else imu
    plan = protocol.plan(np.random.default_rng(0), replace(environment or Environment(), latitude=None))
    entries, motion = plan.intervals, plan.motion
    span = times_of(entries)
    segment = motion.start.searchsorted(span[:, 0] + 1e-9, side="right") - 1
    begin = list(map(rotations_of, motion.attitude[segment]))
    nodes = np.linspace(0.0, 1.0, 2 * NODES + 1)  # edges and, between them, middles
    course = np.asarray(jax.jit(smooth_course)(nodes, motion.ramp[segment][:, None]))
    time = span[:, :1] + np.diff(span) * nodes[1::2]
    gravity = float(motion.gravity)
    stimulus = _stimulus(entries, begin, course, gravity)
    stimulus = replace(stimulus, time=time, temperature=np.interp(time, motion.temperature_time, motion.temperature))
    turn = np.array([entry.kind == "turn" for entry in entries])
    scale = [triad.scales for triad in imu.triads().values()]
    known = [noise.accelerometer, noise.gyroscope][: len(scale)]
    if known[-1] is None:
        raise NotPossibleError("the noise model has no gyroscope, but the unit has one: record both at rest.")
    covariances = [
        axes.covariance(*span.T) * gain[:, None, None] ** 2
        for axes, gain in zip(known, scale, strict=True)
        if axes is not None
    ]
    means = [np.zeros((len(entries), 3))] * len(scale)
    stations = assembled(means, covariances, stimulus, span, turn, gravity, ~turn)
    means = stored.call(_mean_outputs, "station means", imu, stations)
    means += [np.zeros_like(stations.gyroscope_mean)] * (2 - len(means))
    return replace(stations, accelerometer_mean=means[0], gyroscope_mean=means[1])


def _mean_outputs(imu: Imu, stations: Stations):
    outputs = imu.respond(stations.stimulus)
    return [(stations.weight[..., None] * output).sum(axis=-2) for output in outputs if output is not None]


def _stimulus(
    entries: Sequence[ScheduleEntry], begin: Sequence[Rotation | None], course: FloatArray, gravity: float
) -> Stimulus:
    """Return force, rate and attitude at the nodes, from how much of each turn is done at their edges and middles
    (S, 2Q + 1). Where an attitude is not known there is none, and the force in turns is that of the turn's begin.
    """
    steps = course.shape[1] // 2
    duration = np.array([entry.stop - entry.start for entry in entries])
    vector = np.stack([np.asarray(entry.vector) / np.linalg.norm(entry.vector) for entry in entries])
    turned = np.array([entry.angle if entry.kind == "turn" else 0.0 for entry in entries])[:, None] * vector
    share = np.diff(course[:, ::2], axis=1) * steps / duration[:, None]
    rate = share[..., None] * turned[:, None]
    rotation = scipy.spatial.transform.Rotation
    whole = [rotation.identity() if start is None else start for start in begin]
    middles = (
        start * rotation.from_rotvec(middle[:, None] * turn)
        for start, middle, turn in zip(whole, course[:, 1::2], turned, strict=True)
    )
    attitude = np.stack([middle.as_quat(scalar_first=True) for middle in middles])
    up = _up(attitude)
    pose = np.array([entry.kind == "pose" for entry in entries])
    up[pose] = vector[pose][:, None]  # as stated, to the last digit
    known = all(start is not None for start in begin)
    return Stimulus(specific_force=gravity * up, angular_rate=rate, attitude=attitude if known else None)


def assembled(
    means: Sequence[FloatArray],
    covariances: Sequence[FloatArray],
    stimulus: Stimulus,
    span: FloatArray,
    turn: BoolArray,
    gravity: float,
    force: BoolArray,
    recording: IntArray | None = None,
    weight: FloatArray | None = None,
) -> Stations:
    """Put stations together, padded to a bucket.

    **Arguments:** by triad, the gyroscope's left out where there is none, `means` (n, 3) and their `covariances` (3, n,
    n); `span` (n, 2): s; `turn`, `force` (n,): which are turns, and in which the accelerometer is used; `recording`
    (n,): that each is of, of one if None; `weight` (n, Q): of the nodes, alike if None.
    """
    count, nodes = len(turn), stimulus.angular_rate.shape[1]  # pyright: ignore[reportOptionalMemberAccess]
    recording = np.zeros(count, np.int64) if recording is None else recording
    weight = np.full((count, nodes), 1 / nodes) if weight is None else weight
    size = max(_FEWEST, 1 << (count - 1).bit_length())
    there = np.arange(size) < count
    missing = 0, size - count
    used = [np.pad(force, missing), there if len(means) > 1 else np.zeros(size, bool)]

    def pad(array: FloatArray) -> FloatArray:
        return np.concatenate([array, array[:1].repeat(size - count, axis=0)])

    def spread(matrix: FloatArray, used: BoolArray) -> FloatArray:
        whole = np.zeros((3, size, size))
        whole[:, :count, :count] = matrix
        return np.where(used[:, None] & used, whole, np.eye(size))

    means, covariances = [*means, np.zeros((count, 3))][:2], [*covariances, np.zeros((3, count, count))][:2]
    start, stop = (np.where(there, pad(edge), 0.0) for edge in span.T)
    return Stations(
        accelerometer_mean=np.where(there[:, None], pad(means[0]), 0.0),
        gyroscope_mean=np.where(there[:, None], pad(means[1]), 0.0),
        accelerometer_covariance=spread(covariances[0], used[0]),
        gyroscope_covariance=spread(covariances[1], used[1]),
        stimulus=jax.tree.map(pad, stimulus),
        weight=pad(weight),
        start=start,
        stop=stop,
        turn=np.pad(turn, missing),
        accelerometer_used=used[0],
        gyroscope_used=used[1],
        gravity=np.asarray(gravity),
        recording=np.pad(recording, missing),
    )
