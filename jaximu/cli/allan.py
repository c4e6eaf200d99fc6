"""`jaximu allan`: the noise of a unit at rest, its terms with intervals."""

import json
from typing import Annotated

import numpy as np
import tyro

from jaximu.cli.calibrate import prepare_folder
from jaximu.cli.options import JsonFlag, LogOptions, Logs, OutputFolder, progress, say
from jaximu.formats.atomic import atomic_write
from jaximu.gravity import STANDARD
from jaximu.noise.analysis import QUANTITIES, NoiseAnalysis, analyse_noise
from jaximu.noise.datasheet import DATASHEET_UNITS, SI_UNITS, convert

__all__ = ["run"]

_MEANINGS = {
    "Q": "quantisation",
    "N": "white noise (random walk of the integral)",
    "B": "bias instability",
    "K": "rate random walk",
    "R": "rate ramp",
}


def run(
    logs: Logs,
    /,
    *,
    log: Annotated[LogOptions, tyro.conf.arg(name="")] = LogOptions(),  # noqa: B008
    output: OutputFolder = None,
    as_json: JsonFlag = False,
) -> None:
    """Identify the noise of a unit at rest from its Allan deviation; several logs tell the bias's repeatability too."""
    with progress("reading"):
        recordings = [log.read(path, STANDARD, check=False) for path in logs]
    with progress("identifying the noise"):
        analysis = analyse_noise(recordings)
    document = json.dumps(analysis.document(), indent=1, allow_nan=False)
    if output is not None:
        prepare_folder(output)
        with atomic_write(output / "allan.json") as temporary:
            temporary.write_text(document + "\n", encoding="utf-8")
        from jaximu.report.allan import draw_allan

        draw_allan(analysis, output / "allan.png")
        say(f"Written: {output / 'allan.json'}, {output / 'allan.png'}")
    if as_json:
        print(document)
    else:
        _print(analysis)


def _print(analysis: NoiseAnalysis) -> None:
    from rich.console import Console
    from rich.table import Table

    console = Console(highlight=False)
    for name, axes in analysis.axes.items():
        quantity = QUANTITIES[name]
        title = f"{name}, {analysis.rates[name]:.5g} Hz: continuous, two-sided, with 95 % intervals"
        table = Table("term", "unit", "x", "y", "z", title=title, title_justify="left")
        for term, meaning in _MEANINGS.items():
            found = [axis.terms[term] for axis in axes]
            if all(each is None for each in found):
                continue
            for place, unit in enumerate((DATASHEET_UNITS[quantity][term], SI_UNITS[quantity][term])):
                cells = []
                for each in found:
                    if each is None:
                        cells.append("not seen")
                        continue
                    value, low, high = (
                        float(convert(number, SI_UNITS[quantity][term], unit))
                        for number in (each.value, each.low, each.high)
                    )
                    cells.append(f"{value:.4g} ({low:.3g} … {high:.3g})")
                table.add_row(f"{term}, {meaning}" if place == 0 else "", unit, *cells)
        console.print(table)
        missing = [term for term in _MEANINGS if all(axis.terms[term] is None for axis in axes)]
        if missing:
            console.print(f"Not supported by the data on any axis: {', '.join(missing)}.", markup=False)
    for name, table in analysis.repeatability.items():
        unit = DATASHEET_UNITS[QUANTITIES[name]]["B"]
        numbers = np.asarray(convert(table, SI_UNITS[QUANTITIES[name]]["B"], unit))
        cells = ", ".join(f"{value:.4g} ({low:.3g} … {high:.3g})" for value, low, high in numbers)
        console.print(f"Repeatability of the {name}'s bias: {cells} {unit}", markup=False)
    for note in analysis.notes:
        console.print(f"note: {note}", markup=False)
