"""Contact sheets: what a folder of rendered examples looks like, for a person to judge at a glance.

One strip per example: mean of its first eight samples, reference, albedo, and blur (red |coc|, green |motion|).
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from deep_io import read_deep
from deep_io.atomic import atomic_output
from deep_io.errors import UsageError
from deep_io.flat import read_flat
from model.metrics import common_scale
from pipelines.rendering.output import example_files

SHOWN = 48  # strips on a sheet
COLUMNS = 4
SAMPLES = 8
BLUR_RANGE = 16.0  # pixels of coc or motion that show as full red or green
EXPOSURE = 0.6
GAMMA = 2.2
CHANNELS = ("R", "G", "B", "albedo.R", "albedo.G", "albedo.B", "coc", "motion.X", "motion.Y")

Picture = npt.NDArray[np.uint8]


def strip(stem: Path) -> Picture:
    """One example's pictures side by side, (H, 4 W, 3). Raises InputError for files that cannot be read."""
    deep, reference_path, *_ = example_files(stem)
    samples, _ = read_deep(deep, channels=CHANNELS)
    height, width = samples.counts.shape
    flat = read_flat(reference_path).channels
    reference = np.stack([np.asarray(flat[c], np.float32) for c in "RGB"], -1)

    def image(names: tuple[str, ...], first: int | None = None) -> npt.NDArray[np.float32]:
        table = np.stack([np.asarray(samples.channels[n], np.float32) for n in names], -1)
        return np.asarray(table.reshape(height, width, -1, len(names))[:, :, :first].mean(2))

    scale = EXPOSURE * common_scale(reference) if reference.any() else 1.0
    blur = np.concatenate([np.abs(image(("coc",))), np.linalg.norm(image(("motion.X", "motion.Y")), axis=2,
                                                                  keepdims=True), np.zeros((height, width, 1))], 2)
    pictures = [image(("R", "G", "B"), SAMPLES) * scale, reference * scale,
                image(("albedo.R", "albedo.G", "albedo.B")), blur / BLUR_RANGE]
    return (np.clip(np.concatenate(pictures, 1), 0, 1) ** (1 / GAMMA) * 255).astype(np.uint8)


def load_pillow() -> Any:
    """The PIL.Image module. Raises UsageError with the package to install."""
    try:
        from PIL import Image
    except ImportError as missing:
        raise UsageError(
            f"a contact sheet needs Pillow ({missing}): install lbmc with its extra 'render', or pass "
            f"--no-contact-sheet"
        ) from missing
    return Image


def write_contact_sheet(target: Path, stems: list[Path]) -> None:
    """A PNG of up to SHOWN of the examples `stems`, spread evenly over them. Raises UsageError without Pillow."""
    chosen = [stems[i] for i in np.unique(np.linspace(0, len(stems) - 1, min(SHOWN, len(stems))).astype(int))]
    strips = [strip(stem) for stem in chosen]
    height, width = (max(s.shape[axis] for s in strips) for axis in (0, 1))
    columns = min(COLUMNS, len(strips))
    sheet = np.zeros((-(-len(strips) // columns) * height, columns * width, 3), np.uint8)
    for number, picture in enumerate(strips):
        y, x = number // columns * height, number % columns * width
        sheet[y:y + picture.shape[0], x:x + picture.shape[1]] = picture
    with atomic_output(target) as path:
        load_pillow().fromarray(sheet).save(path, format="PNG")
