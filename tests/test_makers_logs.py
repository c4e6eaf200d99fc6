"""`jaximu LOG --yes` on thirty logs of makers and phones: no question in 27, one in the others, a wrong one in none."""

import shlex

import pytest
from dialects import ALL, simulate
from makers_logs import THIRTY, answer

from jaximu.cli import main


@pytest.fixture(scope="module")
def answers(tmp_path_factory):
    folder = tmp_path_factory.mktemp("makers")
    return {name: answer(ALL[name], folder / str(at)) for at, name in enumerate(THIRTY)}


def test_thirty_logs(answers):
    assert len(answers) == 30
    wrong = {name: given for name, given in answers.items() if given.wrong}
    assert wrong == {}
    run = [name for name, given in answers.items() if given.right(ALL[name]) and not given.questions]
    assert len(run) >= 27, sorted(set(answers) - set(run))
    others = [given for name, given in answers.items() if name not in run]
    assert all(given.refused or len(given.questions) == 1 for given in others), others


@pytest.mark.parametrize(
    "name", ["camel case with units", "phyphox in French", "Excel in German: Latin-1, semicolons, decimal commas"]
)
def test_an_accelerometer_under_another_name_is_not_left_out(name, tmp_path, capsys):
    """A gyroscope whose name is known does not make a log of a gyroscope alone."""
    given = answer(ALL[name], tmp_path / "logs")
    assert given.verbs == ("calibrate", "diagnose") and not given.wrong
    (path,) = (tmp_path / "logs").iterdir()
    assert main(["info", str(path)]) == 0
    printed = " ".join(capsys.readouterr().out.split())
    assert "Accelerometer and gyroscope at 100 Hz" in printed and "No accelerometer" not in printed


def test_a_unit_that_the_values_contradict_is_said(tmp_path):
    """A known program's unit is not what the values are in: they are read in theirs, and that is one question."""
    given = answer(ALL["Sensor Logger, AccelerometerUncalibrated.csv in g"], tmp_path / "logs")
    assert given.verbs == ("calibrate",) and not given.wrong
    assert len(given.questions) == 1 and "look like g" in given.questions[0] and "accel_z [g]" in given.questions[0]


def test_info_offers_what_can_be_run_where_units_contradict_the_values(tmp_path, capsys):
    """Its lines carry the columns in the right units, without which every verb refuses."""
    path = ALL["Sensor Logger, AccelerometerUncalibrated.csv in g"].write(tmp_path, simulate("poses", seed=1))
    assert main(["info", str(path)]) == 0
    lines = [line for line in capsys.readouterr().out.splitlines() if "jaximu calibrate" in line]
    assert lines and main([*shlex.split(lines[0])[1:-2], "--json", "-q"]) == 0


def test_a_gyroscope_alone_stays_one(tmp_path, capsys):
    """Where no other columns can be an accelerometer."""
    log = tmp_path / "gyro.csv"
    log.write_text("time [s],gyro_x [rad/s],gyro_y [rad/s],gyro_z [rad/s],volts\n" + "\n".join(
        f"{row / 100},{row % 7 / 1e3},{row % 5 / 1e3},{row % 3 / 1e3},{row % 11}" for row in range(400)
    ))  # fmt: skip
    assert main(["info", str(log)]) == 0
    assert "No accelerometer" in capsys.readouterr().out
