"""The one error family of lbmc and the warnings of deep_io.

Every message is one line that names the file and, where there is one, the cure. The command line turns
`exit_code` into the process's exit code; nothing below it prints or exits.
"""

from __future__ import annotations


class LbmcError(Exception):
    """Base of every error that lbmc raises on purpose; `exit_code` is what the command ends with."""

    exit_code = 1


class UsageError(LbmcError):
    """The command cannot be carried out as asked: options that contradict, an output that is refused."""

    exit_code = 2


class OutputError(LbmcError):
    """An output could not be written: the disk is full, a quota is used up, a folder went away."""


class InputError(LbmcError):
    """An input file is unreadable, corrupt or not the kind of file the job needs."""

    exit_code = 3


class MemoryCostWarning(UserWarning):
    """A file can only be read on a path that takes much more memory than its samples do."""
