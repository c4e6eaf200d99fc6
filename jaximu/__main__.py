"""`python -m jaximu` is the command `jaximu`."""

from jaximu.cli import command

command()
