"""The fleet's job on Ray: tasks read and segment files, actors fit batches, rows come back as they are done."""

from __future__ import annotations

import logging
import os
from collections.abc import Iterator, Sequence
from typing import Any

import ray  # pyright: ignore[reportMissingImports]

from jaximu.fleets.jobs import ONE_THREAD, PATIENCE, Job, Rows, Settings, batches, own_effects, register_all
from jaximu.fleets.rows import ReadJob, finish, read_job
from jaximu.ground import stored
from jaximu.ground.document import Json

_AHEAD = 2
"""Batches that each actor has before it: one is read while another is fitted."""


def compute(jobs: Sequence[Job], indices: Sequence[int], settings: Settings, workers: int) -> Iterator[Rows]:
    """Give rows from the cluster that RAY_ADDRESS names, else from `workers` processes of a cluster of one's own.

    A worker that dies is replaced and its work is done again; the caller keeps each row once. With graphics
    processors each has one actor; without, the actors share the processors with the tasks that read.
    """
    away = "RAY_ADDRESS" in os.environ
    folder = None if away else stored.folder()  # on other machines there is no such folder
    started = not ray.is_initialized()
    effects = own_effects()
    if started:
        where: Json = {} if away else {"num_cpus": workers, "include_dashboard": False, "_node_ip_address": "127.0.0.1"}
        ray.init(log_to_driver=False, logging_level=logging.ERROR, runtime_env={"env_vars": ONE_THREAD}, **where)
    graphics = int(ray.cluster_resources().get("GPU", 0))

    @ray.remote(num_cpus=1, max_retries=-1)
    def read(job: Job) -> ReadJob:
        stored.prepare_process(folder)
        register_all(effects)
        return read_job(job, settings)

    class FittingActor:
        """Fits batches of prepared recordings, and keeps its compiled programs."""

        def __init__(self) -> None:
            stored.prepare_process(folder)
            register_all(effects)

        def rows(self, *prepared: ReadJob) -> list[Json]:
            return finish(prepared, settings)

    fitting: Any = ray.remote(num_cpus=0, num_gpus=1 if graphics else 0, max_restarts=-1, max_task_retries=-1)(
        FittingActor
    )
    left = iter(batches(indices, settings, workers))
    running = {}

    def give_work(actor: Any) -> None:
        if batch := next(left, None):
            running[actor.rows.remote(*[read.remote(jobs[index]) for index in batch])] = actor, batch

    try:
        for actor in [fitting.remote() for _ in range(graphics or workers)] * _AHEAD:
            give_work(actor)
        while running:
            ready, _ = ray.wait(list(running), timeout=PATIENCE)
            if not ready:
                yield (), []
            for one in ready:
                actor, batch = running.pop(one)
                give_work(actor)
                yield batch, ray.get(one)
    finally:
        if started:
            ray.shutdown()
