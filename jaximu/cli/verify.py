"""`jaximu verify`: is a result what was written, and are the files it rests on what they were?"""

from __future__ import annotations

from dataclasses import MISSING
from pathlib import Path

from tyro.conf import Positional

from jaximu.cli import options
from jaximu.cli.options import option, takes_options
from jaximu.ground.page import Page, Table
from jaximu.ground.reexport import later


@takes_options
class VerifyCommand:
    """Check a calibration.json or an acceptance.json, and every file behind it, against the hashes they carry.

    The exit status is 0 if all is intact, 3 if a file was changed, 4 if some cannot be checked and none was changed.

    Examples:
      jaximu verify results/calibration.json
      jaximu verify accepted/acceptance.json --folder archive/

    """

    documents: tuple[Path, ...] = option(
        "DOCUMENT [DOCUMENT ...]", "calibration.json or acceptance.json.", MISSING, Positional
    )
    folder: Path | None = option("DIR", "Look for moved recordings here, too.")
    as_json: options.JsonFlag = False

    def run(self) -> None:
        """Do what the command line says."""
        options.require_files(*self.documents)
        from jaximu.acceptance.verify import CHANGED, INTACT, verify

        links = [link for document in self.documents for link in verify(document, self.folder)]
        states = {link.state for link in links}
        changed = CHANGED in states
        verdict = "changed" if changed else "intact" if states == {INTACT} else "incomplete"
        if self.as_json:
            options.print_json({"verdict": verdict, "files": [vars(link) for link in links]})
        else:
            table = Table(
                ("state", "what", "file"),
                [(link.state, link.what, link.file) for link in links],
                marked=[index for index, link in enumerate(links) if link.state == CHANGED],
            )
            titles = {
                "changed": "Changed: at least one file is not what it was when the result was written.",
                "intact": "Intact: every file is what it was.",
                "incomplete": "Not changed as far as can be checked; --folder DIR names where missing files are.",
            }
            later("report.terminal", "show")(Page(titles[verdict], (), first=(table,)))
        if verdict != "intact":
            raise SystemExit(3 if changed else 4)
