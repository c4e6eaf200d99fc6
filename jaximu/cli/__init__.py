"""The command line: one file a verb, no numerics.

Results go to stdout, progress and prose about the work to stderr. Exit status 0: done; 1: understood but not possible;
2: bad input or usage.
"""

from jaximu.cli.app import command, main

__all__ = ["command", "main"]
