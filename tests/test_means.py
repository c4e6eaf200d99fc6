"""Tables with a row of mean outputs a pose, as papers print them."""

import equinox as eqx
import hidden_effects as hidden
import numpy as np
import pytest
import synthetic

from jaximu import Imu, InputError, LocalGravity, NotPossibleError, calibrate, load_calibration
from jaximu.calibration import calibrate_means
from jaximu.cli.app import main
from jaximu.recordings.readers import ReadOptions, read_means
from jaximu.recordings.recording import PoseMeans, Recording, Signal

GRAVITY = LocalGravity(hidden.GRAVITY, 0.0)
NOISE = 2e-3  # m/s², of a mean
HEADER = ("accel_x [g]", "accel_y [g]", "accel_z [g]", "gyro_x [deg/s]", "gyro_y [deg/s]", "gyro_z [deg/s]")
SPREAD = ("accel_sigma_x [g]", "accel_sigma_y [g]", "accel_sigma_z [g]", "samples")


def drawn(seed, poses=20, stated=False):
    """A header, rows, and the true gain and biases."""
    random = np.random.default_rng(seed)
    force = hidden.GRAVITY * hidden.spread_attitudes(random, poses)[:, 2]
    gain = np.tril(np.eye(3) + 0.02 * random.standard_normal((3, 3)))
    bias, rest = 0.2 * random.standard_normal(3), 0.01 * random.standard_normal(3)
    sigma = NOISE * random.uniform(0.3, 3.0, (poses, 1)) if stated else np.full((poses, 1), NOISE)
    accel = force @ gain.T + bias + sigma * random.standard_normal((poses, 3))
    gyro = rest + 1e-4 * random.standard_normal((poses, 3))
    rows = np.column_stack([accel / 9.80665, np.degrees(gyro)])
    if not stated:
        return HEADER, rows, gain, bias, rest
    counts = random.integers(100, 400, (poses, 1))
    return (
        (*HEADER, *SPREAD),
        np.hstack([rows, np.sqrt(counts) * sigma / 9.80665 * np.ones(3), counts]),
        gain,
        bias,
        rest,
    )


def written(path, header, rows, digits=6):
    np.savetxt(path, rows, f"%.{digits}f", ",", header=",".join(header), comments="")
    return path


@pytest.mark.parametrize("stated", [False, True])
def test_intervals_hold_the_truth(tmp_path, stated):
    lower, inside, rests = np.tril_indices(3), [], []
    for seed in range(12):
        header, rows, gain, bias, rest = drawn(seed, stated=stated)
        found = calibrate_means(read_means(written(tmp_path / "means.csv", header, rows)), GRAVITY)
        gain_sigma, bias_sigma = found.sigma("accelerometer")
        error = np.append((found.imu.accelerometer.gain - gain)[lower], found.imu.accelerometer.bias - bias)
        sigma = np.append(gain_sigma[lower], bias_sigma)
        assert np.median(sigma) < 2 * NOISE
        inside += list(np.abs(error) < 1.96 * sigma)
        rests += list(np.abs(found.imu.gyroscope.bias - rest) < 1.96 * found.sigma("gyroscope")[1])
    assert 0.87 < np.mean(inside) <= 1.0
    assert np.mean(rests) > 0.8
    assert ("accelerometer" in found.excess) == stated
    assert any("not stated" in note and ("of the gyroscope are" in note) == stated for note in found.notes)


def test_stated_deviations_weigh_the_poses(tmp_path):
    errors = []
    for seed in range(12):
        header, rows, gain, *_ = drawn(100 + seed, stated=True)
        errors.append([np.linalg.norm(
            calibrate_means(read_means(written(tmp_path / "m.csv", header[:count], rows[:, :count])), GRAVITY)
            .imu.accelerometer.gain - gain
        ) for count in (6, 10)])  # fmt: skip
    without, given = np.median(errors, axis=0)
    assert given < 0.9 * without


def test_the_command_calibrates_a_table(tmp_path, capsys):
    header, rows, *_ = drawn(1)
    path = written(tmp_path / "means.csv", ("pose", *header[:3]), np.column_stack([np.arange(20), rows[:, :3]]))
    assert main(["calibrate", str(path), "--means", "-o", str(tmp_path / "out")]) == 0
    found = load_calibration(tmp_path / "out" / "calibration.json")
    assert found.imu.gyroscope is None and found.data["poses"] == 20 and "rate" not in found.data
    assert found.reading is not None and set(found.reading.units) == {"accelerometer"} and found.reading.rate is None
    assert "20 poses at rest" in (tmp_path / "out" / "report.html").read_text()
    capsys.readouterr()
    assert main(["info", str(path)]) == 0
    assert "jaximu calibrate --means" in capsys.readouterr().out
    assert main(["calibrate", str(path)]) == 2
    assert "--means" in capsys.readouterr().err


def test_axes_are_mapped_with_their_deviations(tmp_path):
    header, rows, *_ = drawn(3, stated=True)
    path = written(tmp_path / "means.csv", header, rows)
    plain, turned = (read_means(path, ReadOptions(axes=axes)) for axes in (None, "y,-x,z"))
    np.testing.assert_allclose(turned.accelerometer_sigma[:, 0], plain.accelerometer_sigma[:, 1])
    np.testing.assert_allclose(turned.recording.accelerometer.values[:, 1], -plain.recording.accelerometer.values[:, 0])


def test_few_poses_hold_misalignments_and_say_so(tmp_path):
    header, rows, *_ = drawn(2, poses=11)
    found = calibrate_means(read_means(written(tmp_path / "few.csv", header, rows)), GRAVITY)
    assert any("11 poses leave misalignments open" in note for note in found.notes)
    assert not any("leave misalignments open" in note for note in calibrate_means(
        read_means(written(tmp_path / "more.csv", *drawn(2, poses=12)[:2])), GRAVITY).notes)  # fmt: skip


@pytest.mark.parametrize(
    ("column", "change", "said"),
    [
        ("samples", None, "column samples is missing beside accel_sigma_x"),
        ("accel_sigma_y [g]", None, "column accel_sigma_y is missing beside accel_sigma_x"),
        ("samples", 0.0, "row 4: column 'samples' must be greater than zero"),
        ("accel_sigma_z [g]", -1.0, "row 4: column 'accel_sigma_z' must be greater than zero"),
        (
            "accel_sigma_z [g]",
            "accel_sigma_z [deg/s]",
            "'accel_sigma_z' is in deg/s, but the means beside it",
        ),
        ("accel_sigma_z [g]", "accel_sigma_z", "'accel_sigma_z' states no unit"),
        ("accel_sigma_z [g]", "accel_sigma_z [furlong]", "unknown unit 'furlong'"),
        ("accel_y [g]", np.nan, "row 4: column 'accel_y [g]' is empty or NaN"),
        ("accel_z [g]", "accel_z [m/s^2]", "not 9.807 as gravity is"),
        ("accel_x [g]", None, "column accel_x is missing"),
    ],
)
def test_a_damaged_table_is_told_as_such(tmp_path, column, change, said):
    header, rows, *_ = drawn(4, stated=True)
    at = header.index(column)
    header = list(header)
    if change is None:
        header[at] = "other"
    elif isinstance(change, str):
        header[at] = change
        if "m/s^2" in change:
            header = [name.replace("[g]", "[m/s^2]") for name in header]
    else:
        rows[2, at] = change
    with pytest.raises(InputError, match=said.replace("[", r"\[")):
        read_means(written(tmp_path / "means.csv", header, rows))


@pytest.mark.parametrize("options", [("--static", "x.csv"), ("--effect", "accel.cubic"), ("--repair",), ("again.csv",)])
def test_what_needs_samples_is_refused(tmp_path, capsys, options):
    header, rows, *_ = drawn(5)
    path = written(tmp_path / "means.csv", header, rows)
    assert main(["calibrate", str(path), *options, "--means"]) == 2
    assert "--means" in capsys.readouterr().err


def test_six_faces_give_scale_and_bias(tmp_path):
    """What people post: six means in two digits, of units whose misalignments are what sensors have."""
    faces = hidden.GRAVITY * np.vstack([np.eye(3), -np.eye(3)])
    inside = []
    for seed in range(20):
        random = np.random.default_rng(seed)
        gain = np.diag(1 + 0.03 * random.standard_normal(3)) + np.tril(0.008 * random.standard_normal((3, 3)), -1)
        bias = 0.2 * random.standard_normal(3)
        path = written(tmp_path / "six.csv", HEADER[:3], (faces @ gain.T + bias) / 9.80665, 3)
        found = calibrate_means(read_means(path), GRAVITY)
        triad, sigmas = found.imu.accelerometer, np.sqrt(np.diag(found.covariance))
        known = {str(name): sigma for name, sigma in zip(found.names, sigmas, strict=True)}
        for axis in range(3):
            inside.append(
                abs(triad.gain[axis, axis] - gain[axis, axis]) < 2 * known[f"accelerometer.gain[{axis},{axis}]"]
            )
            inside.append(abs(triad.bias[axis] - bias[axis]) < 2 * known[f"accelerometer.bias[{axis}]"])
    assert any("misalignments open" in note for note in found.notes)
    assert np.mean(inside) > 0.9, np.mean(inside)


def test_poses_that_do_not_span_are_refused(tmp_path):
    header, rows, *_ = drawn(2)
    with pytest.raises(NotPossibleError, match="do not span enough orientations"):
        calibrate_means(read_means(written(tmp_path / "means.csv", header, np.repeat(rows[:3], 6, axis=0))), GRAVITY)


def test_five_faces_are_refused(tmp_path):
    rows = np.vstack([np.eye(3), -np.eye(3)])[:5] + 0.01
    with pytest.raises(NotPossibleError, match="add 1 pose"):
        calibrate_means(read_means(written(tmp_path / "five.csv", HEADER[:3], rows, 4)), GRAVITY)


@pytest.mark.parametrize("repeats", [2, 4])
@pytest.mark.parametrize("stated", [False, True])
def test_repeated_faces_do_not_determine_misalignments(repeats, stated):
    """Six faces twice are twelve poses and no new direction: scale and bias are known, misalignments are not."""
    random = np.random.default_rng(repeats)
    gain = np.array([[1.03, 0, 0], [0.004, 0.98, 0], [-0.003, 0.005, 1.01]])
    faces = np.concatenate([np.eye(3), -np.eye(3)] * repeats)
    values = 9.80665 * faces @ gain.T + [0.2, -0.1, 0.3] + 0.002 * random.standard_normal(faces.shape)
    signal = Signal(np.arange(len(faces), dtype=float), values, "m/s^2")
    sigma = np.full(values.shape, 0.002) if stated else None
    calibration = calibrate_means(PoseMeans(Recording(signal), sigma), LocalGravity(9.80665, 0.0))
    triad = calibration.imu.accelerometer
    np.testing.assert_allclose(np.diag(triad.gain), np.diag(gain), atol=4e-4)
    np.testing.assert_allclose(triad.bias, [0.2, -0.1, 0.3], atol=5e-3)
    assert any("leave misalignments open" in note for note in calibration.notes)
    assert any("intervals are from their misfit" in note for note in calibration.notes) is not stated


@pytest.mark.parametrize(("row", "axis"), [(0, "x up"), (4, "y down"), (5, "z down")])
def test_a_face_with_the_wrong_sign_is_named(tmp_path, row, axis):
    """Six faces of which one has another sign are five: the missing one is named, not a fit that does not converge."""
    values = 9.8 * np.concatenate([np.eye(3), -np.eye(3)]) + [0.2, -0.1, 0.3]
    values[row] *= -1
    path = written(tmp_path / "means.csv", [name.replace("[g]", "[m/s^2]") for name in HEADER[:3]], values, 3)
    with pytest.raises(NotPossibleError, match=f"none has {axis}. Check the signs of the rows"):
        calibrate_means(read_means(path), GRAVITY)


def test_six_faces_set_by_hand_hold_misalignments_to_what_sensors_have():
    """Faces within a degree do not tell misalignments: scale and bias are as well known as they are, and it is said."""
    errors = []
    for seed in range(5):
        random = np.random.default_rng(seed)
        faces = random.permutation(np.concatenate([np.eye(3), -np.eye(3)])) + random.normal(0, 0.015, (6, 3))
        gain, bias = np.diag(random.normal(1, 0.02, 3)) + np.tril(random.normal(0, 0.01, (3, 3)), -1), np.ones(3) / 5
        made = eqx.tree_at(lambda imu: (imu.accelerometer.gain, imu.accelerometer.bias), Imu.nominal(), (gain, bias))
        log, _ = synthetic.recording(seed, directions=faces / np.linalg.norm(faces, axis=1, keepdims=True), imu=made)
        found = calibrate(Recording(log.accelerometer), LocalGravity(synthetic.GRAVITY, 0.0))
        sigma, of_bias = found.sigma("accelerometer")
        errors += (np.diagonal(found.imu.accelerometer.gain - gain) / np.diagonal(sigma)).tolist()
        errors += ((np.asarray(found.imu.accelerometer.bias) - bias) / of_bias).tolist()
        assert np.diagonal(sigma).max() < 1.5e-3
        assert any("leave misalignments open" in note for note in found.notes) and not found.weak
    assert 0.4 < np.sqrt(np.mean(np.square(errors))) < 1.6
