"""Bad input to the readers and writers: one plain sentence naming file, row or column, and the right exit status."""

import os
import re
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from jaximu.cli.app import main
from jaximu.ground.atomic import atomic_write
from jaximu.ground.errors import InputError, command_line
from jaximu.recordings import write_recording
from jaximu.recordings.readers import ReadOptions, read_recording
from jaximu.recordings.recording import Recording, Signal

HEADER = "time [s],accel_x [m/s^2],accel_y [m/s^2],accel_z [m/s^2],gyro_x [rad/s],gyro_y [rad/s],gyro_z [rad/s]"


def rows(count: int = 50) -> list[str]:
    generator = np.random.default_rng(0)
    values = generator.normal([0.1, 0.2, 9.8, 0.0, 0.0, 0.0], 0.01, (count, 6))
    return [f"{at / 100:.2f}," + ",".join(f"{each:.6f}" for each in row) for at, row in enumerate(values)]


def write(path: Path, lines: list[str], header: str = HEADER) -> Path:
    path.write_text("\n".join([header, *lines]) + "\n")
    return path


def refusal(path: Path | str, options: ReadOptions | None = None, gyro_log: Path | None = None, **needs: bool) -> str:
    """The message that reading is refused with."""
    with pytest.raises(InputError) as caught:
        read_recording(path, gyro_log, options, **needs)
    with command_line():  # as the command line says it
        message = str(caught.value)
    assert Path(path).name in message or "--" in message
    assert "\n" not in message
    assert caught.value.exit_status == 2
    return message


def cell(lines: list[str], row: int, column: int, text: str) -> list[str]:
    """The lines with one cell replaced; `row` as a person counts the file's lines, the header being 1."""
    cells = lines[row - 2].split(",")
    cells[column] = text
    return [*lines[: row - 2], ",".join(cells), *lines[row - 1 :]]


# --- the file


@pytest.mark.parametrize("content", [b"", b"\n \n"])
def test_empty(tmp_path, content):
    (tmp_path / "log.csv").write_bytes(content)
    assert "is empty" in refusal(tmp_path / "log.csv")


def test_only_comments(tmp_path):
    (tmp_path / "log.csv").write_text("# nothing\n")
    assert "holds no data" in refusal(tmp_path / "log.csv")


def test_header_only(tmp_path):
    assert "header but no rows" in refusal(write(tmp_path / "log.csv", []))


def test_one_row(tmp_path):
    assert "holds 1 row of data" in refusal(write(tmp_path / "log.csv", rows(1)))


def test_prose(tmp_path):
    (tmp_path / "log.csv").write_text("Dear reader,\nthis is\nno recording, but\na letter.\n")
    assert "no table of numbers" in refusal(tmp_path / "log.csv")


@pytest.mark.parametrize("start", [b"", b"PAR1", b"PK\x03\x04", b"MATLAB 5.0 MAT-file", b"\x89HDF\r\n\x1a\n"])
def test_binary_garbage(tmp_path, start):
    path = tmp_path / "log.bin"
    path.write_bytes(start + np.random.default_rng(1).bytes(4096))
    message = refusal(path)
    assert ("cut off or damaged" if start else "binary data") in message


@pytest.mark.parametrize("suffix", [".parquet", ".npz", ".mat"])
def test_cut_off_binary_formats(tmp_path, suffix):
    whole = tmp_path / f"whole{suffix}"
    write_recording(
        Recording(Signal(np.arange(500) / 100, np.random.default_rng(0).normal(9, 1, (500, 3)), "m/s^2")), whole
    )
    path = tmp_path / f"log{suffix}"
    path.write_bytes(whole.read_bytes()[:-800])
    assert "cut off or damaged" in refusal(path)


def test_missing_file_folder_and_locked_file(tmp_path):
    assert "cannot be read: No such file" in refusal(tmp_path / "log.csv")
    assert "is a folder" in refusal(tmp_path)
    (tmp_path / "text").write_text("x")
    assert "cannot be read" in refusal(tmp_path / "text" / "log.csv")
    if os.geteuid() != 0:  # nothing is locked for root
        path = write(tmp_path / "locked.csv", rows())
        path.chmod(0)
        assert "cannot be read" in refusal(path)


# --- rows and cells


def test_cut_off_last_row(tmp_path):
    message = refusal(write(tmp_path / "log.csv", [*rows(), "0.50,0.1,0.2"]))
    assert re.search(r"log\.csv, row 52: holds 3 cells where the others hold 7.*cut off", message)


@pytest.mark.parametrize("row", [2, 3, 30])
def test_ragged_row(tmp_path, row):
    lines = rows()
    lines[row - 2] += ",1.0"
    assert f"row {row}: holds 8 cells" in refusal(write(tmp_path / "log.csv", lines))
    lines[row - 2] = "1.0,2.0"
    assert f"row {row}: holds 2 cells" in refusal(write(tmp_path / "log.csv", lines))


def test_ragged_first_row_without_header(tmp_path):
    lines = [line.replace(",", " ") for line in rows()]
    (tmp_path / "log.txt").write_text("\n".join(["0 1 2", *lines]))
    assert "row 1: holds 3 cells" in refusal(tmp_path / "log.txt")


@pytest.mark.parametrize(
    ("text", "said"),
    [("nan", "empty or NaN"), ("", "empty or NaN"), ("inf", "infinite"), ("-inf", "infinite"), ("1e300", "too large")],
)
@pytest.mark.parametrize(("column", "name"), [(2, "accel_y"), (6, "gyro_z")])
def test_not_finite(tmp_path, text, said, column, name):
    message = refusal(write(tmp_path / "log.csv", cell(rows(), 20, column, text)))
    assert re.search(rf"log\.csv, row 20: column '{name} .*{said}", message)


@pytest.mark.parametrize("row", [2, 20])
def test_missing_stamp(tmp_path, row):
    assert f"row {row}" in refusal(write(tmp_path / "log.csv", cell(rows(), row, 0, "nan")))


@pytest.mark.parametrize("row", [2, 20, 51])
def test_text_in_a_cell(tmp_path, row):
    message = refusal(write(tmp_path / "log.csv", cell(rows(), row, 3, "oops")))
    assert re.search(rf"row {row}: column 'accel_z .*'oops', which is not a number", message)


def test_row_numbers_count_the_lines_of_the_file(tmp_path):
    lines = cell(rows(), 20, 3, "inf")
    text = ["# a comment", "logger,7", "", HEADER, *lines[:10], "", "# another", *lines[10:]]
    (tmp_path / "log.csv").write_text("\n".join(text))
    assert "row 25: column 'accel_z" in refusal(tmp_path / "log.csv")


@pytest.mark.parametrize(("stamp", "said"), [("0.17", "repeats"), ("0.05", "goes back by 0.12 s")])
def test_time_that_does_not_rise(tmp_path, stamp, said):
    message = refusal(write(tmp_path / "log.csv", cell(rows(), 20, 0, stamp)))
    assert re.search(rf"log\.csv, row 20: the time stamp {said}", message)


def test_parquet_rows_are_counted_from_one(tmp_path):
    columns = {name: np.linspace(0.1, 9.9, 20) for name in HEADER.split(",")}
    columns["accel_y [m/s^2]"] = np.where(np.arange(20) == 6, np.nan, columns["accel_y [m/s^2]"])
    pq.write_table(pa.table(columns), tmp_path / "log.parquet")
    assert "row 7: column 'accel_y" in refusal(tmp_path / "log.parquet")


# --- columns and units


def test_missing_axis(tmp_path):
    header = HEADER.replace("accel_y [m/s^2]", "other")
    assert "column accel_y is missing beside accel_x, accel_z" in refusal(write(tmp_path / "log.csv", rows(), header))


def test_missing_accelerometer(tmp_path):
    header = re.sub(r"accel_(.)", r"foo_\1", HEADER)
    message = refusal(write(tmp_path / "log.csv", rows(), header))
    assert re.search(r"columns accel_x, accel_y, accel_z are missing; it has .*'foo_x \[m/s\^2\]'.*--columns", message)


def test_a_log_whose_header_names_all_that_it_has_gets_no_empty_guess(tmp_path, capsys):
    path = write(tmp_path / "log.csv", rows())
    assert main(["magnetometer", str(path)]) == 2
    said = capsys.readouterr().err
    assert said.rstrip().endswith("with --columns; a separate file is given with --mag-log.")


def test_missing_gyroscope_only_where_needed(tmp_path):
    header = re.sub(r"gyro_(.) \[rad/s\]", r"foo_\1", HEADER)
    path = write(tmp_path / "log.csv", rows(), header)
    assert read_recording(path).gyroscope is None
    assert re.search(r"gyro_x.*are missing.*--gyro-log", refusal(path, require_gyroscope=True))


def test_doubled_column(tmp_path):
    for double in ("accel_x [m/s^2]", "acc_x [g]"):
        message = refusal(write(tmp_path / "log.csv", rows(), HEADER.replace("gyro_x [rad/s]", double)))
        assert re.search(r"'accel_x .* and 'acc.*are both accel_x.*--columns", message)


def test_unknown_unit(tmp_path):
    message = refusal(write(tmp_path / "log.csv", rows(), HEADER.replace("rad/s", "radd/s")))
    assert re.search(r"log\.csv, column 'gyro_x': unknown unit 'radd/s'.*rad/s", message)


def test_unit_of_another_quantity(tmp_path):
    message = refusal(write(tmp_path / "log.csv", rows(), HEADER.replace("m/s^2", "deg")))
    assert re.search(r"column 'accel_x'.*'deg' is one of angle", message)


def answered(message: str, option: str = "--columns") -> str:
    """The offered columns, the gyroscope's unit filled in: at rest physics cannot know it."""
    offered = re.search(rf'{option} "(.*?)"', message)
    assert offered is not None
    assert "gyro [?]" in offered[1] and "deg/s or rad/s?" in message
    return offered[1].replace("?", "rad/s")


def test_no_units_prints_a_line_that_works(tmp_path):
    path = write(tmp_path / "log.csv", rows(), re.sub(r" \[.*?\]", "", HEADER))
    message = refusal(path)
    assert "column 'time' states no unit" in message
    assert len(read_recording(path, options=ReadOptions(columns=answered(message))).accelerometer) == 50


def test_no_names_prints_a_line_that_works(tmp_path):
    path = tmp_path / "log.txt"
    path.write_text("\n".join(line.replace(",", "  ") for line in rows()))
    message = refusal(path)
    assert "no column names (7 columns)" in message
    assert read_recording(path, options=ReadOptions(columns=answered(message))).gyroscope is not None


def test_mixed_units_in_a_triad(tmp_path):
    assert "mix raw counts" in refusal(
        write(tmp_path / "log.csv", rows(), HEADER.replace("accel_x [m/s^2]", "accel_x [count]"))
    )


def test_columns_of_another_count(tmp_path):
    message = refusal(write(tmp_path / "log.csv", rows()), ReadOptions(columns="time [s],accel [g]"))
    assert "names 4 columns, the file has 7" in message


def test_no_time_column(tmp_path):
    path = write(tmp_path / "log.csv", rows(), HEADER.replace("time [s]", "n"))
    assert "--rate HZ" in refusal(path)
    assert "--rate" in refusal(path, ReadOptions(rate=0.0))
    assert "--rate" in refusal(path, ReadOptions(rate=float("nan")))


def test_constant_channel(tmp_path):
    lines = rows()
    for row in range(2, 52):
        lines = cell(lines, row, 5, "0.25")
    assert re.search(r"log\.csv: column 'gyro_y .*never changes", refusal(write(tmp_path / "log.csv", lines)))


def test_empty_gyroscope(tmp_path):
    lines = [",".join([*line.split(",")[:4], "", "", ""]) for line in rows()]
    assert "column 'gyro_x [rad/s]' is empty" in refusal(write(tmp_path / "log.csv", lines))


def test_units_that_cannot_be(tmp_path):
    message = refusal(write(tmp_path / "log.csv", rows(), HEADER.replace("m/s^2", "g")))
    assert re.search(r"accel_x.*m/s², stated as g", message)


def test_counts_without_a_gyroscope_scale(tmp_path):
    path = write(tmp_path / "log.csv", rows(), HEADER.replace("rad/s", "count"))
    assert re.search(r"raw counts.*--gyro-scale", refusal(path))


def test_a_scale_for_physical_units(tmp_path):
    path = write(tmp_path / "log.csv", rows())
    assert "--gyro-scale is for raw counts" in refusal(path, ReadOptions(gyro_scale="1/6258"))
    assert "--accel-offset is for raw counts" in refusal(path, ReadOptions(accel_offset="3"))


def test_bad_axes_are_told_before_reading(tmp_path):
    assert "axis map" in refusal("--", ReadOptions(axes="x,y,q"))


# --- two files


def split(folder: Path, later: float = 0.0) -> tuple[Path, Path]:
    cells = [line.split(",") for line in rows()]
    accel, gyro = folder / "a.txt", folder / "g.txt"
    accel.write_text("\n".join(" ".join(row[:4]) for row in cells))
    gyro.write_text("\n".join(" ".join([str(float(row[0]) + later), *row[4:]]) for row in cells))
    return accel, gyro


def test_two_files_that_do_not_overlap(tmp_path):
    accel, gyro = split(tmp_path, 100.0)
    message = refusal(accel, ReadOptions(columns="time [s],accel [m/s^2],gyro [rad/s]"), gyro)
    assert re.search(r"a\.txt and .*g\.txt.*do not overlap in time", message)


def test_two_files_without_names(tmp_path):
    accel, gyro = split(tmp_path)
    first = re.search(r'a\.txt.*--columns "(.*?)"', refusal(accel, None, gyro))
    assert first is not None
    message = refusal(accel, ReadOptions(columns=first[1]), gyro)
    assert gyro.name in message
    second = answered(message, "--gyro-columns")
    read_recording(accel, gyro, ReadOptions(columns=first[1], gyro_columns=second))


def test_second_file_without_a_gyroscope(tmp_path):
    accel, gyro = split(tmp_path)
    options = ReadOptions(columns="time [s],accel [m/s^2]", gyro_columns="time [s],accel [m/s^2]")
    with pytest.raises(InputError, match=r"g\.txt: columns gyro_x, gyro_y, gyro_z are missing"):
        read_recording(accel, gyro, options)


# --- output


def test_unwritable_output(tmp_path):
    recording = read_recording(write(tmp_path / "log.csv", rows()))
    (tmp_path / "file").write_text("x")
    for path in (tmp_path / "file" / "out.csv", tmp_path / "missing" / "out.csv"):
        with pytest.raises(InputError, match=r"out\.csv: cannot be written"):
            write_recording(recording, path)
    (tmp_path / "folder.csv").mkdir()
    with pytest.raises(InputError, match="it is a folder"):
        write_recording(recording, tmp_path / "folder.csv")
    with pytest.raises(InputError, match=r"out\.docx: the suffix must be one of \.csv"):
        write_recording(recording, tmp_path / "out.docx")
    with pytest.raises(InputError, match="cannot be written"), atomic_write(tmp_path / "file" / "out.json"):
        raise AssertionError("the body must not run")
    assert sorted(each.name for each in tmp_path.iterdir()) == ["file", "folder.csv", "log.csv"]
