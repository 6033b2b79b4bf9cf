"""The splat of samples to layers against a loop in plain float64, its range, and the depth prior."""

from __future__ import annotations

import math

import pytest
import torch
import torch.nn.functional as F

from model.features import FrameScale
from model.partition import (
    PRIOR_LIMIT,
    initial_logits,
    kept_logits,
    layer_positions,
    log_sum_behind,
    mixture,
    relative_depth,
    share_of,
    splat,
    window_sums,
)
from model.samples import Segments
from tests.model.random_models import random_counts, random_samples, with_roles

COUNTS = random_counts(1, 12, 4, 0.3)
SEGMENTS = Segments(COUNTS)
TOTAL = int(COUNTS.sum())


def random_rows(columns: int, seed: int) -> torch.Tensor:
    return torch.randn(TOTAL, columns, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def test_splat_equals_the_sums_it_stands_for() -> None:
    weight, values = torch.rand(TOTAL, 1, dtype=torch.float64) + 0.1, random_rows(2, 1)
    partition = torch.softmax(random_rows(3, 2), 1)
    result = splat(weight.log(), partition.log(), values, SEGMENTS)
    start = 0
    for pixel, count in enumerate(COUNTS.tolist()):
        w, p, v = (plane[start : start + count] for plane in (weight, partition, values))
        start += count
        own = (w * p).sum(0)  # (L,)
        occupancy = own.flip(0).cumsum(0).flip(0)
        if count == 0:
            assert bool((result.log_n[pixel] == -math.inf).all())
            assert bool((result.log_w[pixel] == -math.inf).all())
            assert bool((result.values[pixel] == 0).all())
            continue
        torch.testing.assert_close(result.log_n[pixel].exp(), occupancy)
        torch.testing.assert_close(result.log_w[pixel].exp(), own)
        torch.testing.assert_close(result.values[pixel], (w * p).T @ v / occupancy[:, None])


def test_splat_is_exact_for_weights_far_below_single_precision() -> None:
    log_weight = torch.full((TOTAL, 1), -300.0)
    log_partition = torch.log_softmax(random_rows(3, 3) * 50, 1)
    values = random_rows(2, 4)
    low = splat(log_weight, log_partition.float(), values.float(), SEGMENTS)
    exact = splat(torch.zeros(TOTAL, 1, dtype=torch.float64), log_partition, values, SEGMENTS)
    some = exact.log_n > -math.inf
    torch.testing.assert_close(low.log_n[some].double() + 300, exact.log_n[some], rtol=0, atol=1e-4)
    torch.testing.assert_close(low.values[some].double(), exact.values[some], rtol=1e-4, atol=1e-5)


def test_mixture_is_a_weighted_mean_and_the_log_of_its_weight() -> None:
    log_weight, values = random_rows(4, 5) * 3, random_rows(2, 6)
    log_sum, means = mixture(log_weight - 1000, values, SEGMENTS)
    start = 0
    for pixel, count in enumerate(COUNTS.tolist()):
        logs, part = log_weight[start : start + count], values[start : start + count]
        start += count
        if count == 0:
            assert bool((log_sum[pixel] == -math.inf).all())
            assert bool((means[pixel] == 0).all())
            continue
        torch.testing.assert_close(log_sum[pixel] + 1000, torch.logsumexp(logs, 0))
        torch.testing.assert_close(means[pixel], torch.softmax(logs, 0).T @ part)


@pytest.mark.parametrize(("layers", "kept"), [(1, [4]), (2, [0, 4]), (3, [0, 1, 4]), (5, [0, 1, 2, 3, 4])])
def test_the_background_is_always_the_last_logit(layers: int, kept: list[int]) -> None:
    assert kept_logits(layers, 5) == kept
    with pytest.raises(ValueError, match="0 layers"):
        kept_logits(0, 5)


def test_prior_sends_near_samples_to_front_layers_and_far_ones_to_the_back() -> None:
    relative = torch.tensor([[-2.0], [0.0], [2.0]])
    partition = torch.softmax(torch.as_tensor(initial_logits(relative, torch.tensor(1.5), [0, 2], 3)), 1)
    assert partition[0, 0] > 0.9
    assert partition[1, 0] == 0.5
    assert partition[2, 1] > 0.9
    assert layer_positions(1, relative).tolist() == [1.0]
    assert layer_positions(3, relative).tolist() == [-1.0, 0.0, 1.0]


def test_relative_depth_knows_front_from_back_whatever_the_unit() -> None:
    samples = random_samples(2, (1, 8, 8), 2)
    near = torch.arange(128) % 2 == 0
    samples.coverage[:] = 1
    samples.coverage[10] = 0
    samples = with_roles(samples, depth=torch.where(near, 1.0, 5.0).double()[:, None])
    relative = relative_depth(samples, Segments(samples.counts), FrameScale(depth=2.0))[:, 0]
    assert relative[10] == PRIOR_LIMIT  # a miss is behind everything
    near[10] = False
    assert bool((relative[near] < -0.5).all())
    assert bool((relative[~near] > 0.5).all())
    far = with_roles(samples, depth=samples.roles["depth"] * 1e3)
    again = relative_depth(far, Segments(samples.counts), FrameScale(depth=2e3))[:, 0]
    torch.testing.assert_close(again, relative)


def test_the_sky_is_behind_also_where_nothing_was_hit() -> None:
    samples = random_samples(3, (1, 3, 3), 2)
    samples.coverage[:] = 0
    assert bool((relative_depth(samples, Segments(samples.counts), FrameScale()) == PRIOR_LIMIT).all())


@pytest.mark.parametrize(("height", "width"), [(1, 1), (2, 12), (11, 7)])
def test_window_sums_are_those_of_a_pooling_window(height: int, width: int) -> None:
    picture = torch.rand(2, 3, height, width, generator=torch.Generator().manual_seed(6), dtype=torch.float64)
    expected = F.avg_pool2d(picture, 9, 1, 4) * 81
    torch.testing.assert_close(window_sums(picture, 9), expected)


def test_logs_of_sums_behind_each_layer() -> None:
    partition = torch.softmax(torch.randn(6, 4, generator=torch.Generator().manual_seed(7), dtype=torch.float64), 1)
    expected = partition.flip(1).cumsum(1).flip(1)
    torch.testing.assert_close(log_sum_behind(partition.log()).exp(), expected)


def test_a_share_that_is_too_small_to_divide_by_is_none() -> None:
    """A mean is a sum over the share, its derivative one over the share's square: 0/0 in float32 below 1e-19."""
    log_w = torch.tensor([-100.0, -30.0, -torch.inf], requires_grad=True)
    share = share_of(torch.zeros(3), log_w)
    assert share[0] == 0 == share[2]
    assert share[1].item() == pytest.approx(math.exp(-30))
    total = torch.exp(log_w.detach()).requires_grad_()
    (total / torch.where(share > 0, share, 1)).sum().backward()
    for values in (log_w, total):
        assert values.grad is not None
        assert values.grad.isfinite().all()
