"""Names of layer files, options that exclude each other, and what encoding in blocks of rows gives."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from deep_io import Window
from deep_io.decoding import PathSamples
from deep_io.flat import HALF_MAX
from pipelines import export
from pipelines.export import contribution_rows, encode_rows, layer_path
from pipelines.export_options import ExportOptions
from pipelines.export_samples import stored_shares
from pipelines.inference import FrameLayers


@pytest.mark.parametrize(
    ("target", "expected"),
    [
        ("shot.1001.exr", "shot.layer2.1001.exr"),
        ("shot.v2.-0005.exr", "shot.v2.layer2.-0005.exr"),
        ("still.exr", "still.layer2.exr"),
        ("shot.final.exr", "shot.final.layer2.exr"),
        ("1001.exr", "1001.layer2.exr"),
    ],
)
def test_the_layer_stands_before_the_frame_and_never_first(target: str, expected: str) -> None:
    assert layer_path(Path("folder") / target, 2) == Path("folder") / expected


@pytest.mark.parametrize(
    "changes",
    [
        {"target": "out.tif"},
        {"form": "shallow"},
        {"contributions": True},
        {"compression": "zip"},
        {"ids": ("id",)},
        {"ids": ("id",), "form": "files"},
        {"samples": True, "form": "parts"},
        {"samples": True, "aovs": ("key",)},
    ],
)
def test_options_that_do_not_fit_are_refused(changes: dict[str, Any]) -> None:
    with pytest.raises(ValueError, match=r"\w"):
        ExportOptions(**{"source": "in.exr", "target": "out.exr", **changes})


def random_layers(seed: int, height: int = 7, width: int = 5) -> FrameLayers:
    rng = np.random.default_rng(seed)
    weight = rng.random((3, height, width)).astype(np.float32) ** 4
    weight /= weight.sum(0)
    coverage = weight * rng.integers(0, 2, weight.shape).astype(np.float32)
    color = weight[:, None] * rng.lognormal(size=(3, 3, height, width)).astype(np.float32)
    depth = np.where(coverage > 0, rng.uniform(1, 9, weight.shape), np.inf).astype(np.float32)
    return FrameLayers(color, weight, coverage, depth, rng.random((3, 2, height, width)).astype(np.float32))


def test_a_block_of_rows_is_encoded_as_in_the_whole_frame() -> None:
    layers = random_layers(1)
    whole = encode_rows(layers, slice(0, 7), np.float16, by_depth=True)
    part = encode_rows(layers, slice(2, 5), np.float16, by_depth=True)
    assert part.color.shape == (3, 5, 15)  # R, G, B and two AOVs
    assert np.array_equal(whole.color[..., 10:25], part.color)
    assert np.array_equal(whole.depth[:, 10:25], part.depth)


def test_contributions_are_the_layers_as_they_are() -> None:
    layers = random_layers(2)
    layers.color[0, 0, 3, 2] = 1e6
    half = contribution_rows(layers, slice(0, 7), "half")
    assert half.clamped == 1
    assert half.color.max() == HALF_MAX
    exact = contribution_rows(layers, slice(0, 7), "float")
    assert np.array_equal(exact.color[:, :3].reshape(layers.color.shape), layers.color)
    assert np.array_equal(exact.alpha.reshape(layers.coverage.shape), layers.coverage)
    assert np.isfinite(exact.depth).all()


def test_blocks_of_rows_cover_the_frame_once(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(export, "BLOCK_PIXELS", 12)
    for width in (1, 5, 12, 100):
        rows = [row for block in export._row_blocks(7, width) for row in range(7)[block]]
        assert rows == list(range(7))


def test_samples_that_the_network_never_saw_are_the_last_layers() -> None:
    block = PathSamples(np.array([[2]], np.int32), np.ones(2, np.float32), np.ones(2, np.float32), {},
                        Window(0, 0, 0, 0), source=np.array([3, -1]))
    shares = stored_shares(block, np.array([[0.75, 0.25], [0.5, 0.5]], np.float32), 4)
    assert shares.tolist() == [[0, 1], [0, 1], [0, 1], [0.75, 0.25]]
