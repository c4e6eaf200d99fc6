"""The unit table and column names."""

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from jaximu.ground.errors import InputError
from jaximu.ground.units import BASE_UNITS, find_unit, parse_column, unit


@pytest.mark.parametrize(
    ("text", "quantity", "factor"),
    [
        ("m/s^2", "acceleration", 1.0),
        ("m/s²", "acceleration", 1.0),
        ("g", "acceleration", 9.80665),
        ("mg", "acceleration", 9.80665e-3),
        ("ug", "acceleration", 9.80665e-6),
        ("dps", "angular rate", math.pi / 180.0),
        ("°/s", "angular rate", math.pi / 180.0),
        ("mdps", "angular rate", math.pi / 180e3),
        ("deg/h", "angular rate", math.pi / 648e3),
        ("°/min", "angular rate", math.pi / 10800),
        ("µs", "time", 1e-6),
        ("ns", "time", 1e-9),
        ("G", "magnetic field", 100.0),
        ("mG", "magnetic field", 0.1),
        ("deg", "angle", math.pi / 180.0),
        ("LSB", "raw count", 1.0),
        ("RAD/S", "angular rate", 1.0),
    ],
)
def test_known_units(text, quantity, factor):
    found = unit(text)
    assert found.quantity == quantity
    assert found.factor == pytest.approx(factor, rel=1e-15)
    assert found.base == BASE_UNITS[quantity]


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("K", 273.15),
        ("degF", 32.0),
        ("degC", 0.0),
        ("°C", 0.0),
        ("count/340+36.53", -12420.2),
        ("LSB / 256 − 25", 6400.0),
    ],
)
def test_temperatures_have_an_offset(text, value):
    found = unit(text)
    assert found.factor * value + found.offset == pytest.approx(0.0, abs=1e-12)


@pytest.mark.parametrize(
    ("text", "plain"),
    [("m s^-2", "m/s^2"), ("m*s^-2", "m/s^2"), ("m·s⁻²", "m/s^2"), ("rad s-1", "rad/s"), ("rad·s⁻¹", "rad/s"),
     ("rad*s**-1", "rad/s"), ("deg h^-1", "deg/h"), ("mm s^-2", "mm/s^2"), ("° s−1", "deg/s"),
     ("meters/second^2", "m/s^2"), ("metres per second squared", "m/s^2"), ("м/с²", "m/s^2"), ("º/sec", "deg/s"),
     ("degrees per second", "deg/s"), ("Grad/s", "deg/s"), ("рад/с", "rad/s")],
)  # fmt: skip
def test_a_quotient_written_as_a_product(text, plain):
    assert unit(text) == unit(plain)


@pytest.mark.parametrize("text", ["m s^-3", "rad s^-2", "g s^-1", "s^-1", "m s"])
def test_products_that_are_no_unit_of_ours(text):
    assert find_unit(text) is None


def test_letter_case_is_kept_where_it_matters():
    assert unit("mg") != unit("mG")
    assert find_unit("KELVIN") == unit("K")
    assert find_unit("parsec") is None


def test_unknown_unit_names_file_column_and_neighbours():
    with pytest.raises(InputError, match=r"log\.csv.*'gyro_x'.*'degs/s'.*deg/s"):
        unit("degs/s", "angular rate", file="log.csv", column="gyro_x")


def test_unit_of_another_quantity_is_refused():
    with pytest.raises(InputError, match=r"'accel_x'.*'uT'.*magnetic field.*acceleration"):
        unit("uT", ("acceleration", "raw count"), column="accel_x")


def test_the_quantity_decides_where_the_letters_do_not():
    assert unit("G", ("acceleration", "raw count")).name == "g"
    assert unit("G", "magnetic field").name == "G"
    assert unit("°", "temperature").name == "degC"


def test_a_number_scales_a_unit():
    assert unit("100 us", "time").factor == pytest.approx(1e-4)
    assert unit("0.5 mg", "acceleration").factor == pytest.approx(0.5e-3 * 9.80665)


@pytest.mark.parametrize(
    ("text", "name", "stated"),
    [
        ("gyroADC[0]", "gyroADC 0", None),
        ("Acceleration (X)", "Acceleration X", None),
        ("X Accel [x8004]", "X Accel", None),
        ("accel_x [m/s^2]", "accel_x", "m/s^2"),
        (" accel_x[g] ", "accel_x", "g"),
        ("Acc_x (g)", "Acc_x", "g"),
        ("131 (deg/s)", "131", "deg/s"),
        ("gyro_x", "gyro_x", None),
        ("gyro_x []", "gyro_x", None),
        ("", "", None),
    ],
)
def test_parse_column(text, name, stated):
    assert parse_column(text) == (name, stated)


@given(st.text())
def test_parse_column_takes_any_text(text):
    name, stated = parse_column(text)
    assert isinstance(name, str)
    assert stated != ""
