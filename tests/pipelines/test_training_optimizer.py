"""What is trained and how: every parameter moves, Muon steps as far as Adam, and a run with it resumes."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import pytest
import torch

from deep_io.errors import UsageError
from model.config import FAST
from model.denoiser import Denoiser
from pipelines.training.batches import random_batch
from pipelines.training.cache import SampleCache
from pipelines.training.caching import build_cache
from pipelines.training.loop import Trainer
from pipelines.training.optimizer import make_optimizer
from tests.pipelines.training_data import QUICK, SMALL, write_example

MUON = dataclasses.replace(QUICK, muon=True)
RATE = 1e-3


@pytest.fixture(scope="module")
def cache(tmp_path_factory: pytest.TempPathFactory) -> SampleCache:
    data = tmp_path_factory.mktemp("data")
    for number in range(2):
        write_example(data, f"scene{number}", number)
    return build_cache(data, tmp_path_factory.mktemp("cache"))


def test_every_parameter_is_stepped_and_hidden_matrices_in_all_directions_alike() -> None:
    torch.manual_seed(0)
    net = Denoiser(FAST)
    before = [p.detach().clone() for p in net.parameters()]
    optimizer = make_optimizer(net, MUON)
    optimizer.set_rate(RATE)
    sum((p * torch.randn_like(p)).sum() for p in net.parameters()).backward()
    optimizer.step()
    steps = {name: (p.detach() - old) for (name, p), old in zip(net.named_parameters(), before, strict=True)}
    for name, step in steps.items():
        assert step.abs().max() > 0, name
        assert 0.05 * RATE < step.square().mean().sqrt() < 1.1 * RATE, name
    hidden = steps["unet.encoder.1.convolutions.0.weight"].flatten(1)
    values = torch.linalg.svdvals(hidden)
    assert values.max() < 3 * values.min()  # 5 rounds of Newton and Schulz bring them near to each other
    optimizer.zero_grad()
    assert all(p.grad is None for p in net.parameters())


def test_a_run_with_muon_resumes_to_the_uninterrupted_one(tmp_path: Path, cache: SampleCache) -> None:
    whole = Trainer(SMALL, MUON, tmp_path / "whole")
    whole.run(cache, cache, lambda _: None)
    Trainer(SMALL, MUON, tmp_path / "parts").run(cache, cache, lambda _: None, seconds=0)
    interrupted = Trainer(SMALL, MUON, tmp_path / "parts")
    with pytest.raises(KeyboardInterrupt):
        interrupted.run(cache, cache, _raise_interrupt)
    resumed = Trainer(SMALL, MUON, tmp_path / "parts")
    assert 0 < resumed.step < MUON.steps
    resumed.run(cache, cache, lambda _: None)
    for mine, theirs in zip(whole.averaged.parameters(), resumed.averaged.parameters(), strict=True):
        assert torch.equal(mine, theirs)


def _raise_interrupt(_: str) -> None:
    raise KeyboardInterrupt


def test_a_pytorch_without_muon_is_refused_in_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delattr(torch.optim, "Muon")
    with pytest.raises(UsageError, match=r"PyTorch 2\.9"):
        make_optimizer(Denoiser(SMALL), MUON)
    make_optimizer(Denoiser(SMALL), QUICK)


@pytest.mark.parametrize("muon", [False, True])
def test_only_the_part_that_is_asked_for_is_trained(tmp_path: Path, cache: SampleCache, muon: bool) -> None:
    recipe = dataclasses.replace(QUICK, only="generator", muon=muon)
    trainer = Trainer(SMALL, recipe, tmp_path)
    before = {name: value.clone() for name, value in trainer.averaged.state_dict().items()}
    for _ in range(2):
        trainer.advance(random_batch(cache, recipe, trainer.step))
    for name, value in trainer.averaged.state_dict().items():
        assert torch.equal(value, before[name]) == (not name.startswith("generator.")), name
