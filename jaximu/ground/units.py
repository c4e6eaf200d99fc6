"""The unit table: every unit that a column may state, and its conversion to the unit that jaximu computes in."""

import difflib
import math
import re
from dataclasses import dataclass

from jaximu.ground.errors import InputError

STANDARD_GRAVITY = 9.80665
"""Standard gravity in m/s²: the meaning of the unit g, not the local gravity."""

BASE_UNITS = {
    "acceleration": "m/s^2",
    "angular rate": "rad/s",
    "velocity increment": "m/s",
    "time": "s",
    "temperature": "degC",
    "magnetic field": "uT",
    "electric current": "A",
    "angle": "rad",
    "raw count": "count",
    "ratio": "1",
}
"""The unit that each quantity is held in: SI, except degrees Celsius and microtesla."""

SENSORS = {"accel": "accelerometer", "gyro": "gyroscope", "mag": "magnetometer"}
"""The triads by the prefix of their columns and effects."""
PREFIXES = {name: prefix for prefix, name in SENSORS.items()}
SENSOR_UNITS = {"accelerometer": "m/s^2", "gyroscope": "rad/s", "magnetometer": "uT"}
SENSOR_QUANTITIES = {"accelerometer": "specific_force", "gyroscope": "angular_rate", "magnetometer": "magnetic_field"}
"""What each triad measures, as a stimulus and tables of noise call it."""
INERTIAL_QUANTITIES = {name: SENSOR_QUANTITIES[name] for name in ("accelerometer", "gyroscope")}
"""The same of the triads that navigation integrates."""


@dataclass(frozen=True)
class Unit:
    """A unit of a quantity: value in the base unit = factor · value + offset (offset only for temperatures)."""

    name: str
    quantity: str
    factor: float
    offset: float = 0.0

    @property
    def base(self) -> str:
        """The name of the base unit of this quantity."""
        return BASE_UNITS[self.quantity]


DEGREE = math.pi / 180.0
"""rad."""
_FACTORS = {
    # names, the first of which is canonical
    "acceleration": {
        "m/s^2 m/s² m/s2 m/s/s m/s**2 m/(s^2) ms^-2 ms-2": 1.0,
        "mm/s^2 mm/s² mm/s2": 1e-3,
        "cm/s^2 cm/s² cm/s2 Gal": 1e-2,
        "ft/s^2 ft/s² ft/s2": 0.3048,
        "g gn g0 gs g's": STANDARD_GRAVITY,
        "mg": STANDARD_GRAVITY * 1e-3,
        "ug µg μg": STANDARD_GRAVITY * 1e-6,
    },
    "angular rate": {
        "rad/s rads 1/s": 1.0,
        "mrad/s": 1e-3,
        "deg/s dps °/s d/s": DEGREE,
        "mdeg/s mdps": DEGREE * 1e-3,
        "deg/h dph °/h": DEGREE / 3600.0,
        "deg/min dpm °/min": DEGREE / 60.0,
        "rad/h": 1.0 / 3600.0,
        "rpm rev/min r/min tr/min U/min": math.pi / 30.0,
        "rev/s rps r/s tr/s U/s": 2 * math.pi,
    },
    "time": {
        "s sec secs seconds second": 1.0,
        "ms msec msecs milliseconds": 1e-3,
        "us µs μs usec microseconds": 1e-6,
        "ns nsec nanosec nanoseconds": 1e-9,
        "min minute minutes": 60.0,
        "h hour hours": 3600.0,
        "d day days": 86400.0,
    },
    "temperature": {
        "degC °C C celsius ℃": 1.0,
        "K kelvin": 1.0,
        "degF °F F fahrenheit": 5.0 / 9.0,
        "mdegC m°C mC": 1e-3,
    },
    "magnetic field": {
        "uT µT μT": 1.0,
        "T tesla": 1e6,
        "mT": 1e3,
        "nT": 1e-3,
        "G gauss Gs": 1e2,
        "mG mgauss": 0.1,
    },
    "velocity increment": {"m/s": 1.0},
    "electric current": {"A ampere amperes amp amps": 1.0, "mA": 1e-3},
    "angle": {"deg ° degrees": DEGREE, "rad": 1.0},
    "raw count": {"count counts lsb LSB raw digit digits": 1.0},
    "ratio": {"1 dimensionless -": 1.0},
}
_OFFSETS = {"K": -273.15, "degF": -160.0 / 9.0}
_TABLE = {
    alias: Unit(names[0], quantity, factor, _OFFSETS.get(names[0], 0.0))
    for quantity, factors in _FACTORS.items()
    for names, factor in ((aliases.split(), factor) for aliases, factor in factors.items())
    for alias in names
}


_FACTOR = re.compile(r"(\S+?)\s*[\s*·.]\s*([a-zA-Z]+)(?:\^|\*\*)?(?:[-−]([12])|⁻([¹²]))")
"""A unit divided by another, written as a product: "m s^-2", "rad*s**-1", "deg·h⁻¹"."""


_SCALED = re.compile(
    r"(\d+\.?\d*(?:[eE][+-]?\d+)?)\s*([a-zA-Zµμ°].*?)(?:\s*/\s*(?:lsb|count|digit|bit)s?)?", re.IGNORECASE
)


_SPELT = {
    word: unit
    for unit, words in {
        "m": "meter meters metre metres м",
        "s": "sec secs second seconds с sn",
        "deg": "degree degrees grad град derece",
        "rad": "radian radians рад",
        "h": "hour hours hr",
        "ms": "мс",
        "/": "per",
        "^2": "squared",
    }.items()
    for word in words.split()
}
"""Words of a compound unit, as "degrees per second" or "м/с²" has them."""

_OF_COUNTS = re.compile(r"(?:counts?|lsb)\s*/\s*(\d+\.?\d*)\s*([-−+]\s*\d+\.?\d*)?", re.IGNORECASE)
"""A chip's temperature as its data sheet has it, in °C: "count/340 + 36.53"."""


def _wanted(quantity: str | tuple[str, ...] | None) -> tuple[str, ...]:
    return (quantity,) if isinstance(quantity, str) else quantity or tuple(BASE_UNITS)


def find_unit(text: str | None, quantity: str | tuple[str, ...] | None = None) -> Unit | None:
    """The unit called `text`, None if unknown or of another quantity. A number scales it: "0.061 mg", "100 us".

    Letter case counts only where it must (mg and mG, s and S differ), and not where the quantity decides: an
    acceleration in "G" is in g, a temperature in "°" is in degC, and may be a line through counts: "count/340+36.53".
    """
    wanted = _wanted(quantity)
    text = (text or "").strip().replace("º", "°")
    if match := _SCALED.fullmatch(text):
        scaled = find_unit(match[2], quantity)
        return scaled and Unit(text, scaled.quantity, scaled.factor * float(match[1]), scaled.offset)
    if "temperature" in wanted and (match := _OF_COUNTS.fullmatch(text)) and float(match[1]) > 0:
        offset = (match[2] or "0").replace(" ", "").replace("−", "-")
        return Unit(text, "temperature", 1 / float(match[1]), float(offset))
    if product := _FACTOR.fullmatch(text):
        text = f"{product[1]}/{product[2]}" + ("^2" if (product[3] or product[4]) in ("2", "²") else "")
    if wanted == ("temperature",) and text == "°":
        text = "degC"
    fitting = {alias: unit for alias, unit in _TABLE.items() if unit.quantity in wanted}
    if text in fitting:
        return fitting[text]
    alike = {unit for alias, unit in fitting.items() if alias.lower() == text.lower()}
    if alike:
        return alike.pop() if len(alike) == 1 else None
    plain = re.sub(r"[^\W\d_²]+", lambda word: _SPELT.get(word[0].lower(), word[0]), text)
    plain = re.sub(r"\s*([/^])\s*", r"\1", plain)
    return find_unit(plain, quantity) if plain != text else None


def unit(text: str, quantity: str | tuple[str, ...] | None = None, *, file: str = "", column: str = "") -> Unit:
    """The unit called `text`, checked to be one of `quantity` where given.

    `file` and `column` (or an option such as "--accel-scale") say where it was found, for the message.
    Raises InputError for an unknown unit (naming the nearest known ones) and for a unit of another quantity.
    """
    named = column if column.startswith("--") else column and f"column {column!r}"
    where = ", ".join(filter(None, (file, named))) or "unit"
    wanted = _wanted(quantity)
    known = find_unit(text, wanted) or find_unit(text)
    if known is None:
        choices = [alias for alias, unit in _TABLE.items() if unit.quantity in wanted]
        lowered = {alias.lower(): alias for alias in reversed(choices)}
        near = [lowered[name] for name in difflib.get_close_matches(text.lower(), lowered, n=3, cutoff=0.4)]
        canonical = [_TABLE[alias].name for alias in choices]
        offer = list(dict.fromkeys(near or canonical[:40]))
        raise InputError(f"{where}: unknown unit {text!r}; known units near it: {', '.join(offer)}.")
    if known.quantity not in wanted:
        expected = " or ".join(f"{name} ({BASE_UNITS[name]})" for name in wanted)
        raise InputError(f"{where}: the unit {text!r} is one of {known.quantity}, expected one of {expected}.")
    return known


_AXIS = re.compile(r"[xyz](?:[- ]?axis)?", re.IGNORECASE)
_WIDE = str.maketrans("（）［］，：", "()[],:")
"""Signs that are as wide as an ideograph."""
_NO_UNIT = re.compile(r"x[0-9a-f]{4}|txt|no[_ ]?units?|n|r|u", re.IGNORECASE)


def parse_column(text: str) -> tuple[str, str | None]:
    """A column's name and its unit: "accel_x [m/s^2]" → ("accel_x", "m/s^2"); without brackets the unit is None.

    Round brackets are read as well ("Acc_x (g)"), and a unit behind a comma ("acc x, g"); empty brackets are no unit,
    nor is a number or an axis ("acc[0]", "Acc (X)"), nor the number of a message's field ("X Accel [x8004]").
    """
    text = text.translate(_WIDE)
    match = re.fullmatch(r"\s*(.*?)\s*(?:\[([^\[\]]*)\]|\((.*)\))?\s*", text, re.DOTALL)
    if match is None:
        return text.strip(), None
    stated = (match[2] or match[3] or "").strip()
    name, comma, behind = match[1].rpartition(",")
    if comma and not stated and find_unit(behind):
        return name, behind.strip()
    if _AXIS.fullmatch(stated) or (stated.isdigit() and not re.search(r"\s[\[(]", text)):  # unlike "attitude_w [1]"
        return f"{match[1]} {stated}".strip(), None
    if _NO_UNIT.fullmatch(stated):
        return match[1], None
    return match[1], stated or None


def column_title(name: str, unit: str | None) -> str:
    """A column's name with its unit in brackets, where it has one: what `parse_column` reads."""
    return f"{name} [{unit}]" if unit else name
