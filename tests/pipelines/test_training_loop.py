"""The training loop on small real files: runs that resume, validation, curves and panels, checkpoints refused."""

from __future__ import annotations

import csv
import dataclasses
import io
import json
import math
import os
import signal
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image
from torch import Tensor

from deep_io.errors import InputError, LbmcError, UsageError
from model import zoo
from model.compositing import Layers, to_layers
from model.denoiser import Denoiser
from model.losses import LossWeights
from model.samples import Samples
from pipelines.signals import StoppedError
from pipelines.training.batches import Batch, random_batch
from pipelines.training.cache import SampleCache
from pipelines.training.caching import build_cache
from pipelines.training.drawing import PANEL_PIXELS, curve_png, panel_png
from pipelines.training.group import ALONE, Group
from pipelines.training.job import TrainOptions, starting_weights, train
from pipelines.training.loop import HOPELESS, Trainer, disorder, displacement, learning_rate
from pipelines.training.recipe import Augmentation, Recipe
from pipelines.training.run_folder import CHECKPOINT, CURVE, CURVE_PICTURE, PANELS, RECIPE
from pipelines.training.validation import pixel_means, validate
from tests.pipelines.training_data import QUICK, SMALL, uneven, write_example

torch.set_num_threads(1)


@pytest.fixture(scope="module")
def scenes(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("scenes")
    for number in range(2):
        write_example(folder, f"scene{number}", number)
    write_example(folder, "uneven", 2, uneven(2))
    return folder


@pytest.fixture(scope="module")
def cache(scenes: Path, tmp_path_factory: pytest.TempPathFactory) -> SampleCache:
    return build_cache(scenes, tmp_path_factory.mktemp("cache"))


@pytest.fixture(scope="module")
def whole(cache: SampleCache, tmp_path_factory: pytest.TempPathFactory) -> Trainer:
    """A run of QUICK that nothing interrupted."""
    trainer = Trainer(SMALL, QUICK, tmp_path_factory.mktemp("whole"))
    trainer.run(cache, cache, lambda _: None)
    return trainer


def curve_of(trainer: Trainer) -> list[dict[str, float]]:
    with (trainer.folder.folder / CURVE).open() as file:
        return [{name: float(value) for name, value in row.items()} for row in csv.DictReader(file)]


def assert_same_run(one: Trainer, other: Trainer) -> None:
    assert curve_of(one) == curve_of(other)
    for mine, theirs in zip(one.averaged.parameters(), other.averaged.parameters(), strict=True):
        assert torch.equal(mine, theirs)


def test_the_learning_rate_warms_up_and_falls_to_its_floor() -> None:
    recipe = Recipe(steps=100, warmup=10, learning_rate=1.0, final_rate=0.1)
    rates = [learning_rate(step, recipe) for step in range(101)]
    assert rates[0] == pytest.approx(0.1)
    assert rates[9] == pytest.approx(1.0)
    assert all(a >= b for a, b in zip(rates[10:-1], rates[11:], strict=True))
    assert rates[100] == pytest.approx(0.1)


@pytest.mark.parametrize("steps", [1, 3])
def test_a_run_stopped_anywhere_resumes_to_the_uninterrupted_one(
    cache: SampleCache, tmp_path: Path, whole: Trainer, steps: int
) -> None:
    halved = Trainer(SMALL, QUICK, tmp_path)
    for _ in range(steps):
        halved.advance(random_batch(cache, QUICK, halved.step))
    halved.save()
    resumed = Trainer(SMALL, QUICK, tmp_path)
    assert resumed.step == steps
    resumed.run(cache, cache, lambda _: None)
    assert_same_run(whole, resumed)


def test_an_exception_leaves_a_checkpoint_of_the_last_whole_step(
    cache: SampleCache, tmp_path: Path, whole: Trainer
) -> None:
    def fail(line: str) -> None:
        raise OSError(line)

    with pytest.raises(OSError, match="step 3"):
        Trainer(SMALL, QUICK, tmp_path).run(cache, cache, fail)
    resumed = Trainer(SMALL, QUICK, tmp_path)
    assert resumed.step == 3
    resumed.run(cache, cache, lambda _: None)
    assert_same_run(whole, resumed)


def test_a_signal_ends_the_run_after_its_step_and_is_told_once_everything_is_saved(
    cache: SampleCache, tmp_path: Path, whole: Trainer
) -> None:
    class Signalled(Trainer):
        def advance(self, batch: Batch) -> float:
            if self.step == 1:
                os.kill(os.getpid(), signal.SIGTERM)
            return super().advance(batch)

    handler = signal.getsignal(signal.SIGTERM)
    with pytest.raises(StoppedError) as stopped:
        Signalled(SMALL, QUICK, tmp_path).run(cache, cache, lambda _: None)
    assert stopped.value.number == signal.SIGTERM
    assert signal.getsignal(signal.SIGTERM) is handler
    resumed = Trainer(SMALL, QUICK, tmp_path)
    assert resumed.step == 2
    resumed.run(cache, cache, lambda _: None)
    assert_same_run(whole, resumed)


def test_a_signal_during_validation_leaves_that_to_the_resumed_run(
    cache: SampleCache, tmp_path: Path, whole: Trainer, monkeypatch: pytest.MonkeyPatch
) -> None:
    def interrupted(net: Denoiser, *rest: Any) -> object:
        os.kill(os.getpid(), signal.SIGINT)
        return validate(net, *rest)

    with monkeypatch.context() as patch:
        patch.setattr("pipelines.training.loop.validate", interrupted)
        with pytest.raises(StoppedError):
            Trainer(SMALL, QUICK, tmp_path).run(cache, cache, lambda _: None)
    resumed = Trainer(SMALL, QUICK, tmp_path)
    assert (resumed.step, resumed.state.rows) == (3, [])
    resumed.run(cache, cache, lambda _: None)
    assert_same_run(whole, resumed)


def test_a_run_out_of_time_saves_and_says_nothing(cache: SampleCache, tmp_path: Path) -> None:
    trainer = Trainer(SMALL, QUICK, tmp_path)
    trainer.run(cache, cache, lambda _: None, seconds=0.0)
    assert trainer.step == 0
    assert (tmp_path / CHECKPOINT).exists()


def test_checkpoints_are_written_between_validations_as_often_as_asked(
    cache: SampleCache, tmp_path: Path
) -> None:
    saved = []

    class Noting(Trainer):
        def save(self) -> None:
            saved.append(self.step)
            super().save()

    recipe = dataclasses.replace(QUICK, validate_every=100)
    Noting(SMALL, recipe, tmp_path).run(cache, cache, lambda _: None, save_every=1e-6)
    assert saved[:6] == [1, 2, 3, 4, 5, 6]


def test_the_number_of_loaders_changes_nothing(cache: SampleCache, tmp_path: Path, whole: Trainer) -> None:
    trainer = Trainer(SMALL, QUICK, tmp_path)
    trainer.run(cache, cache, lambda _: None, loaders=3)
    assert_same_run(whole, trainer)


def test_parts_of_a_batch_weigh_as_much_as_their_crops(cache: SampleCache, tmp_path: Path) -> None:
    """What DistributedDataParallel averages: the mean of the processes' gradients is that of the whole batch."""
    def gradient(group: Group) -> torch.Tensor:
        trainer = Trainer(SMALL, dataclasses.replace(QUICK, clip=1e9), tmp_path / "none")
        trainer.group = _Silent(group.rank, group.size, group.device)
        trainer.advance(random_batch(cache, QUICK, 0, group.part(QUICK.batch)))
        return torch.cat([p.grad.flatten() for p in trainer.net.parameters() if p.grad is not None])

    parts = [gradient(Group(rank, 2, torch.device("cpu"))) for rank in (0, 1)]
    torch.testing.assert_close(sum(parts) / 2, gradient(ALONE), rtol=1e-4, atol=1e-6)


class _Silent(Group):
    """A process that hears of no other."""

    def mean(self, value: torch.Tensor) -> float:
        return float(value.detach())


def test_every_parameter_gets_a_gradient_whatever_the_batch_lacks(cache: SampleCache, tmp_path: Path) -> None:
    """Processes must agree on which parameters have one."""
    recipe = dataclasses.replace(QUICK, layers=((1, 1.0),), augmentation=Augmentation(drop_roles=1.0, drop_each=1.0))
    trainer = Trainer(SMALL, recipe, tmp_path)
    trainer.advance(random_batch(cache, recipe, 0))
    assert all(p.grad is not None for p in trainer.net.parameters())


def test_training_lowers_the_loss_on_what_it_sees(cache: SampleCache, tmp_path: Path) -> None:
    recipe = dataclasses.replace(QUICK, steps=24, batch=2, learning_rate=4e-3, samples=((4, 1.0),))
    trainer = Trainer(SMALL, recipe, tmp_path)
    batch = random_batch(cache, recipe, 0)
    losses = [trainer.advance(batch) for _ in range(recipe.steps)]
    assert np.mean(losses[-5:]) < np.mean(losses[:5]) - 0.015


def test_the_finish_minimises_its_own_loss(cache: SampleCache, tmp_path: Path) -> None:
    nothing = LossWeights(smape=0, relative=0, pooled=())
    recipe = dataclasses.replace(QUICK, finish=0.5, finish_loss=nothing, partition_entropy=0.0, depth_order=0.0)
    trainer = Trainer(SMALL, recipe, tmp_path)
    losses = [trainer.advance(random_batch(cache, recipe, step)) for step in range(recipe.steps)]
    assert [loss != 0 for loss in losses] == [True] * 3 + [False] * 3


def test_displacement_is_the_share_of_the_weight_that_changed_layers() -> None:
    def layers(front: Tensor) -> Layers:
        visible = torch.zeros(1, 2, 6, *front.shape)
        visible[0, :, 5] = torch.stack([front, 1 - front])
        return to_layers(visible)

    half = torch.full((16, 16), 0.5)
    front = half.clone()
    front[:8, :8] += 0.4  # one cell of four
    assert float(displacement(layers(front), layers(half))) == pytest.approx(0.1)
    front = half + 0.4 * (torch.arange(16) % 2 * 2 - 1)  # edges within a cell are free
    assert float(displacement(layers(front), layers(half))) == pytest.approx(0, abs=1e-6)


def test_layers_that_are_held_go_back_to_where_they_were(cache: SampleCache, tmp_path: Path) -> None:
    nothing = LossWeights(smape=0, relative=0, pooled=())
    recipe = dataclasses.replace(QUICK, steps=12, learning_rate=0.02, loss=nothing, partition_entropy=0.0,
                                 depth_order=0.0, hold_layers=1.0, layers=((2, 1.0),))
    torch.manual_seed(0)
    trainer = Trainer(SMALL, recipe, tmp_path, Denoiser(SMALL).state_dict())
    batch = random_batch(cache, recipe, 0)
    assert trainer.advance(batch) == 0
    with torch.no_grad():
        trainer.net.partitioner.layers[-1].bias[0] += 2
    losses = [trainer.advance(batch) for _ in range(recipe.steps)]
    assert losses[0] > 0.1
    assert losses[-1] < 0.5 * losses[0]


def test_a_resumed_run_holds_the_layers_of_its_start(cache: SampleCache, tmp_path: Path) -> None:
    """Not those of the checkpoint that it resumes from."""
    recipe = dataclasses.replace(QUICK, learning_rate=0.01, hold_layers=10.0)
    torch.manual_seed(0)
    start = Denoiser(SMALL).state_dict()
    whole = Trainer(SMALL, recipe, tmp_path / "whole", start)
    whole.run(cache, cache, lambda _: None)
    stopped = Trainer(SMALL, recipe, tmp_path / "resumed", start)
    for step in range(4):
        stopped.advance(random_batch(cache, recipe, step))
    stopped.save()
    resumed = Trainer(SMALL, recipe, tmp_path / "resumed", start)
    assert resumed.step == 4
    resumed.run(cache, cache, lambda _: None)
    for mine, theirs in zip(whole.averaged.parameters(), resumed.averaged.parameters(), strict=True):
        assert torch.equal(mine, theirs)


def test_a_step_that_is_not_finite_is_skipped_and_counted(cache: SampleCache, tmp_path: Path) -> None:
    trainer = Trainer(SMALL, dataclasses.replace(QUICK, steps=2, validate_every=2), tmp_path)
    batch = random_batch(cache, QUICK, 0)
    broken = dataclasses.replace(batch, target=torch.full_like(batch.target, torch.nan))
    before = [p.clone() for p in trainer.net.parameters()]
    assert np.isnan(trainer.advance(broken))
    assert all(torch.equal(a, b) for a, b in zip(before, trainer.net.parameters(), strict=True))
    told: list[str] = []
    trainer.run(cache, cache, told.append)
    assert trainer.state.rows[-1]["skipped"] == 1
    assert "1 steps skipped" in told[-1]


def test_a_run_that_has_diverged_ends_in_one_line(
    cache: SampleCache, tmp_path: Path
) -> None:
    recipe = dataclasses.replace(QUICK, steps=HOPELESS + 5, validate_every=HOPELESS - 10)
    trainer = Trainer(SMALL, recipe, tmp_path)
    with torch.no_grad():
        for parameter in trainer.net.parameters():
            parameter.fill_(torch.nan)
    with pytest.raises(LbmcError, match=f"step {HOPELESS}: .* lower --learning-rate"):
        trainer.run(cache, cache, print)
    assert (tmp_path / CHECKPOINT).exists()


def test_validation_scores_output_and_input_against_the_reference(cache: SampleCache) -> None:
    result = validate(Denoiser(SMALL), cache, QUICK)
    assert result is not None
    score, shown = result
    scene = next(item for item in shown if item.name == "scene0")
    entry = cache.entries[0]
    arrays = cache.arrays(entry)
    mean = arrays.samples[..., :3].astype(np.float32).mean(2) * entry.target_scale
    np.testing.assert_allclose(scene.noisy, mean, rtol=1e-4)
    np.testing.assert_allclose(scene.reference, arrays.target * entry.target_scale, rtol=1e-5)
    errors = [((s.noisy - s.reference) ** 2 / (s.reference**2 + 0.01)).mean() for s in shown]
    assert score.noisy_relmse == pytest.approx(float(np.exp(np.log(errors).mean())), rel=1e-4)
    errors = [((s.denoised - s.reference) ** 2 / (s.reference**2 + 0.01)).mean() for s in shown]
    assert score.relmse == pytest.approx(float(np.exp(np.log(errors).mean())), rel=1e-4)
    assert score.front == pytest.approx(np.mean([s.front.mean() for s in shown]), rel=1e-4)


def test_validation_takes_the_middle_of_large_scenes(cache: SampleCache) -> None:
    result = validate(Denoiser(SMALL), cache, dataclasses.replace(QUICK, validation_size=32))
    assert result is not None
    middle = cache.arrays(cache.entries[0]).target[4:36, 4:36] * cache.entries[0].target_scale
    np.testing.assert_allclose(result[1][0].reference, middle, rtol=1e-5)


def test_pixels_without_samples_have_a_black_mean() -> None:
    samples = Samples((1, 1, 2), torch.tensor([0, 2]), torch.full((2,), 0.5), torch.ones(2),
                      {"radiance": torch.tensor([[1.0, 2.0, 3.0], [3.0, 4.0, 5.0]])})
    assert pixel_means(samples)[0, :, 0].T.tolist() == [[0, 0, 0], [2, 3, 4]]


def test_a_run_leaves_its_recipe_curve_and_panels(whole: Trainer) -> None:
    folder = whole.folder.folder
    assert sorted(path.name for path in folder.iterdir()) == sorted(
        [CHECKPOINT, RECIPE, CURVE, CURVE_PICTURE, PANELS])
    assert [row["step"] for row in curve_of(whole)] == [3, 6]
    assert sorted(path.name for path in (folder / PANELS).iterdir()) == ["step000003.png", "step000006.png"]
    for path in [folder / CURVE_PICTURE, *(folder / PANELS).iterdir()]:
        with Image.open(path) as image:
            assert image.width > 400
        assert path.stat().st_size < 1_500_000


def test_a_panel_shows_each_scene_in_five_pictures(cache: SampleCache) -> None:
    result = validate(Denoiser(SMALL), cache, QUICK)
    assert result is not None
    shown = result[1]
    with Image.open(io.BytesIO(panel_png(shown, 7))) as image:
        pixels = np.asarray(image).astype(int)
    times = PANEL_PIXELS // 40
    assert pixels.shape[1] == 5 * (40 * times + 4)
    reference = pixels[28:28 + 40 * times:times, 2 * (40 * times + 4):3 * (40 * times + 4) - 4:times]
    assert reference[-1, 0, 0] > reference[0, 0, 0] + 50  # red grows downward in the scene
    assert reference[0, -1, 1] > reference[0, 0, 1] + 20


def test_a_panel_survives_a_network_that_has_diverged(cache: SampleCache) -> None:
    result = validate(Denoiser(SMALL), cache, QUICK)
    assert result is not None
    broken = dataclasses.replace(result[1][0], denoised=np.full_like(result[1][0].denoised, np.nan))
    assert panel_png([broken], 1)
    rows = [{"step": float(k), "loss": np.nan, "relmse": np.nan, "smape": 0.1, "energy": 0.0, "front": 0.5,
             "noisy_relmse": 1.0, "noisy_smape": 0.2, "rate": 1e-3} for k in range(3)]
    assert curve_png(rows)


def test_checkpoints_of_other_runs_and_broken_ones_are_refused_by_name(whole: Trainer, tmp_path: Path) -> None:
    path = whole.folder.folder
    with pytest.raises(UsageError, match=f"{CHECKPOINT}: its network, 'fast', differs .* in generator; train"):
        Trainer(dataclasses.replace(SMALL, generator=(16,)), QUICK, path)
    other = dataclasses.replace(QUICK, seed=4, loss=LossWeights(smape=1.0))
    with pytest.raises(UsageError, match=rf"{CHECKPOINT}: .*differs in loss.smape, seed\)"):
        Trainer(SMALL, other, path)
    broken = tmp_path / CHECKPOINT
    for content in (b"", b"nothing", (path / CHECKPOINT).read_bytes()[:20000]):
        broken.write_bytes(content)
        with pytest.raises(InputError, match=f"{CHECKPOINT}: not a checkpoint"):
            Trainer(SMALL, QUICK, tmp_path)
    torch.save({"weights": 3}, broken)
    with pytest.raises(InputError, match=f"{CHECKPOINT}: not a checkpoint"):
        Trainer(SMALL, QUICK, tmp_path)


def test_checkpoints_from_before_a_recipe_had_a_field_are_resumed(whole: Trainer, tmp_path: Path) -> None:
    data = torch.load(whole.folder.folder / CHECKPOINT, weights_only=True)
    recipe = json.loads(data["recipe"])
    del recipe["muon"]
    (adam,) = data["optimizer"]["parts"]
    torch.save({**data, "recipe": json.dumps(recipe), "optimizer": adam}, tmp_path / CHECKPOINT)
    assert Trainer(SMALL, QUICK, tmp_path).step == QUICK.steps


def test_train_writes_weights_that_the_zoo_reads_and_training_starts_from(
    scenes: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    held = tmp_path / "held"
    held.mkdir()
    write_example(held, "other", 9)
    monkeypatch.setitem(train.__globals__["CONFIGS"], "small", SMALL)
    options = TrainOptions(scenes, held, tmp_path / "run", "small", QUICK, cache=tmp_path / "cache", threads=1)
    told: list[str] = []
    path = train(options, told.append)
    assert path is not None
    assert told[-1] == f"wrote {path}"
    weights = zoo.find(str(path))
    assert weights.info["steps"] == QUICK.steps
    assert weights.info["data"] == {"scenes": 3, "validation": 1}
    assert weights.info["recipe"] == QUICK.to_dict()
    assert weights.config == SMALL
    assert path.stat().st_mode == (tmp_path / "run" / RECIPE).stat().st_mode
    assert (tmp_path / "cache" / "training" / "index.json").exists()
    trained = starting_weights(path, SMALL)
    again = Trainer(SMALL, QUICK, tmp_path / "second", trained)
    for name, value in again.net.state_dict().items():
        assert torch.equal(value, trained[name])
    wider = dataclasses.replace(SMALL, name="wider", generator=tuple(2 * width for width in SMALL.generator))
    once, twice = (starting_weights(path, wider, seed=5) for _ in range(2))
    assert all(torch.equal(value, twice[name]) for name, value in once.items())


def test_a_network_with_fewer_layers_than_a_batch_asks_for_uses_all_it_has(cache: SampleCache, tmp_path: Path) -> None:
    recipe = dataclasses.replace(QUICK, layers=((3, 1.0),))
    net = dataclasses.replace(SMALL, partition_logits=2)
    assert np.isfinite(Trainer(net, recipe, tmp_path).advance(random_batch(cache, recipe, 0)))


def test_layers_in_order_of_depth_are_no_disorder_and_swapped_ones_are() -> None:
    def layers(front: float, back: float, share: float) -> Layers:
        plane = torch.tensor([front, back]).view(1, 2, 1, 1)
        weight = torch.tensor([share, 1 - share]).view(1, 2, 1, 1)
        return Layers(torch.zeros(1, 2, 3, 1, 1), weight, weight, plane, torch.zeros(1, 2, 0, 1, 1))

    assert float(disorder(layers(1.0, 2.0, 0.3))) == 0.0
    assert float(disorder(layers(2.0, 1.0, 0.3))) == pytest.approx(0.3 * (math.log(2) + 0.02))
    assert float(disorder(layers(2.0, 1.0, 0.0))) == 0.0  # nothing of one layer to be seen
    assert float(disorder(layers(2.0, math.inf, 0.3))) == 0.0  # a layer of misses


def test_the_gradient_of_disorder_is_bounded_where_a_layer_has_hardly_any_hits() -> None:
    """The depth is a quotient; by itself its derivative grows as 1 over the coverage, and one pixel would be a step."""
    planes = torch.zeros(1, 2, 6, 1, 1)
    planes[:, :, 5, 0, 0] = 0.5
    planes[0, :, 3, 0, 0] = torch.tensor([1e-12, 0.5])
    planes[0, :, 4, 0, 0] = torch.tensor([9e-12, 0.5])  # nine units away, in front of a layer one unit away
    planes.requires_grad_()
    disorder(to_layers(planes)).backward()
    assert planes.grad is not None
    assert 0 < planes.grad.abs().max() < 10
