"""No private name of another module; the order of the rooms and their circles are a contract in pyproject.toml."""

import ast
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).parents[1]
PATHS = {".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__"): path
         for path in ROOT.glob("jaximu/**/*.py")}  # fmt: skip
SHARED = {"jaximu._version"}
"""Private modules that all may use."""

HANDED_UP = {
    "jaximu.recordings.recording from jaximu.recordings.readers.reader",
    "jaximu.recordings.recording from jaximu.recordings.write",
    "jaximu.recordings.recording from jaximu.report.figures",
    "jaximu.calibration.calibration from jaximu.report.figures",
    "jaximu.ground.page from jaximu.report.html",
    "jaximu.ground.page from jaximu.report.terminal",
    "jaximu.ground.page from jaximu.report.{self._page}",
}
"""Methods that hand their object to a higher layer by name, `reexport.later`; nothing below depends on what comes."""


class Import(NamedTuple):
    """One import of a module: from which, and which name; None where the module itself is meant."""

    source: str
    name: str | None


def imports(tree: ast.AST) -> list[tuple[Import, str]]:
    """What a module imports from jaximu, wherever in it, but not for types alone; with the name it has then."""
    guarded = [node.body for node in ast.walk(tree)
               if isinstance(node, ast.If) and ast.unparse(node.test) == "TYPE_CHECKING"]  # fmt: skip
    types = {id(node) for body in guarded for statement in body for node in ast.walk(statement)}
    found = []
    for node in ast.walk(tree):
        if id(node) in types:
            continue
        if isinstance(node, ast.Import):
            found += [(Import(alias.name, None), alias.asname or alias.name) for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            assert not node.level, "imports are absolute"
            for alias in node.names:
                whole = f"{node.module}.{alias.name}"
                source = Import(whole, None) if whole in PATHS else Import(node.module or "", alias.name)
                found.append((source, alias.asname or alias.name))
    return [(each, bound) for each, bound in found if each.source.partition(".")[0] == "jaximu"]


TREES = {name: ast.parse(path.read_text(encoding="utf-8")) for name, path in PATHS.items()}
IMPORTS = {name: imports(tree) for name, tree in TREES.items()}


def private(name: str | None) -> bool:
    return name is not None and name.startswith("_") and not name.startswith("__")


def intrusions() -> set[str]:
    """Private names and modules that another module imports, or takes from a module as its attribute."""
    found = set()
    for module, entries in IMPORTS.items():
        for each, _ in entries:
            if private(each.name) or (each.source not in SHARED and any(map(private, each.source.split(".")))):
                found.add(f"private: {module} from {each.source} {each.name or ''}".strip())
        modules = {bound: each.source for each, bound in entries if each.name is None}
        for node in ast.walk(TREES[module]):
            if isinstance(node, ast.Attribute) and private(node.attr) and ast.unparse(node.value) in modules:
                found.add(f"private: {module} from {modules[ast.unparse(node.value)]} {node.attr}")
    return found


def handed_up() -> set[str]:
    """What modules below the command line reach by name, upwards or not; the name is a text that can be read here."""
    found = set()
    for module, tree in TREES.items():
        calls = [node for node in ast.walk(tree) if isinstance(node, ast.Call) and ast.unparse(node.func) == "later"]
        if any(each.source == "jaximu.ground.reexport" and each.name == "later" for each, _ in IMPORTS[module]):
            assert calls or module.startswith("jaximu.cli"), f"{module} uses `later` otherwise than by calling it"
            if not module.startswith("jaximu.cli"):
                texts = [ast.unparse(node.args[0]).removeprefix("f").strip("'\"") for node in calls]
                found |= {f"{module} from jaximu.{text}" for text in texts}
    return found


def test_no_private_names_of_others():
    assert intrusions() == set()
    assert handed_up() == HANDED_UP
