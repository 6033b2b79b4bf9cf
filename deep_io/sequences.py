"""Frame sequences: `shot.####.exr`, `shot.%04d.exr`, `shot.$F4.exr` and `--frames 1001-1100x2`, into files.

A `#` stands for one digit (Fileseq's PAD_STYLE_HASH1), so #### means 4 digits. Opens no file.
"""

from __future__ import annotations

import os
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from fileseq.constants import PAD_STYLE_HASH1
from fileseq.exceptions import FileSeqException
from fileseq.filesequence import FileSequence
from fileseq.frameset import FrameSet

from deep_io.errors import InputError, UsageError

PathLike = str | os.PathLike[str]

_PATTERN = re.compile(r"#|@|%0?\d*d|\$F\d*")  # what stands for the frame number in a file's name


@dataclass(frozen=True)
class Frame:
    """One frame of a job: its number (None for a single file) and the files it reads and writes."""

    number: int | None
    source: Path
    target: Path | None = None

    def __str__(self) -> str:
        return self.source.name


def has_pattern(path: PathLike) -> bool:
    """Whether the name holds a frame pattern, whatever exists on disk."""
    return _PATTERN.search(Path(path).name) is not None


def is_sequence(path: PathLike) -> bool:
    """Whether an input's name holds a frame pattern and no file of exactly this name exists."""
    return has_pattern(path) and not os.path.exists(path)


def parse_frames(text: str) -> list[int]:
    """The frames of `--frames`, in the order given, each once: "1001-1100x2", "1,3,7-9". Raises UsageError."""
    try:
        frames = [int(frame) for frame in FrameSet(text)]
    except (ValueError, TypeError) as error:
        raise UsageError(f"--frames {text}: not a frame range; write 1001-1100, 1001-1100x2 or 1,3,7-9") from error
    if not frames:
        raise UsageError(f"--frames {text}: names no frame")
    return frames


def frame_path(pattern: PathLike, number: int) -> Path:
    """The file of one frame of a pattern."""
    return Path(_sequence(pattern).frame(number))


def expand(source: PathLike, frames: str | None = None) -> list[Frame]:
    """The frames of an input: a single file, or those of a pattern that `frames` names or that exist on disk.

    Raises InputError when the file, every file of the pattern or one of the frames asked for is missing (all missing
    ones are listed), UsageError for a frame range that cannot be read or is given with a single file.
    """
    if not is_sequence(source):
        if frames is not None:
            raise UsageError(f"{os.fspath(source)}: --frames is given, but the name has no pattern such as ####")
        if not os.path.isfile(source):
            raise InputError(f"{os.fspath(source)}: {_why_no_file(source)}")
        return [Frame(None, Path(source))]
    sequence = _sequence(source)
    if frames is not None:
        numbers = parse_frames(frames)
    elif written := sequence.frameSet():
        numbers = [int(number) for number in written]  # shot.1001-1010####.exr
    else:
        numbers = _on_disk(source)
    found = [Frame(number, Path(sequence.frame(number))) for number in numbers]
    missing = [frame for frame in found if not frame.source.is_file()]
    if missing:
        listed = FrameSet([frame.number for frame in missing if frame.number is not None])
        raise InputError(f"{os.fspath(source)}: {len(missing)} of {len(found)} frames are missing: {listed}")
    return found


def require_exr(target: PathLike) -> None:
    """Raises UsageError for an output whose name promises another format than the EXR that will be in it."""
    if Path(target).suffix.lower() != ".exr":
        raise UsageError(f"{os.fspath(target)}: an EXR is written; give it a name that ends in .exr")


def pair(source: PathLike, target: PathLike, frames: str | None = None) -> list[Frame]:
    """The frames of an input, each with the file that it writes.

    Raises InputError when one of `source` and `target` is a sequence and the other a single file, and what
    `require_exr` and `expand` raise.
    """
    if not os.path.isdir(target):  # a folder is refused as one, with all outputs
        require_exr(target)
    many = is_sequence(source)
    # An output of this very name may exist from a mistaken run; the pattern still says what is meant.
    many_out = has_pattern(target)
    if many and not many_out:
        raise InputError(f"{os.fspath(target)}: IN is a sequence ({os.fspath(source)}) but OUT is a single file; "
                         f"write the frame number into OUT as well, such as {Path(target).stem}.####.exr")
    if many_out and not many:
        raise InputError(f"{os.fspath(target)}: OUT is a sequence but IN ({os.fspath(source)}) is a single file")
    found = expand(source, frames)
    if not many:
        return [Frame(None, found[0].source, Path(target))]
    pattern = _sequence(target)
    return [Frame(frame.number, frame.source, Path(pattern.frame(str(frame.number)))) for frame in found]


def substitute(pattern: PathLike, token: str, values: Sequence[object]) -> list[str]:
    """The pattern once for each value, put in place of `token`. Raises UsageError when the token is absent."""
    text = os.fspath(pattern)
    if token not in text:
        raise UsageError(f"{text}: the name does not hold {token}")
    return [text.replace(token, str(value)) for value in values]


def _sequence(pattern: PathLike) -> FileSequence:
    try:
        return FileSequence(os.fspath(pattern), pad_style=PAD_STYLE_HASH1)
    except FileSeqException as error:
        raise UsageError(f"{os.fspath(pattern)}: not a frame pattern: {error}") from error


def _on_disk(source: PathLike) -> list[int]:
    """The numbers of the files that match a pattern, ascending."""
    sequence = _sequence(source)
    folder = Path(sequence.dirname() or ".")
    if not folder.is_dir():
        raise InputError(f"{os.fspath(source)}: the folder {folder} does not exist")
    name = re.compile(re.escape(sequence.basename()) + r"(-?\d+)" + re.escape(sequence.extension()))
    matches = (name.fullmatch(entry) for entry in os.listdir(folder))
    numbers = [int(match[1]) for match in matches if match]
    # Only names that the pattern itself would give: shot.1.exr is no frame of shot.####.exr.
    numbers = sorted({number for number in numbers if os.path.isfile(sequence.frame(number))})
    if not numbers:
        raise InputError(f"{os.fspath(source)}: no file matches the pattern")
    return numbers


def _why_no_file(path: PathLike) -> str:
    return "is a folder, not an EXR" if os.path.isdir(path) else "no such file"
