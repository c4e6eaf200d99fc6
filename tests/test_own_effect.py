"""An effect of a user's own: registered, found in a recording, kept in a file, known to the processes of a fleet."""

import importlib
import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaximu
from jaximu.calibration.calibration import effect_named
from jaximu.cli import main
from jaximu.fleets import Settings, find_jobs, run_fleet
from jaximu.fleets.jobs import own_effects
from jaximu.model.effects import CATALOGUE
from jaximu.recordings.recording import Recording

MODULE = '''
import jax.numpy as jnp
import jaximu


class Ripple(jaximu.Effect):
    """c_i sin(2 f_i) on each axis."""

    name, formula, unit, size = "accel.ripple", "c_i sin(2 f_i)", "output", 3
    scope, needs, excited_by = "device", ("specific_force",), "many orientations"
    look_alikes, source, typical = ("accel.cubic",), "an interpolating digitiser", 1e-3

    def term(self, stimulus):
        return FACTOR * self.coefficients * jnp.sin(2 * stimulus.need("specific_force", self.name))


FACTOR = 1
'''
SPEC = """
seed = 7
[protocol]
kind = "hand-held"
poses = 30
pose_duration = 2
[accelerometer]
noise = { white = "100 ug/sqrt(Hz)", density = "one-sided" }
[gyroscope]
noise = { white = "0.005 deg/s/sqrt(Hz)", density = "one-sided" }
[effects."accel.ripple"]
coefficients = [0.02, -0.015, 0.01]
"""


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A folder that modules are imported from, with the effect's."""
    folder = tmp_path_factory.mktemp("own")
    (folder / "ripples.py").write_text(MODULE)
    (folder / "unit.toml").write_text(SPEC)
    sys.path.insert(0, str(folder))
    yield folder
    sys.path.remove(str(folder))
    CATALOGUE.pop("accel.ripple", None)


@pytest.fixture(scope="module")
def ripple(folder):
    """The registered class."""
    return jaximu.register(importlib.import_module("ripples").Ripple)


@pytest.fixture(scope="module")
def log(folder, ripple) -> Recording:
    """A recording of a unit that has the effect."""
    assert main(["simulate", str(folder / "unit.toml"), "-o", str(folder / "unit.parquet")]) == 0
    return jaximu.read_recording(folder / "unit.parquet")


@pytest.fixture(scope="module")
def found(log, ripple):
    """What a diagnosis finds among three candidates."""
    return jaximu.diagnose(log, candidates=["accel.quadratic", ripple, "gyro.g_sensitivity"])


def test_a_diagnosis_names_it(found):
    (named,) = found.named
    assert named.name == "accel.ripple"
    truth = np.array([0.02, -0.015, 0.01])
    effect = found.extended_calibration().imu.accelerometer.effects[0]
    assert np.all(np.abs(np.asarray(effect.coefficients) - truth) < 5 * np.asarray(named.document()["sigma"]))
    assert set(found.document()["detection_limits"]) <= {"accel.quadratic", "accel.ripple", "gyro.g_sensitivity"}
    assert any("only these were asked for: accel.quadratic, accel.ripple, gyro.g_sensitivity" in n for n in found.notes)
    assert found.document()["effects"][0]["name"] == "accel.ripple"


def test_without_it_among_the_candidates_nothing_explains_the_recording(log):
    found = jaximu.diagnose(log, candidates=["accel.misalignment_temperature", "gyro.g_sensitivity"])
    assert found.verdict == "unexplained"
    assert not found.named


def test_an_unknown_candidate_is_named(log):
    with pytest.raises(jaximu.InputError, match=r"there is no effect 'accel.rippel'; did you mean 'accel.ripple'"):
        jaximu.diagnose(log, candidates=["accel.rippel"])


def other(folder) -> str:
    """Another recording of the unit."""
    log = folder / "other.parquet"
    if not log.exists():
        (folder / "other.toml").write_text(SPEC.replace("seed = 7", "seed = 8"))
        assert main(["simulate", str(folder / "other.toml"), "-o", str(log)]) == 0
    return str(log)


def test_a_file_names_what_it_lacks_and_takes_it(found, folder, ripple):
    path = folder / "calibration.json"
    found.extended_calibration().save(path)
    assert jaximu.load_calibration(path) == found.extended_calibration()
    code = f"import jaximu; print(jaximu.load_calibration({str(path)!r}))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    last = done.stderr.strip().splitlines()[-1]
    assert "holds an effect 'accel.ripple'" in last
    assert "ripples:Ripple" in last
    assert "damaged" not in last
    assert main(["check", str(path), other(folder)]) == 0
    given = f"import sys; sys.path.insert(0, {str(folder)!r}); from ripples import Ripple; import jaximu\n"
    code = f"{given}print(jaximu.load_calibration({str(path)!r}, effects=[Ripple]).imu.accelerometer.effects[0].name)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.stdout.strip() == "accel.ripple", done.stderr


def test_processes_of_a_fleet_know_it(log, folder, tmp_path):
    logs = [folder / "unit.parquet", other(folder)]
    assert run_fleet(find_jobs(logs), tmp_path / "fleet.parquet", Settings(diagnose=True), workers=2) == {"ok": 2}
    import pyarrow.parquet

    rows = pyarrow.parquet.read_table(tmp_path / "fleet.parquet").to_pylist()
    assert all("accel.ripple" in str(row["effects"]) for row in rows)


def test_what_another_process_cannot_import_is_refused_before_it_starts(ripple, monkeypatch):
    monkeypatch.setattr(ripple, "__module__", "__main__")
    with pytest.raises(jaximu.InputError, match="__main__:Ripple is defined where other processes cannot find it"):
        own_effects()


def test_a_changed_formula_is_computed_anew(log, folder):
    """Kept programs are of the source that they were made of, though class and name are the same."""
    sizes = []
    for factor in (1, 2):
        (folder / "changing.py").write_text(MODULE.replace("FACTOR = 1", f"FACTOR = {factor}  # {'=' * factor}"))
        sys.modules.pop("changing", None)
        importlib.invalidate_caches()
        kind = importlib.import_module("changing").Ripple
        (effect,) = jaximu.calibrate(log, effects=[kind.dormant()]).imu.accelerometer.effects
        sizes.append(np.asarray(effect.coefficients))
    np.testing.assert_allclose(sizes[0], 2 * sizes[1], rtol=1e-4)  # the prior weighs a little


def test_what_is_no_effect_is_refused():
    class Silent(jaximu.Effect):
        name = "accel.silent"

    class Nameless(jaximu.Effect):
        pass

    class Elsewhere(jaximu.Effect):
        name = "barometer.silent"

    def taken():
        class Quadratic(jaximu.Effect):
            name = "accel.quadratic"
            formula, unit, source, typical, scope = "c f²", "output", "here", 1.0, "device"
            needs, excited_by = ("specific_force",), "poses"

            def term(self, stimulus):
                return self.coefficients * stimulus.specific_force**2

        return Quadratic

    cases = {
        "expected a class derived from jaximu.Effect, found 'accel.quadratic'": "accel.quadratic",
        "Silent does not state its formula, unit": Silent,
        "Nameless states no name": Nameless,
        "'barometer.silent' must begin with one of accel., ": Elsewhere,
        "the catalogue has an effect 'accel.quadratic' already, jaximu.model.effects.quadratic:": taken(),
    }
    before = dict(CATALOGUE)
    for words, kind in cases.items():
        with pytest.raises(jaximu.InputError) as raised:
            jaximu.register(kind)
        assert words in str(raised.value)
    assert before == CATALOGUE
    with pytest.raises(jaximu.InputError, match=r"jaximu.register adds one of your own"):
        effect_named("accel.unheard")


def test_it_is_explained_and_traced(ripple, capsys):
    assert main(["effects", "accel.ripple"]) == 0
    assert ripple.formula in capsys.readouterr().out
    size = jax.grad(lambda c: jnp.sum(ripple(c).term(jaximu.Stimulus(specific_force=jnp.ones(3)))))(jnp.ones(3))
    np.testing.assert_allclose(size, np.sin(2.0))
