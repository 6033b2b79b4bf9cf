"""Training on small real files: the cache, its refusals, turned crops, runs that resume to the same weights."""

from __future__ import annotations

import csv
import dataclasses
import shutil
from pathlib import Path

import numpy as np
import pytest
import torch

from deep_io import DeepSamples, Window, write_deep
from deep_io.errors import InputError, UsageError
from deep_io.flat import write_flat
from model import zoo
from model.config import FAST, UNetConfig
from model.samples import Samples
from pipelines.training.batches import _transpose, _turn, random_batch
from pipelines.training.cache import CHANNEL_COUNT, CHANNELS, SampleCache, build_cache
from pipelines.training.job import train
from pipelines.training.loop import CHECKPOINT, CURVE, Trainer, learning_rate
from pipelines.training.recipe import Recipe

SIZE, COUNT = 40, 6
SMALL = dataclasses.replace(
    FAST,
    unet=UNetConfig(encoder=((8,), (8,)), bottleneck=(8,), decoder=((8,), (8,)), scale=2),
    reducer=(8, 8),
    partitioner=(8,),
    generator=(8,),
    kernel_sizes=(3, 3, 3),
)
QUICK = Recipe(steps=6, batch=2, crop=32, warmup=2, validate_every=3)


def write_example(folder: Path, name: str, seed: int) -> None:
    """A tilted plane under noise, COUNT samples a pixel, and its exact mean as the reference."""
    rng = np.random.default_rng(seed)
    rows, columns = np.indices((SIZE, SIZE))
    clean = np.stack([0.2 + rows / SIZE, 0.5 + columns / SIZE, np.full((SIZE, SIZE), 0.3)], -1).astype(np.float32)
    noisy = clean[:, :, None] * rng.gamma(1.0, 1.0, (SIZE, SIZE, COUNT, 1))
    depth = np.repeat(2 + rows[..., None] / SIZE, COUNT, -1)
    channels = {
        **{c: noisy[..., k].astype(np.float16).ravel() for k, c in enumerate("RGB")},
        "A": np.ones(noisy[..., 0].size, np.float16),
        "Z": depth.astype(np.float32).ravel(),
    }
    counts = np.full((SIZE, SIZE), COUNT, np.int32)
    write_deep(folder / f"{name}.deep.exr", DeepSamples(counts, channels, Window(0, 0, SIZE - 1, SIZE - 1)))
    write_flat(folder / f"{name}.ref.exr", {c: np.ascontiguousarray(clean[..., k]) for k, c in enumerate("RGB")})


@pytest.fixture(scope="module")
def scenes(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("scenes")
    for number in range(3):
        write_example(folder, f"scene{number}", number)
    return folder


@pytest.fixture(scope="module")
def cache(scenes: Path, tmp_path_factory: pytest.TempPathFactory) -> SampleCache:
    return build_cache(scenes, tmp_path_factory.mktemp("cache"))


def weights_of(trainer: Trainer) -> list[torch.Tensor]:
    return [value.clone() for value in trainer.averaged.state_dict().values()]


def test_the_cache_holds_what_the_files_hold_in_exposure_and_depth_units(scenes: Path, cache: SampleCache) -> None:
    entry = cache.entries[0]
    samples, target = cache.arrays(entry)
    assert samples.shape == (SIZE, SIZE, COUNT, CHANNEL_COUNT)
    assert entry.roles == ("radiance", "depth")
    radiance = samples[..., CHANNELS["radiance"]].astype(np.float64).mean((0, 1, 2))
    np.testing.assert_allclose(radiance, target.mean((0, 1)), rtol=0.05)
    depth = samples[:, :, 0, CHANNELS["depth"].start].astype(np.float64) * entry.depth
    np.testing.assert_allclose(depth[:, 0], 2 + np.arange(SIZE) / SIZE, rtol=2e-3)
    assert float(target.mean() * entry.target_scale) == pytest.approx(0.5, rel=0.02)


def test_a_cached_scene_is_not_decoded_again(scenes: Path, tmp_path: Path) -> None:
    copied = tmp_path / "data"
    shutil.copytree(scenes, copied)
    told: list[str] = []
    build_cache(copied, tmp_path / "cache", told.append)
    assert len(told) == 3
    write_example(copied, "scene9", 9)
    build_cache(copied, tmp_path / "cache", told.append)
    assert told[3:] == ["cached scene9"]


def break_reference(folder: Path) -> None:
    (folder / "scene1.ref.exr").unlink()


def shrink_reference(folder: Path) -> None:
    small = np.ones((SIZE, SIZE - 1), np.float32)
    write_flat(folder / "scene1.ref.exr", dict.fromkeys("RGB", small))


def poison_reference(folder: Path) -> None:
    bad = np.full((SIZE, SIZE), np.nan, np.float32)
    write_flat(folder / "scene1.ref.exr", dict.fromkeys("RGB", bad))


def colourless_reference(folder: Path) -> None:
    write_flat(folder / "scene1.ref.exr", {"Y": np.ones((SIZE, SIZE), np.float32)})


@pytest.mark.parametrize(
    ("damage", "named"),
    [
        (break_reference, "scene1.deep.exr.*missing"),
        (shrink_reference, "scene1.ref.exr: 39x40 pixels"),
        (poison_reference, "scene1.ref.exr: NaN or Inf"),
        (colourless_reference, "scene1.ref.exr: no channel R"),
    ],
)
def test_data_that_cannot_be_trained_on_is_refused_by_name(
    scenes: Path, tmp_path: Path, damage: object, named: str
) -> None:
    copied = tmp_path / "data"
    shutil.copytree(scenes, copied)
    assert callable(damage)
    damage(copied)
    with pytest.raises(InputError, match=named):
        build_cache(copied, tmp_path / "cache")


def test_an_empty_folder_and_a_single_scene_are_refused(scenes: Path, tmp_path: Path) -> None:
    (tmp_path / "none").mkdir()
    with pytest.raises(InputError, match=r"no \*\.deep\.exr"):
        build_cache(tmp_path / "none", tmp_path / "cache")
    one = tmp_path / "one"
    one.mkdir()
    write_example(one, "alone", 5)
    with pytest.raises(UsageError, match="needs 2 or more"):
        train(one, scenes, tmp_path / "run", "fast", QUICK)


def test_a_batch_depends_on_its_seed_alone(cache: SampleCache) -> None:
    first, again, other = (random_batch(cache, cache.entries, QUICK, (1, step)) for step in (7, 7, 8))
    assert torch.equal(first.samples.roles["radiance"], again.samples.roles["radiance"])
    assert torch.equal(first.target, again.target)
    assert first.samples.roles["radiance"].shape != other.samples.roles["radiance"].shape or not torch.equal(
        first.samples.roles["radiance"], other.samples.roles["radiance"]
    )


def test_turning_a_crop_turns_directions_on_screen_with_it() -> None:
    """The gradient of depth along the screen's axes, as a stand-in for any direction, keeps pointing the same way."""
    size = 8
    rows, columns = np.indices((size, size)).astype(np.float32)
    slope = np.array([0.3, -0.7], np.float32)  # of depth, per pixel to the right and down
    block = np.zeros((size, size, 1, CHANNEL_COUNT), np.float32)
    block[..., 0, CHANNELS["depth"].start] = columns * slope[0] + rows * slope[1]
    block[..., CHANNELS["motion"]] = slope
    block[..., CHANNELS["lens"]] = slope
    block[..., CHANNELS["normal"]] = [slope[0], -slope[1], 1.0]  # y up
    seen = set()
    for seed in range(40):
        turned, _ = _turn(np.random.default_rng(seed), block.copy(), np.zeros((size, size, 3), np.float32))
        depth = turned[..., 0, CHANNELS["depth"].start]
        measured = [depth[0, 1] - depth[0, 0], depth[1, 0] - depth[0, 0]]
        np.testing.assert_allclose(turned[0, 0, 0, CHANNELS["motion"]], measured, atol=1e-5)
        np.testing.assert_allclose(turned[0, 0, 0, CHANNELS["lens"]], measured, atol=1e-5)
        np.testing.assert_allclose(turned[0, 0, 0, CHANNELS["normal"]], [measured[0], -measured[1], 1], atol=1e-5)
        seen.add(tuple(np.round(measured, 3)))
    assert len(seen) == 8


def test_transposing_twice_is_nothing() -> None:
    block = np.random.default_rng(0).normal(size=(4, 4, 2, CHANNEL_COUNT)).astype(np.float32)
    twice = block.copy()
    _transpose(twice)
    _transpose(twice)
    np.testing.assert_array_equal(twice, block)


def test_the_learning_rate_warms_up_and_falls_to_its_floor() -> None:
    recipe = Recipe(steps=100, warmup=10, learning_rate=1.0, final_rate=0.1)
    rates = [learning_rate(step, recipe) for step in range(101)]
    assert rates[0] == pytest.approx(0.1)
    assert rates[9] == pytest.approx(1.0)
    assert all(a >= b for a, b in zip(rates[10:-1], rates[11:], strict=True))
    assert rates[100] == pytest.approx(0.1)


def test_an_interrupted_run_resumes_to_the_uninterrupted_one(cache: SampleCache, tmp_path: Path) -> None:
    whole = Trainer(SMALL, QUICK, tmp_path / "whole")
    whole.run(cache, cache, lambda _: None)
    halved = Trainer(SMALL, QUICK, tmp_path / "halved")
    told: list[str] = []

    def interrupt(line: str) -> None:
        told.append(line)
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        halved.run(cache, cache, interrupt)
    assert (tmp_path / "halved" / CHECKPOINT).exists()
    resumed = Trainer(SMALL, QUICK, tmp_path / "halved")
    assert resumed.step == 3
    resumed.run(cache, cache, lambda _: None)
    for mine, theirs in zip(weights_of(whole), weights_of(resumed), strict=True):
        torch.testing.assert_close(mine, theirs)
    with (tmp_path / "whole" / CURVE).open() as file:
        assert [float(row["step"]) for row in csv.DictReader(file)] == [3, 6]


def test_training_lowers_the_loss_on_what_it_sees(cache: SampleCache, tmp_path: Path) -> None:
    recipe = dataclasses.replace(QUICK, steps=40, learning_rate=3e-3, samples=((4, 1.0),), validate_every=100)
    trainer = Trainer(SMALL, recipe, tmp_path)
    batch = random_batch(cache, cache.entries, recipe, (0, 0))
    losses = []
    for _ in range(recipe.steps):
        losses.append(trainer.update(batch))
        trainer.step += 1
    assert np.mean(losses[-5:]) < np.mean(losses[:5]) - 0.05


def test_train_writes_weights_that_the_zoo_reads(scenes: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    data = tmp_path / "data"
    shutil.copytree(scenes, data)
    monkeypatch.setitem(train.__globals__["CONFIGS"], "small", SMALL)
    path = train(data, data, tmp_path / "run", "small", QUICK, report=lambda _: None)
    weights = zoo.find(str(path))
    assert weights.info["steps"] == QUICK.steps
    assert weights.info["data"]["scenes"] == 3
    assert weights.config == SMALL
    net = weights.load()
    radiance = torch.rand(16, 3)
    samples = Samples((1, 4, 4), torch.ones(16, dtype=torch.int32), torch.ones(16), torch.ones(16),
                      {"radiance": radiance})
    from model.features import FrameScale

    with torch.no_grad():
        assert torch.isfinite(net(samples, FrameScale()).beauty()).all()
