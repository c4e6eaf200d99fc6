"""The page of a guided recording while it is made: how to hold the unit next, what counted, what is still uncertain."""

import time
from collections.abc import Callable, Hashable
from dataclasses import dataclass
from functools import partial, reduce
from typing import Any

import numpy as np
from markupsafe import Markup, escape
from scipy.spatial.transform import Rotation

from jaximu.calibration import Calibration
from jaximu.ground.array_types import FloatArray
from jaximu.ground.page import Picture
from jaximu.ground.quantities import size
from jaximu.planning.guide import Moment
from jaximu.planning.poses import turned_to
from jaximu.report import figures, vector
from jaximu.report.box import AXES_WORDS, draw_floor, draw_unit
from jaximu.report.canvas import Figure
from jaximu.report.html import environment, failure, packaged
from jaximu.report.uncertainty import at_rest, poses_on_sphere, sphere_figure
from jaximu.simulation.protocols.course import attitude_of

_LASTING = 1.0  # s after which a stage is shown: most take less
_STEP = np.radians(1.0)  # change of an attitude for which the unit is drawn again
_POSE, _NEXT = "white", figures.FLAGGED
_CAPTION = f"As the person who holds the unit sees it, a little from above; its heading does not matter. {AXES_WORDS}"


@dataclass(frozen=True)
class Capture:
    """Where a guided recording stands.

    rest: s that a pose must rest. moment: None before the first look. news: what was said last. stage, since: what
    takes time now, and when it began (s of the monotonic clock). end: how the recording ended, "" while it goes on.
    """

    rest: float
    moment: Moment | None = None
    news: str = ""
    stage: str = ""
    since: float = 0.0
    end: str = ""


class LivePage:
    """A page in parts by the ids of their elements, drawn from `capture`, which is replaced as the recording goes on.

    A drawing is kept until what it shows changes. One thread at a time may ask for parts.
    """

    def __init__(self, rest: float) -> None:
        self.capture, self.script = Capture(rest), packaged("guide.js")
        self._drawings: dict[str, tuple[Hashable, str]] = {}
        self._most: float | None = None
        self._macros: Any = environment().get_template("guide.html.jinja").module

    def html(self) -> str:
        """Return the page as it is by now."""
        return str(self._macros.page(_CAPTION, {name: Markup(text) for name, text in self.parts().items()}))

    def parts(self) -> dict[str, str]:
        """Return what stands in each element of the page, as HTML."""
        capture = self.capture
        moment = capture.moment
        lasting = time.monotonic() - capture.since > _LASTING and not capture.end
        texts = {"headline": _headline(capture), "news": capture.news, "stage": capture.stage * lasting}
        parts = {name: str(escape(text)) for name, text in texts.items()}
        return parts if moment is None else parts | self._parts_of(moment, bool(capture.end or moment.done))

    def _parts_of(self, moment: Moment, over: bool) -> dict[str, str]:
        rest = self.capture.rest
        ups = moment.ups
        still = min(moment.still, rest)
        first = attitude_of(ups[0] if len(ups) else moment.held).as_quat(scalar_first=True)
        before = reduce(turned_to, ups[1:], first)  # from pose to pose by the shortest turn: its heading is not known
        parts = {
            "rest": str(self._macros.bar(still, rest, f"{still:.1f} of {rest:g} s at rest")),
            "now": self._unit("now", turned_to(before, moment.held), "The unit as it is held now"),
            "words": "any orientation",
            "poses": self._progress(moment),
            "map": self._map(moment, over),
        }
        if over:
            return parts | {"rest": "", "held": "", "words": "nothing", "next": ""}
        if moment.up is None:
            return parts
        angle = np.degrees(np.arccos(np.clip(moment.held @ moment.up, -1.0, 1.0)))
        return parts | {
            "held": f"{angle:.0f}° from the next pose",
            "words": str(escape(moment.words)),
            "next": self._unit("next", turned_to(before, moment.up), f"The unit with {moment.words}"),
        }

    def _progress(self, moment: Moment) -> str:
        count = len(moment.taken)
        if not moment.goals:
            return str(self._macros.bar(count, moment.wanted, f"{count} of {moment.wanted} poses count"))
        goals = [(goal.text, goal.words, goal.reached) for goal in moment.goals]
        return str(self._macros.goals(f"{count} pose{'s' * (count != 1)} count{'s' * (count == 1)}", goals))

    def _unit(self, name: str, attitude: FloatArray, alternative: str) -> str:
        draw = partial(_unit_figure, attitude)
        return self._kept(name, (attitude / _STEP).round().tobytes(), lambda: Picture(name, draw, alternative))

    def _map(self, moment: Moment, over: bool) -> str:
        ups = moment.ups
        names = [f"pose {index}" for index in range(1, len(ups) + 1)]
        colors = [_POSE] * len(names)
        if moment.up is not None and not over:
            ups, names, colors = np.vstack([ups, moment.up]), [*names, f"next: {moment.words}"], [*colors, _NEXT]
        return self._kept("map", ups.tobytes(), lambda: self._mapped(moment.calibration, ups, names, colors))

    def _mapped(self, calibration: Calibration | None, ups: FloatArray, names: list[str], colors: list[str]) -> Picture:
        half = np.zeros(0) if calibration is None else at_rest(calibration)
        finite = half[np.isfinite(half)]
        if not len(finite):
            draw: Callable[[], Figure] = partial(_poses_figure, ups, names, colors)
            caption = "Hatched: not known yet. Colours come with the first calibration, after nine poses."
        else:
            worst = float(finite.max())
            self._most = self._most or worst
            draw = partial(sphere_figure, half, ups, names, colors=colors, most=self._most)
            caption = (
                f"Colours: 95 % of the corrected specific force at rest over the direction that points up, ±"
                f"{size(worst, 'm/s^2', 2)} at most. The first map had ±{size(self._most, 'm/s^2', 2)}: as the "
                "uncertainty shrinks, the colours fade."
            )
        return Picture(
            "map", draw, "Poses on a map of all orientations", f"{caption} Numbers: poses; orange: the next."
        )

    def _kept(self, name: str, key: Hashable, make: Callable[[], Picture]) -> str:
        kept, text = self._drawings.get(name, (None, ""))
        if kept != key:
            try:
                picture = make()
                text = str(self._macros.picture(picture, vector.drawing(picture.draw(), name)))
            except Exception as error:  # the recording goes on
                text = str(escape(failure(f"The figure “{name}”", error)))
            self._drawings[name] = key, text
        return text


def _headline(capture: Capture) -> str:
    moment = capture.moment
    if capture.end or moment is None:
        return capture.end or "Waiting for the first samples"
    if moment.done:
        return f"Done: {len(moment.taken)} poses count"
    if 0 < moment.still < capture.rest:
        return "Hold still"
    turn = f"Turn to {moment.words}" if moment.words else "Hold the unit still in any orientation"
    return f"Pose {len(moment.taken)} counts. {turn}" if moment.still and len(moment.taken) else turn


def _unit_figure(attitude: FloatArray) -> Figure:
    figure = figures.new_figure(3.4, 3.2)
    axes = figure.subplots()
    axes.set_axis_off()
    axes.set_aspect("equal")
    draw_floor(axes, by_hand=True)
    draw_unit(axes, Rotation.from_quat(attitude, scalar_first=True).as_matrix())
    axes.set_ylim(-1.75, 1.4)
    return figure


def _poses_figure(*poses: Any) -> Figure:
    return poses_on_sphere(*poses)[0]
