"""What writing the layers of a 1080p frame costs beside writing its beauty, and how large the files are.

    python benchmarks/bench_layers.py [--model MODEL] [SCENE.deep.exr ...]

Denoises the scenes (default: those of examples/) to two layers, tiles them to 1920x1080 and writes the tiling in every
form. CPU seconds of one thread, the encoding included; sizes beside the half beauty with a float depth, ZIP.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np

from deep_io import Header, Window
from deep_io.flat import write_flat
from deep_io.header import channels_of
from deep_io.sequences import Frame
from pipelines.aovs import mean_depth
from pipelines.denoise import Job
from pipelines.export import ExportJob
from pipelines.export_options import FORMS, ExportOptions
from pipelines.inference import FrameLayers, denoise_bands
from pipelines.options import DenoiseOptions
from pipelines.plan import FramePlan

WIDTH, HEIGHT = 1920, 1080
CPU_TARGET, SIZE_TARGET = 1.5, 2.2
EXAMPLES = Path(__file__).resolve().parents[1] / "examples" / "scenes"


def tiled(scenes: list[FrameLayers]) -> FrameLayers:
    """1920x1080 of the scenes, each cut to the smallest one's size.

    Every tile is flipped and scaled at random: exact repetitions would compress as no picture does.
    """
    height = min(scene.weight.shape[1] for scene in scenes)
    width = min(scene.weight.shape[2] for scene in scenes)
    layers = len(scenes[0].weight)
    empty = {"color": 3, "weight": 0, "coverage": 0, "depth": 0}
    planes = {name: np.empty((layers, *([size] if size else []), HEIGHT, WIDTH), np.float32)
              for name, size in empty.items()}
    rng = np.random.default_rng(0)
    for top in range(0, HEIGHT, height):
        for left in range(0, WIDTH, width):
            scene = scenes[rng.integers(len(scenes))]
            flips = rng.choice([-1, 1], 2)
            factors = {"color": rng.uniform(0.5, 2), "depth": rng.uniform(0.5, 2)}
            for name, plane in planes.items():
                tile = getattr(scene, name)[..., :height, :width][..., :: flips[0], :: flips[1]] * factors.get(name, 1)
                room = plane[..., top : top + height, left : left + width]
                room[...] = tile[..., : room.shape[-2], : room.shape[-1]]
    return FrameLayers(**planes, extra=np.empty((layers, 0, HEIGHT, WIDTH), np.float32))


def denoised(job: Job, source: Path) -> tuple[FrameLayers, FramePlan]:
    """A scene's layers and plan, without writing anything."""
    with job.open(source) as reader:
        job.shot = None  # every scene is a shot of its own
        plan = job.plan(source, reader, lambda _: None)
        return denoise_bands(reader, job.net, plan.shot.scale, plan.roles, plan.shot.layers, plan.bands), plan


def main() -> None:
    """Measures and prints."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scenes", nargs="*", type=Path, default=sorted(EXAMPLES.glob("*.deep.exr")))
    parser.add_argument("--model")
    choices = parser.parse_args()
    window = Window(0, 0, WIDTH - 1, HEIGHT - 1)
    header = Header(channels_of(dict.fromkeys("RGB", np.float16)), window, window)
    with tempfile.TemporaryDirectory() as folder:
        target = Path(folder, "out.exr")
        job = ExportJob(ExportOptions(str(choices.scenes[0]), str(target), model=choices.model, layers=2, threads=1))
        scenes = [denoised(job, source) for source in choices.scenes]
        layers, plan = tiled([scene for scene, _ in scenes]), scenes[0][1]
        frame = Frame(None, choices.scenes[0], target)

        def cpu(write: Callable[[], object]) -> float:
            begun = time.process_time()
            write()
            return time.process_time() - begun

        flat = Job(DenoiseOptions(str(choices.scenes[0]), str(target), model=choices.model, threads=1))
        beauty = cpu(lambda: flat.write(frame, [target], plan, layers, header))
        channels, _, _ = flat.beauty(frame, plan, layers)
        write_flat(target, {**channels, "Z": mean_depth(layers)}, header, "zip")
        size = target.stat().st_size
        print(f"beauty: {beauty:.2f} CPU s; with depth {size / 1e6:.1f} MB")
        for form in FORMS:
            job.options = replace(job.options, form=form)
            targets = job.targets(frame)
            seconds = cpu(lambda targets=targets: job.write(frame, targets, plan, layers, header))
            total = sum(path.stat().st_size for path in targets)
            print(f"{form}: {seconds:.2f} CPU s, {seconds - beauty:+.2f}; {total / 1e6:.1f} MB, "
                  f"{total / size:.2f} times")
        print(f"wanted of deep: at most {CPU_TARGET:+.2f} CPU s and {SIZE_TARGET} times")


if __name__ == "__main__":
    main()
