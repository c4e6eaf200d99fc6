"""Against a measured attitude: truth of an outside simulator, clocks, conventions, what is refused, the command."""

import json
from dataclasses import replace
from functools import lru_cache

import attitude_motion
import jax
import numpy as np
import pytest
from scipy.spatial.transform import Rotation, Slerp

from jaximu import InputError, LocalGravity, NotPossibleError, Recording
from jaximu.calibration import calibrate_against_attitude, load_calibration
from jaximu.calibration.attitude import fitted_mounting
from jaximu.cli.app import main
from jaximu.estimation.fitting import effect_numbers
from jaximu.model.effects import CATALOGUE
from jaximu.recordings import write_recording
from jaximu.recordings.attitude import Attitude
from jaximu.recordings.readers import holds_attitude, read_attitude, read_reference
from jaximu.recordings.recording import Signal
from jaximu.report.attitude import mounting_words

GRAVITY = LocalGravity(attitude_motion.GRAVITY, 0.0)
LOW = np.tril_indices(3)


@lru_cache(maxsize=8)
def moved(seed=1, **changes):
    """Twenty seconds at a slow tracker's five poses a second: the dense covariance of a quick one takes seconds."""
    return attitude_motion.move(seed, **{"duration": 20.0, "tracked": 5.0} | changes)


def unit_of(made) -> Recording:
    return Recording(Signal(made.time, made.force, "m/s^2"), Signal(made.time, made.rate, "rad/s"))


def reference_of(made, **changes) -> Attitude:
    given = {"quaternion": made.quaternion, "velocity": made.velocity, "start": float(made.stamp[0])} | changes
    return Attitude(made.stamp - made.stamp[0], **given)


def scores(calibration, truth) -> np.ndarray:
    """Every number's error over its standard deviation."""
    found = []
    for triad, gain, bias in (("accelerometer", "gain_a", "bias_a"), ("gyroscope", "gain_g", "bias_g")):
        sigma, bias_sigma = calibration.sigma(triad)
        rows = LOW if triad == "accelerometer" else np.indices((3, 3)).reshape(2, -1)
        model = calibration.triads()[triad]
        found += [((model.gain - truth[gain]) / np.where(sigma > 0, sigma, 1.0))[tuple(rows)],
                  (model.bias - truth[bias]) / bias_sigma]  # fmt: skip
    offset = calibration.reference["time_offset"]
    found.append([(offset["value"] - truth["delay"]) / offset["sigma"]])
    return np.concatenate(found)


@pytest.fixture(scope="module")
def found():
    made = moved()
    return calibrate_against_attitude(unit_of(made), reference_of(made), GRAVITY)[0]


def test_truth_lies_within_the_intervals(found):
    z = scores(found, moved().truth)
    assert np.max(np.abs(z)) < 4.5 and 0.4 < np.sqrt(np.mean(z**2)) < 1.6
    quaternion = moved().truth["mounting"].inv().as_quat(canonical=True, scalar_first=True)
    np.testing.assert_allclose(found.reference["rotation"], quaternion, atol=2e-3)
    assert found.sigma("gyroscope")[0].max() < 1e-3 and not found.reference["open"]
    before, after, unit = found.rms["rotation"]
    assert after < 0.4 * before and unit == "deg/s"


def test_stamps_of_an_epoch_are_counted_from_the_first(found):
    """The rate between the clocks, 1e-5 uncertain, moved the offset at the epoch's zero by hours."""
    made, epoch = moved(), 1.7e9
    later = {name: replace(one, time=one.time + epoch) for name, one in unit_of(made).signals.items()}
    recording = replace(unit_of(made), **later)
    assert recording.start == epoch and np.abs(recording.gyroscope.time - made.time).max() < 1e-6
    attitude = Attitude(made.stamp + epoch, made.quaternion, made.velocity)
    absolute = calibrate_against_attitude(recording, attitude, GRAVITY)[0].reference["time_offset"]
    known = found.reference["time_offset"]
    assert abs(absolute["value"] - known["value"]) < 0.1 * known["sigma"]
    assert absolute["sigma"] == pytest.approx(known["sigma"], rel=0.05)


def test_an_inner_parameter_that_effects_share_is_one_number():
    """A lag and its square: their time constant's column is the sum of both, whichever comes first."""
    made = moved()
    time = unit_of(made).gyroscope.time
    warm = replace(unit_of(made), temperature=Signal(time, 25.0 + 5.0 * np.sin(time / 5.0)[:, None], "degC"))
    found, against = calibrate_against_attitude(warm, reference_of(made), GRAVITY)
    lags = [CATALOGUE[name].make(1e-3, time_constant=5.0) for name in ("gyro.thermal_lag", "gyro.thermal_lag_squared")]

    def columns(*effects):
        imu = found.imu.with_effects(*found.imu.all_effects().values(), *effects)
        lifted = jax.tree.map(lambda leaf: np.asarray(leaf, float)[None], imu)
        names, whole = effect_numbers(imu)[0], against.about(lifted).columns[0]
        assert whole.shape[1] == len(names)
        return {(name.part, name.axes): whole[:, k] for k, name in enumerate(names) if name.part == "time_constant"}

    (alone,), (square,) = (list(columns(lag).values()) for lag in lags)
    for order in (lags, lags[::-1]):
        (together,) = columns(*order).values()
        np.testing.assert_allclose(together, alone + square, atol=0.02 * np.abs(alone).max())


def test_a_unit_beside_the_tracked_point():
    """Its lever arm is found from the reference's velocities unasked, and the rest is as good as without."""
    arm = np.array([0.12, -0.05, 0.08])
    made = moved(arm=tuple(arm))
    found, _ = calibrate_against_attitude(unit_of(made), reference_of(made), GRAVITY)
    value, sigma = (np.array(found.reference["lever_arm"][key]) for key in ("value", "sigma"))
    assert np.abs((value - arm) / sigma).max() < 4 and sigma.max() < 5e-3
    assert np.abs(scores(found, made.truth)).max() < 4.5
    stated, _ = calibrate_against_attitude(unit_of(made), reference_of(made), GRAVITY, effects=["accel.lever_arm"])
    np.testing.assert_allclose(stated.reference["lever_arm"]["value"], value, atol=1e-6)


@pytest.mark.parametrize(("lag", "stages"), [(0.05, 1), (0.02, 3)])
def test_a_reference_with_a_filter(lag, stages):
    """Without its filter's width among the unknowns scales are 0.3 to 0.6 % off behind 50 ms, up to 8 deviations."""
    made = moved(lag=lag, stages=stages)
    found, measurement = calibrate_against_attitude(unit_of(made), reference_of(made), GRAVITY)
    assert np.abs(scores(found, made.truth)).max() < 4.5
    clear = moved(tracked=500.0, attitude_noise=0.0)  # the same motion, not smoothed
    at = made.stamp[10:] - (made.truth["delay"] - clear.truth["delay"])
    true = Slerp(clear.stamp, reference_of(clear).rotation())(at)
    smooth, sharp = (
        np.sqrt(np.mean((true.inv() * each.rotation()[10:]).magnitude() ** 2))
        for each in (measurement.attitude, measurement.unsmoothed(found.imu))
    )
    assert sharp < 1.2 * np.sqrt(3) * 3e-4 and sharp < smooth / 2  # its noise
    wide, sigma = found.reference["filter"]["variance"], found.reference["filter"]["sigma"]
    assert wide == pytest.approx(made.truth["variance"], rel=0.05) and sigma < 0.05 * wide
    assert "smoothed as by a first-order lag" in " ".join(mounting_words(found))
    # what a straight line between samples of the gyroscope does is no filter of it
    interval = 1 / found.data["gyroscope_rate"]
    for share, words in ((-1 / 6, "No filter of the reference shows"), (-1.0, "The gyroscope is smoothed as by")):
        seen_so = found.reference | {"filter": {"variance": share * interval**2, "sigma": 1e-3 * interval**2}}
        assert words in " ".join(mounting_words(replace(found, reference=seen_so)))


@pytest.mark.parametrize("delay", [-0.2, 0.005, 1.7])
def test_clocks_that_differ(delay):
    made = moved(delay=delay)
    z = scores(calibrate_against_attitude(unit_of(made), reference_of(made), GRAVITY)[0], made.truth)
    assert np.max(np.abs(z)) < 4.5


def test_absolute_stamps_and_a_log_that_counts_from_zero():
    """Both are taken to begin together."""
    made = moved()
    found, _ = calibrate_against_attitude(unit_of(made), reference_of(made, start=1.7e9), GRAVITY)
    delay = made.truth["delay"] - made.stamp[0]
    assert found.reference["time_offset"]["value"] == pytest.approx(delay, abs=1e-3)


@pytest.mark.parametrize("drift", [2e-4, -1e-3])
def test_a_clock_that_runs_fast(drift):
    """Twenty seconds show it; taken for none, it would be noise of the attitude and part of the gyroscope's scale."""
    made = moved(drift=drift)
    found, _ = calibrate_against_attitude(unit_of(made), reference_of(made), GRAVITY)
    sigma = fitted_mounting(found.imu, found.names, found.covariance)[1].clock_scale[0, 0] ** 0.5
    assert abs(found.reference["clock_scale"] - 1 - drift) < 4 * sigma < 4e-5
    assert np.max(np.abs(scores(found, made.truth))) < 4.5
    assert f"ppm {'fast' if drift > 0 else 'slow'} against the reference's" in " ".join(mounting_words(found))


@pytest.mark.parametrize(("name", "change", "said"), [
    ("inverse", lambda q: q * [1, -1, -1, -1], "from the upright frame to the body"),
    ("w last", lambda q: q[:, [1, 2, 3, 0]], "w last"),
    ("both", lambda q: (q * [1, -1, -1, -1])[:, [1, 2, 3, 0]], "w last and run"),
    ("z down", lambda q: np.stack([-q[:, 1], q[:, 0], -q[:, 3], q[:, 2]], axis=1), "z points down"),
])  # fmt: skip
def test_conventions_are_told_by_the_data(name, change, said, found):
    made = moved()
    flip = np.array([1, -1, -1]) if name == "z down" else 1
    given = reference_of(made, quaternion=change(made.quaternion), velocity=made.velocity * flip)
    other, _ = calibrate_against_attitude(unit_of(made), given, GRAVITY)
    assert any(said in note for note in other.notes)
    np.testing.assert_allclose(other.triads()["gyroscope"].gain, found.triads()["gyroscope"].gain, atol=1e-6)


def test_positions_and_attitude_alone_tell_less(found):
    made = moved()
    by_position, _ = calibrate_against_attitude(
        unit_of(made), reference_of(made, velocity=None, position=made.position), GRAVITY
    )
    alone, _ = calibrate_against_attitude(unit_of(made), reference_of(made, velocity=None), GRAVITY)
    for each in (by_position, alone):
        assert np.max(np.abs(scores(each, made.truth))) < 4.5
    sigmas = [each.sigma("accelerometer")[0].max() for each in (found, by_position, alone)]
    assert sigmas[0] < sigmas[1] < sigmas[2]


def test_an_effect_is_fitted_beside():
    made = moved(seed=2, g_sensitivity=2e-4)
    plain, _ = calibrate_against_attitude(unit_of(made), reference_of(made), GRAVITY)
    found, _ = calibrate_against_attitude(unit_of(made), reference_of(made), GRAVITY, effects=["gyro.g_sensitivity"])
    assert found.rms["rotation"][1] < plain.rms["rotation"][1]
    (effect,) = found.imu.gyroscope.effects
    sigma = np.array([s for name, s in zip(found.names, np.sqrt(np.diag(found.covariance)), strict=True)
                      if name.owner == "gyroscope" and name.effect == 0])  # fmt: skip
    off = np.asarray(effect.coefficients) - made.truth["g_sensitivity"].ravel()
    assert np.max(np.abs(off / sigma)) < 4.5
    assert np.max(np.abs(scores(found, made.truth))) < 4.5


def test_gaps_and_jumps_of_the_reference_are_left_out():
    made = moved()
    kept = np.ones(len(made.stamp), bool)
    kept[20:28] = False
    quaternion = made.quaternion.copy()
    turned = Rotation.from_rotvec([0.0, 0.0, 3.0])
    later = turned * Rotation.from_quat(quaternion[60:], scalar_first=True)
    quaternion[60:] = later.as_quat(scalar_first=True)
    attitude = Attitude((made.stamp - made.stamp[0])[kept], quaternion[kept], start=float(made.stamp[0]))
    found, measurement = calibrate_against_attitude(unit_of(made), attitude, GRAVITY)
    assert np.max(np.abs(scores(found, made.truth))) < 4.5
    assert measurement.intervals.used.sum() < 0.95 * len(measurement.intervals.used)


# --- bad input


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_a_left_handed_frame_is_told_by_its_velocities(axis, found):
    """Its attitudes are right-handed, or there were none; one axis of velocity or position runs the other way."""
    made, flip = moved(), np.where(np.arange(3) == axis, -1.0, 1.0)
    other, _ = calibrate_against_attitude(
        unit_of(made), reference_of(made, velocity=made.velocity * flip), GRAVITY
    )  # fmt: skip
    assert any("left-handed" in note and f"along {'xyz'[axis]}," in note for note in other.notes)
    np.testing.assert_allclose(other.imu.accelerometer.gain, found.imu.accelerometer.gain, atol=1e-7)
    assert not any("left-handed" in note for note in found.notes)


def test_a_reference_made_of_the_unit_itself_is_warned_of():
    """A complementary filter of the unit's own samples; an independent tracker, exact ones included, is not."""
    made = moved(tracked=50.0)
    body = Rotation.from_quat(made.quaternion[0], scalar_first=True) * made.truth["mounting"]
    inside, said = made.time > made.stamp[0] - made.truth["delay"], []
    for rate, force in zip(made.rate[inside] - 0.9 * made.truth["bias_g"], made.force[inside], strict=True):
        pull = 0.05 * np.cross(force / np.linalg.norm(force), body.inv().apply([0.0, 0.0, 1.0]))
        body = body * Rotation.from_rotvec((rate + pull) * 0.01)
        said.append(body.as_quat(scalar_first=True))
    stamps = made.time[inside] + 0.005
    own = Attitude(stamps - stamps[0], np.array(said), start=float(stamps[0]))
    found, _ = calibrate_against_attitude(unit_of(made), own, GRAVITY)
    assert any("computed from this very unit" in note for note in found.notes)
    for noise in (3e-4, 1e-7):
        other = moved(tracked=50.0, attitude_noise=noise)
        found, _ = calibrate_against_attitude(unit_of(other), reference_of(other), GRAVITY)
        assert not any("this very unit" in note for note in found.notes)


def test_what_cannot_be_told_is_refused():
    made = moved(duration=40.0, tracked=50.0)
    recording, attitude = unit_of(made), reference_of(made)
    with pytest.raises(InputError, match="do not overlap"):
        calibrate_against_attitude(recording, reference_of(made, start=500.0), GRAVITY)
    still = np.tile([1.0, 0.0, 0.0, 0.0], (len(made.stamp), 1))
    with pytest.raises(NotPossibleError, match="hardly turns"):
        calibrate_against_attitude(recording, reference_of(made, quaternion=still), GRAVITY)
    with pytest.raises(NotPossibleError, match="do not turn alike"):
        calibrate_against_attitude(unit_of(moved(seed=5, duration=40.0, tracked=50.0)), attitude, GRAVITY)
    with pytest.raises(InputError, match=r"length .* not a quaternion"):
        reference_of(made, quaternion=2 * made.quaternion)
    with pytest.raises(InputError, match="there is none"):
        calibrate_against_attitude(replace(recording, gyroscope=None), attitude, GRAVITY)
    with pytest.raises(InputError, match="do not rise"):
        Attitude(np.array([0.0, 1.0, 1.0]), np.tile([1.0, 0, 0, 0], (3, 1)))


@pytest.mark.parametrize(
    ("order", "signs", "option"),
    [
        ([0, 1, 2], [1, 1, -1], "gyro=x,y,-z"),
        ([0, 1, 2], [-1, -1, -1], "gyro=-x,-y,-z"),
        ([1, 0, 2], [1, 1, 1], "gyro=y,x,z"),
    ],
)
def test_axes_and_signs_of_the_gyroscope_are_told(order, signs, option):
    """No convention need be stated that the recording shows; the calibration has it, and says so."""
    made = moved(duration=20.0, tracked=50.0)
    plain, _ = calibrate_against_attitude(unit_of(made), reference_of(made), GRAVITY)
    counts = 100.0 + 900.0 * made.rate[:, order] * signs
    gyroscope = Signal(made.time, counts, "count", np.full(3, 900.0), np.full(3, 100.0))
    found, _ = calibrate_against_attitude(replace(unit_of(made), gyroscope=gyroscope), reference_of(made), GRAVITY)
    assert f'--axes "{option}"' in found.notes[0]
    wanted = np.asarray(plain.imu.gyroscope.gain)[order] * np.array(signs)[:, None]
    np.testing.assert_allclose(np.asarray(found.imu.gyroscope.gain) / 900.0, wanted, atol=2e-4)
    assert not any("--axes" in note for note in plain.notes)


# --- files and the command


def written(path, header, columns):
    with open(path, "w", encoding="utf-8") as file:
        if header:
            file.write(f"{header}\n")
        np.savetxt(file, np.column_stack(columns), delimiter="," if "," in header else " ", fmt="%.9f")
    return path


def test_files_of_references(tmp_path):
    made = moved()
    time, q, p = made.stamp, made.quaternion, made.position
    plain = written(tmp_path / "a.csv", "time [s],qw,qx,qy,qz,vx [m/s],vy [m/s],vz [m/s]", [time, q, made.velocity])
    tum = written(tmp_path / "b.txt", "", [time, p, q[:, [1, 2, 3, 0]]])
    commented = written(tmp_path / "c.txt", "# timestamp(s) tx ty tz qx qy qz qw", [time, p, q[:, [1, 2, 3, 0]]])
    asl = written(
        tmp_path / "d.csv",
        "#timestamp [ns],p_RS_R_x [m],p_RS_R_y [m],p_RS_R_z [m],q_RS_w [],q_RS_x [],q_RS_y [],q_RS_z []",
        [np.round(time * 1e9), p, q],
    )
    rotation = Rotation.from_quat(q, scalar_first=True)
    euler = written(
        tmp_path / "e.csv", "time [ms],roll [deg],pitch [deg],yaw [deg]",
        [1e3 * time, np.degrees(rotation.as_euler("ZYX")[:, ::-1])],
    )  # fmt: skip
    vectors = written(tmp_path / "f.csv", "timestamp_us,rotvec_x,rotvec_y,rotvec_z", [1e6 * time, rotation.as_rotvec()])
    angles = np.degrees(rotation.as_euler("XYZ"))
    gimbals = written(
        tmp_path / "k.csv", "time [s],table_angle_x [deg],table_angle_y [deg],table_angle_z [deg]", [time, angles]
    )
    for path in (plain, tum, commented, asl, euler, vectors, gimbals):
        found = read_attitude(path)
        np.testing.assert_allclose(found.start + found.time, time, atol=2e-6, err_msg=path.name)
        same = np.abs(np.sum(found.quaternion * q, axis=1))
        np.testing.assert_allclose(same, 1.0, atol=1e-7, err_msg=path.name)
    np.testing.assert_allclose(read_attitude(plain).velocity, made.velocity, atol=1e-8)
    for path in (tum, commented, asl):
        np.testing.assert_allclose(read_attitude(path).position, p, atol=1e-8, err_msg=path.name)
    bare = written(tmp_path / "g.csv", "time [s],roll,pitch,yaw", [time, rotation.as_euler("ZYX")[:, ::-1]])
    with pytest.raises(InputError, match=r"states no unit.*yaw \[deg\]"):
        read_attitude(bare)
    with pytest.raises(InputError, match="holds no attitude"):
        read_attitude(written(tmp_path / "h.csv", "time [s],a,b,c", [time, p]))
    with pytest.raises(InputError, match="no time column"):
        read_attitude(written(tmp_path / "i.csv", "qw,qx,qy,qz", [q]))


@pytest.mark.parametrize(
    ("title", "factor"),
    [("timestamp_ms", 1e3), ("time_us", 1e6), ("t_ns", 1e9), ("timestampNs", 1e9), ("millis", 1e3),
     ("mocap_time_ms", 1e3), ("tow_s", 1.0), ("ros_time", 1.0)],
)  # fmt: skip
def test_stamps_of_references_are_in_the_unit_that_their_name_says(title, factor, tmp_path):
    made = moved()
    path = written(tmp_path / "a.csv", f"{title},qw,qx,qy,qz", [np.round(made.stamp * factor, 3), made.quaternion])
    found = read_attitude(path)
    np.testing.assert_allclose(found.start + found.time, made.stamp, atol=1e-3)
    assert any("state no unit" in note for note in found.notes) == (title == "ros_time")


def test_seconds_and_nanoseconds_of_references_are_one_time(tmp_path):
    made = moved()
    whole, rest = np.divmod(np.round(made.stamp * 1e9), 1e9)
    path = tmp_path / "a.csv"
    rows = [f"{s:.0f},{n:.0f}," + ",".join(map(str, q)) for s, n, q in zip(whole, rest, made.quaternion, strict=True)]
    path.write_text("\n".join(["sec,nanosec,attitude_w,attitude_x,attitude_y,attitude_z", *rows]), encoding="utf-8")
    attitude, columns = read_attitude(path), read_reference(path, unit_of(made)).attitude
    np.testing.assert_allclose(attitude.start + attitude.time, made.stamp, atol=1e-6)
    np.testing.assert_allclose(columns.time, made.stamp, atol=1e-6)


def test_angles_of_a_table_of_two_axes_are_an_attitude_and_that_of_one_is_not(tmp_path):
    time, outer, inner = np.arange(20.0), np.linspace(0.0, 2.0, 20), np.linspace(1.0, -1.0, 20)
    path = written(tmp_path / "table.csv", "time [s],table_angle_z [rad],table_angle_x [rad]", [time, outer, inner])
    found, x, z = read_attitude(path).rotation(), np.array([1.0, 0.0, 0.0]), np.array([0.0, 0.0, 1.0])
    wanted = [Rotation.from_rotvec(a * z) * Rotation.from_rotvec(b * x) for a, b in zip(outer, inner, strict=True)]
    np.testing.assert_allclose((found.inv() * Rotation.concatenate(wanted)).magnitude(), 0.0, atol=1e-8)
    assert "about z, then x, outermost first" in read_attitude(path).notes[-1]
    for title in ("table_angle [rad]", "table_angle_z [rad]"):
        assert not holds_attitude(written(tmp_path / "one.csv", f"time [s],{title}", [time, outer]))


def test_command(tmp_path, capsys):
    made = moved()
    log = tmp_path / "log.parquet"
    write_recording(unit_of(made), log)
    reference = written(
        tmp_path / "tracker.csv", "time [s],qw,qx,qy,qz,vx [m/s],vy [m/s],vz [m/s]",
        [made.stamp, made.quaternion, made.velocity],
    )  # fmt: skip
    line = ["reference", str(log), "--reference", str(reference), "--gravity", f"{attitude_motion.GRAVITY}"]
    assert main([*line, "--json", "-o", str(tmp_path / "out")]) == 0
    document = json.loads(capsys.readouterr().out)
    assert document["reference"]["time_offset"]["value"] == pytest.approx(0.03, abs=1e-3)
    assert set(document["reference"]) == {
        "rotation", "time_offset", "clock_scale", "filter", "lever_arm", "residual_rms", "open"
    }  # fmt: skip
    assert load_calibration(tmp_path / "out" / "calibration.json").reference == document["reference"]
    assert document["reading"]["units"]["accelerometer"] == "m/s^2"
    page = (tmp_path / "out" / "report.html").read_text(encoding="utf-8")
    assert "30" in page and "late" in page and "nan" not in page.lower().split("base64")[0]
    assert (tmp_path / "out" / "residuals.png").stat().st_size > 10000
    assert main(line) == 0
    said = " ".join(capsys.readouterr().out.split())
    assert "stamps are 30" in said and "Error of the rate against the reference:" in said
    assert main(["reference", str(log), "--reference", str(tmp_path / "none.csv")]) == 2
    assert main(["reference", str(log)]) == 2
    assert "holds no attitude" in capsys.readouterr().err


def test_a_measured_unit_against_fibre_optics(data_folder, capsys):
    folder = data_folder / "psins"
    line = ["reference", str(folder / "mems.parquet"), "--reference", str(folder / "fibre_optic_ins.parquet"), "--json"]
    assert main(line) == 0
    rms = json.loads(capsys.readouterr().out)["reference"]["residual_rms"]["rotation"]
    assert rms["value"] < 0.040 and rms["unit"] == "deg/s"  # what a plain least-squares fit with the best offset leaves
