"""The Earth's field of place and date: against the published test values of the World Magnetic Model."""

import sys
from datetime import date

import pytest

from jaximu.ground.errors import InputError
from jaximu.ground.magnetic_field import FieldStrength, world_magnetic_model

DAYS = {2020.0: date(2020, 1, 1), 2022.5: date(2022, 7, 2), 2025.0: date(2025, 1, 1), 2027.5: date(2027, 7, 2)}
# year, height (km), latitude, longitude (deg), F (nT), I (deg): NOAA/NCEI, WMM2020 and WMM2025 test values
PUBLISHED = [
    (2020.0, 0, 80, 0, 55000.1, 83.14), (2020.0, 0, 0, 120, 41104.9, -15.42), (2020.0, 0, -80, 240, 55120.6, -72.20),
    (2020.0, 100, 80, 0, 52802.0, 83.19), (2022.5, 0, 0, 120, 41130.5, -15.24), (2022.5, 0, -80, 240, 54912.1, -72.09),
    (2022.5, 100, -80, 240, 52235.4, -72.27), (2025.0, 0, 80, 0, 55178.5, 83.21), (2025.0, 0, 0, 120, 41064.3, -14.93),
    (2025.0, 0, -80, 240, 54698.2, -72.00), (2027.5, 0, 80, 0, 55253.9, 83.24), (2027.5, 0, 0, 120, 41036.9, -14.65),
    (2027.5, 100, 0, 120, 39007.4, -14.81), (2027.5, 100, -80, 240, 51825.7, -72.10),
]  # fmt: skip


@pytest.mark.parametrize(("year", "height", "latitude", "longitude", "strength", "dip"), PUBLISHED)
def test_published_values(year, height, latitude, longitude, strength, dip):
    found = world_magnetic_model(latitude, longitude, DAYS[year], 1e3 * height)
    assert found.value == pytest.approx(strength / 1e3, abs=2e-4)  # noon of the second of July is the middle of a year
    assert found.dip == pytest.approx(dip, abs=6e-3)
    assert found.sigma >= 0.138 and found.dip_sigma >= 0.20  # the error model of WMM2025: 138 nT and 0.20°
    assert "outdated" not in found.note and f"WMM{2020 if year < 2025 else 2025}" in found.note


def test_a_set_meets_its_successor_within_the_uncertainty():
    """What the error budget states holds where two sets meet, all over the Earth."""
    for latitude in range(-75, 90, 30):
        for longitude in range(0, 360, 60):
            for year in (2015, 2020, 2025):
                before, after = (
                    world_magnetic_model(latitude, longitude, day) for day in (date(year - 1, 12, 31), date(year, 1, 1))
                )
                assert abs(before.value - after.value) < 2 * after.sigma
                assert abs(before.dip - after.dip) < 2 * after.dip_sigma


def test_an_outdated_set_is_told():
    inside, outdated = (world_magnetic_model(52.5, 13.4, date(year, 6, 1)) for year in (2029, 2033))
    assert "outdated since 2030" in outdated.note and "WMM2025" in outdated.note
    assert outdated.sigma > inside.sigma + 0.1 and outdated.dip_sigma > inside.dip_sigma + 0.1
    for year in (2009, 2041):
        with pytest.raises(InputError, match=f"no field for {year}-06-01"):
            world_magnetic_model(52.5, 13.4, date(year, 6, 1))


def test_bad_input(monkeypatch):
    with pytest.raises(InputError, match="not on the Earth"):
        world_magnetic_model(95.0, 0.0, date(2026, 1, 1))
    with pytest.raises(InputError, match="not the Earth's"):
        FieldStrength(0.5)
    with pytest.raises(InputError, match="it lies between -90 and 90"):
        FieldStrength(48.0, dip=120.0)
    monkeypatch.setitem(sys.modules, "pygeomag", None)
    with pytest.raises(InputError, match=r"pip install 'jaximu\[field\]'"):
        world_magnetic_model(52.5, 13.4, date(2026, 1, 1))
