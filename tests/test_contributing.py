"""What CONTRIBUTING.md says is enough: an effect of one file and one line, a kind of data of one file."""

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from centrifuge import Centrifuge

import jaximu
from jaximu.cli import main
from jaximu.data.observe_stations import scheme_stations
from jaximu.data.stations import KnownStations
from jaximu.model.effects import CATALOGUE
from jaximu.model.sensor import Triad
from jaximu.model.stimulus import Stimulus
from jaximu.recordings.readers import read_recording
from jaximu.simulation import draw_imu
from jaximu.simulation.protocols import Positions

ROOT = Path(__file__).parents[1]
PAGE = ROOT / "CONTRIBUTING.md"


@pytest.fixture(scope="module")
def page():
    """The file and the line that the page tells to write: the path and the text of the one, and of the other."""
    text = PAGE.read_text(encoding="utf-8")
    told = re.search(r"one file, `(\S+)`, and one line, `(\S+)` in `(\S+)`", text)
    shown = re.search(r"<!-- new-effect -->\n```python\n(.*?)```", text, re.DOTALL)
    assert told and shown
    return told[1], shown[1], told[3], told[2]


def test_the_new_effect_of_the_contributing_page(page, monkeypatch, tmp_path, capsys):
    assert len([line for line in page[1].splitlines() if line.strip()]) <= 10
    scope: dict = {"__name__": "quartic"}
    exec(page[1], scope)
    (kind,) = scope["EFFECTS"]
    monkeypatch.setitem(CATALOGUE, kind.name, kind)

    assert main(["effects", kind.name]) == 0
    assert kind.formula in capsys.readouterr().out
    triad = Triad(jnp.eye(3), jnp.zeros(3), (kind.make(10 * kind.typical),), "angular_rate", "rad/s")
    rate = jnp.array([2.0, -3.0, 4.0])
    output = triad.respond(Stimulus(angular_rate=rate))
    np.testing.assert_allclose(output - rate, 1e-4 * np.array([16.0, 81.0, 256.0]))
    np.testing.assert_allclose(triad.recover(output), rate, atol=1e-9)
    spec = '[protocol]\nkind = "hand-held"\nposes = 3\npose_duration = 1\n[effects."gyro.quartic"]\ncoefficients = {}\n'
    for size in (0, 1e-3):
        (tmp_path / "spec.toml").write_text(spec.format(size))
        assert main(["simulate", str(tmp_path / "spec.toml"), "-o", str(tmp_path / f"{size}.parquet")]) == 0
    plain, flawed = (read_recording(tmp_path / f"{size}.parquet").gyroscope.values for size in (0, 1e-3))
    np.testing.assert_allclose(flawed - plain, 1e-3 * plain**4, atol=1e-12)


NEEDED = ("conftest", "environment", "known_effects", "synthetic", "test_effects", "test_sensor", "test_effect_physics")
LAWS = (
    "test_effects.py::test_metadata_is_complete",
    "test_effects.py::test_inner_parameters_are_declared",
    "test_effects.py::test_another_number_of_coefficients_is_refused",
    "test_effects.py::test_unknown_inner_parameter_is_refused",
    "test_effects.py::test_typical_sizes_are_in_the_units_of_the_output",
    "test_effects.py::test_dormant_effect_is_absent",
    "test_effects.py::test_takes_any_batch_and_its_last_axis_is_the_path",
    "test_effects.py::test_is_linear_in_its_coefficients",
    "test_effects.py::test_units_are_those_of_the_formula",
    "test_effects.py::test_missing_field_is_named",
    "test_sensor.py::test_round_trip_with_effects_ten_times_their_usual_size",
)
WHOLE = (
    "test_effects.py::test_the_catalogue_holds_what_was_demanded",
    "test_effects.py::test_every_file_of_the_folder_is_in_the_catalogue",
    "test_effect_physics.py::test_loops_and_physics_leave_no_effect_out",
    "test_sensor.py::test_only_what_belongs_to_the_unit_is_transferred",
)


def test_the_catalogue_s_tests_try_the_new_effect(page, tmp_path):
    """On a copy of the package that has it, and beside it one that is not what it says: only the latter fails."""
    path, text, catalogue, line = page
    shutil.copytree(ROOT / "jaximu", tmp_path / "jaximu", ignore=shutil.ignore_patterns("__pycache__"))
    shutil.copy(ROOT / "pyproject.toml", tmp_path)
    (tmp_path / "tests").mkdir()
    for name in NEEDED:
        shutil.copy(ROOT / "tests" / f"{name}.py", tmp_path / "tests")
    wrong = text.replace("quartic", "wrong").replace(
        "** 4", "** 3 + 1e-3"
    )  # a cube, and a constant without a coefficient
    (tmp_path / path).write_text(text, encoding="utf-8")
    (tmp_path / path.replace("quartic", "wrong")).write_text(wrong, encoding="utf-8")
    listed = (tmp_path / catalogue).read_text(encoding="utf-8")
    lines = f"_FILES = (\n    {line}\n    {line.replace('quartic', 'wrong')}\n"
    (tmp_path / catalogue).write_text(listed.replace("_FILES = (\n", lines), encoding="utf-8")
    chosen = [f"tests/{law}[gyro.{name}]" for law in LAWS for name in ("quartic", "wrong")]
    chosen += [f"tests/{test}" for test in WHOLE]
    done = subprocess.run(
        [sys.executable, "-m", "pytest", "-q", "-n", "0", "-p", "no:cacheprovider", "-rf", *chosen],
        cwd=tmp_path, env=os.environ | {"PYTHONPATH": str(tmp_path)}, capture_output=True, text=True,
    )  # fmt: skip
    failed = set(re.findall(r"^FAILED (\S+)", done.stdout, re.MULTILINE))
    laws = ("dormant_effect_is_absent", "is_linear_in_its_coefficients", "units_are_those_of_the_formula")
    assert failed == {f"tests/test_effects.py::test_{law}[gyro.wrong]" for law in laws}, done.stdout + done.stderr
    assert f"{len(failed)} failed, {len(chosen) - len(failed)} passed" in done.stdout


HIDDEN = np.array([2e-4, -3e-4, 1e-4])


def on_a_centrifuge(*effects, number=1, run=0, speeds=36):
    """Return a unit with effects, by number, and its mean outputs at some speeds of a centrifuge, up to 3 g."""
    random = np.random.default_rng([number, run])
    direction, axis = (random.normal(size=(speeds, 3)) for _ in range(2))
    speed = random.uniform(2.0, 8.0, speeds)[:, None]
    force = 0.5 * speed**2 * direction / np.linalg.norm(direction, axis=1, keepdims=True)
    rate = speed * axis / np.linalg.norm(axis, axis=1, keepdims=True)
    unit = jax.tree.map(np.asarray, draw_imu(number)).with_effects(*effects)
    outputs = [np.asarray(triad.respond(Stimulus(force, rate))) for triad in unit.triads().values()]
    sigma = np.repeat([1e-3, 1e-4], 3)
    output = np.concatenate(outputs, axis=1) + sigma * random.normal(size=(speeds, 6))
    return unit, Centrifuge(output, force, rate, 10.0 * np.arange(speeds)[:, None] + np.array([0.0, 8.0]), sigma)


def test_a_new_kind_of_data_is_one_file():
    """A kind of data that the library knows nothing of is fitted, alone or with others, and diagnosed."""
    truth, data = on_a_centrifuge(CATALOGUE["accel.quadratic"](HIDDEN))
    found = jaximu.diagnose(data)
    (named,) = found.named
    assert found.verdict == "effects" and named.name == "accel.quadratic" and not named.rivals
    assert np.all(np.abs(named.effect.coefficients - HIDDEN) < 4 * named.sigma)
    assert found.gain is not None and found.gain.after.rms["force"][0] < 0.1 * found.gain.before.rms["force"][0]
    better = found.extended_calibration()
    off = (better.imu.accelerometer.gain - truth.accelerometer.gain) / better.sigma("accelerometer")[0]
    assert np.abs(off).max() < 4.5 and "Error of the force" in str(better.summary())
    assert "Gravity was taken" not in str(better.summary())  # the arm's force does not depend on it

    sound, plain = on_a_centrifuge(number=2)
    assert jaximu.diagnose(plain).verdict == "adequate"
    both = jaximu.calibrate([plain, on_a_centrifuge(number=2, run=1, speeds=20)[1]])
    alone = jaximu.calibrate(plain)
    assert np.all(both.sigma("gyroscope")[0] < alone.sigma("gyroscope")[0])
    assert np.abs((both.imu.gyroscope.gain - sound.gyroscope.gain) / both.sigma("gyroscope")[0]).max() < 4.5


def test_what_is_not_diagnosed_says_so():
    _, data = on_a_centrifuge()
    with pytest.raises(jaximu.InputError, match="are for recordings, and data were given"):
        jaximu.diagnose(data, repair=True)
    with pytest.raises(jaximu.InputError, match="KnownStations cannot be diagnosed: give the recording"):
        jaximu.diagnose(KnownStations(scheme_stations(Positions(6))))
    with pytest.raises(jaximu.InputError, match=r"no effect 'accel\.quadrat'"):
        jaximu.diagnose(data, candidates=["accel.quadrat"])
