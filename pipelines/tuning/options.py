"""What tuning is told. Nothing here reads a file or imports torch."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from pipelines.options import DenoiseOptions
from pipelines.progress import ProgressKind

if TYPE_CHECKING:
    from deep_io.atomic import Existing

FIRST_STEPS, STEPS_A_CROP, MOST_STEPS = 24, 8, 96
"""Few crops are soon learned by heart, noise and all; many bear more steps, and gain more by them."""
MOST_FRAMES = 8


@dataclass(frozen=True)
class TuneOptions:
    """Everything `pipelines.tuning.job.tune` is told.

    reading : which frames there are and how they are read and decided, as `lbmc denoise` is told; its target is where
        the weights go, its model what they start from
    existing : what to do where that file exists
    steps : of gradient descent; each sees CROPS crops, fewer where the frames hold no more. None: `steps_for` them
    most_frames : of a sequence, so many are looked at, evenly spread
    seed : of what is drawn: which crops, and which samples go into which half
    """

    reading: DenoiseOptions
    existing: Existing = "refuse"
    steps: int | None = None
    most_frames: int = MOST_FRAMES
    seed: int = 1
    progress: ProgressKind = "auto"

    def __post_init__(self) -> None:
        from deep_io.sequences import has_pattern  # not for `--help`
        from model.weight_files import SUFFIX

        if self.steps is not None and self.steps < 1:
            raise ValueError(f"steps must be at least 1, not {self.steps}")
        if self.most_frames < 1:
            raise ValueError(f"most_frames must be at least 1, not {self.most_frames}")
        if self.seed < 0:
            raise ValueError(f"seed must not be negative, but is {self.seed}")
        if not self.reading.target.endswith(SUFFIX):
            raise ValueError(f"{self.reading.target}: OUT is a weight file; its name must end in {SUFFIX}")
        if has_pattern(self.reading.target):
            raise ValueError(f"{self.reading.target}: one file serves a whole shot; leave the number out of OUT")


def steps_for(crops: float) -> int:
    """Steps for so many crops, where nothing is said: 32 for one and less, 96 from nine on."""
    return min(FIRST_STEPS + round(STEPS_A_CROP * max(crops, 1)), MOST_STEPS)
