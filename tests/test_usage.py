"""The command line as a person meets it: overview, help, examples, mistakes, completion, how much it says."""

import inspect
import json
import shlex
import subprocess

import numpy as np
import pytest

from jaximu.cli import main, messages, usage
from jaximu.cli.app import GROUPS, VERBS
from jaximu.cli.options import LogOptions, NoiseOptions
from jaximu.ground.gravity import STANDARD
from jaximu.recordings import write_recording
from jaximu.simulation import consumer_noise, draw_imu, simulate
from jaximu.simulation.protocols import HandHeld


def verb(name):
    return usage.command_of(name)


@pytest.fixture
def log(tmp_path):
    recording, _ = simulate(draw_imu(3), HandHeld(12, 2.0, 1.0), consumer_noise(), rate=50.0, seed=3)
    write_recording(recording, tmp_path / "a log.csv")
    return tmp_path / "a log.csv"


def test_the_overview_groups_all_verbs(capsys):
    assert sorted(name for names in GROUPS.values() for name in names.split()) == sorted(VERBS)
    assert main(["--help"]) == 0
    text = capsys.readouterr().out
    places = [text.index(f"{title}:") for title in GROUPS]
    assert places == sorted(places)
    for word in ("--version", "--completion", "Exit status: 0 done", "jaximu demo"):
        assert word in text
    assert main([]) == 2 and capsys.readouterr().err == text


@pytest.mark.parametrize("name", VERBS)
def test_help_is_grouped_and_has_no_machine_words(name, capsys):
    assert main([name, "--help"]) == 0
    text = capsys.readouterr().out
    for word in ("{None}", "MISSING", "<class", "PosixPath", "default: None", "default: ()", "{{"):
        assert word not in text
    assert max(map(len, text.partition("Examples:")[0].splitlines())) <= 100
    assert text.index("\nOutput:") < text.index("\nExamples:\n") < text.index("Exit status")
    for option in usage.options_of(verb(name)):
        assert option.help, option
        assert option.positional or f"{', '.join(option.names)} " in f"{text.replace(chr(10), ' ')} "


@pytest.mark.parametrize("name", VERBS)
def test_examples_are_command_lines(name, monkeypatch):
    """Each parses: it reaches the verb with the options that it shows."""
    _, _, examples = (inspect.getdoc(verb(name)) or "").partition("Examples:\n")
    lines = examples.strip().splitlines()
    assert lines
    for line in lines:
        program, first, *rest = shlex.split(line)
        assert (program, first) == ("jaximu", name)
        reached = []
        monkeypatch.setattr(verb(name), "run", lambda command, reached=reached: reached.append(command))
        assert main([first, *rest]) == 0, line
        assert len(reached) == 1


@pytest.mark.parametrize(
    ("line", "words"),
    [
        ("calibrate x --gravty 9.8", ("--gravty", "did you mean --gravity?")),
        ("calibrate x --rate fast", ("--rate: 'fast' is not a number",)),
        ("calibrate x --method jiont", ("'jiont'", "'joint'")),
        ("calibrate x --gravity", ("--gravity", "Missing value")),
        ("check", ("CALIBRATION is missing",)),
        ("check a.json -o out", ("LOG is missing",)),
        ("compare", ("CALIBRATION is missing",)),
        ("calibrate --rate 50 -v", ("LOG is missing",)),
        ("compensate a.json a.csv", ("--output OUT is missing",)),
        ("export a.json", ("--to FORMAT is missing",)),
        ("export a.json --to=ros", ("a.json cannot be read",)),
        ("effects a b", ("unexpected: b",)),
        ("calibate x", ("'calibate'", "did you mean calibrate?")),
        ("--completion tcsh", ("'tcsh'", "bash, zsh, fish")),
    ],
)
def test_mistakes_are_answered_in_one_sentence(line, words, capsys):
    assert main(line.split()) == 2
    printed = capsys.readouterr()
    assert printed.out == "" and len(printed.err.splitlines()) == 1 and printed.err.startswith("jaximu: ")
    for word in words:
        assert word in printed.err
    assert "│" not in printed.err and "{None}" not in printed.err


def test_a_value_may_begin_with_a_minus(log, capsys):
    assert main(["info", str(log), "--axes", "-x,-y,z"]) == 0
    assert "--axes -x,-y,z" in capsys.readouterr().out  # the lines that it ends with can be pasted
    for line in (["--axes"], ["--axes", "--json"], ["--axes", "-o"]):
        assert main(["calibrate", str(log), *line]) == 2
        assert "--axes" in capsys.readouterr().err


def test_errors_are_a_document_under_json(tmp_path, capsys):
    (tmp_path / "empty.csv").write_text("")
    for line, status in ((["calibrate", str(tmp_path / "empty.csv"), "--json"], 2), (["check", "--json"], 2)):
        assert main(line) == status
        printed = capsys.readouterr()
        document = json.loads(printed.out)
        assert document["schema"] == "jaximu.error/1" and document["exit_status"] == status
        assert f"jaximu: {document['error']}" in printed.err


def test_how_much_is_said(log, tmp_path, capsys):
    """Quiet: nothing but results. Verbose: every stage with its time. The result is the same."""
    line = ["compensate", str(tmp_path / "calibration.json"), str(log), "-o", str(tmp_path / "out.csv")]
    assert main(["calibrate", str(log), "--method", "accelerometer", "-o", str(tmp_path), "--quiet"]) == 0
    assert capsys.readouterr().err == ""
    assert main(["calibrate", str(log), "--method", "accelerometer", "--json", "-v"]) == 0
    assert "calibrating: done in" in capsys.readouterr().err
    assert main(["calibrate", str(log), "--json", "-q"]) == 0
    printed = capsys.readouterr()
    assert printed.err == "" and json.loads(printed.out)["schema"] == "jaximu.calibration/1"
    assert main([*line, "--quiet"]) == 2 and "gyroscope" in capsys.readouterr().err  # errors are said
    assert main(["info", str(log)]) == 0 and messages.level == 1  # the next run says what it usually says


def test_colours_can_be_switched_off(log, monkeypatch, capsys):
    monkeypatch.setenv("FORCE_COLOR", "1")
    monkeypatch.setenv("TERM", "xterm-256color")
    monkeypatch.setenv("NO_COLOR", "")
    assert main(["calibrate", str(log), "--method", "accelerometer"]) == 0
    assert "\x1b[" in capsys.readouterr().out
    assert main(["calibrate", str(log), "--method", "accelerometer", "--no-color"]) == 0
    assert "\x1b[" not in capsys.readouterr().out


def test_info_ends_with_lines_to_paste(log, capsys):
    """The file's name is quoted, the options that reading took are repeated, and the lines run."""
    text = log.read_text().splitlines()
    bare = log.with_name("no header.csv")
    bare.write_text("\n".join(line.partition(",")[2] for line in text[1:]))
    options = ["--columns", "accel [m/s^2],gyro [rad/s]", "--rate", "50"]
    assert main(["info", str(bare), *options]) == 0
    pasted = [line.strip() for line in capsys.readouterr().out.splitlines() if line.strip().startswith("jaximu ")]
    line = next(shlex.split(each) for each in pasted if each.startswith("jaximu calibrate "))
    assert line == ["jaximu", "calibrate", str(bare), "--columns", options[1], "--rate", "50.0", "-o", "results"]
    assert main([*line[1:-2], "--method", "accelerometer", "--json", "-q"]) == 0


@pytest.mark.parametrize("shell", ["bash", "zsh", "fish"])
def test_completion(shell, capsys):
    assert main(["--completion", shell]) == 0
    script = capsys.readouterr().out
    for word in ("calibrate", "gravity", "heldout"):
        assert word in script
    if shell == "bash":
        ask = 'COMP_WORDS=(jaximu {}); COMP_CWORD={}; _jaximu jaximu "{}"; echo "${{COMPREPLY[@]}}"'
        for words, place, part, expected in (("cal", 1, "cal", "calibrate"), ("plan --eq", 2, "--eq", "--equipment")):
            done = subprocess.run(["bash", "-c", f"{script}\n{ask.format(words, place, part)}"], capture_output=True,
                                  text=True, check=True)  # fmt: skip
            assert done.stdout.strip() == expected


def test_a_recording_at_rest_keeps_its_own_gyroscope(tmp_path):
    random = np.random.default_rng(1)
    paths = [tmp_path / name for name in ("log.csv", "turning.csv", "rest.csv")]
    axes = [f"{sensor}_{axis} [{unit}]" for sensor, unit in (("accel", "m/s^2"), ("gyro", "rad/s")) for axis in "xyz"]
    for path, kept in zip(paths, (axes[:3], axes[3:], axes), strict=True):
        rows = np.column_stack(
            [
                np.arange(200) / 100,
                0.1 * random.standard_normal((200, len(kept))) + [9.81 * ("accel_z" in each) for each in kept],
            ]
        )
        np.savetxt(path, rows, delimiter=",", header=",".join(["time [s]", *kept]), comments="")
    (recording,), rest = LogOptions(gyro_log=paths[1]).read_unit(paths[:1], STANDARD, NoiseOptions(static=paths[2]))
    for read, path, columns in ((recording, paths[1], slice(1, 4)), (rest, paths[2], slice(4, 7))):
        wanted = np.loadtxt(path, delimiter=",", skiprows=1)[:, columns]
        np.testing.assert_allclose(read.gyroscope.values, wanted)
