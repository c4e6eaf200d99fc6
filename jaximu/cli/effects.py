"""`jaximu effects`: the catalogue, as the code has it."""

from __future__ import annotations

import difflib
import inspect

from tyro.conf import Positional

import jaximu
from jaximu.cli import options
from jaximu.cli.options import option, takes_options
from jaximu.cli.usage import paragraphs_about
from jaximu.ground.document import Json, entries
from jaximu.ground.errors import InputError
from jaximu.ground.page import Page, Section, Table
from jaximu.ground.quantities import joined, plain, unit_text
from jaximu.ground.reexport import later

_SCOPES = {
    "device": "device: belongs to the unit and holds in other recordings",
    "session": "session: belongs to this recording",
    "fixture": "fixture: belongs to the set-up",
}
_ACTS_ON = {"input": "what the axes sense, before the gain", "output": "what the axes put out"}


@takes_options
class EffectsCommand:
    """List the effects that jaximu knows: formula, unit, scope, what excites each one and what it is mistaken for.

    Examples:
      jaximu effects
      jaximu effects gyro.g_sensitivity

    """

    name: str | None = option("[NAME]", "Show this effect in full.", None, Positional)
    as_json: options.JsonFlag = False

    def run(self) -> None:
        """Do what the command line says."""
        from jaximu.model.effects import CATALOGUE

        name, show = self.name, options.print_json if self.as_json else later("report.terminal", "show")
        if name is None:
            kinds = [*CATALOGUE.values()]
            show([_entry(kind) for kind in kinds] if self.as_json else _catalogue(kinds))
        elif name in CATALOGUE:
            show((_entry if self.as_json else _page)(CATALOGUE[name]))
        else:
            near = difflib.get_close_matches(name, CATALOGUE, n=3, cutoff=0.4)
            hint = f"near it are {', '.join(near)}" if near else "`jaximu effects` lists them"
            raise InputError(f"there is no effect {name!r} in the catalogue; {hint}.")


def _entry(kind: type[jaximu.Effect]) -> Json:
    return {
        **entries(kind, "name", "formula", "unit", "scope", "needs", "excited_by", "look_alikes", "typical"),
        **entries(kind, "recovery", "source"),
        "description": inspect.getdoc(kind),
        "coefficients": kind.size,
        "inner": {name: parameter._asdict() for name, parameter in kind.inner.items()},
        "acts_on": "set-up" if kind.owner == "setup" else kind.refers_to,
    }


def _catalogue(kinds: list[type[jaximu.Effect]]) -> Page:
    """Return the page of all effects."""
    parts = []
    for kind in kinds:
        inner = "".join(f" + {name.replace('_', ' ')}" for name in kind.inner)
        alike = f"; easily taken for {', '.join(kind.look_alikes)}" if kind.look_alikes else ""
        text = f"{kind.size}{inner}, {unit_text(kind.unit)}; {kind.scope}; excited by {kind.excited_by}{alike}"
        parts.append(Section(kind.title, (kind.formula, text)))
    return Page(f"{len(kinds)} effects", ("`jaximu effects NAME` shows one in full.",), first=parts)


def _page(kind: type[jaximu.Effect]) -> Page:
    """Return the page of one effect."""
    rows = [
        (
            "coefficients",
            f"{kind.size}, in {unit_text(kind.unit)}"
            + ('; "output" is the triad\'s output unit' if "output" in kind.unit else ""),
        ),
        ("usual size", f"{plain(kind.typical)}, for outputs in SI"),
        ("scope", _SCOPES[kind.scope]),
        (
            "acts on",
            "what the sensors go through, as against what the set-up says"
            if kind.owner == "setup"
            else _ACTS_ON[kind.refers_to],
        ),
        ("needs", ", ".join(need.replace("_", " ") for need in kind.needs)),
        ("excited by", kind.excited_by),
        ("easily taken for", ", ".join(kind.look_alikes) or "nothing else in the catalogue"),
        ("compensation", kind.recovery),
        ("source", kind.source),
    ]
    for inner, parameter in kind.inner.items():
        usual = joined(plain(parameter.typical), unit_text(parameter.unit))
        text = f"{parameter.meaning}; {usual}, from {plain(parameter.low)} to {plain(parameter.high)}"
        rows.append((inner.replace("_", " "), text))
    return Page(kind.title, (kind.formula,), first=(*paragraphs_about(kind), Table((), rows)))
