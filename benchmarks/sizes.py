"""How much there is to read in the library, by syntax tree, and the ceilings it must stay under.

`python benchmarks/sizes.py` prints the counts beside their ceilings, `--lower` takes the counts as ceilings where they
have fallen, `--raise NAME` takes one that has risen: openly, in a commit of its own that says which capability it pays
for. Lines are not counted, because they can be packed.
"""

import argparse
import ast
import json
import re
import sys
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

ROOT = Path(__file__).parents[1]
CEILINGS = Path(__file__).with_name("ceilings.json")
LONGEST_FUNCTION = 60  # lines
VAGUE_NAMES = frozenset("again anew asked begun each found given kelvin late own place reach said seen told".split())
"""Names that say nothing of what they hold, or hold something else (kelvin: °C)."""
KINDS = frozenset(("filter", "gyroscope", "magnetic", "magnetometer", "reference", "stations"))
"""What a recording or a calibration may lack: asking for one by name is a special case."""
COMMON_NUMBERS = frozenset((0, 1, 2, 3, 4, 6, 9, 10, 60, 100, 180, 360, 1000, 3600, 0.5, 1e-3, 1e6, 1e-6, 1e9, 1e-9))
PRIVATE_CONSTANT = re.compile(r"_[A-Z][A-Z0-9_]*")


@dataclass(frozen=True)
class Module:
    """A file of the package: its path in the package, its text and its syntax."""

    path: Path
    text: str
    package: str

    @cached_property
    def tree(self) -> ast.Module:
        return ast.parse(self.text)

    @cached_property
    def nodes(self) -> tuple[ast.AST, ...]:
        return tuple(ast.walk(self.tree))

    @cached_property
    def name(self) -> str:
        parts = self.path.with_suffix("").parts
        return ".".join((self.package, *(parts[:-1] if parts[-1] == "__init__" else parts)))

    @property
    def functions(self) -> Iterator[ast.FunctionDef | ast.AsyncFunctionDef]:
        return (node for node in self.nodes if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef))

    def imported(self, names: frozenset[str]) -> set[str]:
        """Which of the package's modules it imports: at its top, inside a function, or for types alone."""
        imported: set[str] = set()
        inside = self.name.split(".")
        inside = inside if self.path.stem == "__init__" else inside[:-1]
        for node in self.nodes:
            if isinstance(node, ast.Import):
                imported.update(alias.name for alias in node.names)
            elif isinstance(node, ast.ImportFrom):
                above = inside[: len(inside) + 1 - node.level] if node.level else []
                base = ".".join([*above, *([node.module] if node.module else [])])
                for alias in node.names:
                    whole = f"{base}.{alias.name}"
                    imported.add(whole if whole in names else base)
        return (imported & names) - {self.name}


Modules = list[Module]


def read(folder: Path) -> Modules:
    """Read a package."""
    paths = sorted(folder.rglob("*.py"))
    return [Module(path.relative_to(folder), path.read_text(encoding="utf-8"), folder.name) for path in paths]


def statements(modules: Modules) -> int:
    return sum(isinstance(node, ast.stmt) for module in modules for node in module.nodes)


def syntax_nodes(modules: Modules) -> int:
    return sum(len(module.nodes) for module in modules)


def nodes_a_line(modules: Modules) -> float:
    return round(syntax_nodes(modules) / sum(module.text.count("\n") for module in modules), 1)


def matches(pattern: str) -> Callable[[Modules], int]:
    """Return what counts a pattern in the text."""
    return lambda modules: sum(len(re.findall(pattern, module.text)) for module in modules)


def private_constants(modules: Modules) -> int:
    """Private names in capitals at a module's top whose value holds a number."""
    count = 0
    for statement in (statement for module in modules for statement in module.tree.body):
        targets = {ast.Assign: lambda s: s.targets, ast.AnnAssign: lambda s: [s.target]}.get(type(statement))
        value = getattr(statement, "value", None)
        if targets is None or value is None or not any(map(_is_number, ast.walk(value))):
            continue
        names = (node for target in targets(statement) for node in ast.walk(target) if isinstance(node, ast.Name))
        count += sum(bool(PRIVATE_CONSTANT.fullmatch(name.id)) for name in names)
    return count


def _is_number(node: ast.AST) -> bool:
    return isinstance(node, ast.Constant) and isinstance(node.value, int | float)


def vague_names(modules: Modules) -> int:
    """Assignments and arguments called by a vague name."""
    nodes = (node for module in modules for node in module.nodes)
    return sum(
        (isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store) and node.id in VAGUE_NAMES)
        or (isinstance(node, ast.arg) and node.arg in VAGUE_NAMES)
        for node in nodes
    )


def class_names_used_twice(modules: Modules) -> int:
    return len(
        repeated((node.name for module in modules for node in module.tree.body if isinstance(node, ast.ClassDef)), 2)
    )


def file_names_used_three_times(modules: Modules) -> int:
    return len(repeated((module.path.stem for module in modules if not module.path.stem.startswith("__")), 3))


def repeated(names: Iterable[str], times: int) -> list[str]:
    """Return the names that occur so many times or more."""
    return sorted(name for name, count in Counter(names).items() if count >= times)


def questions_of_kind(modules: Modules) -> int:
    """Comparisons of a kind of data with None."""
    comparisons = (node for module in modules for node in module.nodes if isinstance(node, ast.Compare))
    return sum(
        any(isinstance(other, ast.Constant) and other.value is None for other in node.comparators)
        and ast.unparse(node.left).rpartition(".")[2] in KINDS
        for node in comparisons
    )


def isinstance_calls(modules: Modules) -> int:
    calls = (node for module in modules for node in module.nodes if isinstance(node, ast.Call))
    return sum(isinstance(call.func, ast.Name) and call.func.id == "isinstance" for call in calls)


def long_functions(modules: Modules) -> int:
    lengths = ((node.end_lineno or 0) - node.lineno + 1 for module in modules for node in module.functions)
    return sum(length > LONGEST_FUNCTION for length in lengths)


def numbers_inside_functions(modules: Modules) -> int:
    """Numbers that are not everybody's; one in a function inside another counts for each."""
    nodes = (node for module in modules for function in module.functions for node in ast.walk(function))
    return sum(
        isinstance(node, ast.Constant) and type(node.value) in (int, float) and node.value not in COMMON_NUMBERS
        for node in nodes
    )


def loose_modules(modules: Modules) -> int:
    """Modules in no room."""
    return sum(
        len(module.path.parts) == 1 and not module.path.stem.startswith("__") and module.path.stem != "_version"
        for module in modules
    )


def circles_of_imports(modules: Modules) -> int:
    """Sets of modules of which each leads to all others by its imports."""
    names = frozenset(module.name for module in modules)
    imports = {module.name: module.imported(names) for module in modules}
    leads_to = {name: _reached(name, imports) for name in imports}
    circles = {frozenset(other for other in leads_to[name] if name in leads_to[other]) for name in imports}
    return sum(len(circle) > 1 for circle in circles)


def _reached(start: str, imports: dict[str, set[str]]) -> set[str]:
    reached: set[str] = set()
    waiting = list(imports[start])
    while waiting:
        name = waiting.pop()
        if name not in reached:
            reached.add(name)
            waiting += imports[name]
    return reached


MEASURES: dict[str, Callable[[Modules], float]] = {
    "syntax nodes": syntax_nodes,
    "statements": statements,
    "syntax nodes a line": nodes_a_line,
    "packed by hand": matches(r"#\s*fmt:\s*(?:skip|off)"),
    "type checks silenced": matches(r"#\s*(?:pyright|type):\s*ignore"),
    "private tuning constants": private_constants,
    "numbers inside functions": numbers_inside_functions,
    "vague names assigned": vague_names,
    "class names used twice": class_names_used_twice,
    "file names used three times": file_names_used_three_times,
    "tests for a kind being there": questions_of_kind,
    "isinstance tests": isinstance_calls,
    "functions over 60 lines": long_functions,
    "loose modules": loose_modules,
    "circles of imports": circles_of_imports,
}


def measure(folder: Path = ROOT / "jaximu") -> dict[str, float]:
    """Count all of it."""
    modules = read(folder)
    return {name: count(modules) for name, count in MEASURES.items()}


def ceilings() -> dict[str, float]:
    """Return what the counts must not exceed."""
    return json.loads(CEILINGS.read_text(encoding="utf-8"))


def main() -> int:
    """Print the counts; set ceilings where asked."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--lower", action="store_true", help="take the counts as ceilings where they have fallen")
    parser.add_argument("--raise", dest="raised", choices=MEASURES, action="append", default=[], metavar="NAME",
                        help="take this count as its ceiling")  # fmt: skip
    options = parser.parse_args()
    counts, limits = measure(), ceilings()
    for name, count in counts.items():
        limit = limits.get(name, float("inf"))
        if name in options.raised or (options.lower and count < limit):
            limits[name] = limit = count
        print(f"{name:32}{count:>10g}{limit:>10g}{'  over its ceiling' if count > limit else ''}")
    if options.lower or options.raised:
        CEILINGS.write_text(json.dumps(limits, indent=1) + "\n", encoding="utf-8")
    return int(any(count > limits.get(name, 0) for name, count in counts.items()))


if __name__ == "__main__":
    sys.exit(main())
