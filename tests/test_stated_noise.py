"""Noise that a file states: the same Allan variance as its terms have, and weights of a fit."""

import json

import numpy as np
import pytest

from jaximu.cli.app import main
from jaximu.ground.errors import InputError
from jaximu.model import BiasInstability, Quantisation, RandomWalk, White
from jaximu.noise.stated import model_of
from jaximu.recordings import write_recording
from jaximu.simulation import consumer_noise, draw_imu, simulate
from jaximu.simulation.protocols import HandHeld

TERMS = {"Q": Quantisation, "N": White, "B": BiasInstability, "K": RandomWalk}
FIGURES = {"Q": 1e-5, "N": 1e-3, "B": 2e-4, "K": 3e-5}


@pytest.mark.parametrize("terms", ["N", "NQ", "NB", "NK", "QNBK"])
def test_noise_has_the_allan_variance_of_its_terms(terms):
    """Each term by itself is written elsewhere in the library; a random walk lasts ever, its stand-in 10⁵ s."""
    times = np.geomspace(1.0, 1000.0, 20)
    noise = model_of({"accelerometer": {letter: np.full(3, FIGURES[letter]) for letter in terms}}).accelerometer
    truth = sum(TERMS[letter](FIGURES[letter]).allan_variance(times) for letter in terms)
    np.testing.assert_allclose(noise.allan_variance(times), np.tile(truth[:, None], 3), rtol=0.04)


def test_without_white_noise_or_accelerometer_it_is_refused():
    with pytest.raises(InputError, match="accelerometer's white noise N is not stated"):
        model_of({"accelerometer": {"K": np.ones(3)}})
    with pytest.raises(InputError, match="no noise of an accelerometer"):
        model_of({"gyroscope": {"N": np.ones(3)}})


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A log, and three files that state the same white noise."""
    made = tmp_path_factory.mktemp("stated")
    recording, _ = simulate(draw_imu(3), HandHeld(14, 2.0, 1.0), consumer_noise(), rate=50.0, seed=3)
    write_recording(recording, made / "log.parquet")
    white = {"accelerometer": (1e-3, "m/s^2/sqrt(Hz)"), "gyroscope": (1e-4, "rad/s/sqrt(Hz)")}
    triads = {name: [{"terms": {"N": {"value": value, "unit": unit}}}] * 3 for name, (value, unit) in white.items()}
    (made / "allan.json").write_text(json.dumps({"schema": "jaximu.allan/1", **triads}))
    lines = [f"{name}_noise_density: {value:.5e}" for name, (value, _) in white.items()]
    (made / "imu.yaml").write_text("\n".join(lines))
    tables = [
        f'[{name}]\nnoise = {{ white = "{value} {unit}", density = "two-sided" }}'
        for name, (value, unit) in white.items()
    ]
    (made / "spec.toml").write_text("\n".join(['[protocol]\nkind = "hand-held"', *tables]))
    return made


def test_files_that_state_the_same_noise_give_the_same_calibration(folder, capsys):
    documents = []
    for name in ("allan.json", "imu.yaml", "spec.toml"):
        assert main(["calibrate", str(folder / "log.parquet"), "--noise", str(folder / name), "--json"]) == 0
        documents.append(json.loads(capsys.readouterr().out))
    first, *others = (np.array(document["covariance"]["matrix"]) for document in documents)
    for other in others:
        np.testing.assert_allclose(other, first, rtol=1e-6, atol=1e-6 * np.abs(first).max())
    assert not [note for note in documents[0]["fit"]["notes"] if "were estimated from this" in note]


def test_two_sources_and_files_that_state_none_are_refused(folder, capsys):
    log, stated = str(folder / "log.parquet"), str(folder / "allan.json")
    assert main(["calibrate", log, "--noise", stated, "--static", log]) == 2
    assert "either --static or --noise" in capsys.readouterr().err
    assert main(["calibrate", log, "--noise", log]) == 2
    assert "is not an allan.json" in capsys.readouterr().err


def test_the_former_name_of_an_option_works_and_is_said(folder, tmp_path, capsys):
    assert main(["calibrate", str(folder / "log.parquet"), "-o", str(tmp_path)]) == 0
    capsys.readouterr()
    line = ["consequences", str(tmp_path / "calibration.json"), "--draws", "0", "--duration", "10", "--json"]
    assert main([*line, "--allan", str(folder / "allan.json")]) == 0
    former = capsys.readouterr()
    assert "--allan is called --noise now." in former.err
    assert main([*line, "--noise", str(folder / "allan.json")]) == 0
    assert capsys.readouterr().out == former.out
