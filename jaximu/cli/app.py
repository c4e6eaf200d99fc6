"""The entry point: settings of the process, choice of the verb, errors as sentences."""

import os
import sys
from collections.abc import Sequence
from contextlib import suppress
from importlib import import_module
from pathlib import Path
from typing import NoReturn

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
    "plan",
    "budget",
    "thermal",
    "fleet",
    "export",
)
"""One module of this folder each, with a function `run`."""


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
    """Double precision and compiled code kept between runs: settings of this process, never of an importing one."""
    import jax

    jax.config.update("jax_enable_x64", True)
    from jaximu import stored

    folder = None if "JAX_COMPILATION_CACHE_DIR" in os.environ else _cache_folder()
    stored.use_folder(folder)
    if folder is not None:
        jax.config.update("jax_compilation_cache_dir", str(folder))
        jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.1)
        jax.config.update("jax_persistent_cache_min_entry_size_bytes", -1)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line and return its exit status."""
    import tyro

    from jaximu.errors import JaximuError

    os.environ.setdefault("JAX_PLATFORMS", "")  # keep the user's choice; JAX looks for accelerators by itself
    try:
        _settings()
        given = list(sys.argv[1:] if arguments is None else arguments)
        verbs = VERBS
        if given and given[0] in VERBS:
            # What the other verbs import would cost half a second; tyro needs two commands to expect a command's name.
            verbs = (given[0], "effects" if given[0] == "info" else "info")
        app = tyro.extras.SubcommandApp()
        for verb in verbs:
            app.command(import_module(f"jaximu.cli.{verb}").run, name=verb)
        if given in (["--version"], ["-V"]):
            from jaximu import __version__

            print(f"jaximu {__version__}")
            return 0
        app.cli(
            prog="jaximu",
            description="Calibrate inertial measurement units.",
            args=given,
            config=(tyro.conf.FlagCreatePairsOff, tyro.conf.OmitArgPrefixes),
        )
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
    return 0


def command() -> NoReturn:
    """Run the command line as a process of its own.

    It ends without taking libraries down: a reader's thread that is still at work would abort it, whatever its status.
    """
    status = main()
    with suppress(OSError, ValueError):  # a pipe that nobody reads any more
        sys.stdout.flush()
        sys.stderr.flush()
    os._exit(status)
