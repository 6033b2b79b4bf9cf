"""A card merged between the layers by OpenImageIO: what is nearer covers it, what is farther it covers."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import numpy as np
import OpenImageIO as oiio
import pytest

from deep_io import DeepSamples, read_deep
from tests.end_to_end.compositor import flatten
from tests.end_to_end.scenes import random_weights
from tests.runner import in_process

SCENE = Path(__file__).resolve().parents[2] / "examples" / "scenes" / "defocus-motion.deep.exr"
OIIOTOOL = Path(sys.executable).parent / "oiiotool"
GREEN = (0.125, 0.5, 0.125, 1.0)


@pytest.fixture(scope="module")
def layers(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two deep layers of a scene with strong defocus; the untrained partition is by depth."""
    folder = tmp_path_factory.mktemp("layers")
    model = random_weights(folder / "random.safetensors")
    run = in_process("export-layers", SCENE, folder / "layers.exr", "--model", model, "--pixel-type", "float")
    assert run.code == 0, run.err
    return folder / "layers.exr"


def card(samples: DeepSamples, depth: float) -> oiio.ImageBuf:
    """A flat card over the whole frame, made deep by OpenImageIO."""
    window = samples.window
    spec = oiio.ImageSpec(window.width, window.height, 5, oiio.FLOAT)
    spec.channelnames = (*"RGBA", "Z")
    image = oiio.ImageBuf(spec)
    assert oiio.ImageBufAlgo.fill(image, (*GREEN, depth))
    deep = oiio.ImageBufAlgo.deepen(image)
    assert not deep.has_error, deep.geterror()
    return deep


def in_front(samples: DeepSamples, depth: float) -> np.ndarray:
    """(H, W, 4) over of the samples nearer than a depth, one sample after the other."""
    result = np.zeros((samples.counts.size, 4))
    columns = np.stack([samples.channels[name] for name in "RGBA"], -1).astype(np.float64)
    for rank in range(int(samples.counts.max())):
        pixels = np.flatnonzero(samples.counts.ravel() > rank)
        where = samples.offsets[:-1][pixels] + rank
        near = samples.channels["Z"][where] < depth
        pixels, where = pixels[near], where[near]
        result[pixels] += (1 - result[pixels, 3:]) * columns[where]
    return result.reshape(*samples.counts.shape, 4)


@pytest.mark.parametrize("share", [0.1, 0.5, 0.9])
def test_the_front_layer_covers_the_card_and_the_card_the_back_layer(share: float, layers: Path) -> None:
    samples, _ = read_deep(layers)
    hits = np.sort(samples.channels["Z"][samples.channels["A"] > 0])
    depth = float(np.nextafter(hits[int(share * len(hits))], np.float32(np.inf)))
    merged = oiio.ImageBufAlgo.deep_merge(oiio.ImageBuf(str(layers)), card(samples, depth))
    assert not merged.has_error, merged.geterror()
    front = in_front(samples, depth)
    expected = front + (1 - front[..., 3:]) * np.array(GREEN)
    assert np.abs(flatten(merged) - expected).max() < 1e-5
    both = (samples.counts == 2) & (front[..., 3] > 0.1) & (front[..., 3] < 0.9)  # the card shows through the front
    assert both.any()


def test_a_holdout_removes_what_the_card_covers(layers: Path, tmp_path: Path) -> None:
    samples, _ = read_deep(layers)
    depth = float(np.nextafter(np.median(samples.channels["Z"]), np.float32(np.inf)))
    card(samples, depth).write(str(tmp_path / "card.exr"))
    subprocess.run([OIIOTOOL, layers, tmp_path / "card.exr", "--deepholdout", "-o", tmp_path / "held.exr"], check=True)
    assert np.abs(flatten(tmp_path / "held.exr") - in_front(samples, depth)).max() < 1e-3
