#!/usr/bin/env python3
"""Draws the pictures of layers in docs/results.md, after the paper's Figures 4 and 5, into docs/images.

    python docs/layer_images.py [--model fast] [--work WORK]

layers.png: an example scene through a preset: samples by layer, filtered layers, their composite, the reference.
visibility.png: a scene with no noise but visibility, through two networks that benchmarks/paper.py trained in WORK
(left out without it), one of which composites its layers by alpha and one averages them, and through the preset; its
errors go to docs/results/visibility.json, of which docs/tables.py makes a table. Needs the extra `bench`.
"""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path

import matplotlib

matplotlib.use("agg")

import matplotlib.pyplot as plt
import numpy as np
import torch
from matplotlib.axes import Axes
from numpy.typing import NDArray

sys.path.insert(0, str(Path(__file__).resolve().parent))

from visibility_scene import Traced, trace

from deep_io.path_samples import SampleReader
from model.denoiser import Denoiser
from model.features import FrameScale
from model.metrics import common_scale, relmse, tone_mapped
from model.samples import Samples
from pipelines.flat_pictures import read_rgb
from pipelines.inference import to_model
from pipelines.network import find_weights
from pipelines.survey import exposure_of, survey

HOME = Path(__file__).resolve().parents[1]
IMAGES = HOME / "docs" / "images"
SCENE = HOME / "examples" / "scenes" / "defocus-motion"
NUMBERS = HOME / "docs" / "results" / "visibility.json"
SIZE, SAMPLES = (160, 200), 8
REFERENCE_PASSES, PASS_SAMPLES = 32, 32
SEED = 4
MIXED = 0.02  # a pixel of whose samples at least this part sees another surface than the rest has noisy visibility
SURFACES = ("leaves", "disc", "wall")
REDUCED = {"LAYER, reduced": "LAYER.1.safetensors", "LAYER_w, reduced": "LAYER_w.1.safetensors"}
Picture = NDArray[np.floating]


def show(axes: Axes, picture: Picture, title: str, scale: float | None = None) -> None:
    """A linear picture (H, W, 3) at the metrics' scale, or without `scale` a plane (H, W) of 0..1."""
    if scale is None:
        axes.imshow(picture, cmap="gray", vmin=0, vmax=1, interpolation="nearest")
    else:
        axes.imshow(tone_mapped(np.asarray(picture, "f8") * scale), interpolation="nearest")
    axes.set_title(title, fontsize=9)
    axes.axis("off")


def planes(layers: torch.Tensor) -> list[Picture]:
    """(1, L, 3, H, W) -> L pictures (H, W, 3)."""
    return list(layers[0].permute(0, 2, 3, 1).numpy())


@torch.inference_mode()
def sample_layers(net: Denoiser, samples: Samples, scale: FrameScale) -> tuple[list[Picture], Picture]:
    """What the samples of each pixel contribute to each layer, before any filter; the front layer's weight (H, W)."""
    share = net.partition(samples, scale, 2) * samples.weight[:, None]  # (N, 2)
    _, height, width = samples.shape
    pixel = torch.repeat_interleave(torch.arange(height * width), samples.counts.long())

    def total(values: torch.Tensor) -> Picture:
        summed: Picture = torch.zeros(height * width, values.shape[1]).index_add(0, pixel, values).numpy()
        return summed.reshape(height, width, -1)

    return [total(share[:, k : k + 1] * samples.roles["radiance"]) for k in range(2)], total(share[:, :1])[..., 0]


@torch.inference_mode()
def draw_layers(model: str | None) -> None:
    """layers.png."""
    net = find_weights(model).load()
    with SampleReader(Path(f"{SCENE}.deep.exr")) as reader:
        block = reader.read()
    seen = survey([block])
    scale = FrameScale(seen.exposure, seen.depth)
    samples = to_model(block, net.config.roles, seen.depth, torch.device("cpu"))
    unfiltered, weight = sample_layers(net, samples, scale)
    layers = net(samples, scale, 2)
    filtered, beauty = planes(layers.color), layers.beauty()[0].permute(1, 2, 0).numpy()
    reference = read_rgb(Path(f"{SCENE}.ref.exr")).rgb
    k = common_scale(reference)
    figure = plt.figure(figsize=(12.4, 5.2), dpi=110)
    grid = figure.add_gridspec(2, 6)
    rows = (("samples", unfiltered, weight), ("filtered", filtered, layers.weight[0, 0].numpy()))
    for row, (word, (front, back), alpha) in enumerate(rows):
        show(figure.add_subplot(grid[row, 0]), front, f"front layer, {word}", k)
        show(figure.add_subplot(grid[row, 1]), back, f"back layer, {word}", k)
        show(figure.add_subplot(grid[row, 2]), alpha, f"front layer's weight, {word}")
        show(figure.add_subplot(grid[row, 3]), front + back,
             f"noisy, relMSE {error(front + back, reference):.3f}" if row == 0 else
             f"composite, relMSE {error(beauty, reference):.3f}", k)
    show(figure.add_subplot(grid[:, 4:]), reference, "reference", k)
    figure.tight_layout()
    figure.savefig(IMAGES / "layers.png", metadata={"Software": None})


def error(picture: Picture, reference: Picture) -> float:
    """relMSE at the common scale."""
    k = common_scale(reference)
    return relmse(k * np.asarray(picture, "f8"), k * np.asarray(reference, "f8"))


def to_samples(traced: Traced) -> Samples:
    """The model's input."""
    pixels, total = traced.height * traced.width, traced.height * traced.width * traced.per_pixel
    return Samples((1, traced.height, traced.width), torch.full((pixels,), traced.per_pixel, dtype=torch.int32),
                   torch.full((total,), 1 / traced.per_pixel), torch.ones(total),
                   {role: torch.from_numpy(values).float() for role, values in traced.roles.items()})


def converged() -> tuple[Picture, Picture]:
    """The scene of `visibility.png` without noise (H, W, 3), and what its pixels see, as `Traced.shares`."""
    found = np.zeros((2, *SIZE, 3))
    for k in range(REFERENCE_PASSES):
        traced = trace(*SIZE, PASS_SAMPLES, SEED + 1 + k)
        found += traced.mean(), traced.shares()
    picture, seen = found / REFERENCE_PASSES
    return picture, seen


@torch.inference_mode()
def draw_visibility(work: Path, model: str | None) -> None:
    """visibility.png, and its numbers."""
    traced = trace(*SIZE, SAMPLES, SEED)
    reference, seen = converged()
    samples, noisy = to_samples(traced), traced.mean()
    scale = FrameScale(exposure_of(noisy.astype("f4")), float(np.median(traced.roles["depth"])))
    k = common_scale(reference)
    regions = {"mixed": seen.max(-1) <= 1 - MIXED, "wall": seen[..., 2] == 1}

    def errors(picture: Picture) -> dict[str, float]:
        found = {name: relmse(k * np.asarray(picture, "f8")[where], k * reference[where])
                 for name, where in regions.items()}
        return {"all": error(picture, reference), **found}

    def in_front(net: Denoiser) -> dict[str, float]:
        """How much of each surface's samples the network puts into the front layer."""
        share = net.partition(samples, scale, 2)[:, 0].numpy()
        return {name: float(share[surface].mean()) for name, surface in zip(SURFACES, traced.surfaces().T, strict=True)}

    shipped = find_weights(model)
    networks = {word: find_weights(str(work / name)) for word, name in REDUCED.items()} | {shipped.name: shipped}
    rows: dict[str, dict[str, dict[str, float]]] = {f"noisy, {SAMPLES} samples": {"relmse": errors(noisy)}}
    figure, axes = plt.subplots(len(networks), 5, figsize=(13.6, 7.2), dpi=100)
    show(axes[0, 0], noisy, f"noisy, {SAMPLES} samples, relMSE {error(noisy, reference):.4f}", k)
    show(axes[1, 0], reference, "reference", k)
    show(axes[2, 0], seen[..., 0] + seen[..., 1], "seen of leaves and disc, reference")
    for row, (word, weights) in enumerate(networks.items()):
        net = weights.load()
        layers = net(samples, scale, 2)
        front, back = planes(layers.color)
        show(axes[row, 1], front, f"{word}: front layer", k)
        show(axes[row, 2], back, f"{word}: back layer", k)
        show(axes[row, 3], layers.weight[0, 0].numpy(), f"{word}: front layer's weight")
        show(axes[row, 4], front + back, f"{word}: sum, relMSE {error(front + back, reference):.4f}", k)
        rows[word] = {"relmse": errors(front + back), "in_front": in_front(net)}
    figure.tight_layout()
    figure.savefig(IMAGES / "visibility.png", metadata={"Software": None})
    parts = {name: float(where.mean()) for name, where in regions.items()}
    NUMBERS.write_text(json.dumps({"parts": parts, "rows": rows}, indent=1) + "\n", "utf-8")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--model", default=None, help="preset or .safetensors file")
    parser.add_argument("--work", type=Path, help="where benchmarks/paper.py left its weights")
    options = parser.parse_args()
    torch.set_num_threads(1)
    draw_layers(options.model)
    if options.work:
        draw_visibility(options.work, options.model)


if __name__ == "__main__":
    main()
