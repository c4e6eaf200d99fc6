"""How the field names its columns: the words for each sensor, for axes, for time, and for units written in names.

`Field.of("accelerometerAccelerationX(G)")` is the accelerometer's x axis in g. A new habit is a word in a table here; a
program whose names do not say their units is a line in `jaximu.recordings.columns.known`.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from unicodedata import combining, normalize

from jaximu.ground.units import SENSORS, STANDARD_GRAVITY, find_unit, parse_column
from jaximu.ground.units import unit as unit_named

_SENSORS = {
    "accel": "a ac acc acce accel accl accels accelero accelerometer accelerometers acceleration accelerations "
    "acelerometro accelerometro accelerometre beschleunigungssensor beschleunigungsmesser versnellingsmeter "
    "akcelerometr акселерометр 加速度计 加速度計 가속도계 "
    "beschleunigung accelerazione aceleracion aceleracao versnelling przyspieszenie ivme ускорение 加速度 가속도 "
    "gf f fb sf force specific",
    "gyro": "g gy gyr gyro gyros gyroscope gyroscopes w wb om omega rot rotation rotational rate rates ars angvel "
    "angularvelocity angularrate rotationrate as angvelocity gyroskop gyroskope drehrate drehraten giroscopio giroskop "
    "gyrometre drehratensensor zyroskop ジャイロ 자이로 "
    "ω winkelgeschwindigkeit hoeksnelheid гироскоп 角速度 陀螺仪 각속도",
    "mag": "m mag mags magn magneto magnetometer magnetic b field compass magnetometro magnetfeld 磁场 磁場 磁力计",
    "temperature": "temp temperature temperatures temperatur temperatura temperatuur tmp температура 温度",
    "ambient_temperature": "ambient",
}
_ACCELERATIONS = {word for word in _SENSORS["accel"].split() if len(word) > 1}
_WORDS = {word: sensor for sensor, words in _SENSORS.items() for word in words.split()}
_TURNING = "angular ang angolare angulaire угловая".split()
_HELPERS = dict.fromkeys([*_TURNING, *"velocity vel turn speed velocita velocidad vitesse скорость".split()], "gyro")
"""Words that name no sensor alone: an angular velocity is a gyroscope's, a velocity is not."""
_NEUTRAL = set(
    "imu ins raw sensor sensors data device dev body frame cal calibrated calib uncal uncalibrated uncomp scaled adc "
    "smooth signals signal values value val field0 msg message axis component ln wr low wide range inertial motion "
    "reading readings output out meas measured noise noisy in of the rps log mpu bmi lsm icm adis xsens shimmer "
    "payload buffer atti corrected compensated "
    "sensordata android".split()
)
_REFUSALS = {
    "gravity is taken out": "linear lin user free dynamic",
    "gravity alone": "gravity grav",
    "an estimated bias": "bias",
    "an offset": "offset",
    "a standard deviation": "std sd sigma",
    "a variance": "var variance",
    "a covariance": "cov covariance",
    "an increment": "delta",
    "a magnitude": "norm magnitude total absolute abs",
    "in the world's axes": "earth world ned enu global nav",
    "an error": "error err",
    "a quaternion": "quat q quaternion",
    "angles": "euler angle angles winkel",
    "a set point": "setpoint sp cmd command commanded desired des target ref reference",
}
_REFUSED = {word: reason for reason, words in _REFUSALS.items() for word in words.split()}
"""Words beside a sensor's by which a column is not its measurement, and what it is."""
_ESTIMATED = {("b", "w"), ("b", "a"), ("b", "g")}
"""How the names of an estimated state's biases begin, as in EuRoC's b_w_RS_S_x."""
_TIME = set(
    "t ts time times timestamp timestamps stamp tstamp elapsed datetime clock micros millis usec msec zeit temps "
    "tiempo tempo tijd tid zaman datenum czas время 时间 時間 시간 unix epoch tow sow tod sod utc".split()
)
_TIME_ALONE = set("ms us ns sec secs seconds milliseconds microseconds nanoseconds epoch uptime".split())
"""Words that name a column of time where they are its whole name, and no other names one."""
_TIME_BESIDE = _NEUTRAL | set(
    "s since start reboot boot seconds second unix epoch utc system sys local host device sample fine elapsed offset "
    "recording phone node chip epoc "
    "startup us ms ns sec nanosec nanoseconds nanos micros microseconds millis milliseconds usec msec nsec "
    "logging arrival creation gps week whole "
    "absolute relative and date txt day midnight mcu cpu board timer runtime".split()
)
_UNIT_NAMES = {
    "time": {
        "s": "s, sec, secs, seconds, sow, sod",
        "ms": "ms, msec, msecs, millis, milliseconds",
        "us": "us, usec, usecs, micros, microseconds",
        "ns": "ns, nsec, nsecs, nanos, nanosec, nanosecs, nanoseconds",
    },
    "accel": {"g": "g, gs", "mg": "mg, m g", "m/s^2": "ms2, mps2, mss, m s 2, m s2, m s s, m per s2, m s"},
    "gyro": {
        "deg/s": "dps, degs, deg s, deg sec, deg per s",
        "rad/s": "rads, rad s, radps, rps, rad sec, rad per s",
        "mdeg/s": "mdps, mdeg s",
    },
    "mag": {"uT": "ut, u t, µ t, µt", "G": "gauss, g", "mG": "mgauss, mg, m g", "nT": "nt, n t"},
    "temperature": {
        "degC": "c, degc, celsius, deg c",
        "K": "k, kelvin",
        "degF": "f, degf, fahrenheit, deg f",
        "0.1 degC": "c x 10, cx 10",
        "0.01 degC": "c x 100, cx 100",
        "mdegC": "m c, mc, mdegc, mdeg c",
    },
}
_UNIT_WORDS = {
    sensor: {words: unit for unit, names in units.items() for words in names.split(", ")}
    for sensor, units in _UNIT_NAMES.items()
}
_GLUED = re.compile(
    r"(a|ac|acc|accel|accl|acceleration|accelerometer|g|gy|gyr|gyro|gyroscope|gf|w|om|omega|rot|rotation|m|mag|b|f|fb|wb)"
    r"([xyz])|([xyz])(a|acc|accel|acceleration|gyro|gyr|rate|rot|rotation|mag|magn)|"
    r"(roll|pitch|yaw)(?:rate|speed)"
)
_WITH, _WITHOUT = {"with", "including", "incl"}, {"without", "no", "excluding", "excl", "minus"}
"""Words before gravity."""
_BROWSER = {"beta": "x", "gamma": "y", "alpha": "z"}
"""Axes of the rotation rate in a browser's DeviceMotion."""
_TURNS = {"roll": "x", "pitch": "y", "yaw": "z"}
_INSTANCE = re.compile(r"([a-z]+)\d+")
_ABOUT = 0.15  # of 1 g, that an accelerometer at rest may be off
_FIELD = 15.0, 80.0  # uT of the Earth's field, disturbed indoors
_MIDDLE = re.compile(r"(.*?)\s*[\[(]((?:[^\[\]()]|\([^()]*\))+)[\])]\s*([^\s\[\]()].*)")
"""A unit that stands within a name: Acceleration - x (m/s²) Run #1."""
QUANTITIES = {"acceleration": "accel", "angular rate": "gyro", "magnetic field": "mag"}
"""The sensor of a quantity."""
_OWN = re.compile(r"(ambient_temperature|current|table_angle|table_rate|attitude_[wxyz])")


def measures(unit: str | None, level: float | None = None) -> str | None:
    """The sensor of a unit, None for none. G and mG may be gravity or gauss, as which values of a `level` can be."""
    measured = find_unit(unit)
    gravity = find_unit(unit, "acceleration")
    if measured and gravity and measured.quantity == "magnetic field":
        if level is not None and abs(level * gravity.factor / STANDARD_GRAVITY - 1) < _ABOUT:
            return "accel"
        return "mag" if level is not None and _FIELD[0] < level * measured.factor < _FIELD[1] else None
    return QUANTITIES.get(measured.quantity) if measured else None


def last_of(name: str) -> tuple[str, str | None]:
    """What stands before a unit of time that ends a name, and that unit; None where it ends in none."""
    match = re.fullmatch(r"(.*?)([a-z]+)", name.strip('" #').lower())
    unit = _UNIT_WORDS["time"].get(match[2]) if match else None
    return (match[1], unit) if match and unit else (name, None)


def words_of(text: str) -> list[str]:
    """The words of a name, lower case, without accents: split at signs, digits, capitals, and where a script ends."""
    bare = normalize("NFC", "".join(letter for letter in normalize("NFD", text) if not combining(letter)))
    return [part.lower() for part in re.findall(r"[A-Z]+(?![a-zµ])|[A-Z]?[a-zµ]+|\d+|[^\W\d_a-zA-Zµ²³¹º]+", bare)]


@dataclass(frozen=True)
class Field:
    """What a column's name says of it.

    stem: the words without axis and unit. axis: "x", "y", "z", a digit, or none. sensor: "accel", "gyro", "mag",
    "temperature", "time", another of our own names, or None. unit: as stated in brackets or at the name's end.
    why_not: why a column that has a sensor's name is not its measurement.
    """

    stem: tuple[str, ...]
    axis: str | None
    sensor: str | None
    unit: str | None
    why_not: str | None = None

    @property
    def canonical(self) -> str | None:
        """The column in our words, None where the name does not say it all."""
        if self.sensor in SENSORS:
            return f"{self.sensor}_{self.axis}" if self.axis and self.axis in "xyz" else None
        return self.sensor

    @property
    def bare_time(self) -> bool:
        """Whether the name is a unit of time and no more."""
        return self.sensor == "time" and len(self.stem) == 1 and self.stem[0] in _TIME_ALONE

    @property
    def clock_of(self) -> str | None:
        """The sensor whose stamps a column of time holds by its name (gyroTimestamp), None for no one sensor's."""
        sensors = {_WORDS.get(word) for word in self.stem if len(word) > 2} & SENSORS.keys()
        return sensors.pop() if self.sensor == "time" and len(sensors) == 1 else None

    @classmethod
    def of(cls, name: str) -> Field:
        """Read a column's name."""
        name = name.strip().lstrip("%#")
        if (match := _MIDDLE.fullmatch(name)) and find_unit(match[2]):
            name = f"{match[1]} {match[3]} [{match[2]}]"
        text, unit = parse_column(name)
        plain = re.sub(r"[^a-z0-9]+", "_", text.lower()).strip("_")
        if match := _OWN.fullmatch(plain):
            return cls((plain,), None, match[1], unit)
        words, times = [word for word in words_of(text) if word != "axis"], _UNIT_WORDS["time"]
        stem, axis = _axis(words)
        sensor, why_not = sensor_of(stem)
        if sensor in (None, "temperature") and why_not is None:  # the F of degrees names an accelerometer elsewhere
            for size in (3, 2, 1):  # a unit at the end of the name, whose axis stands before it
                head, tail = words[:-size], " ".join(words[-size:])
                if _time(head) and tail in times:
                    return cls(tuple(head), None, "time", unit or times[tail])
                short, at = _axis(head)
                short_sensor, _ = sensor_of(short)
                named = _UNIT_WORDS.get(short_sensor or "", {}).get(tail)
                if named and (at or short_sensor == "temperature"):
                    return cls(short, at, short_sensor, unit or named)
        if not (axis and axis in "xyz") and (_time(words, unit) or (len(words) == 1 and words[0] in _TIME_ALONE)):
            if words == ["t"] and find_unit(unit, "temperature"):
                return cls(("t",), None, "temperature", unit)  # T (°)
            tail = next((word for word in reversed(words) if word in times and len(word) > 1), "")
            return cls(tuple(words), None, "time", unit or times.get(tail))
        measured = find_unit(unit) if axis else None
        if not stem and measured and measured.quantity == "time":  # X [s], the abscissa
            return cls((), None, "time", unit)
        if not stem and axis in tuple("xyz"):  # X (m/s^2)
            sensor = measures(unit)
        if axis and stem[:2] in _ESTIMATED:
            sensor, why_not = None, "an estimated bias"
        # LowG_X (g): the letter is the unit's
        of_unit = sensor == "gyro" and "g" in stem and find_unit(unit, "acceleration")
        if axis and (of_unit or "temperature" in (sensor or "")):
            sensor = None
        return cls(stem, axis, sensor, unit, why_not)


def fields_of(names: Sequence[str]) -> list[Field]:
    """The fields of a table's names, without what most of them begin with (a device's name and number).

    Axes that are counted (acc[0], acc[1], acc[2]) or called p, q, r have letters, as have names that differ in them.
    """
    fields = [Field.of(name) for name in _without_prefix(names)]
    lettered: dict[tuple[str, str], dict[str, int]] = {}
    joined = [" ".join(field.stem) for field in fields]
    for at, (field, text) in enumerate(zip(fields, joined, strict=True)):
        for index, letter in enumerate(text if field.axis is None and field.sensor is None else ""):
            if index and letter in "xyz":
                lettered.setdefault((text[:index], text[index + 1 :]), {})[letter] = at
    for (head, tail), places in lettered.items():
        if len(places) == 3:
            stem = (*head.split(), *tail.split())
            sensor, why_not = sensor_of(stem)
            why_not = "a quaternion" if f"{head}w{tail}" in joined else why_not
            for axis, at in places.items():
                fields[at] = replace(fields[at], stem=stem, axis=axis, sensor=sensor, why_not=why_not)
    counted: dict[tuple[str, ...], dict[str, int]] = {}
    for at, field in enumerate(fields):
        if field.axis and field.axis.isdigit() and field.sensor:
            counted.setdefault(field.stem, {})[field.axis] = at
        elif field.stem and field.stem[0] in tuple("pqr") and _of_rates(field):
            counted.setdefault(("p", "q", "r", *field.stem[1:]), {})[str("pqr".index(field.stem[0]))] = at
    for places in counted.values():
        if sorted(places) in (["0", "1", "2"], ["1", "2", "3"]):
            for axis, (_, at) in zip("xyz", sorted(places.items()), strict=True):
                stem = fields[at].stem if fields[at].sensor else ("p", "q", "r")
                fields[at] = replace(fields[at], stem=stem, axis=axis, sensor=fields[at].sensor or "gyro", why_not=None)
    return fields


def _of_rates(field: Field) -> bool:
    """Whether what follows p, q or r lets it be a rate: nothing, or words that say the body's, or a rate's unit."""
    rest = set(field.stem[1:])
    plain = field.axis is None and not rest & _REFUSED.keys()
    return not rest or (plain and (rest <= _NEUTRAL | {"b"} or measures(field.unit) == "gyro"))


def _without_prefix(names: Sequence[str]) -> list[str]:
    """The names without the words that four fifths of them begin with, if those name no sensor and none of our own."""
    left = list(names)
    if any(_OWN.fullmatch(parse_column(name.strip().lower())[0]) for name in left):
        return left
    while len(left) > 3:
        heads = [match[0] if (match := re.match(r"[^_.:/\s]+[_.:/\s]+(?=\S)", name)) else "" for name in left]
        head = max(set(heads), key=heads.count)
        words = tuple(word for word in words_of(head))
        if not head or heads.count(head) < 0.8 * len(left) or sensor_of(words)[0] or set(words) & (_TIME | set("xyz")):
            break
        shorter = [name.removeprefix(head) for name in left]
        if any(re.match(r"[A-Za-z][^A-Za-z0-9]", name) for name in shorter):
            break  # chan_a_x: a letter that is left alone is no sensor's
        left = shorter
    return left


def _time(words: list[str], unit: str | None = None) -> bool:
    """Whether words name a time: by one that says so, or by a unit of time beside others that would fit one."""
    timed = find_unit(unit, "time") or (len(words) > 1 and any(word in _TIME_ALONE for word in words))
    return (any(word in _TIME for word in words) or bool(words and timed)) and all(
        word in _TIME or word in _TIME_BESIDE or word.isdigit() or (len(word) > 2 and _WORDS.get(word) in SENSORS)
        for word in words
    )


def _in_place(words: Sequence[str], at: int, *others: str) -> tuple[str, ...]:
    """The words with others, or none, in place of one."""
    return (*words[:at], *others, *words[at + 1 :])


def _axis(words: list[str]) -> tuple[tuple[str, ...], str | None]:
    """The words without the axis among them, and the axis."""
    if len(words) > 1 and words[-1] in _BROWSER and words[-2] in ("rate", "rotation"):
        return tuple(words[:-1]), _BROWSER[words[-1]]
    of_sensor = len(words) > 1 and any(word in _WORDS or word in _HELPERS for word in words)
    for axes in ({axis: axis for axis in "xyz"}, _TURNS if of_sensor else {}):
        places = [at for at, word in enumerate(words) if word in axes]
        if len(places) == 1:
            return _in_place(words, places[0]), axes[words[places[0]]]
    for at, word in enumerate(words):
        if match := _GLUED.fullmatch(word):
            sensor, axis = match[1] or match[4] or "rate", match[2] or match[3] or _TURNS[match[5]]
            return _in_place(words, at, sensor), axis
    if words and words[-1] in ("0", "1", "2", "3"):
        return tuple(words[:-1]), words[-1]
    return tuple(words), None


def sensor_of(stem: tuple[str, ...]) -> tuple[str | None, str | None]:
    """The sensor that the words of a name mean, None for none or more than one, and why it is not its measurement."""
    sensors: set[str] = set()
    why_not = None
    for at, word in enumerate(stem[:-1]):  # with gravity, without gravity
        if stem[at + 1] in ("gravity", "g") and word in _WITH | _WITHOUT:
            why_not = "gravity is taken out" if word in _WITHOUT else None
            stem = (*stem[:at], *stem[at + 2 :])
            break
    for at, word in enumerate(stem):
        if word == "g" and set(stem[at + 1 :]) & _ACCELERATIONS:
            continue  # G-Force
        plain = match[1] if (match := _INSTANCE.fullmatch(word)) else word
        if plain in _REFUSED and any(other != "var" and not other.isdigit() for other in stem):  # Var1 says nothing
            why_not = why_not or _REFUSED[plain]
        elif plain in _WORDS or plain in _HELPERS:
            sensors.add(_WORDS.get(plain) or _HELPERS[plain])
        elif plain not in _NEUTRAL and not plain.isdigit():
            return None, None
    names_one = any(word in _WORDS or _INSTANCE.sub(r"\1", word) in _WORDS or word in _TURNING for word in stem)
    if why_not or not names_one:
        return None, why_not
    if "temperature" in sensors:
        sensors = {"ambient_temperature"} if "ambient_temperature" in sensors else {"temperature"}
    return (sensors.pop(), None) if len(sensors) == 1 else (None, None)


_RATE = re.compile(
    r"(?:\bfs|\bodr|(?:sampl\w*|update|data|measurement|output|imu|log\w*)[ _-]*(?:rate|freq\w*|per second)|"
    r"\bfrequency|\brate|\bfreq)\b[\s\"'=:,;\t(]*(?:\(?\[?hz\]?\)?)?[\s\"'=:,;\t]*([0-9]+(?:[.,][0-9]+)?)\s*(k?hz)?|"
    r"\bat ([0-9]+(?:\.[0-9]+)?) *(hz)\b",
    re.IGNORECASE,
)
_INTERVAL = re.compile(
    r"(?:sampl\w*[ _-]*(?:interval|period|time)|\bdt|interval)\b[\s\"'=:,;\t(]*([0-9]+(?:\.[0-9]+)?(?:e-?\d+)?)\s*"
    r"\)?(s|ms|us|sec|msec)\b",
    re.IGNORECASE,
)


def stated_rate(text: str) -> float | None:
    """The sample rate in Hz that a file's preamble states, None for none or for several that differ."""
    rates = {
        float((match[1] or match[3]).replace(",", ".")) * (1e3 if (match[2] or "").lower() == "khz" else 1.0)
        for match in _RATE.finditer(text)
    }
    intervals = [float(match[1]) * unit_named(match[2], "time").factor for match in _INTERVAL.finditer(text)]
    rates |= {round(1.0 / interval, 6) for interval in intervals if interval > 0}
    return rates.pop() if len(rates) == 1 and 0 < min(rates) < 1e5 else None
