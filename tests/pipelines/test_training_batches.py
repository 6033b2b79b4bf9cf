"""Training batches: what they depend on, subsets of samples, turned and relit crops."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from model.denoiser import Denoiser
from model.features import FrameScale
from pipelines.training.augment import Turn, relight
from pipelines.training.batches import Batch, Crop, random_batch, spread, take
from pipelines.training.cache import CHANNEL_COUNT, CHANNELS, SampleCache, SceneArrays
from pipelines.training.caching import build_cache
from pipelines.training.recipe import Augmentation, Recipe
from tests.pipelines.training_data import COUNT, QUICK, SIZE, SMALL, uneven, write_example

RADIANCE, TIME = CHANNELS["radiance"], CHANNELS["time"].start
PLAIN = Augmentation(symmetries=False, permute_colors=False, exposure_stops=0, drop_roles=0, fireflies=0)
TURNS = [Turn(a, b, c) for a in (False, True) for b in (False, True) for c in (False, True)]


@pytest.fixture(scope="module")
def cache(tmp_path_factory: pytest.TempPathFactory) -> SampleCache:
    """Two scenes with as many samples everywhere, one adaptive, one over-composited."""
    folder = tmp_path_factory.mktemp("scenes")
    write_example(folder, "a", 1)
    write_example(folder, "b", 2)
    write_example(folder, "c", 3, uneven(3))
    write_example(folder, "d", 4, attributes={"lbmc:weighting": "over"}, fading=True)
    return build_cache(folder, folder / "cache")


def only(cache: SampleCache, *names: str) -> SampleCache:
    chosen = SampleCache(cache.folder)
    chosen.entries = [entry for entry in cache.entries if entry.name in names]
    return chosen


def same(one: Batch, other: Batch) -> bool:
    return torch.equal(one.target, other.target) and torch.equal(one.samples.weight, other.samples.weight) and all(
        torch.equal(one.samples.roles[role], other.samples.roles[role]) for role in one.samples.roles)


def test_a_batch_depends_on_seed_and_step_alone(cache: SampleCache) -> None:
    batch = random_batch(cache, QUICK, 7)
    assert same(batch, random_batch(cache, QUICK, 7))
    assert not torch.equal(batch.target, random_batch(cache, QUICK, 8).target)
    assert not torch.equal(batch.target, random_batch(cache, dataclasses.replace(QUICK, seed=2), 7).target)


@pytest.mark.parametrize("step", range(6))
def test_the_parts_of_a_batch_are_the_batch(cache: SampleCache, step: int) -> None:
    recipe = dataclasses.replace(QUICK, batch=5, augmentation=Augmentation(drop_roles=0.5))
    whole = random_batch(cache, recipe, step)
    parts = [random_batch(cache, recipe, step, part) for part in (slice(0, 1), slice(1, 3), slice(3, 5))]
    assert {part.layers for part in parts} == {whole.layers}
    assert all(part.samples.roles.keys() == whole.samples.roles.keys() for part in parts)
    assert torch.equal(torch.cat([part.target for part in parts]), whole.target)
    assert torch.equal(torch.cat([part.scale for part in parts]), whole.scale)
    for role, values in whole.samples.roles.items():
        assert torch.equal(torch.cat([part.samples.roles[role] for part in parts]), values)


def test_crops_of_a_batch_differ_from_each_other(cache: SampleCache) -> None:
    batch = random_batch(only(cache, "a"), dataclasses.replace(QUICK, batch=4, augmentation=PLAIN), 0)
    assert len({target.numpy().tobytes() for target in batch.target}) == 4


def test_a_subset_is_unbiased_and_its_weights_sum_to_one_in_every_pixel_that_has_samples(cache: SampleCache) -> None:
    recipe = dataclasses.replace(QUICK, batch=8, samples=((3, 1.0),), augmentation=PLAIN)
    for name, held in (("a", COUNT), ("c", None), ("d", None)):
        part = only(cache, name)
        samples = random_batch(part, recipe, 3).samples
        index = torch.repeat_interleave(torch.arange(samples.counts.numel()), samples.counts.long())
        sums = torch.zeros(samples.counts.numel()).index_add(0, index, samples.weight)
        torch.testing.assert_close(sums, (samples.counts > 0).float())
        times = samples.roles["time"][:, 0]
        if name != "d":  # a virtual miss has no time
            assert float(times.mean()) == pytest.approx(0.5, abs=0.02)
        if held is not None:
            assert set(samples.counts.tolist()) == {3}


def labelled(counts: np.ndarray) -> SceneArrays:
    """A ragged scene whose samples say in their radiance which pixel they are of and which of its samples they are."""
    offsets = np.concatenate([[0], counts.ravel().cumsum()]).astype(np.int64)
    samples = np.zeros((offsets[-1], CHANNEL_COUNT), np.float16)
    samples[:, 0] = np.repeat(np.arange(counts.size), counts.ravel())
    samples[:, 1] = np.arange(offsets[-1]) - np.repeat(offsets[:-1], counts.ravel())
    target = np.repeat(np.arange(counts.size, dtype=np.float32).reshape(*counts.shape, 1), 3, 2)
    return SceneArrays(samples, target, offsets)


@pytest.mark.parametrize("even", [False, True])
@pytest.mark.parametrize("turn", TURNS)
def test_a_ragged_crop_takes_distinct_samples_of_its_own_pixels(turn: Turn, even: bool) -> None:
    counts = uneven(8)
    arrays = labelled(counts)
    y, x = slice(3, 11), slice(20, 28)
    crop = take(arrays, y, x, turn, 4, 0.5, np.random.default_rng(1), even)
    pixels = turn.picture(arrays.target[y, x])[..., 0].ravel()
    np.testing.assert_array_equal(np.repeat(pixels, crop.counts), crop.values[:, 0])
    labels = crop.values[:, :2].astype(int)
    assert len(np.unique(labels, axis=0)) == len(labels)
    held = counts.ravel()[pixels.astype(int)]
    assert np.all(np.abs(crop.counts - held * 0.5) < 1)
    np.testing.assert_array_equal(crop.counts == 0, held == 0)


def test_subsets_of_a_ragged_scene_are_drawn_pixel_by_pixel() -> None:
    arrays = labelled(np.full((16, 16), 8, np.int32))
    crop = take(arrays, slice(0, 16), slice(0, 16), Turn(), 1, 1 / 8, np.random.default_rng(2))
    chosen = crop.values[:, 1]
    assert set(np.unique(chosen)) == set(range(8))
    assert crop.counts.tolist() == [1] * 256


@given(st.lists(st.integers(0, 40), min_size=1), st.integers(1, 40), st.sampled_from([None, 1]))
def test_spread_places_ascend_and_leave_no_wide_gap(held: list[int], most: int, seed: int | None) -> None:
    sizes = np.array(held, np.int64)
    counts = np.minimum(sizes, most)
    places = spread(sizes, counts, None if seed is None else np.random.default_rng(seed))
    for size, own in zip(held, np.split(places, counts.cumsum()[:-1]), strict=True):
        edges = np.concatenate([[-1], own, [size]])
        assert np.all(np.diff(edges) >= 1)
        assert not len(own) or np.diff(edges).max() <= 2 * np.ceil(size / len(own)) + 1


@pytest.mark.parametrize("ragged", [False, True])
@pytest.mark.parametrize("seed", [None, 3])
def test_even_subsets_have_a_sample_in_each_interval_of_the_shutter(ragged: bool, seed: int | None) -> None:
    """As many samples as the shutter has steps are one of each step, in any order that the cache has them."""
    size, steps, each = 8, 4, 3
    times = (np.arange(steps * each) // each + 0.5) / steps
    times = np.random.default_rng(1).permuted(np.tile(times, (size * size, 1)), axis=1)
    values = np.zeros((size * size, steps * each, CHANNEL_COUNT), np.float16)
    values[..., TIME] = times
    target = np.zeros((size, size, 3), np.float32)
    offsets = np.arange(size * size + 1) * steps * each
    arrays = (SceneArrays(values.reshape(-1, CHANNEL_COUNT), target, offsets) if ragged
              else SceneArrays(values.reshape(size, size, -1, CHANNEL_COUNT), target))
    rng = None if seed is None else np.random.default_rng(seed)
    crop = take(arrays, slice(0, size), slice(0, size), Turn(), steps, 1 / each, rng, even=True)
    taken = np.sort(crop.values[:, TIME].reshape(-1, steps), axis=1)
    np.testing.assert_allclose(taken, np.tile((np.arange(steps) + 0.5) / steps, (size * size, 1)))


def test_without_a_generator_a_crop_is_the_first_samples(cache: SampleCache) -> None:
    entry = cache.entries[0]
    arrays = cache.arrays(entry)
    crop = take(arrays, slice(0, 8), slice(0, 8), Turn(), 2, 1.0)
    np.testing.assert_array_equal(crop.values, arrays.samples[:8, :8, :2].reshape(-1, CHANNEL_COUNT))


@pytest.mark.parametrize("turn", TURNS)
def test_turning_a_crop_turns_directions_on_screen_with_it(turn: Turn) -> None:
    """The gradient of depth along the screen's axes, as a stand-in for any direction, keeps pointing the same way."""
    size = 8
    rows, columns = np.indices((size, size)).astype(np.float32)
    slope = np.array([0.3, -0.7], np.float32)  # of depth, per pixel to the right and down
    block = np.zeros((size, size, 1, CHANNEL_COUNT), np.float16)
    block[..., 0, CHANNELS["depth"].start] = columns * slope[0] + rows * slope[1]
    block[..., CHANNELS["motion"]] = slope
    block[..., CHANNELS["lens"]] = slope
    block[..., CHANNELS["normal"]] = [slope[0], -slope[1], 1.0]  # y up
    crop: Crop = take(SceneArrays(block, np.zeros((size, size, 3), np.float32)), slice(0, 8), slice(0, 8), turn, 1, 1.0)
    turn.directions(crop.values)
    depth = crop.values[:, CHANNELS["depth"].start].reshape(size, size)
    measured = [depth[0, 1] - depth[0, 0], depth[1, 0] - depth[0, 0]]
    np.testing.assert_allclose(crop.values[0, CHANNELS["motion"]], measured, atol=5e-3)
    np.testing.assert_allclose(crop.values[0, CHANNELS["lens"]], measured, atol=5e-3)
    np.testing.assert_allclose(crop.values[0, CHANNELS["normal"]], [measured[0], -measured[1], 1], atol=5e-3)


def test_all_eight_turns_are_drawn() -> None:
    assert {Turn.draw(np.random.default_rng(seed)) for seed in range(60)} == set(TURNS)


def test_relighting_changes_samples_and_target_alike_but_litters_the_samples_alone() -> None:
    rng = np.random.default_rng(0)
    values = rng.uniform(0.1, 1, (4000, CHANNEL_COUNT)).astype(np.float32)
    target = rng.uniform(0.1, 1, (5, 5, 3)).astype(np.float32)
    how = Augmentation(exposure_stops=2.0, fireflies=1.0, firefly_share=(-2, -2), firefly_gain=(2, 2))
    relit = values.copy()
    changed, gain = relight(np.random.default_rng(3), relit, target, how)
    order = [int(np.argmin(np.abs(changed[0, 0, k] / gain - target[0, 0]))) for k in range(3)]
    assert sorted(order) == [0, 1, 2]
    np.testing.assert_allclose(changed, target[..., order] * gain, rtol=1e-5)
    ratio = relit[:, RADIANCE] / (values[:, RADIANCE][:, order] * gain)
    hit = ratio[:, 0] > 10
    np.testing.assert_allclose(ratio[hit], 100, rtol=1e-4)
    np.testing.assert_allclose(ratio[~hit], 1, rtol=1e-4)
    assert 20 <= hit.sum() <= 65  # a share of 10^-2
    for role in ("albedo", "specular"):
        np.testing.assert_array_equal(relit[:, CHANNELS[role]], values[:, CHANNELS[role]][:, order])
    np.testing.assert_array_equal(relit[:, CHANNELS["normal"]], values[:, CHANNELS["normal"]])


def test_roles_are_dropped_from_some_batches_and_never_the_radiance(cache: SampleCache) -> None:
    recipe = dataclasses.replace(QUICK, batch=1, augmentation=Augmentation(drop_roles=0.5, drop_each=0.5))
    seen = {tuple(random_batch(only(cache, "a"), recipe, step).samples.roles) for step in range(40)}
    assert seen == {("radiance",), ("radiance", "depth"), ("radiance", "time"), ("radiance", "depth", "time")}


def test_samples_and_layers_are_drawn_as_often_as_the_recipe_says(cache: SampleCache) -> None:
    recipe = Recipe(batch=1, crop=32, samples=((2, 3.0), (5, 1.0)), layers=((1, 1.0), (3, 1.0)))
    batches = [random_batch(only(cache, "a"), recipe, step) for step in range(80)]
    counts = [int(batch.samples.counts[0]) for batch in batches]
    assert set(counts) == {2, 5}
    assert 45 <= counts.count(2) <= 73
    assert {batch.layers for batch in batches} == {1, 3}


def test_a_network_takes_a_batch_of_scenes_of_every_kind(cache: SampleCache) -> None:
    batch = random_batch(cache, dataclasses.replace(QUICK, batch=8), 1)
    assert batch.samples.shape == (8, 32, 32)
    assert int(batch.samples.counts.min()) == 0
    beauty = Denoiser(SMALL)(batch.samples, FrameScale()).beauty()
    assert torch.isfinite(beauty).all()


def test_crops_shrink_to_the_smallest_scene(cache: SampleCache) -> None:
    batch = random_batch(cache, dataclasses.replace(QUICK, crop=128), 0)
    assert batch.target.shape == (3, 3, SIZE, SIZE)
