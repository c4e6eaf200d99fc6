"""Packages whose names load their modules when they are first used: a command that only parses stays quick."""

from collections.abc import Callable, Mapping
from importlib import import_module
from typing import Any


def later(module: str, name: str) -> Any:
    """Return what a method hands its object to: pictures and files of an object, which lie in layers above its own.

    Nothing in the object's own work depends on them, and they are loaded when somebody asks.
    """
    return getattr(import_module(f"jaximu.{module}"), name)


def lazily(package: str, table: Mapping[str, str]) -> Callable[[str], Any]:
    """Return a package's `__getattr__` (PEP 562): `table` lists the names of each module, as its import would."""
    homes: dict[str, tuple[str, str]] = {}
    for module, names in table.items():
        for called, _, name in (text.partition(" as ") for text in names.split(", ")):
            homes[name or called] = module, called

    def get(name: str) -> Any:
        if name not in homes:
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        module, called = homes[name]
        return getattr(import_module(module), called)

    return get
