"""A fleet's run: what is missing is computed by an engine and kept, and the table is written when all is there."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from contextlib import closing
from pathlib import Path

from jaximu.fleets.engines import ENGINES
from jaximu.fleets.jobs import Job, Settings
from jaximu.fleets.store import Store
from jaximu.ground.cores import available_cores
from jaximu.ground.errors import FilePath, InputError


def run_fleet(
    jobs: Sequence[Job],
    output: FilePath,
    settings: Settings | None = None,
    engine: str = "local",
    workers: int | None = None,
    progress: Callable[[int, int, Counter], None] = lambda done, kept, statuses: None,
) -> Counter:
    """Calibrate every recording of a fleet, and diagnose it where that is asked for, into one Parquet table.

    Finished rows are kept beside `output` (in `<output>.parts`), a batch at a time: the same call after an interruption
    goes on where that stopped. The table appears at the end, whole, its rows in the order of `jobs`.

    **Arguments:**

    - `engine`: "local", or "ray" for a Ray cluster.
    - `workers`: processes; as many as there are cores if None.
    - `progress`: called with the rows that are there, how many of them were kept from an earlier run, and how often
      each status occurs among those computed now; with each batch, and every second or so without one.

    **Returns:** how often each status occurs. Raises `InputError` where the output is in use or cannot be written.
    """
    if engine not in ENGINES:
        raise InputError(f"--engine: {engine!r} is not one of {', '.join(ENGINES)}.")
    if not jobs:
        raise InputError("there are no recordings to calibrate.")
    settings = settings or Settings()
    path = Path(output)
    if not path.parent.is_dir():
        raise InputError(f"{path}: the folder {path.parent} does not exist.")
    statuses: Counter = Counter()
    with Store(path, [settings.key(job) for job in jobs]) as store:
        pending = store.pending()
        kept = done = len(jobs) - len(pending)
        progress(done, kept, statuses)
        if pending:
            with closing(ENGINES[engine](jobs, pending, settings, workers or available_cores())) as results:  # pyright: ignore[reportArgumentType]
                for places, rows in results:
                    if rows:
                        store.add(places, rows)
                    statuses.update(row["status"] for row in rows)
                    done += len(places)
                    progress(done, kept, statuses)
        if kept:
            statuses = Counter(row["status"] for group in store.rows() for row in group)
        store.close()
    return statuses
