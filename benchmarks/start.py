"""How soon the command answers, in times of `python -c "import jax, optimistix"`. `python benchmarks/start.py`

Wall clock, the least of several runs (`--small`: of one) over the least of as many of the yardstick in turn with them.
Empty cache: each run has a new XDG_CACHE_HOME, as on a user's first day.
"""

import os
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

from common import Table, arguments, finish

YARDSTICK = ("-c", "import jax, optimistix")


@dataclass(frozen=True)
class Case:
    """A command with its exit status, the most it may take (times the yardstick; None: no goal), and how often to run.

    `empty`: with a new cache each time.
    """

    command: tuple[str, ...]
    goal: float | None = None
    runs: int = 9
    status: int = 0
    empty: bool = False


def cases(log: Path, folder: Path) -> dict[str, Case]:
    """The rows of the table."""
    calibrate, diagnose = (("-m", "jaximu", verb, str(log), "--json") for verb in ("calibrate", "diagnose"))
    demo = "-m", "jaximu", "demo", "-o", str(folder / "demo")
    return {
        "--help": Case(("-m", "jaximu", "--help"), 0.15),
        "--version": Case(("-m", "jaximu", "--version"), 0.15),
        "an option that there is not": Case(("-m", "jaximu", "calibrate", "--nonsense"), 0.15, status=2),
        "no log named": Case(("-m", "jaximu", "calibrate"), 0.15, status=2),
        "calibrate --json": Case(calibrate, 1.3, runs=5),
        "calibrate --json, empty cache": Case(calibrate, 4.0, runs=2, empty=True),
        "diagnose --json": Case(diagnose, 3.0, runs=3),
        "diagnose --json, empty cache": Case(diagnose, 9.0, runs=2, empty=True),
        "demo": Case(demo, 4.0, runs=3),
        "demo, empty cache": Case(demo, 12.0, runs=2, empty=True),
    }


def seconds(command: tuple[str, ...], cache: str, status: int = 0) -> float:
    """Run Python with a cache folder; stop with what it wrote where it ends otherwise than it should."""
    given = {name: value for name, value in os.environ.items() if name != "PYTHONDONTWRITEBYTECODE"}  # as users have it
    began = time.perf_counter()
    done = subprocess.run([sys.executable, *command], capture_output=True, text=True, encoding="utf-8",
                          env={**given, "PYTHONUTF8": "1", "XDG_CACHE_HOME": cache})  # fmt: skip
    took = time.perf_counter() - began
    if done.returncode != status:
        raise SystemExit(f"{' '.join(command)} ended with {done.returncode}, not {status}:\n{done.stderr}")
    return took


def measure(case: Case, cache: str, small: bool) -> tuple[float, float]:
    """Return the least time of a case and of the yardstick."""
    if not case.empty:
        seconds(case.command, cache, case.status)  # compiles
    own, yardstick = [], []
    for _ in range(1 if small else case.runs):
        yardstick.append(seconds(YARDSTICK, cache))
        with tempfile.TemporaryDirectory() as fresh:
            own.append(seconds(case.command, fresh if case.empty else cache, case.status))
    return min(own), min(yardstick)


def write_log(path: Path) -> int:
    """Simulate a recording of forty poses; return its rows."""
    import jax

    jax.config.update("jax_enable_x64", True)
    from jaximu.recordings import write_recording
    from jaximu.simulation import consumer_noise, draw_imu, simulate
    from jaximu.simulation.protocols import HandHeld

    recording, _ = simulate(draw_imu(0), HandHeld(40, 11.3), consumer_noise(), seed=0)
    write_recording(recording, path)
    return len(recording.accelerometer)


def main() -> None:
    asked = arguments(__doc__)
    figures = {}
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        rows = write_log(folder / "log.parquet")
        load = os.getloadavg()[0]
        note = f"A log of {rows} rows. Load of the machine at the start {load:.1f}."
        table = Table("The command, in times of importing jax and optimistix", ["", "ratio", "[s]", "goal", ""], note)
        for words, case in cases(folder / "log.parquet", folder).items():
            own, yardstick = measure(case, str(folder / "cache"), asked.small)
            ratio = own / yardstick
            kept = "" if case.goal is None else "kept" if ratio <= case.goal else "missed"
            table.add(words, f"{ratio:.2f}", f"{own:.2f}", "" if case.goal is None else f"≤ {case.goal:g}", kept)
            figures[words] = {"ratio": ratio, "seconds": own, "yardstick": yardstick, "goal": case.goal}
            print(f"{words}: {ratio:.2f} {kept}", file=sys.stderr)
    finish("start", [table], {"load": load, "cases": figures}, keep=not asked.small)


if __name__ == "__main__":
    main()
