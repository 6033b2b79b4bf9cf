"""Frame sequences: `shot.####.exr`, `shot.%04d.exr`, `shot.$F4.exr` and `--frames 1001-1100x2`, into files.

A `#` or `@` stands for one digit (as in Fileseq's PAD_STYLE_HASH1), so #### means 4 digits; the range of frames may
also stand before it, `shot.1001-1010####.exr`. Ranges are Fileseq's; names are taken apart here, because Fileseq
refuses or silently passes by folders and names with a further `#`, `@`, bracket or digit in them. Opens no file.
"""

from __future__ import annotations

import os
import re
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

from fileseq.frameset import FrameSet

from deep_io.errors import InputError, UsageError

PathLike = str | os.PathLike[str]

# What stands for the frame number in a file's name. An @ inside a word, as in user@host.exr, does not.
_NUMBER = re.compile(r"#+|@+(?![A-Za-z0-9@])|(?:%0?(?P<printf>\d*)d|\$F(?P<houdini>\d*))(?![A-Za-z])")
_RANGE_BEFORE = re.compile(r"(?:^|(?<=[^A-Za-z0-9,:-]))(?P<range>\d+[-,][-\d,x:]*\d)$")


@dataclass(frozen=True)
class Frame:
    """One frame of a job: its number (None for a single file) and the files it reads and writes."""

    number: int | None
    source: Path
    target: Path | None = None

    def __str__(self) -> str:
        return self.source.name


@dataclass(frozen=True)
class _Pattern:
    """A name taken apart: the frame number, of at least `width` characters, goes between `head` and `tail`."""

    folder: Path
    head: str
    width: int
    tail: str
    frames: str
    """The range written before the number, "" for none."""

    def frame(self, number: int) -> Path:
        """The file of one frame."""
        return self.folder / f"{self.head}{str(number).zfill(self.width)}{self.tail}"

    def on_disk(self) -> list[int]:
        """The numbers of the files that exist, ascending. Raises OSError."""
        name = re.compile(re.escape(self.head) + r"(-?\d+)" + re.escape(self.tail))
        matches = (name.fullmatch(entry) for entry in os.listdir(self.folder))
        numbers = {int(match[1]) for match in matches if match}
        # Only names that the pattern itself would give: shot.1.exr is no frame of shot.####.exr.
        return sorted(number for number in numbers if self.frame(number).is_file())


def has_pattern(path: PathLike) -> bool:
    """Whether the name holds a frame pattern, whatever exists on disk."""
    return bool(_numbers(Path(path).name))


def has_range(pattern: PathLike) -> bool:
    """Whether a pattern names its frames itself, as in shot.1001-1010####.exr. Raises UsageError for one of none."""
    return bool(_parse(pattern).frames)


def is_sequence(path: PathLike) -> bool:
    """Whether an input's name holds a frame pattern and no file of exactly this name exists."""
    return has_pattern(path) and not os.path.exists(path)


def parse_frames(text: str, given: str = "") -> list[int]:
    """The frames of a range, in the order given, each once: "1001-1100x2", "1,3,7-9".

    Raises UsageError, which quotes `given`: what the user wrote to name the range, `text` alone by default.
    """
    given = given or repr(text)
    try:
        found = list(FrameSet(text))
        frames = [int(frame) for frame in found]
        if frames != found:
            raise ValueError("frames are whole numbers")
    except (ValueError, TypeError) as error:
        raise UsageError(f"{given}: not a frame range; write 1001-1100, 1001-1100x2 or 1,3,7-9") from error
    if not frames:
        raise UsageError(f"{given}: names no frame")
    return frames


def frame_path(pattern: PathLike, number: int) -> Path:
    """The file of one frame of a pattern. Raises UsageError for a name that holds none."""
    return _parse(pattern).frame(number)


def sibling_path(path: PathLike, number: int) -> Path | None:
    """Another frame of the shot that a file such as shot.1002.exr belongs to; None where its name has no number."""
    found = re.fullmatch(r"(|.*[^0-9])(\d+)(\D*\.[^.]+)", Path(path).name)
    return Path(path).with_name(f"{found[1]}{str(number).zfill(len(found[2]))}{found[3]}") if found else None


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
    pattern = _parse(source)
    if frames is not None:
        numbers = parse_frames(frames, f"--frames {frames}")
    elif pattern.frames:
        numbers = parse_frames(pattern.frames, f"{os.fspath(source)}: {pattern.frames}")
    else:
        numbers = _on_disk(source, pattern)
    found = [Frame(number, pattern.frame(number)) for number in numbers]
    missing = [frame for frame in found if not frame.source.is_file()]
    if missing:
        listed = FrameSet([frame.number for frame in missing if frame.number is not None])
        raise InputError(f"{os.fspath(source)}: {len(missing)} of {len(found)} frames are missing: {listed}")
    return found


def gaps(frames: Sequence[Frame]) -> str:
    """The range of what is missing between the first frame and the last, at the least step of all; "" for nothing."""
    numbers = sorted({frame.number for frame in frames if frame.number is not None})
    step = min((after - before for before, after in pairwise(numbers)), default=1)
    found = []
    for before, after in pairwise(numbers):
        first, last = before + step, before + (after - before - 1) // step * step
        if first <= last:
            found.append(str(first) if first == last else f"{first}-{last}{f'x{step}' if step > 1 else ''}")
    return ",".join(found)


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
    return [Frame(frame.number, frame.source, frame_path(target, frame.number or 0)) for frame in found]


def substitute(pattern: PathLike, token: str, values: Sequence[object]) -> list[str]:
    """The pattern once for each value, put in place of `token`. Raises UsageError when the token is absent."""
    text = os.fspath(pattern)
    if token not in text:
        raise UsageError(f"{text}: the name does not hold {token}")
    return [text.replace(token, str(value)) for value in values]


def _numbers(name: str) -> list[re.Match[str]]:
    """Where a name may hold the frame number; an @, or the # of take#2, counts only where nothing else does."""
    found = list(_NUMBER.finditer(name))
    found = [match for match in found if match[0][0] != "@"] or found
    return [match for match in found if not name[match.end():match.end() + 1].isalnum()] or found


def _parse(pattern: PathLike) -> _Pattern:
    """Raises UsageError unless the name holds exactly one pattern."""
    path = Path(pattern)
    found = _numbers(path.name)
    if len(found) != 1:
        several = " and ".join(match[0] for match in found)
        raise UsageError(f"{os.fspath(pattern)}: "
                         + (f"holds {several}; write the frame number once" if found
                            else "the name has no pattern such as ####"))
    match = found[0]
    head, tail = path.name[:match.start()], path.name[match.end():]
    written = match["printf"] if match["printf"] is not None else match["houdini"]
    width = len(match[0]) if written is None else int(written or 1)
    before = _RANGE_BEFORE.search(head)
    return _Pattern(path.parent, head[:before.start()] if before else head, width, tail,
                    before["range"] if before else "")


def _on_disk(source: PathLike, pattern: _Pattern) -> list[int]:
    """The numbers of the files that match a pattern, ascending. Raises InputError when there is none."""
    if not pattern.folder.is_dir():
        raise InputError(f"{os.fspath(source)}: the folder {pattern.folder} does not exist")
    try:
        numbers = pattern.on_disk()
    except OSError as error:
        raise InputError(f"{os.fspath(source)}: {pattern.folder} cannot be listed: {error.strerror}") from error
    if not numbers:
        raise InputError(f"{os.fspath(source)}: no file matches the pattern")
    return numbers


def _why_no_file(path: PathLike) -> str:
    if os.path.exists(path):
        return "is a folder, not an EXR" if os.path.isdir(path) else "is a pipe or a device, not a file"
    return "no such file"
