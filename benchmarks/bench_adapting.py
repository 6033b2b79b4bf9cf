#!/usr/bin/env python3
"""What modelling only what a scene needs saves, and what it costs: one row for each saving.

    python benchmarks/bench_adapting.py FOLDER... [--model fast] [--repeats 3] [--contexts FULL HALF]
                                        [--json docs/results/adapting.json] [--halves [GLOB]]

A FOLDER holds NAME.deep.exr with NAME.ref.exr. docs/tables.py makes the table of docs/adapting.md of the JSON. Each
saving is measured on the scenes where the survey chooses it and, forced, on those where it does not. Scenes that need
less are also made of the others: crops in which depth does not mix, and frames of several tiles whose upper half is a
sky of one colour, a sky whose colour changes smoothly, or holds no samples. `--halves` measures these frames alone and
leaves the other rows of the JSON as they are. What a context at half resolution saves no single network can tell: FULL
and HALF are the weights of two that differ in that alone, such as full-resolution.1 and base.1 of ablations.py. Time is
the CPU time of the network, the runs with and without a saving taking turns, medians; error is relMSE, its ratio
averaged geometrically.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import sys
import time
from collections.abc import Callable, Iterator
from fnmatch import fnmatch
from pathlib import Path
from statistics import median

import numpy as np
import torch

from deep_io.errors import LbmcError
from deep_io.header import Header
from deep_io.path_samples import PathSamples
from deep_io.samples import Window
from model import zoo
from model.denoiser import Denoiser
from model.features import FrameScale
from model.metrics import geometric_mean, score
from pipelines.cells import Cells
from pipelines.decisions import decide, zero_roles
from pipelines.denoise import Job
from pipelines.flat_pictures import read_rgb
from pipelines.inference import denoise_bands
from pipelines.options import DenoiseOptions
from pipelines.scene_names import DEEP, reference_of, scene_name
from pipelines.survey import Survey, survey
from pipelines.tiles import Band

CROP = 96  # pixels along the side of a crop
FEW_MIXED = 0.002  # of the pixels of a crop in which depth does not mix
TILED = 768  # pixels along the side of a frame made of tiles, at least
HALVES = PLAIN_SKY, SMOOTH_SKY, EMPTY = "plain sky above", "smooth sky above", "no samples above"
HALVED = 4  # scenes that such frames are made of
ZENITH, HORIZON, GLOW = np.array([0.15, 0.35, 0.9]), np.array([0.9, 0.95, 1.0]), 1.5
COMPANIONS = frozenset({"coc", "lens", "motion", "time"})


@dataclasses.dataclass(frozen=True)
class Scene:
    """A frame in memory, as the network's loop reads it; `reference` (H, W, 3), None where there is none."""

    name: str
    samples: PathSamples
    reference: np.ndarray | None
    seen: Survey

    @staticmethod
    def of(name: str, samples: PathSamples, reference: np.ndarray | None) -> Scene:
        height, width = samples.counts.shape
        samples = dataclasses.replace(samples, window=Window(0, 0, width - 1, height - 1))
        return Scene(name, samples, reference, survey([samples]))


class InMemory:
    """A scene in the place of an open file, as far as `denoise_bands` looks at one."""

    carried = carried_lights = 0

    def __init__(self, scene: Scene) -> None:
        self._samples = scene.samples
        self.header = Header((), scene.samples.window, scene.samples.window)

    def read(self, y0: int, y1: int) -> PathSamples:
        """Rows y0 to y1, exclusive."""
        return picked(self._samples, np.arange(y0, y1), np.arange(self._samples.counts.shape[1]))


@dataclasses.dataclass(frozen=True)
class Choice:
    """What one run is told: network (None: the one that is measured), layers (None: the network's), roles held or
    dropped, cells that pass, precision."""

    net: Denoiser | None = None
    layers: int | None = None
    held: frozenset[str] = frozenset()
    dropped: frozenset[str] = frozenset()
    cells: Cells | None = None
    dtype: torch.dtype | None = None


PLAIN = Choice()


@dataclasses.dataclass
class Row:
    """One line of the table: seconds without and with the saving, and ratios of errors where there is a reference."""

    label: str
    scenes: str
    before: list[float] = dataclasses.field(default_factory=list)
    after: list[float] = dataclasses.field(default_factory=list)
    errors: list[float] = dataclasses.field(default_factory=list)
    change: list[float] = dataclasses.field(default_factory=list)

    def line(self) -> str:
        saved = 1 - sum(self.after) / sum(self.before)
        error = "-"
        if self.errors:
            error = f"{100 * (geometric_mean(self.errors) - 1):+.1f} % (worst {100 * (max(self.errors) - 1):+.1f} %)"
        change = f"{max(self.change):.0e}" if self.change else "-"
        return (f"| {self.label} | {self.scenes} | {len(self.before)} | {sum(self.before):.2f} | {100 * saved:.0f} % | "
                f"{error} | {change} |")


class Bench:
    """Runs the network with and without each saving."""

    def __init__(self, model: str, repeats: int) -> None:
        self.job = Job(DenoiseOptions("", "", model=model, threads=1, progress="none"))
        self.repeats = repeats

    def load(self, path: Path) -> Scene:
        with self.job.open(path) as reader:
            return Scene.of(scene_name(path), reader.read(), read_rgb(reference_of(path)).rgb)

    def run(self, scene: Scene, choice: Choice) -> tuple[np.ndarray, float]:
        """The beauty (H, W, 3), and CPU seconds."""
        net, height = choice.net or self.job.net, scene.samples.counts.shape[0]
        net.set_product_dtype(choice.dtype)
        roles = tuple(r for r in net.config.roles if r in scene.samples.roles and r not in choice.held | choice.dropped)
        reader = InMemory(scene)
        begun = time.process_time()
        layers = denoise_bands(reader, net, FrameScale(scene.seen.exposure, scene.seen.depth), roles,
                               choice.layers or net.config.layers, [Band(0, height, 0, height)],
                               held=choice.held & scene.samples.roles.keys(), cells=choice.cells)
        return layers.beauty(), time.process_time() - begun

    def measure(self, row: Row, scene: Scene, choice: Choice, kept: np.ndarray | None = None,
                base: Choice = PLAIN) -> None:
        """Adds a scene to a row; `kept` (H, W): pixels whose largest relative change is looked at."""
        runs: list[tuple[float, float]] = []
        for _ in range(self.repeats):
            (plain, before), (saving, after) = self.run(scene, base), self.run(scene, choice)
            runs.append((before, after))
        row.before.append(median(before for before, _ in runs))
        row.after.append(median(after for _, after in runs))
        if scene.reference is not None:
            errors = [score(picture, scene.reference, with_flip=False).relmse for picture in (saving, plain)]
            row.errors.append(errors[0] / errors[1])
        if kept is not None:
            change = np.abs(saving - plain).max(-1) / (np.abs(plain).max(-1) + 1e-3 * plain.mean())
            row.change.append(float(change[kept].max()))


def picked(samples: PathSamples, rows: np.ndarray, columns: np.ndarray) -> PathSamples:
    """The pixels of some rows and columns, in that order, again and again if named so."""
    width = samples.counts.shape[1]
    pixels = (rows[:, None] * width + columns[None, :]).ravel()
    counts = samples.counts.reshape(-1)[pixels]
    before = samples.offsets[:-1][pixels] - (np.cumsum(counts) - counts)
    index = np.repeat(before, counts) + np.arange(int(counts.sum()))
    return dataclasses.replace(samples, counts=counts.reshape(len(rows), len(columns)), weight=samples.weight[index],
                               coverage=samples.coverage[index],
                               roles={role: values[index] for role, values in samples.roles.items()})


def crops(scene: Scene) -> Iterator[Scene]:
    """The first square of CROP pixels in which depth does not mix, if there is one."""
    height, width = scene.samples.counts.shape
    for top in range(0, height - CROP + 1, CROP // 3):
        for left in range(0, width - CROP + 1, CROP // 3):
            part = picked(scene.samples, np.arange(top, top + CROP), np.arange(left, left + CROP))
            assert scene.reference is not None
            crop = Scene.of(f"{scene.name} crop", part, scene.reference[top : top + CROP, left : left + CROP])
            plain = crop.seen.mixed is not None and crop.seen.mixed < FEW_MIXED
            if plain and crop.seen.hits > 0.5 * crop.seen.samples:
                yield crop
                return


def smooth_sky(samples: PathSamples) -> np.ndarray:
    """(N, 3) float32: radiance of a clear sky where each sample, anywhere in its pixel, sees it.

    It pales from the zenith, in the first row, to the horizon in the middle of the frame, and glows around a sun that
    is out of the picture: no two samples are alike, but those of a pixel nearly are.
    """
    height, width = samples.counts.shape
    pixel = np.repeat(np.arange(height * width), samples.counts.ravel())
    place = np.stack([pixel // width, pixel % width], 1) + np.random.default_rng(0).random((len(pixel), 2))
    down, across = 2 * place[:, 0] / height, place[:, 1] / width  # 0..1 from the zenith, from the left
    color = ZENITH + (HORIZON - ZENITH) * np.minimum(down, 1)[:, None] ** 2
    glow = GLOW * np.exp(-((across - 1) ** 2 + (down + 0.2) ** 2) / 0.5)
    return (color + glow[:, None]).astype(np.float32)


def tiled(scene: Scene) -> Scene:
    """Tiles of a scene, a frame of TILED pixels or more along a side."""
    rows, columns = (np.tile(np.arange(size), -(-TILED // size)) for size in scene.samples.counts.shape)
    return Scene.of(scene.name, picked(scene.samples, rows, columns), None)


def half(frame: Scene, name: str) -> Scene:
    """A frame with something of HALVES in the place of its upper half."""
    samples = frame.samples
    upper = np.zeros(samples.counts.shape, np.bool_)
    upper[: len(upper) // 2] = True
    inside = np.repeat(upper.ravel(), samples.counts.ravel())
    if name == EMPTY:
        less = dataclasses.replace(samples, counts=np.where(upper, 0, samples.counts).astype(np.int32),
                                   weight=samples.weight[~inside], coverage=samples.coverage[~inside],
                                   roles={role: values[~inside] for role, values in samples.roles.items()})
        return Scene.of(frame.name, less, None)
    radiance = np.float32(0.5) if name == PLAIN_SKY else smooth_sky(samples)
    roles = {role: np.where(inside[:, None], radiance if role == "radiance" else np.float32(0), values)
             for role, values in samples.roles.items()}
    sky = dataclasses.replace(samples, roles=roles, coverage=np.where(inside, np.float32(0), samples.coverage))
    return Scene.of(frame.name, sky, None)


class Rows(dict[tuple[str, str], Row]):
    """Rows by saving and scenes, made when they are asked for."""

    def __call__(self, label: str, where: str) -> Row:
        return self.setdefault((label, where), Row(label, where))


def savings(bench: Bench, scenes: list[Scene], contexts: tuple[Denoiser, ...], note: Callable[[str], None]
            ) -> list[Row]:
    """Every saving on every scene; `contexts` are of full and half resolution, or none."""
    row = Rows()
    for scene in scenes:
        note(scene.name)
        decided, zeros, cells = decide(scene.seen), zero_roles(scene.seen), scene.seen.cells
        for small in crops(scene):
            bench.measure(row("1 layer", "forced: crops where depth does not mix"), small, Choice(layers=1))
        bench.measure(row("1 layer", "chosen" if decided.one_layer else "forced"), scene, Choice(layers=1))
        for roles in (frozenset({"coc", "lens"}), frozenset({"motion", "time"})):
            there = roles <= scene.samples.roles.keys()
            where = "chosen" if roles <= decided.held else "forced"
            label = " and ".join(sorted(roles))
            if there:
                bench.measure(row(f"{label} held", where), scene, Choice(held=roles))
            if there and where == "chosen":
                bench.measure(row(f"{label} absent instead", where), scene, Choice(dropped=roles))
        if zeros - COMPANIONS:
            bench.measure(row("roles of zeros held", "chosen"), scene, Choice(held=zeros - COMPANIONS))
        passes = cells.passed.any() or cells.alike.any()
        where = "chosen" if passes else "nothing passes"
        bench.measure(row("cells pass", where), scene, Choice(cells=cells), ~cells.mask)
        bench.measure(row("bf16 products", "all"), scene, Choice(dtype=torch.bfloat16))
        if contexts:
            full, half = (Choice(net) for net in contexts)
            bench.measure(row("context at half resolution", "all, reduced networks"), scene, half, base=full)
    return list(row.values())


def halved(bench: Bench, scenes: list[Scene], note: Callable[[str], None], match: str) -> list[Row]:
    """What passes of frames made of these scenes whose upper half holds nothing to do, those whose name matches."""
    row = Rows()
    for scene in scenes:
        whole = tiled(scene)
        for name in (name for name in HALVES if fnmatch(name, match)):
            note(f"{scene.name}, {name}")
            less = half(whole, name)
            cells = less.seen.cells
            bench.measure(row("cells pass", name), less, Choice(cells=cells), ~cells.mask)
            runs = [(bench.run(whole, PLAIN)[1], bench.run(less, Choice(cells=cells))[1]) for _ in range(bench.repeats)]
            against = row("cells pass", f"{name}, against a full frame")
            against.before.append(median(before for before, _ in runs))
            against.after.append(median(after for _, after in runs))
    return list(row.values())


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folders", type=Path, nargs="+", metavar="FOLDER")
    parser.add_argument("--model", default="fast")
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--contexts", nargs=2, default=(), metavar=("FULL", "HALF"))
    parser.add_argument("--json", type=Path)
    parser.add_argument("--halves", nargs="?", const="*", metavar="GLOB",
                        help="only frames whose upper half holds nothing to do, those whose name matches")
    options = parser.parse_args()
    paths: list[Path] = []
    for folder in options.folders:
        found = [path for path in sorted(folder.glob(f"*{DEEP}")) if reference_of(path).exists()]
        if not found:
            sys.exit(f"ERROR: {folder}: no NAME.deep.exr with a NAME.ref.exr beside it")
        paths += found
    bench, few = Bench(options.model, options.repeats), paths[:: max(len(paths) // HALVED, 1)]
    scenes = {path: bench.load(path) for path in (few if options.halves else paths)}
    contexts = tuple(zoo.find(name).load().eval() for name in options.contexts)

    def note(text: str) -> None:
        print(text, file=sys.stderr)

    rows = [] if options.halves else savings(bench, list(scenes.values()), contexts, note)
    rows += halved(bench, [scenes[path] for path in few], note, options.halves or "*")
    print("| saving | scenes | number | CPU s without | saved | relMSE | largest change outside |\n" + "|---" * 7 + "|")
    print("\n".join(row.line() for row in rows))
    if options.json:
        write(options.json, list(scenes.values()), rows, keep=options.halves is not None)


def write(path: Path, scenes: list[Scene], rows: list[Row], keep: bool) -> None:
    """The JSON; with `keep`, what it holds already and was not measured again stays."""
    decisions = {scene.name: {"one_layer": decide(scene.seen).one_layer, "held": sorted(decide(scene.seen).held),
                              "cells_passed": int(scene.seen.cells.passed.sum()),
                              "cells": int(scene.seen.cells.passed.size)} for scene in scenes}
    lines = [dataclasses.asdict(row) for row in rows]
    if keep and path.exists():
        new, old = {(row.label, row.scenes) for row in rows}, json.loads(path.read_text("utf-8"))
        lines = [*(row for row in old["rows"] if (row["label"], row["scenes"]) not in new), *lines]
        decisions = {**old["decisions"], **decisions}
    document = {"decisions": decisions, "rows": lines}
    path.write_text(json.dumps(document, indent=1) + "\n")


if __name__ == "__main__":
    try:
        main()
    except LbmcError as error:
        sys.exit(f"ERROR: {error}")
