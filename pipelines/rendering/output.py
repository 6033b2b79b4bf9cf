"""A rendered example's files: NAME.deep.exr, NAME.ref.exr, at times NAME.ref2.exr, and NAME.json, each whole or none.

The JSON comes last, so its presence means that the example is complete.
"""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import numpy.typing as npt

from deep_io import DeepSamples, Window, write_deep
from deep_io.atomic import atomic_output
from deep_io.flat import HALF_MAX, write_flat
from pipelines.rendering.shots import Shot
from pipelines.scene_names import DEEP, OTHER_HALF, REFERENCE


def deep_samples(channels: dict[str, npt.NDArray[np.float32]], size: int) -> DeepSamples:
    """A square picture of `size` pixels, equally many samples in each; channels (N,) become half, Z stays float."""
    typed: dict[str, npt.NDArray[np.generic]] = {
        name: values if name == "Z" else np.clip(values, -HALF_MAX, HALF_MAX).astype(np.float16)
        for name, values in channels.items()}
    counts = np.full((size, size), len(channels["Z"]) // size**2, np.int32)
    return DeepSamples(counts, typed, Window(0, 0, size - 1, size - 1))


def example_files(stem: Path, halves: bool = False) -> tuple[Path, ...]:
    """The deep file, the reference, with `halves` its other half, and last the JSON of the example `stem` (a path
    without extension)."""
    ends = (DEEP, REFERENCE, *(OTHER_HALF,) * halves, ".json")
    return tuple(stem.with_name(stem.name + end) for end in ends)


def write_example(stem: Path, shot: Shot) -> None:
    """Write the files of an example. Raises OSError from the disk."""
    references = [half for half in (shot.reference, shot.other_half) if half is not None]
    deep, *targets, about = example_files(stem, len(references) > 1)
    with atomic_output(deep) as path:
        write_deep(path, deep_samples(shot.channels, shot.reference.shape[0]))
    for target, half in zip(targets, references, strict=True):
        with atomic_output(target) as path:
            write_flat(path, {name: np.ascontiguousarray(half[..., i]) for i, name in enumerate("RGBA")})
    with atomic_output(about) as path:
        path.write_text(json.dumps(shot.about, indent=1) + "\n")
