"""Sequences of positions for `jaximu filter`: rotations that make what its filter leaves uncertain small.

What a sequence tells is asked of the filter itself: each rotation and the rest after it are simulated without noise,
cut into the filter's own intervals (`jaximu.data.motion`), and its white rows are added to what is known by
the filter's elimination (`jaximu.estimation.information_filter`). A rotation from a position says the same whatever
came before, but for the heading, which only the Earth's rotation feels; so few are simulated, and many sequences are
tried.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from scipy.linalg import qr
from scipy.spatial.transform import Rotation

from jaximu.calibration.calibration import effect_named
from jaximu.calibration.systematic import (
    NEIGHBOURS,
    disturbances,
    places_of,
    plausible_sizes,
    state_advice,
    state_effect,
)
from jaximu.data.drift import with_usual_drift
from jaximu.data.motion import Disturbances, IntervalsOfMotion, cut, first_knowledge, longest_rest
from jaximu.estimation.information_filter import Knowledge, WhiteRows, estimate, run
from jaximu.estimation.problem import Name, Parameters, flatten, without_equipment_or_effects
from jaximu.estimation.uncertainty import spoken_amount, weak_directions
from jaximu.ground import stored
from jaximu.ground.array_types import FloatArray, IntArray
from jaximu.ground.errors import InputError
from jaximu.ground.precision import require_float64
from jaximu.ground.quantities import Z95
from jaximu.ground.rotation import UP
from jaximu.ground.tracing import on_host
from jaximu.ground.vectors import sigmas_of, submatrix
from jaximu.model.effects.base import Effect
from jaximu.model.effects.earth_rotation import EARTH_RATE, GyroEarthRotation
from jaximu.model.noise_model import AxisNoise, NoiseModel
from jaximu.model.sensor import Imu
from jaximu.planning.information import root_of
from jaximu.planning.optimisation import CRITERIA, criterion_of
from jaximu.planning.plan import AS_GOOD, EQUIPMENT, Equipment, Known, Pose, Proposal, Turn, question_of
from jaximu.planning.poses import pose_words, up_of
from jaximu.simulation import simulate
from jaximu.simulation.protocols import Environment, Rotations
from jaximu.simulation.protocols.course import Course, attitude_of
from jaximu.simulation.protocols.rotations import NINETEEN, rotation_vector

FILTERED = replace(EQUIPMENT["table"], rest=20.0, turn=8.0, setting=0.0, in_sequence=True)
"""A table that turns a unit from one position to the next while it is recorded."""
_CHOICES = [f"{axis}{angle}" for angle in (90, -90, 180) for axis in "xyz"]
_UPRIGHT = attitude_of(UP)
_WIDTH = 12
"""Sequences that are kept at every length."""
_RATE = 50.0
"""Hz of the simulated motion: nothing but means and increments over half a second are made of it."""
_BEFORE = 2.0
"""Seconds of rest before a simulated rotation."""
_SHOWN = 0.5
"""Share of its uncertainty beforehand down to which a number must come to count as shown."""


@dataclass(frozen=True)
class _From(Rotations):
    """Rotations that begin in another position, after a rest of another length."""

    first: float = 1.0
    up: tuple[float, ...] = field(default=(0.0, 0.0, 1.0), metadata={"signed": True})

    def course(self, rng):
        course = Course(attitude_of(np.array(self.up)))
        course.rest(self.first)
        for word in self.rotations.split():
            course.turn(rotation_vector(word), self.turn_duration)
            course.rest(self.duration)
        return course


@dataclass
class Filter:
    """The filter of a unit, and what it would make of sequences it has not seen.

    imu: with the Earth's rotation and all effects that are states, dormant. errors: what disturbs it. gravity: m/s².
    rest, turn: s. names, size (p,): of the free numbers; prior: of them and of gravity, in their own units.
    """

    imu: Imu
    errors: Disturbances
    gravity: float
    rest: float
    turn: float
    names: tuple[Name, ...]
    size: FloatArray
    index: IntArray
    prior: Knowledge
    beyond: int = 0
    _legs: dict[tuple, tuple[WhiteRows, Rotation]] = field(default_factory=dict, repr=False)

    def measured(
        self, words: Sequence[str], first: float | None = None, up: Sequence[float] = (0.0, 0.0, 1.0)
    ) -> tuple[IntervalsOfMotion, int]:
        """Return what the filter is given of a sequence, noise-free, and how many intervals its first rest has."""
        protocol = _From(" ".join(words), self.rest, self.turn, first or self.rest, tuple(up))
        recording, truth = simulate(
            self.imu.without(GyroEarthRotation), protocol, rate=_RATE, environment=Environment(gravity=self.gravity)
        )
        rests = np.array([[station.start, station.stop] for station in truth.schedule if station.kind == "pose"])
        intervals, _ = cut(recording, rests, longest_rest(self.errors), self.beyond)
        return IntervalsOfMotion(intervals, self.errors, self.gravity), int(np.argmin(intervals.rest))

    def begun(self) -> Knowledge:
        """Return what is known before the first rest."""
        start = first_knowledge(self.errors, np.zeros(3), len(self.prior.right))
        states = self.errors.states
        start.root[states:, states:], start.right[states:] = self.prior.root, self.prior.right
        return start

    def rested(self) -> Knowledge:
        """Return what is known after the first rest, z up."""
        measurement, first = self.measured(_CHOICES[:1])
        rows, start = self._rows(measurement, 0, first)
        return run(self.begun(), self._headed(rows, start.inv()))[0]

    def rotated(self, known: Knowledge, attitude: Rotation, word: str) -> Knowledge:
        """Return what is known after a rotation from an attitude, and the rest that follows."""
        up = np.round(attitude.inv().apply([0.0, 0.0, 1.0]))
        key = word, *up.astype(int).tolist()
        if key not in self._legs:
            measurement, first = self.measured([word], _BEFORE, up.tolist())
            rows, start = self._rows(measurement, first)
            self._legs[key] = _merged(rows), start
        rows, start = self._legs[key]
        return run(known, self._headed(rows, attitude * start.inv()))[0]

    def whole(self, words: Sequence[str], *, known: bool = True) -> Knowledge:
        """Return what is known after a sequence of which all is filtered at once.

        **Arguments:** `known`: with what is known beforehand of the numbers; else with no more of them than of gravity
        and the Earth's rotation.
        """
        measurement, _ = self.measured(words)
        rows, start = self._rows(measurement)
        initial = self.begun()
        states = self.errors.states
        if not known:
            initial.root[states:, states:][[index for index in range(len(self.names)) if index not in self.earth]] = 0.0
        return run(initial, self._headed(rows, start.inv()))[0]

    @property
    def earth(self) -> tuple[int, ...]:
        """Places of the Earth's rotation among the names."""
        return places_of(GyroEarthRotation, self.imu, self.names)

    def numbers(self, known: Knowledge) -> FloatArray:
        """Return the covariance (p, p) of the free numbers, in their own units."""
        states = self.errors.states
        return estimate(Knowledge(known.root[states:, states:], known.right[states:]))[1][:-1, :-1]

    def value(self, known: Knowledge, criterion: str, weights: FloatArray) -> float:
        """Return the logarithm of a criterion of all free numbers but the Earth's rotation."""
        kept = [index for index in range(len(self.names)) if index not in self.earth]
        spread = submatrix(self.numbers(known) / self.size[:, None] / self.size, kept)
        return float(stored.call(CRITERIA[criterion], f"sequence's {criterion}", spread, weights[kept]))

    def _rows(
        self, measurement: IntervalsOfMotion, first: int = 0, stop: int | None = None
    ) -> tuple[WhiteRows, Rotation]:
        """Return rows of intervals about the free numbers and gravity, and the attitude where they begin.

        They go from `first` to `stop`, or to the last that is real.
        """
        part = slice(first, int(np.sum(measurement.intervals.real)) if stop is None else stop)
        filtered = measurement.filtered(self.imu)
        shared = np.append(self.index, len(flatten(self.imu)))
        rows = WhiteRows(*(np.asarray(array)[part] for array in filtered.rows))
        start = Rotation.from_quat(np.asarray(filtered.path.attitude)[first], scalar_first=True)
        return rows._replace(shared=rows.shared[..., shared]), start

    def _headed(self, rows: WhiteRows, ahead: Rotation) -> WhiteRows:
        """Return rows of a path turned about the vertical: its heading is by chance, the Earth's rotation is not."""
        shared = np.array(rows.shared)
        earth = list(self.earth)
        shared[..., earth] = shared[..., earth] @ ahead.as_matrix().T
        return rows._replace(shared=shared)


def _merged(rows: WhiteRows) -> WhiteRows:
    """Return N steps as one: the states in between are eliminated; leading axis of length one."""
    n = rows.before.shape[-1]
    whole = np.concatenate([rows.before[0], rows.after[0], rows.shared[0], rows.right[0][:, None]], axis=1)
    for before, after, shared, right in zip(*(part[1:] for part in rows), strict=True):
        # columns: the state between, which goes, then the first state, the next one, the numbers
        old = np.concatenate([whole[:, n : 2 * n], whole[:, :n], np.zeros((len(whole), n)), whole[:, 2 * n :]], axis=1)
        new = np.concatenate([before, np.zeros_like(before), after, shared, right[:, None]], axis=1)
        whole = np.asarray(qr(np.concatenate([old, new]), mode="r")[0])[n:, n:]
        whole = whole[: whole.shape[1]]
    return WhiteRows(whole[None, :, :n], whole[None, :, n : 2 * n], whole[None, :, 2 * n : -1], whole[None, :, -1])


def filter_of(
    known: Known, equipment: Equipment, positions: int, effects: Sequence[str | Effect], noise: NoiseModel | None
) -> tuple[Filter, tuple[str, ...]]:
    """Return the filter of a unit and notes on what had to be assumed; arguments as in [`propose_sequence`]."""
    chosen = [state_effect(effect_named(effect)) for effect in effects]
    chosen = [effect for effect in chosen if effect.name != GyroEarthRotation.name]
    question, notes = question_of(replace(known, imu=known.imu.with_effects()), equipment, "D", None)
    if noise is None:
        gains = [np.linalg.inv(np.asarray(triad.gain)) for triad in question.imu.triads().values()]
        densities = np.asarray(question.accuracy.accelerometer) * equipment.rest, np.asarray(question.accuracy.density)
        white = [
            AxisNoise.of_white(np.diagonal(gain @ density @ gain.T))
            for gain, density in zip(gains, densities, strict=False)
        ]
        duration = positions * equipment.rest + (positions - 1) * equipment.turn
        noise = with_usual_drift(NoiseModel(white[0], white[1]), equipment.rest, duration)
        notes += ("the drift of the biases that is usual of MEMS sensors is assumed.",)
    imu = on_host(question.imu.with_effects(*chosen, GyroEarthRotation.dormant()))
    free = Parameters.select(imu, without_equipment_or_effects)
    size = np.asarray(free.size)
    spread = plausible_sizes(imu) | {GyroEarthRotation.name: np.full(3, EARTH_RATE)}
    information = np.zeros((len(size) + 1, len(size) + 1))
    base = question.parameters
    inside = [free.names.index(name) for name in base.names]
    information[np.ix_(inside, inside)] = np.asarray(question.prior) / np.outer(base.size, base.size)
    for index, name in enumerate(free.names):
        if name.effect is not None:
            effect = imu.all_effects()[name.key]
            information[index, index] = 1 / np.broadcast_to(spread[effect.name], effect.size)[name.axes[0]] ** 2
    information[-1, -1] = 1 / max(known.gravity.sigma, 1e-6) ** 2
    scale = sigmas_of(information)
    root = np.linalg.cholesky(information / np.outer(scale, scale)).T * scale
    return Filter(
        imu,
        disturbances(noise),
        known.gravity.value,
        equipment.rest,
        equipment.turn,
        free.names,
        size,
        np.asarray(free.index, int),
        Knowledge(root, np.zeros(len(root))),
        NEIGHBOURS if chosen else 0,
    ), notes


def propose_sequence(
    known: Known,
    equipment: Equipment = FILTERED,
    positions: int = 19,
    criterion: str = "D",
    parameter: str | None = None,
    effects: Sequence[str | Effect] = (),
    noise: NoiseModel | None = None,
    report: Callable[[str], None] = lambda _: None,
) -> Proposal:
    """Return positions, and rotations by 90° or 180° about the unit's axes between them, for `calibrate_by_filter`.

    The sequence begins with z up. At every length the best few are kept; where nineteen positions of the well-known
    sequence (`jaximu.simulation.protocols.rotations`) do as well, they are proposed.

    **Arguments:**

    - `positions`: how many, the first included, at least two. `criterion`, `parameter`: as in [`propose`], of all that
      the filter estimates but the Earth's rotation.
    - `effects`: of the catalogue, states beside gain and bias.
    - `noise`: of the unit; None takes what is known of its white noise, and the drift that is usual.
    - `report`: receives what is being worked on, in words.

    Raises `InputError` for an unknown parameter or criterion, too few positions, or a table that is too slow;
    `NotPossibleError` for an effect that the filter cannot follow.
    """
    require_float64()
    if known.imu.gyroscope is None:
        raise InputError("the filter needs a gyroscope beside the accelerometer, and this unit has none.")
    if positions < 2:
        raise InputError("a sequence for the filter has at least two positions.")
    fastest = np.radians(equipment.fastest) * equipment.turn / 2 + 1e-9  # the rate peaks at twice its mean
    choices = [word for word in _CHOICES if np.linalg.norm(rotation_vector(word)) <= fastest]
    if not choices:
        raise InputError(
            f"a rotation by 90° in {equipment.turn:g} s reaches {180 / equipment.turn:.3g} °/s, and the table's limit "
            f"is {equipment.fastest:g} °/s: give the turn more time, --turn {180 / equipment.fastest:.3g}."
        )
    estimator, notes = filter_of(known, equipment, positions, effects, noise)
    label = parameter or criterion
    criterion, weights = criterion_of(criterion, parameter, estimator.names)

    def left(knowledge: Knowledge) -> float:
        return estimator.value(knowledge, criterion, weights)

    words = _searched(estimator, choices, positions, left, report)
    knowledge = estimator.whole(words)
    best = left(knowledge)
    classical = tuple(NINETEEN.split())
    if positions == len(classical) + 1 and set(classical) <= set(choices):
        value = left(other := estimator.whole(classical))
        ratio = float(np.exp(value - best))
        if ratio <= AS_GOOD:
            words, knowledge, best = classical, other, value
            notes += ("the well-known nineteen positions do as well as any here, and are proposed.",)
        else:
            notes += (f"the well-known nineteen positions, as long, leave {ratio:.3g} times as much.",)
    unit = float(estimator.size @ weights) or 1.0
    sigmas = [float(np.exp(logarithm)) * unit for logarithm in (left(estimator.begun()), best, best)]
    return _proposal(estimator, words, knowledge, sigmas, label, equipment, known.source, notes)


def _searched(
    estimator: Filter,
    choices: Sequence[str],
    positions: int,
    left: Callable[[Knowledge], float],
    report: Callable[[str], None],
) -> tuple[str, ...]:
    """The rotations that make smallest what is left, of those that are tried."""
    kept: list[tuple[float, tuple[str, ...], Rotation, Knowledge]] = [(0.0, (), _UPRIGHT, estimator.rested())]
    for number in range(1, positions):
        report(f"position {number + 1} of {positions}")
        longer = []
        for _, words, attitude, before in kept:
            for word in choices:
                after = estimator.rotated(before, attitude, word)
                reached = attitude * Rotation.from_rotvec(rotation_vector(word))
                longer.append((left(after), (*words, word), reached, after))
        kept = []
        for option in sorted(
            longer, key=lambda option: option[0]
        ):  # of sequences that are alike but for the names of axes one is enough
            if len(kept) < _WIDTH and (not kept or option[0] - kept[-1][0] > 1e-7):
                kept.append(option)
    return kept[0][1]


def _proposal(
    estimator: Filter,
    words: Sequence[str],
    knowledge: Knowledge,
    criterion: Sequence[float],
    label: str,
    equipment: Equipment,
    source: str,
    notes: tuple[str, ...],
) -> Proposal:
    size = estimator.size
    before, after = (np.asarray(estimator.numbers(stage)) for stage in (estimator.begun(), knowledge))
    states = estimator.errors.states
    earth = list(estimator.earth)
    root = estimator.whole(words, known=False).root[states:, states:]
    # gravity's column comes last, so that the rows above it hold without it only where it is known
    information = root.T @ root
    alone = information[:-1, :-1] - np.outer(information[:-1, -1], information[-1, :-1]) / information[-1, -1]
    rank, weak = weak_directions(
        root_of(alone * size[:, None] * size).T, estimator.names, size, estimator.imu, state_advice
    )
    of_earth = {estimator.names[index] for index in earth}
    weak = tuple(direction for direction in weak if not {name for name, _ in direction.parameters} <= of_earth)
    unshown = [index for index in earth if after[index, index] > _SHOWN**2 * before[index, index]]
    if unshown:
        left = spoken_amount(estimator.names[unshown[0]], Z95 * np.sqrt(after[unshown[0], unshown[0]]), estimator.imu)
        notes += (
            "the gyroscope's noise hides the Earth's rotation from this sequence: it is known to "
            f"± {left} (95 %), and is part of how uncertain the biases are.",
        )
    poses, turns = _poses_and_turns(words, equipment)
    return Proposal(
        equipment,
        label,
        poses,
        turns,
        estimator.imu,
        estimator.names,
        (before, after),
        np.zeros(len(size)),
        *criterion,
        rank=rank,
        open=weak,
        source=source,
        notes=notes,
    )


def _poses_and_turns(words: Sequence[str], equipment: Equipment) -> tuple[tuple[Pose, ...], tuple[Turn, ...]]:
    """The positions that rotations lead through, z up first, and the turns between them."""
    attitude = _UPRIGHT
    turns = []

    def stand(attitude: Rotation) -> Pose:
        quaternion = attitude.as_quat(scalar_first=True)
        return Pose(up_of(quaternion), quaternion, pose_words(up_of(quaternion).round()))

    poses = [stand(attitude)]
    for word in words:
        vector = rotation_vector(word)
        angle = float(np.linalg.norm(vector))
        attitude *= Rotation.from_rotvec(vector)
        poses.append(stand(attitude))
        about = f"{np.degrees(angle):.0f}° about {'+' if vector.sum() > 0 else '−'}{word[0]}"
        turns.append(Turn(vector / angle, angle, angle / equipment.turn, about))
    return tuple(poses), tuple(turns)
