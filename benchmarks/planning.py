"""Planned poses against classical and random ones: the criterion, and the errors measured on simulated units.

The criterion D is the geometric mean of the standard deviations along the axes of the uncertainty's ellipsoid, in
typical sizes; the measured figure is the same of the errors' scatter, from the determinant of their mean square (the
bias of a determinant from so many units is taken off). Table: least squares on mean outputs, in NumPy. By hand: the
joint fit of poses and turns. Units deviate from their data sheet by up to 2 %.
"""

import os

os.environ.setdefault("JAX_PLATFORMS", "cpu")

import jax

jax.config.update("jax_enable_x64", True)

from dataclasses import dataclass, replace  # noqa: E402

import numpy as np  # noqa: E402
from common import Table, arguments, finish  # noqa: E402
from scipy.spatial.transform import Rotation  # noqa: E402
from scipy.special import digamma  # noqa: E402

from jaximu import LocalGravity  # noqa: E402
from jaximu.calibration import fit_hand_held  # noqa: E402
from jaximu.estimation.problem import flatten, names_of  # noqa: E402
from jaximu.ground.units import STANDARD_GRAVITY  # noqa: E402
from jaximu.model.sensor import Imu  # noqa: E402
from jaximu.planning import EQUIPMENT, Design, Known, propose  # noqa: E402
from jaximu.planning.optimisation import covariance, score  # noqa: E402
from jaximu.planning.plan import question_of  # noqa: E402
from jaximu.recordings.observations import Observations, Poses, Turns  # noqa: E402
from jaximu.simulation import ACCELEROMETER_DENSITY, GYROSCOPE_DENSITY, draw_imu  # noqa: E402
from jaximu.simulation.protocols.course import attitude_of  # noqa: E402
from jaximu.simulation.protocols.positions import directions  # noqa: E402

POSES, RANDOM, SAMPLES = 12, 20, 16
GRAVITY = LocalGravity(STANDARD_GRAVITY, 0.0)
HEAD = np.array([[0, 0, 1], [1, 0, 0], [0, 1, 0], [-1, 0, 0], [0, -1, 0]], float)  # S16: z never down


@dataclass
class Case:
    """A set-up, what is known before, and the schemes compared in it."""

    title: str
    equipment: object
    known: Known
    schemes: dict
    planned: object


def quaternions(up, heading=0.0):
    return attitude_of(np.asarray(up, float), heading).as_quat(scalar_first=True)


def of_table(up, axis, rate):
    return Design(quaternions(up), quaternions(axis), np.broadcast_to(np.radians(rate), len(axis)).astype(float))


def by_hand(attitudes):
    attitudes = np.array(attitudes)
    for place in range(1, len(attitudes)):
        attitudes[place] *= 1.0 if attitudes[place] @ attitudes[place - 1] >= 0 else -1.0
    return Design(attitudes, np.zeros((0, 4)), np.zeros(0))


def sphere(rng, count, z_up=False):
    up = rng.standard_normal((count, 3))
    up[:, 2] = np.abs(up[:, 2]) if z_up else up[:, 2]
    return up / np.linalg.norm(up, axis=1, keepdims=True)


def planned_design(proposal):
    attitudes = np.array([pose.attitude for pose in proposal.poses])
    if proposal.equipment.by_hand:
        return by_hand(attitudes)
    axes = quaternions([turn.axis for turn in proposal.turns])
    return Design(attitudes, axes, np.array([turn.rate for turn in proposal.turns]))


def cases():
    nominal = Known(Imu.nominal(), gravity=GRAVITY)
    rng = np.random.default_rng(0)
    table, head, hands = (EQUIPMENT[name] for name in ("table", "dividing-head", "hands"))
    edges, headings = (np.array(part) for part in zip(*directions(12), strict=True))
    both_ways = np.resize(np.eye(3), (12, 3)), table.fastest * np.where(np.arange(12) // 3 % 2, -1.0, 1.0)
    random_table = [of_table(sphere(rng, 12), sphere(rng, 12), rng.uniform(-1, 1, 12) * table.fastest)
                    for _ in range(RANDOM)]  # fmt: skip
    classical = {"twelve positions": [of_table(edges, *both_ways)], "random": random_table}
    yield Case("table, nothing known before", table, nominal, classical, propose(nominal, table, POSES))

    # a first session on the table that never turned the unit over: nine poses within 30° of z up, turns about z
    first = sphere(rng, 9, z_up=True) * [0.4, 0.4, 1.0]
    question, _ = question_of(nominal, table, "D", None)
    before = covariance(question, of_table(first, np.tile([0.0, 0, 1], (4, 1)), [90.0, -90, 45, -45])).covariance
    size = np.asarray(question.parameters.size)
    lopsided = replace(nominal, names=question.parameters.names, covariance=before * size[:, None] * size)
    yield Case("table, after nine poses near z up", table, lopsided, classical, propose(lopsided, table, POSES))

    turns = np.resize(HEAD[:3], (12, 3)), head.fastest * np.where(np.arange(12) // 3 % 2, -1.0, 1.0)
    schemes = {
        "five positions, repeated": [of_table(np.resize(HEAD, (12, 3)), *turns)],
        "random": [of_table(sphere(rng, 12, True), sphere(rng, 12, True), rng.uniform(-1, 1, 12) * head.fastest)
                   for _ in range(RANDOM)],
    }  # fmt: skip
    yield Case("dividing head, z never down", head, nominal, schemes, propose(nominal, head, POSES))

    schemes = {
        "twelve positions": [by_hand(quaternions(edges, headings))],
        "random": [by_hand(Rotation.random(12, rng).as_quat(scalar_first=True)) for _ in range(RANDOM)],
    }
    yield Case("by hand, nothing known before", hands, nominal, schemes, propose(nominal, hands, POSES))


def determinant_error(errors):
    """Geometric mean of the scatter along the axes of the errors' ellipsoid, without the bias of a determinant."""
    units, size = errors.shape
    _, value = np.linalg.slogdet(errors.T @ errors / units)
    bias = np.sum(digamma((units - np.arange(size)) / 2)) + size * np.log(2 / units)
    return float(np.exp((value - bias) / (2 * size)))


def errors_of_table(case, design, question, imus, rng):
    """Least squares on mean outputs, whitened, with what was known before as further rows."""
    equipment = case.equipment
    sigmas = np.array([ACCELEROMETER_DENSITY, GYROSCOPE_DENSITY]) / np.sqrt(equipment.rest)
    turning = GYROSCOPE_DENSITY / np.sqrt(equipment.turn)
    up, axis = (Rotation.from_quat(np.asarray(each), scalar_first=True).inv().apply([0, 0, 1.0])
                for each in (design.attitude, design.axis))  # fmt: skip
    still = np.zeros_like(up)
    rows = [(0, STANDARD_GRAVITY * up, sigmas[0]), (1, still, sigmas[1]),
            (1, np.asarray(design.rate)[:, None] * axis, turning)]  # fmt: skip
    size = np.asarray(question.parameters.size)
    root = np.linalg.cholesky(question.prior).T
    found = []
    for imu in imus:
        truth = np.concatenate(
            [np.ravel(part) for t in (imu.accelerometer, imu.gyroscope) for part in (t.gain, t.bias)]
        )
        blocks, values = [root], [root @ (truth / size + np.linalg.solve(root, rng.standard_normal(len(size))))]
        for triad, stimulus, sigma in rows:
            for output in range(3):
                block = np.zeros((len(stimulus), len(size)))
                block[:, 12 * triad + 3 * output : 12 * triad + 3 * output + 3] = stimulus
                block[:, 12 * triad + 9 + output] = 1.0
                values.append(block @ truth / sigma + rng.standard_normal(len(stimulus)))
                blocks.append(block * size / sigma)
        solved = np.linalg.lstsq(np.concatenate(blocks), np.concatenate(values), rcond=None)[0]
        found.append(solved - truth / size)
    return np.array(found)


def stack(trees):
    return jax.tree.map(lambda *leaves: np.stack([np.asarray(leaf) for leaf in leaves]), *trees)


def observations(imu, attitudes, equipment, rng):
    count, turn = len(attitudes), equipment.turn
    attitudes = Rotation.from_quat(np.asarray(attitudes), scalar_first=True)
    up = attitudes.inv().apply([0.0, 0.0, 1.0])
    rates = np.repeat((attitudes[:-1].inv() * attitudes[1:]).as_rotvec()[:, None] / turn, SAMPLES, axis=1)
    gain, bias = (
        [np.asarray(getattr(t, name)) for t in (imu.accelerometer, imu.gyroscope)] for name in ("gain", "bias")
    )
    sigma = np.array([ACCELEROMETER_DENSITY, GYROSCOPE_DENSITY]) / np.sqrt(equipment.rest)
    at_rest = [s**2 * np.tile(np.eye(3), (count, 1, 1)) for s in sigma]
    noise = rng.standard_normal(rates.shape) * GYROSCOPE_DENSITY * np.sqrt(SAMPLES / turn)
    constant = np.ones(count)
    return Observations(
        Poses(
            STANDARD_GRAVITY * up @ gain[0].T + bias[0] + sigma[0] * rng.standard_normal((count, 3)), at_rest[0],
            bias[1] + sigma[1] * rng.standard_normal((count, 3)), at_rest[1],
            0 * constant, constant, 25 * constant, np.ones(count, bool),
        ),
        Turns(
            rates @ gain[1].T + bias[1] + noise, np.full(rates.shape[:2], turn / SAMPLES),
            GYROSCOPE_DENSITY**2 * np.eye(3), np.linalg.svd(up[1:, None, :])[2][:, 1:, :], np.ones(count - 1, bool),
        ),
        np.asarray(STANDARD_GRAVITY),
    )  # fmt: skip


def errors_by_hand(case, design, question, imus, rng):
    seen = stack([observations(imu, design.attitude, case.equipment, rng) for imu in imus])
    fit = fit_hand_held(stack([Imu.nominal()] * len(imus)), seen)
    places = [names_of(imus[0]).index(name) for name in fit.names]
    error = fit.values - np.stack([flatten(imu) for imu in imus])[:, places]
    good = np.asarray(fit.converged)
    if not good.all():
        print(f"{np.sum(~good)} of {len(good)} fits did not converge and are left out")
    return (error / np.asarray(question.parameters.size))[good]


def main() -> None:
    small = arguments(__doc__).small
    units = 60 if small else 200
    imus = [draw_imu(seed) for seed in range(units)]
    shown = Table(
        f"Twelve poses planned, classical and random: D-criterion and the errors of {units} simulated units",
        [
            "set-up",
            "scheme",
            "D predicted",
            "against planned",
            "D measured",
            "against planned",
            "measured / predicted",
            "RMSE measured",
            "against planned",
        ],
        "In 1e-6 of a typical size. D: geometric mean of standard deviations; RMSE: of all parameters together. "
        f"Random: the median of {RANDOM} schemes. The twelve positions are a spherical 2-design, which no other scheme "
        "can beat on a table for a linear model and equal noise: there the plan is these very positions, and equality "
        "the truth.",
    )
    figures = {"units": units}
    for case in cases():
        question, _ = question_of(case.known, case.equipment, "D", None)
        measure = errors_by_hand if case.equipment.by_hand else errors_of_table
        rows = []
        for name, designs in {"planned": [planned_design(case.planned)], **case.schemes}.items():
            scores = [score(question, covariance(question, design).covariance) for design in designs]
            middle = int(np.argsort(scores)[len(scores) // 2])
            errors = measure(case, designs[middle], question, imus, np.random.default_rng(1))
            rmse = float(np.sqrt(np.mean(errors**2)))
            rows.append((name, scores[middle], determinant_error(errors), min(scores), rmse))
        figures[case.title] = {
            name: {"predicted": predicted, "measured": measured, "best": best, "rmse": rmse}
            for name, predicted, measured, best, rmse in rows
        } | {"rounding_loss": case.planned.rounding_loss}
        for name, predicted, measured, best, rmse in rows:
            shown.add(case.title, name + (f" (best {1e6 * best:.4g})" if name == "random" else ""), 1e6 * predicted,
                      predicted / rows[0][1], 1e6 * measured, measured / rows[0][2], measured / predicted,
                      1e6 * rmse, rmse / rows[0][4])  # fmt: skip
        print(case.title, figures[case.title], flush=True)
    finish("planning", [shown], figures, keep=not small)


if __name__ == "__main__":
    main()
