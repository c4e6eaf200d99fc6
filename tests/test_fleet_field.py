"""`jaximu fleet` of units with a magnetometer: hard and soft iron of each, by the accelerometer's recipe on rests."""

from dataclasses import replace

import jax
import numpy as np
import pyarrow.parquet as pq
import pytest

from jaximu.calibration import FieldStrength, MagneticLog, calibrate_magnetometer
from jaximu.cli import main
from jaximu.data.poses import PosesAndTurns
from jaximu.estimation.fitting import fit
from jaximu.estimation.problem import without_equipment
from jaximu.fleets import Job, Settings, fit_units, rows_of
from jaximu.fleets.field import field_row, field_unit
from jaximu.model import Noise, White
from jaximu.model.sensor import Triad
from jaximu.recordings import write_recording
from jaximu.recordings.recording import Signal
from jaximu.recordings.segmentation import segment
from jaximu.simulation import consumer_noise, draw_imu, simulate
from jaximu.simulation.protocols import Environment, HandHeld

UNITS, STRENGTH = 12, 50.0


def lower(gain):
    """The same ellipsoid's gain in the frame in which it is lower triangular: K R = L with positive diagonal."""
    return np.linalg.cholesky(gain @ gain.T)


@pytest.fixture(scope="module")
def cases():
    """Recordings of 20 rests, the stamps of the magnetometer its own; and gain and bias (µT) in truth."""
    found = []
    noise = consumer_noise() | {"magnetometer": Noise((White(0.03),), "magnetic_field")}
    for seed in range(UNITS):
        rng = np.random.default_rng(100 + seed)
        gain, bias = np.eye(3) + 0.05 * rng.standard_normal((3, 3)), rng.normal(0, 20.0, 3)
        imu = replace(draw_imu(seed), magnetometer=Triad(gain, bias, quantity="magnetic_field", output_unit="uT"))
        recording, _ = simulate(
            imu, HandHeld(20, 2.0), noise, seed=seed, environment=Environment(field=STRENGTH, dip=60.0)
        )
        signal = recording.magnetometer
        assert signal is not None
        own = Signal(signal.time[::2] + 0.003, signal.values[::2], "uT")
        found.append((replace(recording, magnetometer=own), gain, bias))
    return found


@pytest.fixture(scope="module")
def rows(cases, tmp_path_factory):
    folder = tmp_path_factory.mktemp("fields")
    for number, (recording, _, _) in enumerate(cases):
        write_recording(recording, folder / f"unit{number:02d}.parquet")
    jobs = [Job(path.stem, str(path)) for path in sorted(folder.glob("*.parquet"))]
    return rows_of(jobs, Settings(field=FieldStrength(STRENGTH)))


def test_hard_and_soft_iron_of_every_unit_within_their_uncertainty(cases, rows):
    squares = []
    for row, (_, gain, bias) in zip(rows, cases, strict=True):
        assert row["status"] == "ok" and row["mag_message"] is None and row["mag_unit"] == "uT"
        assert row["mag_field"] == STRENGTH and 0 < row["mag_rms"] < 0.1
        off = np.concatenate([row["mag_gain"] - lower(gain).ravel(), row["mag_bias"] - bias])
        sigma = np.concatenate([row["mag_gain_sigma"], row["mag_bias_sigma"]])
        squares.append((off / np.where(sigma > 0, sigma, 1.0))[sigma > 0] ** 2)
        assert np.all(off[sigma == 0] == 0)
    z2 = np.concatenate(squares)
    assert len(z2) == 9 * UNITS
    assert z2.mean() == pytest.approx(1.0, abs=5 * np.sqrt(2 * 9 / len(z2)))


def test_is_the_core_s_fit_of_the_same_means(cases, rows):
    """The core from the same start, weighted alike: what is left is where each of the two stops."""
    found = segment(cases[4][0])
    own = field_unit(cases[4][0].magnetometer, found, FieldStrength(STRENGTH), "unit")
    ((fitted, rms),) = fit_units([own.unit])
    np.testing.assert_allclose(field_row(own, fitted, rms[0])["mag_bias"], rows[4]["mag_bias"], rtol=0, atol=1e-12)
    seen = PosesAndTurns.of(jax.tree.map(lambda leaf: np.asarray(leaf)[None], own.unit.observations), "norm")
    like = jax.tree.map(lambda leaf: np.asarray(leaf)[None], own.unit.nominal)
    exact = fit(
        like, seen, lambda name: without_equipment(name) and name.owner == "accelerometer",
        excess=fitted.excess[None], estimate_excess=False, max_passes=12,
    )  # fmt: skip
    values = fitted.values
    step = np.abs(exact.values[0] - values) / np.sqrt(np.diagonal(fitted.covariance))
    assert step.max() < 1e-4


def test_agrees_with_the_magnitude_recipe_of_one_recording(cases, rows):
    """`jaximu magnetometer` of the file alone sees motion, too: what both determine agrees within what both leave."""
    for row, (recording, _, _) in list(zip(rows, cases, strict=True))[:3]:
        single, _, _ = calibrate_magnetometer([MagneticLog(recording.magnetometer)], FieldStrength(STRENGTH))
        triad, (gain_sigma, bias_sigma) = single.imu.magnetometer, single.sigma("magnetometer")
        assert triad is not None
        for value, other, sigma, own in (
            (row["mag_gain"], np.ravel(triad.gain), np.ravel(gain_sigma), row["mag_gain_sigma"]),
            (row["mag_bias"], triad.bias, bias_sigma, row["mag_bias_sigma"]),
        ):
            assert np.all(np.abs(value - other) <= 4 * np.hypot(sigma, own))


def test_a_field_of_which_nothing_is_known_widens_scale_alone(cases):
    found = segment(cases[0][0])
    known, free = (field_unit(cases[0][0].magnetometer, found, each, "u") for each in (FieldStrength(STRENGTH), None))
    fits = fit_units([known.unit, free.unit])
    first, second = (field_row(own, each, rms[0]) for own, (each, rms) in zip((known, free), fits, strict=True))
    assert second["mag_field_sigma"] == pytest.approx(0.05 * second["mag_field"])
    np.testing.assert_allclose(second["mag_bias"], first["mag_bias"], atol=1e-4)
    np.testing.assert_allclose(second["mag_gain"] * second["mag_field"], first["mag_gain"] * STRENGTH, rtol=1e-4)
    diagonal = second["mag_gain_sigma"][[0, 4, 8]] / second["mag_gain"][[0, 4, 8]]
    np.testing.assert_allclose(diagonal, 0.05, rtol=0.01)


def test_a_magnetometer_that_cannot_be_calibrated_costs_its_own_columns_alone(cases, tmp_path, capsys):
    recording = cases[0][0]
    signal = recording.magnetometer
    spoiled = {
        "still": Signal(signal.time, np.tile([20.0, 0.0, 40.0], (len(signal), 1)) + 1e-3 * signal.values, "uT"),
        "late": Signal(signal.time + 1e4, signal.values, "uT"),
    }
    write_recording(replace(recording, magnetometer=spoiled["still"]), tmp_path / "still.parquet")
    assert main(["fleet", str(tmp_path), "-o", str(tmp_path / "t.parquet"), "--workers", "1", "--field", "50+-1"]) == 0
    said = capsys.readouterr().out.partition("Magnetometers")[2]
    assert "- 0 of 1 calibrated." in said and "- 1 not calibrated: the magnetometer's output" in said
    (row,) = pq.read_table(tmp_path / "t.parquet").to_pylist()
    assert row["status"] == "ok" and row["mag_gain"] is None
    assert "not the Earth's field" in row["mag_message"]
    with pytest.raises(Exception, match="no samples while the unit is at rest"):
        field_unit(spoiled["late"], segment(recording), None, "late.csv")
