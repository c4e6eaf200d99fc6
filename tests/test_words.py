"""The words a user reads: plain English and one typography, in the code's sentences, the pages and the notebooks."""

import ast
import json
import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PLAIN_UNITS = r"(?<![\w\[(])m/s\^2"
FORBIDDEN = {
    r"\b(?:tells?|told)\b(?!(?: \S+){0,5} apart)": "shows, determines, measures; of causes: distinguishes",
    r"\banew\b": "again",
    r"\bmend(ed|s)?\b": "correct, improve, repair",
    r"\bwhoever\b": "anyone who",
    r"\bstands? in for\b": "replaces",
    r"\bdoes not pay\b": "does not improve",
    r"\bthe most that\b": "at most, up to",
    r"\bas such\b": "say what it is",
    r"\bof (its|their) own\b": "own, separate",
    r"\bwhat is left\b": "the remainder",
    r"\bno effect of the catalogue\b": "no known effect",
    r"\bby so much\b": "by …",
    r"\bsettled?s?\b": "determine",
    r"\bmore surely\b|\bless surely\b": "better, worse",
    r"\bsought\b": "tested",
    r"\blay still\b|\blies still\b|\blay down\b": "was stationary, at rest",
    r"\bin times of\b": "× …",
    r"\((s|es)\)(?!\w)": "a plural that is counted",
    r"\bdeg/s\b(?= \(95)": "°/s",
    PLAIN_UNITS: "m/s²",
    r"\bp = 0(?!\.)": "p < 10⁻³⁰⁰",
}
"""What is not said, and what is said instead."""


def offences(text: str) -> list[str]:
    return [f"{found[0]!r} (better: {better})" for pattern, better in FORBIDDEN.items()
            for found in re.finditer(pattern, text, re.IGNORECASE)]  # fmt: skip


def sentences(path: Path) -> list[tuple[int, str]]:
    """The strings of a module that are sentences: not its docstrings, but for the one that is a command's help."""
    tree = ast.parse(path.read_text(encoding="utf-8"))
    hidden: set[int] = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef):
            shown = isinstance(node, ast.FunctionDef) and node.name == "run" and "cli" in path.parts
            for place, statement in enumerate(node.body):
                if isinstance(statement, ast.Expr) and isinstance(statement.value, ast.Constant) and not (
                    shown and place == 0
                ):  # fmt: skip
                    hidden.add(id(statement.value))
        if isinstance(node, ast.JoinedStr):  # its parts are read as one
            hidden |= {id(part) for part in node.values}
    found = []
    for node in ast.walk(tree):
        if isinstance(node, ast.JoinedStr):
            text = "".join(part.value if isinstance(part, ast.Constant) else "…" for part in node.values)
        elif isinstance(node, ast.Constant) and isinstance(node.value, str) and id(node) not in hidden:
            text = node.value
        else:
            continue
        if text.count(" ") >= 2:
            found.append((node.lineno, text))
    return found


MODULES = sorted(path for path in (ROOT / "jaximu").rglob("*.py"))


def test_the_sentences_of_the_code():
    """Files in other formats are written, and their dialects named, in plain units."""
    plain = [ROOT / "jaximu" / part for part in ("recordings", "report/export", "ground/units.py")]
    wrong = [
        f"{path.relative_to(ROOT)}:{line}: {each} in {text[:70]!r}"
        for path in MODULES
        for line, text in sentences(path)
        for each in offences(text.replace("m/s^2", "m/s²") if any(map(path.is_relative_to, plain)) else text)
    ]
    assert not wrong, "\n".join(wrong)


def test_the_pages_of_reports():
    wrong = []
    for path in sorted((ROOT / "jaximu").rglob("*.jinja")):
        text = re.sub(
            r"\{[%{#].*?[%}#]\}|<style>.*?</style>|<[^>]*>", " ", path.read_text(encoding="utf-8"), flags=re.S
        )
        wrong += [f"{path.name}: {each}" for each in offences(text)]
    assert not wrong, "\n".join(wrong)


@pytest.mark.parametrize(
    "name", ["README.md", "notebooks/commands.md", "notebooks/mathematics.md", "notebooks/reading.md"]
)
def test_the_pages_of_the_repository(name):
    text = re.sub(r"```.*?```|`[^`]*`", " ", (ROOT / name).read_text(encoding="utf-8"), flags=re.DOTALL)
    assert not offences(text)


def test_the_notebooks():
    wrong = []
    for path in sorted((ROOT / "notebooks").glob("*.ipynb")):
        for cell in json.loads(path.read_text(encoding="utf-8"))["cells"]:
            if cell["cell_type"] == "markdown":
                text = re.sub(r"```.*?```|`[^`]*`|\$[^$]*\$", " ", "".join(cell["source"]), flags=re.DOTALL)
                wrong += [f"{path.name}: {each} in {text[:60]!r}" for each in offences(text)]
    assert not wrong, "\n".join(wrong)


@pytest.mark.parametrize(
    "text",
    ["of bias that is slower than a pose they tell little", "3 interval(s) left out", "up to 0.2 m/s^2", "(p = 0)",
     "can shift together by so much (95 %)", "take it anew"],
)  # fmt: skip
def test_the_list_catches_what_it_is_for(text):
    assert offences(text)
    assert not offences("Poses cannot show slow drift; 3.4 mm/s² remain (p = 0.03), accel_x [m/s^2]. p < 1e-300")
