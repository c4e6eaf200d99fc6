"""The filter over intervals of rest and motion: equal to the batch fit, its derivatives, and what it says of misuse."""

import json
import pickle
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.flatten_util import ravel_pytree
from scipy.spatial.transform import Rotation
from tracker import LATE, TILT, TURNED, tracked
from tracker import NOISE as NOISE_OF_TRACKER

from jaximu.calibration import FilterInUse, calibrate_by_filter, followed_in_use, load_calibration
from jaximu.calibration.systematic import places_of
from jaximu.cli.app import main
from jaximu.effects import CATALOGUE
from jaximu.effects.earth_rotation import EARTH_RATE
from jaximu.errors import InputError, NotPossibleError
from jaximu.estimation import fit
from jaximu.formats import write_recording
from jaximu.gravity import LocalGravity
from jaximu.information_filter import Knowledge, Rows, estimate, run, smooth, smoothed_variances
from jaximu.measurements.intervals import Disturbances, IntervalsOfMotion, Path, carried, cut, interval_rows
from jaximu.noise import Noise, White
from jaximu.noise.model import AxisNoise, NoiseModel
from jaximu.problem import without_equipment
from jaximu.protocols import Environment, HandHeld, Positions, SingleAxisTable
from jaximu.rotation import exponential, multiply
from jaximu.simulation import ACCELEROMETER_DENSITY, GYROSCOPE_DENSITY, consumer_noise, draw_imu, simulate

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


def disturbed(drifts: int, grade: float = 1.0) -> Disturbances:
    """Disturbances of a unit whose white noise is `grade` times a consumer unit's."""
    white = grade**2 * np.repeat([GYROSCOPE_DENSITY**2, ACCELEROMETER_DENSITY**2], 3)
    variance = np.tile(0.05 * white, (drifts, 1))
    return Disturbances(white, white, variance, 10.0 ** np.arange(1, drifts + 1), np.float64(1e-10), np.float64(1e-3),
                        np.ones(6))  # pyright: ignore # fmt: skip


def test_filter_and_smoother_solve_the_least_squares_problem_of_all_rows():
    random = np.random.default_rng(0)
    n, m, r, steps = 3, 2, 7, 6
    rows = Rows(*(random.standard_normal(size) for size in ((steps, r, n), (steps, r, n), (steps, r, m), (steps, r))))
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


def test_transition_has_the_derivatives_that_automatic_differentiation_gives(recorded):
    imu, recording, rests, _ = recorded
    imu = imu.with_effects(CATALOGUE["gyro.earth_rotation"].make(np.array([2e-5, 1e-5, 5e-5])))
    intervals, _ = cut(recording, rests)
    place = int(np.flatnonzero((np.asarray(intervals.rest) == 0) & (np.asarray(intervals.real) > 0))[1])
    part = jax.tree.map(lambda leaf: jnp.asarray(leaf)[place], intervals)
    errors, numbers = disturbed(1), ravel_pytree(imu)[0]
    before = Path(exponential(jnp.array([0.3, -0.8, 0.5])), jnp.array([0.2, -0.1, 0.3]))

    def onward(change):
        start = Path(multiply(before.attitude, exponential(change[:3])), before.velocity + change[3:6])
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
    "tracked": HandHeld(poses=7, pose_duration=2.5, turn_duration=1.4),
    "positions": Positions(12, 1.5, 1.4),
    "single-axis-table": SingleAxisTable(1.5, 180.0, 1.4),
}


@pytest.mark.parametrize(("grade", "drifts"), [(1.0, 2), (0.01, 0)], ids=["consumer", "navigation"])
@pytest.mark.parametrize("protocol", PROTOCOLS)
def test_the_fit_is_the_least_squares_solution_of_all_states_and_numbers(protocol, grade, drifts):
    """Numbers, iterated to convergence, against dense Gauss–Newton steps over every state at once."""
    imu = jax.tree.map(np.asarray, draw_imu(5))
    white = {"accelerometer": Noise((White(grade * ACCELEROMETER_DENSITY),), "specific_force"),
             "gyroscope": Noise((White(grade * GYROSCOPE_DENSITY),), "angular_rate")}  # fmt: skip
    recording, truth = simulate(imu, PROTOCOLS[protocol], white, rate=50.0, seed=5)
    seen, first = (tracked(recording, truth, 5), 0.5) if protocol == "tracked" else (None, 1e-3)
    intervals, _ = cut(recording, truth.intervals, attitude=seen, clock=(LATE, 0.0))
    errors = replace(disturbed(drifts, grade), reference=np.float64(NOISE_OF_TRACKER))
    measurement = IntervalsOfMotion(intervals, errors, GRAVITY.value)
    if seen is not None:
        off = {"reference_rotation": TURNED + 2e-3, "reference_delay": [LATE - 5e-4], "table_tilt": TILT - 1e-3}
        imu = imu.with_effects(*(CATALOGUE[f"setup.{name}"].make(each) for name, each in off.items()))
    found = fit(imu, measurement, _free, follow=True, estimate_excess=False, excess=(0.0,))
    assert found.converged
    if seen is not None:
        setup = np.concatenate([np.asarray(each.coefficients) for each in found.model.setup])
        np.testing.assert_allclose(setup, [*TURNED, LATE, *TILT], atol=5e-4)
    path = measurement.filtered(found.model).path
    count = int(np.sum(intervals.real))
    numbers = ravel_pytree(found.model)[0]
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
    again = fit(found.model, measurement, _free, follow=True, estimate_excess=False, excess=(0.0,))
    moved = (np.asarray(again.values) - np.asarray(found.values)) / sigma
    np.testing.assert_allclose(moved, step / sigma, atol=1e-6)


def _free(name):
    return without_equipment(name) or name.owner == "setup"


def _names(imu):
    from jaximu.problem import names_of

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


def test_effects_that_only_motion_shows_are_found_as_states():
    hidden = {"accel.size_effect": np.array([0.03, -0.02, 0.01, -0.01, 0.02, 0.03, -0.02, 0.0, -0.04]),
              "accel.quadratic": np.array([4e-4, -6e-4, 8e-4]), "setup.time_offset": np.array([3e-3])}  # fmt: skip
    imu = draw_imu(5).with_effects(*(CATALOGUE[name].make(each) for name, each in hidden.items()))
    protocol = HandHeld(poses=12, pose_duration=2.5, turn_duration=1.4)
    recording, _ = simulate(imu, protocol, consumer_noise(), rate=50.0, seed=5)
    found, history = calibrate_by_filter(recording, GRAVITY, static=NOISE, effects=tuple(hidden))
    effects = {each.name: np.asarray(each.coefficients) for each in found.imu.all_effects().values()}
    for name, truth in hidden.items():
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
        calibrate_by_filter(recorded[1], GRAVITY, static=loud, effects=["accel.size_effect"])


def test_in_use_the_same_unit_is_followed_and_another_is_told(recorded, calibrated):
    calibration, _ = calibrated
    after, history = followed_in_use(calibration, recorded[1], NOISE)
    assert after.filter["diverged"] is None
    assert 0.7 < after.filter["nis"] < 1.3
    assert history.sigmas[-1, 0] < history.sigmas[0, 0]
    other = simulate(draw_imu(6), HandHeld(poses=5, pose_duration=3.0), consumer_noise(), rate=50.0, seed=6)[0]
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
        still = simulate(recorded[0], HandHeld(poses=1, pose_duration=30.0), consumer_noise(), rate=50.0, seed=1)[0]
        calibrate_by_filter(still, GRAVITY)


# --- a measured attitude ----------------------------------------------------------------------------------------------


def test_a_measured_attitude_has_the_derivatives_of_what_it_means(recorded):
    """Its rows against differences of the condition as scipy has it: Exp(τ)ᵀ C Exp(ω δ) Exp(α)ᵀ = Q."""
    imu, recording, rests, tracker = recorded
    setup = {"reference_delay": [LATE + 3e-3], "clock_scale": [2e-4], "reference_rotation": TURNED, "table_tilt": TILT}
    imu = imu.with_effects(*(CATALOGUE[f"setup.{name}"].make(each) for name, each in setup.items()))
    intervals, _ = cut(recording, rests, attitude=tracker, clock=(LATE, 0.0))
    moving = np.asarray(intervals.sighting.measured) > np.asarray(intervals.rest)
    part = jax.tree.map(lambda leaf: np.asarray(leaf)[int(np.flatnonzero(moving)[3])], intervals)
    numbers, seen = ravel_pytree(imu)[0], part.sighting
    errors = replace(disturbed(1), reference=np.float64(2e-3))
    after = Path(exponential(jnp.array([0.3, -0.8, 0.5])), jnp.zeros(3))
    rows = jax.jit(lambda: interval_rows(imu, numbers, jnp.asarray(9.8), part, errors, after, after))()
    last = int(np.sum(np.asarray(part.length) > 0)) - 1
    rate = np.linalg.solve(imu.gyroscope.gain, np.asarray(part.gyroscope)[last] - imu.gyroscope.bias)
    assert np.linalg.norm(rate) > 0.2

    def off(change):  # delay, clock scale, mounting, tilt; attitude
        late, scale = change[:2] + [LATE + 3e-3, 2e-4]
        ahead = (seen.stamp - late) * (1 + scale) - seen.end
        assert abs(ahead) < 1 / 50 + 3e-3 + 2e-4 * seen.stamp
        said = Rotation.from_quat(np.asarray(after.attitude), scalar_first=True) * Rotation.from_rotvec(change[7:])
        said = Rotation.from_rotvec([*(TILT + change[5:7]), 0.0]).inv() * said * Rotation.from_rotvec(rate * ahead)
        said = said * Rotation.from_rotvec(TURNED + change[2:5]).inv()
        return (Rotation.from_quat(seen.attitude, scalar_first=True).inv() * said).as_rotvec()

    slopes = np.stack([(off(step) - off(-step)) / 2e-5 for step in 1e-5 * np.eye(10)], axis=1)
    state, shared, right = (2e-3 * np.asarray(each)[-3:] for each in (rows.after, rows.shared, rows.right))
    np.testing.assert_allclose(np.concatenate([shared[:, -8:-1], state[:, :3]], axis=1), slopes, atol=1e-9)
    np.testing.assert_allclose(right, -off(np.zeros(10)), atol=1e-12)
    assert not state[:, 3:].any() and not shared[:, :-8].any()


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
    better = found.sigma("gyroscope")[0] / alone.sigma("gyroscope")[0]
    assert better.max() < 1.1 and better.mean() < 0.95
    offset, turned = found.reference["time_offset"], Rotation.from_quat(found.reference["rotation"], scalar_first=True)
    assert abs(offset["value"] - LATE) < 4 * offset["sigma"] < 1e-3
    assert (turned * Rotation.from_rotvec(TURNED)).magnitude() < 1e-3
    np.testing.assert_allclose(found.imu.coefficients(CATALOGUE["setup.table_tilt"]), TILT, atol=5e-4)


def test_a_measured_attitude_carries_through_long_motion(recorded):
    _, recording, rests, tracker = recorded
    apart = rests[[0, 1, -2, -1]]
    assert apart[2, 0] - apart[1, 1] > 30.0
    alone, left_out = cut(recording, apart)
    assert any("left out" in note for note in left_out) and np.sum(alone.restart) == 1
    seen, notes = cut(recording, apart, attitude=tracker, clock=(LATE, 0.0))
    assert notes == [] and np.sum(seen.restart) == 0
    lost = replace(tracker, time=tracker.time[:100], quaternion=tracker.quaternion[:100])
    assert np.sum(cut(recording, apart, attitude=lost, clock=(LATE, 0.0))[0].restart) == 1


def test_the_attitude_of_another_body_is_refused(recorded):
    moved = simulate(recorded[0], HandHeld(poses=12, pose_duration=3.0, turn_duration=1.0), rate=50.0, seed=6)
    with pytest.raises(NotPossibleError, match="do not turn alike"):
        calibrate_by_filter(recorded[1], GRAVITY, static=NOISE, attitude=tracked(*moved, 6))


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
