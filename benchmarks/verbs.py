"""Every verb on every kind of measured input, at full length: what a user gets, in which time, and that nothing breaks.

`python benchmarks/verbs.py` with `JAXIMU_DATA`. The same command lines on the quick verbs are a test.
"""

import os
import sys
import tempfile
from pathlib import Path

os.environ.setdefault("JAX_PLATFORMS", "cpu")
sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))

import jax
from common import Table, arguments, finish
from every_verb import INPUTS, VERBS, run
from every_verb import arguments as line_of

jax.config.update("jax_enable_x64", True)


def main():
    """Run all and keep the table."""
    options = arguments(__doc__)
    data = Path(os.environ["JAXIMU_DATA"])
    table = Table("Outcome of every verb on every input", ["verb", "input", "exit", "seconds", "says", "fault"],
                  "Seconds of one process that keeps what it compiled. Exit 0: done; 1: the recording cannot tell; "
                  "2: more must be said.")  # fmt: skip
    figures = {}
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "out"
        first = line_of("calibrate", INPUTS["MPU-9150 by hand"], data, out)
        run(first, Path(folder) / "unit", False)
        calibration = Path(folder) / "unit" / "calibration.json"
        for verb in VERBS:
            for name, given in INPUTS.items():
                if options.small and verb not in ("info", "calibrate"):
                    continue
                found = run(line_of(verb, given, data, calibration), out, True)
                says = found.short.replace(f"{data}/", "").replace("|", "/").replace("\n", " ")
                table.add(verb, name, found.status, f"{found.seconds:.1f}", says[:160], "; ".join(found.faults))
                figures[f"{verb}: {name}"] = {"status": found.status, "seconds": found.seconds, "faults": found.faults}
    finish("verbs", [table], figures, keep=not options.small)


if __name__ == "__main__":
    main()
