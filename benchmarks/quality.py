#!/usr/bin/env python3
"""Quality on a folder of NAME.deep.exr + NAME.ref.exr: the noisy mean, an untrained baseline, Intel OIDN, and lbmc.

    python benchmarks/quality.py FOLDER [--model fast] [--tune] [--json OUT.json] [--panels DIR]

Prints one Markdown row per scene and method (relMSE / SMAPE / PSNR / energy), and for each number of samples per pixel
the geometric mean of relMSE and the means of the others. Errors are those of model/metrics.py; where NAME.ref2.exr is
there as well, the reference is the mean of both, and the JSON has the error free of its noise.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import math
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np

from deep_io.errors import LbmcError
from deep_io.path_samples import PathSamples, SampleReader
from model.baseline import clamp_and_blur, pixel_means
from model.metrics import Scores, geometric_mean
from pipelines.bench.results import spread
from pipelines.bench.scenes import find_scenes
from pipelines.flat_pictures import read_rgb
from pipelines.oidn import Oidn
from pipelines.options import DenoiseOptions
from pipelines.pictures import panel
from pipelines.scene_names import scene_name

Picture = np.ndarray
"""(H, W, 3) linear RGB."""


@dataclasses.dataclass
class Scene:
    """One deep sample file in memory."""

    path: Path
    samples: PathSamples

    @property
    def name(self) -> str:
        return scene_name(self.path)

    @property
    def per_pixel(self) -> int:
        """Samples per pixel, rounded."""
        return round(self.samples.total / self.samples.counts.size)

    def mean(self, role: str) -> Picture:
        return pixel_means(self.samples.counts, self.samples.weight, self.samples.roles[role])


Method = Callable[[Scene], Picture]


def oidn_methods(oidn: Oidn) -> dict[str, Method]:
    """OIDN at high quality; the guides are plain means, 0 on misses, albedo without the specular colour."""

    def guides(scene: Scene) -> tuple[Picture, Picture]:
        return scene.mean("albedo"), scene.mean("normal")

    return {
        "OIDN color": lambda scene: oidn.denoise(scene.mean("radiance")),
        "OIDN aux": lambda scene: oidn.denoise(scene.mean("radiance"), *guides(scene)),
        "OIDN prefiltered": lambda scene: oidn.denoise(scene.mean("radiance"), *guides(scene), prefilter=True),
    }


def lbmc_method(model: str, threads: int | None, adapt: bool, layers: int | None, light: bool = True) -> Method:
    """`lbmc denoise` with one preset or weight file, through the same door as the command."""

    def denoise(scene: Scene) -> Picture:
        from pipelines.denoise import denoise_frames

        with tempfile.TemporaryDirectory() as folder:
            target = Path(folder) / "beauty.exr"
            options = DenoiseOptions(
                str(scene.path),
                str(target),
                model=model,
                threads=threads,
                adapt=adapt,
                layers=layers,
                light=light,
                pixel_type="float",
                progress="none",
            )
            for frame in denoise_frames(options).failed:
                raise SystemExit(f"ERROR: {frame.error}")
            return read_rgb(target).rgb

    return denoise


def tuned_method(model: str, threads: int | None, adapt: bool, layers: int | None, light: bool) -> Method:
    """`lbmc tune` to the scene, then `lbmc denoise` with what it wrote; the scene's reference has no part in it."""

    def denoise(scene: Scene) -> Picture:
        from pipelines.tuning.job import tune
        from pipelines.tuning.options import TuneOptions

        with tempfile.TemporaryDirectory() as folder:
            weights = str(Path(folder) / "scene.safetensors")
            reading = DenoiseOptions(str(scene.path), weights, model=model, threads=threads, adapt=adapt, layers=layers,
                                     progress="none")
            tune(TuneOptions(reading, progress="none"))
            return lbmc_method(weights, threads, adapt, layers, light)(scene)

    return denoise


def cells(scores: Scores) -> str:
    return f"{scores.relmse:.4f} / {scores.smape:.4f} / {scores.psnr:.2f} / {scores.energy:.3f}"


def mean_cells(rows: list[Scores]) -> str:
    smape, psnr, energy = (np.mean([getattr(row, name) for row in rows]) for name in ("smape", "psnr", "energy"))
    errors = [row.relmse for row in rows]
    found = spread(errors)
    ends = "" if found is None else f" [{found[0]:.4f}, {found[1]:.4f}]"
    return f"**{geometric_mean(errors):.4f}**{ends} / {smape:.4f} / {psnr:.2f} / {energy:.3f}"


def table(results: dict[int, dict[str, dict[str, Scores]]], methods: list[str]) -> str:
    """Markdown: rows are scenes grouped by samples per pixel, columns methods."""
    lines = ["| scene | " + " | ".join(methods) + " |", "|---" * (len(methods) + 1) + "|"]
    for per_pixel, scenes in sorted(results.items()):
        for scene, row in scenes.items():
            lines.append(f"| {scene} | " + " | ".join(cells(row[name]) for name in methods) + " |")
        means = [mean_cells([row[name] for row in scenes.values()]) for name in methods]
        lines.append(f"| **{len(scenes)} with {per_pixel} samples** | " + " | ".join(means) + " |")
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--model", action="append", default=[], help="preset or .safetensors file; repeatable")
    parser.add_argument("--match", default="*", help="only scenes whose NAME matches this glob")
    parser.add_argument("--no-oidn", action="store_true")
    parser.add_argument("--no-adapt", action="store_true")
    parser.add_argument("--layers", type=int)
    parser.add_argument("--light", choices=("held", "free"), default="held")
    parser.add_argument("--tune", action="store_true", help="also each model tuned to each scene by its own samples")
    parser.add_argument("--flip", action="store_true", help="also FLIP (in the JSON)")
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--json", type=Path)
    parser.add_argument("--panels", type=Path, help="folder for one PNG per scene")
    options = parser.parse_args()

    from pipelines.allocator import keep_freed_memory

    keep_freed_memory()  # as the command does
    with Oidn(options.threads) as oidn:
        methods: dict[str, Method] = {
            "noisy": lambda scene: scene.mean("radiance"),
            "baseline": lambda scene: clamp_and_blur(
                scene.samples.counts, scene.samples.weight, scene.samples.roles["radiance"]
            ),
            **({} if options.no_oidn else oidn_methods(oidn)),
        }
        for model in options.model:
            choices = (options.threads, not options.no_adapt, options.layers, options.light == "held")
            methods[f"lbmc {Path(model).stem}"] = lbmc_method(model, *choices)
            if options.tune:
                methods[f"lbmc {Path(model).stem} tuned"] = tuned_method(model, *choices)
        results: dict[int, dict[str, dict[str, Scores]]] = {}
        seconds = dict.fromkeys(methods, 0.0)
        for truth in find_scenes(options.folder, options.match):
            with SampleReader(truth.source, threads=options.threads) as reader:
                scene = Scene(truth.source, reader.read())
            pictures: dict[str, Picture] = {}
            for name, method in methods.items():
                started = time.process_time()
                pictures[name] = method(scene)
                seconds[name] += time.process_time() - started
            row = {name: truth.score(picture, with_flip=options.flip) for name, picture in pictures.items()}
            results.setdefault(scene.per_pixel, {})[scene.name] = row
            print(f"{scene.name}: " + "; ".join(f"{name} {row[name].relmse:.4f}" for name in row), file=sys.stderr)
            if options.panels:
                write_panel(options.panels, scene.name, pictures, row, truth.reference.rgb)
    print(table(results, list(methods)))
    print("\nCPU s in all: " + ", ".join(f"{name} {spent:.1f}" for name, spent in seconds.items()))
    if options.json:
        options.json.write_text(json.dumps(as_json(results), indent=1) + "\n")


def write_panel(
    folder: Path, name: str, pictures: dict[str, Picture], row: dict[str, Scores], reference: Picture
) -> None:
    """Noisy, OIDN at its best, lbmc, the reference, and the signed error of the last of the denoised."""
    wanted = [key for key in ("noisy", "OIDN prefiltered") if key in pictures]
    wanted += [key for key in pictures if key.startswith("lbmc")]
    titles = {f"{key}\nrelMSE {row[key].relmse:.4f}": pictures[key] for key in wanted}
    folder.mkdir(parents=True, exist_ok=True)
    (folder / f"{name}.png").write_bytes(panel(titles, reference, name))


def as_json(results: dict[int, dict[str, dict[str, Scores]]]) -> dict[str, dict[str, dict[str, object]]]:
    """scene -> method -> scores; what is not a finite number becomes null."""

    def plain(value: float | None) -> float | None:
        return value if value is not None and math.isfinite(value) else None

    return {
        scene: {
            method: {key: plain(value) for key, value in dataclasses.asdict(scores).items()}
            for method, scores in row.items()
        }
        for scenes in results.values()
        for scene, row in scenes.items()
    }


if __name__ == "__main__":
    try:
        main()
    except LbmcError as error:
        sys.exit(f"ERROR: {error}")
