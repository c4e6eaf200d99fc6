"""Numbers and units as a person reads them: one way everywhere."""

import math
import re

import pytest
from hypothesis import given
from hypothesis import strategies as st

from jaximu.ground.quantities import (
    Z95,
    change,
    number,
    probability,
    readable,
    size,
    unit_text,
    with_interval,
    with_intervals,
)

FLOATS = st.floats(min_value=1e-12, max_value=1e12)
RAISED = str.maketrans("⁻⁰¹²³⁴⁵⁶⁷⁸⁹−", "-0123456789-")


def read(text: str) -> float:
    """The number that a text says."""
    mantissa, _, power = text.translate(RAISED).partition("·10")
    return float(mantissa) * 10.0 ** int(power or 0)


@given(value=FLOATS, digits=st.integers(2, 6), sign=st.sampled_from([-1, 1]))
def test_numbers_are_read_back_to_their_digits(value, digits, sign):
    assert read(number(sign * value, digits)) == pytest.approx(sign * value, rel=0.51 * 10.0 ** (1 - digits))
    assert "e" not in number(value, digits)


@given(value=st.floats(-1e6, 1e6), sigma=st.floats(1e-9, 1e3))
def test_value_and_interval_share_decimals_and_unit(value, sigma):
    text = with_interval(value, sigma, "mm/s²")
    found = re.fullmatch(r"\(?([−\d.]+) ± ([\d.]+)\)?(·10[⁻⁰¹²³⁴⁵⁶⁷⁸⁹]+)? mm/s²", text)
    assert found, text
    value_text, half_text, power = found[1], found[2], found[3] or ""
    assert len(value_text.partition(".")[2]) == len(half_text.partition(".")[2])
    assert read(half_text + power) == pytest.approx(Z95 * sigma, rel=0.06)  # two digits
    assert abs(read(value_text + power) - value) <= 0.06 * Z95 * sigma


@pytest.mark.parametrize(
    ("value", "unit", "text"),
    [
        (0.0016, "m/s^2", "1.60 mm/s²"),
        (8.2e-5, "rad/s", "0.00470 °/s"),
        (0.49, "rad", "28.1°"),
        (9.81, "m/s^2", "9.81 m/s²"),
        (3e-6, "m/s^2", "3.00 µm/s²"),
        (48.2, "uT", "48.2 µT"),
        (0.27, "deg/s", "0.270 °/s"),
        (-0.02, "m/s^2", "−20.0 mm/s²"),
        (0.0021, "(m/s^2)/K", "2.10 (mm/s²)/K"),
        (2e-4, "(rad/s)/(m/s^2)", "0.0115 (°/s)/(m/s²)"),
        (3e-4, "(m/s^2)/(m/s^2)^2", "0.000300 1/(m/s²)"),
        (1.48e-5, "(m/s^2)/(m/s^2)^2", "1.48·10⁻⁵ 1/(m/s²)"),
    ],
)
def test_units_are_those_a_person_compares(value, unit, text):
    assert size(value, unit) == text


@pytest.mark.parametrize(
    ("unit", "printed"),
    [
        ("m/s^2", "m/s²"),
        ("deg/h/sqrt(h)", "°/h/√h"),
        ("ug/sqrt(Hz)", "µg/√Hz"),
        ("deg/sqrt(h)", "°/√h"),
        ("1", ""),
        ("(m/s^2)/(m/s^2)", ""),
        ("(m/s^2)/(m/s^2)^3", "1/(m/s²)²"),
        ("(rad/s)/(rad/s)/s", "1/s"),
        ("(rad/s)/(rad/s)^2", "1/(rad/s)"),
        ("(rad/s)/(m/s^2)", "(rad/s)/(m/s²)"),
        ("output/(rad/s)^4", "output/(rad/s)⁴"),
    ],
)
def test_typography_of_units(unit, printed):
    assert unit_text(unit) == printed


def test_several_values_share_a_unit():
    assert with_intervals([0.002, 1e-4], [1e-4, 1e-5], "m/s^2") == ["2.00 ± 0.20 mm/s²", "0.100 ± 0.020 mm/s²"]
    assert change(0.0111, 6.7e-4, "m/s^2") == "11.1 → 0.670 mm/s²" and change(2.0, 0.0, "rad") == "115 → 0°"


@given(value=FLOATS)
def test_prefixes_keep_accelerations_near_one(value):
    factor, unit = readable("m/s^2", value)
    assert {"m/s²": 1.0, "mm/s²": 1e3, "µm/s²": 1e6}[unit] == factor
    assert value * factor >= 0.1 or unit == "µm/s²"


def test_a_probability_is_never_zero():
    assert probability(0.0) == "< 10⁻³⁰⁰" and probability(math.ldexp(1, -1070)) == "< 10⁻³⁰⁰"
    assert probability(0.031) == "= 0.031" and probability(7.3e-249) == "= 7.3·10⁻²⁴⁹"
