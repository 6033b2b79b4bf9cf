"""A rendered example's files: NAME.deep.exr, NAME.ref.exr and NAME.json, each whole or not there.

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
from pipelines.scene_names import DEEP, REFERENCE


def deep_samples(channels: dict[str, npt.NDArray[np.float32]], size: int) -> DeepSamples:
    """A square picture of `size` pixels, equally many samples in each; channels (N,) become half, Z stays float."""
    typed: dict[str, npt.NDArray[np.generic]] = {
        name: values if name == "Z" else np.clip(values, -HALF_MAX, HALF_MAX).astype(np.float16)
        for name, values in channels.items()}
    counts = np.full((size, size), len(channels["Z"]) // size**2, np.int32)
    return DeepSamples(counts, typed, Window(0, 0, size - 1, size - 1))


def example_files(stem: Path) -> tuple[Path, Path, Path]:
    """The deep file, the reference and the JSON of the example `stem` (a path without extension)."""
    deep, reference, about = (stem.with_name(stem.name + end) for end in (DEEP, REFERENCE, ".json"))
    return deep, reference, about


def write_example(stem: Path, shot: Shot) -> None:
    """Write the three files of an example. Raises OSError from the disk."""
    deep, reference, about = example_files(stem)
    size = shot.reference.shape[0]
    with atomic_output(deep) as path:
        write_deep(path, deep_samples(shot.channels, size))
    with atomic_output(reference) as path:
        write_flat(path, {name: np.ascontiguousarray(shot.reference[..., i]) for i, name in enumerate("RGBA")})
    with atomic_output(about) as path:
        path.write_text(json.dumps(shot.about, indent=1) + "\n")
