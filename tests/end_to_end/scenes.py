"""Small deep sample files for the end-to-end tests, and weights of a random network. Not a test itself."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import OpenEXR
import torch

from deep_io import DeepSamples, Header, Window, write_deep
from deep_io.attributes import attribute
from model import zoo
from model.config import FAST, UNetConfig
from model.denoiser import Denoiser

WINDOW = Window(-5, 3, 58, 42)
"""64 x 40 pixels, away from the origin."""

Arrays = dict[str, np.ndarray]


def noisy_scene(seed: int = 0, window: Window = WINDOW, most: int = 4, dtype: Any = np.float16) -> DeepSamples:
    """Two surfaces and a sky under noise: 1 to `most` samples a pixel, 15 of the roles' channels."""
    rng = np.random.default_rng(seed)
    counts = rng.integers(1, most + 1, (window.height, window.width)).astype(np.int32)
    rows, columns = (np.repeat(index.ravel(), counts.ravel()) for index in np.indices(counts.shape))
    total = rows.size
    sky = rows < 8
    front = ~sky & (columns + rng.normal(0.0, 2.0, total) < 30)
    albedo = np.where(front[:, None], [0.8, 0.3, 0.1], [0.2, 0.4, 0.7]) * np.where(columns % 6 < 3, 1.0, 0.6)[:, None]
    radiance = np.where(sky[:, None], [0.5, 0.7, 1.0], albedo * rng.lognormal(-0.5, 1.0, (total, 1)))
    normal = np.where(front[:, None], [0.6, 0.0, 0.8], [0.0, 1.0, 0.0])
    hit = ~sky
    channels: Arrays = {
        **{name: radiance[:, i] for i, name in enumerate("RGB")},
        "A": hit,
        "Z": np.where(hit, np.where(front, 2.0, 5.0) + rng.uniform(0.0, 0.1, total), 1e10),
        **{f"N.{axis}": np.where(hit, normal[:, i], 0.0) for i, axis in enumerate("XYZ")},
        **{f"albedo.{axis}": np.where(hit, albedo[:, i], 0.0) for i, axis in enumerate("RGB")},
        "roughness": np.where(hit, 1.0, 0.0),
        "coc": np.where(hit, np.where(front, -3.0, 2.0), 0.0),
        "lens.X": rng.uniform(-0.7, 0.7, total),
        "lens.Y": rng.uniform(-0.7, 0.7, total),
    }
    typed = {name: np.asarray(v).astype(np.float32 if name == "Z" else dtype) for name, v in channels.items()}
    return DeepSamples(counts, typed, window)


def write_scene(path: Path, samples: DeepSamples | None = None, **attributes: str) -> Path:
    """A deep sample file; a double underscore in an attribute's name stands for a colon."""
    samples = samples or noisy_scene()
    added = {name.replace("__", ":"): attribute(value, "string") for name, value in attributes.items()}
    write_deep(path, samples, Header.of_samples(samples).with_attributes(added))
    return path


def changed(samples: DeepSamples, **channels: np.ndarray) -> DeepSamples:
    """The same samples with some channels replaced; a double underscore stands for a dot."""
    replaced = {name.replace("__", "."): values for name, values in channels.items()}
    return DeepSamples(samples.counts, {**samples.channels, **replaced}, samples.window)


def without_samples(window: Window = WINDOW) -> DeepSamples:
    """The channels of `noisy_scene` with not one sample."""
    channels = {name: values[:0] for name, values in noisy_scene(0, window).channels.items()}
    return DeepSamples(np.zeros((window.height, window.width), np.int32), channels, window)


def random_weights(path: Path, seed: int = 0, **config_changes: Any) -> Path:
    """Weights of a small untrained network: what it must get right, it must get right without training."""
    torch.manual_seed(seed)
    unet = UNetConfig(encoder=((16,), (16,)), bottleneck=(16,), decoder=((16,), (16,)), scale=2)
    config = dataclasses.replace(FAST, name="random", unet=unet, kernel_sizes=(3, 3, 3), **config_changes)
    zoo.save(Denoiser(config), path, {"description": "random"})
    return path


def read_flat(path: Path) -> tuple[Arrays, Mapping[str, Any]]:
    """Channels (H, W) and header of a flat EXR, through OpenEXR."""
    part = OpenEXR.File(str(path), separate_channels=True).parts[0]
    return {name: channel.pixels for name, channel in part.channels.items()}, part.header


def rgb(path: Path) -> np.ndarray:
    """(H, W, 3) of a flat EXR."""
    channels, _ = read_flat(path)
    return np.stack([channels[name] for name in "RGB"], axis=-1)
