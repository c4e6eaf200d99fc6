"""How much there is to read: the library stays under its ceilings, and the counts are right."""

import sys
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parents[1] / "benchmarks"))
import sizes

PACKAGE = {
    "loose.py": """
from package.room.first import One
_LIMIT, TEXT = 3.5, "x"
_WORDS: str = "none"  # fmt: skip


class One:
    def each(self, found, *, gyroscope=None):
        place = 7 if gyroscope is None else 2
        return isinstance(place, int)  # type: ignore
""",
    "room/__init__.py": "",
    "room/first.py": "from .. import loose\n\n\nclass One:\n    pass\n",
    "room/second.py": "def long():\n" + "    # a line\n" * 60 + "    return 1\n\n\nclass Two:\n    pass\n",
    "other/second.py": "def imported_late():\n    from package.room import second\n\n    return second\n",
    "other/third/second.py": "",
}
COUNTS = {
    "statements": 17,
    "packed by hand": 1,
    "type checks silenced": 1,
    "private tuning constants": 1,
    "numbers inside functions": 1,
    "vague names assigned": 2,
    "class names used twice": 1,
    "file names used three times": 1,
    "tests for a kind being there": 1,
    "isinstance tests": 1,
    "functions over 60 lines": 1,
    "loose modules": 1,
    "circles of imports": 1,
}


@pytest.fixture
def package(tmp_path):
    for name, text in PACKAGE.items():
        path = tmp_path / "package" / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)
    return tmp_path / "package"


def test_the_counts_of_a_package_counted_by_hand(package):
    counts = sizes.measure(package)
    assert {name: counts[name] for name in COUNTS} == COUNTS
    assert counts["syntax nodes a line"] == round(counts["syntax nodes"] / 84, 1)
    assert set(counts) == set(COUNTS) | {"syntax nodes", "syntax nodes a line"}


def test_packing_lines_changes_the_density_alone(package):
    before = sizes.measure(package)
    path = package / "room" / "second.py"
    path.write_text("def long(): return 1\nclass Two: pass\n")
    after = sizes.measure(package)
    assert after["syntax nodes"] == before["syntax nodes"] and after["statements"] == before["statements"]
    assert after["syntax nodes a line"] > before["syntax nodes a line"]


def test_the_library_stays_under_its_ceilings():
    """`python benchmarks/sizes.py --lower` takes what has fallen; `--raise NAME` is a commit of its own."""
    counts, limits = sizes.measure(), sizes.ceilings()
    over = {name: (count, limits[name]) for name, count in counts.items() if count > limits[name]}
    assert not over, f"over their ceilings: {over}"
