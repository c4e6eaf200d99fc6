"""What a calibration is traced by: which unit it is, who calibrated it where and with what, in a TOML file.

    serial = "A-0017"                    # the options --serial, --lot … go before these
    model = "MPU-9150 on carrier B"
    lot = "2026-11"
    operator = "J. Doe"
    station = "bench 2"
    fixture = "cube 7"
    date = "2026-03-04"                  # of the calibration
    received = "2026-03-01"

    [environment]                        # conditions, in any words
    temperature = "(23.1 ± 0.5) °C"

    [[reference]]                        # gravity, a rate table, a thermometer …; one table each
    name = "local gravity"
    certificate = "survey 2024-118"
    expires = "2030-01-01"
    file = "survey.pdf"                  # if it is there; its hash is kept

    [certificate]                        # asked for by a certificate
    number = "C-2026-0017"
    laboratory = "Example Laboratory"
    address = "1 Example Street, Example Town"
    customer = "Example Customer, 2 Example Street"
    authorised_by = "A. Smith"

Beside LOG, such a file called LOG.trace.toml is read without being named.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping
from datetime import date
from pathlib import Path
from typing import Any

from jaximu.ground.document import Json, file_digest, read_toml
from jaximu.ground.errors import FilePath, InputError, only

_REFERENCE = tuple("name certificate expires file value uncertainty".split())
_CERTIFICATE = tuple("number laboratory address customer authorised_by".split())
NEEDED = (
    *"serial model operator date environment reference".split(),
    *(f"certificate.{key}" for key in _CERTIFICATE),
)
"""What ISO/IEC 17025, 7.8.2 and 7.8.4, asks of a certificate and the recording does not say."""


def sidecar(log: FilePath) -> Path | None:
    """Return the file beside a log that says what it is traced by; None where there is none."""
    path = Path(f"{os.fspath(log)}.trace.toml")
    return path if path.is_file() else None


def read_trace(path: FilePath | None, stated: Mapping[str, str | None] | None = None) -> Json:
    """Return what a file, if any, and options say; options go first.

    Raises `InputError` naming file and key: what is not known, has no text, or a reference whose certificate had
    expired on the day of the calibration.
    """
    name, document = ("the options", {}) if path is None else (os.fspath(path), read_toml(path))
    trace: Json = {}
    for key, value in document.items():
        where = f"{name}, {key}"
        if key in _SAID:
            trace[key] = _SAID[key](value, where)
        elif key in ("environment", "certificate") and isinstance(value, dict):
            only(value, _CERTIFICATE if key == "certificate" else value, where)
            trace[key] = {name: _text(text, f"{where}.{name}") for name, text in value.items()}
        elif key == "reference" and isinstance(value, list):
            trace[key] = [_reference(reference, f"{where} {number}", name) for number, reference in enumerate(value, 1)]
        else:
            only({key: value}, (*_SAID, "[environment]", "[[reference]]", "[certificate]"), name)
    trace |= {key: _SAID[key](value, f"--{key}") for key, value in (stated or {}).items() if value is not None}
    _refuse_expired(trace, name)
    return trace


def missing(trace: Mapping[str, Any] | None) -> list[str]:
    """Return the keys that a certificate needs and that are not there."""
    certificate = (trace or {}).get("certificate") or {}
    there = {**(trace or {}), **{f"certificate.{key}": value for key, value in certificate.items()}}
    return [key for key in NEEDED if not there.get(key)]


def _text(value: Any, where: str) -> str:
    if not isinstance(value, str | int | float) or isinstance(value, bool) or not str(value).strip():
        raise InputError(f"{where}: a text is needed, found {value!r}.")
    return str(value).strip()


def _date(value: Any, where: str) -> str:
    try:
        return date.fromisoformat(str(value)[:10]).isoformat()
    except ValueError:
        raise InputError(f'{where}: a date such as "2026-03-04" is needed, found {value!r}.') from None


_SAID: dict[str, Callable[[Any, str], str]] = {
    **{key: _text for key in "serial model lot operator station fixture".split()},
    **{"date": _date, "received": _date},
}
"""What a file's first part and options say, and what makes it out."""


def _reference(entry: Any, where: str, name: str) -> dict[str, str]:
    if not isinstance(entry, dict):
        raise InputError(f"{where}: references stand below [[reference]], one table each.")
    only(entry, _REFERENCE, where)
    for key in ("name", "certificate"):
        if key not in entry:
            raise InputError(f"{where}: the {key} is missing.")
    reference = {key: (_date if key == "expires" else _text)(value, f"{where}.{key}") for key, value in entry.items()}
    if "file" in entry:
        path = Path(name).parent / reference["file"]
        reference |= {"file": str(path), "sha256": file_digest(path)}
    return reference


def _refuse_expired(trace: Mapping[str, Any], name: str) -> None:
    for reference in trace.get("reference", ()):
        if "expires" not in reference:
            continue
        holder, expires = reference["name"], reference["expires"]
        if "date" not in trace:
            raise InputError(
                f"{name}: state the date of the calibration (date = …), as the certificate of {holder} expires."
            )
        if expires < trace["date"]:
            raise InputError(
                f"{name}: the certificate {reference['certificate']} of {holder} expired on {expires}, before "
                f"the calibration of {trace['date']}. Have it calibrated again, or name the certificate that holds."
            )
