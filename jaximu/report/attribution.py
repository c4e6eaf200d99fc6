"""The page of units and sessions: each recording's verdict, what belongs to what, and common time courses."""

from collections.abc import Iterator, Sequence
from functools import partial

import numpy as np

from jaximu.diagnosis import COMMON_DRIFT, Attributed, Attribution, CommonDrift
from jaximu.diagnosis.diagnosis import stated_instead
from jaximu.ground.page import Page, Part, Picture, Statement, Table
from jaximu.ground.quantities import counted, listed, number, probability, readable, sentence, size, unit_text
from jaximu.mistakes.titles import effect_title
from jaximu.model.effects import CATALOGUE
from jaximu.report import figures
from jaximu.report.canvas import Figure
from jaximu.report.tables import p_text

_DRAWN = 8
"""Sessions whose common drift is drawn at most."""


def page_of(attribution: Attribution) -> Page:
    """Return the verdict, what belongs to units, sessions and the board, each recording's verdict, and time courses."""
    parts = attribution.recordings
    explained = sum(part.diagnosis["verdict"] != "unexplained" for part in parts)
    return Page(
        f"{counted(len(attribution.units), 'unit')} in {counted(len(attribution.sessions), 'session')}: "
        f"{attribution.verdict}",
        [*_verdict(attribution)],
        f"{explained} of {len(parts)}",
        "recordings whose model is adequate, or whose effects explain them",
        [*_first(attribution)],
        notes=attribution.notes,
        next=attribution.suggestion,
        caution=explained < len(parts),
    )


def _verdict(attribution: Attribution) -> Iterator[str]:
    texts = [_sentence(finding, attribution) for finding in attribution.findings if finding.name != COMMON_DRIFT]
    if attribution.common:
        yield drift_words(attribution.common, attribution.sessions)
    elif not texts:
        yield "Nothing repeats over the sessions of a unit or over the units of a session."
    yield from texts
    open_units = [part.unit for part in attribution.recordings if part.diagnosis["verdict"] == "unexplained"]
    if open_units:
        where = listed([unit for unit in attribution.units if unit in open_units])
        yield (
            f"{sentence(counted(len(open_units), 'recording'))} of unit{'s' * (len(set(open_units)) > 1)} {where} "
            f"{'stay' if len(open_units) > 1 else 'stays'} unexplained."
        )


def drift_words(common: Sequence[CommonDrift], sessions: Sequence[str]) -> str:
    """Say in which of all sessions units drift together, by how much, and how much of all drift that is."""
    where = _names("session", [drift.session for drift in common], sessions)
    sizes = listed([size(drift.size, "rad/s", 2) for drift in common])
    shares = [100 * drift.share for drift in common]
    share = f"{min(shares):.0f} %" if max(shares) - min(shares) < 1 else f"{min(shares):.0f} to {max(shares):.0f} %"
    return (
        f"All units drift together in {where}: one time course, by {sizes} in a usual axis, is {share} of the drift of "
        "all gyroscope axes."
    )


def _names(noun: str, names: Sequence[str], every: Sequence[str]) -> str:
    if len(names) == len(every):
        return f"all {noun}s"
    return f"{noun}{'s' * (len(names) > 1)} {listed(list(names))}"


def _sentence(finding: Attributed, attribution: Attribution) -> str:
    title = sentence(effect_title(finding.name))
    if finding.belongs_to == "unit":
        return f"{title} belongs to {_names('unit', finding.units, attribution.units)}: it repeats over the sessions."
    if finding.belongs_to == "session":
        sessions = _names("session", finding.sessions, attribution.sessions)
        return f"{title} belongs to {sessions}: the units have it in common there."
    return f"{title} belongs to the board: all units have it in common in all sessions."


def _first(attribution: Attribution) -> Iterator[Part]:
    yield from common_drift(attribution.drifts, attribution.common)
    yield Table(
        ("finding", "belongs to", "units", "sessions", "share", "p-value"),
        [
            (
                f"common drift ({COMMON_DRIFT})" if finding.name == COMMON_DRIFT else effect_title(finding.name),
                finding.belongs_to,
                _names("unit", finding.units, attribution.units),
                _names("session", finding.sessions, attribution.sessions),
                f"{100 * finding.share:.0f} %",
                p_text(finding.p_value),
            )
            for finding in attribution.findings
        ],
        "Share: of the squares of all recordings' estimates, weighted with their information; of a common drift, of "
        "the variance of all axes. p: that the part is not there, beside scatter from recording to recording.",
    )
    yield _verdicts_table(attribution)
    yield from _look_alikes(attribution)


def common_drift(drifts: Sequence[CommonDrift], common: Sequence[CommonDrift]) -> Iterator[Part]:
    """Draw what units of each session have in common in time, and say what could be behind that which is no chance."""
    clearest = sorted(drifts, key=lambda drift: drift.p_value)[:_DRAWN]
    if drifts:
        yield Picture(
            "attribution",
            partial(_drift_figure, [drift for drift in drifts if drift in clearest], common),
            "What the gyroscopes of a session have in common in time",
            "Coloured: the common time course of each session, in a usual axis. Grey: each axis that has a part in it, "
            "less what follows orientation, divided by its part; where grey follows the line, the course is common."
            + f" Of {len(drifts)} sessions the {_DRAWN} where it is clearest."
            * (len(drifts) > _DRAWN),
        )
    if common:
        yield Statement(
            "What the common drift could be",
            "Temperature that was not logged (warm-up after power-on), the supply, or the board bending: what acts on "
            "all units at once. It belongs to the session, so no unit's calibration contains it.",
        )


def _look_alikes(attribution: Attribution) -> Iterator[Statement]:
    for finding in attribution.findings:
        if finding.name in CATALOGUE and finding.belongs_to == "board" and attribution.latitude is None:
            for _, text in stated_instead(finding.name):
                yield Statement("What the common part may be", text, caution=True)


def _verdicts_table(attribution: Attribution) -> Table:
    cells = {
        (part.unit, part.session): f"{_short(part.diagnosis)}\nχ² {number(part.chi2_heldout, 3)}"
        + " *" * part.without_drift
        + " †" * bool(part.taken_off)
        for part in attribution.recordings
    }
    names = dict.fromkeys(effect_title(name) for part in attribution.recordings for name in part.taken_off)
    return Table(
        ("", *(f"session {session}" for session in attribution.sessions)),
        [
            (f"unit {unit}", *(cells.get((unit, session), "not recorded") for session in attribution.sessions))
            for unit in attribution.units
        ],
        "χ² per condition on parts left out: 1 is noise and drift alone."
        + (" *: the common drift was taken off, as the other units show it." if attribution.common else "")
        + (f" †: {listed(list(names))} was taken off, as the other recordings show it." if names else ""),
    )


def _short(diagnosis: dict) -> str:
    names = [effect["name"] for effect in diagnosis["effects"]]
    words = ", ".join(CATALOGUE[name].english if name in CATALOGUE else name for name in names)
    return ": ".join(filter(None, (diagnosis["verdict"] if diagnosis["verdict"] != "effects" else "", words)))


def _drift_figure(drifts: Sequence[CommonDrift], common: Sequence[CommonDrift]) -> Figure:
    factor, unit = readable("rad/s", max(drift.size for drift in drifts))
    figure, grid = figures.stacked(len(drifts), 2.0, 1.0, across="time (s)", sharex=True, sharey=True)
    for axes, drift in zip(grid, drifts, strict=True):
        for line in drift.axes:
            axes.plot(drift.times, factor * line, color=figures.BEFORE, linewidth=0.6, alpha=0.5)
        more, color = ("more", figures.AFTER) if drift in common else ("no more", figures.FLAGGED)
        axes.plot(drift.times, factor * drift.curve, color=color, linewidth=2)
        figures.dressed(axes, level=0.0)
        text = f"{more} in common than independent drift, p {probability(drift.p_value)}"
        axes.set_title(f"session {drift.session}: {text}", loc="left", fontsize=9)
        axes.set_ylabel(f"rate ({unit_text(unit)})", fontsize=8)
    spread = factor * max(float(np.abs(drift.curve).max()) for drift in drifts)
    grid[0].set_ylim(-2 * spread, 2 * spread)
    return figure
