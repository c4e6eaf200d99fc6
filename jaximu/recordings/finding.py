"""`Finding`: a mistake in a recording, named, with its rows and what can be done about it."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

import numpy as np

from jaximu.ground.array_types import IntArray
from jaximu.ground.document import Json
from jaximu.recordings.recording import Recording

Rows = IntArray
NO_ROWS: Rows = np.zeros(0, np.int64)


@dataclass(frozen=True)
class Finding:
    """A mistake in a recording, and what can be done about it.

    name: "data.zeros" and so on. rows: the first rows concerned, counted from 1. text: what is wrong and what to do.
    repair: the option to paste. rivals: mistakes that would look exactly the same. spoils: parameters and effects
    cannot be trusted while it stands. refuses: nothing can be calibrated from this sensor ("accelerometer" …) at all,
    or by "gravity".
    partial: a repair cannot find all of it, so that what is left may still look like an effect.
    apply: changes the recording as the repair does; done without being asked where `repair` is empty. without: rows of
    each sensor, counted from 0, that are no measurement and are left out. numbers: what the text states of each sensor:
    the corner (Hz) of a filter.
    """

    name: str
    rows: tuple[int, ...]
    text: str
    repair: str = ""
    rivals: tuple[str, ...] = ()
    spoils: bool = False
    refuses: str = ""
    partial: bool = False
    apply: Callable[[Recording], Recording] | None = field(default=None, compare=False, repr=False)
    without: Mapping[str, Rows] = field(default_factory=dict, compare=False, repr=False)
    numbers: Mapping[str, float] = field(default_factory=dict)

    def document(self) -> Json:
        """Return the finding as `diagnosis.json` has it."""
        document: Json = {"name": self.name, "rows": list(self.rows), "text": self.text}
        if self.repair:
            document["repair"] = self.repair
        if self.rivals:
            document["indistinguishable_from"] = list(self.rivals)
        return document
