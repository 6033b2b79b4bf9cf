#!/usr/bin/env python3
"""Draws docs/images/compositing.png: an example scene's layers taken apart, graded, and with a card merged between.

    python docs/compositing_images.py [MODEL]

Runs the installed `lbmc`, with its default weights or those of MODEL; OpenImageIO does the compositing. Needs the extra
`test`.
"""

from __future__ import annotations

import subprocess
import sys
import tempfile
from pathlib import Path

import matplotlib

matplotlib.use("agg")

import matplotlib.pyplot as plt
import numpy as np
import OpenImageIO as oiio
from numpy.typing import NDArray

from model.metrics import common_scale, tone_mapped

HOME = Path(__file__).resolve().parents[1]
SCENE = HOME / "examples" / "scenes" / "defocus-motion.deep.exr"
GRADE = {"layer0": (1.6, 1.05, 0.6, 1.0), "layer1": (0.5, 0.75, 1.25, 1.0)}  # warm in front, cold behind
CARD = ((0.02, 0.25, 0.02), (0.3, 0.5, 0.02))  # the two colours of its stripes, relative to the picture's brightness
STRIPE = 7  # pixels
CARD_SHARE = 0.5  # of the hits' depths are nearer than the card

Picture = NDArray[np.float32]


def pixels(path: Path, layer: str = "") -> Picture:
    """(H, W, 4) of the plain channels or of a layer's."""
    image = oiio.ImageBuf(str(path))
    names = [f"{layer}.{name}" if layer else name for name in "RGBA"]
    return image.get_pixels(oiio.FLOAT)[..., [image.spec().channelnames.index(name) for name in names]]


def buffer(picture: Picture, names: str = "RGBA") -> oiio.ImageBuf:
    """A picture as OpenImageIO holds it."""
    spec = oiio.ImageSpec(picture.shape[1], picture.shape[0], len(names), oiio.FLOAT)
    spec.channelnames = tuple(names)
    image = oiio.ImageBuf(spec)
    image.set_pixels(image.roi, np.ascontiguousarray(picture, np.float32))
    return image


def flat(image: oiio.ImageBuf) -> Picture:
    """(H, W, 3) of a deep or flat picture."""
    done = oiio.ImageBufAlgo.flatten(image)
    return done.get_pixels(oiio.FLOAT)[..., [done.spec().channelnames.index(name) for name in "RGB"]]


def card(shape: tuple[int, ...], depth: float, brightness: float) -> oiio.ImageBuf:
    """A striped card at one depth, as a deep picture."""
    stripes = (np.indices(shape[:2]).sum(0) // STRIPE) % 2
    color = np.array(CARD)[stripes] * brightness
    alpha, z = np.ones((*shape[:2], 1)), np.full((*shape[:2], 1), depth)
    return oiio.ImageBufAlgo.deepen(buffer(np.concatenate([color, alpha, z], -1), "RGBAZ"))


def main() -> None:
    """Exports, composites, draws."""
    model = ["--model", sys.argv[1]] if len(sys.argv) > 1 else []
    with tempfile.TemporaryDirectory() as folder:
        deep, channels = Path(folder, "deep.exr"), Path(folder, "channels.exr")
        for path, form in ((deep, "deep"), (channels, "channels")):
            words = ["lbmc", "export-layers", str(SCENE), str(path), "--form", form, "--pixel-type", "float", *model]
            subprocess.run(words, check=True)
        beauty, front, back = pixels(channels), pixels(channels, "layer0"), pixels(channels, "layer1")
        graded = oiio.ImageBufAlgo.over(*(buffer(layer * np.array(GRADE[name], np.float32)) for layer, name in
                                          ((front, "layer0"), (back, "layer1"))))
        names = oiio.ImageBuf(str(channels)).spec().channelnames
        z = oiio.ImageBuf(str(channels)).get_pixels(oiio.FLOAT)[..., names.index("layer0.Z")]
        depth = float(np.nextafter(np.quantile(z[front[..., 3] > 0.1], CARD_SHARE), np.float32(np.inf)))
        scale = common_scale(beauty[..., :3])
        merged = flat(oiio.ImageBufAlgo.deep_merge(oiio.ImageBuf(str(deep)), card(beauty.shape, depth, 1 / scale)))
    panels = {"denoised": beauty[..., :3], "front layer": front[..., :3], "back layer": back[..., :3],
              "front layer's alpha": None, "layers graded, then over": graded.get_pixels(oiio.FLOAT)[..., :3],
              "a card merged between (deep)": merged}
    figure, axes = plt.subplots(2, 3, figsize=(9, 6.4), dpi=100)
    for axis, (title, picture) in zip(axes.flat, panels.items(), strict=True):
        if picture is None:
            axis.imshow(front[..., 3], cmap="gray", vmin=0, vmax=1, interpolation="nearest")
        else:
            axis.imshow(tone_mapped(picture * scale), interpolation="nearest")
        axis.set_title(title, fontsize=10)
        axis.axis("off")
    figure.tight_layout()
    figure.savefig(HOME / "docs" / "images" / "compositing.png", metadata={"Software": None})


if __name__ == "__main__":
    main()
