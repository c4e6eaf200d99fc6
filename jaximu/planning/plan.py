"""`Proposal`: the next poses and turns that most reduce a stated uncertainty, with what they are expected to gain."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import zip_longest

import numpy as np
from scipy.spatial.transform import Rotation

from jaximu.calibration import Calibration
from jaximu.data.attitude import INTERVALS
from jaximu.estimation.problem import TOLERANCE, Name, Parameters, names_of, without_equipment
from jaximu.estimation.uncertainty import WeakDirection, weak_directions
from jaximu.ground.array_types import FloatArray
from jaximu.ground.document import SOFTWARE, Document, Json, entries
from jaximu.ground.errors import InputError
from jaximu.ground.gravity import STANDARD, LocalGravity
from jaximu.ground.page import Result
from jaximu.ground.precision import require_float64
from jaximu.ground.rotation import UP
from jaximu.ground.tracing import on_host, part_of
from jaximu.ground.vectors import dot_rows, sigmas_of, submatrix
from jaximu.model.effects import CATALOGUE
from jaximu.model.sensor import Imu, Triad
from jaximu.planning.information import (
    COARSE,
    RAMP,
    STIMULI,
    Accuracy,
    Design,
    gravity_sensitivity,
    root_of,
    turn_vectors,
)
from jaximu.planning.optimisation import (
    FEW_STEPS,
    STEPS,
    DesignCovariance,
    DesignQuestion,
    covariance,
    criterion_of,
    optimise,
    score,
)
from jaximu.planning.poses import (
    attitude_words,
    first_heading,
    heading_of,
    pose_words,
    round_attitude,
    round_direction,
    short_order,
    up_of,
)
from jaximu.planning.setup_errors import noise_squares
from jaximu.simulation import ACCELEROMETER_DENSITY, GYROSCOPE_DENSITY, Specification
from jaximu.simulation.protocols.course import attitude_of
from jaximu.simulation.protocols.positions import directions, spiral

SCHEMA = "jaximu.plan/1"
_STARTS, _FEW_STARTS = 10, 4
AS_GOOD = 1.001
"""A well-known scheme is proposed where the best is better by no more than this."""
_MOUNTING = TOLERANCE * 0.1
"""How far (rad) a table's frame may lie from that of a calibration by hand: as far as a misalignment may."""


@dataclass(frozen=True)
class Equipment:
    """What poses and turns are made with: its limits and usual durations.

    rest, turn, setting: s at rest, turning, and to set the next pose. step: degrees that a person sets angles to.
    fastest: degrees per second; turn_limit: degrees, of a turn by hand or of a robot, so that the direct way is clear.
    accuracy: degrees, one sigma of each axis of the attitude that a robot or tracker reports; None: there is none.
    in_sequence: whether the unit is recorded while it is turned from one position to the next.
    """

    name: str
    rest: float
    turn: float
    step: float
    setting: float = 0.0
    by_hand: bool = False
    z_up: bool = False
    fastest: float = 0.0
    turn_limit: float = 150.0
    accuracy: float | None = None
    in_sequence: bool = False

    @property
    def words(self) -> str:
        """Where or how poses are made with it."""
        return "by hand" if self.by_hand else f"on the {self.name.replace('-', ' ')}"

    @property
    def robot(self) -> bool:
        """Whether it reports the attitude."""
        return self.accuracy is not None

    @property
    def chained(self) -> bool:
        """Whether each turn leads from one pose to the next."""
        return self.by_hand or self.in_sequence or self.robot

    @property
    def largest_turn(self) -> float:
        """Radians of a turn from one pose to the next at the most: a robot's rate is limited, too."""
        fastest = (1 - RAMP) * self.fastest * self.turn if self.robot else self.turn_limit
        return float(np.radians(min(self.turn_limit, fastest)))


EQUIPMENT = {
    "hands": Equipment("hands", 4.0, 1.5, 15.0, by_hand=True),
    "table": Equipment("table", 10.0, 8.0, 5.0, setting=20.0, fastest=90.0),
    "robot": Equipment("robot", 4.0, 4.0, 1.0, fastest=60.0, turn_limit=330.0, accuracy=0.05),
    "dividing-head": Equipment("dividing-head", 60.0, 9.0, 5.0, setting=20.0, z_up=True, fastest=30.0),
}


@dataclass(frozen=True)
class Known:
    """What is known of a unit before the next poses.

    imu: the unit. names, covariance: of its parameters, in their own units, gravity's uncertainty included; None where
    the data sheet is all. noise: densities (3, 3) in output units² · s of both triads, two-sided. excess: variance
    beyond the noise of a mean accelerometer output, a turn, a mean gyroscope output (traces, output units²; of a turn,
    of the output integrated over it).
    """

    imu: Imu
    names: tuple[Name, ...] = ()
    covariance: FloatArray | None = None
    gravity: LocalGravity = STANDARD
    accelerometer_noise: FloatArray | None = None
    gyroscope_noise: FloatArray | None = None
    excess: tuple[float, float, float] = (0.0, 0.0, 0.0)
    source: str = "the data sheet"

    @classmethod
    def from_calibration(cls, calibration: Calibration, source: str = "the calibration") -> Known:
        """Return what a calibration knows; its noise too where the recording is at hand (not from a file)."""
        known = cls(calibration.imu, calibration.names, calibration.covariance, calibration.gravity, source=source)
        observations = calibration.observations
        if observations is None:
            return replace(known, excess=_left_over(calibration))
        turns = observations.turns
        poses = part_of(observations.poses, np.asarray(observations.poses.mask))
        noise = np.asarray(turns.noise)
        turned = np.asarray(turns.interval)[np.asarray(turns.mask)]
        density = np.mean(poses.accelerometer_covariance * (poses.stop - poses.start)[:, None, None], axis=0)
        # variances as traces: the next rests and turns have other durations, their excess is the same
        excess = calibration.excess
        duration = float(turned.sum(axis=1).mean()) if len(turned) else 0.0
        return replace(
            known,
            accelerometer_noise=density,
            gyroscope_noise=noise if "turns" in excess else None,
            excess=(
                excess["accelerometer"] * float(np.trace(poses.accelerometer_covariance.mean(axis=0))),
                excess.get("turns", 0.0) * duration * float(noise.trace()),
                excess.get("gyroscope", 0.0) * float(np.trace(poses.gyroscope_covariance.mean(axis=0))),
            ),
        )

    @classmethod
    def from_specification(cls, specification: Specification) -> Known:
        """Return the first unit of a specification as its data sheet, with its white noise; nothing calibrated yet."""
        case = specification.case(0)
        noise = {
            name: _in_output(triad, np.diag(white))
            for name, triad in case.imu.triads().items()
            if (white := noise_squares(case, name).get("N")) is not None
        }
        gravity = LocalGravity(float(case.plan.motion.gravity), 0.0)
        return cls(
            case.imu, (), None, gravity, noise.get("accelerometer"), noise.get("gyroscope"), source=specification.name
        )


def _left_over(calibration: Calibration) -> tuple[float, float, float]:
    """Variances (traces, output units²) of a pose, a turn and a rest that explain the scatter a fit has left.

    Its rms, in SI, is all that a file tells; the conditions that the parameters took up are made up for.
    """
    left = {name: after for name, (_, after, _) in calibration.rms.items()}
    poses, turns = (calibration.data.get(name, 0) for name in ("poses", "turns"))
    scale = {name: float(np.trace(triad.gain @ triad.gain.T)) for name, triad in calibration.triads().items()}
    rotation = scale.get("gyroscope", 0.0)
    if "specific_force" in left:  # with equipment: vectors of three components, twelve parameters a triad
        force, turn = (3 * count / max(3 * count - 12, 1) / 3 for count in (poses, poses + turns))
        return (
            scale["accelerometer"] * force * left["specific_force"] ** 2,
            rotation * turn * np.radians(left.get("turn_angle", 0.0)) ** 2,
            rotation * turn * left.get("rate_at_rest", 0.0) ** 2,
        )
    directions = 2 * turns if "gravity_direction" in left else 0
    fitted = sum((name.owner, name.part) != ("gyroscope", "bias") for name in calibration.names)
    shrunk = (poses + directions) / max(poses + directions - fitted, 1)
    return (
        scale["accelerometer"] * shrunk * left.get("gravity_norm", 0.0) ** 2,
        rotation * shrunk * np.radians(left.get("gravity_direction", 0.0)) ** 2 / 2,
        rotation * left.get("static_gyroscope", 0.0) ** 2 / 3,
    )


@dataclass(frozen=True)
class Pose:
    """A pose: the body's upward direction (3,), its attitude (4,), body to level frame, and both in words."""

    up: FloatArray
    attitude: FloatArray
    words: str


@dataclass(frozen=True)
class Turn:
    """A turn about a body axis (3,) by an angle (rad) at a mean rate (rad/s), in words."""

    axis: FloatArray
    angle: float
    rate: float
    words: str


@dataclass(frozen=True, repr=False, eq=False)
class Proposal(Result, Document, page="plan"):
    """The next poses and turns, and what they are expected to do to the uncertainty.

    By hand and on a robot, turn k leads from pose k to the next. covariances: of the parameters (p, p), own units,
    without and with them; by_gravity (p,): what one sigma of gravity's error adds to the parameters, zero where that
    is another number. criterion_before, …_after, …_exact: the criterion as a standard deviation, …_exact before the
    angles were rounded. rank, open: what all data together determine, and directions they leave open.
    """

    equipment: Equipment
    criterion: str
    poses: tuple[Pose, ...]
    turns: tuple[Turn, ...]
    imu: Imu
    names: tuple[Name, ...]
    covariances: tuple[FloatArray, FloatArray]
    by_gravity: FloatArray
    criterion_before: float
    criterion_after: float
    criterion_exact: float
    rank: int
    open: tuple[WeakDirection, ...]
    source: str
    notes: tuple[str, ...]

    @property
    def before(self) -> FloatArray:
        """The standard deviations of the parameters (p,), own units, without the poses."""
        return sigmas_of(self.covariances[0])

    @property
    def after(self) -> FloatArray:
        """The standard deviations of the parameters (p,), own units, with the poses."""
        return sigmas_of(self.covariances[1])

    @property
    def gain(self) -> float:
        """How many times smaller the criterion's standard deviation becomes."""
        return self.criterion_before / self.criterion_after

    @property
    def rounding_loss(self) -> float:
        """By what share rounding the angles makes the criterion's standard deviation larger."""
        return self.criterion_after / self.criterion_exact - 1

    @property
    def schedule(self) -> str:
        """The poses and turns as a schedule (CSV), with time to set each of them.

        Of a table it is for `--reference`; of a robot or a sequence it is what to do, one after the other, headings
        included.
        """
        lines, now, setting = ["start [s],stop [s],kind,x,y,z,angle [deg],heading [deg]"], 0.0, self.equipment.setting
        robot = self.equipment.chained and not self.equipment.by_hand
        entries = [
            ("pose", pose.up, 0.0, self.equipment.rest, heading_of(pose.attitude) if robot else 0.0)
            for pose in self.poses
        ]
        turns = [("turn", turn.axis, np.degrees(turn.angle), self.equipment.turn, 0.0) for turn in self.turns]
        if robot:  # each turn follows its pose
            entries = [entry for pair in zip_longest(entries, turns) for entry in pair if entry]
        else:
            entries += turns
        for kind, vector, angle, duration, heading in entries:
            numbers = ",".join(f"{round(value, 12) + 0.0:.9g}" for value in (*vector, angle, heading))
            lines.append(f"{now:.9g},{now + duration:.9g},{kind},{numbers}")
            now += duration + setting
        return "\n".join(lines) + "\n"

    def document(self) -> Json:
        """Return the proposal as the JSON document of schema `jaximu.plan/1`."""
        sigmas = zip(self.names, self.before.tolist(), self.after.tolist(), strict=True)
        return {
            "schema": SCHEMA,
            **entries(self, "source", "rank", "notes"),
            "equipment": self.equipment.name,
            **entries(self.equipment, "rest", "turn"),
            "accuracy": None if self.equipment.accuracy is None else {"value": self.equipment.accuracy, "unit": "deg"},
            "poses": [entries(pose, "up", "attitude", "words") for pose in self.poses],
            "turns": [
                entries(turn, "axis", "words")
                | {"angle": float(np.degrees(turn.angle)), "angle_unit": "deg"}
                | {"rate": float(np.degrees(turn.rate)), "rate_unit": "deg/s"}
                for turn in self.turns
            ],
            "criterion": {
                "name": self.criterion,
                "before": self.criterion_before,
                "after": self.criterion_after,
                **entries(self, "gain", "rounding_loss"),
            },
            "sigma": {name: {"before": before, "after": after} for name, before, after in sigmas},
            "parameters": len(self.names),
            "open": [entries(direction, "text", "sigma", "determined") for direction in self.open],
            "software": SOFTWARE,
        }


def propose(
    known: Known,
    equipment: Equipment = EQUIPMENT["hands"],
    poses: int = 12,
    criterion: str = "D",
    parameter: str | None = None,
    turns: int | None = None,
    seed: int = 0,
    report: Callable[[str], None] = lambda _: None,
) -> Proposal:
    """Return the poses and turns that make a criterion small.

    **Arguments:**

    - `poses`: how many; by hand and on a robot at least two, one turn between each two.
    - `criterion`: `"D"`, the geometric mean of the standard deviations along the axes of the uncertainty's ellipsoid;
      `"A"`, the root mean square of all (both in typical sizes, see `jaximu.estimation.problem.typical_sizes`).
      `parameter`: the name of one, `accelerometer.gain[0,0]`, whose standard deviation is the criterion instead.
    - `turns`: of a table, as many as poses by default; none where the unit has no gyroscope.
    - `report`: receives what is being worked on, in words, for a search may take a minute.

    Raises `InputError` for an unknown parameter or criterion, or a number of poses or turns that cannot be.
    """
    require_float64()
    question, notes = question_of(known, equipment, criterion, parameter, poses)
    has_gyroscope = question.imu.gyroscope is not None
    turns = (poses if turns is None else turns) if has_gyroscope and not equipment.chained else 0
    if poses < (2 if equipment.chained else 1):
        raise InputError(f"a plan {equipment.words} needs at least {'two poses' if equipment.chained else 'one'}.")
    if turns < 0:
        raise InputError(f"the number of turns must not be negative, found {turns}.")
    exact, design, best, classical = _searched(question, poses, turns, equipment, seed, report)
    if classical:
        notes += ("well known positions do as well as any here, and are proposed.",)
    names = question.parameters.names
    size = question.parameters.size
    prior = np.linalg.inv(question.prior) + np.outer(question.by_gravity, question.by_gravity)
    # what the data sheet adds is none of the data's: it must not hide a direction that no pose tells
    root = root_of(best.information + question.prior - np.eye(len(size)) / TOLERANCE**2)
    rank, weak = weak_directions(root.T, names, size, question.imu)
    stages = prior, best.covariance, covariance(question, exact).covariance
    unit = float(size @ question.weights) or 1.0  # of a parameter; else a typical size
    criteria = (score(question, stage) * unit for stage in stages)
    return Proposal(
        equipment,
        parameter or criterion,
        tuple(Pose(up_of(attitude), attitude, _words(attitude, equipment)) for attitude in design.attitude),
        _turns(design, equipment),
        question.imu,
        names,
        (size[:, None] * prior * size, size[:, None] * best.covariance * size),
        size * question.by_gravity,
        *criteria,
        rank=rank,
        open=weak,
        source=known.source,
        notes=notes,
    )


def _searched(
    question: DesignQuestion, poses: int, turns: int, equipment: Equipment, seed: int, report: Callable[[str], None]
) -> tuple[Design, Design, DesignCovariance, bool]:
    """The best design; it rounded, or a classical one that does as well; what this leaves; whether it is classical."""
    fastest = np.radians(equipment.fastest)
    starts = _starts(poses, turns, equipment, seed)[: _FEW_STARTS if equipment.robot else None]
    sought = optimise(_coarsened(question), starts, fastest, report, FEW_STEPS if equipment.robot else STEPS)
    exact = _ordered(sought, equipment)
    design = _rounded(exact, equipment)
    best = covariance(question, design)
    if not equipment.chained and _classical(poses, equipment):
        simple = _ordered(starts[0], equipment)
        plain = covariance(question, simple)
        if score(question, plain.covariance) <= AS_GOOD * score(question, best.covariance):
            return exact, simple, plain, True
    return exact, design, best, False


# --- the question -----------------------------------------------------------------------------------------------------


def question_of(
    known: Known, equipment: Equipment, criterion: str, parameter: str | None, poses: int = 12
) -> tuple[DesignQuestion, tuple[str, ...]]:
    """Return what a design is asked for, and notes on what had to be assumed; arguments as in [`propose`]."""
    for name, unit in {"rest": "", "turn": "", "step": "", "accuracy": " degrees"}.items():
        value = getattr(equipment, name)
        if value is not None and not (np.isfinite(value) and value > 0):
            raise InputError(f"the {name} must be greater than zero{unit}, found {value:g}.")
    if equipment.robot and known.imu.gyroscope is None:
        raise InputError(
            "a robot's attitude calibrates a gyroscope, and this unit has none: plan for a table, --equipment table."
        )
    imu, notes = _plannable(known.imu)

    def keep(name: Name) -> bool:
        if name.effect is not None:
            return name.part == "coefficients" and name.owner != "setup"
        return not equipment.chained or without_equipment(name)

    parameters = Parameters.select(imu, keep)
    criterion, weights = criterion_of(criterion, parameter, parameters.names)
    by_gravity = gravity_sensitivity(imu, parameters.names, known.gravity) / parameters.size
    if known.covariance is not None and not equipment.chained and _is_by_hand(known.names):
        notes += (
            "a calibration by hand has the accelerometer's axes for its frame; how they lie to the table's is "
            "taken as open.",
        )
    if equipment.robot:
        notes += (
            f"the attitude's error is taken as {equipment.accuracy:g}° (1 σ, each axis), independent from stamp to "
            "stamp, and the gyroscope's bias as constant; what is off alike in all poses, such as a bent arm, is not "
            "in the prediction.",
        )
    accuracy, more = _accuracy(known, imu, equipment)
    question = DesignQuestion(
        imu,
        parameters,
        _prior(known, imu, parameters, by_gravity),
        by_gravity,
        weights,
        accuracy,
        np.asarray(known.gravity.value),
        np.asarray(equipment.largest_turn),
        equipment.by_hand,
        equipment.z_up,
        criterion,
        poses * equipment.rest + (poses - 1) * equipment.turn if equipment.robot else None,
    )
    return question, (*notes, *more)


def _coarsened(question: DesignQuestion) -> DesignQuestion:
    """The question that a design is sought for: a robot's attitude at fewer stamps, each as good as those it is for."""
    if question.duration is None:
        return question
    accuracy = question.accuracy
    alike = replace(accuracy, attitude=accuracy.attitude * np.sqrt(COARSE / INTERVALS))
    return replace(question, accuracy=alike, coarse=True)


def _plannable(imu: Imu) -> tuple[Imu, tuple[str, ...]]:
    """The unit with its effects dormant, but for those that poses and turns do not excite or that do not last."""
    dormant = []
    notes = []
    for effect in (effect for triad in imu.triads().values() for effect in triad.effects):
        if effect.scope == "device" and set(effect.needs) <= set(STIMULI) and not effect.memory:
            dormant.append(CATALOGUE[effect.name].dormant(**{key: getattr(effect, key) for key in effect.inner}))
        else:
            notes.append(f"{effect.title} is left as it is: poses and turns at one temperature do not determine it.")
    return on_host(imu.with_effects(*dormant)), tuple(notes)


def _in_output(triad: Triad, density: FloatArray) -> FloatArray:
    return triad.gain @ density @ triad.gain.T


def _accuracy(known: Known, imu: Imu, equipment: Equipment) -> tuple[Accuracy, tuple[str, ...]]:
    notes = []
    densities = []
    figures = {
        "accelerometer": (ACCELEROMETER_DENSITY, "100 µg/√Hz", known.accelerometer_noise),
        "gyroscope": (GYROSCOPE_DENSITY, "0.005 °/s/√Hz", known.gyroscope_noise),
    }
    for name, (typical, words, density) in figures.items():
        triad = imu.triads().get(name)
        if triad is None:
            density = np.eye(3)
        elif density is None:
            density = _in_output(triad, typical**2 * np.eye(3))
            left = ", and the scatter that the calibration left" if any(known.excess) else ""
            notes.append(f"the {name}'s noise is not known here: a typical consumer unit's {words} is assumed{left}.")
        densities.append(density)
    rest = [density / equipment.rest for density in densities]
    white = np.trace(rest[0]), np.trace(densities[1]) * equipment.turn, np.trace(rest[1])
    turn, still, attitude = map(np.asarray, (equipment.turn, equipment.rest, np.radians(equipment.accuracy or 0.0)))
    return Accuracy(rest[0], rest[1], densities[1], np.array(known.excess) / white, turn, still, attitude), tuple(notes)


def _prior(known: Known, imu: Imu, parameters: Parameters, by_gravity: FloatArray) -> FloatArray:
    """Information (typical sizes) about the parameters, gravity known: the calibration's, else the data sheet's."""
    names = parameters.names
    size = parameters.size
    total = TOLERANCE**2 * np.eye(len(names))
    if known.covariance is not None:
        upper = [index for index, name in enumerate(names) if name in _UPPER]
        by_hand = _is_by_hand(known.names)
        covariance = known.covariance
        if not upper and not by_hand and set(_UPPER) <= set(known.names):
            covariance = _in_hand_frame(covariance, known.names, imu)
        indices = [index for index, name in enumerate(names) if name in known.names]
        rows = [known.names.index(names[index]) for index in indices]
        total[np.ix_(indices, indices)] = submatrix(covariance, rows) / size[indices][:, None] / size[indices]
        if upper and by_hand:
            # by hand the accelerometer's axes are the frame; how they lie to a table's is open, for both triads alike
            frame = _frame(imu, names) / size[:, None]
            total[upper, :] = total[:, upper] = 0.0
            total += _MOUNTING**2 * frame @ frame.T
        if known.gravity.sigma > 0 and by_gravity.any():
            total = _gravity_known(total, by_gravity)
    try:
        np.linalg.cholesky(total)
    except np.linalg.LinAlgError as error:
        raise InputError(f"{known.source}: the covariance of its parameters is not positive definite.") from error
    return np.asarray(np.linalg.inv(total), float)


_UPPER = tuple(name for name in names_of(Imu.nominal()) if not without_equipment(name))
_CROSS = np.cross(np.eye(3)[:, None], np.eye(3)).transpose(0, 2, 1)
"""[e_k]× for each axis k."""


def _is_by_hand(names: Sequence[Name]) -> bool:
    return not set(_UPPER) & set(names)


def _frame(imu: Imu, names: Sequence[Name]) -> FloatArray:
    """How gains (n, 3) react to a small rotation of the body frame: K → K (I + [ρ]×)."""
    change = np.zeros((len(names), 3))
    for index, name in enumerate(names):
        if name.part == "gain":
            row, column = name.axes
            change[index] = _CROSS[:, :, column] @ imu.triads()[name.owner].gain[row]
    return change


def _in_hand_frame(covariance: FloatArray, names: Sequence[Name], imu: Imu) -> FloatArray:
    """A table's covariance in the frame in which the accelerometer's gain is lower triangular."""
    frame = _frame(imu, names)
    upper = [names.index(name) for name in _UPPER]
    turned = np.eye(len(names))
    turned[:, upper] -= frame @ np.linalg.inv(frame[upper])
    return turned @ covariance @ turned.T


def _gravity_known(total: FloatArray, by_gravity: FloatArray) -> FloatArray:
    """Take what an uncertain gravity adds off a covariance: it is no error that further poses could reduce.

    The share is large and along one direction, so that it is found in the covariance itself; plain subtraction would
    leave rounding. In that direction a ten thousandth of the variance is kept at least.
    """
    along = by_gravity / (by_gravity @ by_gravity)
    variance = along @ total @ along
    response = total @ along / variance
    return total + (max(variance - 1.0, 1e-4 * variance) - variance) * np.outer(response, response)


# --- from a design to what a person does ------------------------------------------------------------------------------


def _classical(poses: int, equipment: Equipment) -> bool:
    """Whether faces, edges and corners of a cube make so many positions; they are the first start then."""
    return poses in (6, 8, 12, 26) and not equipment.z_up


def _starts(poses: int, turns: int, equipment: Equipment, seed: int) -> list[Design]:
    """Designs to start from: directions spread evenly, turned at random; a classical scheme where there is one."""
    rng = np.random.default_rng(seed)

    def spread(count: int) -> FloatArray:
        even = spiral(count)
        up = np.asarray(rng.permutation(Rotation.random(None, rng).apply(even)) if count else even, float)
        if equipment.z_up:
            up[:, 2] = np.abs(up[:, 2])
        return up

    def design(up: FloatArray, heading: FloatArray, axis: FloatArray) -> Design:
        sign = np.where(np.arange(turns) // 3 % 2, -1.0, 1.0)  # about three axes one way, then the other
        attitude = _attitudes(up, heading)
        axes = _attitudes(axis, np.zeros(turns))
        attitude = _neighbourly(attitude) if equipment.chained else attitude
        return Design(attitude, axes, np.radians(equipment.fastest) * sign)

    made = [design(spread(poses), rng.uniform(-np.pi, np.pi, poses), spread(turns)) for _ in range(_STARTS)]
    if _classical(poses, equipment):
        up, heading = zip(*directions(poses), strict=True)
        made.insert(0, design(np.array(up), np.array(heading), np.resize(np.eye(3), (turns, 3))))
    return made


def _ordered(design: Design, equipment: Equipment) -> Design:
    """Poses and turns of a table in an order with short ways; else the order is part of the design."""
    if equipment.chained:
        return design
    poses, turns = (
        short_order(up_of(attitudes)) if len(attitudes) else [] for attitudes in (design.attitude, design.axis)
    )
    return Design(design.attitude[poses], design.axis[turns], design.rate[turns])


def _attitudes(up: FloatArray, heading: FloatArray | float = 0.0) -> FloatArray:
    """Attitudes (n, 4) with these upward directions (n, 3); there may be none."""
    return attitude_of(up, heading).as_quat(scalar_first=True) if len(up) else np.zeros((0, 4))


def _neighbourly(attitudes: FloatArray) -> FloatArray:
    """Attitudes in which neighbours have one sign: the shortest way leads from one to the next."""
    return attitudes * np.cumprod([1.0, *np.where(dot_rows(attitudes[1:], attitudes[:-1]) >= 0, 1.0, -1.0)])[:, None]


def _rounded(design: Design, equipment: Equipment) -> Design:
    step = np.radians(equipment.step)
    attitude = design.attitude
    if equipment.chained:
        zero = first_heading(attitude[0]) if equipment.by_hand else 0.0
        round_ = np.array([round_attitude(quaternion, step, zero) for quaternion in attitude])
        if equipment.by_hand:
            return replace(design, attitude=_neighbourly(round_))
        signs = np.where(dot_rows(round_, attitude) >= 0, 1.0, -1.0)
        return replace(design, attitude=round_ * signs[:, None])  # each turn goes the way that was sought
    up, axis = (
        _attitudes(np.array([round_direction(direction, step) for direction in up_of(part)]))
        for part in (attitude, design.axis)
    )
    return Design(up, axis, np.radians(np.degrees(design.rate).round(0)))


def _words(attitude: FloatArray, equipment: Equipment) -> str:
    if equipment.by_hand:
        return attitude_words(attitude)
    tilt = pose_words(up_of(attitude))
    return f"{tilt}; heading {heading_of(attitude):.4g}°".replace(" -", " −") if equipment.robot else tilt


def _turns(design: Design, equipment: Equipment) -> tuple[Turn, ...]:
    if not equipment.chained:
        return tuple(
            Turn(
                up,
                rate * equipment.turn,
                rate,
                f"{pose_words(up)}: {abs(np.degrees(rate)):.4g} °/s for {equipment.turn:g} s "
                f"({abs(np.degrees(rate)) * equipment.turn:.4g}°), {'anticlockwise' if rate > 0 else 'clockwise'} "
                "seen from above",
            )
            for up, rate in zip(up_of(design.axis), design.rate, strict=True)
        )
    turns = []
    for vector in np.asarray(turn_vectors(design.attitude)):
        angle = float(np.linalg.norm(vector))
        axis = vector / angle if angle > 0 else UP
        words = f"the direct way, {np.degrees(angle):.0f}°"
        if equipment.robot:
            about = ", ".join(f"{component + 0.0:.3f}" for component in np.round(axis, 3))
            words = f"{np.degrees(angle):.1f}° about ({about}) of the unit's axes"
        turns.append(Turn(axis, angle, angle / equipment.turn, words))
    return tuple(turns)
