"""What every test gets: float64, the CPU, no window, repeatable examples, and the way to the measured data."""

import os

from environment import environment, few_memory_maps

os.environ.update(environment())

import gc
from pathlib import Path

import hypothesis
import jax
import pytest

from jaximu.ground import stored

jax.config.update("jax_enable_x64", True)
jax.config.update("jax_compilation_cache_dir", str(Path(os.environ["XDG_CACHE_HOME"]) / "jax"))
hypothesis.settings.register_profile("jaximu", derandomize=True, deadline=None, max_examples=25, database=None)
hypothesis.settings.load_profile("jaximu")
# Traced programs are many objects that live long: by default a sixth of the tests' time goes into looking through them.
gc.set_threshold(100_000, 20, 100)


def pytest_collection_finish():
    """What was loaded until now stays: the collector need not look at it. What a test traces is kept as the command
    line keeps it, for the other worker, the processes that tests start, and the next run."""
    gc.collect()
    gc.freeze()
    folder = Path(os.environ["XDG_CACHE_HOME"]) / "jaximu"
    folder.mkdir(mode=0o700, exist_ok=True)
    stored.cache(folder)


@pytest.fixture(scope="session")
def data_folder() -> Path:
    """The folder of measured recordings, named by JAXIMU_DATA; unset, the test skips (JAXIMU_REQUIRE_DATA=1: fails)."""
    named = os.environ.get("JAXIMU_DATA")
    if named:
        if not Path(named).is_dir():
            pytest.fail(f"JAXIMU_DATA names {named}, which is not a folder")
        return Path(named)
    reason = "needs measured recordings: set JAXIMU_DATA to their folder"
    if os.environ.get("JAXIMU_REQUIRE_DATA") == "1":
        pytest.fail(reason)
    pytest.skip(reason)


@pytest.fixture(scope="session")
def practice_folder(data_folder: Path) -> Path:
    """The practice recordings, beside the measured ones; missing ones fail, because the data is there."""
    folder = data_folder.parent / "practice"
    if not folder.is_dir():
        pytest.fail(f"{folder} is missing beside the measured data")
    return folder


@pytest.fixture(scope="session")
def unit_logs(tmp_path_factory) -> Path:
    """A folder of recordings of thirty units, all of one shape: `unit000.parquet` of `draw_imu(0)`, and so on."""
    # not at the top: pytest is to check the shapes in what they import
    from jaximu.recordings import write_recording
    from jaximu.simulation import consumer_noise, draw_imu, simulate
    from jaximu.simulation.protocols import HandHeld

    folder = tmp_path_factory.mktemp("unit_logs")
    for seed in range(30):
        recording, truth = simulate(draw_imu(seed), HandHeld(12, 1.5), consumer_noise(), seed=seed)
        write_recording(recording, folder / f"unit{seed:03d}.parquet")
        truth.save(folder / f"unit{seed:03d}.parquet.truth.json")
    return folder


@pytest.fixture(autouse=True, scope="module")
def _few_memory_maps():
    yield
    few_memory_maps()
