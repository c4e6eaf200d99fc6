"""`jaximu allan`: terms, JSON and picture of recordings at rest; what is not at rest or not even is refused."""

import json
from dataclasses import replace

import numpy as np
import pytest

from jaximu.cli import main
from jaximu.errors import InputError, NotPossibleError
from jaximu.formats import write_recording
from jaximu.noise import BiasRepeatability, Noise, RandomWalk, White
from jaximu.noise.analysis import analyse_noise, evenly_sampled
from jaximu.protocols import HandHeld, Static
from jaximu.recording import Recording, Signal
from jaximu.simulation import draw_imu, simulate
from jaximu.simulation.artefacts import Dropped, Gap, Jitter

NOISE = {
    "accelerometer": Noise((White(0.019), RandomWalk(5e-3), BiasRepeatability(0.05)), "specific_force"),
    "gyroscope": Noise((White(0.014), RandomWalk(3e-3), BiasRepeatability(0.01)), "angular_rate"),
}
TRUE = {"accelerometer": {"N": 0.019, "K": 5e-3}, "gyroscope": {"N": 0.014, "K": 3e-3}}


CONSTANT = Signal(np.arange(6000) / 100, np.ones((6000, 3)), "rad/s")


def at_rest(duration=400.0, seed=1, **changes) -> Recording:
    return simulate(draw_imu(1), Static(duration), NOISE, rate=100.0, seed=seed, **changes)[0]


def test_the_document_and_the_picture(tmp_path, capsys):
    for power_on in range(3):
        write_recording(at_rest(400.0 if power_on == 0 else 60.0, power_on=power_on), tmp_path / f"{power_on}.parquet")
    logs = [str(tmp_path / f"{power_on}.parquet") for power_on in range(3)]
    assert main(["allan", *logs, "-o", str(tmp_path / "out")]) == 0
    printed = " ".join(capsys.readouterr().out.split())
    assert "continuous, two-sided" in printed and "deg/sqrt(h)" in printed and "Repeatability" in printed
    assert (tmp_path / "out" / "allan.png").stat().st_size > 20_000
    document = json.loads((tmp_path / "out" / "allan.json").read_text())
    assert document["schema"] == "jaximu.allan/1"
    inside = 0
    for name, terms in TRUE.items():
        assert len(document[name]) == 3
        for axis in document[name]:
            assert (
                len(axis["taus"]) == len(axis["deviation"]) == len(axis["deviation_low"]) == len(axis["deviation_high"])
            )
            assert set(axis["terms"]) == set("QNBKR")
            for term, true in terms.items():
                found = axis["terms"][term]
                inside += found is not None and found["low"] <= true <= found["high"]
    assert inside >= 9  # of twelve 95 % intervals
    assert document["gyroscope"][0]["terms"]["N"]["unit"] == "rad/s/sqrt(Hz)"
    assert document["accelerometer"][0]["terms"]["N"]["unit"] == "m/s^2/sqrt(Hz)"
    spread = document["repeatability"]["gyroscope"]
    assert spread["unit"] == "rad/s"
    assert (np.array(spread["low"]) < spread["value"]).all() and (np.array(spread["value"]) < spread["high"]).all()
    assert main(["allan", logs[0], "--json"]) == 0
    alone = json.loads(capsys.readouterr().out)
    assert alone["repeatability"] is None and alone["gyroscope"] == document["gyroscope"]


def test_lost_samples_are_left_out_and_said():
    whole, holed = analyse_noise(at_rest()), analyse_noise(at_rest(artefacts=[Dropped(0.002), Gap(100.0, 103.0)]))
    assert any("samples of the gyroscope are missing" in note for note in holed.notes)
    for one, two in zip(whole.axes["gyroscope"], holed.axes["gyroscope"], strict=True):
        assert two.terms["N"].value == pytest.approx(one.terms["N"].value, rel=0.05)


def test_the_grid_of_uneven_stamps():
    rng = np.random.default_rng(0)
    time = 3.0 + np.arange(1000) / 99.7 + 1e-4 * rng.standard_normal(1000)
    keep = np.sort(rng.choice(1000, 950, replace=False))
    keep = np.unique(np.concatenate([[0], keep, [999]]))
    values, rate = evenly_sampled(Signal(time[keep], np.arange(1000.0)[keep, None] * np.ones(3), "rad/s"))
    assert rate == pytest.approx(99.7, rel=1e-4) and values.shape == (3, 1000)
    np.testing.assert_array_equal(values[0][keep], keep)
    assert np.isnan(values[0]).sum() == 1000 - len(keep)


@pytest.mark.parametrize(
    ("make", "error", "words"),
    [
        (lambda: analyse_noise([]), InputError, "no recording"),
        (lambda: analyse_noise(at_rest(1.0)), NotPossibleError, "too few to identify noise"),
        (
            lambda: analyse_noise(simulate(draw_imu(1), HandHeld(12, 5.0), NOISE, seed=1)[0]),
            NotPossibleError,
            "did not rest: .* seconds scatter",
        ),
        (lambda: analyse_noise(at_rest(60.0, artefacts=[Jitter(0.004)])), InputError, "sampled unevenly"),
        (
            lambda: analyse_noise(replace(at_rest(60.0), gyroscope=CONSTANT)),
            NotPossibleError,
            "no noise to identify",
        ),
    ],
)
def test_what_tells_no_noise_is_refused(make, error, words):
    with pytest.raises(error, match=words):
        make()


def test_statuses_of_the_command(tmp_path, capsys):
    write_recording(at_rest(1.0), tmp_path / "short.csv")
    assert main(["allan", str(tmp_path / "short.csv"), "-o", str(tmp_path / "out")]) == 1
    assert "too few" in capsys.readouterr().err
    assert main(["allan", str(tmp_path / "none.csv")]) == 2
    assert not (tmp_path / "out").exists()
    capsys.readouterr()


def test_measured_runs_agree_and_are_said_to_be_more_than_five_terms(data_folder, capsys):
    """ADIS16405, data sheet: 2.0 °/√h and 0.2 m/s/√h typical."""
    found = []
    for run in (1, 2):
        assert main(["allan", str(data_folder / "adis16405_static" / f"run{run}.parquet"), "--json"]) == 0
        found.append(json.loads(capsys.readouterr().out))
    for name, typical in (("gyroscope", np.radians(2.0) / 60), ("accelerometer", 0.2 / 60)):
        for one, two in zip(found[0][name], found[1][name], strict=True):
            a, b = one["terms"]["N"], two["terms"]["N"]
            assert a["low"] <= b["high"] and b["low"] <= a["high"]
            assert 0.7 < a["value"] / typical < 1.5
    assert any("no combination of the five terms" in note for note in found[0]["notes"])
