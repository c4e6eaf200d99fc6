"""Engines: they compute the rows of jobs, here or on a cluster. The job is the same; only who works on it differs.

An engine takes all jobs and the places of those that are wanted, and gives batches of (places, rows) in any order,
and empty ones while it waits.
"""

from __future__ import annotations

import multiprocessing
import multiprocessing.connection
import os
import threading
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager

from jaximu.fleets.jobs import ONE_THREAD, PATIENCE, Job, Rows, Settings, batches, own_effects, register_all
from jaximu.fleets.rows import row_begun, rows_of
from jaximu.ground.errors import InputError

Engine = Callable[[Sequence[Job], Sequence[int], Settings, int], Iterator[Rows]]
_TRIES = 2
"""Times that a batch may bring its process down before its jobs are tried one by one."""
_DIED = "the process that computed this row died twice: the file may need more memory than there is"


def local(jobs: Sequence[Job], places: Sequence[int], settings: Settings, workers: int) -> Iterator[Rows]:
    """Compute in this process (`workers` 1), or in as many others on this machine."""
    cut = batches(places, settings, workers)
    if workers == 1 or len(cut) == 1:
        for part in cut:
            yield part, rows_of([jobs[index] for index in part], settings)
        return
    waiting = deque((part, 0) for part in cut)  # with how often each has seen its pool break
    while waiting:
        yield from _one_pool(jobs, waiting, settings, workers)


def _one_pool(jobs: Sequence[Job], waiting: deque, settings: Settings, workers: int) -> Iterator[Rows]:
    """Work until all is done, or a process dies; then what was being computed is put back."""
    alone = waiting[0][1] >= _TRIES  # suspects run one at a time, so that it is known which one it was
    running = {}
    with _quiet_threads(), _pool(1 if alone else workers) as pool:
        broken = False
        while running or (waiting and not broken):
            room = 1 if alone else 2 * workers
            while waiting and len(running) < room and not broken and (waiting[0][1] >= _TRIES) == alone:
                part, strikes = waiting[0]
                try:
                    future = pool.submit(rows_of, [jobs[index] for index in part], settings)
                except BrokenProcessPool:  # a process died before it had a batch: this one is not to blame
                    broken = True
                    break
                except (OSError, ValueError):  # or while another was being started, which then finds pipes closed
                    if alone:
                        raise
                    waiting[0] = part, strikes + 1
                    broken = True
                    break
                waiting.popleft()
                running[future] = part, strikes
            if not running:
                return
            finished = wait(running, PATIENCE, FIRST_COMPLETED).done
            if not finished:
                yield (), []
            for future in finished:
                part, strikes = running.pop(future)
                try:
                    yield part, future.result()
                except BrokenProcessPool:
                    broken = True
                    if len(part) == 1 and alone:
                        yield part, [row_begun(jobs[part[0]]) | {"status": "failed", "message": _DIED}]
                    elif strikes + 1 >= _TRIES:
                        waiting.extend(([index], _TRIES) for index in part)
                    else:
                        waiting.appendleft((part, strikes + 1))


@contextmanager
def _pool(workers: int) -> Iterator[ProcessPoolExecutor]:
    """Processes that end with this one, however it ends, and that leave Ctrl-C to it."""
    from jaximu.ground import stored

    context = multiprocessing.get_context("spawn")  # a forked JAX may hang
    pool = ProcessPoolExecutor(workers, context, initializer=_begin, initargs=(stored.folder(), own_effects()))
    try:
        yield pool
    finally:
        # they are idle, or not wanted any more; a broken pool waits for ever for one that was just being started
        for process in list((pool._processes or {}).values()):
            process.kill()
        pool.shutdown(wait=True, cancel_futures=True)


def _begin(folder, effects: Sequence[str]) -> None:
    import signal

    from jaximu.ground import stored

    signal.signal(signal.SIGINT, signal.SIG_IGN)
    parent = multiprocessing.parent_process()
    assert parent is not None

    def end_with_parent():
        multiprocessing.connection.wait([parent.sentinel])
        os._exit(1)

    threading.Thread(target=end_with_parent, daemon=True).start()
    stored.prepare_process(folder)
    register_all(effects)


@contextmanager
def _quiet_threads() -> Iterator[None]:
    """One thread a process: with as many processes as cores, more only get into each other's way."""
    before = {name: os.environ[name] for name in ONE_THREAD if name in os.environ}
    os.environ.update(ONE_THREAD)
    try:
        yield
    finally:
        for name in ONE_THREAD:
            os.environ.pop(name, None)
        os.environ.update(before)


def _ray(jobs: Sequence[Job], places: Sequence[int], settings: Settings, workers: int) -> Iterator[Rows]:
    try:
        from jaximu.fleets.cluster import compute
    except ImportError as error:
        raise InputError(
            f"--engine ray needs Ray ({error}): pip install 'jaximu[cluster]', or leave the option out."
        ) from error
    return compute(jobs, places, settings, workers)


ENGINES: dict[str, Engine] = {"local": local, "ray": _ray}
"""By their names on the command line."""
