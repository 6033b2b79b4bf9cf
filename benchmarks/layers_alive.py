#!/usr/bin/env python3
"""Whether the layers of a network are alive: where depth mixes within a pixel, do both carry weight, in order of depth?

    python benchmarks/layers_alive.py NAME=FOLDER [NAME=FOLDER ...] [--model fast] [--json FILE]

Depth mixes within a pixel where its samples' depths, sorted, have a gap of more than a tenth, a miss being infinitely
far. Over those pixels of each scene, with two layers: the front layer's mean visible weight; the share of pixels in
which that weight is between 10 and 90 %; the share in which the front layer is nearer than the back, by the mean depth
of their hits, and by the mean of 1 / depth, in which misses take part as 0. All are stated after the filter, and before
it (each pixel's own samples, partitioned). A scene is blurred where 5 % of its samples move, or have a circle of
confusion, of half a pixel or more, by the description beside it; else by its name.
"""

from __future__ import annotations

import argparse
import json
import re
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from deep_io.errors import InputError, LbmcError
from deep_io.path_samples import PathSamples, SampleReader
from model import zoo
from model.denoiser import Denoiser
from model.features import FrameScale
from pipelines.bench.scenes import find_scenes
from pipelines.inference import to_model
from pipelines.network import find_weights
from pipelines.survey import survey

HOME = Path(__file__).resolve().parents[1]
ROWS = HOME / "docs" / "results" / "layers_alive.json"
GAP = 1.1
"""Neighbours in depth within a pixel that differ by more than this factor are two surfaces."""
LOW, HIGH = 0.1, 0.9
VISIBLE = 0.5  # pixels of motion or circle of confusion
BLUR = re.compile("defocus|motion")
"""In the name of a scene that has no description beside it."""
Row = dict[str, Any]
Plane = NDArray[np.floating[Any]]


def mixed_pixels(samples: PathSamples) -> NDArray[np.bool_]:
    """(H, W): whether depth mixes within the pixel. Raises InputError without depth."""
    if "depth" not in samples.roles:
        raise InputError("a scene without depth has no order of layers")
    pixel = np.repeat(np.arange(samples.counts.size), samples.counts.ravel())
    depth = np.where(samples.coverage > 0, samples.roles["depth"][:, 0].astype("f8"), np.inf)
    order = np.lexsort((depth, pixel))
    near, far = depth[order[:-1]], depth[order[1:]]
    gaps = (pixel[order[:-1]] == pixel[order[1:]]) & (far > GAP * near)
    return (np.bincount(pixel[order[:-1]][gaps], minlength=samples.counts.size) > 0).reshape(samples.counts.shape)


def means(mixed: NDArray[np.bool_], weight: Plane, coverage: Plane, depth: Plane, inverse: Plane) -> Row:
    """Over the pixels where depth mixes. Of two layers (2, H, W): weight, coverage, depth of hits, mean 1 / depth."""
    front = weight[0][mixed]
    by_hits = np.where(coverage > 0, depth, np.inf)
    return {"front": round(float(front.mean()), 4),
            "both": round(float(((front >= LOW) & (front <= HIGH)).mean()), 4),
            "nearer": round(float((by_hits[0] < by_hits[1])[mixed].mean()), 4),
            "nearer_with_misses": round(float((inverse[0] > inverse[1])[mixed].mean()), 4)}


@torch.inference_mode()
def measure(net: Denoiser, source: Path) -> Row:
    """One scene; a scene in which depth mixes nowhere has a share and no more."""
    with SampleReader(source) as reader:
        block = reader.read()
    seen = survey([block])
    mixed = mixed_pixels(block)
    row: Row = {"mixed": round(float(mixed.mean()), 4)}
    if not mixed.any():
        return row
    scale = FrameScale(seen.exposure, seen.depth)
    samples = to_model(block, net.config.roles, seen.depth, torch.device("cpu"))
    layers = net(samples, scale, 2)
    planes = (layers.weight, layers.coverage, layers.depth)
    weight, coverage, depth = (plane[0].numpy().astype("f8") for plane in planes)
    with np.errstate(divide="ignore", invalid="ignore"):
        inverse = np.where((weight > 0) & (coverage > 0), coverage / weight / depth, 0.0)
        row["filtered"] = means(mixed, weight, coverage, depth, inverse)
        # the same of the samples themselves, before any kernel
        share = net.partition(samples, scale, 2).numpy().T * block.weight  # (2, N)
        hits = share * (block.coverage > 0)
        z = np.where(block.coverage > 0, block.roles["depth"][:, 0], 1.0)
        pixel = np.repeat(np.arange(block.counts.size), block.counts.ravel())

        def totals(values: Plane) -> Plane:
            return np.stack([np.bincount(pixel, one, block.counts.size).reshape(block.counts.shape) for one in values])

        weight, coverage = totals(share), totals(hits)
        row["samples"] = means(mixed, weight, coverage, totals(hits * z) / coverage, totals(hits / z) / weight)
    return row


def blurred(source: Path) -> bool:
    """Whether a scene has defocus or motion, by the description beside it, else by its name."""
    description = source.with_name(source.name.replace(".deep.exr", ".json"))
    if not description.exists():
        return bool(BLUR.search(source.name))
    found = json.loads(description.read_text("utf-8"))
    return any(found.get(key, 0.0) >= VISIBLE for key in ("coc_95", "motion_95"))


def measured(net: Denoiser, sets: dict[str, Path]) -> Iterator[tuple[str, str, Row]]:
    """Set, scene and row of every scene, one of each: not those that are another one with more samples."""
    for name, folder in sets.items():
        for scene in find_scenes(folder):
            if ".32spp" not in scene.name:
                yield name, scene.name, {"blurred": blurred(scene.source), **measure(net, scene.source)}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("sets", nargs="+", metavar="NAME=FOLDER")
    parser.add_argument("--model", default=None, help="preset or .safetensors file")
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--json", type=Path, default=ROWS)
    options = parser.parse_args()
    torch.set_num_threads(options.threads)
    weights: zoo.Weights = find_weights(options.model)
    document: Row = {"model": weights.name, "weights": weights.digest, "sets": {}}
    sets = {name: Path(folder) for name, _, folder in (word.partition("=") for word in options.sets)}
    for name, scene, row in measured(weights.load(), sets):
        document["sets"].setdefault(name, {})[scene] = row
        print(f"{name} {scene}: depth mixes in {row['mixed']:.1%}" + "".join(
            f"; {key}: front {row[key]['front']:.2f}, both {row[key]['both']:.1%}, nearer {row[key]['nearer']:.1%}, "
            f"with misses {row[key]['nearer_with_misses']:.1%}"
            for key in ("samples", "filtered") if key in row), flush=True)
    options.json.parent.mkdir(parents=True, exist_ok=True)
    options.json.write_text(json.dumps(document, indent=1) + "\n", "utf-8")


if __name__ == "__main__":
    try:
        main()
    except LbmcError as error:
        sys.exit(f"ERROR: {error}")
