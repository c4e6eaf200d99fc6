"""Local gravity."""

import pytest

from jaximu.cli.options import GravityOptions
from jaximu.ground.errors import InputError
from jaximu.ground.gravity import STANDARD, LocalGravity, parse_gravity, wgs84_gravity


def test_standard_gravity_spreads_over_the_earth():
    assert (STANDARD.value, STANDARD.sigma) == (9.80665, 0.015)


@pytest.mark.parametrize(
    ("text", "value", "sigma"),
    [
        ("9.81744", 9.81744, 0.5e-5 / 3**0.5),
        ("9.81", 9.81, 0.005 / 3**0.5),
        ("9.80665+-0", 9.80665, 0.0),
        ("9.81 +- 0.001", 9.81, 0.001),
        ("9.81±1e-3", 9.81, 0.001),
        ("9.81+/-0.02", 9.81, 0.02),
    ],
)
def test_parse(text, value, sigma):
    assert parse_gravity(text) == LocalGravity(value, sigma)


@pytest.mark.parametrize("text", ["", "g", "9.81+-", "9.81+-0.1+-0.2", "nan", "9.81+-nan", "981", "1", "9.81+--0.1"])
def test_bad_gravity(text):
    with pytest.raises(InputError, match=r"gravity"):
        parse_gravity(text)


@pytest.mark.parametrize(
    ("latitude", "expected"),
    [(0.0, 9.7803253359), (90.0, 9.8321849379), (-90.0, 9.8321849379), (45.0, 9.80619777)],
)
def test_wgs84_on_the_ellipsoid(latitude, expected):
    """Equator and poles are the defining values of the ellipsoid."""
    assert wgs84_gravity(latitude).value == pytest.approx(expected, abs=2e-9)


def test_wgs84_falls_with_height():
    """The free-air gradient is 0.3086 mGal per metre."""
    fall = wgs84_gravity(45.0).value - wgs84_gravity(45.0, 1000.0).value
    assert fall == pytest.approx(3.086e-3, rel=2e-3)
    assert wgs84_gravity(45.0).sigma == 5e-4


@pytest.mark.parametrize(("latitude", "height"), [(91.0, 0.0), (-90.1, 0.0), (float("nan"), 0.0), (0.0, 1e6)])
def test_wgs84_range(latitude, height):
    with pytest.raises(InputError, match=r"latitude|height"):
        wgs84_gravity(latitude, height)


def test_a_stated_gravity_keeps_the_latitude_for_the_rotation_of_the_earth():
    assert GravityOptions("9.8105+-0.0002", 48.1).value() == LocalGravity(9.8105, 0.0002, 48.1)
    assert GravityOptions(None, 48.1, 500.0).value() == wgs84_gravity(48.1, 500.0)
