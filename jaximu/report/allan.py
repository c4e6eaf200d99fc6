"""The picture of a noise analysis: Allan deviations with bands, and the fitted terms."""

from __future__ import annotations

import os

import numpy as np

from jaximu.formats.atomic import atomic_write
from jaximu.noise.analysis import QUANTITIES, NoiseAnalysis
from jaximu.noise.datasheet import DATASHEET_UNITS, SI_UNITS, convert

__all__ = ["draw_allan"]

_COLOURS = {"x": "tab:red", "y": "tab:green", "z": "tab:blue"}


def draw_allan(analysis: NoiseAnalysis, path: str | os.PathLike[str]) -> None:
    """Draw each triad's overlapping Allan deviation (points, 95 % bands) and the fit (lines) into a PNG."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(5.5 * len(analysis.axes), 4.6), layout="constrained", dpi=130)
    FigureCanvasAgg(figure)
    panels = np.atleast_1d(figure.subplots(1, len(analysis.axes)))
    for panel, (name, axes) in zip(panels, analysis.axes.items(), strict=True):
        quantity = QUANTITIES[name]
        unit = DATASHEET_UNITS[quantity]["B"]
        factor = convert(1.0, SI_UNITS[quantity]["B"], unit)
        for (axis, colour), found in zip(_COLOURS.items(), axes, strict=True):
            tau, each = found.deviation.tau, found.deviation
            panel.fill_between(tau, factor * each.low, factor * each.high, color=colour, alpha=0.2, linewidth=0)
            panel.plot(tau, factor * each.value, ".", color=colour, markersize=5, label=f"{axis} measured")
            fine = np.geomspace(tau[0], tau[-1], 200)
            panel.plot(fine, factor * found.allan_deviation(fine), color=colour, linewidth=1, label=f"{axis} fitted")
        panel.set(
            xscale="log", yscale="log", xlabel="averaging time [s]", ylabel=f"Allan deviation [{unit}]", title=name
        )
        panel.grid(True, which="both", color="0.9")
        panel.legend(fontsize=8, ncols=3)
    with atomic_write(path) as temporary:
        figure.savefig(temporary, format="png")
