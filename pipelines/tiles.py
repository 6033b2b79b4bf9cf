"""Bands: how a frame is cut into full-width strips so that a job stays within its memory budget.

A band is read with a halo as wide as the network's reach and starts on the network's grid, so that where the cuts lie
changes nothing in the result.
"""

from __future__ import annotations

import os
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

import numpy as np
import numpy.typing as npt

# From peaks of `lbmc denoise` on frames of 960x540 and 1920x540 with 2 to 24 samples and 1 to 5 layers; a tenth more.
BYTES_BASE = 350 << 20  # the process with its libraries
BYTES_PER_SAMPLE = 105  # decoded roles in float32, and what the network holds per sample
BYTES_PER_MIRRORED = 40  # besides, of each sample where mirror images are denoised as well
BYTES_PER_CHANNEL = 7.0  # of each pixel and channel of the context's network
BYTES_PER_MIRRORED_CHANNEL = 4.5  # besides, where mirror images are denoised: what one run leaves is not all free again
BYTES_PER_LAYER = 1100  # of each pixel: planes and predictions
BYTES_PER_CARRIED = (16, 64)  # for each channel filtered besides the radiance: of each sample, of each pixel and layer
BYTES_OF_RESULT = 24  # of each pixel and layer of a frame, whatever its bands
BYTES_OF_LIGHT = 8  # of each pixel of a frame: what the survey keeps of its light, and what is made of that
BYTES_OF_CONTEXT = 1.25  # of each pixel and channel of a frame whose bands share a context
BYTES_TO_DECODE = 9.5  # the same while it is made, before the first band
DEFAULT_MEMORY = 8 << 30
CONTROL_GROUPS = {  # where a hierarchy of control groups is mounted: the file of a group that has its limit
    "sys/fs/cgroup": "memory.max",
    "sys/fs/cgroup/unified": "memory.max",
    "sys/fs/cgroup/memory": "memory.limit_in_bytes",
}


@dataclass(frozen=True)
class Band:
    """Rows y0..y1 (exclusive) of the result, made from rows read0..read1; all count from the frame's first row."""

    y0: int
    y1: int
    read0: int
    read1: int


@dataclass(frozen=True)
class FrameLoad:
    """What a frame weighs on memory.

    samples : (height,) how many each row holds
    carried : channels filtered besides the radiance
    mirrored : whether mirror images of it are denoised as well
    channels : the most of the network that makes the context, at its own resolution
    """

    width: int
    samples: npt.NDArray[np.int64]
    layers: int
    carried: int = 0
    mirrored: bool = False
    channels: int = 64

    @property
    def height(self) -> int:
        """Rows."""
        return len(self.samples)

    def most_samples(self, rows: int) -> int:
        """In any so many neighbouring rows."""
        before = np.concatenate([[0], np.cumsum(self.samples)])
        rows = min(rows, self.height)
        return int((before[rows:] - before[: len(before) - rows]).max())

    def needed(self, rows: int) -> int:
        """Estimated peak bytes of denoising any so many rows at once."""
        per_sample, per_layer = BYTES_PER_CARRIED
        channel = BYTES_PER_CHANNEL + self.mirrored * BYTES_PER_MIRRORED_CHANNEL
        pixel = round(self.channels * channel) + self.layers * (BYTES_PER_LAYER + self.carried * per_layer)
        per_sample = BYTES_PER_SAMPLE + self.carried * per_sample + self.mirrored * BYTES_PER_MIRRORED
        samples = self.most_samples(rows) * per_sample
        result = self.height * self.width * (self.layers * BYTES_OF_RESULT + BYTES_OF_LIGHT)
        return BYTES_BASE + result + rows * self.width * pixel + samples

    @property
    def context(self) -> int:
        """Estimated bytes of a context that bands share."""
        return round(self.height * self.width * self.channels * BYTES_OF_CONTEXT)

    def needed_shared(self, rows: int) -> int:
        """`needed` where bands share a context."""
        decoded = round(self.height * self.width * self.channels * BYTES_TO_DECODE)
        return max(self.needed(rows) + self.context, BYTES_BASE + decoded)


def default_memory(root: Path = Path("/")) -> int:
    """Bytes: DEFAULT_MEMORY, or half of what the machine, or this process's control group, has, where that is less.

    root : where the machine's /proc and /sys are
    """
    there = [2 * DEFAULT_MEMORY]
    with suppress(AttributeError, ValueError, OSError):  # no sysconf, or it does not know
        there.append(os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES"))
    return min(*there, *control_group_limits(root)) // 2


def control_group_limits(root: Path) -> list[int]:
    """Bytes that the control groups of this process, and those around them, may have; of version 1 and 2.

    Inside a container the paths of /proc/self/cgroup may be those of the machine, and what is mounted the container's
    own group: so each mount counts itself, too. "No limit" is `max`, or a number that no machine has.
    """
    groups = {"/"}
    with suppress(OSError):
        for line in (root / "proc/self/cgroup").read_text().splitlines():
            _, controllers, path = line.split(":", 2)
            if controllers == "" or "memory" in controllers.split(","):
                groups |= {path, *map(str, PurePosixPath(path).parents)}
    limits = []
    for mount, limit in CONTROL_GROUPS.items():
        for group in groups:
            with suppress(OSError, ValueError):
                limits.append(int((root / mount / group.lstrip("/") / limit).read_text()))
    return limits


def plan_bands(load: FrameLoad, reach: int, shared_reach: int | None, stride: int, memory: int) -> list[Band]:
    """The fewest equal bands that fit the budget; where none fits, bands of one stride, the smallest there are.

    reach, shared_reach : of the network, and of one whose bands share a context, None if they cannot
    """
    height = load.height
    if load.needed(height) <= memory:
        return [Band(0, height, 0, height)]
    if shared_reach is not None:
        reach, memory = shared_reach, memory - load.context
    halo = 2 * reach + stride  # above, below, and down to the grid
    fitting = stride
    while fitting < height and load.needed(min(fitting + stride + halo, height)) <= memory:
        fitting += stride
    rows = -(-height // -(-height // fitting))  # as many bands, but equal ones
    rows = -(-rows // stride) * stride
    return [_band(y, min(y + rows, height), height, reach, stride) for y in range(0, height, rows)]


def narrowed(bands: list[Band], busy: npt.NDArray[np.bool_], height: int, reach: int, stride: int) -> list[Band]:
    """The bands without rows of the frame that nothing is wanted of: busy (H,) says of which something is.

    What goes is whole bands, and rows above the first and below the last busy row of a band.
    """
    some = []
    for band in bands:
        rows = np.flatnonzero(busy[band.y0 : band.y1])
        if rows.size:
            first = band.y0 + int(rows[0]) // stride * stride
            some.append(_band(first, band.y0 + int(rows[-1]) + 1, height, reach, stride))
    return some


def within_reach(busy: npt.NDArray[np.bool_], reach: int, stride: int) -> tuple[int, int]:
    """First row, on the grid, and last, exclusive, of what the busy rows of a frame can see; (0, 0) if none is busy."""
    rows = np.flatnonzero(busy)
    if not rows.size:
        return 0, 0
    return max(int(rows[0]) - reach, 0) // stride * stride, min(int(rows[-1]) + 1 + reach, len(busy))


def _band(y0: int, y1: int, height: int, reach: int, stride: int) -> Band:
    read0 = max(y0 - reach, 0) // stride * stride
    return Band(y0, y1, read0, min(y1 + reach, height))
