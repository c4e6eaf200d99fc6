"""Acceptance: a gauge study of measured units, false acceptances at a limit, ten thousand rows with limits and page.

`--small` leaves out most of it; the gauge study needs JAXIMU_DATA.
"""

import os
import resource
import subprocess
import sys
import tempfile
import time

os.environ.setdefault("JAX_PLATFORMS", "cpu")
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

from dataclasses import replace
from pathlib import Path

import jax
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from common import Table, arguments, finish

from jaximu import LocalGravity, ReadOptions, calibrate, read_recording
from jaximu.acceptance import Rule, follow, read_limits
from jaximu.acceptance.line import read_table
from jaximu.acceptance.quantities import measure, of_calibration
from jaximu.acceptance.statistics import gauge
from jaximu.fleets import PARAMETERS, SCHEMA, Job, Settings, rows_of
from jaximu.ground.distributions import chi2_sf, normal_isf
from jaximu.model.sensor import Imu, Triad
from jaximu.recordings import write_recording
from jaximu.simulation import consumer_noise, draw_imu, simulate
from jaximu.simulation.protocols import HandHeld

jax.config.update("jax_enable_x64", True)

MIMU4444 = ReadOptions(accel_scale="2048 count/g", gyro_scale="16.4 count/(deg/s)")
STOCKHOLM = LocalGravity(9.8184, 0.0)  # common to all recordings: it is no part of their scatter
NOMINAL = {"accelerometer": (np.full(3, 2048 / 9.80665), np.zeros(3)),
           "gyroscope": (np.full(3, np.degrees(16.4)), np.zeros(3))}  # fmt: skip
KINDS = {"bias": {"accelerometer": ("mm/s²", 1e3), "gyroscope": ("°/s", np.degrees(1))}, "scale": ("%", 100.0),
         "misalignment": ("mrad", 1e3)}  # fmt: skip
FREE = [place for place, name in enumerate(PARAMETERS)
        if name not in ("accelerometer.gain[0,1]", "accelerometer.gain[0,2]", "accelerometer.gain[1,2]")]  # fmt: skip
LIMITS = """
[limits]
"accelerometer.bias" = "0.1 m/s^2"
"accelerometer.scale" = "2 %"
"accelerometer.misalignment" = "20 mrad"
"gyroscope.bias" = "1 deg/s"
"gyroscope.scale" = "2 %"
"gyroscope.misalignment" = "20 mrad"
"accelerometer.output" = { within = "50 mg", over = "1 g" }
"""
AT = 0.1  # m/s²: the limit of the accelerometer's bias


def gauge_study(small):
    """Eight units on one board, each recorded in four sessions; every recording calibrated by itself."""
    folder = Path(os.environ["JAXIMU_DATA"]) / "mimu4444"
    values, sigmas, parts, sessions = [], [], [], []
    for unit in range(1, 4 if small else 9):
        for session in range(1, 5):
            recording = read_recording(folder / f"unit{unit}_session{session}.parquet", options=MIMU4444)
            units = of_calibration(calibrate(recording, STOCKHOLM))
            measured = measure(units, NOMINAL, ())
            values.append(measured.value[0])
            sigmas.append(measured.sigma[0])
            parts.append(str(unit))
            sessions.append(str(session))
    values, sigmas = np.array(values), np.array(sigmas)
    table = Table(
        f"Gauge study: {len(set(parts))} units of a MIMU4444 board, four sessions each, by hand",
        ["quantity", "repeatability", "between sessions", "between units", "ndc, worst and best axis",
         "observed / stated", "p", "the same without what a session does to all", "p"],
        "Standard deviations, root mean square over axes, by analysis of variance with units and sessions crossed. "
        "ndc: groups of units that can be told apart (AIAG: five or more). Observed / stated: scatter of a unit's "
        "recordings in multiples of the uncertainty that each calibration states; p: of as much by chance.",
    )  # fmt: skip
    figures = {}
    for owner in ("accelerometer", "gyroscope"):
        for part, shown in KINDS.items():
            unit, factor = shown[owner] if isinstance(shown, dict) else shown
            places = [k for k, name in enumerate(measured.names)
                      if name.startswith(f"{owner}.{part}[") and not measured.fixed[k]]  # fmt: skip
            found = [gauge(values[:, k], sigmas[:, k], parts, sessions) for k in places]
            square = lambda entries: float(np.sqrt(np.mean(np.square(entries))))  # noqa: E731
            sums = [
                scattered(values[:, k], sigmas[:, k], parts, sessions, own) for own in (False, True) for k in places
            ]
            ratios = []
            for half in (sums[: len(places)], sums[len(places) :]):
                total, freedom = (sum(each[at] for each in half) for at in (0, 1))
                ratios += [float(np.sqrt(total / freedom)), float(chi2_sf(total, freedom))]
            row = [factor * square([each.repeatability[0] for each in found]),
                   factor * square([each.reproducibility for each in found]),
                   factor * square([each.parts for each in found])]  # fmt: skip
            ndc = sorted(each.categories for each in found)
            table.add(f"{owner} {part}", *(f"{each:.2g} {unit}" for each in row), f"{ndc[0]} and {ndc[-1]}",
                      *(f"{each:.2g}" for each in ratios))  # fmt: skip
            figures[f"{owner} {part}"] = {
                "unit": unit, "repeatability": row[0], "sessions": row[1], "units": row[2], "ndc": ndc,
                "observed_over_stated": ratios[0], "p": ratios[1], "within_session": ratios[2], "p_within": ratios[3],
            }  # fmt: skip
    return table, figures


def scattered(values, sigma, parts, sessions, own):
    """χ² and degrees of freedom of recordings about their unit's mean; with `own`, and about their session's shift."""
    columns = [np.array(parts) == each for each in sorted(set(parts))]
    columns += [np.array(sessions) == each for each in sorted(set(sessions))[1:]] * own
    design = np.stack(columns, axis=1) / sigma[:, None]
    rest = values / sigma - design @ np.linalg.lstsq(design, values / sigma, rcond=None)[0]
    return float(rest @ rest), len(values) - design.shape[1]


def fleet_table(path, values, covariances, poses=30, excess=0.0, **columns):
    """A table as `jaximu fleet` writes it of units in SI; values (n, 21) of the free parameters."""
    count, low = len(values), np.tril_indices(len(PARAMETERS))
    whole, big = np.zeros((count, 24)), np.zeros((count, 24, 24))
    whole[:, FREE] = values
    big[np.ix_(range(count), FREE, FREE)] = covariances
    sigma = np.sqrt(np.diagonal(big, axis1=1, axis2=2))
    nominal = [1.0] * 3 + [0.0] * 3
    found = {
        "device": [f"unit{k}" for k in range(count)], "file": [f"unit{k}.csv" for k in range(count)],
        "status": ["ok"] * count, "accel_unit": ["m/s^2"] * count, "gyro_unit": ["rad/s"] * count,
        "accel_nominal": [nominal] * count, "gyro_nominal": [nominal] * count, "accel_rms": [1e-3] * count,
        "gyro_rms": [1e-2] * count, "poses": [poses] * count, "turns": [poses - 1] * count,
        "excess": np.full((count, 3), excess), "covariance": big[:, low[0], low[1]],
    }  # fmt: skip
    for start, triad in ((0, "accel"), (12, "gyro")):
        for part, first, size in (("gain", start, 9), ("bias", start + 9, 3)):
            found |= {f"{triad}_{part}": whole[:, first : first + size],
                      f"{triad}_{part}_sigma": sigma[:, first : first + size]}  # fmt: skip
    found |= columns
    arrays = [pa.array(list(found[each.name]) if each.name in found else [None] * count, each.type) for each in SCHEMA]
    pq.write_table(pa.table(arrays, schema=SCHEMA), path)
    return path


def drawn(rng, count, freedom=None):
    """Units whose accelerometer's bias x lies exactly at its limit: estimates and the covariances that they state."""
    mean = np.zeros(len(PARAMETERS))
    mean[[0, 4, 8, 12, 16, 20]] = 1.0
    mean[9] = AT
    factor = np.diag(np.where(np.arange(21) < 12, 2e-3, 1e-4)) @ (np.eye(21) + 0.3 * rng.standard_normal((21, 21)))
    values = mean[FREE] + rng.standard_normal((count, 21)) @ factor.T
    scale = np.ones(count) if freedom is None else rng.chisquare(freedom, count) / freedom
    return values, scale[:, None, None] * (factor @ factor.T)


def guard_bands(small, folder):
    """Units whose truth lies at a limit: one passes as often as the risk says, and no more."""
    count = 1000 if small else 10_000
    rng = np.random.default_rng(1)
    table = Table(
        f"False acceptances of {count} simulated units with one parameter exactly at its limit",
        ["rule", "uncertainty", "accepted (95 % bounds of the share)", "stated risk", "within the bounds"],
        "A unit at its limit conforms with none to spare: each one that passes is counted as false. Known: the "
        "covariance is the true one; from 9 degrees of freedom: it is estimated from scatter, for each unit anew.",
    )  # fmt: skip
    limits = folder / "limits.toml"
    limits.write_text(LIMITS)
    figures = {}
    cases = [("guarded", risk, None) for risk in (0.01, 0.025, 0.05)] + [("guarded", 0.05, 9), ("simple", 0.05, None)]
    for kind, risk, freedom in cases:
        values, covariances = drawn(rng, count, freedom)
        path = fleet_table(folder / "units.parquet", values, covariances, poses=9 + (freedom or 21),
                           excess=0.0 if freedom is None else 1e9)  # fmt: skip
        line = follow(read_table(path), replace(read_limits(limits), rule=Rule(kind, risk)))
        accepted = int(np.sum(line.judged.verdict[:, line.judged.names.index("accelerometer.bias[0]")] == "pass"))
        stated = risk if kind == "guarded" else 0.5
        half = float(normal_isf(0.025)) * np.sqrt(stated * (1 - stated) / count)
        inside = bool(abs(accepted / count - stated) <= half)
        words = "known" if freedom is None else f"from {freedom} degrees of freedom"
        table.add(kind, words, f"{100 * accepted / count:.2f} % ({100 * (stated - half):.2f} to "
                  f"{100 * (stated + half):.2f} % expected)", f"{100 * stated:g} %",
                  "yes" if inside else "no")  # fmt: skip
        figures[f"{kind} {risk} {words}"] = {"accepted": accepted, "count": count, "stated": stated, "inside": inside}
    return table, figures


def recorded(small, folder):
    """The same through recordings: simulated, segmented, fitted; their truth at the limit."""
    count = 40 if small else 200
    limits = folder / "limits.toml"
    limits.write_text(LIMITS)
    jobs = []
    for seed in range(count):
        unit = draw_imu(seed)
        gain = np.asarray(unit.accelerometer.gain)
        bias = np.array([AT * gain[0, 0], 0.0, 0.0])
        accelerometer = Triad(gain, bias)
        imu = Imu(accelerometer, unit.gyroscope)
        recording, _ = simulate(imu, HandHeld(24, 2.0), consumer_noise(), seed=seed)
        path = folder / f"unit{seed}.parquet"
        write_recording(recording, path)
        jobs.append(Job(f"unit{seed}", str(path)))
    rows = []
    for start in range(0, count, 32):
        rows += rows_of(jobs[start : start + 32], Settings(gravity=LocalGravity(9.80665, 0.0)))
    path = folder / "recorded.parquet"
    pq.write_table(
        pa.table([pa.array([row[each.name] for row in rows], each.type) for each in SCHEMA], schema=SCHEMA), path
    )
    line = follow(read_table(path), replace(read_limits(limits), rule=Rule("guarded", 0.05)))
    own = line.judged.verdict[:, line.judged.names.index("accelerometer.bias[0]")]
    passed, failed = int(np.sum(own == "pass")), int(np.sum(own == "fail"))
    half = float(normal_isf(0.025)) * np.sqrt(0.05 * 0.95 / len(own))
    table = Table(
        f"The same through {len(own)} simulated recordings (24 poses by hand) and `jaximu fleet`, guarded, risk 5 %",
        ["accepted", "rejected", "undecided", "expected of either"],
        "The noise holds slow bias, which the intervals of `fleet` leave out.",
    )
    table.add(f"{100 * passed / len(own):.1f} %", f"{100 * failed / len(own):.1f} %",
              f"{100 * (1 - (passed + failed) / len(own)):.1f} %", f"5 ± {100 * half:.1f} %")  # fmt: skip
    return table, {"count": len(own), "accepted": passed, "rejected": failed}


def big_table(small, folder):
    """Ten thousand rows: limits, charts, page and table, by the command."""
    count = 500 if small else 10_000
    rng = np.random.default_rng(2)
    values, covariances = drawn(rng, count)
    values[:, 6] += 0.02 * rng.standard_normal(count) - AT
    path = fleet_table(folder / "line.parquet", values, covariances,
                       date=[str(np.datetime64("2026-01-01") + k // 50) for k in range(count)],
                       lot=[f"lot {k // 500}" for k in range(count)],
                       station=[f"station {k % 3}" for k in range(count)])  # fmt: skip
    limits = folder / "limits.toml"
    limits.write_text(LIMITS)
    line = [sys.executable, "-m", "jaximu", "accept", str(path), "--limits", str(limits), "-o", str(folder / "page"),
            "--fail-on", "never"]  # fmt: skip
    times, processor = [], []
    for _ in range(2):
        began, used = time.perf_counter(), processor_time()
        subprocess.run(line, check=True, capture_output=True)
        times.append(time.perf_counter() - began)
        processor.append(processor_time() - used)
    size = (folder / "page" / "report.html").stat().st_size
    table = Table(
        f"`jaximu accept TABLE --limits` of {count} rows, three stations: verdicts, charts, page, table",
        ["", "processor time", "wall time", "goal"],
        f"The page has {size / 1e6:.2f} MB. Wall time is that of a machine that does other work beside it.",
    )
    for place, name in enumerate(("first run", "compiled before")):
        goal = f"20 s{', missed' if processor[place] > 20 else ''}"
        table.add(name, f"{processor[place]:.1f} s", f"{times[place]:.1f} s", goal)
    return table, {"rows": count, "processor_seconds": processor, "wall_seconds": times, "goal": 20.0}


def processor_time():
    """Seconds of the processor that finished child processes have taken; other work on the machine adds to none."""
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def main():
    """Measure and keep the tables."""
    options = arguments(__doc__)
    tables, figures = [], {}
    with tempfile.TemporaryDirectory() as name:
        jobs = {"guard_bands": guard_bands, "recorded": recorded, "big_table": big_table}
        if os.environ.get("JAXIMU_DATA"):
            jobs = {"gauge": lambda small, _: gauge_study(small), **jobs}
        for key, job in jobs.items():
            folder = Path(name) / key
            folder.mkdir()
            table, figures[key] = job(options.small, folder)
            tables.append(table)
    finish("acceptance", tables, figures, keep=not options.small)


if __name__ == "__main__":
    main()
