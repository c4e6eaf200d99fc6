"""What a verb takes, read from the fields of its class: its help, completion, and mistakes in its options."""

from __future__ import annotations

import difflib
import inspect
import itertools
import re
import shutil
import textwrap
import typing
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import MISSING, dataclass, fields, is_dataclass
from importlib import import_module
from pathlib import Path
from types import UnionType
from typing import Any

from jaximu.cli.messages import say
from jaximu.ground.errors import InputError

EXIT_STATUS = (
    "Exit status: 0 done; 1 understood but not possible (the message says what to record); 2 bad input or usage."
)
_GROUPS = "Options", "Reading", "Gravity", "Traceability", "Output"
_IN_OUTPUT = "output", "as_json"
_KINDS = {str: "TEXT", int: "NUMBER", float: "NUMBER", Path: "PATH"}


@dataclass(frozen=True)
class OptionHelp:
    """An option, or with no names starting in a hyphen a positional argument, as its help shows it."""

    names: tuple[str, ...]
    metavar: str
    help: str
    group: str
    default: object = None

    @property
    def positional(self) -> bool:
        """Whether it is given by its place."""
        return not self.names


_RENAMED = {"--allan": "--noise"}
"""Options by their former names, which go on working until the next version."""
COMMON = (
    OptionHelp(("--quiet", "-q"), "", "Say nothing on stderr but errors.", "Output"),
    OptionHelp(
        ("--verbose", "-v"), "", "Show how long every stage takes, and where an unexpected error arose.", "Output"
    ),
    OptionHelp(("--no-color",), "", "No colours and no bold type (as NO_COLOR=1).", "Output"),
    OptionHelp(("--help", "-h"), "", "Show this help.", "Output"),
)
"""What every verb takes."""


def command_of(verb: str) -> type[Any]:
    """Return the class of a verb, of the module of its name: its fields are the options, `run` does the work."""
    return getattr(import_module(f"jaximu.cli.{verb.lower()}"), f"{verb.capitalize()}Command")


def options_of(command: type[Any]) -> list[OptionHelp]:
    """Return what a verb takes, in the order of its fields."""
    hints = typing.get_type_hints(command, include_extras=True)
    helps: list[OptionHelp] = []
    for part in fields(command):
        name, default = part.name, part.default
        if is_dataclass(default):
            group_hints = typing.get_type_hints(type(default), include_extras=True)
            title = getattr(default, "title", "Options")
            options = [field for field in fields(default) if field.repr]  # the others are no options
            helps += [_option(field.name, group_hints[field.name], field.default, title) for field in options]
        else:
            helps.append(_option(name, hints[name], default, "Output" if name in _IN_OUTPUT else "Options"))
    return helps


def paragraphs_about(documented: object) -> list[str]:
    """Return the paragraphs of what a class says of itself, each as one line."""
    return [" ".join(paragraph.split()) for paragraph in (inspect.getdoc(documented) or "").split("\n\n")]


def _option(name: str, hint: object, default: object, group: str) -> OptionHelp:
    arguments = typing.get_args(hint) if typing.get_origin(hint) is typing.Annotated else (hint,)
    stated = next((argument for argument in arguments[1:] if hasattr(argument, "metavar")), None)
    positional = any(
        getattr(argument, "__name__", "") == "Positional" or str(argument) == "Positional" for argument in arguments[1:]
    )
    option = "--" + str(getattr(stated, "name", None) or name).replace("_", "-")
    metavar = getattr(stated, "metavar", None) or ("" if arguments[0] is bool else _metavariable(arguments[0]))
    aliases = tuple(getattr(stated, "aliases", None) or ())
    names = () if positional else (*aliases, option)
    return OptionHelp(names, metavar, getattr(stated, "help", None) or "", group, default)


def _metavariable(hint: object) -> str:
    origin, parts = typing.get_origin(hint), typing.get_args(hint)
    if origin is typing.Literal:
        return "{" + ",".join(map(str, parts)) + "}"
    if origin in (typing.Union, UnionType, tuple):
        return next((_metavariable(part) for part in parts if part not in (type(None), ...)), "TEXT")
    return _KINDS.get(typing.cast(type, hint), "TEXT")


def help_text(name: str, command: type[Any]) -> str:
    """Return the help of a verb: what it does, its arguments, its options by group, examples, exit status."""
    width = min(shutil.get_terminal_size().columns, 100)
    text, _, examples = (inspect.getdoc(command) or "").partition("\n\nExamples:\n")
    options = options_of(command)
    positional = [option for option in options if option.positional]
    places = [option.metavar for option in positional]
    verb = [] if places and places[0].startswith(name) else [name]  # a log stands in place of a verb
    lines = [" ".join(["usage: jaximu", *verb, "[OPTIONS]", *places]), ""]
    for paragraph in text.split("\n\n"):
        lines += [*textwrap.wrap(" ".join(paragraph.split()), width), ""]
    for option in positional:
        lines += [*_lines(option.metavar, option.help, width), ""] if option.help else []
    for group in _GROUPS:
        shown = [option for option in (*options, *COMMON) if option.group == group and not option.positional]
        if shown:
            lines.append(f"{group}:")
            for option in shown:
                stated = option.default not in (None, False, (), MISSING)
                default = f" (default: {option.default})" if stated else ""
                lines += _lines(f"{', '.join(option.names)} {option.metavar}".rstrip(), option.help + default, width)
            lines.append("")
    if examples:
        lines += ["Examples:", examples, ""]
    return "\n".join([*lines, *textwrap.wrap(EXIT_STATUS, width)])


def _lines(left: str, text: str, width: int, indent: int = 26) -> list[str]:
    wrapped = textwrap.wrap(text, width - indent) or [""]
    if len(left) > indent - 4:
        return [f"  {left}", *(f"{'':{indent}}{line}" for line in wrapped)]
    return [f"  {left:<{indent - 2}}{wrapped[0]}".rstrip(), *(f"{'':{indent}}{line}" for line in wrapped[1:])]


def listed(groups: Mapping[str, str], verb: Callable[[str], type[Any]]) -> str:
    """Return the overview: the usage, and by group what each verb does in its own words; `groups`: names by title."""
    width = min(shutil.get_terminal_size().columns, 100)
    lines = [
        "usage: jaximu VERB [OPTIONS] …",
        "       jaximu LOG [LOG ...] [--yes] [-o DIR]    all that the logs allow, in one report",
        "",
        "Calibrate inertial measurement units.",
        "",
    ]
    for group, names in groups.items():
        lines.append(f"{group}:")
        for name in names.split():
            lines += _lines(name, paragraphs_about(verb(name))[0], width, 17)
        lines.append("")
    rest = [
        ("--help", "Show this overview; after a verb, its options and examples."),
        ("--version", "Show the version."),
        ("--completion SHELL", "Print a script that completes verbs and options: bash, zsh or fish."),
    ]
    lines += ["Options:", *(line for left, text in rest for line in _lines(left, text, width, 24)), ""]
    lines += [
        "Examples:",
        "  jaximu demo",
        "  jaximu log.csv -o results",
        "  jaximu info log.csv",
        "  jaximu calibrate log.csv -o results",
        "",
    ]
    return "\n".join([*lines, *textwrap.wrap(EXIT_STATUS, width)])


def check_options(name: str, command: type[Any], arguments: Sequence[str]) -> list[str]:
    """Return the command line, with `--option=value` where a value begins with a minus, as the axes -x,-y,z do.

    Raises `InputError` for an option that the verb has not, naming the nearest that it has, and for one that it needs.
    """
    options = (*options_of(command), *COMMON)
    known = [text for option in options for text in option.names]
    valued = [text for option in options if option.metavar for text in option.names if text.startswith("--")]
    line: list[str] = []
    for text in arguments:
        option, *value = text.split("=", 1)
        renamed = _RENAMED.get(option)
        if renamed in known and option not in known:
            say(f"{option} is called {renamed} now.")
            option, text = renamed, "=".join([renamed, *value])
        if re.fullmatch(r"--[a-z][\w-]*", option) and option.replace("_", "-") not in known:
            near = difflib.get_close_matches(option, known, 1, 0.5)
            hint = f"; did you mean {near[0]}?" if near else "."
            raise InputError(f"jaximu {name} has no option {option}{hint} `jaximu {name} --help` lists its options.")
        if line and line[-1] in valued and text.startswith("-") and option not in known:
            line[-1] += f"={text}"
        else:
            line.append(text)
    _require_all(name, options, line)
    return line


def _require_all(name: str, options: Sequence[OptionHelp], line: Sequence[str]) -> None:
    """Refuse a line without an argument or an option that has no default."""
    if "--" in line:  # what follows it may look like options
        return
    valued = {text for option in options if option.metavar for text in option.names}
    words = sum(before not in valued and text[:1] != "-" for before, text in itertools.pairwise(["", *line]))
    needed = [option for option in options if option.default is MISSING]
    missing = [option.metavar.split()[0].strip(".") for option in needed if option.positional][words:]
    missing += [
        f"{option.names[-1]} {option.metavar}"
        for option in needed
        if option.names and not any(text.startswith(option.names) for text in line)
    ]
    if missing:
        raise InputError(f"{missing[0]} is missing. See `jaximu {name} --help`.")


_VALUE = re.compile(r"Error parsing (?P<option>\S+): .*? from \[(?P<value>.*?)\]\.")


def usage_mistake(name: str, command: type[Any], printed: str) -> InputError:
    """Return what is wrong with a command line as one sentence, from what the parser printed in a box."""
    lines = [line.strip("│╭╮╰╯ ") for line in printed.splitlines()]
    _, *lines = [line for line in lines if line]  # a title, and perhaps a rule; what follows the next rule is advice
    rule = re.compile("[─-]{9,}")
    lines = list(itertools.dropwhile(rule.fullmatch, lines))
    text = " ".join(itertools.takewhile(lambda line: not rule.fullmatch(line), lines))
    if match := _VALUE.search(text):
        kinds = {spelling: option.metavar for option in options_of(command) for spelling in option.names}
        kind = "a number" if "FLOAT" in text or "INT" in text else kinds.get(match["option"], "what it takes")
        text = f"{match['option']}: {match['value']} is not {kind}."
    text = re.sub(r"Unrecognized options: (.*)", r"unexpected: \1.", text)
    return InputError(f"{text} See `jaximu {name} --help`.")


def completion(shell: str, verbs: Sequence[str], verb: Callable[[str], type[Any]]) -> str:
    """Return a script for bash, zsh or fish that completes verbs, options and files."""
    if shell not in ("bash", "zsh", "fish"):
        raise InputError(f"--completion: {shell!r} is none of bash, zsh, fish.")
    names = {name: _names(verb(name)) for name in verbs}
    if shell == "fish":
        lines = [f"complete -c jaximu -n __fish_use_subcommand -f -a '{' '.join(verbs)}'"]
        for name, options in names.items():
            long = " ".join(f"-l {option[2:]}" for option in options)
            lines.append(f"complete -c jaximu -n '__fish_seen_subcommand_from {name}' {long}")
        return "\n".join(lines)
    cases = "\n".join(f"    {name}) words='{' '.join(options)}' ;;" for name, options in names.items())
    head = "autoload -U +X bashcompinit && bashcompinit\n" if shell == "zsh" else ""
    return f"""{head}_jaximu() {{
  local words='{" ".join(verbs)} --help --version'
  if [ "$COMP_CWORD" -gt 1 ]; then
    case "${{COMP_WORDS[1]}}" in
{cases}
    esac
    case "$2" in -*) ;; *) return ;; esac
  fi
  COMPREPLY=($(compgen -W "$words" -- "$2"))
}}
complete -o default -F _jaximu jaximu"""


def _names(command: type[Any]) -> Iterator[str]:
    return (name for option in (*options_of(command), *COMMON) for name in option.names if name.startswith("--"))
