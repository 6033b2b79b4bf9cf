"""Mirror images of a frame: every sample moves with its pixel, and what points on the screen turns with it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

from deep_io import Window
from deep_io.deep_reader import DeepReader
from model.compositing import Layers
from pipelines.averages import MeanLayers
from pipelines.frame_reader import FrameReader
from pipelines.mirrors import ALL_FOUR, Mirror
from pipelines.tiles import Band
from tests.end_to_end.scenes import changed, noisy_scene, write_scene

WINDOW = Window(-3, 5, 10, 15)
"""14 x 11 pixels."""


@pytest.fixture(params=["ragged", "equal", "over"])
def source(request: pytest.FixtureRequest, tmp_path: Path) -> Path:
    """With samples that point, each somewhere else; under `over` also with virtual misses."""
    samples = noisy_scene(1, WINDOW, most=1 if request.param == "equal" else 4)
    rng = np.random.default_rng(1)
    names = ("N.X", "N.Y", "N.Z", "lens.X", "lens.Y", "motion.X", "motion.Y")
    pointing = {name: rng.normal(size=samples.total).astype(np.float32) for name in names}
    samples = changed(samples, **pointing, R=np.arange(1, samples.total + 1, dtype=np.float32))
    if request.param == "over":
        samples = changed(samples, A=(0.5 * samples.channels["A"]).astype(np.float16))
    return write_scene(tmp_path / "in.exr", samples, lbmc__weighting="over" if request.param == "over" else "uniform")


@pytest.mark.parametrize("kept", [False, True])
def test_rows_of_every_image_hold_the_samples_of_the_files_rows(kept: bool, source: Path) -> None:
    with FrameReader(source) as reader:
        reader.carry(data=["R"])
        whole = reader.read()
        pixels = [slice(*ends) for ends in zip(whole.offsets[:-1], whole.offsets[1:], strict=True)]
        if kept:
            reader.keep()
            for _ in reader.blocks():
                pass
        for mirror in (*ALL_FOUR, *ALL_FOUR[::-1]):
            block = reader.read_mirrored(WINDOW.ymin + 2, WINDOW.ymin + 9, mirror)
            first = (WINDOW.height - 9 if mirror.top_bottom else 2) * WINDOW.width
            starts = block.offsets
            signs = np.array([-1 if mirror.left_right else 1, -1 if mirror.top_bottom else 1], np.float32)
            before = reader.samples_per_row[: first // WINDOW.width].sum()
            for row, column in np.ndindex(block.counts.shape):
                y = WINDOW.height - 3 - row if mirror.top_bottom else row + 2
                x = WINDOW.width - 1 - column if mirror.left_right else column
                there = pixels[y * WINDOW.width + x]
                here = slice(*starts[row * WINDOW.width + column :][:2])
                for name in ("weight", "coverage", "extra"):
                    np.testing.assert_array_equal(getattr(block, name)[here], getattr(whole, name)[there])
                for role, values in whole.roles.items():
                    expected = values[there].copy()
                    if role in ("normal", "motion", "lens"):
                        expected[:, :2] *= signs
                    np.testing.assert_array_equal(block.roles[role][here], expected)
                stored = np.arange(whole.total)[there] if whole.source is None else whole.source[there]
                sources = (np.arange(block.total) if block.source is None else block.source)[here]
                np.testing.assert_array_equal(sources, np.where(stored < 0, stored, stored - before))


def test_a_kept_frame_is_not_decoded_again_for_its_images(source: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with FrameReader(source) as reader:
        reader.keep()
        for _ in reader.blocks():
            pass
        monkeypatch.setattr(DeepReader, "read", None)
        for mirror in ALL_FOUR:
            reader.read_mirrored(WINDOW.ymin, WINDOW.ymax + 1, mirror)
        assert reader.read().counts.shape == (WINDOW.height, WINDOW.width)


def test_from_one_image_to_another_and_back() -> None:
    picture = np.arange(6).reshape(2, 3)
    for one in ALL_FOUR:
        for other in ALL_FOUR:
            np.testing.assert_array_equal(one.to(other).picture(one.picture(picture)), other.picture(picture))


def layers(color: float, weight: float, coverage: float, depth: float) -> Layers:
    """One pixel, one layer."""
    color_plane = torch.full((1, 1, 3, 1, 1), color)
    weight_plane, coverage_plane, depth_plane = (torch.full((1, 1, 1, 1), v) for v in (weight, coverage, depth))
    return Layers(color_plane, weight_plane, coverage_plane, depth_plane, torch.empty(1, 1, 0, 1, 1))


def test_depth_counts_by_coverage_and_a_run_without_samples_in_reach_not_at_all() -> None:
    mean = MeanLayers((1, 1), 1, 0)
    runs = (layers(2.0, 1.0, 0.75, 4.0), layers(4.0, 1.0, 0.25, 8.0), layers(0.0, 0.0, 0.0, torch.inf),
            layers(6.0, 1.0, 0.0, torch.inf))
    for run, mirror in zip(runs, ALL_FOUR, strict=True):
        mean.add(run, Band(0, 1, 0, 1), mirror)
    found = mean.result()
    assert float(found.color[0, 0, 0]) == pytest.approx(4.0)
    assert float(found.weight) == pytest.approx(1.0)
    assert float(found.coverage) == pytest.approx(1 / 3)
    assert float(found.depth) == pytest.approx(5.0)


def test_one_run_is_what_it_was_to_the_last_bit() -> None:
    rng = np.random.default_rng(0)
    for color, coverage, depth in rng.lognormal(size=(50, 3)).astype(np.float32):
        mean = MeanLayers((1, 1), 1, 0)
        one = layers(float(color), 1.0, min(float(coverage), 1.0), float(depth))
        mean.add(one, Band(0, 1, 0, 1), Mirror())
        found = mean.result()
        for name in ("color", "weight", "coverage", "depth"):
            assert torch.equal(getattr(found, name), getattr(one, name))
