"""The fleet's job on Ray: tasks read and segment files, actors fit batches, rows stream back as they are done."""

from __future__ import annotations

import logging
import os
import pickle
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
import ray  # pyright: ignore[reportMissingImports]
import ray.data  # pyright: ignore[reportMissingImports]

from jaximu.fleets.jobs import ONE_THREAD, Job, Rows, Settings, batches, own_effects, register_all
from jaximu.fleets.rows import finish, read_job
from jaximu.ground import stored

__all__ = ["compute"]


def compute(jobs: Sequence[Job], indices: Sequence[int], settings: Settings, workers: int) -> Iterator[Rows]:
    """Give rows from the cluster that RAY_ADDRESS names, else from `workers` processes of a cluster of one's own.

    A worker that dies is replaced and its work is done again; the caller keeps each row once. Without a graphics
    processor Ray joins the two stages, so that a process fits what it has read.
    """
    away = "RAY_ADDRESS" in os.environ
    folder = None if away else stored.folder()  # on other machines there is no such folder
    started, effects = not ray.is_initialized(), own_effects()
    if started:
        where: dict[str, Any] = (
            {} if away else {"num_cpus": workers, "include_dashboard": False, "_node_ip_address": "127.0.0.1"}
        )
        ray.init(log_to_driver=False, logging_level=logging.ERROR, runtime_env={"env_vars": ONE_THREAD}, **where)
    logging.getLogger("ray.data").setLevel(logging.ERROR)
    ray.data.DataContext.get_current().enable_progress_bars = False

    def read(item: dict[str, Any]) -> dict[str, Any]:
        stored.prepare_process(folder)
        register_all(effects)
        return {"place": item["place"], "prepared": pickle.dumps(read_job(pickle.loads(item["job"]), settings))}

    class FittingActor:
        """Fits batches of prepared recordings, and keeps its compiled programs."""

        def __init__(self) -> None:
            stored.prepare_process(folder)
            register_all(effects)

        def __call__(self, batch: dict[str, np.ndarray]) -> dict[str, Any]:
            rows = finish([pickle.loads(item) for item in batch["prepared"]], settings)
            return {"place": batch["place"], "row": [pickle.dumps(row) for row in rows]}

    graphics = int(ray.cluster_resources().get("GPU", 0))
    cut = batches(indices, settings, workers)
    items = [{"place": index, "job": pickle.dumps(jobs[index])} for index in indices]
    try:
        rows = (
            ray.data.from_items(items, override_num_blocks=len(cut))
            .map(read, num_cpus=1)
            .map_batches(
                FittingActor,
                batch_size=len(cut[0]),
                num_cpus=1,
                num_gpus=1 if graphics else 0,
                compute=ray.data.ActorPoolStrategy(size=graphics or workers),
            )
        )
        for batch in rows.iter_batches(batch_size=None, batch_format="numpy"):
            yield [int(index) for index in batch["place"]], [pickle.loads(row) for row in batch["row"]]
    finally:
        if started:
            ray.shutdown()
