"""Folders of tiny scenes with references for the tests of `lbmc bench`. Not a test itself."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from deep_io import DeepSamples, Header, Window
from deep_io.flat import write_flat
from model.baseline import blur, pixel_means
from pipelines.flat_pictures import read_rgb
from tests.end_to_end.scenes import changed, noisy_scene, write_scene

WINDOW = Window(0, 0, 31, 23)


def write_reference(path: Path, rgb: np.ndarray, window: Window = WINDOW) -> Path:
    """(H, W, 3) as a flat float EXR."""
    header = Header.of_samples(DeepSamples(np.zeros((window.height, window.width), np.int32), {}, window))
    write_flat(path, {name: np.ascontiguousarray(rgb[..., i], np.float32) for i, name in enumerate("RGB")}, header)
    return path


def write_pair(folder: Path, name: str, seed: int, samples: int = 4, window: Window = WINDOW) -> DeepSamples:
    """NAME.deep.exr with so many samples in every pixel, and a smooth picture of them as NAME.ref.exr."""
    deep = full(noisy_scene(seed, window, 2), samples, seed)
    write_scene(folder / f"{name}.deep.exr", deep)
    radiance = np.stack([deep.channels[channel].astype(np.float32) for channel in "RGB"], axis=-1)
    weight = np.full(deep.total, 1.0 / samples)
    write_reference(folder / f"{name}.ref.exr", blur(pixel_means(deep.counts, weight, radiance)), window)
    return deep


def full(scene: DeepSamples, samples: int, seed: int) -> DeepSamples:
    """Every pixel's samples drawn again, so many of them, with fresh noise."""
    rng = np.random.default_rng(seed)
    counts = np.repeat(scene.counts.ravel(), samples)
    pick = np.repeat(scene.offsets[:-1], samples) + rng.integers(0, counts)
    drawn = DeepSamples(np.full_like(scene.counts, samples),
                        {name: values[pick] for name, values in scene.channels.items()}, scene.window)
    noise = rng.lognormal(-0.2, 0.6, drawn.total)
    return changed(drawn, **{name: (drawn.channels[name] * noise).astype(np.float16) for name in "RGB"})


def write_halves(folder: Path, name: str, seed: int) -> None:
    """A scene whose reference is two halves: the smooth picture of `write_pair` with noise of its own each."""
    write_pair(folder, name, seed)
    truth = read_rgb(folder / f"{name}.ref.exr").rgb
    rng = np.random.default_rng(seed)
    for kind in ("ref", "ref2"):
        write_reference(folder / f"{name}.{kind}.exr", truth * rng.gamma(16.0, 1.0 / 16.0, truth.shape))
