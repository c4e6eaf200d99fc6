"""The constraints of `.ci/run`'s full suite are the lower bounds that pyproject.toml promises."""

import re
import tomllib
from pathlib import Path

ROOT = Path(__file__).parents[1]
TRIED = ("test", "formats", "field", "serial", "cluster")
"""The extras that the README's test command installs."""


def test_what_is_promised_is_what_is_tried():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    requirements = [
        *project["dependencies"],
        *(line for name in TRIED for line in project["optional-dependencies"][name]),
    ]
    bounds = {}
    for requirement in requirements:
        name, bound = re.fullmatch(r"([\w-]+)(?:\[[\w,]+\])?(?:>=([\w.]+))?", requirement).groups()
        if name != project["name"]:
            assert bound, f"{requirement} has no lower bound"
            bounds[name] = bound
    lines = (ROOT / ".ci" / "lower-bounds.txt").read_text(encoding="utf-8").splitlines()
    assert dict(line.split("==") for line in lines if not line.startswith("#")) == bounds
