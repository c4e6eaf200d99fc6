"""Error budgets: against hand derivations, the closed formula, and Monte Carlo through the whole estimator."""

import json
import math
import os

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from jaximu.calibration.turntable import free_on_table
from jaximu.cli import main
from jaximu.data.stations import station_weights, turntable
from jaximu.estimation.problem import Parameters
from jaximu.ground.errors import InputError, NotPossibleError
from jaximu.ground.rotation import integrate_rates
from jaximu.ground.units import STANDARD_GRAVITY
from jaximu.model import BiasInstability, Noise, RandomWalk, White
from jaximu.planning import budget as planning
from jaximu.planning.budget import budget
from jaximu.planning.goals import parse_goal, per_si
from jaximu.planning.setup_errors import _mean_covariances, scheme_and_sources, task
from jaximu.report.budget import goal_words
from jaximu.simulation.protocols import Positions, attitude_of

DEGREE = np.radians(1.0)
NOISE = {
    "accelerometer": {"noise": {"white": "100 ug/sqrt(Hz)", "density": "two-sided"}},
    "gyroscope": {"noise": {"white": "0.3 deg/sqrt(h)"}},
}
SIX = {
    "protocol": {"kind": "positions", "count": 6, "duration": 20.0},
    **NOISE,
    "errors": {
        "tilt": "0.02 deg",
        "angle_setting": "0.03 deg",
        "gravity": "1e-3 m/s^2",
        "drift": {"accelerometer": "1 mg/h"},
        "timing": "5 ms",
    },
}
HEAD = {
    "protocol": {"kind": "dividing-head"},
    "environment": {"latitude": 30.5},
    "accelerometer": {
        "scale": 0.01,
        "bias": "20 mg",
        "noise": {"white": "100 ug/sqrt(Hz)", "density": "two-sided", "bias_instability": "30 ug",
                  "bias_instability_is": "B"},
    },
    "gyroscope": {"scale": -0.01, "noise": {"white": "0.3 deg/sqrt(h)", "rate_random_walk": "3 deg/h/sqrt(h)"}},
    "errors": {
        "tilt": "0.02 deg",
        "angle_setting": "0.01 deg",
        "mounting": "0.02 deg",
        "orthogonality": "20 arcsec",
        "gravity": "2e-4 m/s^2",
        "rate": "50 ppm",
        "temperature": {"accelerometer": "0.05 mg/K", "gyroscope": "0.002 deg/s/K", "span": "2 K"},
        "vibration": {"rms": "1 m/s^2", "rectification": "0.05 deg/s/g^2", "noise": "0.01 deg/s/sqrt(Hz)"},
        "truncated": {"accel.quadratic": 1e-5},
    },
    "goal": {"accelerometer.bias": "0.2 mg", "gyroscope.scale": "1 %"},
}  # fmt: skip


def changed(document, **errors):
    return document | {"errors": document["errors"] | errors}


def row(found, source):
    """A source's reach by parameter's name."""
    place = [each.name for each in found.sources].index(source)
    return dict(zip(found.names, found.sigma[place], strict=True))


@pytest.fixture(scope="module")
def six():
    return budget(task(SIX))


@pytest.fixture(scope="module")
def head():
    return budget(task(HEAD), draws=128)


# --- by hand ----------------------------------------------------------------------------------------------------------


def test_tilt_moves_misalignments_and_no_scale(six):
    """Up and down give column j of the gain: half the difference of how each pose's "up" moves, −Rᵀ (α × e_z)."""
    reach = row(six, "tilt")
    rotations = {sign: [attitude_of(sign * axis).as_matrix() for axis in np.eye(3)] for sign in (1, -1)}
    alpha = 0.02 * DEGREE
    for j in range(3):
        moved = [
            0.5 * (-rotations[1][j].T + rotations[-1][j].T) @ np.cross(alpha * axis, [0, 0, 1])
            for axis in np.eye(3)[:2]
        ]
        np.testing.assert_allclose(
            [reach[f"accelerometer.gain[{i},{j}]"] for i in range(3)],
            np.linalg.norm(moved, axis=0),
            rtol=1e-6,
            atol=1e-12,
        )
        assert reach[f"accelerometer.gain[{j},{j}]"] < 1e-6 * alpha
    assert max(reach.values()) == pytest.approx(STANDARD_GRAVITY * alpha, rel=0.7)  # of a bias
    assert math.hypot(reach["accelerometer.gain[0,2]"], reach["accelerometer.gain[1,2]"]) == pytest.approx(
        alpha, rel=0.5
    )


def test_a_common_delay_of_turns_from_rest_to_rest_moves_nothing(six):
    assert max(row(six, "timing").values()) < 1e-9


def test_gravity_moves_the_scale_by_its_share(six):
    reach = row(six, "gravity")
    for i in range(3):
        assert reach[f"accelerometer.gain[{i},{i}]"] == pytest.approx(1e-3 / STANDARD_GRAVITY, rel=1e-6)
    assert max(value for name, value in reach.items() if "gain[0,1]" in name or "bias" in name) < 1e-9


def test_angle_setting_of_six_poses(six):
    """A misalignment is half the difference of two poses; a bias the mean of the four poses across, over six."""
    reach, sigma = row(six, "angle_setting"), 0.03 * DEGREE
    for i in range(3):
        assert reach[f"accelerometer.bias[{i}]"] == pytest.approx(STANDARD_GRAVITY * sigma / 3, rel=1e-5)
        for j in {0, 1, 2} - {i}:
            assert reach[f"accelerometer.gain[{i},{j}]"] == pytest.approx(sigma / math.sqrt(2), rel=1e-5)
        assert reach[f"accelerometer.gain[{i},{i}]"] < 1e-6 * sigma


def test_drift_moves_bias_by_the_middle_and_scale_by_up_less_down(six):
    reach, rate = row(six, "drift"), 1e-3 * STANDARD_GRAVITY / 3600
    intervals = Positions(6, 20.0).plan(np.random.default_rng(0)).intervals
    middle = np.array([(each.start + each.stop) / 2 for each in intervals if each.kind == "pose"])
    for i in range(3):
        assert reach[f"accelerometer.bias[{i}]"] == pytest.approx(rate * middle.mean(), rel=1e-4)
        apart = rate * (middle[2 * i + 1] - middle[2 * i]) / 2 / STANDARD_GRAVITY
        assert reach[f"accelerometer.gain[{i},{i}]"] == pytest.approx(apart, rel=1e-4)


def test_noise_of_six_poses(six):
    """Six means of 20 s: bias N/√(6 T), gain N/(g √(2 T))."""
    reach, mean = row(six, "noise"), 1e-4 * STANDARD_GRAVITY / math.sqrt(20.0)
    assert reach["accelerometer.bias[1]"] == pytest.approx(mean / math.sqrt(6), rel=1e-5)
    assert reach["accelerometer.gain[2,1]"] == pytest.approx(mean / math.sqrt(2) / STANDARD_GRAVITY, rel=1e-5)


def test_one_mounting_of_a_head_turns_both_gains_and_nothing_else(head):
    reach, sigma = row(head, "mounting"), 0.02 * DEGREE
    for triad in ("accelerometer", "gyroscope"):
        for i in range(3):
            for j in range(3):
                wanted = 0.0 if i == j else sigma
                assert reach[f"{triad}.gain[{i},{j}]"] == pytest.approx(wanted, rel=1e-4, abs=1e-4 * sigma)
            assert reach[f"{triad}.bias[{i}]"] < 1e-5 * sigma
    assert row(head, "rate")["gyroscope.gain[1,1]"] == pytest.approx(50e-6, rel=1e-5)


def test_means_of_slow_noise():
    """A Wiener process from zero: the mean over [a, b] has K² (a + (b − a)/3), later means covary by K² (a + b)/2."""
    start, stop = np.array([2.0, 10.0]), np.array([8.0, 15.0])
    _, walk = _mean_covariances(Noise((White(0.0), RandomWalk(0.3))).squares(), start, stop)
    np.testing.assert_allclose(walk[1], 0.09 * np.array([[4.0, 5.0], [5.0, 10 + 5 / 3]]), rtol=1e-12)
    start, stop = np.array([0.0, 20.0]), np.array([20.0, 40.0])
    _, flicker = _mean_covariances(Noise((White(0.0), BiasInstability(0.2))).squares(), start, stop)
    allan = 0.5 * (flicker[0, 0, 0] + flicker[0, 1, 1] - 2 * flicker[0, 0, 1])
    assert allan == pytest.approx(2 * np.log(2) / np.pi * 0.04, rel=0.01)


# --- the derivative ---------------------------------------------------------------------------------------------------


def test_implicit_derivative_is_the_closed_formula():
    """dz/de = −(JᵀJ + I/τ²)⁻¹ Jᵀ W dȳ/de, τ the data sheet's tolerance; and dȳ/de as central differences have it."""
    scheme, _, _ = scheme_and_sources(task(SIX))
    unit = scheme.unit
    parameters = Parameters.select(unit, free_on_table(unit))
    stations, excess = scheme.stations, np.array([3.0, 1.0, 0.5])
    weights = jax.jit(station_weights)(stations, excess)

    @jax.jit
    def by_z(weights):
        return jax.jacfwd(lambda z: turntable(parameters.model(unit, z), stations, weights))(jnp.zeros(24))

    jacobian, weights = np.asarray(by_z(weights)), np.asarray(weights)
    reaction = planning._reaction(scheme)
    used = np.stack([stations.accelerometer_used, stations.gyroscope_used])[..., None, None]
    moved = np.moveaxis(reaction * used, 2, 1).reshape(6, stations.turn.size, -1)
    moved = np.einsum("aij,ajn->ain", weights, moved).reshape(len(jacobian), -1)
    closed = -np.linalg.solve(jacobian.T @ jacobian + np.eye(24) / 1e4, jacobian.T @ moved)
    by_means = np.asarray(planning._sensitivity(stations, unit, parameters, excess)).reshape(24, -1)
    whole = by_means @ reaction.reshape(by_means.shape[1], -1)
    np.testing.assert_allclose(whole, closed, rtol=1e-6, atol=1e-9 * np.abs(closed).max())

    step = 1e-4 * np.eye(sum(scheme.sizes))[: scheme.simulated]
    central = (planning._recorded(scheme, step) - planning._recorded(scheme, -step)) / 2e-4
    np.testing.assert_allclose(np.moveaxis(central, 0, -1), reaction[..., : len(step)], atol=1e-6)


def test_turns_end_where_the_errors_of_their_ends_say():
    """The rates of a turn, integrated, take the wrong first attitude to the wrong last one."""
    scheme, _, _ = scheme_and_sources(task(SIX))
    rng = np.random.default_rng(3)
    turned = 0.01 * rng.standard_normal((scheme.stops, 3))
    true = jax.jit(lambda s, t: s.stimulus(0.0, t))(scheme, turned)
    stations, place = scheme.stations, int(np.flatnonzero(scheme.stations.turn)[2])
    step = (stations.stop[place] - stations.start[place]) / true.angular_rate.shape[1]
    said, got = (
        Rotation.from_quat(
            np.asarray(integrate_rates(jnp.asarray(rates), jnp.full(len(rates), step))), scalar_first=True
        )
        for rates in (stations.stimulus.angular_rate[place], np.asarray(true.angular_rate[place]))
    )
    first, last = (Rotation.from_rotvec(turned[end]) for end in scheme.ends[place])
    assert (got.inv() * (first.inv() * said * last)).magnitude() < 2e-4  # of 2e-2; a turn has 32 nodes
    np.testing.assert_allclose(
        np.asarray(true.specific_force)[0, 0],
        Rotation.from_rotvec(turned[scheme.ends[0, 0]]).inv().apply(stations.stimulus.specific_force[0, 0]),
        atol=1e-12,
    )


def test_a_late_schedule_cuts_the_turns():
    """Turns of 2 s from rest to rest (no constant rate): a quarter late, 5/64 of the angle is done before."""
    scheme, _, _ = scheme_and_sources(task(SIX))
    errors = np.zeros((1, sum(scheme.sizes)))
    errors[0, 0] = 0.5
    said, cut = (planning._recorded(scheme, each)[0, 1, scheme.stations.turn] for each in (0 * errors, errors))
    np.testing.assert_allclose(np.linalg.norm(cut, axis=1) / np.linalg.norm(said, axis=1), 1 - 5 / 64, rtol=1e-9)


# --- Monte Carlo ------------------------------------------------------------------------------------------------------


@pytest.mark.slow  # benchmarks/results/budget.md has the ratios; the next test draws 128 of them through it all
def test_budget_agrees_with_monte_carlo_within_five_percent(head):
    """4096 sessions solved with the budget's weights: chance is 1.1 % of one parameter's standard deviation."""
    assert head.determined.all()
    scheme, sources, _ = scheme_and_sources(task(HEAD))
    unit = scheme.unit
    parameters = Parameters.select(unit, free_on_table(unit))
    rng = np.random.default_rng(11)
    errors = np.sum([source.draw(rng, 4096) for source in sources], axis=0)
    means = planning._recorded(scheme, errors)
    z = planning._chunks(planning._lanes, "budget solutions", means, scheme.stations, unit, parameters, head.excess)
    scale = np.asarray(parameters.size) / [per_si(name, unit) for name in parameters.names]
    np.testing.assert_allclose(np.sqrt(np.mean((z * scale) ** 2, axis=0)) / head.total, 1, atol=0.05)


def test_budget_agrees_with_the_whole_estimator(head):
    """128 sessions from the data sheet on, weights estimated: 6 % of chance (1σ) for one parameter."""
    assert head.check.failed == 0
    ratio = head.check.rms / head.total
    assert np.all(np.abs(ratio - 1) < 4 / np.sqrt(2 * head.check.draws))
    assert abs(np.mean(ratio) - 1) < 0.05
    assert not head.nonlinear()


def test_where_first_order_fails_the_budget_says_so(six):
    """A tilt of 4° takes 1 − cos α off every scale; small tilts do not."""
    assert not six.nonlinear()
    found = budget(task(changed(SIX, tilt="4 deg")))
    tilt = [each.name for each in found.sources].index("tilt")
    flagged = {found.names[column] for source, column in found.nonlinear() if source == tilt}
    assert {f"accelerometer.gain[{i},{i}]" for i in range(3)} <= flagged
    place = found.names.index("accelerometer.gain[1,1]")
    # |α|² is σ² χ²(2), so its half has the root mean square √2 σ²; of 16 draws it is known to some 40 %
    assert found.actual[tilt, place] == pytest.approx(math.sqrt(2) * (4 * DEGREE) ** 2, rel=0.6)
    assert found.sigma[tilt, place] < 1e-3 * found.actual[tilt, place]
    entry = found.document()["parameters"][place]
    assert entry["nonlinear"].keys() == {"tilt"}


# --- goals and documents ----------------------------------------------------------------------------------------------


def test_needs_reach_the_goal_and_no_less(six):
    """With one source that much smaller, the worst parameter stands at its goal."""
    goal = {"goal": {"accelerometer.misalignment": "0.4 mrad"}}
    found = budget(task(SIX | goal)).goals[0]
    assert not found.reached and found.together is None
    assert [need.sources for need in found.alone[:2]] == [("angle_setting",), ("tilt",)]
    for need, size in zip(found.alone, (0.03, 0.02), strict=False):
        mended = budget(task(changed(SIX, **{need.sources[0]: size * DEGREE / need.times}) | goal))
        places = [mended.names.index(name) for name in found.parameters]
        assert mended.total[places].max() == pytest.approx(0.4e-3, rel=1e-3)


def test_several_sources_where_one_is_not_enough(six):
    goal = {"goal": {"accelerometer.misalignment": "0.05 mrad"}}
    found = budget(task(SIX | goal)).goals[0]
    assert all(need.times is None for need in found.alone)
    assert found.together.sources == ("angle_setting", "tilt")
    times = found.together.times
    mended = budget(task(changed(SIX, tilt=0.02 * DEGREE / times, angle_setting=0.03 * DEGREE / times) | goal))
    places = [mended.names.index(name) for name in found.parameters]
    assert mended.total[places].max() == pytest.approx(5e-5, rel=1e-3)


def test_document_is_finite_and_adds_up(head):
    document = json.loads(head.text(), parse_constant=lambda text: pytest.fail(text))
    assert document["schema"] == "jaximu.budget/1"
    for entry in document["parameters"]:
        parts = list(entry["contributions"].values())
        assert parts == sorted(parts, reverse=True)
        assert math.hypot(*parts) == pytest.approx(entry["sigma"], rel=1e-12)
    assert [goal["reached"] for goal in document["goals"]] == [False, True]
    assert {each["name"] for each in document["sources"]} >= {"tilt", "earth_rotation", "bias_instability", "vibration"}


def test_what_a_scheme_leaves_open_has_no_uncertainty():
    """At rest gravity cannot be told from the scales: only the data sheet holds them."""
    errors = {"errors": {"mounting": "0.01 deg"}, "fitted": ["setup.gravity"]}
    found = budget(task(SIX | errors | {"goal": {"setup[0].coefficients[0]": "0.1 m/s^2"}}))
    lost = {name for name, known in zip(found.names, found.determined, strict=True) if not known}
    assert lost == {"setup[0].coefficients[0]", *(f"accelerometer.gain[{i},{i}]" for i in range(3))}
    assert found.open
    entry = found.document()["parameters"][found.names.index("setup[0].coefficients[0]")]
    assert "sigma" not in entry
    goal = found.goals[0]
    assert not goal.reached and not goal.alone and "does not determine the local gravity" in goal_words(found, goal)


def test_an_effect_that_is_fitted_follows_its_error(head):
    """The table's tilt, fitted, tilts no gain any more, and is itself known better than it was set."""
    found = budget(task(HEAD | {"fitted": ["setup.table_tilt"]}))
    tilt = row(found, "tilt")
    assert found.determined.all() and len(tilt) == 26
    assert max(tilt.values()) < 1e-3 * 0.02 * DEGREE
    assert max(found.total[-2:]) < 0.02 * DEGREE
    assert max(row(head, "tilt").values()) > 0.02 * DEGREE


# --- bad input --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (changed(SIX, tlit="1 deg"), ["errors", "'tlit'", "'tilt'"]),
        (changed(SIX, tilt="-1 deg"), ["errors.tilt", "negative"]),
        (changed(SIX, tilt="1 m"), ["errors.tilt", "different quantities"]),
        (changed(SIX, tilt=[1, 2]), ["errors.tilt", "number"]),
        (changed(SIX, gravity="nan"), ["errors.gravity"]),
        (changed(SIX, drift="1 mg/h"), ["errors.drift", "table"]),
        (changed(SIX, drift={"accel": "1 mg/h"}), ["'accel'", "'accelerometer'"]),
        (changed(SIX, temperature={"accelerometer": "1 mg/K"}), ["temperature", "span"]),
        (changed(SIX, temperature={"accelerometer": "1 mg", "span": 1}), ["temperature.accelerometer", "'mg'"]),
        (changed(SIX, earth_rotation="ignored"), ["earth_rotation", "latitude"]),
        (changed(SIX, vibration={"rms": 1.0}), ["vibration", "rectification"]),
        (changed(SIX, truncated={"accel.quadratik": 1e-5}), ["accel.quadratik", "accel.quadratic"]),
        (changed(SIX, truncated={"accel.quadratic": [1e-5, 1e-5]}), ["3 sizes", "2"]),
        (SIX | {"eror": {}}, ["'eror'", "errors"]),
        (SIX | {"fitted": ["setup.tilt"]}, ["'setup.tilt'", "setup.table_tilt"]),
        ({key: value for key, value in SIX.items() if key != "errors"}, ["[errors]"]),
    ],
)
def test_bad_input_is_refused_in_a_sentence(change, words):
    with pytest.raises(InputError) as caught:
        task(change, "spec.toml")
    message = str(caught.value)
    assert message.startswith("spec.toml") and message.endswith((".", "?"))
    assert all(word in message for word in words), message


@pytest.mark.parametrize(
    ("goal", "words"),
    [("accelerometer.bais 1 mg", "accelerometer.bias"), ("accelerometer.bias 1 deg", "different quantities"),
     ("accelerometer.bias 0", "greater than zero")],
)  # fmt: skip
def test_bad_goals(six, goal, words):
    with pytest.raises(InputError, match=words):
        planning._goal(six, *parse_goal(goal))


def test_a_goal_needs_a_size_and_a_budget_known_poses():
    with pytest.raises(InputError, match="how much"):
        parse_goal("accelerometer.bias")
    with pytest.raises(NotPossibleError, match="hand-held"):
        budget(task(SIX | {"protocol": {"kind": "hand-held"}}))


# --- the command ------------------------------------------------------------------------------------------------------

TOML = """
[protocol]
kind = "positions"
count = 6
duration = 20.0
[errors]
tilt = "0.02 deg"
angle_setting = "0.03 deg"
gravity = "1e-3 m/s^2"
drift = { accelerometer = "1 mg/h" }
timing = "5 ms"
[goal]
"accelerometer.bias" = "0.1 mg"
"""


@pytest.fixture
def specification(tmp_path):
    path = tmp_path / "set-up.toml"
    path.write_text(TOML, encoding="utf-8")
    return str(path)


def test_command_writes_report_picture_and_json(specification, tmp_path, capsys):
    out = tmp_path / "out"
    assert main(["budget", specification, "--goal", "accelerometer.scale 1 %", "--json", "-o", str(out)]) == 0
    printed = json.loads(capsys.readouterr().out)
    assert sorted(os.listdir(out)) == ["budget.json", "budget.png", "report.html"]
    assert json.loads((out / "budget.json").read_text()) == printed
    assert [goal["reached"] for goal in printed["goals"]] == [False, True]
    page = (out / "report.html").read_text(encoding="utf-8")
    assert "tilt of the table" in page and "Not reached" in page and "is assumed" in page
    assert main(["budget", specification]) == 0
    text = capsys.readouterr().out
    assert "its goal is 0.1 mg (0.98 mm/s²)" in text and "--check" not in text
    assert "accelerometer bias z" in text and "instead of 0.03°" in text


def test_command_refuses(specification, tmp_path, capsys):
    assert main(["budget"]) == 2
    assert main(["budget", str(tmp_path / "missing.toml")]) == 2
    assert main(["budget", specification, "--check", "3"]) == 2
    assert main(["budget", specification, "--goal", "accelerometer.bias"]) == 2
    printed = capsys.readouterr()
    assert printed.out == "" and "should not happen" not in printed.err
    assert main(["budget", "--explain"]) == 0
    assert "[errors]" in capsys.readouterr().out


def test_the_documented_example_is_understood():
    text = "\n".join(line[4:] for line in planning.__doc__.splitlines() if line.startswith("    "))
    found = task(planning_toml(text))
    assert len(found.errors) == 12 and len(found.goals) == 2 and found.fitted == ("setup.table_tilt",)


def planning_toml(text):
    import tomllib

    return tomllib.loads(text)
