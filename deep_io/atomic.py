"""Outputs that appear whole or not at all, and the rules that refuse one.

`output_action` decides before any work whether a file may be written; `atomic_output` writes beside the target and
renames. Knows nothing of what is written.
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


def output_action(target: PathLike, inputs: Iterable[PathLike] = (), existing: Existing = "refuse", *,
                  can_skip: bool = True) -> bool:
    """Whether `target` is to be written: True, or False where it exists and `existing` is "skip".

    `can_skip` tells whether the job's command has --skip-existing, so that a refusal may advise it.
    Raises UsageError when it is one of `inputs` (the same file, a hard or symbolic link to it), when it exists and
    may not be replaced, and when it is a folder; InputError when its folder does not exist or cannot be written.
    """
    path = Path(target)
    _refuse_inputs(path, inputs)
    if path.is_dir():
        raise UsageError(f"{path}: is a folder; name the file to write")
    _require_folder(path)
    if os.path.lexists(path):
        if existing == "skip":
            return False
        if existing == "refuse":
            skip = " or --skip-existing to leave it" if can_skip else ""
            raise UsageError(f"{path}: exists; pass --overwrite to replace it{skip}")
    return True


def _refuse_inputs(path: Path, inputs: Iterable[PathLike]) -> None:
    for source in inputs:
        same = os.path.realpath(source) == os.path.realpath(path)
        with suppress(OSError):  # one of them does not exist
            same = same or os.path.samefile(source, path)
        if same:
            raise UsageError(f"{path}: is the input {os.fspath(source)} itself; write to another file")


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
