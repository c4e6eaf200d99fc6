"""The filter over intervals of rest and motion: equal to the batch fit, its derivatives, and what it says of misuse."""

import json
import pickle
from dataclasses import dataclass, replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from compass import FIELD_NOISE, MAGNETOMETER, magnetic
from jax.flatten_util import ravel_pytree
from scipy.spatial.transform import Rotation
from tracker import ARM, LATE, SPEED_NOISE, TILT, TURNED, tracked
from tracker import NOISE as NOISE_OF_TRACKER

from jaximu.calibration import FilterInUse, calibrate, calibrate_by_filter, followed_in_use, load_calibration
from jaximu.calibration.attitude import mounted_on
from jaximu.calibration.systematic import field_of, places_of
from jaximu.cli.app import main
from jaximu.data.motion import Disturbances, IntervalsOfMotion, MotionPath, carried, cut, first_field, interval_rows
from jaximu.estimation.fitting import fit
from jaximu.estimation.information_filter import Knowledge, WhiteRows, estimate, run, smooth, smoothed_variances
from jaximu.estimation.problem import unflatten, without_equipment
from jaximu.ground.errors import InputError, NotPossibleError
from jaximu.ground.gravity import LocalGravity
from jaximu.ground.rotation import exponential, multiply
from jaximu.model import Noise, White
from jaximu.model.effects import CATALOGUE
from jaximu.model.effects.earth_rotation import EARTH_RATE
from jaximu.model.mounting import Mounting
from jaximu.model.noise_model import AxisNoise, NoiseModel
from jaximu.model.sensor import Imu
from jaximu.recordings import write_recording
from jaximu.recordings.readers import read_recording
from jaximu.recordings.recording import Signal
from jaximu.simulation import ACCELEROMETER_DENSITY, GYROSCOPE_DENSITY, consumer_noise, draw_imu, simulate
from jaximu.simulation.protocols import Environment, HandHeld, Rotations, SingleAxisTable
from jaximu.simulation.protocols.base import Protocol
from jaximu.simulation.protocols.course import Course

GRAVITY = LocalGravity(9.80665, 1e-3)
NOISE = NoiseModel(AxisNoise.of_white(ACCELEROMETER_DENSITY**2), AxisNoise.of_white(GYROSCOPE_DENSITY**2))


@pytest.fixture(scope="module")
def recorded():
    """A unit, its recording by hand, the true rests and what a tracker says."""
    imu = draw_imu(5)
    recording, truth = simulate(imu, HandHeld(poses=12, pose_duration=2.5, turn_duration=1.4), consumer_noise(),
                                rate=50.0, seed=5)  # fmt: skip
    return jax.tree.map(np.asarray, imu), recording, truth.intervals, tracked(recording, truth, 5)


@pytest.fixture(scope="module")
def calibrated(recorded):
    """The recording calibrated by the filter."""
    return calibrate_by_filter(recorded[1], GRAVITY, static=NOISE)


@pytest.fixture(scope="module")
def magnetic_recording():
    """The recording of `recorded` with a magnetometer, and that one's calibration."""
    protocol = HandHeld(poses=12, pose_duration=2.5, turn_duration=1.4)
    return magnetic(*simulate(draw_imu(5), protocol, consumer_noise(), rate=50.0, seed=5))


def disturbed(drifts: int, grade: float = 1.0) -> Disturbances:
    """Disturbances of a unit whose white noise is `grade` times a consumer unit's."""
    white = grade**2 * np.repeat([GYROSCOPE_DENSITY**2, ACCELEROMETER_DENSITY**2], 3)
    variance = np.tile(0.05 * white, (drifts, 1))
    return Disturbances(white, white, variance, 10.0 ** np.arange(1, drifts + 1), np.float64(1e-10), np.float64(1e-3),
                        np.ones(6))  # pyright: ignore # fmt: skip


def test_filter_and_smoother_solve_the_least_squares_problem_of_all_rows():
    random = np.random.default_rng(0)
    n, m, r, steps = 3, 2, 7, 6
    rows = WhiteRows(
        *(random.standard_normal(size) for size in ((steps, r, n), (steps, r, n), (steps, r, m), (steps, r)))
    )
    start = Knowledge(np.diag([1.0, 2.0, 3.0, 0.1, 0.1]), np.ones(n + m))
    last, eliminated, innovations, _ = run(start, rows)
    final, covariance = estimate(last)
    states, variances = smooth(eliminated, final[:n], final[n:]), smoothed_variances(eliminated, covariance)
    whole = np.zeros((n + m + steps * r, (steps + 1) * n + m))
    whole[:n, :n], whole[n : n + m, -m:] = start.root[:n, :n], start.root[n:, n:]
    for k in range(steps):
        part = slice(n + m + k * r, n + m + (k + 1) * r)
        whole[part, k * n : (k + 1) * n], whole[part, (k + 1) * n : (k + 2) * n] = rows.before[k], rows.after[k]
        whole[part, -m:] = rows.shared[k]
    right = np.concatenate([start.right, np.ravel(rows.right)])
    solution, squares, *_ = np.linalg.lstsq(whole, right)
    sigma = np.sqrt(np.diagonal(np.linalg.inv(whole.T @ whole)))
    np.testing.assert_allclose(np.concatenate([np.ravel(states), final]), solution, rtol=1e-10, atol=1e-12)
    np.testing.assert_allclose(np.sqrt(np.ravel(variances)), sigma[: steps * n], rtol=1e-10)
    assert np.sum(innovations) == pytest.approx(float(squares[0]), rel=1e-10)
    parted = run(start, rows, (4, 6))[2]
    np.testing.assert_allclose(parted.sum(axis=1), innovations[:, 0], rtol=1e-10)
    first = WhiteRows(*(np.asarray(each)[:, :4] for each in rows))
    assert parted.shape == (steps, 3) and parted[0, 0] == pytest.approx(run(start, first)[2][0, 0], rel=1e-10)


def test_transition_has_the_derivatives_that_automatic_differentiation_gives(recorded):
    imu, recording, rests, _ = recorded
    imu = imu.with_effects(CATALOGUE["gyro.earth_rotation"].make(np.array([2e-5, 1e-5, 5e-5])))
    intervals, _ = cut(recording, rests)
    place = int(np.flatnonzero((np.asarray(intervals.rest) == 0) & (np.asarray(intervals.real) > 0))[1])
    part = jax.tree.map(lambda leaf: jnp.asarray(leaf)[place], intervals)
    errors, numbers = disturbed(1), ravel_pytree(imu)[0]
    before = MotionPath(exponential(jnp.array([0.3, -0.8, 0.5])), jnp.array([0.2, -0.1, 0.3]))

    def onward(change):
        start = MotionPath(multiply(before.attitude, exponential(change[:3])), before.velocity + change[3:6])
        return carried(imu, numbers + change[6:-1], 9.8 + change[-1], part, start)

    @jax.jit
    def all_of():
        after, exact = onward(jnp.zeros(7 + len(numbers))), jax.jacfwd(onward)(jnp.zeros(7 + len(numbers)))
        rows = interval_rows(imu, numbers, jnp.asarray(9.8), part, errors, before, after)
        # a rotation vector δ in the body turns q by q ⊗ (1, δ/2)
        back = jax.vmap(lambda slope: 2 * multiply(after.attitude * jnp.array([1, -1, -1, -1]), slope)[1:], 1, 1)
        return rows, jnp.concatenate([back(exact.attitude), exact.velocity])

    rows, expected = jax.tree.map(np.asarray, all_of())
    weights = np.linalg.inv(-rows.after[:6, :6])  # rows are W (carried − reached)
    found = weights @ np.concatenate([rows.before[:6, :6], rows.shared[:6]], axis=1)
    np.testing.assert_allclose(found, expected, atol=1e-9)
    assert np.abs(rows.right[:6]).max() < 1e-6 * np.abs(weights).max() ** -1


PROTOCOLS = {
    "hand-held": HandHeld(poses=7, pose_duration=2.5, turn_duration=1.4),
    "tracked": HandHeld(poses=7, pose_duration=2.5, turn_duration=1.4, displacement=0.4),
    "magnetic": HandHeld(poses=7, pose_duration=2.5, turn_duration=1.4),
    "single-axis-table": SingleAxisTable(1.5, 180.0, 1.4),
}


@pytest.mark.parametrize(
    ("protocol", "grade", "drifts"),
    [
        ("hand-held", 0.01, 0),
        ("tracked", 1.0, 2),
        pytest.param("magnetic", 1.0, 2, marks=pytest.mark.slow),
        pytest.param("single-axis-table", 1.0, 2, marks=pytest.mark.slow),
    ],
)
def test_the_fit_is_the_least_squares_solution_of_all_states_and_numbers(protocol, grade, drifts):
    """Numbers, iterated to convergence, against dense Gauss–Newton steps over every state at once."""
    imu = jax.tree.map(np.asarray, draw_imu(5))
    white = {"accelerometer": Noise((White(grade * ACCELEROMETER_DENSITY),), "specific_force"),
             "gyroscope": Noise((White(grade * GYROSCOPE_DENSITY),), "angular_rate")}  # fmt: skip
    recording, truth = simulate(imu, PROTOCOLS[protocol], white, rate=50.0, seed=5)
    seen, first = (tracked(recording, truth, 5, moving=True), 0.5) if protocol == "tracked" else (None, 1e-3)
    field = field_of(*magnetic(recording, truth)[::-1]) if protocol == "magnetic" else None
    intervals, _ = cut(recording, truth.intervals, attitude=seen, mounting=Mounting(delay=LATE), field=field)
    errors = replace(
        disturbed(drifts, grade), reference=np.float64(NOISE_OF_TRACKER), velocity=np.float64(SPEED_NOISE),
        field=np.float64(FIELD_NOISE),
    )  # fmt: skip
    measurement = IntervalsOfMotion(intervals, errors, GRAVITY.value)
    if seen is not None:
        off = {"reference_rotation": TURNED + 2e-3, "reference_delay": [LATE - 5e-4], "table_tilt": TILT - 1e-3}
        arm = CATALOGUE["accel.lever_arm"].make(ARM - 0.02)
        imu = imu.with_effects(arm, *(CATALOGUE[f"setup.{name}"].make(each) for name, each in off.items()))
    if field is not None:
        imu = imu.with_effects(CATALOGUE["setup.magnetic_field"].make(first_field(intervals, imu)))
    found = fit(imu, measurement, _free, follow=True, estimate_excess=False, excess=(0.0,))
    assert found.converged
    if field is not None:
        strength = np.linalg.norm(found.imu.coefficients(CATALOGUE["setup.magnetic_field"]))
        assert strength == pytest.approx(48.0, abs=0.3)
    if seen is not None:
        setup = np.concatenate([np.asarray(each.coefficients) for each in found.imu.setup])
        np.testing.assert_allclose(setup, [*TURNED, LATE, *TILT], atol=5e-4)
        np.testing.assert_allclose(found.imu.coefficients(CATALOGUE["accel.lever_arm"]), ARM, atol=2e-3)
    path = measurement.filtered(found.imu).path
    count = int(np.sum(intervals.real))
    numbers = ravel_pytree(found.imu)[0]
    n, m = errors.states, len(found.names)
    index = [list(map(str, _names(imu))).index(name) for name in found.names]

    @jax.jit
    def rows(part, before, after):
        return interval_rows(imu, numbers, jnp.asarray(GRAVITY.value), part, errors, before, after)

    # normal equations, block by block: nothing is eliminated
    size = (count + 1) * n + m
    information, pull = np.zeros((size, size)), np.zeros(size)
    level = 1 / np.array([0.5, 0.5, first, 1e-4, 1e-4, 1e-4, *np.sqrt(np.ravel(errors.variance))])
    information[:n, :n] += np.diag(level**2)
    pull[3:6] -= level[3:6] ** 2 * path.velocity[0]
    for k in range(count):
        part = jax.tree.map(lambda leaf, k=k: np.asarray(leaf)[k], intervals)
        ends = [jax.tree.map(lambda leaf, k=k: np.asarray(leaf)[k], path) for k in (k, k + 1)]
        own = rows(part, *ends)
        jacobian = np.concatenate([own.before, own.after, own.shared[:, index]], axis=1)
        places = np.concatenate([np.arange(k * n, (k + 2) * n), np.arange(size - m, size)])
        information[np.ix_(places, places)] += jacobian.T @ jacobian
        pull[places] += jacobian.T @ np.asarray(own.right)
    known = np.asarray(found.sizes) * 5.0
    information[-m:, -m:] += np.diag(1 / known**2)
    scale = 1 / np.sqrt(np.diagonal(information))
    inverse = np.linalg.inv(information * scale[:, None] * scale) * scale[:, None] * scale
    step, sigma = (inverse @ pull)[-m:], np.sqrt(np.diagonal(inverse))[-m:]
    assert np.max(np.abs(step) / sigma) < 1e-2  # `fit` stops where its last step was below this, and takes it
    np.testing.assert_allclose(found.sigmas(), sigma, rtol=1e-4)
    again = fit(found.imu, measurement, _free, follow=True, estimate_excess=False, excess=(0.0,))
    moved = (np.asarray(again.values) - np.asarray(found.values)) / sigma
    np.testing.assert_allclose(moved, step / sigma, atol=1e-6)


def test_conditions_that_fill_up_a_size_are_none(recorded):
    """They are counted nowhere: the excess is that of the innovations there are."""
    imu, recording, rests, _ = recorded
    measurement = IntervalsOfMotion(cut(recording, rests)[0], disturbed(2), GRAVITY.value)
    about = measurement.about_one(imu)
    used = np.asarray(about.covariance.used)
    assert used.sum() == measurement.freedom.sum() < len(used)
    (factor,) = about.covariance.factors
    np.testing.assert_array_equal(factor, used)
    np.testing.assert_array_equal(np.asarray(about.conditions(imu))[used == 0], 0.0)


def _free(name):
    return without_equipment(name) or name.effect is not None


def _names(imu):
    from jaximu.estimation.problem import names_of

    return names_of(imu)


def squared_error(calibration, imu):
    """Squared error of gain and bias over their covariance: χ² of 21 degrees, of which 5.1 to 46.8 holds 99.9 %."""
    truth = dict(zip(map(str, _names(imu)), np.asarray(ravel_pytree(imu)[0]), strict=True))
    value = dict(zip(map(str, _names(calibration.imu)), np.asarray(ravel_pytree(calibration.imu)[0]), strict=True))
    rows = [place for place, name in enumerate(calibration.names) if name.effect is None]
    error = np.array([value[calibration.names[row]] - truth[calibration.names[row]] for row in rows])
    return error @ np.linalg.solve(calibration.covariance[np.ix_(rows, rows)], error)


def test_the_filter_recovers_a_simulated_unit(recorded, calibrated):
    calibration, history = calibrated
    assert calibration.filter is not None
    assert 5 < squared_error(calibration, recorded[0]) < 45
    assert 0.8 < calibration.filter["nis"] < 1.2
    assert calibration.filter["open"] == []
    assert np.all(np.diff(history.sigmas[:, 0]) < 1e-6)  # of a constant number knowledge only grows
    with_earth = calibration.imu.gyroscope.effects[0].coefficients
    assert np.linalg.norm(with_earth) < 5 * EARTH_RATE


def test_a_sequence_that_leaves_too_much_open_is_refused_with_what_to_record():
    """All turns about z are about the vertical in nineteen positions, and such a gyroscope does not feel the Earth."""
    imu = draw_imu(2)
    recording, _ = simulate(imu, Rotations(duration=2.5, turn_duration=1.4), consumer_noise(), rate=50.0, seed=2)
    with pytest.raises(NotPossibleError, match=r"Gyroscope scale z .* axis horizontal.*jaximu plan"):
        calibrate_by_filter(recording, LocalGravity(9.80665, 1e-3))


HIDDEN = {
    "accel.size_effect": np.array([0.03, -0.02, 0.01, -0.01, 0.02, 0.03, -0.02, 0.0, -0.04]),
    "accel.quadratic": np.array([4e-4, -6e-4, 8e-4]),
    "setup.time_offset": np.array([3e-3]),
}


def test_effects_that_only_motion_shows_are_found_as_states():
    imu = draw_imu(5).with_effects(*(CATALOGUE[name].make(each) for name, each in HIDDEN.items()))
    protocol = HandHeld(poses=12, pose_duration=2.5, turn_duration=1.4)
    recording, _ = simulate(imu, protocol, consumer_noise(), rate=50.0, seed=5)
    found, history = calibrate_by_filter(recording, GRAVITY, static=NOISE, effects=tuple(HIDDEN))
    effects = {each.name: np.asarray(each.coefficients) for each in found.imu.all_effects().values()}
    for name, truth in HIDDEN.items():
        rows = list(places_of(CATALOGUE[name], found.imu, found.names))
        covariance, error = found.covariance[np.ix_(rows, rows)], effects[name] - truth
        assert error @ np.linalg.solve(covariance, error) < 4 * len(rows) + 5
        between = np.eye(len(rows)) - (np.tile(np.eye(3), (3, 3)) / 3 if len(rows) == 9 else 0)  # arms' mean is open
        sigma = np.sqrt(np.diagonal(between @ covariance @ between.T))
        assert np.all(sigma < 0.2 * np.max(np.abs(truth))), name
        assert np.all(np.abs(history.values[-1, rows] - effects[name]) < history.sigmas[-1, rows])
    assert any("size effect" in text and "does not determine them" in text for text in found.filter["open"])
    assert "setup.time_offset[0]" in found.filter["states"]
    assert found.rms["gravity_norm"][1] < 0.01  # without what the effects add


def test_effects_that_the_filter_cannot_follow_are_refused(recorded):
    for name, reason in (("accel.lever_arm", "error of a set-up"), ("gyro.temperature", "jaximu thermal"),
                         ("gyro.dead_band", "not proportional")):  # fmt: skip
        with pytest.raises(NotPossibleError, match=reason):
            calibrate_by_filter(recorded[1], GRAVITY, effects=[name])
    loud = NoiseModel(AxisNoise.of_white((300 * ACCELEROMETER_DENSITY) ** 2), AxisNoise.of_white(GYROSCOPE_DENSITY**2))
    with pytest.raises(NotPossibleError, match=r"size effect .* hidden in the noise"):
        calibrate_by_filter(recorded[1], GRAVITY, static=loud, effects=tuple(HIDDEN))


def test_in_use_the_same_unit_is_followed_and_another_is_told(recorded, calibrated):
    calibration, _ = calibrated
    after, history = followed_in_use(calibration, recorded[1], NOISE)
    assert after.filter["diverged"] is None
    assert 0.7 < after.filter["nis"] < 1.3
    assert history.sigmas[-1, 0] < history.sigmas[0, 0]
    protocol = HandHeld(poses=12, pose_duration=2.5, turn_duration=1.4)
    other = simulate(draw_imu(6), protocol, consumer_noise(), rate=50.0, seed=6)[0]
    told, _ = followed_in_use(calibration, other, NOISE)
    assert told.filter["diverged"] is not None and "another unit" in told.filter["diverged"]


def test_a_sensor_that_hums_is_found_at_rest_in_use(recorded, calibrated):
    """A line that the density of the noise does not tell makes the samples scatter twice as much."""
    signal, white = recorded[1].gyroscope, GYROSCOPE_DENSITY * np.sqrt(recorded[1].gyroscope.rate)
    hum = 2.5 * white * np.sin(2 * np.pi * 19.0 * signal.time)
    humming = replace(recorded[1], gyroscope=replace(signal, values=signal.values + hum[:, None]))
    rests = [followed_in_use(calibrated[0], each, NOISE)[1].rest for each in (recorded[1], humming)]
    assert 0.9 * rests[0].sum() < rests[1].sum() <= 1.1 * rests[0].sum()


def test_motion_in_use_is_as_uncertain_as_the_turns_of_the_calibration(recorded, calibrated):
    """What turns missed beyond the noise when the unit was calibrated counts in motion, and not at rest."""
    plain = replace(calibrated[0], filter=None, excess={"turns": 0.0})
    loose = replace(plain, excess={"turns": 99.0})
    errors = [FilterInUse(each, NOISE, 50.0).errors for each in (plain, loose)]
    np.testing.assert_allclose(errors[1].white, 100 * np.asarray(errors[0].white))
    np.testing.assert_array_equal(errors[1].rest, errors[0].rest)
    assert float(errors[1].arrival) == pytest.approx(10 * float(errors[0].arrival))


def test_a_stream_gives_the_same_however_it_is_cut(recorded, calibrated):
    signal, rate = recorded[1].accelerometer, recorded[1].gyroscope
    found = []
    for size in (7, 400):
        follower = FilterInUse(calibrated[0], NOISE, rate.rate)
        steps = []
        for first in range(0, 1200, size):
            rows = slice(first, min(first + size, 1200))
            steps += follower.update(rate.time[rows], signal.values[rows], rate.values[rows])
        found.append(np.array([each.values for each in steps]))
    np.testing.assert_array_equal(*found)
    with pytest.raises(InputError, match="must rise"):
        follower.update(rate.time[:2], signal.values[:2], rate.values[:2])


def test_a_recording_without_rests_is_refused_in_use(recorded, calibrated):
    random = np.random.default_rng(1)
    signal = recorded[1].gyroscope
    follower = FilterInUse(calibrated[0], NOISE, signal.rate)
    shaken = signal.values[:1000] + random.standard_normal((1000, 3))
    assert follower.update(signal.time[:1000], recorded[1].accelerometer.values[:1000], shaken) == []


def test_command_writes_what_the_surface_says(recorded, calibrated, tmp_path, capsys):
    log, old = tmp_path / "log.csv", tmp_path / "old.json"
    write_recording(recorded[1], log)
    calibrated[0].save(old)
    assert main(["filter", str(log), "--online", str(old), "--json", "-o", str(tmp_path / "results")]) == 0
    printed = json.loads(capsys.readouterr().out)
    assert printed == json.loads((tmp_path / "results" / "calibration.json").read_text())
    assert set(printed["filter"]) >= {"states", "nis", "open"}
    assert "Innovations" in (tmp_path / "results" / "report.html").read_text()


def test_a_recording_without_gyroscope_is_refused(recorded):
    with pytest.raises(InputError, match="needs a gyroscope"):
        calibrate_by_filter(replace(recorded[1], gyroscope=None), GRAVITY)
    with pytest.raises(NotPossibleError, match="static pose"):
        still = recorded[1].gyroscope.time < recorded[2][0, 1]
        calibrate_by_filter(with_rates(recorded[1], recorded[1].gyroscope.values, still), GRAVITY)


# --- a measured attitude ----------------------------------------------------------------------------------------------


def test_what_is_measured_from_outside_has_the_derivatives_of_what_it_means(recorded):
    """WhiteRows against differences of the conditions as scipy has them, by every number of the unit and of the path.

    Exp(τ)ᵀ C Exp(ω δ) Exp(α)ᵀ = Q, and Exp(τ)ᵀ (v + (C f − g ẑ) δ − C Exp(ω δ) (ω′ × r)) = V.
    """
    imu, recording, rests, tracker = recorded
    setup = {"setup.reference_delay": [LATE + 3e-3], "setup.clock_scale": [2e-4], "accel.lever_arm": ARM,
             "setup.reference_rotation": TURNED, "setup.table_tilt": TILT}  # fmt: skip
    imu = imu.with_effects(*(CATALOGUE[name].make(each) for name, each in setup.items()))
    moving = replace(tracker, velocity=np.sin(tracker.time[:, None] + [0.0, 1.0, 2.0]))
    intervals, _ = cut(recording, rests, attitude=moving, mounting=Mounting(delay=LATE))
    chosen = np.asarray(intervals.sightings[0].measured) > np.asarray(intervals.rest)
    part = jax.tree.map(lambda leaf: np.asarray(leaf)[int(np.flatnonzero(chosen)[3])], intervals)
    numbers, (seen, speed) = np.asarray(ravel_pytree(imu)[0]), part.sightings
    sigmas = {"reference": 2e-3, "velocity": 3e-2}
    errors = replace(disturbed(1), **{name: np.float64(each) for name, each in sigmas.items()})
    after = MotionPath(exponential(jnp.array([0.3, -0.8, 0.5])), jnp.array([0.2, -0.4, 0.3]))
    rows = jax.jit(lambda: interval_rows(imu, numbers, jnp.asarray(9.8), part, errors, after, after))()
    last = int(np.sum(np.asarray(part.length) > 0)) - 1

    def off(change):  # the unit's numbers, gravity; attitude, velocity
        unit = unflatten(imu, numbers + change[:-7])
        turning, force = (
            np.linalg.solve(triad.gain, (np.asarray(output)[last - 1 : last + 1] - triad.bias).T).T
            for triad, output in ((unit.gyroscope, part.gyroscope), (unit.accelerometer, part.accelerometer))
        )
        rate, force = turning[1], force[1]
        late, scale, turned, tilt, arm = (
            np.asarray(unit.coefficients(CATALOGUE[f"{name}"]))
            for name in ("setup.reference_delay", "setup.clock_scale", "setup.reference_rotation", "setup.table_tilt",
                         "accel.lever_arm")
        )  # fmt: skip
        ahead = float((seen.stamp - late[0]) * (1 + scale[0]) - seen.end)
        assert np.linalg.norm(rate) > 0.2 and 1e-3 < abs(ahead) < 1 / 50 + 3e-3 + 2e-4 * seen.stamp
        stood = Rotation.from_quat(np.asarray(after.attitude), scalar_first=True) * Rotation.from_rotvec(change[-6:-3])
        there, upright = stood * Rotation.from_rotvec(rate * ahead), Rotation.from_rotvec([*tilt, 0.0]).inv()
        said = upright * there * Rotation.from_rotvec(turned).inv()
        fast = np.asarray(after.velocity) + change[-3:] + (stood.apply(force) - [0.0, 0.0, 9.8 + change[-7]]) * ahead
        onward = np.mean(np.asarray(part.length)[last - 1 : last + 1])
        swinging = rate + (turning[1] - turning[0]) / onward * (np.asarray(part.length)[last] / 2 + ahead)
        fast = upright.apply(fast - there.apply(np.cross(swinging, arm)))
        turn = (Rotation.from_quat(seen.value, scalar_first=True).inv() * said).as_rotvec()
        return np.concatenate([turn / sigmas["reference"], (fast - speed.value) / sigmas["velocity"]])

    count = len(numbers) + 7
    slopes = np.stack([(off(step) - off(-step)) / 2e-5 for step in 1e-5 * np.eye(count)], axis=1)
    state, shared, right = (np.asarray(each)[-6:] for each in (rows.after, rows.shared, rows.right))
    scale = np.repeat(list(sigmas.values()), 3)
    found = np.concatenate([shared, state[:, :6]], axis=1)
    np.testing.assert_allclose(scale[:, None] * found, scale[:, None] * slopes, atol=1e-9)
    np.testing.assert_allclose(right, -off(np.zeros(count)), atol=1e-9)
    assert not state[:, 6:].any() and not np.asarray(rows.before)[-6:].any()


def test_a_measured_attitude_improves_the_calibration(recorded, calibrated, tmp_path, capsys):
    imu, recording, _, tracker = recorded
    log, seen = tmp_path / "log.csv", tmp_path / "tracker.csv"
    write_recording(recording, log)
    columns = np.column_stack([tracker.time, tracker.quaternion])
    np.savetxt(seen, columns, delimiter=",", header="time [s],qw,qx,qy,qz", comments="")
    out = tmp_path / "results"
    assert main(["filter", str(log), "--reference", str(seen), "--gravity", "9.80665+-0.001", "-o", str(out)]) == 0
    assert "stamps are 42." in capsys.readouterr().out
    found, alone = load_calibration(out / "calibration.json"), calibrated[0]
    assert 5 < squared_error(found, imu) < 45
    assert 0.8 < found.filter["nis"] < 1.2 and found.filter["open"] == []
    assert found.reading is not None and found.reading.units["gyroscope"] == "rad/s"
    better = found.sigma("gyroscope")[0] / alone.sigma("gyroscope")[0]
    assert better.max() < 1.1 and better.mean() < 0.97
    offset, turned = found.reference["time_offset"], Rotation.from_quat(found.reference["rotation"], scalar_first=True)
    assert abs(offset["value"] - LATE) < 4 * offset["sigma"] < 1e-3
    assert (turned * Rotation.from_rotvec(TURNED)).magnitude() < 1e-3
    np.testing.assert_allclose(found.imu.coefficients(CATALOGUE["setup.table_tilt"]), TILT, atol=5e-4)


@pytest.fixture(scope="module")
def moved_about(recorded):
    """The same unit moved by up to a metre in each turn, its recording, the true rests and what a tracker says."""
    protocol = HandHeld(poses=9, pose_duration=2.5, turn_duration=2.0, displacement=1.0)
    recording, truth = simulate(recorded[0], protocol, consumer_noise(), rate=50.0, seed=7)
    return recording, truth.intervals, tracked(recording, truth, 7, moving=True)


def test_a_measured_velocity_is_a_measurement_and_shows_the_lever_arm(recorded, moved_about):
    imu, (recording, _, said) = recorded[0], moved_about
    found, history = calibrate_by_filter(recording, GRAVITY, static=NOISE, attitude=said)
    assert 5 < squared_error(found, imu) < 45
    assert 0.8 < found.filter["nis"] < 1.2 and found.filter["open"] == []
    assert history.freedom.max() == 12  # of a rest, attitude and velocity
    arm = found.reference["lever_arm"]
    mounting = Rotation.from_quat(found.reference["rotation"], scalar_first=True).inv()
    assert np.all(np.abs(arm["value"] - mounting.apply(ARM)) < 4 * np.array(arm["sigma"])) and max(arm["sigma"]) < 2e-3


def test_a_measured_velocity_tightens_the_accelerometer_where_rests_are_few(recorded, moved_about):
    """Two rests, and motion between: force in motion is all that shows the accelerometer, and the velocity shows it."""
    imu, (recording, rests, said) = recorded[0], moved_about
    errors = replace(disturbed(1), reference=np.float64(NOISE_OF_TRACKER), velocity=np.float64(SPEED_NOISE))
    setup = {"setup.reference_delay": [LATE], "setup.reference_rotation": TURNED, "setup.table_tilt": TILT,
             "accel.lever_arm": ARM}  # fmt: skip
    unit = imu.with_effects(*(CATALOGUE[name].make(each) for name, each in setup.items()))
    fits = []
    for attitude in (said, replace(said, velocity=None)):
        intervals, notes = cut(recording, rests[[0, -1]], attitude=attitude, mounting=Mounting(delay=LATE))
        assert notes == [] and not np.any(intervals.restart)
        measurement = IntervalsOfMotion(intervals, errors, GRAVITY.value)
        fits.append(fit(unit, measurement, without_equipment, follow=True, estimate_excess=False, excess=(0.0,)))
    found, alone = fits
    assert found.converged and found.names == alone.names
    own = [place for place, name in enumerate(found.names) if name.owner == "accelerometer"]
    tighter = found.sigmas()[own] / alone.sigmas()[own]
    assert np.max(tighter) < 0.5 and np.mean(tighter) < 0.3
    error = np.asarray(found.values) - [
        dict(zip(map(str, _names(imu)), np.asarray(ravel_pytree(imu)[0]), strict=True))[name] for name in found.names
    ]
    assert 5 < error @ np.linalg.solve(found.covariance, error) < 45


def test_in_use_a_measured_attitude_follows_a_unit_that_never_rests_again(recorded, calibrated):
    """Its calibration's gains stand open by half a per cent; motion and the reference show them, and causally."""
    imu = recorded[0]
    restless = HandHeld(poses=14, pose_duration=0.2, turn_duration=2.5, initial_rest=4.0, displacement=1.0)
    recording, truth = simulate(imu, restless, consumer_noise(), rate=50.0, seed=8)
    said = tracked(recording, truth, 8, moving=True)
    open_gains = np.diag([(5e-3 * (name.part == "gain")) ** 2 for name in calibrated[0].names])
    known = replace(calibrated[0], covariance=calibrated[0].covariance + open_gains)
    after, history = followed_in_use(known, recording, NOISE, attitude=said)
    alone, before = followed_in_use(known, recording, NOISE)
    assert after.filter["diverged"] is None and 0.8 < after.filter["nis"] < 1.25
    assert 5 < squared_error(after, imu) < 45
    own = [place for place, name in enumerate(after.names) if name.owner == "gyroscope" and name.part == "gain"]
    tighter = np.sqrt(np.diagonal(after.covariance) / np.diagonal(alone.covariance))[own]
    assert np.max(tighter) < 0.3
    assert history.freedom.max() == 12 and before.freedom.max() == 6
    assert history.time[-1] > 38.0 and abs(after.reference["time_offset"]["value"] - LATE) < 2e-3


def test_command_follows_a_unit_with_a_reference(calibrated, moved_about, tmp_path, capsys):
    (recording, _, said), log, seen, old = (
        moved_about,
        tmp_path / "log.csv",
        tmp_path / "seen.csv",
        tmp_path / "old.json",
    )
    write_recording(recording, log)
    columns = np.column_stack([said.time, said.quaternion, said.velocity])
    header = "time [s],qw,qx,qy,qz,vx [m/s],vy [m/s],vz [m/s]"
    np.savetxt(seen, columns, delimiter=",", header=header, comments="")
    calibrated[0].save(old)
    assert main(["filter", str(log), "--online", str(old), "--reference", str(seen), "--json"]) == 0
    printed = json.loads(capsys.readouterr().out)
    assert printed["filter"]["diverged"] is None and printed["reference"]["lever_arm"] is not None
    assert main(["filter", str(log), "--online", str(old), "--magnetometer", str(old)]) == 2
    assert "no magnetometer in it" in capsys.readouterr().err


def test_in_use_a_reference_of_another_body_diverges(recorded, calibrated, moved_about):
    """It stands still from half the recording on, and the unit goes on turning."""
    recording, _, said = moved_about
    stuck = said.quaternion.copy()
    stuck[len(stuck) // 2 :] = stuck[len(stuck) // 2]
    mounted = mounted_on(recording, replace(said, velocity=None), GRAVITY, NOISE, calibrated[0])
    rate, force = recording.gyroscope, recording.accelerometer
    follower = FilterInUse(calibrated[0], NOISE, rate.rate, GRAVITY, mounted)
    told = replace(mounted.attitude, quaternion=stuck)
    steps = follower.update(rate.time, force.values, rate.values, told)
    assert "the reference is off" in follower.diverged()
    assert sum(step.freedom for step in steps) > 300
    with pytest.raises(InputError, match="how it is mounted"):
        FilterInUse(calibrated[0], NOISE, rate.rate).update(rate.time, force.values, rate.values, said)


def test_a_stream_with_a_reference_gives_the_same_however_it_is_cut(calibrated, moved_about):
    recording, _, said = moved_about
    mounted = mounted_on(recording, said, GRAVITY, NOISE, calibrated[0])
    rate, force, told, found = recording.gyroscope, recording.accelerometer, mounted.attitude, []
    for size in (50, 600):
        follower, steps = FilterInUse(calibrated[0], NOISE, rate.rate, GRAVITY, mounted), []
        for first in range(0, 1200, size):
            rows = slice(first, first + size)
            now = (told.time > rate.time[max(first - 1, 0)] + 0.5) & (told.time <= rate.time[rows][-1] + 0.5)
            now |= (first == 0) & (told.time <= rate.time[rows][-1] + 0.5)
            part = replace(told, time=told.time[now], quaternion=told.quaternion[now], velocity=told.velocity[now])
            steps += follower.update(rate.time[rows], force.values[rows], rate.values[rows], part)
        found.append(np.array([each.values for each in steps]))
    np.testing.assert_allclose(*found)


def test_a_measured_attitude_carries_through_long_motion(recorded):
    _, recording, rests, tracker = recorded
    apart = rests[[0, 1, -2, -1]]
    assert apart[2, 0] - apart[1, 1] > 30.0
    alone, left_out = cut(recording, apart)
    assert any("left out" in note for note in left_out) and np.sum(alone.restart) == 1
    seen, notes = cut(recording, apart, attitude=tracker, mounting=Mounting(delay=LATE))
    assert notes == [] and np.sum(seen.restart) == 0
    lost = replace(tracker, time=tracker.time[:100], quaternion=tracker.quaternion[:100])
    assert np.sum(cut(recording, apart, attitude=lost, mounting=Mounting(delay=LATE))[0].restart) == 1


def test_gains_that_poses_leave_open_do_not_tell_how_a_reference_is_mounted(tmp_path):
    """Turns about two axes leave one gain open; taken for known, it put the reference late and turned by degrees."""
    low = 'noise = { white = "20 ug/sqrt(Hz)", density = "one-sided" }'
    spec = ['seed = 24', 'rate = 50', '[protocol]', 'kind = "rotations"', 'duration = 4', 'turn_duration = 3',
            '[accelerometer]', low, '[gyroscope]', 'scale = [-0.002, 0.001, 0.002]',
            'noise = { white = "0.1 deg/sqrt(h)" }']  # fmt: skip
    (tmp_path / "unit.toml").write_text("\n".join(spec))
    log, out = str(tmp_path / "unit.parquet"), tmp_path / "out"
    assert main(["simulate", str(tmp_path / "unit.toml"), "-o", log]) == 0
    assert not calibrate(read_recording(log), GRAVITY).gains_determined()
    assert main(["filter", log, "--reference", log, "--gravity", "9.80665+-0.0005", "-o", str(out)]) == 0
    found = load_calibration(out / "calibration.json")
    off = np.diag(found.imu.gyroscope.gain) - [0.998, 1.001, 1.002]
    assert np.all(np.abs(off) < 5 * np.diag(found.sigma("gyroscope")[0]))
    assert np.all(np.abs(off) < 3e-4)
    assert np.degrees(Rotation.from_quat(found.reference["rotation"], scalar_first=True).magnitude()) < 0.05
    assert abs(found.reference["time_offset"]["value"]) < 1e-3


def test_the_attitude_of_another_body_is_refused(recorded):
    moved = simulate(recorded[0], HandHeld(poses=12, pose_duration=3.0, turn_duration=1.0), rate=50.0, seed=6)
    with pytest.raises(NotPossibleError, match="do not turn alike"):
        calibrate_by_filter(recorded[1], GRAVITY, static=NOISE, attitude=tracked(*moved, 6))


# --- the magnetic field -----------------------------------------------------------------------------------------------


def test_a_measured_field_has_the_derivatives_of_what_it_means(recorded):
    """Its rows against differences of Cᵀ h = m, as scipy has it."""
    imu, recording, rests, _ = recorded
    place, mean = np.array([18.0, 5.0, -42.0]), np.array([20.0, -3.0, 40.0])
    unit = imu.with_effects(CATALOGUE["setup.magnetic_field"].make(place))
    time = recording.gyroscope.time
    intervals, _ = cut(recording, rests, field=Signal(time, np.tile(mean, (len(time), 1)), "uT"))
    (seen,) = intervals.sightings
    assert np.sum(seen.measured) == len(rests)
    part = jax.tree.map(lambda leaf: np.asarray(leaf)[int(np.argmax(seen.measured))], intervals)
    after, errors = MotionPath(exponential(jnp.array([0.3, -0.8, 0.5])), jnp.zeros(3)), disturbed(1)
    numbers = ravel_pytree(unit)[0]
    rows = jax.jit(lambda: interval_rows(unit, numbers, jnp.asarray(9.8), part, errors, after, after))()

    def off(change):  # attitude, field
        stood = Rotation.from_quat(np.asarray(after.attitude), scalar_first=True) * Rotation.from_rotvec(change[:3])
        return stood.inv().apply(place + change[3:]) - mean

    slopes = np.stack([(off(step) - off(-step)) / 2e-5 for step in 1e-5 * np.eye(6)], axis=1)
    state, shared, right = (np.asarray(each)[-3:] for each in (rows.after, rows.shared, rows.right))
    np.testing.assert_allclose(np.concatenate([state[:, :3], shared[:, -4:-1]], axis=1), slopes, rtol=1e-9, atol=3e-9)
    np.testing.assert_allclose(right, -off(np.zeros(6)), atol=1e-12)
    assert not state[:, 3:].any() and not shared[:, :-4].any() and not shared[:, -1].any()


def test_the_magnetic_field_is_a_measurement_of_every_rest(recorded, magnetic_recording):
    imu, (recording, known) = recorded[0], magnetic_recording
    found, history = calibrate_by_filter(recording, GRAVITY, static=NOISE, magnetometer=known)
    assert 5 < squared_error(found, imu) < 45
    assert 0.8 < found.filter["nis"] < 1.2 and found.filter["open"] == []
    field = found.imu.coefficients(CATALOGUE["setup.magnetic_field"])
    assert np.linalg.norm(field) == pytest.approx(48.0, abs=0.3)
    assert np.degrees(np.arcsin(field[2] / np.linalg.norm(field))) == pytest.approx(-62.0, abs=0.3)
    assert any("magnetic_field" in each for each in found.filter["states"]) and history.freedom.max() == 9


@dataclass(frozen=True)
class _Carousel(Protocol):
    """Level, and turned about the vertical by a quarter eight times, which gravity does not show."""

    kind = "carousel"

    def course(self, rng):
        course = Course(Rotation.identity())
        for _ in range(8):
            course.rest(2.5)
            course.turn([0.0, 0.0, np.pi / 2], 1.4)
        course.rest(2.5)
        return course


def test_the_magnetic_field_holds_the_heading():
    """Gravity does not show how far the unit turned about the vertical; the field does, and so the gyroscope's gain."""
    imu = jax.tree.map(np.asarray, draw_imu(5))
    simulated = simulate(imu, _Carousel(), consumer_noise(), rate=50.0, seed=5)
    recording, known = magnetic(*simulated)
    errors, fits = replace(disturbed(1), field=np.float64(FIELD_NOISE)), []
    for field in (field_of(known, recording), None):
        intervals, _ = cut(recording, simulated[1].intervals, field=field)
        unit = imu
        if field is not None:
            unit = imu.with_effects(CATALOGUE["setup.magnetic_field"].make(first_field(intervals, imu)))
        measurement = IntervalsOfMotion(intervals, errors, GRAVITY.value)
        fits.append(fit(unit, measurement, _free, follow=True, estimate_excess=False, excess=(0.0,)))
    held, alone = fits
    about_vertical = list(map(str, held.names)).index("gyroscope.gain[2,2]")
    sigma = held.sigmas()[about_vertical]
    assert sigma < 0.01 * alone.sigmas()[about_vertical] and sigma < 1.5e-3
    assert abs(held.values[about_vertical] - imu.gyroscope.gain[2, 2]) < 3 * sigma


@pytest.fixture(scope="module")
def turned_level():
    """The unit of `recorded` turned about the vertical, with a magnetometer, and that one's calibration."""
    return magnetic(*simulate(draw_imu(5), _Carousel(), consumer_noise(), rate=50.0, seed=5))


def test_in_use_the_magnetic_field_holds_the_heading(recorded, calibrated, turned_level):
    """A gain about the vertical that is off, and not known better, which gravity does not show."""
    (recording, known), (calibration, _) = turned_level, calibrated
    place = [str(each) for each in calibration.names].index("gyroscope.gain[2,2]")
    covariance = np.array(calibration.covariance)
    covariance[place, place] += 0.02**2
    gain = np.array(calibration.imu.gyroscope.gain)
    gain[2, 2] += 0.02
    imu = replace(calibration.imu, gyroscope=replace(calibration.imu.gyroscope, gain=gain))
    stale = replace(calibration, imu=imu, covariance=covariance)
    held, alone = (followed_in_use(stale, recording, NOISE, magnetometer=each)[0] for each in (known, None))
    sigmas = [np.sqrt(each.covariance[place, place]) for each in (held, alone)]
    assert held.names[place] == calibration.names[place] and held.filter["diverged"] is None
    assert 0.5 < held.filter["nis"] < 1.3
    assert sigmas[0] < 0.2 * sigmas[1]
    assert abs(held.imu.gyroscope.gain[2, 2] - recorded[0].gyroscope.gain[2, 2]) < 3 * sigmas[0]
    assert "magnetic field" in held.filter["states"] and not held.imu.setup


def test_in_use_a_field_that_is_disturbed_is_said(calibrated, turned_level):
    """From the middle on iron turns the field by a quarter."""
    recording, known = turned_level
    field, values = field_of(known, recording), np.array(recording.magnetometer.values)
    late = field.time > field.time[len(field) // 2]
    values[late] = (field.values[late] * [1.0, -1.0, 1.0])[:, [1, 0, 2]] @ MAGNETOMETER.gain.T + MAGNETOMETER.bias
    spoilt = replace(recording, magnetometer=replace(recording.magnetometer, values=values))
    after, _ = followed_in_use(calibrated[0], spoilt, NOISE, magnetometer=known)
    assert after.filter["diverged"] is not None and "magnetic field is disturbed" in after.filter["diverged"]


def test_a_stream_with_a_field_gives_the_same_however_it_is_cut(calibrated, turned_level):
    recording, known = turned_level
    field, force, rate = field_of(known, recording), recording.accelerometer, recording.gyroscope
    around = np.where(np.arange(len(rate.time))[:, None] % 3 == 0, field.values, np.nan)  # a third of the rate
    found = []
    for size in (7, 400):
        follower = FilterInUse(calibrated[0], NOISE, rate.rate, magnetic=True)
        steps = []
        for first in range(0, len(rate.time), size):
            rows = slice(first, first + size)
            steps += follower.update(rate.time[rows], force.values[rows], rate.values[rows], None, around[rows])
        found.append(np.array([each.values for each in steps]))
    np.testing.assert_array_equal(*found)
    assert max(each.freedom for each in steps) == 9
    with pytest.raises(InputError, match="follows none"):
        FilterInUse(calibrated[0], NOISE, rate.rate).update(
            rate.time[:2], force.values[:2], rate.values[:2], None, around[:2]
        )


def test_what_holds_no_magnetometer_is_refused(recorded, magnetic_recording):
    with pytest.raises(InputError, match="no magnetometer in it"):
        calibrate_by_filter(recorded[1], GRAVITY, static=NOISE, magnetometer=magnetic_recording[1])
    bare = replace(magnetic_recording[1], imu=Imu.nominal())
    with pytest.raises(InputError, match="holds none"):
        calibrate_by_filter(magnetic_recording[0], GRAVITY, static=NOISE, magnetometer=bare)


# --- recordings that are not as they should be ------------------------------------------------------------------------


def with_rates(recording, values, kept=slice(None)):
    """Return a recording whose gyroscope read something else, without some of its samples."""
    signals = {"gyroscope": replace(recording.gyroscope, values=values), "accelerometer": recording.accelerometer}
    return replace(recording, **{name: replace(each, time=each.time[kept], values=each.values[kept])
                                 for name, each in signals.items()})  # fmt: skip


def test_what_comes_before_the_first_rest_is_left_out_and_said(recorded):
    _, recording, rests, _ = recorded
    intervals, notes = cut(recording, rests[1:])
    assert np.min(np.asarray(intervals.time)[np.asarray(intervals.length) > 0]) > rests[1, 0]
    assert len(notes) == 1 and "the first 3.9 s, before the first rest, were left out" in notes[0]


def test_gaps_are_bridged_where_the_unit_hardly_turned_and_motion_left_out_where_it_did(recorded):
    _, recording, rests, _ = recorded
    time, rate = recording.gyroscope.time, np.linalg.norm(recording.gyroscope.values, axis=1)
    fast = time[np.argmax(rate)]
    resting = np.abs(time - rests[4].mean()) > 0.2
    turning = np.abs(time - fast) > 0.4 / rate.max()
    found = [cut(with_rates(recording, recording.gyroscope.values, kept), rests) for kept in (resting, turning)]
    assert ["bridged" in notes[0] for _, notes in found] == [True, False]
    assert "1 motion in which samples are missing while the unit turned" in found[1][1][0]
    assert [np.sum(intervals.restart) for intervals, _ in found] == [0, 1]
    assert 0.3 < np.sum(found[0][0].lost) < 0.5


def test_motion_beyond_the_range_is_left_out_and_said(recorded, calibrated):
    imu, recording, _, _ = recorded
    limit = 0.8 * np.abs(recording.gyroscope.values).max()
    clipped = with_rates(recording, np.clip(recording.gyroscope.values, -limit, limit))
    found, _ = calibrate_by_filter(clipped, GRAVITY, static=NOISE)
    assert any("range is too small" in note for note in found.notes)
    assert any("nobody knows how far" in note for note in found.notes)
    assert 5 < squared_error(found, imu) < 45
    after, history = followed_in_use(calibrated[0], clipped, NOISE)
    assert after.filter["diverged"] is None and any("range is too small" in note for note in after.notes)
    assert history.sigmas[-1, 0] < history.sigmas[0, 0]


def test_a_slow_turn_is_no_rest(recorded, calibrated):
    """About the vertical, where the accelerometer cannot see it: heading is free, so nothing else changes."""
    imu, recording, rests, _ = recorded
    rate, force = recording.gyroscope, recording.accelerometer
    inside = (rate.time > rests[6, 0]) & (rate.time < rests[6, 1])
    up = np.linalg.solve(imu.accelerometer.gain, force.values[inside].mean(axis=0) - imu.accelerometer.bias)
    turning = np.radians(1.0) * np.asarray(imu.gyroscope.gain) @ up / np.linalg.norm(up)
    slow = with_rates(recording, rate.values + inside[:, None] * turning)
    found, _ = calibrate_by_filter(slow, GRAVITY, static=NOISE)
    assert any("turned slowly" in note for note in found.notes) and 5 < squared_error(found, imu) < 45
    told, _ = followed_in_use(calibrated[0], slow, NOISE)
    assert "a rest was no rest" in told.filter["diverged"]


def test_the_earth_is_no_noise_of_motion():
    """Turns of a good gyroscope miss by the Earth's rotation, and the filter knows it."""
    grade, imu = 0.01, jax.tree.map(np.asarray, draw_imu(5))
    white = {"accelerometer": Noise((White(grade * ACCELEROMETER_DENSITY),), "specific_force"),
             "gyroscope": Noise((White(grade * GYROSCOPE_DENSITY),), "angular_rate")}  # fmt: skip
    known = NoiseModel(
        *(AxisNoise.of_white((grade * each) ** 2) for each in (ACCELEROMETER_DENSITY, GYROSCOPE_DENSITY))
    )
    recording, _ = simulate(imu, HandHeld(poses=14, pose_duration=4.0, turn_duration=1.4), white, rate=50.0, seed=5,
                            environment=Environment(latitude=48.0))  # fmt: skip
    found, history = calibrate_by_filter(recording, GRAVITY, static=known)
    assert 5 < squared_error(found, imu) < 45
    assert found.filter["noise"]["motion"] < 10 and found.sigma("gyroscope")[0].max() < 1e-5
    earth = history.values[-1, list(history.earth)]
    np.testing.assert_allclose(np.linalg.norm(earth), EARTH_RATE, rtol=0.02)
    np.testing.assert_allclose(np.degrees(np.arcsin(earth[2] / EARTH_RATE)), 48.0, atol=2.0)


def test_a_stream_needs_constant_memory(recorded, calibrated):
    force, rate = recorded[1].accelerometer, recorded[1].gyroscope
    follower, sizes = FilterInUse(calibrated[0], NOISE, rate.rate), []
    for first in range(0, 2400, 600):
        rows = slice(first, first + 600)
        follower.update(rate.time[rows], force.values[rows], rate.values[rows])
        sizes.append(len(pickle.dumps({name: each for name, each in vars(follower).items() if name != "imu"})))
    assert max(sizes) - min(sizes) < 6000  # a few innovations; six hundred samples are 60 kB and more
