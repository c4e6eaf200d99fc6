"""How numbers and units are written for a person: on the terminal, in reports, in sentences and in `summary()`.

JSON documents are for programs and keep SI and plain unit names; everything else is written here.
"""

import math
import re
from collections.abc import Collection, Iterable, Sequence

Z95 = 1.96
"""Standard deviations on either side of the mean that hold 95 % of a normal distribution."""
_SYMBOLS = {
    "sqrt(Hz)": "√Hz",
    "sqrt(h)": "√h",
    "^2": "²",
    "^3": "³",
    "^4": "⁴",
    "degC": "°C",
    "deg": "°",
    "ug": "µg",
    "uT": "µT",
}
_RATIO = re.compile(r"\((?P<unit>[^()]+)\)/\((?P=unit)\)(?:\^(?P<power>\d))?(?P<rest>(?:/s)?)")
"""A unit over a power of itself, as coefficients have it."""
_NUMERATOR = re.compile(r"(\(?)(rad|m/s\^2)(?![\w^])(.*)")
"""What a unit begins with that a person reads in another: of (m/s^2)/K the parenthesis, m/s^2 and the rest."""
_PREFIXES = ((1e-1, 1.0, ""), (1e-4, 1e3, "m"), (0.0, 1e6, "µ"))


def raised(power: int) -> str:
    """Return an exponent in raised digits."""
    return str(power).translate(str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹"))


def unit_text(unit: str) -> str:
    """Return a unit as it is printed: m/s^2 as m/s², deg/s as °/s, uT as µT; "1" and (m/s^2)/(m/s^2) are nothing."""
    if ratio := _RATIO.fullmatch(unit):
        base, power = f"({ratio['unit']})", int(ratio["power"] or 1) - 1
        over = (f"{base}^{power}" if power > 1 else base * power) + ratio["rest"].removeprefix("/")
        unit = f"1/{over}" if over else "1"
    if unit == "1":
        return ""
    for plainly, printed in _SYMBOLS.items():
        unit = unit.replace(plainly, printed)
    return unit


def readable(unit: str, largest: float) -> tuple[float, str]:
    """Return the factor and the unit in which a person reads values up to `largest`, in `unit`.

    Angles and rates are read in degrees, accelerations with the prefix that keeps them near one: 0.0016 m/s² are
    1.6 mm/s², 8.2e-05 rad/s are 0.0047 °/s, 0.002 (m/s²)/K are 2 (mm/s²)/K. Other units stay what they are.
    """
    head = _NUMERATOR.fullmatch(unit)
    if head is None or _RATIO.fullmatch(unit):
        return 1.0, unit_text(unit)
    if head[2] == "rad":
        return math.degrees(1.0), unit_text(f"{head[1]}deg{head[3]}")
    factor, prefix = next((f, prefix) for low, f, prefix in _PREFIXES if largest >= low or not largest)
    return factor, unit_text(f"{head[1]}{prefix}m/s^2{head[3]}")


def size(value: float, unit: str, digits: int = 3) -> str:
    """Return a value with the unit in which a person reads it."""
    factor, printed = readable(unit, abs(value))
    return joined(number(factor * value, digits), printed)


def change(before: float, after: float, unit: str, digits: int = 3) -> str:
    """Return "before → after", both sizes, in the one unit that suits what lies between them."""
    factor, printed = readable(unit, math.sqrt(before * after) or max(before, after))
    return joined(f"{number(factor * before, digits)} → {number(factor * after, digits)}", printed)


def number(value: float, digits: int = 3) -> str:
    """Return a number with so many significant digits, with a power of ten only where a person would use one."""
    if value == 0:
        return "0"
    if not math.isfinite(value):
        return str(value)
    exponent = math.floor(math.log10(abs(value)))
    if -4 <= exponent < 6:
        return f"{value:.{max(0, digits - 1 - exponent)}f}".replace("-", "−")
    mantissa, _, power = f"{value:.{digits - 1}e}".partition("e")
    return f"{mantissa}·10{raised(int(power))}".replace("-", "−")


def plain(value: float) -> str:
    """Return a number with up to six digits and no zeros after the last one that counts."""
    mantissa, _, power = f"{value:.6g}".partition("e")
    return (mantissa + (f"·10{raised(int(power))}" if power else "")).replace("-", "−")


def joined(text: str, unit: str) -> str:
    """Put a unit after a number: a degree sign follows it closely."""
    return f"{text}{unit}" if unit == "°" else f"{text} {unit}".strip()


def with_interval(value: float, sigma: float, unit: str = "", sign: bool = False) -> str:
    """Return value ± half the 95 % interval, both to the interval's second digit, sharing power of ten and unit.

    A unit in plain SI becomes the one in which a person reads them; one that is printed already stays.
    """
    factor, printed = readable(unit, max(abs(value), Z95 * sigma))
    value, half = factor * value, factor * Z95 * sigma
    if not half > 0:
        return joined(number(value, 6), printed)
    digits, plus = max(0, 1 - math.floor(math.log10(half))), "+" if sign else ""
    if digits < 8:
        text = f"{value:{plus}z.{digits}f} ± {half:.{digits}f}"  # z: no minus before a zero
    else:
        power = math.floor(math.log10(max(abs(value), half)))
        text = f"({value * 10.0**-power:{plus}z.{digits + power}f} ± {half * 10.0**-power:.{digits + power}f})"
        text += f"·10{raised(power)}"
    return joined(text.replace("-", "−"), printed)


def with_intervals(values: Collection[float], sigmas: Collection[float], unit: str) -> list[str]:
    """Return each value ± half its 95 % interval, all in the unit in which a person reads the largest."""
    factor, printed = readable(unit, max(map(abs, values)))
    return [with_interval(factor * v, factor * s, printed) for v, s in zip(values, sigmas, strict=True)]


def counted(count: int, noun: str) -> str:
    """Return how many there are of what, in the singular or the plural."""
    return f"{count} {noun}{'s' * (count != 1)}"


def sentence(text: str) -> str:
    """Return the text with a capital at its start, unless it starts with the name of a file or an identifier."""
    return text if re.match(r"\S*[._/\\]\w", text) else text[:1].upper() + text[1:]


def in_order(names: Iterable[str]) -> list[str]:
    """Return names without repetition, numbers by size."""
    return sorted(dict.fromkeys(names), key=lambda name: (not name.isdigit(), len(name) * name.isdigit(), name))


def listed(words: Sequence[str], last: str = "and") -> str:
    """Return words in a row as a sentence has them."""
    return words[0] if len(words) == 1 else f"{', '.join(words[:-1])} {last} {words[-1]}"


def probability(value: float) -> str:
    """Return "= 0.03", or "< 10⁻³⁰⁰" for what the computer takes for zero."""
    return "< 10⁻³⁰⁰" if value <= 1e-300 else f"= {value:.2g}" if value >= 1e-4 else f"= {number(value, 2)}"
