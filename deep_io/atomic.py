"""Outputs that appear whole or not at all, and the rules that refuse one.

`output_action` decides before any work whether a file may be written, `Inputs` knows the files it must not be;
`atomic_output` writes beside the target and renames. Knows nothing of what is written.
"""

from __future__ import annotations

import os
import re
import secrets
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Literal

from deep_io.errors import InputError, OutputError, UsageError

PathLike = str | os.PathLike[str]
Existing = Literal["refuse", "overwrite", "skip"]

MOST_OF_STEM = 40  # characters: a name of the 255 bytes that file systems allow leaves no room for what is added


class Inputs:
    """The files that a job reads, looked up on the disk once, however many outputs are held against them."""

    def __init__(self, paths: Iterable[PathLike] = ()) -> None:
        self._names: dict[str | tuple[int, int], str] = {}
        for path in paths:
            for identity in _identities(path):
                self._names.setdefault(identity, os.fspath(path))

    def same_as(self, path: PathLike) -> str | None:
        """The name of the input that `path` is, or is a hard or symbolic link to; None where it is none."""
        return next((self._names[identity] for identity in _identities(path) if identity in self._names), None)


def _identities(path: PathLike) -> Iterator[str | tuple[int, int]]:
    """What two names of one file have in common: the real path, and device and number where it exists."""
    yield os.path.realpath(path)
    with suppress(OSError):
        found = os.stat(path)
        yield found.st_dev, found.st_ino


def output_action(target: PathLike, inputs: Inputs | Iterable[PathLike] = (), existing: Existing = "refuse", *,
                  can_skip: bool = True) -> bool:
    """Whether `target` is to be written: True, or False where it exists and `existing` is "skip".

    `inputs` are looked up on every call unless they are `Inputs` already, as those of a job with many outputs should.
    `can_skip` tells whether the job's command has --skip-existing, so that a refusal may advise it.
    Raises UsageError when it is one of `inputs` (the same file, a hard or symbolic link to it), when it exists and
    may not be replaced, and when it is a folder; InputError when its folder does not exist or cannot be written.
    """
    path = Path(target)
    source = (inputs if isinstance(inputs, Inputs) else Inputs(inputs)).same_as(path)
    if source is not None:
        raise UsageError(f"{path}: is the input {source} itself; write to another file")
    if path.is_dir():
        raise UsageError(f"{path}: is a folder; name the file to write")
    exists = os.path.lexists(path)
    if exists and existing == "skip":  # also where nothing could be written
        return False
    _require_folder(path)
    if exists and existing == "refuse":
        skip = " or --skip-existing to leave it" if can_skip else ""
        raise UsageError(f"{path}: exists; pass --overwrite to replace it{skip}")
    return True


def _require_folder(path: Path) -> None:
    if not path.parent.is_dir():
        raise InputError(f"{path}: the folder {path.parent} does not exist; make it first")
    if not os.access(path.parent, os.W_OK | os.X_OK):
        raise InputError(f"{path}: the folder {path.parent} cannot be written to")


@contextmanager
def atomic_output(target: PathLike) -> Iterator[Path]:
    """Gives the path of a temporary file beside `target` to write to, and renames it onto `target` at the end.

    On any exception, KeyboardInterrupt and whatever a signal handler raises included, the temporary file is removed
    and the target stays as it was. The name keeps the target's suffix, since libraries choose the format by it, and
    begins with a dot, so that no sequence pattern finds it. Of the target's own name it has only a beginning in letters
    that every library takes. Permissions follow the umask, or the file replaced.
    Raises InputError when the folder does not exist, OutputError in place of an OSError inside.
    """
    path = Path(target)
    _require_folder(path)
    stem = re.sub(r"[^\w.-]", "_", path.stem)[:MOST_OF_STEM]
    temporary = path.with_name(f".{stem}.{os.getpid()}-{secrets.token_hex(4)}.tmp{path.suffix}")
    try:
        yield temporary
        with suppress(FileNotFoundError):
            os.chmod(temporary, path.stat().st_mode & 0o777)
        os.replace(temporary, path)
    except BaseException as error:
        with suppress(FileNotFoundError):
            temporary.unlink()
        if isinstance(error, OSError):
            reason = error.strerror or str(error).replace(str(temporary), str(path)).removeprefix(f"{path}: ")
            raise OutputError(f"{path}: cannot be written: {reason}") from error
        raise
