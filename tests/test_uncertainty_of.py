"""The uncertainty of the corrected output: closed forms, draws, differences, and what the data leave open."""

import json
import re
from dataclasses import replace

import equinox as eqx
import jax
import numpy as np
import pytest
from jax.flatten_util import ravel_pytree
from matplotlib.figure import Figure

import jaximu
from jaximu import InputError, LocalGravity
from jaximu.calibration import Calibration, load_calibration
from jaximu.estimation.problem import flatten, names_of, unflatten, without_equipment_or_effects
from jaximu.estimation.projection import output_error, sensitivity
from jaximu.estimation.uncertainty import WeakDirection
from jaximu.model.effects import CATALOGUE
from jaximu.model.stimulus import Stimulus
from jaximu.report.uncertainty import uncertainty_parts
from jaximu.simulation import draw_imu

GRAVITY = 9.80665
NOMINAL = jax.tree.map(np.asarray, jaximu.Imu.nominal())
COUNTS = jax.tree.map(
    np.asarray,
    jaximu.Imu.nominal(
        (1 / GRAVITY,) * 3, accelerometer_unit="g", gyroscope_scale=(180 / np.pi,) * 3, gyroscope_unit="deg/s"
    ),
)
DIRECTIONS = np.array([[0.0, 0, 1], [1, 0, 0], [0, -1, 0], [0.6, 0, 0.8]])
STILL = Stimulus(GRAVITY * DIRECTIONS, np.zeros((4, 3)))


def calibration_of(imu, sigma, **changes) -> Calibration:
    """Return a calibration whose numbers have these standard deviations, by the beginning of their names."""

    def of(name):
        return next((value for stem, value in sigma.items() if name.startswith(stem)), 0.0)

    names = tuple(name for name in names_of(imu) if without_equipment_or_effects(name))
    covariance = np.diag([of(name) ** 2 for name in names])
    gravity = LocalGravity(GRAVITY, 0.0)
    whole = Calibration(imu, names, covariance, gravity, "joint", "linear", {}, len(names), (), {}, "converged", {})
    return replace(whole, **changes)


def drawn_covariance(calibration: Calibration, share: float) -> Calibration:
    """Return a calibration whose covariance is a random full matrix, of this share of each number's typical size."""
    count = len(calibration.names)
    mixed = np.random.default_rng(5).standard_normal((count, 2 * count)) / np.sqrt(2 * count)
    sizes = share * np.array([1e-3 if name.part == "gain" else 1e-2 if name.effect is None else 1e-4
                              for name in calibration.names])  # fmt: skip
    return replace(calibration, covariance=sizes[:, None] * (mixed @ mixed.T) * sizes)


def test_a_bias_alone_is_the_same_in_every_orientation():
    uncertainty = calibration_of(NOMINAL, {"accelerometer.bias[1]": 0.02}).uncertainty_of(STILL)
    np.testing.assert_allclose(uncertainty["accelerometer"].sigma, np.tile([0, 0.02, 0], (4, 1)), atol=1e-15)
    np.testing.assert_allclose(uncertainty["accelerometer"].largest, 0.02, rtol=1e-12)
    assert not uncertainty["gyroscope"].sigma.any()


def test_a_gain_alone_goes_with_the_force_along_its_axis():
    uncertainty = calibration_of(NOMINAL, {"accelerometer.gain[2,0]": 1e-3}).uncertainty_of(STILL)
    np.testing.assert_allclose(
        uncertainty["accelerometer"].sigma[:, 2], 1e-3 * GRAVITY * np.abs(DIRECTIONS[:, 0]), rtol=1e-12
    )
    rate = Stimulus(angular_rate=np.linspace(0, 4, 5)[:, None] * [0.0, 0.0, 1.0])
    uncertainty = calibration_of(NOMINAL, {"gyroscope.gain[2,2]": 1e-3}).uncertainty_of(rate)
    np.testing.assert_allclose(uncertainty["gyroscope"].sigma[:, 2], 1e-3 * np.linspace(0, 4, 5), rtol=1e-12)
    assert set(uncertainty) == {"gyroscope"}


def test_it_is_in_si_whatever_the_unit_puts_out():
    uncertainty = calibration_of(COUNTS, {"accelerometer.bias": 1e-3, "gyroscope.bias": 0.1}).uncertainty_of(STILL)
    np.testing.assert_allclose(uncertainty["accelerometer"].sigma, 1e-3 * GRAVITY, rtol=1e-12)
    np.testing.assert_allclose(uncertainty["gyroscope"].sigma, np.radians(0.1), rtol=1e-12)


def test_over_temperature_it_grows_from_where_the_bias_holds():
    imu = NOMINAL.with_effects(CATALOGUE["accel.temperature"].make(1e-3))
    calibration = calibration_of(imu, {"accelerometer.effects": 1e-4})
    still = Stimulus(np.tile([0.0, 0, GRAVITY], (3, 1)), temperature=np.array([5.0, 25.0, 45.0]))
    np.testing.assert_allclose(calibration.uncertainty_of(still)["accelerometer"].largest, [2e-3, 0, 2e-3], atol=1e-12)
    with pytest.raises(InputError, match=r"accel\.temperature needs the temperature"):
        calibration.uncertainty_of(STILL)


UNITS = {
    "plain": draw_imu(3),
    "effects": draw_imu(4).with_effects(
        CATALOGUE["accel.asymmetry"].make(1e-3), CATALOGUE["gyro.g_sensitivity"].make(1e-4)
    ),
}


@pytest.mark.parametrize("name", UNITS)
def test_draws_through_the_inverse_scatter_as_it_says(name):
    imu = jax.tree.map(np.asarray, UNITS[name])
    calibration = drawn_covariance(calibration_of(imu, {}), 1.0)
    stimulus = Stimulus(STILL.specific_force, np.array([[0.5, -1, 2]] * 4))
    claimed = calibration.uncertainty_of(stimulus)
    places = [names_of(imu).index(name) for name in calibration.names]
    numbers = np.tile(flatten(imu), (2000, 1))
    numbers[:, places] += np.random.default_rng(1).multivariate_normal(
        np.zeros(len(places)), calibration.covariance, 2000, method="cholesky"
    )
    force, rate = imu.respond(stimulus)
    recovered = jax.jit(jax.vmap(lambda unit: unit.recover(force, rate, stimulus)))(unflatten(imu, numbers))
    for owner, values in zip(("accelerometer", "gyroscope"), recovered, strict=True):
        scatter = np.einsum("nki,nkj->kij", off := np.asarray(values) - np.mean(values, axis=0), off) / 1999
        root = np.linalg.inv(np.linalg.cholesky(claimed[owner].covariance))
        whitened = root @ scatter @ np.swapaxes(root, -1, -2)
        np.testing.assert_allclose(np.linalg.eigvalsh(whitened), 1.0, atol=0.15)  # one in a thousand is 0.11 off


@pytest.mark.parametrize("name", UNITS)
def test_derivatives_are_those_of_the_inverse(name):
    imu = jax.tree.map(np.asarray, UNITS[name])
    force = np.array([[3.0, -5, 8], [-9, 2, 1]])  # off the axes, where an asymmetry has a kink
    stimulus = Stimulus(force, np.array([[0.5, -1, 2]] * 2))
    numbers, restore = ravel_pytree(imu)
    output = imu.respond(stimulus)
    slopes = sensitivity(imu, np.arange(len(numbers)), stimulus)
    for place in range(len(numbers)):
        step = 1e-5 * np.eye(len(numbers))[place]
        for owner, index in (("accelerometer", 0), ("gyroscope", 1)):
            up, down = (
                restore(numbers + sign * step).triads()[owner].recover(output[index], stimulus) for sign in (1, -1)
            )
            np.testing.assert_allclose((down - up) / 2e-5, slopes[owner][..., place], atol=2e-8)


def test_the_core_can_be_compiled_batched_and_differentiated():
    def worst(bias, gain):
        imu = replace(NOMINAL, accelerometer=replace(NOMINAL.accelerometer, gain=gain * np.eye(3), bias=bias))
        return sensitivity(imu, np.arange(12), STILL)["accelerometer"][0, 2, 11]

    many = jax.jit(jax.vmap(worst, (None, 0)))(np.zeros(3), np.array([1.0, 2.0]))
    np.testing.assert_allclose(many, [1.0, 0.5])  # of the bias along z, over the gain
    np.testing.assert_allclose(jax.grad(worst, 1)(np.zeros(3), 2.0), -0.25)
    assert output_error(NOMINAL, NOMINAL, STILL)["accelerometer"] == pytest.approx(0.0)


def test_effects_of_a_session_are_left_alone():
    imu = NOMINAL.with_effects(CATALOGUE["accel.bias_ramp"].make(1e-3))
    assert imu.all_effects()["accelerometer", 0].scope == "session"
    uncertainty = calibration_of(imu, {"accelerometer.effects": 1.0}).uncertainty_of(STILL)
    assert not uncertainty["accelerometer"].sigma.any()


def test_what_the_data_leave_open_is_infinite_and_the_rest_is_not():
    open_scale = calibration_of(NOMINAL, {"accelerometer.gain[2,2]": 0.5, "accelerometer.bias": 0.01})
    sigma = open_scale.uncertainty_of(STILL)["accelerometer"].sigma
    assert np.isinf(sigma[[0, 3], 2]).all() and np.isfinite(sigma[[1, 2]]).all() and np.isfinite(sigma[:, :2]).all()
    assert np.isfinite(open_scale.uncertainty_of(STILL)["accelerometer"].covariance).all()
    assert np.isinf(open_scale.uncertainty_of(STILL)["accelerometer"].largest).tolist() == [True, False, False, True]


def test_gains_of_a_data_sheet_are_not_taken_for_known():
    known = calibration_of(NOMINAL, {"gyroscope.bias": 1e-4})
    sheet = known.of_numbers(lambda name: not name.startswith("gyroscope.gain"))
    turning = Stimulus(angular_rate=np.array([[0.0, 0, 0], [0, 0, 2]]))
    assert sheet.from_data_sheet == ("gyroscope gain",)
    sigma = sheet.uncertainty_of(turning)["gyroscope"].sigma
    np.testing.assert_allclose(sigma[0], 1e-4)
    assert np.isinf(sigma[1]).all()


def test_a_gyroscope_alone_and_an_accelerometer_alone(tmp_path):
    both = calibration_of(NOMINAL, {"accelerometer.bias": 0.01, "gyroscope.bias": 1e-4})
    alone = both.of_numbers(lambda name: name.owner == "accelerometer", imu=replace(NOMINAL, gyroscope=None))
    assert set(alone.uncertainty_of(STILL)) == {"accelerometer"}
    gyroscope = both.of_numbers(lambda name: name.owner == "gyroscope", absent=("accelerometer",))
    assert set(gyroscope.uncertainty_of(STILL)) == {"gyroscope"}
    with pytest.raises(InputError, match="holds no angular rate"):
        gyroscope.uncertainty_of(Stimulus(specific_force=STILL.specific_force))
    file = tmp_path / "calibration.json"
    file.write_text(json.dumps(both.document()), encoding="utf-8")
    np.testing.assert_allclose(load_calibration(file).uncertainty_of(STILL)["gyroscope"].sigma, 1e-4)


@pytest.mark.parametrize(
    ("stimulus", "message"),
    [
        (Stimulus(), "holds no specific force or angular rate"),
        (
            eqx.tree_at(lambda one: one.specific_force, STILL, np.zeros((4, 2))),
            r"specific force has the shape \(4, 2\): its last axis must have 3 entries",
        ),
        (Stimulus(np.array([0, np.nan, 9.8])), "specific force holds a number that is not finite"),
        (Stimulus(np.zeros((4, 3)), np.zeros((5, 3))), r"leading axes: \(4,\) and \(5,\)"),
    ],
)
def test_what_is_no_input_is_refused(stimulus, message):
    with pytest.raises(InputError, match=message):
        calibration_of(NOMINAL, {}).uncertainty_of(stimulus)


def test_weak_directions_do_not_matter_where_the_output_does_not_feel_them():
    """Two numbers of which the data know the sum alone: an input that feels the sum is known."""
    imu, names = NOMINAL, names_of(NOMINAL)
    calibration = calibration_of(imu, {})
    rows = [calibration.names.index(names[names.index(name)]) for name in
            ("accelerometer.gain[2,2]", "accelerometer.bias[2]")]  # fmt: skip
    change = np.zeros(len(calibration.names))
    change[rows] = 1.0, -GRAVITY  # along +z they cancel, along −z they add
    weak = WeakDirection(5.0, False, (("accelerometer.gain[2,2]", 1.0),), "scale z and bias z trade off.")
    traded = replace(calibration, covariance=np.outer(change, change), weak=(weak,))
    up, down = traded.uncertainty_of(Stimulus(GRAVITY * np.array([[0.0, 0, 1], [0, 0, -1]])))["accelerometer"].largest
    assert up == pytest.approx(0.0, abs=1e-6) and np.isinf(down)


# --- pages


def shown(calibration) -> tuple[dict[str, str], dict[str, Figure]]:
    """Return the sentences by what they are about, and the drawn pictures by name."""
    parts = [*uncertainty_parts(calibration)]
    return (
        {part.about: part.text for part in parts if part.kind == "statement"},
        {part.name: part.draw() for part in parts if part.kind == "picture"},
    )


def test_the_page_names_the_worst_orientation_and_the_worst_rate():
    sigma = {"accelerometer.gain[1,0]": 1e-3, "accelerometer.bias": 1e-3, "gyroscope.gain[1,1]": 1e-3}
    sentences, pictures = shown(calibration_of(NOMINAL, sigma | {"gyroscope.bias": np.radians(0.01)}))
    assert re.search(r"the direction [+−]x up: ±19 mm/s² \(95 %", sentences["At rest"])  # 1.96 √(g² + 1) 1e-3 m/s²
    assert "0.11° if it is used as a level" in sentences["At rest"] and "±2.0 mm/s²" in sentences["At rest"]
    assert "Gravity" not in sentences["At rest"]
    assert re.search(
        r"±0\.020 °/s \(95 %\) at rest, and known to ±0\.49 °/s \(95 %\) at 250 °/s about [+−]y", sentences["Turning"]
    )
    assert set(pictures) == {"orientations", "uncertainty"}
    assert pictures["orientations"].axes[2].get_xlabel() == "specific force at rest, ± 95 % (mm/s²)"
    assert [line.get_ydata()[-1] for line in pictures["uncertainty"].axes[0].lines] == pytest.approx(
        [0.0196, 1.96 * np.hypot(0.01, 0.25), 0.0196], rel=1e-6
    )


def test_gravity_is_stated_beside_the_map():
    calibration = calibration_of(NOMINAL, {"accelerometer.bias": 1e-3})
    calibration = replace(calibration, gravity=LocalGravity(GRAVITY, 0.015))
    scaled = np.array([name in {f"accelerometer.gain[{k},{k}]" for k in range(3)} for name in calibration.names])
    shift = scaled * 0.015 / GRAVITY
    np.testing.assert_array_equal(calibration.gravity_shift(), 0.0)  # nothing of it is in the covariance
    calibration = replace(calibration, covariance=calibration.covariance + 1.001 * np.outer(shift, shift))
    np.testing.assert_allclose(calibration.gravity_shift(), shift)
    assert calibration.uncertainty_of(STILL)["accelerometer"].largest == pytest.approx(np.hypot(0.015, 1e-3), rel=1e-3)
    sentences, _ = shown(calibration)
    assert "±2.2 mm/s²" in sentences["At rest"] and "Gravity's own uncertainty adds ±29 mm/s²" in sentences["At rest"]


def test_the_page_of_what_is_open_says_so():
    open_scale = calibration_of(COUNTS, {"accelerometer.gain[2,2]": 0.5 / GRAVITY, "accelerometer.bias": 1e-3})
    sheet = open_scale.of_numbers(lambda name: not name.startswith("gyroscope.gain"))
    sentences, pictures = shown(sheet)
    assert "up the corrected specific force is not determined: a combination" in sentences["At rest"]
    assert "and not determined at 250 °/s" in sentences["Turning"]
    assert "Not determined" in pictures["orientations"].get_suptitle()
    nothing = open_scale.of_numbers(lambda name: "gain" not in name)
    sentences, pictures = shown(replace(nothing, covariance=nothing.covariance + 100 * np.eye(len(nothing.names))))
    assert "the accelerometer gain is the data sheet's" in sentences["At rest"] and not pictures


def test_a_gyroscope_alone_has_no_sphere_and_over_temperature_there_are_curves():
    imu = NOMINAL.with_effects(CATALOGUE["gyro.temperature"].make(1e-5), CATALOGUE["accel.temperature"].make(1e-3))
    both = calibration_of(imu, {"gyroscope.bias": 1e-4, "gyroscope.effects": 1e-5, "accelerometer.effects": 1e-4})
    sentences, pictures = shown(both)
    force = pictures["uncertainty"].axes[1].lines[0]
    assert force.get_xdata()[[0, -1]].tolist() == [5.0, 45.0]
    np.testing.assert_allclose(force.get_ydata()[[0, 20, -1]], [1.96 * 2, 0, 1.96 * 2], atol=1e-9)  # mm/s²
    alone = both.of_numbers(lambda name: name.owner == "gyroscope", absent=("accelerometer",))
    sentences, pictures = shown(alone)
    assert set(sentences) == {"Turning"} and set(pictures) == {"uncertainty"} and len(pictures["uncertainty"].axes) == 2
