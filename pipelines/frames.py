"""Which frames a denoising job reads and writes, found before anything slow: no pixel is read, no torch imported."""

from __future__ import annotations

import re
from pathlib import Path

from deep_io.errors import InputError, UsageError
from deep_io.sequences import Frame, expand, frame_path, is_sequence, pair, sibling_path
from pipelines.options import DenoiseOptions


def find_frames(options: DenoiseOptions) -> list[Frame]:
    """The frames of a job, each with its input and output.

    Raises what deep_io.sequences.pair does, and InputError or UsageError where the frame of `exposure_from` is not
    there.
    """
    frames = pair(options.source, options.target, options.frames)
    exposure_frame(options)
    return frames


def find_sources(options: DenoiseOptions) -> list[Frame]:
    """The frames of a job that writes none. Raises what deep_io.sequences.expand does, and as `find_frames`."""
    frames = expand(options.source, options.frames)
    exposure_frame(options)
    return frames


def exposure_frame(options: DenoiseOptions) -> Path | None:
    """The file whose exposure and depth scale serve all frames; None where the job's own first frame does.

    Raises InputError when it is missing, UsageError for a number where the input's name has none.
    """
    named = options.exposure_from
    if named is None:
        return None
    path: Path | None = Path(named)
    if re.fullmatch(r"-?\d+", named) and not Path(named).exists():
        name_frame = frame_path if is_sequence(options.source) else sibling_path
        path = name_frame(options.source, int(named))
    if path is None:
        raise UsageError(f"--exposure-from {named}: {options.source} has no frame number; name a file instead")
    if not path.is_file():
        raise InputError(f"--exposure-from {named}: {path}: no such file; name a frame that is there")
    return path
