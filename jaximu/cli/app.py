"""The entry point: settings of the process, choice of the verb, errors as sentences."""

import io
import os
import sys
import warnings
from collections.abc import Callable, Sequence
from contextlib import redirect_stderr
from pathlib import Path
from typing import NoReturn

from jaximu._version import __version__
from jaximu.cli.streams import open_streams
from jaximu.cli.usage import check_options, command_of, completion, help_text, listed, usage_mistake
from jaximu.ground.errors import InputError, JaximuError, command_line

VERBS = (
    "info",
    "demo",
    "calibrate",
    "record",
    "diagnose",
    "check",
    "compare",
    "compensate",
    "allan",
    "effects",
    "simulate",
    "turntable",
    "reference",
    "array",
    "filter",
    "magnetometer",
    "plan",
    "budget",
    "thermal",
    "fleet",
    "export",
    "consequences",
    "accept",
    "verify",
)
"""One module of this folder each, with a class of options that runs. It loads what is heavy only when it works."""
GROUPS = {
    "Inspect": "info effects",
    "Calibrate": "calibrate record reference filter array magnetometer compensate export",
    "Diagnose": "diagnose check compare allan consequences",
    "Equipment": "turntable budget",
    "Temperature": "thermal",
    "Fleet": "fleet accept verify",
    "Simulate and plan": "demo simulate plan",
}
"""How the overview arranges them all."""
LOG = "LOG"
"""What stands for a log in place of a verb, in messages."""
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

    from jaximu.cli import messages
    from jaximu.ground import stored

    os.environ.setdefault("JAX_PLATFORMS", "")  # keep the user's choice; JAX looks for accelerators by itself
    # Matrices here are small: threads of a linear algebra library cost more than they give, and on a busy machine wait
    # for each other five times as long as one takes alone.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "3")  # XLA calls a slow compilation an error
    logging.getLogger("matplotlib").setLevel(logging.ERROR)  # it warns where its fonts' cache cannot be written
    stored.prepare_process(_cache_folder(), lambda: messages.say(_FIRST))
    _say_what_was_not_drawn()


def _say_what_was_not_drawn() -> None:
    """Show the warning of a figure that failed as a note."""
    from jaximu.cli.messages import say

    show = warnings.showwarning

    def handle(message, *where) -> None:
        if "could not be drawn" in str(message):
            say(f"note: {message}")
        else:
            show(message, *where)

    warnings.showwarning = handle


def _names_log(word: str) -> bool:
    """Whether a first word is a log and no mistyped verb: it is there, or looks like the name of a file."""
    return word == LOG or bool(word and (set(word) & set("./\\") or Path(word).exists()))


def _parse(name: str, arguments: Sequence[str]) -> Callable[[], None]:
    """Return a verb with its arguments. Raises `InputError` for a mistake in them."""
    command = command_of(name)
    line = check_options(name, command, arguments)
    import tyro  # with what it loads for its checks, it takes as long as all that a mistake above needs

    config = tyro.conf.FlagCreatePairsOff, tyro.conf.OmitArgPrefixes
    printed = io.StringIO()
    try:
        with redirect_stderr(printed):
            return tyro.cli(command, prog=f"jaximu {name}", args=line, config=config).run
    except SystemExit:
        raise usage_mistake(name, command, printed.getvalue()) from None


def _common(arguments: Sequence[str]) -> list[str]:
    """Take out what every verb takes, and do as it says."""
    from jaximu.cli import messages

    levels = {"--quiet": 0, "-q": 0, "--verbose": 2, "-v": 2}
    messages.level = [1, *(levels[text] for text in arguments if text in levels)][-1]
    if "--no-color" in arguments:
        os.environ["NO_COLOR"] = "1"
    return [text for text in arguments if text not in (*levels, "--no-color")]


def _run(arguments: Sequence[str]) -> int:
    """Run the verb that comes first with the options that follow it."""
    name, *rest = arguments or [""]
    if name not in VERBS and not name.startswith("-") and _names_log(name):
        name, rest = LOG, [word for word in arguments if word != LOG]
    if name in (*VERBS, LOG):
        if "--help" in rest or "-h" in rest:
            print(help_text(name, command_of(name)))
            return 0
        work = _parse(name, _common(rest))
        _settings()
        work()
    elif name == "help" and rest and rest[0] in (*VERBS, LOG):
        print(help_text(rest[0], command_of(rest[0])))
    elif name in ("--help", "-h") or (name == "help" and not rest):
        print(listed(GROUPS, command_of))
    elif name in ("--version", "-V", "version"):
        print(f"jaximu {__version__}")
    elif name == "--completion":
        print(completion(rest[0] if rest else "", VERBS, command_of))
    elif name:
        import difflib

        name = rest[0] if name == "help" else name
        near = difflib.get_close_matches(name, VERBS, 1)
        raise InputError(
            f"there is no command {name!r}{f' (did you mean {near[0]}?)' if near else ''}; `jaximu --help` lists them."
        )
    else:
        print(listed(GROUPS, command_of), file=sys.stderr)
        return 2
    return 0


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line and return its exit status."""
    line = sys.argv[1:] if arguments is None else arguments
    try:
        with command_line():
            return _run(line)
    except JaximuError as error:
        return _failed(str(error.args[0]), error.exit_status, line)
    except SystemExit as stop:
        return int(stop.code or 0) if not isinstance(stop.code, str) else 2
    except KeyboardInterrupt:
        print("jaximu: stopped.", file=sys.stderr)
        return 130
    except Exception as error:  # a defect of ours; a user gets a sentence, a developer the traceback on request
        if os.environ.get("JAXIMU_DEBUG"):
            raise
        if {"--verbose", "-v"} & set(line):
            import traceback

            traceback.print_exc()
        kind = f"{type(error).__name__}: {error}".splitlines()[0]
        return _failed(f"this should not happen ({kind}); --verbose shows where. Please report it.", 1, line)


def _failed(message: str, status: int, arguments: Sequence[str]) -> int:
    """Say what went wrong on stderr, and with --json as a document on stdout too; return the exit status."""
    print(f"jaximu: {message}", file=sys.stderr)
    if "--json" in arguments:
        import json

        print(json.dumps({"schema": "jaximu.error/1", "error": message, "exit_status": status}))
    return status


def command() -> NoReturn:
    """Run the command line as a process of its own.

    It ends without taking libraries down: a reader's thread that is still at work would abort it, whatever its status.
    """
    open_streams()
    status = main()
    try:
        for stream in (sys.stdout, sys.stderr):
            print(end="", file=stream, flush=True)
    except OSError as error:  # a full disk behind a redirection
        status = _failed(f"the output could not be written: {error.strerror}.", 2, ())
    os._exit(status)
