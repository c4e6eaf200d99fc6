"""Compare the outputs that notebooks hold with a run: `python notebooks/check.py [--write] [NOTEBOOK ...]`.

Words must be equal, numbers within the tolerances below, and pictures must be where they were; their pixels change with
the version of matplotlib. What goes to stderr (progress and times) is neither compared nor stored. `--write` stores
the outputs of the run. The measured data is in the folder that JAXIMU_DATA names.
"""

import argparse
import asyncio
import html
import os
import re
import sys
from collections.abc import Iterator, Mapping
from itertools import zip_longest
from pathlib import Path
from typing import Any

HERE = Path(__file__).parent
TIMEOUT = 900  # seconds for a cell
RELATIVE = 0.02
"""Another machine, or the lower bounds of the stack, round differently, and an iteration may stop one pass sooner."""
SMALLEST = 1e-9
"""Numbers below this are equal: rounding errors, or probabilities in the tails, which amplify a relative change."""
COUNT = 100
"""Whole numbers below this are counts; larger ones may be measured values that were rounded."""
PICTURE = "(picture)"
_NUMBER = re.compile(r"[-+]?(?:\d+\.?\d*|\.\d+)(?:e[-+]?\d+)?")
_POWER = re.compile("[·×]10([⁻⁺]?[⁰¹²³⁴-⁹]+)")
_PLAIN = str.maketrans("−⁻⁺⁰¹²³⁴⁵⁶⁷⁸⁹", "--+0123456789")
_RULE = re.compile(r"[-─━═│┃|+╭╮╰╯┌┐└┘]{2,}")
_MARKUP = re.compile(r"(?s)<(svg|style|script)\b.*?</\1>|<[^>]*>")

Notebook = Mapping[str, Any]


def lines(cell: Notebook) -> list[str]:
    """Return what a cell shows, a line each: standard output in one piece, results, and a mark for each picture."""
    parts: list[str] = []
    for output in cell.get("outputs", []):
        data = output.get("data", {})
        if any(kind.startswith("image/") for kind in data):
            parts.append(f"\n{PICTURE}\n")
        elif "text/html" in data:
            parts.append(f"\n{html.unescape(_MARKUP.sub(' ', ''.join(data['text/html'])))}\n")
        elif output.get("name") != "stderr":
            parts += output.get("text", data.get("text/plain", ""))
    return "".join(parts).splitlines()


def words(text: list[str]) -> Iterator[tuple[str, str]]:
    """Yield each word with its line. Line breaks, the length of rules and NumPy's padding depend on the numbers."""
    for line in text:
        for word in re.sub(r"\[ +", "[", line).split():
            if not _RULE.fullmatch(word):
                yield _POWER.sub(lambda power: f"e{power[1]}", word.replace("−", "-")).translate(_PLAIN), line


def alike(one: str, other: str) -> bool:
    """Tell whether two words are equal but for what numbers in them may differ by."""
    if _NUMBER.split(one) != _NUMBER.split(other):
        return False
    return all(map(close, _NUMBER.findall(one), _NUMBER.findall(other)))


def close(one: str, other: str) -> bool:
    """Tell whether two numbers as printed are equal: small counts exactly, others within the tolerances."""
    first, second = float(one), float(other)
    last = min(last_place(one), last_place(other))
    allowed = (
        max(RELATIVE * max(abs(first), abs(second)), 1.01 * last, SMALLEST)
        if last != 1.0 or min(first, second) >= COUNT
        else 0.0
    )
    return abs(first - second) <= allowed


def last_place(text: str) -> float:
    """Return what one in the last decimal place of a number as printed is worth, 1 for a count."""
    mantissa, _, power = text.partition("e")
    return 10.0 ** (int(power or 0) - len(mantissa.partition(".")[2]))


def differences(stored: Notebook, run: Notebook) -> Iterator[str]:
    """Yield a sentence for each cell whose stored output differs from the run's, with the two lines."""
    for number, (before, after) in enumerate(zip(stored["cells"], run["cells"], strict=True)):
        pairs = zip_longest(words(lines(before)), words(lines(after)), fillvalue=("", "(nothing)"))
        for (one, line), (other, line_of_run) in pairs:
            if not alike(one, other):
                yield f"cell {number}:\n  stored: {line.strip()}\n  run:    {line_of_run.strip()}"
                break


async def execute(path: Path, free: asyncio.Semaphore) -> tuple[Notebook, Notebook]:
    """Return a notebook as it is stored, and as it is after a run in its folder, without paths of this machine."""
    import nbformat
    from nbclient import NotebookClient

    text = path.read_text(encoding="utf-8")
    stored, run = nbformat.reads(text, 4), nbformat.reads(text, 4)
    place = {"metadata": {"path": str(path.parent)}}
    client = NotebookClient(run, timeout=TIMEOUT, resources=place, coalesce_streams=True, record_timing=False)
    async with free:
        await client.async_execute()
    run.metadata = stored.metadata
    for cell in run.cells:
        if "outputs" in cell:
            cell.outputs = [output for output in cell.outputs if output.get("name") != "stderr"]
    text = nbformat.writes(run)
    if "JAXIMU_DATA" in os.environ:
        text = text.replace(f"{os.environ['JAXIMU_DATA'].rstrip('/')}/", "")
    return stored, nbformat.reads(text, 4)


async def compared(paths: list[Path], write: bool) -> bool:
    """Run notebooks, as many at a time as there are cores, say how each compares; return whether all ran and agree."""
    import nbformat
    from nbclient.exceptions import CellExecutionError

    free = asyncio.Semaphore(os.cpu_count() or 1)
    # kernels fill the cores: threads of NumPy's beside them wait for one another, and wait busily
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    runs, fine = [asyncio.create_task(execute(path, free)) for path in paths], True
    for path, ended in zip(paths, runs, strict=True):
        try:
            stored, run = await ended
        except CellExecutionError as error:
            print(f"{path.name}: {error}", flush=True)
            fine = False
            continue
        different = list(differences(stored, run))
        count = f"{len(different)} cell{' differs' if len(different) == 1 else 's differ'}"
        print("\n".join([f"{path.name}: {count}", *different]), flush=True)
        if write:
            nbformat.write(run, path)
        else:
            fine &= not different
    return fine


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("notebooks", nargs="*", type=Path, metavar="NOTEBOOK", help="Default: all, beside this script.")
    parser.add_argument("--write", action="store_true", help="Store the outputs of the run.")
    options = parser.parse_args()
    paths = options.notebooks or sorted(HERE.glob("*.ipynb"), key=lambda path: int(path.stem.partition("_")[0]))
    if not paths:
        parser.error(f"there is no notebook in {HERE}.")
    sys.exit(not asyncio.run(compared(paths, options.write)))


if __name__ == "__main__":
    main()
