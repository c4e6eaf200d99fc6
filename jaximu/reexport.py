"""Packages whose names load their modules when they are first used: a command that only parses stays quick."""

from collections.abc import Callable, Mapping
from importlib import import_module
from typing import Any

__all__ = ["later", "lazily"]


def later(module: str, name: str) -> Any:
    """Return what a method hands its object to: pictures and files of an object, which lie in layers above its own.

    Nothing in the object's own work depends on them, and they are loaded when somebody asks.
    """
    return getattr(import_module(f"jaximu.{module}"), name)


def lazily(package: str, homes: Mapping[str, str]) -> Callable[[str], Any]:
    """Return a package's `__getattr__` (PEP 562); `homes` has its names, by blanks, for each module of it."""
    home_of = {name: home for home, names in homes.items() for name in names.split()}

    def get(name: str) -> Any:
        if name not in home_of:
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        return getattr(import_module(f"{package}.{home_of[name]}"), name)

    return get
