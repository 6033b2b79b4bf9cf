"""What the survey decides: one layer where no depth mixes, all of the network's where it does or is unknown."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from deep_io import DeepSamples, Window
from pipelines.denoise import Job
from pipelines.options import DenoiseOptions
from tests.end_to_end.scenes import random_weights, write_scene


def plane(mixed: bool, depth: bool = True) -> DeepSamples:
    """16 x 16 pixels of two samples on one surface; if `mixed`, every other pixel sees a second, nearer one."""
    counts = np.full((16, 16), 2, np.int32)
    total = int(counts.sum())
    near = np.arange(total) % 4 == 0
    channels: dict[str, np.ndarray] = {c: np.full(total, 0.5, np.float16) for c in "RGB"}
    channels["A"] = np.ones(total, np.float16)
    if depth:
        channels["Z"] = np.where(near & mixed, 2.0, 5.0).astype(np.float32)
    return DeepSamples(counts, channels, Window(0, 0, 15, 15))


@pytest.mark.parametrize(
    ("mixed", "depth", "choices", "expected"),
    [
        (False, True, {}, 1),
        (True, True, {}, 2),
        (False, False, {}, 2),
        (False, True, {"adapt": False}, 2),
        (False, True, {"layers": 3}, 3),
    ],
)
def test_layers_follow_the_scene(
    tmp_path: Path, mixed: bool, depth: bool, choices: dict[str, int], expected: int
) -> None:
    source = write_scene(tmp_path / "in.deep.exr", plane(mixed, depth))
    weights = random_weights(tmp_path / "w.safetensors")
    job = Job(DenoiseOptions(str(source), str(tmp_path / "out.exr"), model=str(weights), **choices))
    with job.open(source) as reader:
        assert job.plan(source, reader, lambda _: None).shot.layers == expected
