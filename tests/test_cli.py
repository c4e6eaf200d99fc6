"""The command line: results, exit statuses, and bad input as one sentence with nothing half written."""

import json
import os
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

import jaximu
from jaximu.cli import main, messages
from jaximu.cli.app import VERBS
from jaximu.cli.demo import _HIDDEN, _draw_flaw
from jaximu.cli.messages import progress
from jaximu.cli.usage import command_of
from jaximu.model.effects import CATALOGUE
from jaximu.recordings import write_recording
from jaximu.recordings.readers import read_recording
from jaximu.recordings.recording import Recording, Signal
from jaximu.simulation import consumer_noise, draw_imu, simulate
from jaximu.simulation.protocols import HandHeld

POSES = 12


@pytest.fixture(scope="module")
def unit():
    return simulate(draw_imu(5), HandHeld(POSES, 2.0), consumer_noise(), seed=5)


@pytest.fixture(scope="module")
def log(unit, tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("logs") / "log.csv"
    write_recording(unit[0], path)
    return path


@pytest.fixture(scope="module")
def calibration(log, tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("calibration")
    assert main(["calibrate", str(log), "--gravity", "9.80665+-0", "-o", str(folder)]) == 0
    return folder


def refused(capsys, status: int, *arguments: str) -> str:
    """Run a command that must be refused; return its message, one sentence on stderr."""
    assert main(arguments) == status
    printed = capsys.readouterr()
    assert printed.out == ""
    message = [line for line in printed.err.splitlines() if line.startswith("jaximu: ")]
    assert len(message) == 1, printed.err
    assert "Traceback" not in printed.err and "should not happen" not in printed.err
    return message[0]


def test_calibrate_writes_a_calibration_that_holds_the_truth(unit, calibration):
    document = json.loads((calibration / "calibration.json").read_text())
    assert document["schema"] == "jaximu.calibration/1"
    truth = unit[1].imu
    for name in ("accelerometer", "gyroscope"):
        triad, part = getattr(truth, name), document[name]
        sigma = np.array(part["gain_sigma"])
        off = np.abs(np.array(part["gain"]) - triad.gain)
        assert (off <= 4.5 * sigma + 1e-12).all()
        assert (np.abs(np.array(part["bias"]) - triad.bias) <= 4.5 * np.array(part["bias_sigma"])).all()
    assert document["data"]["poses"] == POSES
    assert len(document["data"]["sha256"]) == 64
    assert document["fit"]["rank"] == 21
    assert {path.name for path in calibration.iterdir()} >= {"calibration.json", "report.html"}
    assert not [path for path in calibration.iterdir() if path.suffix not in (".json", ".html", ".png")]


def test_json_is_one_document(log, capsys):
    assert main(["calibrate", str(log), "--gravity", "9.80665+-0", "--json"]) == 0
    document = json.loads(capsys.readouterr().out)
    assert document["setup"]["gravity"] == {"value": 9.80665, "sigma": 0.0, "unit": "m/s^2"}


def test_unknown_gravity_widens_the_scale(log, calibration, capsys):
    assert main(["calibrate", str(log), "--json"]) == 0
    document = json.loads(capsys.readouterr().out)
    known = json.loads((calibration / "calibration.json").read_text())
    sigma = np.array(document["accelerometer"]["gain_sigma"])[0, 0]
    narrow = np.array(known["accelerometer"]["gain_sigma"])[0, 0]
    # the scale is proportional to 1/g: σ² grows by (K σ_g / g)²
    assert sigma**2 - narrow**2 == pytest.approx((0.015 / 9.80665) ** 2, rel=0.05)


def test_table_is_printed(log, capsys):
    assert main(["calibrate", str(log), "--gravity", "9.80665"]) == 0
    printed = capsys.readouterr()
    assert "accelerometer" in printed.out and "Error against gravity at rest" in printed.out


def test_compensate(unit, log, calibration, tmp_path):
    out = tmp_path / "out.parquet"
    assert main(["compensate", str(calibration / "calibration.json"), str(log), "-o", str(out)]) == 0
    written = read_recording(out)
    truth = unit[1].stimulus
    error = written.accelerometer.values - truth.specific_force
    assert np.abs(error.mean(axis=0)).max() < 2e-3
    assert written.gyroscope is not None
    assert np.abs((written.gyroscope.values - truth.angular_rate).mean(axis=0)).max() < 2e-4


def test_several_recordings(tmp_path, unit, capsys):
    second, _ = simulate(unit[1].imu, HandHeld(POSES, 2.0), consumer_noise(), seed=77)
    paths = []
    for index, recording in enumerate((unit[0], second)):
        paths.append(str(tmp_path / f"{index}.parquet"))
        write_recording(recording, paths[-1])
    assert main(["calibrate", *paths, "--gravity", "9.80665", "--json"]) == 0
    document = json.loads(capsys.readouterr().out)
    assert document["data"]["poses"] == 2 * POSES
    assert document["data"]["turns"] == 2 * (POSES - 1)


def test_static_noise(tmp_path, log, capsys):
    generator = np.random.default_rng(0)
    time = np.arange(20000) / 100
    still = Recording(
        accelerometer=Signal(time, generator.normal(0, 0.01, (20000, 3)) + [0, 0, 9.8], "m/s^2"),
        gyroscope=Signal(time, generator.normal(0, 1e-3, (20000, 3)), "rad/s"),
    )
    write_recording(still, tmp_path / "static.csv")
    assert (
        main(["calibrate", str(log), "--static", str(tmp_path / "static.csv"), "--gravity", "9.80665", "--json"]) == 0
    )
    json.loads(capsys.readouterr().out)


def test_info(log, capsys):
    assert main(["info", str(log), "--json"]) == 0
    document = json.loads(capsys.readouterr().out)
    assert document["signals"]["accelerometer"]["rate"] == pytest.approx(100)
    assert any(f"{POSES} static poses" in finding for finding in document["findings"])
    assert main(["info", str(log)]) == 0
    assert "100" in capsys.readouterr().out


def test_demo(tmp_path, capsys):
    """The seed hides an effect; the diagnosis names it, and the numbers of the truth stand beside."""
    assert main(["demo", "-o", str(tmp_path / "demo")]) == 0
    printed = " ".join(capsys.readouterr().out.split())
    truth = json.loads((tmp_path / "demo" / "recording.parquet.truth.json").read_text())
    (name,) = truth["accelerometer"]["effects"] | truth["gyroscope"]["effects"]
    assert f"Hidden in this unit was {CATALOGUE[name].title}: " in printed
    found = json.loads((tmp_path / "demo" / "diagnosis.json").read_text(encoding="utf-8"))
    assert found["verdict"] == "effects"
    assert name in {found["effects"][0]["name"], *found["effects"][0]["indistinguishable_from"]}
    assert (tmp_path / "demo" / "report.html").stat().st_size > 10_000


def test_demo_hides_what_is_asked_for(tmp_path, capsys):
    assert main(["demo", "--effect", "accel.size_effect", "-o", str(tmp_path / "demo")]) == 2
    assert "hides one of accel.quadratic" in capsys.readouterr().err
    assert main(["demo", "--seed", "-1", "-o", str(tmp_path / "demo")]) == 2
    assert not (tmp_path / "demo").exists()
    found = {_draw_flaw(seed, None).name for seed in range(40)}
    assert found == set(_HIDDEN)
    assert _draw_flaw(3, "gyro.g_sensitivity").name == "gyro.g_sensitivity"


def test_version_and_usage(capsys):
    assert main(["--version"]) == 0
    assert capsys.readouterr().out.startswith("jaximu ")
    assert main(["calibrate", "--no-such-option"]) == 2
    assert main(["nonsense"]) == 2
    capsys.readouterr()


def still(seconds: float, **changes) -> Recording:
    """A unit at rest in one pose."""
    generator = np.random.default_rng(1)
    count = int(100 * seconds)
    time = np.arange(count) / 100
    accelerometer = Signal(time, generator.normal(0, 0.01, (count, 3)) + [0.1, 0.2, 9.8], "m/s^2")
    return Recording(accelerometer, Signal(time, generator.normal(0, 1e-3, (count, 3)), "rad/s"), **changes)


def test_one_pose(tmp_path, capsys):
    write_recording(still(30), tmp_path / "one.csv")
    message = refused(capsys, 1, "calibrate", str(tmp_path / "one.csv"), "-o", str(tmp_path / "out"))
    assert "one.csv" in message and "1 static pose found" in message and "nine orientations" in message
    assert list((tmp_path / "out").iterdir()) == []


def test_poses_that_do_not_span(tmp_path, capsys):
    """Turns about the vertical leave gravity where it was; two orientations are too few."""
    recording, _ = simulate(draw_imu(1), HandHeld(3, 3.0), consumer_noise(), seed=1)
    write_recording(recording, tmp_path / "few.csv")
    message = refused(capsys, 1, "calibrate", str(tmp_path / "few.csv"))
    assert "few.csv" in message and "do not span" in message and "Record" in message


def edited(log: Path, target: Path, edit) -> str:
    lines = log.read_text().splitlines()
    target.write_text("\n".join(edit(lines)) + "\n")
    return str(target)


def cell(lines: list[str], row: int, column: int, text: str) -> list[str]:
    cells = lines[row - 1].split(",")
    cells[column] = text
    return [*lines[: row - 1], ",".join(cells), *lines[row:]]


BAD = {
    "text": (lambda lines: cell(lines, 22, 1, "oops"), ("22", "accel_x")),
    "backwards": (lambda lines: cell(lines, 31, 0, lines[10].partition(",")[0]), ("31",)),
    "repeated": (lambda lines: cell(lines, 31, 0, lines[29].partition(",")[0]), ("31",)),
    "truncated": (lambda lines: [*lines[:-1], lines[-1][: len(lines[-1]) // 3]], ("4051",)),
    "missing": (lambda lines: [line.rpartition(",")[0] for line in lines], ("gyro_z",)),
    "doubled": (lambda lines: [lines[0].replace("gyro_z", "gyro_y"), *lines[1:]], ("gyro_y",)),
    "unit": (lambda lines: [lines[0].replace("rad/s", "furlong"), *lines[1:]], ("furlong",)),
    "no units": (lambda lines: [lines[0].replace(" [rad/s]", ""), *lines[1:]], ("gyro_x", "--columns")),
    "header only": (lambda lines: lines[:1], ()),
    "constant": (lambda lines: [lines[0], *(cell([line], 1, 3, "9.8")[0] for line in lines[1:])], ("accel_z",)),
    "deg/s as rad/s": (
        lambda lines: [
            lines[0],
            *(
                ",".join([*line.split(",")[:4], *(str(57.29578 * float(v)) for v in line.split(",")[4:])])
                for line in lines[1:]
            ),
        ],
        ("deg/s",),
    ),
}


@pytest.mark.parametrize("name", BAD)
def test_bad_log(name, log, tmp_path, capsys):
    edit, words = BAD[name]
    path = edited(log, tmp_path / "bad.csv", edit)
    message = refused(capsys, 2, "calibrate", path, "-o", str(tmp_path / "out"))
    assert "bad.csv" in message
    for word in words:
        assert word in message, message
    assert list((tmp_path / "out").iterdir()) == []


@pytest.mark.parametrize("content", [b"", b"\x00\x01\xff\xfe" * 500])
def test_not_a_log(content, tmp_path, capsys):
    (tmp_path / "bad.csv").write_bytes(content)
    assert "bad.csv" in refused(capsys, 2, "calibrate", str(tmp_path / "bad.csv"))


def test_missing_files_and_options(log, calibration, tmp_path, capsys):
    assert "nowhere.csv" in refused(capsys, 2, "calibrate", "nowhere.csv")
    assert "LOG is missing" in refused(capsys, 2, "calibrate")
    assert "latitude" in refused(capsys, 2, "calibrate", str(log), "--gravity", "9.8", "--latitude", "450")
    assert "--latitude" in refused(capsys, 2, "calibrate", str(log), "--height", "100")
    assert "98" in refused(capsys, 2, "calibrate", str(log), "--gravity", "98")
    (tmp_path / "file").write_text("")
    assert "file" in refused(capsys, 2, "calibrate", str(log), "-o", str(tmp_path / "file"))
    document = str(calibration / "calibration.json")
    assert "nowhere" in refused(capsys, 2, "compensate", document, str(log), "-o", str(tmp_path / "nowhere" / "x.csv"))
    assert ".xyz" in refused(capsys, 2, "compensate", document, str(log), "-o", str(tmp_path / "x.xyz"))
    assert not (tmp_path / "x.xyz").exists()


@pytest.mark.parametrize(
    ("change", "word"),
    [
        (lambda text: text[: len(text) // 2], "not JSON"),
        (lambda text: text.replace("jaximu.calibration/1", "jaximu.calibration/9"), "schema"),
        (lambda text: text.replace('"gain":', '"gian":', 1), "gain"),
        (lambda text: "[1, 2]", "schema"),
    ],
)
def test_damaged_calibration(change, word, log, calibration, tmp_path, capsys):
    damaged = tmp_path / "calibration.json"
    damaged.write_text(change((calibration / "calibration.json").read_text()))
    message = refused(capsys, 2, "compensate", str(damaged), str(log), "-o", str(tmp_path / "out.csv"))
    assert "calibration.json" in message and word in message
    assert not (tmp_path / "out.csv").exists()


def test_wrong_unit_for_the_calibration(log, calibration, tmp_path, capsys):
    columns = "time [s],accel [count],gyro [rad/s]"
    message = refused(
        capsys, 2, "compensate", str(calibration / "calibration.json"), str(log), "-o", str(tmp_path / "o.csv"),
        "--columns", columns, "--accel-scale", "1 count/(m/s^2)",
    )  # fmt: skip
    assert "count" in message


def process(*arguments: str, **environment: str) -> subprocess.CompletedProcess[str]:
    """Run the command as a user starts it; all warnings are shown."""
    return subprocess.run(
        [sys.executable, "-m", "jaximu", *arguments], capture_output=True, text=True, encoding="utf-8",
        env={**os.environ, "PYTHONWARNINGS": "default", "PYTHONUTF8": "1", **environment},
    )  # fmt: skip


def test_a_process_of_its_own(tmp_path):
    """As a user starts it: no double precision set before, no traceback, results and prose apart."""
    missing = process("calibrate", str(tmp_path / "no.csv"))
    assert missing.returncode == 2
    assert missing.stderr.splitlines()[1:] == [f"jaximu: {tmp_path / 'no.csv'} cannot be read: {os.strerror(2)}."]
    assert missing.stdout == ""


@pytest.mark.parametrize(
    ("arguments", "status"),
    [("--help", 0), ("--version", 0), ("", 2), ("nonsense", 2), ("plan --help", 0), ("calibrate --nonsense", 2),
     ("calibrate", 2), ("check old.json log.csv", 2), ("export", 2)],
)  # fmt: skip
def test_usage_loads_nothing_heavy(arguments, status):
    found = process(*arguments.split(), PYTHONPROFILEIMPORTTIME="1")
    assert found.returncode == status
    loaded = {line.rpartition("|")[2].strip() for line in found.stderr.splitlines() if line.startswith("import time:")}
    assert "jaximu.cli.app" in loaded
    heavy = {"jax", "equinox", "optimistix", "numpy", "scipy", "matplotlib", "pyarrow", "rich"}
    # tyro loads typeguard for the lines that it parses; here that is only the one that lacks nothing but its files.
    assert not loaded & (heavy if arguments.startswith("check") else {*heavy, "typeguard"})


def test_only_the_first_run_compiles(log, calibration):
    """What is computed eagerly would be compiled again by each command."""
    for arguments in (["calibrate", str(log), "--json"], ["consequences", str(calibration / "calibration.json"),
                                                          "--json"]):  # fmt: skip
        first, second = (process(*arguments, JAX_LOG_COMPILES="1") for _ in range(2))
        assert first.returncode == second.returncode == 0 and first.stdout == second.stdout
        compiled = [line for line in second.stderr.splitlines() if "XLA compilation" in line]
        assert not compiled and "jax" in second.stderr


def test_the_library_loads_what_is_used():
    """The four ways and the check stand at the top; none of it is loaded by the import alone."""
    text = "import jaximu, sys; print([name for name in ('jax', 'numpy') if name in sys.modules])"
    done = subprocess.run([sys.executable, "-c", text], capture_output=True, text=True, check=True)
    assert done.stdout == "[]\n"
    assert {"simulate", "read_recording", "calibrate", "diagnose", "check", "compensate"} <= set(jaximu.__all__)
    assert dir(jaximu) == sorted(jaximu.__all__)
    assert all(hasattr(jaximu, name) for name in jaximu.__all__) and not hasattr(jaximu, "nonsense")


def test_stages_say_what_they_take(capsys, monkeypatch):
    for longest, lines in ((0.0, ["planning …", "planning: design 2 of 9, 0 s", "planning: done in 0 s"]),
                           (2.0, ["planning …"])):  # fmt: skip
        monkeypatch.setattr(messages, "_LONG", longest)
        with progress("planning") as report:
            time.sleep(1e-3)
            report("design 2 of 9")
            time.sleep(1e-3)
        assert capsys.readouterr().err.splitlines() == lines


def test_the_overview_shows_every_verb_in_its_own_words(capsys):
    assert main(["--help"]) == 0
    printed = " ".join(capsys.readouterr().out.split())
    for name in VERBS:
        first = command_of(name).__doc__.partition("\n\n")[0]
        assert f"{name} {' '.join(first.split())}" in printed
    assert "did you mean calibrate?" in refused(capsys, 2, "calibate")


def test_caches_that_are_damaged_or_cannot_be_written(log, tmp_path):
    """Slower, never wrong, and not a word of it; what was damaged is replaced."""
    said = "reading …", "calibrating …", "compiling for the first time on this machine; later runs start sooner"

    def calibrate(folder: Path | str, home: Path | str) -> str:
        arguments = "calibrate", str(log), "--method", "accelerometer", "--json"
        done = process(*arguments, XDG_CACHE_HOME=str(folder), HOME=str(home), MPLCONFIGDIR="")
        assert done.returncode == 0
        assert all(line.startswith(said) or "done in" in line for line in done.stderr.splitlines()), done.stderr
        assert (said[2] in done.stderr) == (folder == tmp_path and not damaged)
        return done.stdout

    damaged: dict[Path, bytes] = {}
    whole = calibrate(tmp_path, tmp_path)
    kept = [path for path in (tmp_path / "jaximu").iterdir() if path.name.endswith((".name", ".program", "-cache"))]
    for number, path in enumerate(sorted(kept)):  # not the lock and the times of use that lie beside them
        content = path.read_bytes()
        half = len(content) // 2
        damaged[path] = content[:half] + (b"" if number % 2 else bytes([content[half] ^ 255]) + content[half + 1 :])
        path.write_bytes(damaged[path])
    assert len(damaged) > 2
    assert calibrate(tmp_path, tmp_path) == whole
    assert not [path for path, content in damaged.items() if path.exists() and path.read_bytes() == content]
    (tmp_path / "file").write_text("")
    assert calibrate(tmp_path / "file", tmp_path / "file") == whole


def test_a_cache_that_is_read_only(log, tmp_path):
    if os.name == "nt" or os.geteuid() == 0:
        pytest.skip("this user may write everywhere")
    (tmp_path / "jaximu").mkdir(mode=0o500)
    tmp_path.chmod(0o500)
    done = process("calibrate", str(log), "--method", "accelerometer", "--json", XDG_CACHE_HOME=str(tmp_path),
                   HOME=str(tmp_path), MPLCONFIGDIR="")  # fmt: skip
    assert done.returncode == 0 and "arning" not in done.stderr and "compiling" not in done.stderr
    assert json.loads(done.stdout)["schema"] == "jaximu.calibration/1"


def test_results_as_json_need_no_pictures(log):
    """What draws, shows tables or reads other formats is not loaded for a calibration as JSON."""
    found = process("calibrate", str(log), "--method", "accelerometer", "--json", PYTHONPROFILEIMPORTTIME="1")
    loaded = {line.rpartition("|")[2].strip() for line in found.stderr.splitlines() if line.startswith("import time:")}
    assert found.returncode == 0 and "jax" in loaded
    unwanted = {
        "matplotlib",
        "pandas",
        "jinja2",
        "h5py",
        "rich",
        "scipy.stats",
        "scipy.signal",
        *(
            f"jaximu.{name}"
            for name in ("report", "diagnosis", "simulation.engine", "fleets", "planning", "calibration.thermal")
        ),
    }
    assert not loaded & unwanted
