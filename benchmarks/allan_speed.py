"""The overlapping Allan deviation of six axes against allantools: time, memory, and what few phase points cost.

`python benchmarks/allan_speed.py`, six minutes; needs allantools. Times are the least of several runs, taken in turns
in one process. Memory is that of a fresh process, above what it held before the input was made.
"""

import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import jax
import numpy as np
from common import Table, arguments, finish

jax.config.update("jax_enable_x64", True)

from jaximu.noise import averaging_factors, deviation  # noqa: E402

RATE, AXES = 100.0, 6
NOISE = {
    "white": lambda k: -np.abs(k),
    "flicker": lambda k: k**2 * np.log(np.where(k == 0, 1.0, np.abs(k))),
    "random walk": lambda k: np.abs(k) * (k**2 - 1.0) / 6,
}
"""Generalised covariance of the phase, up to a constant and what the fourth difference does not see."""


def variance(noise: Callable, samples: int, factor: int, step: int) -> float:
    """Variance of the mean of squared differences, over its mean squared, of every `step`-th phase point; exact."""
    count = samples // step - 2 * (factor // step) + 1
    k = np.arange(min(count, 2 * factor * 20)) * float(step)
    weights = {0: 6, 1: -4, 2: 1}
    r = sum(w * (noise(k + i * factor) + noise(k - i * factor)) / (2 - (i > 0)) for i, w in weights.items())
    terms = (1 - np.arange(len(k)) / count) * (r / r[0]) ** 2
    return 2 * (2 * terms.sum() - terms[0]) / count


def loss(noise: Callable, samples: int, factor: int) -> float:
    """Increase of the variance by the multi-resolution deviation."""
    step = 1 << ((factor // 32).bit_length() - 1)
    return variance(noise, samples, factor, step) / variance(noise, samples, factor, 1) - 1


def held(which: str) -> float:
    """Memory of this process in bytes: VmRSS now, VmHWM at most. getrusage would count what the parent held."""
    lines = Path("/proc/self/status").read_text().splitlines()
    return 1024.0 * int(next(line.split()[1] for line in lines if line.startswith(which)))


def memory(what: str, samples: int, path: str) -> None:
    """Print the peak of memory above that before, over the size of the arrays. Run in a process of its own."""
    if what == "write":
        import pyarrow as pa
        import pyarrow.parquet as pq

        rng, names = (
            np.random.default_rng(0),
            [f"accel_{a} [m/s^2]" for a in "xyz"] + [f"gyro_{a} [rad/s]" for a in "xyz"],
        )
        columns = [np.arange(samples) / RATE] + [1e-2 * rng.standard_normal(samples) for _ in range(AXES)]
        columns[3] += 9.81
        pq.write_table(pa.table(dict(zip(["time [s]", *names], columns, strict=True))), path)
        return
    if what == "read":
        import pyarrow.parquet  # noqa: F401

        from jaximu.recordings.readers.reader import read_recording

        before = held("VmRSS")
        recording = read_recording(path)
        size = 7 * 8 * len(recording.accelerometer)
    else:
        deviation(np.random.default_rng(0).standard_normal((2, 1000)), RATE, resolution=what)
        before = held("VmRSS")
        values = np.random.default_rng(0).standard_normal((AXES, samples))
        deviation(values, RATE, factors=averaging_factors(samples, spacing=100), resolution=what)
        size = values.nbytes
    print((held("VmHWM") - before) / size)


def measured(what: str, samples: int, path: str = "") -> str:
    command = [sys.executable, __file__, "--memory", what, str(samples), path]
    return subprocess.run(command, check=True, capture_output=True, text=True).stdout


def main() -> None:
    small = arguments(__doc__).small
    import allantools

    sizes = {100_000: 3} if small else {1_000_000: 7, 10_000_000: 2}
    table = Table(
        "Overlapping Allan deviation, 6 axes, 100 averaging times spaced evenly in their logarithm",
        [
            "samples",
            "method",
            "seconds",
            "times as fast as allantools",
            "goal",
            "memory, input included, over the input",
        ],
        "Whole calls of `deviation`, with intervals and exponents.",
    )
    figures: dict = {"seconds": {}, "memory": {}, "loss": {}}
    for samples, runs in sizes.items():
        values = np.random.default_rng(1).standard_normal((AXES, samples))
        factors = averaging_factors(samples, spacing=100)
        ways = {
            "allantools": lambda v=values, f=factors: [
                allantools.oadev(axis, rate=RATE, data_type="freq", taus=f / RATE)[1] for axis in v
            ],
            "full": lambda v=values, f=factors: deviation(v, RATE, factors=f).value,
            "multi": lambda v=values, f=factors: deviation(v, RATE, factors=f, resolution="multi").value,
        }
        difference = np.max(np.abs(ways["full"]() / np.array(ways["allantools"]()) - 1))
        assert difference < 1e-9, difference
        ways["multi"]()
        seconds: dict[str, list[float]] = {name: [] for name in ways}
        for _ in range(runs):
            for name, run in ways.items():
                start = time.perf_counter()
                run()
                seconds[name].append(time.perf_counter() - start)
        del values
        figures["seconds"][samples] = seconds
        goals = {"allantools": "", "full": "≥ 6" if samples < 10**7 else "≥ 4", "multi": "≥ 12"}
        for name, goal in goals.items():
            most = float(measured(name, samples)) if goal else float("nan")
            figures["memory"][f"{name}, {samples}"] = most if goal else None
            ratio = min(seconds["allantools"]) / min(seconds[name])
            table.add(
                f"{samples:.0e}", name, f"{min(seconds[name]):.3f}", f"{ratio:.1f}", goal, f"{most:.2f}" if goal else ""
            )
    with tempfile.TemporaryDirectory() as scratch:
        samples, path = max(sizes), str(Path(scratch) / "log.parquet")
        measured("write", samples, path)
        figures["memory"]["read_recording"] = float(measured("read", samples, path))
    reading = Table(
        "Memory of reading a Parquet file of 7 columns", ["rows", "peak over the columns as float64", "goal"]
    )
    reading.add(f"{samples:.0e}", f"{figures['memory']['read_recording']:.2f}", "≤ 3")
    losses = Table(
        "Increase of the estimator's variance by the multi-resolution deviation, from theory",
        ["noise", "longest average an n-th of the recording: n = 1000", "n = 10", "n = 3", "goal"],
        "The largest over averages of 64 to 511 samples; longer ones keep as many points, and lose at most the limit, "
        "5/4/32² = 0.122 % for white noise.",
    )
    for name, noise in NOISE.items():
        cells = [max(loss(noise, n * m, m // 64 * 64 or m) for m in (64, 128, 256, 448)) for n in (1000, 10, 3)]
        figures["loss"][name] = cells
        losses.add(name, *(f"{100 * each:.4f} %" for each in cells), "< 0.2 %")
    finish("allan_speed", [table, reading, losses], figures, keep=not small)


if __name__ == "__main__":
    if sys.argv[1:2] == ["--memory"]:
        memory(sys.argv[2], int(sys.argv[3]), sys.argv[4])
    else:
        main()
