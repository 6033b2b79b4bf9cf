"""The cache of training data: what it holds of uniform, ragged, packed and over-composited files, and its refusals."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from deep_io.errors import InputError
from deep_io.flat import read_flat, write_flat
from deep_io.header import Header
from deep_io.path_samples import PathSamples, SampleReader
from deep_io.samples import Window
from pipelines.training.cache import CHANNEL_COUNT, CHANNELS, SampleCache, array_path, read_index
from pipelines.training.caching import build_cache, scene_files
from tests.pipelines.training_data import COUNT, SIZE, uneven, write_example

DEPTH, TIME = CHANNELS["depth"].start, CHANNELS["time"].start


@pytest.fixture(scope="module")
def scenes(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("scenes")
    for number in range(3):
        write_example(folder, f"scene{number}", number)
    return folder


@pytest.fixture(scope="module")
def cache(scenes: Path, tmp_path_factory: pytest.TempPathFactory) -> SampleCache:
    return build_cache(scenes, tmp_path_factory.mktemp("cache"))


def decoded(path: Path) -> PathSamples:
    with SampleReader(path) as reader:
        return reader.read()


def test_the_cache_holds_what_the_files_hold_in_exposure_and_depth_units(cache: SampleCache) -> None:
    entry = cache.entries[0]
    arrays = cache.arrays(entry)
    assert arrays.samples.shape == (SIZE, SIZE, COUNT, CHANNEL_COUNT)
    assert arrays.offsets is None
    assert entry.roles == ("radiance", "depth", "time")
    radiance = arrays.samples[..., CHANNELS["radiance"]].astype(np.float64).mean((0, 1, 2))
    np.testing.assert_allclose(radiance, arrays.target.mean((0, 1)), rtol=0.05)
    depth = arrays.samples[..., DEPTH].astype(np.float64).mean(2) * entry.depth
    expected = 2 + np.arange(SIZE) / SIZE + 0.01 * (COUNT - 1) / 2
    np.testing.assert_allclose(depth, np.repeat(expected[:, None], SIZE, 1), rtol=2e-3)
    assert float(arrays.target.mean() * entry.target_scale) == pytest.approx(0.5, rel=0.02)


def test_samples_of_a_pixel_lie_in_random_order_whatever_the_renderers_was(cache: SampleCache) -> None:
    """Otherwise the first samples of each pixel would all be from the start of the shutter."""
    time = cache.arrays(cache.entries[0]).samples[..., TIME].astype(np.float64)
    np.testing.assert_allclose(np.sort(time, 2), np.broadcast_to(np.linspace(0, 1, COUNT), time.shape), atol=1e-3)
    np.testing.assert_allclose(time.mean((0, 1)), 0.5, atol=0.05)
    assert abs(np.corrcoef(time[:, :-1, 0].ravel(), time[:, 1:, 0].ravel())[0, 1]) < 0.1


def test_pixels_with_different_numbers_of_samples_keep_theirs(tmp_path: Path) -> None:
    counts = uneven(5)
    write_example(tmp_path, "adaptive", 5, counts)
    cache = build_cache(tmp_path, tmp_path / "cache")
    entry = cache.entries[0]
    arrays = cache.arrays(entry)
    assert entry.ragged
    assert arrays.offsets is not None
    assert arrays.weight is None
    np.testing.assert_array_equal(np.diff(arrays.offsets), counts.ravel())
    assert entry.samples == np.ceil(counts.sum() / (counts > 0).sum())
    stored = decoded(tmp_path / "adaptive.deep.exr").roles["radiance"] * np.float32(entry.exposure)
    mine = arrays.samples[:, CHANNELS["radiance"]].astype(np.float32)
    assert not np.array_equal(mine, stored.astype(np.float16))  # shuffled
    for pixel in np.flatnonzero(counts.ravel())[::97]:
        place = slice(arrays.offsets[pixel], arrays.offsets[pixel + 1])
        np.testing.assert_allclose(np.sort(mine[place], 0), np.sort(stored[place], 0), rtol=1e-3)


def test_samples_of_an_over_composite_keep_their_weights(tmp_path: Path) -> None:
    write_example(tmp_path, "comp", 6, attributes={"lbmc:weighting": "over"}, fading=True)
    cache = build_cache(tmp_path, tmp_path / "cache")
    entry = cache.entries[0]
    arrays = cache.arrays(entry)
    stored = decoded(tmp_path / "comp.deep.exr")
    assert entry.weighting == "over"
    assert arrays.weight is not None
    np.testing.assert_allclose(arrays.weight, stored.weight)
    np.testing.assert_allclose(
        arrays.samples[:, CHANNELS["radiance"]].astype(np.float32), stored.roles["radiance"] * entry.exposure, rtol=1e-3
    )


def test_a_cached_scene_is_decoded_again_only_when_it_changed(scenes: Path, tmp_path: Path) -> None:
    copied = tmp_path / "data"
    shutil.copytree(scenes, copied)
    told: list[str] = []
    before = build_cache(copied, tmp_path / "cache", told.append)
    assert len(told) == 3
    mapped = before.arrays(before.entries[1]).samples
    held = np.array(mapped)
    write_example(copied, "scene1", 77)
    write_example(copied, "scene9", 9)
    after = build_cache(copied, tmp_path / "cache", told.append)
    assert told[3:] == ["cached scene1 (1 of 2)", "cached scene9 (2 of 2)"]
    assert [entry.name for entry in after.entries] == ["scene0", "scene1", "scene2", "scene9"]
    assert not np.array_equal(after.arrays(after.entries[1]).samples, held)
    np.testing.assert_array_equal(mapped, held)  # a training that runs on the old arrays goes on undisturbed


def test_the_target_of_a_reference_in_halves_is_their_mean(scenes: Path, tmp_path: Path) -> None:
    copied = tmp_path / "data"
    shutil.copytree(scenes, copied)
    before = build_cache(copied, tmp_path / "cache")
    target = np.array(before.arrays(before.entries[1]).target)
    one = read_flat(copied / "scene1.ref.exr").channels
    write_flat(copied / "scene1.ref2.exr", {name: np.ascontiguousarray(3 * values) for name, values in one.items()})
    told: list[str] = []
    after = build_cache(copied, tmp_path / "cache", told.append)
    assert told == ["cached scene1 (1 of 1)"], "a half that came later counts"
    np.testing.assert_allclose(after.arrays(after.entries[1]).target, 2 * target, rtol=1e-6)


def test_a_scene_whose_arrays_were_removed_is_decoded_again(scenes: Path, tmp_path: Path) -> None:
    told: list[str] = []
    build_cache(scenes, tmp_path / "cache")
    array_path(tmp_path / "cache", "scene1", "target").unlink()
    cache = build_cache(scenes, tmp_path / "cache", told.append)
    assert told == ["cached scene1 (1 of 1)"]
    assert cache.arrays(cache.entries[1]).target.shape[2] == 3


def test_what_another_run_cached_meanwhile_stays_in_the_index(scenes: Path, tmp_path: Path) -> None:
    held: list[list[str]] = []

    def report(_: str) -> None:
        if not held:
            build_cache(scenes, tmp_path / "cache")  # the other run: it starts later and is done first
        held.append(sorted(read_index(tmp_path / "cache")))

    build_cache(scenes, tmp_path / "cache", report)
    assert held == [["scene0", "scene1", "scene2"]] * 3


def test_a_scene_that_was_moved_away_is_no_longer_in_the_cache(scenes: Path, tmp_path: Path) -> None:
    copied = tmp_path / "data"
    shutil.copytree(scenes, copied)
    build_cache(copied, tmp_path / "cache")
    for path in copied.glob("scene1.*"):
        path.unlink()
    assert [entry.name for entry in build_cache(copied, tmp_path / "cache").entries] == ["scene0", "scene2"]


def lose_reference(folder: Path) -> None:
    (folder / "scene1.ref.exr").unlink()


def shrink_reference(folder: Path) -> None:
    write_flat(folder / "scene1.ref.exr", dict.fromkeys("RGB", np.ones((SIZE, SIZE - 1), np.float32)))


def shift_reference(folder: Path) -> None:
    path, window = folder / "scene1.ref.exr", Window(3, 0, SIZE + 2, SIZE - 1)
    write_flat(path, dict.fromkeys("RGB", np.ones((SIZE, SIZE), np.float32)), Header((), window, window))


def poison_reference(folder: Path) -> None:
    bad = np.ones((SIZE, SIZE), np.float32)
    bad[3, 4] = np.nan
    write_flat(folder / "scene1.ref.exr", dict.fromkeys("RGB", bad))


def colourless_reference(folder: Path) -> None:
    write_flat(folder / "scene1.ref.exr", {"Y": np.ones((SIZE, SIZE), np.float32)})


def black_reference(folder: Path) -> None:
    write_flat(folder / "scene1.ref.exr", dict.fromkeys("RGB", np.zeros((SIZE, SIZE), np.float32)))


def copy_half(folder: Path) -> None:
    shutil.copy(folder / "scene1.ref.exr", folder / "scene1.ref2.exr")


def truncate_deep(folder: Path) -> None:
    path = folder / "scene1.deep.exr"
    path.write_bytes(path.read_bytes()[:-500])


@pytest.mark.parametrize(
    ("damage", "named"),
    [
        (lose_reference, "scene1.deep.exr: its reference scene1.ref.exr is missing"),
        (shrink_reference, "scene1.ref.exr: 39x40 pixels at .0, 0., but scene1.deep.exr has 40x40 pixels at .0, 0."),
        (shift_reference, "scene1.ref.exr: 40x40 pixels at .3, 0., but scene1.deep.exr has 40x40 pixels at .0, 0."),
        (poison_reference, "scene1.ref.exr: NaN or Inf"),
        (colourless_reference, "scene1.ref.exr: no R, G, B channels"),
        (black_reference, "scene1.ref.exr: .*no light"),
        (copy_half, "scene1.ref.exr and .*scene1.ref2.exr are the same picture"),
        (truncate_deep, "scene1.deep.exr"),
    ],
)
def test_data_that_cannot_be_trained_on_is_refused_by_name(
    scenes: Path, tmp_path: Path, damage: Callable[[Path], None], named: str
) -> None:
    copied = tmp_path / "data"
    shutil.copytree(scenes, copied)
    damage(copied)
    with pytest.raises(InputError, match=named):
        build_cache(copied, tmp_path / "cache")
    assert not [path for path in (tmp_path / "cache").glob("*") if "scene1" in path.name]


def test_folders_without_enough_scenes_are_refused(scenes: Path, tmp_path: Path) -> None:
    (tmp_path / "none").mkdir()
    with pytest.raises(InputError, match=r"none: no \*\.deep\.exr"):
        scene_files(tmp_path / "none")
    with pytest.raises(InputError, match="nowhere: no such folder"):
        scene_files(tmp_path / "nowhere")
    with pytest.raises(InputError, match="3 scenes; 4 or more"):
        scene_files(scenes, 4)
    with pytest.raises(InputError, match="no training cache here"):
        SampleCache(tmp_path / "none")
