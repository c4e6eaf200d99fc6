"""The entry point: settings of the process, choice of the verb, errors as sentences."""

import functools
import inspect
import os
import shutil
import sys
import textwrap
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from importlib import import_module
from pathlib import Path
from types import ModuleType
from typing import NoReturn

from jaximu._version import __version__
from jaximu.errors import InputError, JaximuError

__all__ = ["VERBS", "command", "main"]

VERBS = (
    "info",
    "demo",
    "calibrate",
    "diagnose",
    "check",
    "compensate",
    "allan",
    "effects",
    "simulate",
    "turntable",
    "reference",
    "filter",
    "magnetometer",
    "plan",
    "budget",
    "thermal",
    "fleet",
    "export",
    "consequences",
)
"""One module of this folder each, with a function `run`. It loads what is heavy only when it works."""
_FIRST = "compiling for the first time on this machine; later runs start sooner"


def _cache_folder() -> Path | None:
    """The user's own cache folder for compiled code; None where it cannot be made private.

    A shared one would be a security hole: whoever writes to it runs code.
    """
    base = os.environ.get("XDG_CACHE_HOME") or (os.environ.get("LOCALAPPDATA") if os.name == "nt" else "~/.cache")
    folder = Path(base or "~/.cache").expanduser() / "jaximu"
    try:
        folder.mkdir(parents=True, exist_ok=True, mode=0o700)
        if os.name != "nt" and (folder.stat().st_uid != os.getuid() or folder.stat().st_mode & 0o022):
            return None
    except (OSError, RuntimeError):
        return None
    return folder


def _settings() -> None:
    """What holds for this process, not for an importing one: set before the libraries are loaded, if a verb does so."""
    import logging

    from jaximu import stored

    os.environ.setdefault("JAX_PLATFORMS", "")  # keep the user's choice; JAX looks for accelerators by itself
    # Matrices here are small: threads of a linear algebra library cost more than they give, and on a busy machine wait
    # for each other five times as long as one takes alone.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "3")  # XLA calls a slow compilation an error
    logging.getLogger("matplotlib").setLevel(logging.ERROR)  # it warns where its fonts' cache cannot be written
    stated = os.environ.get("JAX_COMPILATION_CACHE_DIR") not in (None, str(stored.folder()))
    folder = None if stated else _cache_folder()
    stored.prepare_process(folder, lambda: print(_FIRST, file=sys.stderr))
    _expect_damage(folder)


def _expect_damage(folder: Path | None) -> None:
    """Keep JAX's warnings of its cache from the user, and remove what it cannot read: it would keep that for ever."""
    warnings.filterwarnings("always", "Error (reading|writing) persistent compilation cache")
    show = warnings.showwarning

    def handle(message, *where) -> None:
        if "persistent compilation cache" not in str(message):
            show(message, *where)
        elif folder is not None and "reading" in str(message):
            for path in folder.glob("*-cache"):  # the warning does not say which
                with suppress(OSError):
                    path.unlink()

    warnings.showwarning = handle


def _verb(name: str) -> Callable[..., None]:
    return import_module(f"jaximu.cli.{name}").run


def _overview() -> str:
    """Return the usage, and what each verb does in its own words."""
    width = min(shutil.get_terminal_size().columns, 120)
    lines = ["usage: jaximu [-h] [--version] VERB …", "", "Calibrate inertial measurement units.", ""]
    for name in VERBS:
        text = " ".join((inspect.getdoc(_verb(name)) or "").partition("\n\n")[0].split())
        lines += textwrap.wrap(text, width, initial_indent=f"  {name:<13}", subsequent_indent=15 * " ")
    return "\n".join([*lines, "", "`jaximu VERB --help` shows the options of a verb."])


def _parse(name: str, given: Sequence[str]) -> Callable[[], None]:
    """Return a verb with its arguments."""
    import tyro

    run = _verb(name)

    @functools.wraps(run)
    def bind(*values, **options) -> Callable[[], None]:
        return functools.partial(run, *values, **options)

    config = tyro.conf.FlagCreatePairsOff, tyro.conf.OmitArgPrefixes
    with _defaults_unchecked():
        return tyro.cli(bind, prog=f"jaximu {name}", args=given, config=config)


@contextmanager
def _defaults_unchecked() -> Iterator[None]:
    """Keep tyro from checking our options' defaults (pyright does): typeguard takes a third of the time to start."""
    if "typeguard" in sys.modules:
        yield
        return
    unchecked = ModuleType("typeguard")
    unchecked.__dict__.update(check_type=lambda value, _: value, TypeCheckError=TypeError)
    sys.modules["typeguard"] = unchecked
    try:
        yield
    finally:
        del sys.modules["typeguard"]


def _run(given: Sequence[str]) -> int:
    """Run the verb that comes first with the options that follow it."""
    name = given[0] if given else ""
    if name in VERBS:
        work = _parse(name, given[1:])
        _settings()
        work()
    elif name in ("--help", "-h"):
        print(_overview())
    elif name in ("--version", "-V"):
        print(f"jaximu {__version__}")
    elif name:
        import difflib

        near = difflib.get_close_matches(name, VERBS, 1)
        raise InputError(
            f"there is no verb {name!r}{f' (did you mean {near[0]}?)' if near else ''}; see jaximu --help."
        )
    else:
        print(_overview(), file=sys.stderr)
        return 2
    return 0


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line and return its exit status."""
    try:
        return _run(sys.argv[1:] if arguments is None else arguments)
    except JaximuError as error:
        print(f"jaximu: {error}", file=sys.stderr)
        return error.exit_status
    except SystemExit as stop:  # tyro ends a wrong usage, and --help, by itself
        return int(stop.code or 0) if not isinstance(stop.code, str) else 2
    except BrokenPipeError:
        sys.stderr.close()
        return 0
    except KeyboardInterrupt:
        print("jaximu: stopped.", file=sys.stderr)
        return 130
    except Exception as error:  # a defect of ours; a user gets a sentence, a developer the traceback on request
        if os.environ.get("JAXIMU_DEBUG"):
            raise
        kind = f"{type(error).__name__}: {error}".splitlines()[0]
        print(
            f"jaximu: this should not happen ({kind}); JAXIMU_DEBUG=1 shows where. Please report it.", file=sys.stderr
        )
        return 1


def command() -> NoReturn:
    """Run the command line as a process of its own.

    It ends without taking libraries down: a reader's thread that is still at work would abort it, whatever its status.
    """
    status = main()
    with suppress(OSError, ValueError):  # a pipe that nobody reads any more
        sys.stdout.flush()
        sys.stderr.flush()
    os._exit(status)
