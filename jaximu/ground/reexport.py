"""Packages whose names load their modules when they are first used: a command that only parses stays quick."""

import ast
import sys
from collections.abc import Callable
from functools import cache
from importlib import import_module
from pathlib import Path
from typing import Any

__all__ = ["later", "lazily"]


def later(module: str, name: str) -> Any:
    """Return what a method hands its object to: pictures and files of an object, which lie in layers above its own.

    Nothing in the object's own work depends on them, and they are loaded when somebody asks.
    """
    return getattr(import_module(f"jaximu.{module}"), name)


def lazily(package: str) -> Callable[[str], Any]:
    """Return a package's `__getattr__` (PEP 562): its names are those that it imports `if TYPE_CHECKING`."""

    @cache
    def homes() -> dict[str, tuple[str, str]]:
        tree = ast.parse(Path(str(sys.modules[package].__file__)).read_text(encoding="utf-8"))
        (guarded,) = (node for node in tree.body if isinstance(node, ast.If))
        imports = [node for node in guarded.body if isinstance(node, ast.ImportFrom)]
        return {alias.asname or alias.name: (str(node.module), alias.name) for node in imports for alias in node.names}

    def get(name: str) -> Any:
        if name not in homes():
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        module, called = homes()[name]
        return getattr(import_module(module), called)

    return get
