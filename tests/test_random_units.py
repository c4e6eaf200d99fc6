"""Forty random units, every verb and chain among them: what a user gets is sound, whatever is asked of whichever unit.

Two thousand of them: benchmarks/results/random_units.md. A draw that fails is run again by
`python tests/random_units.py --short SEED`.
"""

import pytest
import random_units
import written_files

SEEDS = (
    7,
    8,
    15,
    17,
    19,
    20,
    33,
    36,
    44,
    46,
    47,
    48,
    49,
    50,
    51,
    52,
    53,
    55,
    64,
    69,
    70,
    75,
    83,
    93,
    98,
    130,
    148,
    150,
    160,
    164,
    167,
    178,
    179,
    189,
    472,
    493,
    507,
    594,
    978,
    1138,
)
"""Every verb and chain once, by the draws that cost least among those that differ: all formats, counts and units,
gyroscope or none, several recordings, hidden effects, artefacts; `jaximu demo` has separate tests."""
LONG = {7, 8, 20, 46, 49, 55, 75, 83, 93, 179, 189, 493, 507, 594, 978, 1138}
"""What takes longest of them, and what it asks has tests of its own: `-m slow`."""


def test_every_verb_and_chain_is_drawn():
    names = [random_units.recipe_of(seed).__name__ for seed in SEEDS]
    assert len(names) == 40 and {*names, "demo"} == {recipe.__name__ for recipe in random_units.RECIPES}


@pytest.mark.parametrize("seed", [pytest.param(seed, marks=pytest.mark.slow if seed in LONG else ()) for seed in SEEDS])
def test_a_random_unit(seed, tmp_path):
    draw = random_units.run_draw(seed, tmp_path / "draw", short=True)
    failures = [f"{failure.kind}: {failure.run}: {failure.text}" for failure in draw.failures]
    assert not failures, "\n".join([draw.line, "jaximu " + " ".join(draw.last), *failures])


@pytest.mark.parametrize(
    ("name", "text", "fault"),
    [
        ("a.json", '{"schema": "jaximu.plan/1", "value": NaN}', "NaN"),
        ("a.json", '{"schema": "jaximu.plan/1", "digest": "0", "value": 1}', "digest"),
        ("calibration.json", '{"schema": "jaximu.calibration/1"}', "does not load"),
        ("report.html", '<html><img src="poses.png"></html>', "poses.png"),
        ("report.html", "<html>x = nan m/s²</html>", "says nan"),
        ("report.html", "<html>cut", "cut off"),
        ("a.png", "no picture", "no PNG"),
        ("imu.yaml", "accelerometer_noise_density: .nan", "nan"),
        ("a.csv", "x,y\n1,2\n3\n", "cells"),
        ("a.csv", "x,y\n1,nan\n", "nan"),
        ("a.h", "", "empty"),
    ],
)
def test_what_is_wrong_with_a_file_is_seen(name, text, fault, tmp_path):
    (tmp_path / name).write_text(text, encoding="utf-8")
    (found,) = written_files.faults_of_files(tmp_path, (name,))
    assert fault in found


def test_files_that_differ_from_what_was_printed_are_seen(tmp_path):
    printed = {"schema": "jaximu.plan/1", "value": [1.0, 2.0], "seconds": 3.0}
    (tmp_path / "plan.json").write_text('{"schema": "jaximu.plan/1", "value": [1.0, 2.0], "seconds": 4.0}')
    assert not written_files.disagreement(tmp_path, ("plan.json",), printed)
    (tmp_path / "plan.json").write_text('{"schema": "jaximu.plan/1", "value": [1.0, 2.1], "seconds": 3.0}')
    (found,) = written_files.disagreement(tmp_path, ("plan.json",), printed)
    assert "value[1]" in found
