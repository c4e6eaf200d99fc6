"""Errors as sentences a user can act on, each with the exit status that the command line returns for it."""


class JaximuError(Exception):
    """Base of the errors that jaximu raises on purpose; the message is one plain sentence (or a few)."""

    exit_status = 2


class InputError(JaximuError):
    """Bad input or usage: the message names the file, row or column and what to change. Exit status 2."""

    exit_status = 2


class NotPossibleError(JaximuError):
    """The input was understood but does not allow the task; the message says what to record. Exit status 1."""

    exit_status = 1
