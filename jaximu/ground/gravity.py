"""Local gravity and its uncertainty, which enters the uncertainty of every accelerometer scale."""

import math
import re
from dataclasses import dataclass
from typing import Any

from jaximu.ground.errors import InputError
from jaximu.ground.units import STANDARD_GRAVITY

LOWEST, HIGHEST = 9.5, 10.1
"""What is accepted as gravity on or near the Earth, m/s² (at sea level it spans 9.780 to 9.832)."""


@dataclass(frozen=True)
class LocalGravity:
    """Magnitude of gravity where the recording was made, and its standard deviation, both in m/s².

    latitude: degrees, where it is known; the Earth's rotation is then known, too.

    Raises InputError for a value that is no gravity on the Earth, or a negative sigma.
    """

    value: float = STANDARD_GRAVITY
    sigma: float = 0.015
    latitude: float | None = None

    def __post_init__(self) -> None:
        if not LOWEST <= self.value <= HIGHEST:
            raise InputError(
                f"gravity {self.value:g} m/s² is not plausible on the Earth ({LOWEST} to {HIGHEST}); state it in m/s²."
            )
        if not 0.0 <= self.sigma < 1.0:
            raise InputError(f"the standard deviation of gravity must lie between 0 and 1 m/s², not {self.sigma:g}.")

    def __str__(self) -> str:
        return f"{self.value:.7g} ± {self.sigma:g} m/s²"


STANDARD = LocalGravity()
"""Standard gravity, its sigma (0.015 m/s²) standing for the spread of gravity over the Earth."""


Gravity = LocalGravity | float | str
"""Local gravity as a person states it: with its uncertainty, as a number in m/s², or as text."""


def as_gravity(value: Gravity) -> LocalGravity:
    """Return local gravity stated as such, as a number in m/s² (believed exactly), or as text ("9.81744+-0.0005").

    Raises InputError for anything else.
    """
    if isinstance(value, LocalGravity):
        return value
    if isinstance(value, str):
        return parse_gravity(value)
    try:
        return LocalGravity(float(value), 0.0)
    except (TypeError, ValueError):
        raise InputError(
            f"gravity is a number in m/s² or a jaximu.LocalGravity, not of type {type(value).__name__}: "
            "pass 9.81744, or jaximu.wgs84_gravity(latitude, height)."
        ) from None


def parse_gravity(text: str) -> LocalGravity:
    """Gravity from "G" or "G+-SIGMA" (also "G±SIGMA"), in m/s²: "9.81744", "9.81+-0.001".

    A bare G is known to half a unit of its last digit, anything within as likely: 9.81 has sigma 0.005/√3; G+-0 is
    exact. Raises InputError for anything else.
    """
    parts = re.split(r"\+/?-|±", text)
    decimals = len(parts[0].strip().partition(".")[2])
    try:
        value, sigma = float(parts[0]), float(parts[1]) if len(parts) > 1 else 0.5 * 10.0**-decimals / math.sqrt(3)
    except ValueError:
        value, sigma = math.nan, math.nan
    if len(parts) > 2 or math.isnan(value) or math.isnan(sigma):
        raise InputError(f"gravity {text!r} is not understood; write G or G+-SIGMA in m/s², such as 9.81744+-0.0005.")
    return LocalGravity(value, sigma)


EQUATOR_RADIUS, SQUARED_ECCENTRICITY = 6378137.0, 0.00669437999014
"""Of the WGS-84 ellipsoid: its larger half axis, m, and e²."""


def normal_gravity(sine_squared: Any, height: Any) -> Any:
    """Return normal gravity (m/s²) of the WGS-84 ellipsoid, of numbers or arrays of any shape.

    Somigliana's closed formula on the ellipsoid, and the second-order expansion in height above it (NIMA TR8350.2,
    section 4).

    **Arguments:** `sine_squared`: sin² of the geodetic latitude; `height`: above the ellipsoid, m.
    """
    equator, k = 9.7803253359, 0.00193185265241
    a, f, m = EQUATOR_RADIUS, 1.0 / 298.257223563, 0.00344978650684
    on_ellipsoid = equator * (1.0 + k * sine_squared) / (1.0 - SQUARED_ECCENTRICITY * sine_squared) ** 0.5
    fall = 1.0 - 2.0 * (1.0 + f + m - 2.0 * f * sine_squared) * height / a + 3.0 * (height / a) ** 2
    return on_ellipsoid * fall


def wgs84_gravity(latitude_deg: float, height_m: float = 0.0) -> LocalGravity:
    """Normal gravity of the WGS-84 ellipsoid at a geodetic latitude (degrees) and ellipsoidal height (m).

    See `normal_gravity`. The ellipsoid knows no mountains: real gravity differs by the gravity anomaly, whose global
    standard deviation is 35 mGal (Heiskanen and Moritz 1967, variance 1201 mGal²) and which is larger in mountains;
    sigma is a stated 50 mGal = 5e-4 m/s². Raises InputError for a latitude or height outside its range.
    """
    if not -90.0 <= latitude_deg <= 90.0:
        raise InputError(f"latitude must lie between -90 and 90 degrees, not {latitude_deg:g}.")
    if not -1000.0 <= height_m <= 20000.0:
        raise InputError(f"height must lie between -1000 and 20000 m, not {height_m:g}.")
    sine_squared = math.sin(math.radians(latitude_deg)) ** 2
    return LocalGravity(normal_gravity(sine_squared, height_m), 5e-4, latitude_deg)
