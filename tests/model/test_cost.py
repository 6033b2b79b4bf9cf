"""Analytic counts against the module's own hand count, PyTorch's counter, and the networks' actual parameters."""

from __future__ import annotations

import pytest
import torch
from torch.utils.flop_counter import FlopCounterMode

from model.config import CONFIGS, LAYER
from model.cost import count
from model.denoiser import Denoiser
from model.features import FrameScale
from tests.model.random_models import SMALL, random_network, random_samples


def test_layer_costs_what_the_hand_count_says() -> None:
    cost = count(LAYER)
    assert cost.parameters == 17_284_435
    stages = {stage.name: stage for stage in cost.stages}
    assert {name: stages[name].parameters for name in ("reducer", "partitioner", "generator")} == {
        "reducer": 2784, "partitioner": 5714, "generator": 74401,
    }
    assert cost.multiply_adds(samples=8, layers=2) == {
        "reducer": 8 * 2688,
        "statistics": 8 * 32,
        "unet": 794_880,
        "partitioner": 4096 + 8 * 1568,
        "splat": 8 * 2 * 38,
        "generator": 16384 + 2 * 57472,
        "filter": 2 * 1734,
    }


@pytest.mark.parametrize("name", sorted(CONFIGS))
def test_parameters_are_those_of_the_network(name: str) -> None:
    with torch.device("meta"):
        net = Denoiser(CONFIGS[name])
    assert count(CONFIGS[name]).parameters == sum(parameter.numel() for parameter in net.parameters())


@pytest.mark.parametrize("layers", [1, 2])
@pytest.mark.parametrize("name", sorted(SMALL))
def test_products_are_those_that_run(name: str, layers: int) -> None:
    config = SMALL[name]
    layers = min(layers, config.partition_logits)
    net = random_network(config, 1, torch.float32)
    samples = random_samples(1, (1, 16, 24), 3, dtype=torch.float32)
    with FlopCounterMode(display=False) as counter:
        net(samples, FrameScale(), layers)
    counted = count(config).multiply_adds(3, layers)
    # What the counter does not see: taps, and weighted sums over samples, matrix products in one variant only.
    unseen = ("filter",) if config.variant == "sample_splat" else ("filter", "splat", "statistics")
    seen = dict(counter.get_flop_counts()["Global"])
    if config.kernel == "affinity":  # batched products are its blocks', which are more than its taps, and its guides'
        unseen += ("guides",)
        del seen[torch.ops.aten.bmm]
    products = sum(value for stage, value in counted.items() if not stage.startswith(unseen))
    assert sum(seen.values()) == 2 * products * 16 * 24
