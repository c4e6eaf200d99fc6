"""The fleet as evidence, on tables whose truth is drawn here: no fit enters, NumPy alone."""

import json

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from scipy.stats import binom, chi2

from jaximu.fleets.population import estimate_population, read_fleet, write_shrunk
from jaximu.fleets.rows import PARAMETERS, SCHEMA
from jaximu.ground.errors import InputError, NotPossibleError
from jaximu.report.fleet import difference_words
from jaximu.report.html import write_report

FREE = [k for k, name in enumerate(PARAMETERS)
        if name not in ("accelerometer.gain[0,1]", "accelerometer.gain[0,2]", "accelerometer.gain[1,2]")]  # fmt: skip
NAMES = [PARAMETERS[k] for k in FREE]
SIZE = len(FREE)
NOMINAL = np.zeros(24)
NOMINAL[[0, 4, 8, 12, 16, 20]] = 1.0


def draw(seed, count, weak=0):
    """Truth x, estimates y and covariances; `weak` units know one direction thirty times worse."""
    rng = np.random.default_rng(seed)
    factor = np.diag(rng.uniform(0.002, 0.02, SIZE)) @ (np.eye(SIZE) + 0.2 * rng.standard_normal((SIZE, SIZE)))
    mean = 0.01 * rng.standard_normal(SIZE)
    x = mean + rng.standard_normal((count, SIZE)) @ factor.T
    noise = np.zeros((count, SIZE, SIZE))
    for k in range(count):
        own = 2e-4 * (np.eye(SIZE) + 0.3 * rng.standard_normal((SIZE, SIZE)))
        if k < weak:
            direction = rng.standard_normal(SIZE)
            own[:, 0] += 0.05 * direction / np.linalg.norm(direction)
        noise[k] = own
    y = x + np.einsum("nij,nj->ni", noise, rng.standard_normal((count, SIZE)))
    return mean, factor @ factor.T, x, y, np.einsum("nij,nkj->nik", noise, noise)


def write(path, y, covariances, scale=1.0, **columns):
    """A table as `jaximu fleet` writes it; `columns` replaces device, lot, date, effects, verdict."""
    count, low = len(y), np.tril_indices(24)
    whole = np.tile(NOMINAL, (count, 1))
    whole[:, FREE] += y - NOMINAL[FREE]
    big = np.zeros((count, 24, 24))
    big[np.ix_(range(count), FREE, FREE)] = covariances
    rows = []
    for k in range(count):
        row = dict.fromkeys(SCHEMA.names)
        row |= {"device": f"unit{k}", "file": f"unit{k}.csv", "status": "ok", "effects": None,
                "accel_gain": scale * whole[k, :9], "accel_bias": scale * whole[k, 9:12],
                "gyro_gain": whole[k, 12:21], "gyro_bias": whole[k, 21:],
                "accel_nominal": [scale] * 3 + [0.0] * 3, "gyro_nominal": [1.0] * 3 + [0.0] * 3,
                "accel_unit": "m/s^2", "gyro_unit": "rad/s", "accel_rms": 1e-3, "gyro_rms": 1e-2}  # fmt: skip
        factor = np.concatenate([np.full(12, scale), np.ones(12)])
        row["covariance"] = (big[k] * factor * factor[:, None])[low]
        row |= {name: values[k] for name, values in columns.items()}
        rows.append(row)
    pq.write_table(pa.table([pa.array([row[f.name] for row in rows], f.type) for f in SCHEMA], schema=SCHEMA), path)
    return path


def values_of(y):
    """Estimates as gains: the ones of the diagonal belong to them."""
    return y + NOMINAL[FREE]


def test_population_is_recovered_and_posteriors_cover():
    mean, covariance, x, y, noise = draw(1, 600, weak=300)
    population = estimate_population(NAMES, y, noise)
    assert population.count >= 598
    off = (population.mean - mean) / np.sqrt(np.diagonal(covariance) / 600)
    assert off @ np.linalg.solve(np.corrcoef(x.T), off) < chi2.isf(1e-4, SIZE)
    np.testing.assert_allclose(population.spread, np.sqrt(np.diagonal(covariance)), rtol=4 / np.sqrt(2 * 600) + 0.02)
    shrunk, spread = population.shrink(y, noise)
    squares = np.einsum("ni,ni->n", shrunk - x, np.linalg.solve(spread, (shrunk - x)[..., None])[..., 0])
    assert squares.mean() == pytest.approx(SIZE, rel=5 * np.sqrt(2 / SIZE / 600) + 0.05)


@pytest.mark.parametrize("count", [12, 60, 400])
def test_shrinking_lowers_the_error_of_weak_directions_and_of_none_raises_it(count):
    _, _, x, y, noise = draw(2, count, weak=count // 2)
    shrunk, _ = estimate_population(NAMES, y, noise).shrink(y, noise)
    alone, with_prior = (np.sqrt(np.mean((each - x) ** 2, axis=1)) for each in (y, shrunk))
    weak = slice(count // 2)
    assert np.sqrt(np.mean(with_prior[weak] ** 2)) < 0.8 * np.sqrt(np.mean(alone[weak] ** 2))
    assert np.sqrt(np.mean(with_prior[count // 2 :] ** 2)) < 1.02 * np.sqrt(np.mean(alone[count // 2 :] ** 2))


def test_too_few_units():
    _, _, _, y, noise = draw(3, 7)
    with pytest.raises(NotPossibleError, match="7 calibrated units are too few"):
        estimate_population(NAMES, y, noise)


def test_nothing_is_found_where_nothing_is(tmp_path):
    """Thirty fleets of five lots: of each kind one false alarm in a hundred is allowed for."""
    alarms = {"stranger": 0, "lot": 0, "date": 0}
    fleets = 30
    for seed in range(fleets):
        _, _, _, y, noise = draw(100 + seed, 80)
        days = [f"2026-0{1 + k % 9}-11" for k in range(80)]
        path = write(tmp_path / "t.parquet", values_of(y), noise, lot=[str(k % 5) for k in range(80)], date=days)
        fleet = read_fleet(path)
        alarms["stranger"] += bool(fleet.strangers)
        for kind in ("lot", "date"):
            alarms[kind] += any(each.kind == kind for each in fleet.differences)
    limit = binom.isf(1e-3, fleets, 0.02)  # the population is estimated from the very units that are asked
    assert max(alarms.values()) <= limit, alarms


@pytest.mark.parametrize("count", [8, 12, 30])
def test_of_few_units_no_ordinary_one_is_a_stranger(count):
    """In four fleets of five of eight alike units one was, the population taken as known: 'p 1e-31'."""
    alarms = misses = 0
    for seed in range(150):
        _, covariance, _, y, noise = draw(1000 + seed, count)
        population = estimate_population(NAMES, y, noise)
        alarms += np.min(population.p_values(y, noise, population.kept)) * count < 0.01
        y[0, 3] += 25 * np.sqrt(covariance[3, 3])
        population = estimate_population(NAMES, y, noise)
        misses += np.argmin(p_values := population.p_values(y, noise, population.kept)) or p_values[0] * count > 0.01
    assert alarms <= binom.isf(1e-3, 150, 0.01)
    assert misses <= 15


def test_strangers_are_found_and_named(tmp_path):
    _, covariance, _, y, noise = draw(4, 120)
    y[17, 3] += 15 * np.sqrt(covariance[3, 3])
    y[60, 20] -= 15 * np.sqrt(covariance[20, 20])
    fleet = read_fleet(write(tmp_path / "t.parquet", values_of(y), noise))
    assert {each.device for each in fleet.strangers} == {"unit17", "unit60"}
    named = {each.device: each.parameters[0][0] for each in fleet.strangers}
    assert named == {"unit17": NAMES[3], "unit60": NAMES[20]}


def test_a_bad_lot_is_found_and_its_units_are_no_strangers(tmp_path):
    _, covariance, _, y, noise = draw(5, 200)
    lots = np.array([f"L{k % 8}" for k in range(200)])
    shift = 2.5 * np.sqrt(covariance[7, 7])
    y[lots == "L3", 7] += shift
    fleet = read_fleet(write(tmp_path / "t.parquet", values_of(y), noise, lot=lots.tolist()))
    (lot,) = [each for each in fleet.differences if each.kind == "lot"]
    assert lot.group == "L3" and lot.count == 25
    (name, amount, sigma) = lot.parameters[0]
    assert name == NAMES[7] and abs(amount - shift) < 4 * sigma
    assert not fleet.strangers
    assert fleet.population is not None
    assert fleet.population.spread[7] == pytest.approx(np.sqrt(covariance[7, 7]), rel=0.25)


def test_drift_with_the_date(tmp_path):
    _, covariance, _, y, noise = draw(6, 150)
    days = np.arange(150) * 4
    y[:, 11] += 3 * np.sqrt(covariance[11, 11]) * days / 365.25
    dates = [str(np.datetime64("2025-01-01") + int(day)) for day in days]
    fleet = read_fleet(write(tmp_path / "t.parquet", values_of(y), noise, date=dates))
    (drift,) = [each for each in fleet.differences if each.kind == "date"]
    name, slope, sigma = drift.parameters[0]
    assert name == NAMES[11]
    assert abs(slope - 3 * np.sqrt(covariance[11, 11])) < 4 * sigma


def in_order(count, lots, mixed=0):
    """Lots (count,) that follow each other over a year, and dates; one unit in `mixed` is of a lot drawn at random."""
    rng = np.random.default_rng(20)
    places = np.arange(count) * lots // count
    if mixed:
        places = np.where(np.arange(count) % mixed == 0, rng.integers(0, lots, count), places)
    days = 365 * np.arange(count) // count
    return np.array([f"L{k}" for k in places]), [str(np.datetime64("2025-01-01") + int(day)) for day in days], days


@pytest.mark.parametrize("mixed", [0, 4])
def test_a_drift_makes_no_lot_look_bad(tmp_path, mixed):
    """Lots made one after another, wholly or but for one unit in four: only the drift is told, and taken off."""
    _, covariance, x, y, noise = draw(21, 240, weak=80)
    spread = np.sqrt(covariance[11, 11])
    lots, dates, days = in_order(240, 6, mixed)
    added = 4 * spread * days / 365.25
    x[:, 11] += added
    y[:, 11] += added
    path = write(tmp_path / "t.parquet", values_of(y), noise, lot=lots.tolist(), date=dates)
    fleet = read_fleet(path)
    assert [each.kind for each in fleet.differences] == ["date"]
    ((name, slope, sigma),) = fleet.differences[0].parameters
    assert name == NAMES[11] and abs(slope - 4 * spread) < 4 * sigma
    assert fleet.population is not None and not fleet.strangers
    assert fleet.population.spread[11] == pytest.approx(spread, rel=0.2)  # with the drift in it 1.5 times as much
    # and units at the ends of the year are not pulled to its middle
    write_shrunk(fleet, tmp_path / "s.parquet")
    rows = pq.read_table(tmp_path / "s.parquet").to_pylist()
    written = np.array([[*row["accel_gain"], *row["accel_bias"], *row["gyro_gain"], *row["gyro_bias"]] for row in rows])
    np.testing.assert_allclose(written[:, FREE], fleet.shrunk, rtol=1e-9, atol=1e-15)
    off = fleet.shrunk[:, 11] - x[:, 11]
    bound = 5 * spread / np.sqrt(80)
    assert abs(off[:80].mean()) < bound and abs(np.polyfit(days[:80], off[:80], 1)[0] * 365) < bound


def test_a_bad_lot_is_no_drift(tmp_path):
    """The last of lots made one after another is off; one before it is the mirror image, and told too."""
    _, covariance, _, y, noise = draw(22, 240)
    lots, dates, _ = in_order(240, 6, 5)
    y[lots == "L5", 7] += 2 * np.sqrt(covariance[7, 7])
    y[lots == "L1", 4] -= 2 * np.sqrt(covariance[4, 4])
    fleet = read_fleet(write(tmp_path / "t.parquet", values_of(y), noise, lot=lots.tolist(), date=dates))
    told = {each.group: [name for name, _, _ in each.parameters] for each in fleet.differences}
    assert told == {"L5": [NAMES[7]], "L1": [NAMES[4]]}


def test_a_bad_lot_and_a_drift_in_one_parameter(tmp_path):
    _, covariance, _, y, noise = draw(23, 400)
    spread = np.sqrt(covariance[11, 11])
    lots, dates, days = in_order(400, 8, 5)
    y[:, 11] += 2 * spread * days / 365.25
    y[lots == "L2", 11] += 2 * spread
    fleet = read_fleet(write(tmp_path / "t.parquet", values_of(y), noise, lot=lots.tolist(), date=dates))
    found = {each.kind: each for each in fleet.differences}
    assert set(found) == {"lot", "date"} and found["lot"].group == "L2"
    for kind in found:
        ((name, amount, sigma),) = found[kind].parameters
        assert name == NAMES[11] and abs(amount - 2 * spread) < 4 * sigma


def test_of_two_lots_one_is_told(tmp_path):
    """Each differs from the other; what differs is taken off one of them, not off both."""
    _, covariance, _, y, noise = draw(24, 100)
    lots = np.array(["A"] * 50 + ["B"] * 50)
    y[lots == "B", 7] += 2 * np.sqrt(covariance[7, 7])
    fleet = read_fleet(write(tmp_path / "t.parquet", values_of(y), noise, lot=lots.tolist()))
    (lot,) = fleet.differences
    assert lot.group in "AB" and [name for name, _, _ in lot.parameters] == [NAMES[7]]
    assert fleet.shifts is not None
    centred = fleet.values[:, 7] - fleet.shifts.of([{"lot": lot, "date": None} for lot in lots])[:, 7]
    apart = centred[:50].mean() - centred[50:].mean()
    assert abs(apart) < 5 * np.sqrt(covariance[7, 7] * 4 / 100)


def test_a_device_that_changed(tmp_path):
    _, _, _, y, noise = draw(7, 40)
    devices = [f"unit{k % 20}" for k in range(40)]
    rng = np.random.default_rng(0)
    own = np.linalg.cholesky(noise)
    y[20:] = y[:20] + np.einsum("nij,nj->ni", own[20:] - own[:20], rng.standard_normal((20, SIZE)))
    noise[20:] *= 4
    y[25, 2] += 20 * np.sqrt(noise[25, 2, 2])
    fleet = read_fleet(write(tmp_path / "t.parquet", values_of(y), noise, device=devices))
    (changed,) = [each for each in fleet.differences if each.kind == "device"]
    assert changed.group == "unit5" and changed.parameters[0][0] == NAMES[2]


def test_an_effect_shared_by_a_lot(tmp_path):
    _, _, _, y, noise = draw(8, 60)
    lots = [f"L{k % 4}" for k in range(60)]
    effects = [["gyro.g_sensitivity"] if k % 4 == 2 or k == 5 else [] for k in range(60)]
    verdicts = ["effects" if each else "adequate" for each in effects]
    path = write(tmp_path / "t.parquet", values_of(y), noise, lot=lots, effects=effects, verdict=verdicts)
    fleet = read_fleet(path)
    (shared,) = [each for each in fleet.differences if each.kind == "effect"]
    assert shared.group == "L2" and "15 of its 15" in shared.text and "1 of 45" in shared.text
    json.dumps(fleet.document(), allow_nan=False)


def test_units_do_not_matter_and_shrunk_values_come_back_in_them(tmp_path):
    """The same fleet in m/s² and in counts: the same population, and shrunk gains forty times as large."""
    _, _, _, y, noise = draw(9, 50, weak=20)
    plain = read_fleet(write(tmp_path / "a.parquet", values_of(y), noise))
    counts = read_fleet(write(tmp_path / "b.parquet", values_of(y), noise, scale=40.0))
    assert plain.population is not None and counts.population is not None
    np.testing.assert_allclose(plain.population.covariance, counts.population.covariance, rtol=1e-9, atol=1e-15)
    write_shrunk(plain, tmp_path / "a.shrunk.parquet")
    write_shrunk(counts, tmp_path / "b.shrunk.parquet")
    a, b = (pq.read_table(tmp_path / f"{name}.shrunk.parquet").to_pylist() for name in "ab")
    for first, second, shrunk in zip(a, b, plain.shrunk, strict=True):
        np.testing.assert_allclose(40 * np.array(first["accel_gain"]), second["accel_gain"], rtol=1e-9, atol=1e-12)
        np.testing.assert_allclose(first["gyro_bias"], shrunk[-3:], rtol=1e-9, atol=1e-15)
        assert first["accel_gain_sigma"][1] == 0.0  # fixed by convention


def test_small_and_foreign_tables(tmp_path):
    _, _, _, y, noise = draw(10, 5)
    fleet = read_fleet(write(tmp_path / "t.parquet", values_of(y), noise))
    assert fleet.population is None and "fewer than 8" in fleet.notes[-1]
    with pytest.raises(NotPossibleError):
        write_shrunk(fleet, tmp_path / "s.parquet")
    pq.write_table(pa.table({"device": ["a"]}), tmp_path / "other.parquet")
    with pytest.raises(InputError, match="column file is missing"):
        read_fleet(tmp_path / "other.parquet")
    (tmp_path / "none.parquet").write_text("x")
    with pytest.raises(InputError, match="is not a fleet's table"):
        read_fleet(tmp_path / "none.parquet")


def test_page_of_a_fleet(tmp_path):
    """What is found stands on the page, escaped, and the page needs nothing from outside."""
    _, covariance, _, y, noise = draw(11, 80)
    lots = np.array([f"<L{k % 4}>" for k in range(80)])
    y[lots == "<L1>", 19] += 4 * np.sqrt(covariance[19, 19])
    y[8, 3] += 20 * np.sqrt(covariance[3, 3])
    path = write(tmp_path / "t.parquet", values_of(y), noise, lot=lots.tolist())
    fleet = read_fleet(path)
    page = write_report(fleet, tmp_path).read_text(encoding="utf-8")
    assert "unit8" in page and "&lt;L1&gt;" in page and "<L1>" not in page
    assert "http://" not in page and "https://" not in page
    assert page.count("<svg ") == 2 and "the fleet as prior makes none a fifth better" in page
    assert str(fleet.summary()).startswith("Fleet of 80 recordings, t.parquet\nAll recordings were calibrated.")
    document = fleet.document()
    assert document["schema"] == "jaximu.fleet/1" and document["population"]["units"] == 79
    assert difference_words(fleet.differences[0]).startswith(
        "Lot <L1> (20 units) differs from the other lots: gyroscope"
    )


def test_a_prior_that_helps_is_drawn(tmp_path):
    _, _, _, y, noise = draw(13, 40, weak=20)
    page = write_report(read_fleet(write(tmp_path / "t.parquet", values_of(y), noise)), tmp_path)
    assert page.read_text(encoding="utf-8").count("<svg ") == 2 and (tmp_path / "prior.png").exists()


def test_page_without_a_population(tmp_path):
    _, _, _, y, noise = draw(12, 3)
    path = write(tmp_path / "t.parquet", values_of(y), noise)
    page = write_report(read_fleet(path), tmp_path).read_text(encoding="utf-8")
    assert "Too few units to speak of a population" in page and "<svg " not in page
