"""`jaximu allan`: the noise of a unit at rest, its terms with intervals, and the numbers that a filter takes."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING

import jaximu
from jaximu.cli import options
from jaximu.cli.messages import progress
from jaximu.cli.options import takes_options
from jaximu.ground.document import Json
from jaximu.ground.gravity import STANDARD

if TYPE_CHECKING:
    from jaximu.noise.analysis import NoiseAnalysis


@takes_options
class AllanCommand:
    """Identify the noise of a unit at rest from its Allan deviation; several LOGs show how repeatable its bias is.

    DIR receives allan.json, allan.png, report.html and imu.yaml for Kalibr.

    Examples:
      jaximu allan rest.csv -o noise
      jaximu allan monday.csv tuesday.csv wednesday.csv --json

    """

    logs: options.Logs
    log: options.LogOptions = options.READING
    results: options.Results = options.RESULTS

    def run(self) -> None:
        """Do what the command line says."""
        with progress("reading"):
            recordings = [stated.read(path, STANDARD, alone=True) for path, stated in self.log.spread(self.logs)]
        with progress("identifying the noise"):
            analysis = jaximu.allan(recordings)
            from jaximu.report.allan import kalibr_text, page_of

            text = json.dumps(document(analysis), indent=1, allow_nan=False)
            yaml = kalibr_text(analysis).encode("utf-8", "backslashreplace")
        names = "allan.json, allan.png, report.html and Kalibr's imu.yaml"
        sources = [source for recording in recordings for source in recording.sources]
        self.results.present(
            lambda: page_of(analysis, sources),
            names,
            {"allan.json": (text + "\n").encode(), "imu.yaml": yaml},
            lambda: text,
        )


def document(analysis: NoiseAnalysis) -> Json:
    """Return `allan.json`: the analysis, `mean` (each term over a triad's axes, see `mean_terms`), and `filter`."""
    from jaximu.ground.units import SENSOR_QUANTITIES
    from jaximu.model.data_sheet import SI_UNITS
    from jaximu.noise.filter_noise import filter_document, mean_terms

    mean: Json = {}
    for name, quantity in SENSOR_QUANTITIES.items():
        terms = mean_terms(analysis.axes[name]) if name in analysis.axes else None
        mean[name] = terms and {
            term: estimate and estimate.document(SI_UNITS[quantity][term]) for term, estimate in terms.items()
        }
    return analysis.document() | {"mean": mean, "filter": filter_document(analysis)}
