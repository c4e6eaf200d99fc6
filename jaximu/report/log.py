"""The page of all that logs allow: one verdict, what is in the logs, and a chapter for every verb that was run."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from jaximu.ground.page import Items, Page, Part, Section, Statement
from jaximu.ground.quantities import sentence
from jaximu.report.recording import log_page


def page_of(
    title: str,
    chapters: Mapping[str, Page],
    lead: str,
    documents: Sequence[Mapping[str, Any]],
    refused: Mapping[str, str],
    assumed: Sequence[str],
    after: str,
    whole: bool,
) -> Page:
    """Return the page of logs.

    **Arguments:** `chapters`: the page of each verb that was run; `lead` names the one whose verdict counts.
    `documents`: what `jaximu info` says of each log. `refused`: by verb, why it gave no result. `assumed`: what the
    logs do not say. `after`: the next command. `whole`: with what only HTML files show.
    """
    page = chapters[lead]
    parts: list[Part] = [
        Section("What was assumed", [Items(assumed)]),
        *(page.chapter(verb, whole) for verb, page in chapters.items()),
        Section("What these logs do not allow", [Statement(verb, sentence(text)) for verb, text in refused.items()]),
        *(log_page(document, ()).chapter(f"log{number}", whole) for number, document in enumerate(documents)),
    ]
    return Page(title, page.verdict[:1], page.number, page.meaning, parts, next=after, caution=page.caution)
