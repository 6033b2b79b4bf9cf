#!/usr/bin/env python3
"""Draws noisy | denoised | reference of one or more scenes, with their errors and two enlarged crops each, as a PNG.

    python examples/panel.py OUT.png DEEP DENOISED REFERENCE [DEEP DENOISED REFERENCE ...]

DEEP is the deep sample file, whose pixels' weighted means are the noisy picture. The first crop is where the noise is
worst, the second where the denoised picture is worst. Pixels are shown as they are, enlarged without smoothing.
Needs matplotlib.
"""

from __future__ import annotations

import argparse
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from deep_io.atomic import atomic_output
from deep_io.errors import LbmcError
from deep_io.path_samples import SampleReader
from model.baseline import pixel_means
from model.metrics import Scores, common_scale, score, tone_mapped
from pipelines.flat_pictures import read_rgb
from pipelines.pictures import signed_error, worst_regions

Picture = NDArray[np.floating[Any]]

COLUMN = 384  # dots: a picture's width, and that of its two crops together
GAP, CAPTION, HEAD = 6, 30, 34  # dots
CROP_SHARE = 6  # a crop is this part of the picture's shorter side
FRAME = 2  # dots
COLORS = np.array([[1.0, 0.72, 0.0], [0.0, 0.75, 1.0]])  # of the two crops and their places
DOTS_PER_INCH = 100


@dataclass(frozen=True)
class Scene:
    """One scene's three pictures (H, W, 3), its name and the samples per pixel of the noisy one."""

    name: str
    samples: float
    noisy: Picture
    denoised: Picture
    reference: Picture


def load(deep: str, denoised: str, reference: str) -> Scene:
    """Raises InputError for files that cannot be read, ValueError for sizes that differ."""
    with SampleReader(deep) as reader:
        samples = reader.read()
    noisy = pixel_means(samples.counts, samples.weight, samples.roles["radiance"])
    name = Path(deep).name.removesuffix(".exr").removesuffix(".deep")
    pictures = noisy, read_rgb(denoised).rgb, read_rgb(reference).rgb
    if len({picture.shape for picture in pictures}) > 1:
        raise ValueError(f"{name}: sizes differ: {', '.join(str(picture.shape[:2]) for picture in pictures)}")
    return Scene(name, samples.total / samples.counts.size, *pictures)


def enlarged(picture: Picture, width: int) -> Picture:
    """Every pixel repeated, so that the picture is `width` dots wide."""
    height = round(width * picture.shape[0] / picture.shape[1])
    rows = np.arange(height) * picture.shape[0] // height
    columns = np.arange(width) * picture.shape[1] // width
    found: Picture = picture[rows][:, columns]
    return found


def outlined(picture: Picture, color: Picture) -> Picture:
    """The picture with a frame in one color."""
    result = np.tile(color, (*picture.shape[:2], 1))
    result[FRAME:-FRAME, FRAME:-FRAME] = picture[FRAME:-FRAME, FRAME:-FRAME]
    return result


def column(picture: Picture, corners: list[tuple[int, int]], size: int) -> Picture:
    """A tone-mapped picture with the places of its crops marked, and the crops below it."""
    whole = enlarged(picture, COLUMN)
    dots = COLUMN / picture.shape[1]
    side = (COLUMN - GAP) // 2
    below = np.ones((GAP + side, COLUMN, 3))
    for number, (row, left) in enumerate(corners):
        place = tuple(slice(round(corner * dots), round((corner + size) * dots)) for corner in (row, left))
        whole[place] = outlined(whole[place], COLORS[number])
        crop = enlarged(picture[row : row + size, left : left + size], side)
        x = number * (side + GAP)
        below[GAP:, x : x + side] = outlined(crop, COLORS[number])
    return np.concatenate([whole, below])


def strip(scene: Scene) -> tuple[Picture, list[str]]:
    """A scene's three columns side by side, and a caption for each."""
    scale = common_scale(scene.reference)
    size = max(min(scene.reference.shape[:2]) // CROP_SHARE, 2)
    corners = worst_regions(signed_error(scene.noisy, scene.reference), size, 1)
    corners += [found for found in worst_regions(signed_error(scene.denoised, scene.reference), size, 2)
                if not corners or max(abs(a - b) for a, b in zip(found, corners[0], strict=True)) >= size][:1]
    scores = [score(picture, scene.reference, with_flip=False) for picture in (scene.noisy, scene.denoised)]
    columns = [column(tone_mapped(scale * picture), corners, size)
               for picture in (scene.noisy, scene.denoised, scene.reference)]
    captions = [caption(f"noisy, {scene.samples:.3g} samples", scores[0]), caption("denoised", scores[1]), "reference"]
    print(f"{scene.name}: relMSE noisy {scores[0].relmse:.4f}, denoised {scores[1].relmse:.4f} "
          f"({scores[0].relmse / scores[1].relmse:.1f} times less)")
    between = np.ones((columns[0].shape[0], GAP, 3))
    return np.concatenate([columns[0], between, columns[1], between, columns[2]], axis=1), captions


def caption(what: str, scores: Scores) -> str:
    return f"{what}   relMSE {scores.relmse:.4f}   PSNR {scores.psnr:.1f} dB"


def draw(scenes: list[Scene]) -> Any:
    """A matplotlib figure: the scenes' strips under each other, dot by dot."""
    try:
        from matplotlib.figure import Figure
    except ImportError as missing:
        sys.exit(f"ERROR: drawing needs matplotlib: pip install matplotlib ({missing})")
    strips = [strip(scene) for scene in scenes]
    width = strips[0][0].shape[1]
    height = sum(HEAD + picture.shape[0] + CAPTION for picture, _ in strips)
    figure = Figure(figsize=(width / DOTS_PER_INCH, height / DOTS_PER_INCH), dpi=DOTS_PER_INCH)
    y = height  # figures count upwards
    for scene, (picture, captions) in zip(scenes, strips, strict=True):
        y -= HEAD
        figure.text(0, (y + 9) / height, scene.name, fontsize=11, weight="bold")
        y -= picture.shape[0]
        figure.figimage(picture, 0, y)
        y -= CAPTION
        for number, text in enumerate(captions):
            figure.text(number * (COLUMN + GAP) / width, (y + 13) / height, text, fontsize=8.5)
    return figure


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("target", metavar="OUT.png", type=Path)
    parser.add_argument("files", metavar="DEEP DENOISED REFERENCE", nargs="+")
    options = parser.parse_args()
    if len(options.files) % 3:
        parser.error("give three files for each scene: DEEP DENOISED REFERENCE")
    threes = zip(*(options.files[first::3] for first in range(3)), strict=True)
    figure = draw([load(*three) for three in threes])
    with atomic_output(options.target) as temporary:
        figure.savefig(temporary)
    print(f"wrote {options.target}")


if __name__ == "__main__":
    try:
        main()
    except (LbmcError, ValueError) as error:
        sys.exit(f"ERROR: {error}")
