"""The Earth's magnetic field at a place: stated, or of the World Magnetic Model, each with its uncertainty."""

from __future__ import annotations

import math
from dataclasses import dataclass
from datetime import date

from jaximu.ground.errors import InputError

LOWEST, HIGHEST = 10.0, 100.0
"""µT between which the Earth's field lies, a building's iron included."""
_SETS = (2010, 2015, 2020, 2025)
"""Years from which on the coefficients hold, five years each."""
_SPAN, _EXTENDED = 5.0, 10.0
"""Years for which a set is made, and for which the last one is used beyond that."""
_SIGMA, _DIP_SIGMA = 0.152, 0.22
"""µT and degrees: the largest of the error models of WMM2015, 2020 and 2025 (138 to 152 nT, 0.20 to 0.22°): the crust
and daily changes, averaged over the Earth, and five years of prediction."""
_SIGMA_YEAR, _DIP_SIGMA_YEAR = 0.04, 0.05
"""µT and degrees for every year beyond: the sets of 2010 and 2015, ten and fifteen years old, are 69 to 296 nT and
0.15 to 0.41° (rms over the Earth) off their successors."""


@dataclass(frozen=True)
class FieldStrength:
    """Strength of the field, µT, and its standard deviation.

    dip: degrees that it points below the level, and its standard deviation; None where it is not known. note: where
    they are from. Raises `InputError` for what is no field of the Earth.
    """

    value: float
    sigma: float = 0.0
    dip: float | None = None
    dip_sigma: float = 0.0
    note: str = ""

    def __post_init__(self) -> None:
        if not LOWEST < self.value < HIGHEST or not self.sigma >= 0.0:
            raise InputError(
                f"a field of {self.value:g} ± {self.sigma:g} µT is not the Earth's (22 to 67 µT); state it in µT."
            )
        if self.dip is not None and (not -90.0 <= self.dip <= 90.0 or not self.dip_sigma >= 0.0):
            raise InputError(f"a dip of {self.dip:g} ± {self.dip_sigma:g}° is none: it lies between -90 and 90°.")


def world_magnetic_model(latitude: float, longitude: float, day: date, height: float = 0.0) -> FieldStrength:
    """Return strength and dip of the World Magnetic Model (NOAA/NCEI and BGS, degree 12) outdoors.

    **Arguments:** `latitude`, `longitude`: degrees, geodetic, east positive; `day`: of the recording; `height`: above
    sea level, m.

    The uncertainty is that of the model's own error budget. Beyond the last set's five years it grows, and the note
    says that the set is outdated. Raises `InputError` for a place or a day that the model does not have, and where
    pygeomag, which evaluates it and carries its coefficients, is not installed.
    """
    if not -90.0 <= latitude <= 90.0 or not -180.0 <= longitude <= 360.0:
        raise InputError(
            f"latitude {latitude:g} or longitude {longitude:g} is not on the Earth: -90 to 90 and -180 to 360 degrees."
        )
    epoch = max((year for year in _SETS if year <= day.year), default=math.inf)
    new_year = date(day.year, 1, 1)
    year = day.year + (day - new_year) / (date(day.year + 1, 1, 1) - new_year)
    beyond = max(year - epoch - _SPAN, 0.0)
    if epoch > year or beyond > _EXTENDED:
        raise InputError(
            f"the World Magnetic Model that is installed has no field for {day.isoformat()}: its coefficients are for "
            f"{_SETS[0]} to {_SETS[-1] + _SPAN:.0f}. State the field itself (--field), or the right --date."
        )
    try:
        from pygeomag import GeoMag
    except ImportError:
        raise InputError(
            "the field of a place and date needs pygeomag: pip install 'jaximu[field]', or state it (--field)."
        ) from None
    model = GeoMag(coefficients_file=f"wmm/WMM_{epoch}{'v2' if epoch == 2015 else ''}.COF")
    field = model.calculate(
        glat=latitude, glon=longitude, alt=height / 1e3, time=year, allow_date_outside_lifespan=True
    )
    strength, dip = field.f / 1e3, field.i
    sigma, dip_sigma = _SIGMA + _SIGMA_YEAR * beyond, _DIP_SIGMA + _DIP_SIGMA_YEAR * beyond
    note = (
        f"the field is that of WMM{epoch} at {latitude:g}°, {longitude:g}° on {day.isoformat()}: {strength:.2f} ± "
        f"{1.96 * sigma:.2f} µT, dip {dip:.2f} ± {1.96 * dip_sigma:.2f}° (95 %, outdoors and away from iron)."
    )
    if beyond:
        note += (
            f" Its coefficients are outdated since {epoch + _SPAN:.0f}, and the uncertainty is wider for it: "
            "pip install -U pygeomag, or --field."
        )
    return FieldStrength(strength, sigma, dip, dip_sigma, note)
