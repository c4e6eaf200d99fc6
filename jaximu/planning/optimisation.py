"""Designs that make a criterion small: gradient through the Fisher information, on the group of rotations.

A design moves by rotation vectors about its last iterate, q ← q exp(δ), so no attitude is singular. Limits of the
equipment (turns by hand, z never down) are constraints of sequential quadratic programming; rates keep to a box.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import lru_cache
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float
from scipy.optimize import minimize

from jaximu.data.attitude import INTERVALS
from jaximu.estimation.problem import Name, Parameters
from jaximu.ground import stored
from jaximu.ground.array_types import Array, FloatArray
from jaximu.ground.errors import InputError, nearest
from jaximu.ground.rotation import exponential, multiply
from jaximu.model.sensor import Imu
from jaximu.planning.information import (
    COARSE,
    Accuracy,
    Design,
    hand_held_information,
    robot_information,
    table_information,
    turn_vectors,
    up_vectors,
)

CRITERIA: dict[str, Callable[[Array, Array], Array]] = {
    "D": lambda covariance, _: jnp.linalg.slogdet(covariance)[1] / (2 * covariance.shape[0]),
    "A": lambda covariance, _: jnp.log(jnp.trace(covariance) / covariance.shape[0]) / 2,
    "parameter": lambda covariance, weights: jnp.log(weights @ covariance @ weights) / 2,
}
"""Logarithms of a standard deviation: the geometric mean along the axes of the uncertainty's ellipsoid, the root mean
square of all parameters (both in typical sizes), that of one combination of parameters."""


def criterion_of(criterion: str, parameter: str | None, names: Sequence[Name]) -> tuple[str, FloatArray]:
    """Return the key of a criterion in `CRITERIA`, and the weights (p,) that it looks at.

    Raises `InputError` for one that is not known, or for a `parameter` that is none of the names.
    """
    if parameter is None:
        if criterion not in ("D", "A"):
            raise InputError(f"the criterion {criterion!r} is not known; use D, A, or name one parameter.")
        return criterion, np.zeros(len(names))
    if parameter not in names:
        raise InputError(f"there is no parameter {parameter!r} in this plan; {nearest(parameter, names)}")
    return "parameter", np.array([float(name == parameter) for name in names])


STEPS, FEW_STEPS = (40, 200), (15, 40)
"""Steps of every start and of the best; and where each takes long."""
_CLOSE = 1e-7
"""Change of the criterion's logarithm at which a search ends."""


class DesignQuestion(eqx.Module):
    """What a design is asked for, all but the design.

    imu, parameters: what may be unknown, effects included. prior: information about the parameters (in typical sizes)
    that is there already. by_gravity: what one sigma of gravity does to them, which no pose can tell. weights: the
    combination of parameters that the criterion "parameter" looks at. turn_limit: rad, the largest turn by hand or of a
    robot. duration: s, of a robot's motion; None: it is none. coarse: whether its motion is cut into few intervals.
    """

    imu: Imu
    parameters: Parameters
    prior: Float[Array, "p p"]
    by_gravity: Float[Array, " p"]
    weights: Float[Array, " p"]
    accuracy: Accuracy
    gravity: Float[Array, ""]
    turn_limit: Float[Array, ""]
    by_hand: bool = eqx.field(static=True)
    z_up: bool = eqx.field(static=True)
    criterion: str = eqx.field(static=True)
    duration: float | None = eqx.field(static=True, default=None)
    coarse: bool = eqx.field(static=True, default=False)

    @property
    def chained(self) -> bool:
        """Whether each turn leads from one attitude to the next."""
        return self.by_hand or self.duration is not None

    @property
    def key(self) -> str:
        """Tells compiled functions of different questions apart."""
        return f"plan {self.by_hand} {self.z_up} {self.criterion} {self.duration} {self.coarse}"


class Step(NamedTuple):
    """A change of a design: rotation vectors (body frame, rad) of its attitudes and axes, and the new rates (rad/s)."""

    attitude: Float[Array, "P 3"]
    axis: Float[Array, "M 3"]
    rate: Float[Array, " M"]


class DesignCovariance(NamedTuple):
    """Of the parameters in typical sizes, with a design; and the design's own information."""

    covariance: Float[Array, "p p"]
    information: Float[Array, "p p"]


def _covariance(question: DesignQuestion, design: Design) -> DesignCovariance:
    known = question.imu, question.parameters, design, question.accuracy, question.gravity
    if question.duration is not None:
        information = robot_information(*known, COARSE if question.coarse else INTERVALS, question.duration)
    else:
        information = (hand_held_information if question.by_hand else table_information)(*known)
    total = jnp.linalg.inv(question.prior + information) + jnp.outer(question.by_gravity, question.by_gravity)
    return DesignCovariance(total, information)


def _limits(question: DesignQuestion, design: Design) -> Float[Array, " c"]:
    """What the equipment cannot do, as numbers that must not be negative."""
    limits = []
    if question.chained:
        limits.append(1 - jnp.sum(turn_vectors(design.attitude) ** 2, axis=-1) / question.turn_limit**2)
    if question.z_up:
        limits += [up_vectors(attitude)[:, 2] for attitude in (design.attitude, design.axis)]
    return jnp.concatenate(limits) if limits else jnp.zeros(0)


def _moved(design: Design, step: Step) -> Design:
    return Design(
        multiply(design.attitude, exponential(step.attitude)), multiply(design.axis, exponential(step.axis)), step.rate
    )


def covariance(question: DesignQuestion, design: Design) -> DesignCovariance:
    """Return the covariance that a design leaves, and its own information, both in typical sizes (NumPy)."""
    return stored.call(_covariance, f"{question.key} covariance", question, design)


def score(question: DesignQuestion, covariance: Float[Array, "p p"]) -> float:
    """Return the criterion of a covariance in typical sizes, as a standard deviation."""

    def value(question, covariance):
        return CRITERIA[question.criterion](covariance, question.weights)

    return float(np.exp(stored.call(value, f"{question.key} score", question, np.asarray(covariance))))


def objective(question: DesignQuestion, design: Design, step: Step) -> tuple[float, Step]:
    """Return the logarithm of the criterion after a step, and its gradient by the step."""

    def value(question, design, step):
        return CRITERIA[question.criterion](_covariance(question, _moved(design, step)).covariance, question.weights)

    slope = jax.value_and_grad(value, argnums=2)
    logarithm, gradient = stored.call(slope, f"{question.key} slope", question, design, step)
    return float(logarithm), gradient


def _limited(question: DesignQuestion, design: Design, step: Step) -> tuple[FloatArray, FloatArray]:
    """The limits (c,) after a step, and their derivatives (c, n) by all its numbers."""

    def of(question, design, step):
        limits = _limits(question, _moved(design, step))
        return limits, limits

    slopes = jax.jacrev(of, argnums=2, has_aux=True)
    by_step, left = stored.call(slopes, f"{question.key} limits", question, design, step)
    return left, np.concatenate([slope.reshape(len(left), -1) for slope in by_step], axis=1)


def _descend(question: DesignQuestion, design: Design, fastest: float, iterations: int) -> tuple[float, Design]:
    """Minimise from one start, in the chart about it."""
    poses = len(design.attitude)
    turns = len(design.rate)
    ends = 3 * poses, 3 * (poses + turns)

    def step(vector: np.ndarray) -> Step:
        attitude, axis, rate = np.split(vector, ends)
        return Step(attitude.reshape(-1, 3), axis.reshape(-1, 3), rate)

    def evaluate(vector):
        value, gradient = objective(question, design, step(vector))
        return value, np.concatenate([np.ravel(part) for part in gradient])

    start = np.concatenate([np.zeros(ends[1]), design.rate])
    bounds = [(None, None)] * ends[1] + [(-fastest, fastest)] * turns
    limits = []
    if question.chained or question.z_up:
        known = lru_cache(maxsize=1)(lambda key: _limited(question, design, step(np.frombuffer(key))))
        limits = [{"type": "ineq", "fun": lambda x: known(x.tobytes())[0], "jac": lambda x: known(x.tobytes())[1]}]
    solution = minimize(
        evaluate,
        start,
        jac=True,
        method="SLSQP",
        bounds=bounds,
        constraints=limits,
        options={"maxiter": iterations, "ftol": _CLOSE},
    )
    return float(solution.fun), stored.call(_moved, "plan moved", design, step(solution.x))


def optimise(
    question: DesignQuestion,
    starts: Sequence[Design],
    fastest: float,
    report: Callable[[str], None],
    steps: tuple[int, int],
) -> Design:
    """Return the best design that is reached from the starts.

    **Arguments:** `starts`: designs (NumPy) with the same numbers of poses and turns, none at a saddle such as a rate
    of zero. `fastest`: the largest rate of a table (rad/s). `report` receives what is being worked on, in words.
    `steps`: of every start, and of the best two.

    All starts go some way; the two best of them go to the end. The same input gives the same design.
    """

    def descend(designs: Sequence[Design], iterations: int, words: str) -> list[tuple[float, Design]]:
        ends = []
        for number, design in enumerate(designs):
            report(f"{words} {number + 1} of {len(designs)}")
            ends.append(_descend(question, design, fastest, iterations))
        return sorted(ends, key=lambda end: end[0])

    best = descend(starts, steps[0], "design")
    ends = descend([design for _, design in best[:2]], steps[1], "best design")
    return ends[0][1]
