"""A frame that is kept reads as the file does, and the file is not asked again."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from deep_io.deep_reader import DeepReader
from deep_io.path_samples import PathSamples, SampleReader
from pipelines.frame_reader import FrameReader
from tests.end_to_end.scenes import changed, noisy_scene, write_scene


def assert_equal(left: PathSamples, right: PathSamples) -> None:
    assert left.window == right.window
    assert left.roles.keys() == right.roles.keys()
    for name in ("counts", "weight", "coverage", "extra"):
        np.testing.assert_array_equal(getattr(left, name), getattr(right, name))
    sources = [np.arange(block.total) if block.source is None else block.source for block in (left, right)]
    np.testing.assert_array_equal(*sources)
    for role, values in left.roles.items():
        np.testing.assert_array_equal(values, right.roles[role])


@pytest.mark.parametrize("broken", [False, True])
@pytest.mark.parametrize("weighting", ["uniform", "over"])
def test_kept_rows_are_those_of_the_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, weighting: str, broken: bool
) -> None:
    samples = noisy_scene(5)
    if broken:
        red = samples.channels["R"].copy()
        red[[70, 900]] = np.nan
        samples = changed(samples, R=red)
    path = write_scene(tmp_path / "in.exr", samples, lbmc__weighting=weighting)
    spans = [(None, None), (3, 4), (10, 30), (42, 43)]
    with SampleReader(path) as plain:
        plain.carry(data=["roughness"])
        expected = [plain.read(*span) for span in spans]
    with FrameReader(path) as reader:
        reader.carry(data=["roughness"])
        reader.keep()
        for _ in reader.blocks(max_bytes=20000):
            pass
        monkeypatch.setattr(DeepReader, "read", None)  # nothing is left to read
        for span, block in zip(spans, expected, strict=True):
            assert_equal(reader.read(*span), block)
        with pytest.raises(ValueError, match="rows"):
            reader.read(2, 4)


def test_forgotten_roles_are_gone_and_others_stay(tmp_path: Path) -> None:
    with FrameReader(write_scene(tmp_path / "in.exr")) as reader:
        reader.keep()
        for _ in reader.blocks():
            pass
        reader.forget(["lens", "time"])
        assert reader.read().roles.keys() == {"radiance", "depth", "normal", "albedo", "roughness", "coc"}


def test_without_keep_the_file_is_read_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with FrameReader(write_scene(tmp_path / "in.exr")) as reader:
        for _ in reader.blocks():
            pass
        monkeypatch.setattr(DeepReader, "read", None)
        with pytest.raises(TypeError):
            reader.read()
