"""A command run once for all tests of what it writes and of what the function under it returns."""

import contextlib
import io
from types import ModuleType
from typing import Any

import pytest

from jaximu.cli.app import main


def result_of(line: list[str], module: ModuleType, name: str) -> tuple[Any, str]:
    """Run a command line that must succeed; return what `module.name` returned in it, and what was printed."""
    function, returned = getattr(module, name), []

    def kept(*values, **options):
        returned.append(function(*values, **options))
        return returned[-1]

    with pytest.MonkeyPatch.context() as patch, contextlib.redirect_stdout(io.StringIO()) as printed:
        patch.setattr(module, name, kept)
        assert main(line) == 0
    (only,) = returned
    return only, printed.getvalue()
