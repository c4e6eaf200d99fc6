"""Many units at once: jobs, rows, engines, and the fleet as evidence."""

from typing import TYPE_CHECKING

from jaximu.ground.reexport import lazily

if TYPE_CHECKING:
    from jaximu.fleets.fit import FleetUnit, fit_units
    from jaximu.fleets.jobs import Job, Settings, find_jobs, listed_jobs
    from jaximu.fleets.rows import PARAMETERS, SCHEMA, rows_of
    from jaximu.fleets.run import run_fleet

__all__ = [
    "PARAMETERS",
    "SCHEMA",
    "FleetUnit",
    "Job",
    "Settings",
    "find_jobs",
    "fit_units",
    "listed_jobs",
    "rows_of",
    "run_fleet",
]

__getattr__ = lazily(
    __name__,
    {
        "jaximu.fleets.fit": "FleetUnit, fit_units",
        "jaximu.fleets.jobs": "Job, Settings, find_jobs, listed_jobs",
        "jaximu.fleets.rows": "PARAMETERS, SCHEMA, rows_of",
        "jaximu.fleets.run": "run_fleet",
    },
)
