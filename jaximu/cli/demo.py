"""`jaximu demo`: the main job on a simulated unit, no input needed."""

from pathlib import Path
from typing import Annotated

import tyro

__all__ = ["run"]


def run(
    *,
    seed: int = 0,
    output: Annotated[
        Path, tyro.conf.arg(name="output", aliases=["-o"], metavar="DIR", help="Folder for recording and report.")
    ] = Path("jaximu-demo"),
) -> None:
    """Simulate a unit with a hidden flaw, calibrate it, and show what the calibration can and cannot explain."""
    raise NotImplementedError
