"""The names of the packages: what an editor reads, what is public, and what is loaded are the same."""

import ast
from importlib import import_module
from pathlib import Path

import pytest

import jaximu

ROOT = Path(jaximu.__file__).parent
LAZY = sorted(path for path in ROOT.rglob("__init__.py") if "lazily" in path.read_text(encoding="utf-8"))


@pytest.mark.parametrize("path", LAZY, ids=lambda path: path.parent.name)
def test_the_table_of_a_package_holds_what_it_imports_for_types(path):
    """As eager imports would: each name from its module, all of them public, and no other in the table."""
    tree = ast.parse(path.read_text(encoding="utf-8"))
    (typed,) = (node for node in tree.body if isinstance(node, ast.If))
    table: dict[str, list[str]] = {}
    for node in typed.body:
        names = [f"{alias.name} as {alias.asname}" if alias.asname else alias.name for alias in node.names]
        table.setdefault(node.module, []).extend(names)
    (call,) = (node for node in ast.walk(tree) if isinstance(node, ast.Call) and node.func.id == "lazily")
    assert ast.literal_eval(call.args[1]) == {module: ", ".join(names) for module, names in table.items()}
    package = import_module(".".join(("jaximu", *path.parent.relative_to(ROOT).parts)))
    public = {alias.asname or alias.name for node in typed.body for alias in node.names}
    assert set(package.__all__) - {"__version__"} == public
    for node in typed.body:
        for alias in node.names:
            assert getattr(package, alias.asname or alias.name) is getattr(import_module(node.module), alias.name)


def test_a_name_that_a_package_has_not_is_refused_by_name():
    with pytest.raises(AttributeError, match=r"module 'jaximu\.model' has no attribute 'nonsense'"):
        _ = import_module("jaximu.model").nonsense
