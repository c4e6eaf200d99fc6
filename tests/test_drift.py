"""Drift, moving poses and undersampled turns, estimated from the recording that is diagnosed."""

from dataclasses import replace

import hidden_effects as hidden
import numpy as np
import pytest
from scipy.optimize import minimize

from jaximu import (
    CATALOGUE,
    LocalGravity,
    ReadOptions,
    Recording,
    Signal,
    calibrate,
    compensate,
    diagnose,
    load_calibration,
    read_recording,
    write_recording,
)
from jaximu.data.drift import restricted_likelihood
from jaximu.diagnosis.diagnosis import recorded_by_hand
from jaximu.recordings.recording import one_after_another

GRAVITY = LocalGravity(hidden.GRAVITY, 0.0)
USUAL = {name: hidden.FLICKER[short] / hidden.WHITE[short] for name, short in
         (("accelerometer", "accel"), ("gyroscope", "gyro"))}  # fmt: skip
XSENS = ReadOptions(columns="time [s],accel [count],gyro [count]", accel_offset="32768",
                    gyro_scale="6258 count/(rad/s)", gravity=LocalGravity(9.81744, 0.0005))  # fmt: skip


# how often, from less to more: benchmarks/results/false_alarms.md
@pytest.mark.parametrize("flicker", [pytest.param(0.3, marks=pytest.mark.slow), 1.0, 3.6, 7.0])
def test_drift_is_estimated_and_no_effect_is_made_of_it(flicker, tmp_path):
    case = hidden.draw_case(1304, (), flicker=flicker)
    found = diagnose(read_recording(case.write(tmp_path, ("fit",))["fit"]), GRAVITY)
    assert found.verdict == "adequate"
    assert [each.name for each in found.preflight] == []
    drift = found.experiment.drift
    assert drift is not None and set(drift.notes) <= set(found.notes)
    for triad, usual in USUAL.items() if flicker < 5 else ():  # beyond, it is part of the scatter within a second
        size, relative = drift.sizes[f"{triad} bias instability"]
        assert abs(np.log(size / (flicker * usual))) < 3 * relative + 0.3
    calibration, plain = found.extended_calibration(), found.calibration
    for triad, truth in (("accelerometer", case.truth.accel_bias), ("gyroscope", case.truth.gyro_bias)):
        sigma = calibration.sigma(triad)[1]
        assert np.all(np.abs(np.asarray(calibration.triads()[triad].bias) - truth) < 4 * sigma)
        if flicker >= 1:
            assert np.all(sigma > plain.sigma(triad)[1])


def test_a_hidden_effect_does_not_pass_for_drift(tmp_path):
    case = hidden.draw_case(1305, ("gyro.g_sensitivity",)).with_size(3.0)
    found = diagnose(read_recording(case.write(tmp_path, ("fit",))["fit"]), GRAVITY)
    assert [each.name for each in found.effects] == ["gyro.g_sensitivity"]
    assert found.experiment.drift is not None
    size, relative = found.experiment.drift.sizes["gyroscope bias instability"]
    assert abs(np.log(size / USUAL["gyroscope"])) < 3 * relative + 0.3


def sessions(case, folder):
    """Three recordings of a unit, the biases of both sensors set anew before each."""
    made = case.powered_on({"accel": 0.03, "gyro": 0.003})
    return [read_recording(each.write(folder / f"{number}.parquet")) for number, each in enumerate(made)]


@pytest.mark.parametrize("static", [False, True])
def test_biases_of_another_power_on_are_no_effect(static, tmp_path):
    case = hidden.draw_case(1306, (), poses=20, static_minutes=10)
    noise = read_recording(case.write(tmp_path, ("static",))["static"]) if static else None
    found = diagnose(sessions(case, tmp_path), GRAVITY, static=noise)
    assert found.verdict == "adequate"
    assert [note for note in found.notes if "Between the recordings the accelerometer's bias changes by about" in note]
    assert found.experiment.drift is not None
    size, relative = found.experiment.drift.sizes["accelerometer power-on"]
    assert abs(np.log(size * hidden.WHITE["accel"] / 0.03)) < 3 * max(relative, 0.3)  # six numbers tell it
    tested = {*found.detection_limits, *found.not_observable}
    assert {f"gyro.step@{number}" for number in (1, 2, 3)} <= tested  # in each recording by itself
    assert not {"gyro.step", "gyro.warm_up@all"} & tested


def drifting_in_the_second(folder, *others):
    """Two recordings of a unit, a ramp of the gyroscope's bias hidden in the second; `others` are hidden in both."""
    names = ("gyro.bias_ramp", *others)
    case = hidden.draw_case(1306, names, poses=20).with_size({"gyro.bias_ramp": 4.0, **dict.fromkeys(others, 2.0)})
    without = replace(case, hidden=tuple(each for each in case.hidden if each.name in others))
    biases = {"accel": 0.03, "gyro": 0.003}
    made = without.powered_on(biases, 2)[0], case.powered_on(biases, 2)[1]
    logs = [each.write(folder / f"{number}.parquet") for number, each in enumerate(made, 1)]
    return case, [read_recording(log) for log in logs]


def test_a_ramp_of_one_recording_is_named_in_it(tmp_path):
    case, recordings = drifting_in_the_second(tmp_path)
    found = diagnose(recordings, GRAVITY)
    assert found.verdict == "effects"
    (ramp,) = found.named
    assert (ramp.name, ramp.file, ramp.effect.recording) == ("gyro.bias_ramp@2", "2.parquet", 2)
    assert "gyroscope bias ramp in recording 2 (gyro.bias_ramp@2) of 2.parquet" in ramp.sentence()
    assert np.all(np.abs(ramp.effect.coefficients - case.hidden[0].coefficients) < 4 * ramp.sigma)
    assert found.gain is not None and found.gain.log_likelihood > 10
    (written,) = found.document()["effects"]
    assert (written["name"], written["recording"], written["scope"]) == ("gyro.bias_ramp", 2, "session")
    extended = found.extended_calibration()
    extended.save(tmp_path / "calibration.json")
    read = load_calibration(tmp_path / "calibration.json")
    (effect,), (kept,) = (one.imu.all_effects().values() for one in (read, extended))
    assert effect.name == kept.name == "gyro.bias_ramp@2"
    np.testing.assert_array_equal(effect.coefficients, kept.coefficients)
    assert not read.imu.transferable().all_effects()  # no other recording is corrected by it
    corrected, plain = (compensate(one, recordings[1]) for one in (read, replace(read, imu=read.imu.with_effects())))
    np.testing.assert_array_equal(corrected.signals["gyroscope"].values, plain.signals["gyroscope"].values)


def test_what_dies_away_after_power_on_goes_on_in_the_next_recording(tmp_path):
    name = "gyro.warm_up"
    case = hidden.draw_case(1306, (name,), poses=32, inner={name: {"time_constant": 90.0}}).with_size(10.0)
    whole = read_recording(case.write(tmp_path, ("fit",))["fit"])
    stop = float(whole.accelerometer.time[-1])
    logs = []
    for number, (first, last) in enumerate([(0.0, 0.45 * stop), (0.5 * stop, stop)]):
        part = {}
        for key, of in whole.signals.items():
            rows = (of.time >= first) & (of.time <= last)
            part[key] = replace(of, time=of.time[rows] - first, values=of.values[rows])
        logs.append(tmp_path / f"{number}.parquet")
        write_recording(replace(whole, **part, start=1.7e9 + first), logs[-1])
    found = diagnose([read_recording(log) for log in logs], GRAVITY)
    (effect,) = found.effects
    assert effect.name == "gyro.warm_up@all" and not effect.rivals
    np.testing.assert_array_less(np.abs(effect.effect.coefficients - case.hidden[0].coefficients), 4 * effect.sigma)
    assert "gyroscope warm-up over all recordings" in effect.sentence()
    found.extended_calibration().save(tmp_path / "calibration.json")
    (read,) = load_calibration(tmp_path / "calibration.json").imu.all_effects().values()
    assert read.name == effect.name == found.document()["effects"][0]["name"]


def test_recordings_follow_each_other_by_their_stamps():
    signal = Signal(np.arange(11.0), np.zeros((11, 3)), "m/s^2")
    logs = [Recording(signal, start=start) for start in (122.0, 100.0, 111.0)]
    assert one_after_another(logs) == [22.0, 0.0, 11.0]
    assert one_after_another(logs[:2]) == [22.0, 0.0]
    for start in (105.0, 131.0):  # the stamps overlap; or the pause is longer than what was recorded
        assert one_after_another([logs[1], Recording(signal, start=start)]) == []
    assert one_after_another(logs[:1]) == []


def test_a_ramp_of_one_recording_stands_beside_what_the_unit_does_in_both(tmp_path):
    _, recordings = drifting_in_the_second(tmp_path, "gyro.g_sensitivity")
    found = diagnose(recordings, GRAVITY)
    assert found.verdict == "effects"
    assert {each.name for each in found.named} == {"gyro.bias_ramp@2", "gyro.g_sensitivity"}


def test_an_effect_of_one_recording_acts_in_no_other(tmp_path):
    """Its columns are those of the whole effect in its recording; a unit with it has none of it in the others."""
    _, recordings = drifting_in_the_second(tmp_path)
    calibration = calibrate(recordings, GRAVITY)
    data, unit = recorded_by_hand(calibration), calibration.imu.with_effects()
    details, kind = data.along(unit, ()), CATALOGUE["gyro.bias_ramp"]
    grids = {one: [{}] for one in (kind, kind.within(1), kind.within(2))}
    whole, first, second = (data.dormant_columns(unit, details, grids)[one][0] for one in grids)
    np.testing.assert_allclose(first + second, whole, rtol=1e-12, atol=1e-12 * np.abs(whole).max())
    count = len(data.segmentations[0].intervals)
    touches = {1: data.rows(unit).first < count, 2: data.rows(unit).last >= count}
    assert not first[~touches[1]].any() and not second[~touches[2]].any()
    assert first[touches[1]].any() and second[touches[2]].any()
    ramp = kind.within(2).make([1e-5, -2e-5, 3e-5])
    affected = data.along(unit.with_effects(ramp), (ramp,)).observations.poses
    taken = np.asarray(data.observations.poses.gyroscope_mean - affected.gyroscope_mean)
    middle = np.asarray(affected.start + affected.stop)[:, None] / 2
    expected = np.where(np.arange(len(taken))[:, None] < count, 0.0, ramp.coefficients * middle)
    real = np.asarray(affected.mask)
    np.testing.assert_allclose(taken[real], expected[real], atol=2e-7)  # a sample is stamped in the middle of it


def test_findings_in_several_recordings_say_in_which(tmp_path):
    case = hidden.draw_case(1306, (), poses=20)
    first, second, third = sessions(case, tmp_path)
    values = second.accelerometer.values.copy()
    values[500:530] = 0.0
    second = replace(second, accelerometer=replace(second.accelerometer, values=values))
    found = calibrate([first, second, third], GRAVITY)
    (zeros,) = [note for note in found.notes if "zero" in note]
    assert zeros.startswith("In 1.parquet: ")


def test_the_covariance_of_a_calibration_knows_power_ons(tmp_path):
    case = hidden.draw_case(7056, (), poses=20)
    found = calibrate(sessions(case, tmp_path), GRAVITY)
    assert [note for note in found.notes if "power is switched on" in note]
    (gain, _), triad = found.sigma("accelerometer"), found.imu.accelerometer
    free = np.tril_indices(3)
    assert np.all(np.abs(np.asarray(triad.gain) - case.truth.accel_gain)[free] < 4 * gain[free])


def test_sessions_together_show_what_one_does_not(tmp_path):
    case = hidden.draw_case(1307, ("gyro.g_sensitivity",), poses=20).with_size(0.4)
    recordings = sessions(case, tmp_path)
    assert diagnose(recordings[0], GRAVITY).verdict == "adequate"
    found = diagnose(recordings, GRAVITY)
    assert (found.verdict, [each.name for each in found.effects]) == ("effects", ["gyro.g_sensitivity"])


def test_a_held_out_recording_of_another_power_on_has_biases_of_its_own(tmp_path):
    case = hidden.draw_case(1308, ("gyro.g_sensitivity",), poses=20).with_size(2.0)
    first, other, _ = sessions(case, tmp_path)
    found = diagnose(first, GRAVITY, heldout=other)
    assert [each.name for each in found.effects] == ["gyro.g_sensitivity"]
    assert found.gain is not None and found.gain.data == "another recording"
    assert found.gain.after.chi_squared < 1.4 * found.gain.after.count < found.gain.before.chi_squared


def test_xsens_is_explained_once_poses_that_move_count_for_less(data_folder):
    """The poses' own tilt tells how much their rates at rest are off: the size estimated for it is one."""
    folder = data_folder / "imu_tk_xsens"
    recording = read_recording(folder / "xsens_acc.mat", folder / "xsens_gyro.mat", XSENS)
    found = diagnose(recording, XSENS.gravity)
    assert found.verdict == "effects"
    assert [each.name for each in found.effects] == ["gyro.g_sensitivity"]
    assert found.gain is not None
    assert found.gain.before.chi_squared / found.gain.before.count > 10
    assert found.gain.after.chi_squared / found.gain.after.count < 1.1
    (moving,) = [each for each in found.preflight if each.name == "data.moving_pose"]
    assert moving.rows and "poses are not still" in moving.text
    assert found.experiment.drift is not None
    assert 0.6 < found.experiment.drift.sizes["poses that move"][0] < 1.6


# all of them: benchmarks/results/real_diagnosis.md
@pytest.mark.parametrize("unit", [0, pytest.param(1, marks=pytest.mark.slow), pytest.param(2, marks=pytest.mark.slow)])
def test_hand_held_mems_units_are_adequate(unit, data_folder):
    options = ReadOptions(columns="accel [m/s^2],gyro [rad/s]", rate=100)
    recording = read_recording(data_folder / "mikoff_mpu9150" / f"imu{unit}.log", options=options)
    found = diagnose(recording, LocalGravity(9.80665, 0.0))
    assert found.verdict == "adequate"
    assert found.experiment.drift is not None
    assert 0.4 < found.experiment.drift.sizes["poses that move"][0] < 2.0


@pytest.mark.slow  # benchmarks/results/real_diagnosis.md has all units and sessions; test_everyday has it simulated
def test_turns_that_are_too_quick_for_the_rate_are_said(data_folder):
    """An array of units turned by hand in less than a second at 62.5 Hz: all eight miss the same part of each turn."""
    options = ReadOptions(accel_scale="2048 count/g", gyro_scale="16.4 count/(deg/s)")
    recording = read_recording(data_folder / "mimu4444" / "unit1_session2.parquet", options=options)
    found = diagnose(recording, LocalGravity(9.8184, 0.0005))
    (sampling,) = [each for each in found.preflight if each.name == "data.sampling"]
    assert "62.5 Hz" in sampling.text
    assert found.experiment.drift is not None
    assert 0.2 < found.experiment.drift.sizes["turns undersampled"][0] < 0.8


def test_biases_of_a_calibration_lie_in_their_intervals(tmp_path):
    """White noise alone would state the gyroscope's biases six times too sure."""
    errors = []
    for seed, flicker in ((1310, 1.0), (1311, 1.0), (1312, 3.6), (1313, 3.6)):
        case = hidden.draw_case(seed, (), flicker=flicker)
        found = calibrate(read_recording(case.write(tmp_path, ("fit",))["fit"]), GRAVITY)
        assert any("bias drift" in note for note in found.notes)
        for triad, truth in (("accelerometer", case.truth.accel_bias), ("gyroscope", case.truth.gyro_bias)):
            errors.append((np.asarray(found.triads()[triad].bias) - truth) / found.sigma(triad)[1])
    assert 0.6 < np.sqrt(np.mean(np.square(errors))) < 1.5  # 24 standard normal numbers: 0.6 to 1.4 in 999 of 1000
    plain = calibrate(read_recording(case.write(tmp_path, ("fit",))["fit"]), GRAVITY, method="two-step")
    assert any("leave out slow drift" in note for note in plain.notes)
    assert np.all(plain.sigma("gyroscope")[1] < found.sigma("gyroscope")[1] / 3)


def test_sizes_are_where_the_restricted_likelihood_is_greatest():
    random = np.random.default_rng(5)
    place = np.arange(90.0)
    apart = np.abs(place[:, None] - place)
    components = np.stack([np.exp(-apart / 20), np.minimum(place[:, None], place) / 90, np.diag(place % 3 == 0)])
    bare, jacobian = 0.5 * np.eye(90), random.standard_normal((90, 8))
    mean, spread = np.log([0.3, 1.0, 0.3]), np.array([2.0, 2.0, 4.0])
    residual = np.linalg.cholesky(bare + np.tensordot([2.0, 0.5, 1.0], components, 1)) @ random.standard_normal(90)
    across = np.linalg.svd(jacobian)[0][:, 8:].T  # of what the fit leaves: the likelihood of the contrasts

    def cost(log_size):
        total = across @ (bare + np.tensordot(np.exp(log_size), components, 1)) @ across.T
        left = across @ residual
        fit = np.linalg.slogdet(total)[1] + left @ np.linalg.solve(total, left)
        return fit / 2 + np.sum(np.square((log_size - mean) / spread)) / 2

    found, uncertainty = restricted_likelihood(residual, jacobian, bare, components, mean, spread)
    best = minimize(cost, mean, method="Nelder-Mead", options={"xatol": 1e-5, "fatol": 1e-9, "maxiter": 4000}).x
    np.testing.assert_allclose(found, best, atol=0.02 * np.sqrt(np.diag(uncertainty)).min())


def _disturbed(recording: Recording, triad: str, added) -> Recording:
    """Return a recording to whose sensor (n, 3) SI were added."""
    signal = getattr(recording, triad)
    return replace(recording, **{triad: replace(signal, values=signal.values + added * signal.nominal_scale)})


def test_a_warm_up_that_would_pass_for_drift_is_named(tmp_path):
    """Before its cause is known it makes drift look so large that a recording hardly shows any warm-up."""
    case = hidden.draw_case(13, (), poses=30, pose_duration=5.0)
    recording = read_recording(case.write(tmp_path, ("fit",))["fit"])
    elapsed = recording.gyroscope.time - recording.gyroscope.time[0]
    warming = -np.exp(-elapsed / 40)[:, None] * 0.01 * np.array([1.0, -0.67, 0.33])
    found = diagnose(_disturbed(recording, "gyroscope", warming), GRAVITY)
    (cause,) = found.named
    assert (
        cause.name == "gyro.warm_up" and abs(cause.effect.time_constant - 40) < 4 * cause.inner_sigma["time_constant"]
    )


def test_an_accelerometer_that_jumps_is_no_drift(tmp_path):
    """Jumps scatter poses as no sensor's drift does, and make no cycle either."""
    case = hidden.draw_case(1306, (), poses=30)
    recording = read_recording(case.write(tmp_path, ("fit",))["fit"])
    random, time = np.random.default_rng(30), recording.accelerometer.time
    part = ((time - time[0]) // 13.0).astype(int)
    size = 0.2 * random.choice(np.linspace(-0.5, 0.5, 30), part[-1] + 1)
    found = diagnose(_disturbed(recording, "accelerometer", size[part][:, None] * [1.0, 0.0, 0.0]), GRAVITY)
    assert found.verdict == "unexplained" and found.p_value < 0.05
    assert not found.effects and found.shape is None
    assert any("another cause is likelier" in note for note in found.notes)


def test_the_bias_of_each_session_drifts_along_its_own_curve(tmp_path):
    case = hidden.draw_case(12, (), poses=24)
    files = case.write(tmp_path, ("fit", "heldout"))
    sessions = []
    for path, centre, size in zip(files.values(), (0.55, 0.35), ([0, 2e-3, -1e-3], [1.5e-3, 0, 1.5e-3]), strict=True):
        recording = read_recording(path)
        share = np.linspace(0.0, 1.0, len(recording.gyroscope))
        hump = np.exp(-(((share - centre) / 0.15) ** 2))[:, None] * size
        sessions.append(_disturbed(recording, "gyroscope", hump))
    found = diagnose(sessions, GRAVITY)
    assert found.verdict == "effects"
    assert {curve.effect.name for curve in found.drifts} == {"gyro.learned_time@1", "gyro.learned_time@2"}
    assert {cause.name for cause in found.effects} == {curve.effect.name for curve in found.drifts}
    assert found.gain.smaller(found.extended.effects) and found.gain.log_likelihood > 20
    kept = found.extended_calibration()
    for triad, truth in (("accelerometer", case.truth.accel_gain), ("gyroscope", case.truth.gyro_gain)):
        gain, sigma = np.asarray(kept.triads()[triad].gain), kept.sigma(triad)[0]
        assert np.all(np.abs(gain - truth) <= 4 * sigma)
