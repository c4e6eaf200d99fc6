"""`jaximu simulate`: a specification into recordings and their truth."""

from __future__ import annotations

import inspect
import json
from dataclasses import MISSING, fields
from pathlib import Path

from tyro.conf import Positional

from jaximu.cli import options
from jaximu.cli.messages import progress, say
from jaximu.cli.options import option, switch, takes_options
from jaximu.cli.usage import paragraphs_about
from jaximu.ground.errors import InputError
from jaximu.ground.page import Code, Page, Section
from jaximu.ground.reexport import later


@takes_options
class SimulateCommand:
    """Simulate recordings from a specification: motion, sensor, effects and noise.

    The truth is written beside the recording, LOG.truth.json. Several units or recordings are numbered:
    LOG-0000.parquet, LOG-0001.parquet … A protocol with a table also writes its schedule, LOG.schedule.csv.

    Examples:
      jaximu simulate --explain
      jaximu simulate unit.toml -o log.parquet

    """

    specification_file: Path | None = option("SPEC", "TOML file; --explain describes it.", None, Positional)
    output: Path | None = option("LOG", "Recording to write; the suffix sets the format.", aliases=["-o"])
    protocols: bool = switch("List the protocols with their keys and exit.")
    explain: bool = switch("Describe the specification and exit.")
    as_json: options.JsonFlag = False

    def run(self) -> None:
        """Do what the command line says."""
        if self.explain:
            from jaximu.simulation import specification

            print(inspect.getdoc(specification))
            return
        if self.protocols:
            later("report.terminal", "show")(_protocols())
            return
        if self.specification_file is None or self.output is None:
            raise InputError("name a specification and where to write: jaximu simulate SPEC.toml -o LOG.parquet.")
        options.require_files(self.specification_file)
        from jaximu.recordings.write import check_suffix
        from jaximu.simulation import read_specification, write_case

        check_suffix(self.output)
        task = read_specification(self.specification_file)
        cases = task.cases()  # all of them are checked before anything is written
        if not self.output.parent.is_dir():
            raise InputError(f"{self.output}: the folder {self.output.parent} does not exist.")
        written = []
        for unit, recordings in enumerate(cases):
            for number, case in enumerate(recordings):
                path = _numbered(self.output, unit if task.units > 1 else None, number if task.recordings > 1 else None)
                with progress(f"simulating {path}"):
                    truth = write_case(case, path)
                truth.save(f"{path}.truth.json")
                if "attitude" in case.plan.columns:
                    truth.save_schedule(f"{path}.schedule.csv")
                for note in truth.notes:
                    say(f"{path}: {note}")
                duration = case.plan.motion.length
                facts = {"samples": case.samples, "duration": duration, "notes": list(truth.notes)}
                written.append({"file": str(path), "truth": f"{path}.truth.json"} | facts)
                if not self.as_json:
                    say(f"{path}: {case.samples} samples, {duration:g} s")
        if self.as_json:
            options.print_json({"specification": str(self.specification_file), "recordings": written})


def _numbered(output: Path, unit: int | None, recording: int | None) -> Path:
    stem = output.stem + ("" if unit is None else f"-{unit:04d}") + ("" if recording is None else f"-{recording}")
    return output.with_name(stem + output.suffix)


def _protocols() -> Page:
    """Return the page of the protocols, each with its keys as a specification has them."""
    from jaximu.simulation.protocols import PROTOCOLS

    parts = []
    for kind, protocol in PROTOCOLS.items():
        keys = [key.name + ("" if key.default is MISSING else f" = {_toml(key.default)}") for key in fields(protocol)]
        parts.append(Section(kind, (*paragraphs_about(protocol), Code("\n".join(keys)))))
    return Page("Protocols and their keys", (), first=parts)


def _toml(value: object) -> str:
    return json.dumps(list(value) if isinstance(value, tuple) else value)
