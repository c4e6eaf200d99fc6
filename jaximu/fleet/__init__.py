"""Many units at once: jobs, rows, engines, and the fleet as evidence."""

from jaximu.fleet.fit import Fitted, Unit, fit_units
from jaximu.fleet.jobs import Job, Settings, find_jobs
from jaximu.fleet.rows import PARAMETERS, SCHEMA, rows_of
from jaximu.fleet.run import run_fleet

__all__ = [
    "PARAMETERS",
    "SCHEMA",
    "Fitted",
    "Job",
    "Settings",
    "Unit",
    "find_jobs",
    "fit_units",
    "rows_of",
    "run_fleet",
]
