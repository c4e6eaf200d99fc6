"""Simulating an hour at 100 Hz of six axes against NumPy and imu-error-model, and a day streamed to Parquet.

All three generate white noise, a random walk and flicker noise in every axis. The NumPy generator is written here as
one would: `standard_normal`, `cumsum`, and flicker by filtering a spectrum. Times are the medians of repetitions taken
in turn. imu-error-model (pip install imu-error-model) works sample by sample; it is timed over fewer samples and scaled
up.
"""

import os

os.environ.setdefault("JAX_PLATFORMS", "cpu")

import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import jax
import numpy as np
from common import Table, arguments, finish

from jaximu.model import BiasInstability, Noise, RandomWalk, White
from jaximu.simulation import Case, draw_imu, simulate, write_case
from jaximu.simulation.protocols import Static

jax.config.update("jax_enable_x64", True)

RATE, HOUR = 100.0, 360_000
FIGURES = {  # N, K, B in SI
    "accelerometer": ("specific_force", 1e-3, 1e-5, 2e-4),
    "gyroscope": ("angular_rate", 1e-4, 1e-6, 2e-5),
}
NOISE = {name: Noise((White(n), RandomWalk(k), BiasInstability(b)), q) for name, (q, n, k, b) in FIGURES.items()}


def numpy_noise(rng: np.random.Generator, samples: int, n: float, k: float, b: float) -> np.ndarray:
    white = rng.standard_normal((samples, 3)) * (n * np.sqrt(RATE))
    walk = np.cumsum(rng.standard_normal((samples, 3)) * (k / np.sqrt(RATE)), axis=0)
    spectrum = np.fft.rfft(rng.standard_normal((3, samples)))
    frequency = np.fft.rfftfreq(samples, 1 / RATE)
    frequency[0] = np.inf
    flicker = np.fft.irfft(spectrum * (b * np.sqrt(RATE / (2 * np.pi * frequency))), samples)
    return white + walk + flicker.T


def numpy_hour(seed: int) -> list[np.ndarray]:
    rng = np.random.default_rng(seed)
    imu, rest = draw_imu(1), {"accelerometer": [0.0, 0.0, 9.80665], "gyroscope": [0.0, 0.0, 0.0]}
    return [
        np.asarray(triad.gain) @ rest[name] + np.asarray(triad.bias) + numpy_noise(rng, HOUR, *FIGURES[name][1:])
        for name, triad in imu.triads().items()
    ]


def noise_hour(seed: int) -> list[np.ndarray]:
    return [noise.sample(HOUR, RATE, seed) for noise in NOISE.values()]


def whole_hour(seed: int):
    return simulate(draw_imu(1), Static(3600.0), NOISE, rate=RATE, seed=seed)[0]


def peer_hour(samples: int) -> float | None:
    """Seconds for an hour by imu-error-model, or None where it is not installed."""
    try:
        from imu_error_model import AxisConfig, ImuConfig, ImuModel
    except ImportError:
        return None
    axes = {
        name: AxisConfig(
            white_noise_density=n, bias_std=k, flicker_bias_std=b,
            flicker_min_correlation_time=0.01, flicker_max_correlation_time=1e5, flicker_components=14,
        )
        for name, (_, n, k, b) in FIGURES.items()
    }  # fmt: skip
    model = ImuModel(ImuConfig(**axes), np.random.default_rng(0))
    still, level = np.zeros(3), np.eye(3)
    began = time.perf_counter()
    for sample in range(samples):
        model.measure(sample / RATE, still, level)
    return (time.perf_counter() - began) * HOUR / samples


def medians(functions: dict, repetitions: int) -> dict[str, float]:
    taken: dict[str, list[float]] = {name: [] for name in functions}
    for repetition in range(repetitions + 1):  # the first compiles
        for name, function in functions.items():
            began = time.perf_counter()
            function(repetition)
            taken[name].append(time.perf_counter() - began)
    return {name: float(np.median(times[1:])) for name, times in taken.items()}


def streamed(hours: float) -> tuple[float, float]:
    """Peak memory (MB) and time (s) of a process that writes so many hours to Parquet."""
    code = (
        "import sys, time; sys.path.insert(0, sys.argv[2]); import simulation; began = time.perf_counter(); "
        "simulation.write_day(float(sys.argv[1]), sys.argv[3]); took = time.perf_counter() - began; "
        "print(simulation.peak_memory(), took)"
    )
    with tempfile.TemporaryDirectory() as folder:
        path = str(Path(folder) / "log.parquet")
        done = subprocess.run(
            [sys.executable, "-c", code, str(hours), str(Path(__file__).parent), path],
            capture_output=True, text=True, check=True,
        )  # fmt: skip
    memory, took = done.stdout.split()
    return float(memory), float(took)


def write_day(hours: float, path: str) -> None:
    write_case(Case.of(draw_imu(1), Static(3600.0 * hours), NOISE, RATE, 1), path)


def peak_memory() -> float:
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


def main() -> None:
    small = arguments(__doc__).small
    taken = medians({"numpy": numpy_hour, "noise": noise_hour, "whole": whole_hour}, 3 if small else 9)
    peer = peer_hour(2_000 if small else 20_000)
    hour, day = streamed(1.0), streamed(2.0 if small else 24.0)
    figures = {
        "numpy_seconds": taken["numpy"],
        "noise_seconds": taken["noise"],
        "noise_over_numpy": taken["noise"] / taken["numpy"],
        "whole_seconds": taken["whole"],
        "whole_over_numpy": taken["whole"] / taken["numpy"],
        "imu_error_model_seconds": peer,
        "imu_error_model_over_whole": None if peer is None else peer / taken["whole"],
        "hour_peak_mb": hour[0],
        "day_peak_mb": day[0],
        "day_seconds": day[1],
    }
    table = Table(
        "An hour at 100 Hz of six axes: white noise, random walk, flicker noise",
        ["generator", "seconds", "over NumPy", "goal"],
        "The NumPy generator's flicker is one Fourier filter over the whole hour; the one here is streamed.",
    )
    table.add("NumPy, K u + b + noise", f"{taken['numpy']:.3f}", "1", "")
    table.add("jaximu, noise alone", f"{taken['noise']:.3f}", f"{figures['noise_over_numpy']:.2f}", "≤ 1.6")
    table.add(
        "jaximu, `simulate`: motion, response, noise",
        f"{taken['whole']:.3f}",
        f"{figures['whole_over_numpy']:.2f}",
        "≤ 1.6",
    )
    if peer is not None:
        times = f"jaximu {figures['imu_error_model_over_whole']:.0f} times faster (goal 100)"
        table.add("imu-error-model, scaled up", f"{peer:.1f}", f"{peer / taken['numpy']:.0f}", times)
    memory = Table("Streamed to Parquet", ["hours", "peak memory [MB]", "seconds"])
    memory.add("1", f"{hour[0]:.0f}", f"{hour[1]:.1f}")
    memory.add("2" if small else "24", f"{day[0]:.0f}", f"{day[1]:.1f}")
    finish("simulation", [table, memory], figures, keep=not small)


if __name__ == "__main__":
    main()
