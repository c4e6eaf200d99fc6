"""Error budgets against Monte Carlo through the whole estimator: the dividing head and the 24 positions.

Sessions with all errors at once are simulated as stations and calibrated by `fit_turntable` from the data sheet on, its
weights estimated from each session; the budget is one derivative of the fit. The head's set-up is an example in the
manner of the dividing-head paper (CSNC 2011): its sizes are assumed, not the paper's.
"""

import os
import time
from typing import Any

os.environ.setdefault("JAX_PLATFORMS", "cpu")

import jax
import numpy as np
from common import Table, arguments, finish

from jaximu.estimation.uncertainty import describe
from jaximu.planning.budget import budget
from jaximu.planning.setup_errors import task
from jaximu.report.budget import amount, goal_words, parameter_rows, source_rows

jax.config.update("jax_enable_x64", True)

UNIT = {
    "accelerometer": {
        "scale": 0.01,
        "bias": "20 mg",
        "noise": {"white": "100 ug/sqrt(Hz)", "density": "two-sided", "bias_instability": "30 ug",
                  "bias_instability_is": "B"},
    },
    "gyroscope": {
        "scale": -0.01,
        "bias": "0.5 deg/s",
        "noise": {"white": "0.3 deg/sqrt(h)", "bias_instability": "8 deg/h", "bias_instability_is": "B"},
    },
}  # fmt: skip
SHARED = {
    "tilt": "0.02 deg",
    "angle_setting": "0.01 deg",
    "gravity": "2e-4 m/s^2",
    "timing": "5 ms",
    "drift": {"gyroscope": "20 deg/h/h"},
    "temperature": {"accelerometer": "0.05 mg/K", "gyroscope": "0.002 deg/s/K", "span": "2 K"},
    "truncated": {"accel.quadratic": 1e-5},
}
SCHEMES = {
    "dividing head": {
        "protocol": {"kind": "dividing-head"},
        "environment": {"latitude": 30.5},
        "errors": SHARED
        | {
            "mounting": "0.02 deg",
            "orthogonality": "20 arcsec",
            "vibration": {"rms": "1 m/s^2", "rectification": "0.05 deg/s/g^2", "noise": "0.01 deg/s/sqrt(Hz)"},
        },
        "goal": {"accelerometer.bias": "0.2 mg", "gyroscope.scale": "200 ppm"},
    },
    "24 positions": {
        "protocol": {"kind": "positions", "count": 24},
        "environment": {"latitude": 30.5},
        "errors": SHARED | {"mounting": "0.02 deg"},
        "goal": {"accelerometer.bias": "0.2 mg", "gyroscope.scale": "200 ppm"},
    },
}


def main() -> None:
    chosen = arguments(__doc__)
    draws = 256 if chosen.small else 2048
    figures: dict[str, Any] = {"draws": draws}
    tables = []
    for name, document in SCHEMES.items():
        began = time.perf_counter()
        found = budget(task(document | UNIT, name), draws)
        seconds = time.perf_counter() - began
        assert found.check is not None and found.determined.all()
        ratio = found.check.rms / found.total
        sources = Table(f"{name}: sources, dominant first", ["source", "size (1σ)", "mean share", "most of"])
        for cells in source_rows(found):
            sources.add(*cells)
        worst = float(np.max(np.abs(ratio - 1)))
        note = (
            f"{draws} sessions, {found.check.failed} not converged, {seconds:.0f} s in all. Ratio on average "
            f"{ratio.mean():.4f}, farthest from one by {100 * worst:.1f} %; chance alone is "
            f"{100 / np.sqrt(2 * draws):.1f} % (1σ) for each. "
            + " ".join(f"{goal.name} to {goal.text}: {goal_words(found, goal)}" for goal in found.goals)
        )
        compared = Table(
            f"{name}: budget and Monte Carlo, 1σ", ["parameter", "budget", "Monte Carlo", "ratio", "of"], note
        )
        made = {words: parts for words, _, parts, _ in parameter_rows(found)}
        for place, parameter in enumerate(found.names):
            words, unit = describe(parameter, found.imu), found.units[place]
            both = (amount(float(each[place]), unit) for each in (found.total, found.check.rms))
            compared.add(words, *both, f"{ratio[place]:.3f}", made[words])
        tables += [sources, compared]
        figures[name] = {
            "ratio_mean": float(ratio.mean()),
            "ratio_worst": worst,
            "failed": found.check.failed,
            "seconds": seconds,
            "budget": found.document(),
        }
    finish("budget", tables, figures, keep=not chosen.small)


if __name__ == "__main__":
    main()
