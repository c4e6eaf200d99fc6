"""`Guide`: a person is led through a hand-held recording while it is made, pose by pose, until the goal is reached.

The recording so far is segmented and calibrated as a whole whenever it has grown, by the very functions that calibrate
it afterwards: a pose counts here if it counts there. Which orientation comes next is the one, of a box's 26 faces,
edges and corners, whose rest and whose turn from the present one add most to what is known: to the worst goal, or to
all parameters alike (the D-criterion) where there is none.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import jax
import numpy as np

from jaximu.calibration import Calibration, calibrate
from jaximu.calibration.nominal import as_stated
from jaximu.estimation.problem import names_of
from jaximu.ground import stored
from jaximu.ground.array_types import FloatArray, IntArray
from jaximu.ground.errors import InputError, NotPossibleError
from jaximu.ground.gravity import STANDARD, LocalGravity
from jaximu.ground.vectors import sigmas_of
from jaximu.model.sensor import Imu
from jaximu.planning.chunks import in_chunks
from jaximu.planning.goals import goal_of, goal_sigmas, parse_goal
from jaximu.planning.information import Design, hand_held_information
from jaximu.planning.optimisation import DesignQuestion
from jaximu.planning.plan import EQUIPMENT, Known, question_of
from jaximu.planning.poses import box_words, turned_to
from jaximu.recordings.recording import Recording, Signal
from jaximu.recordings.segmentation import SegmentationOptions, segment
from jaximu.simulation.protocols.course import attitude_of
from jaximu.simulation.protocols.positions import directions

_BOX = np.array([up for up, _ in directions(26)])
_FEWEST, _MOST = 9, 60  # poses that a calibration needs; poses after which a goal is given up
_USUAL = 12  # poses where no goal is stated
_REACHED = 0.5  # s since the last pose's end after which the unit is said to move
_HELD = 0.25  # s at the end of the recording whose mean shows how the unit is held now
_NEXT = np.radians(30.0)
"""The next pose is this far from the present one at least."""


@dataclass(frozen=True)
class GoalProgress:
    """A standard deviation that is wanted, and what it is now (inf: not determined), both in the stated unit's SI."""

    text: str
    size: float
    now: float

    @property
    def reached(self) -> bool:
        """Whether it is as small as wanted."""
        return self.now <= self.size

    @property
    def words(self) -> str:
        """How far it is."""
        if self.now == np.inf:
            return "open"
        return "reached" if self.reached else f"{self.now / self.size:.2g} times that"


@dataclass(frozen=True)
class Moment:
    """Where a capture stands.

    still: s for which the unit has been at rest by now, 0 while it moves. taken (P, 2): start and stop of the poses
    that count, s. short: s of the last rest, where it was too short to count, else 0. up, words: the orientation to go
    to next, which body direction points up. goals: how far each is. done: whether to stop; calibration: of what was
    recorded, None before it is possible. held (3,), ups (P, 3): which body direction points up now, and in the poses
    that count. wanted: number of poses to record, 0 where there are goals.
    """

    still: float
    taken: FloatArray
    short: float
    up: FloatArray | None
    words: str
    goals: tuple[GoalProgress, ...]
    done: bool
    calibration: Calibration | None
    held: FloatArray
    ups: FloatArray
    wanted: int


class Guide:
    """Leads through a recording: call `update` with all that was recorded so far, as often as there is more.

    **Arguments:**

    - `goals`: standard deviations that are wanted, "accelerometer.bias 0.2 mg", as for `jaximu budget`; none: a dozen
      poses.
    - `gravity`: local gravity.
    - `rest`: s, of a pose that counts.

    Raises `InputError` for a goal that is not understood.
    """

    def __init__(self, goals: Sequence[str] = (), gravity: LocalGravity = STANDARD, rest: float = 4.0) -> None:
        if not rest > 0:
            raise InputError(f"a pose must rest for more than zero seconds, found {rest:g}.")
        self.goals = [(text, *parse_goal(text)) for text in goals]
        for _, what, size in self.goals:
            goal_of(what, size, names_of(Imu.nominal()), Imu.nominal())
        self.gravity, self.rest = gravity, rest
        self._seen: FloatArray = np.zeros((0, 2))
        self._calibration: Calibration | None = None
        self._next: FloatArray | None = None
        self._ups: FloatArray = np.zeros((0, 3))

    def update(self, recording: Recording) -> Moment:
        """Return where the capture stands. Raises `InputError` where a goal names no parameter of this unit."""
        try:
            rests = segment(recording, SegmentationOptions(fewest=1)).intervals
        except NotPossibleError:
            rests = np.zeros((0, 2))
        length = rests[:, 1] - rests[:, 0]
        long = length >= self.rest
        signal = recording.accelerometer
        still = float(length[-1]) if len(rests) and signal.time[-1] - rests[-1, 1] < _REACHED else 0.0
        taken = rests[long]
        if len(taken) != len(self._seen) or (np.abs(taken[:, 0] - self._seen[:, 0]) > _REACHED).any():
            self._seen = taken
            self._renew(recording)
        short = float(length[-1]) if len(rests) and not long[-1] and not still else 0.0
        goals = tuple(self._goals())
        done = all(goal.reached for goal in goals) if goals else len(taken) >= _USUAL
        done = (done and self._calibration is not None) or len(taken) >= _MOST
        words = "" if self._next is None else box_words(self._next)
        count = len(signal)
        held = _upward(self._unit(recording), signal, np.array([[count - max(1, round(_HELD * signal.rate)), count]]))[
            0
        ]
        wanted = 0 if goals else _USUAL
        return Moment(still, taken, short, self._next, words, goals, done, self._calibration, held, self._ups, wanted)

    def _renew(self, recording: Recording) -> None:
        if len(self._seen) >= _FEWEST:
            try:
                self._calibration = calibrate(recording, self.gravity)
            except NotPossibleError:
                self._calibration = None
        imu = self._unit(recording)
        self._ups = _upward(imu, recording.accelerometer, np.searchsorted(recording.accelerometer.time, self._seen))
        if not len(self._seen):
            return
        if self._calibration is None:
            known = Known(
                imu if recording.gyroscope is not None else replace(imu, gyroscope=None), gravity=self.gravity
            )
        else:
            known = Known.from_calibration(self._calibration)
        question, _ = question_of(known, replace(EQUIPMENT["hands"], rest=self.rest), "D", None)
        information = np.asarray(question.prior)
        if self._calibration is None:
            for before, after in pairwise(self._ups):
                information = information + _information(question, before, after[None])[0]
        added = _information(question, self._ups[-1], _BOX)
        left = [
            self._left(question, information + more, up @ self._ups[-1]) for more, up in zip(added, _BOX, strict=True)
        ]
        self._next = _BOX[np.argmin(left)]

    def _unit(self, recording: Recording) -> Imu:
        return as_stated(recording) if self._calibration is None else self._calibration.imu

    def _left(self, question: DesignQuestion, information: FloatArray, cosine: float) -> float:
        """Return how much is left to know with this information, as a logarithm; inf for a turn that cannot be made."""
        if not np.cos(float(question.turn_limit)) < cosine < np.cos(_NEXT):
            return np.inf
        if not self.goals:
            return -float(np.linalg.slogdet(information)[1])
        covariance = np.linalg.inv(information) + np.outer(question.by_gravity, question.by_gravity)
        sigma = sigmas_of(covariance) * np.asarray(question.parameters.size)
        total = 0.0
        for _, what, text in self.goals:
            size, now = goal_sigmas(what, text, question.parameters.names, question.imu, sigma)
            total += np.sum((now / size) ** 4)  # the largest counts most; where it cannot be helped at once, the others
        return float(np.log(total))

    def _goals(self) -> Iterator[GoalProgress]:
        calibration = self._calibration
        for text, what, size in self.goals:
            wanted, now = 0.0, np.inf
            if calibration is not None:
                sigma = sigmas_of(calibration.covariance)
                wanted, sigmas = goal_sigmas(what, size, calibration.names, calibration.imu, sigma)
                now = float(sigmas.max())
            yield GoalProgress(text, wanted, now)


def _upward(imu: Imu, signal: Signal, rows: IntArray) -> FloatArray:
    """Return the body's mean upward directions (n, 3) over spans of rows (n, 2)."""
    means = np.array([signal.values[first:last].mean(axis=0) for first, last in rows]).reshape(-1, 3)
    force = np.linalg.solve(np.asarray(imu.accelerometer.gain), (means - np.asarray(imu.accelerometer.bias)).T).T
    return force / np.maximum(np.linalg.norm(force, axis=1, keepdims=True), 1e-12)


def _information(question: DesignQuestion, before: FloatArray, after: FloatArray) -> FloatArray:
    """Return the information (n, p, p) of a rest in each direction `after` (n, 3) and of the turn to it."""
    first = attitude_of(before).as_quat(scalar_first=True)
    pairs = np.array([[first, turned_to(first, direction)] for direction in after])

    def one(question, attitude):
        design = Design(attitude, attitude[:0], attitude[:0, 0])
        return hand_held_information(question.imu, question.parameters, design, question.accuracy, question.gravity)

    every = jax.vmap(one, (None, 0))
    return in_chunks(lambda pairs: stored.call(every, f"{question.key} guide", question, pairs), len(_BOX), pairs)
