"""Channels carried along with the roles: parts of the radiance are decoded as it is, the rest stays as stored."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from deep_io import DeepSamples, Header, Window, write_deep
from deep_io.path_samples import SampleReader

WINDOW = Window(2, 3, 9, 8)


def scene(seed: int = 0) -> DeepSamples:
    """Unsorted samples of every alpha, with a copy of the radiance (`copy`), a scalar (`fog`) and their number."""
    rng = np.random.default_rng(seed)
    counts = rng.integers(0, 6, (WINDOW.height, WINDOW.width)).astype(np.int32)
    total = int(counts.sum())
    color = rng.lognormal(size=(3, total)).astype(np.float32)
    alpha = rng.choice([0.0, 0.5, 1.0], total).astype(np.float32)
    return DeepSamples(counts, {
        **dict(zip("RGB", color, strict=True)), "A": alpha, "Z": rng.uniform(1, 9, total).astype(np.float32),
        **{f"copy.{name}": plane.copy() for name, plane in zip("RGB", color, strict=True)},
        "fog": rng.random(total).astype(np.float32), "number": np.arange(total, dtype=np.float32) + 1}, WINDOW)


@pytest.fixture
def path(tmp_path: Path) -> Path:
    write_deep(tmp_path / "in.exr", scene())
    return tmp_path / "in.exr"


@pytest.mark.parametrize("weighting", ["uniform", "packed", "over"])
def test_a_copy_of_the_radiance_is_decoded_to_the_radiance(weighting: str, path: Path) -> None:
    with SampleReader(path, weighting=weighting) as reader:
        plain = reader.read()
        reader.carry([f"copy.{name}" for name in "RGB"], ["fog", "number"])
        assert (reader.carried, reader.carried_lights) == (5, 3)
        block = reader.read()
    assert np.array_equal(block.roles["radiance"], plain.roles["radiance"])
    assert np.array_equal(block.extra[:, :3], block.roles["radiance"])
    assert plain.extra.shape[1] == 0


@pytest.mark.parametrize("weighting", ["uniform", "packed", "over"])
def test_the_source_says_which_stored_sample_each_one_is(weighting: str, path: Path) -> None:
    with SampleReader(path, weighting=weighting) as reader:
        reader.carry(data=["fog", "number"])
        block = reader.read()
        rows = reader.read(5, 7)
    stored = scene().channels
    source = np.arange(block.total) if block.source is None else block.source
    real = source >= 0
    assert np.array_equal(block.extra[real, 1], source[real] + 1)
    assert np.array_equal(block.extra[real, 0], stored["fog"][source[real]])
    assert not block.extra[~real].any()
    assert (weighting == "over") or real.all()
    first = int(block.offsets[2 * WINDOW.width])
    assert np.array_equal(rows.extra, block.extra[first : first + rows.total])


def test_what_is_not_finite_is_mended_and_counted(tmp_path: Path) -> None:
    samples = scene()
    samples.channels["fog"][:3] = [np.nan, np.inf, -np.inf]
    samples.channels["copy.R"][1] = np.nan
    path = tmp_path / "broken.exr"
    write_deep(path, samples, Header.of_samples(samples))
    with SampleReader(path, weighting="uniform") as reader:
        reader.carry([f"copy.{name}" for name in "RGB"], ["fog"])
        block = reader.read()
    assert np.isfinite(block.extra).all()
    assert block.extra[1, 0] == 0
    assert (block.repairs["fog"], block.repairs["copy.R"], block.repairs["radiance"]) == (3, 1, 0)


def test_a_channel_that_is_not_there_cannot_be_carried(path: Path) -> None:
    with SampleReader(path, weighting="uniform") as reader, pytest.raises(KeyError):
        reader.carry(["nothing"])
