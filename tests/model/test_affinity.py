"""The affinity filter against a per-pixel oracle in float64, its derivative, and its numerical range."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor

from model.affinity import affinity_filter, pool_cells, spline_logs


def b_spline(distance: float) -> float:
    """The quadratic B-spline over three cells, 0.75 at its centre."""
    distance = abs(distance)
    if distance <= 0.5:
        return 0.75 - distance**2
    return 0.5 * max(1.5 - distance, 0.0) ** 2


def oracle(features: Tensor, bias: Tensor, preference: Tensor, log_n: Tensor, values: Tensor,
           windows: tuple[int, ...]) -> Tensor:
    """The module's definition for one picture, one target, one level and one cell at a time; windows 1 or 3 wide
    above level 0. features (D, H, W), bias and preference (levels, H, W), log_n (H, W), values (C, H, W)."""
    height, width = log_n.shape
    out = torch.zeros_like(values)
    for ty in range(height):
        for tx in range(width):
            scores, found = [], []
            for level, window in enumerate(windows):
                size = 2**level
                for cy in range(ty // size - window // 2, ty // size + window // 2 + 1):
                    for cx in range(tx // size - window // 2, tx // size + window // 2 + 1):
                        rows = slice(max(cy * size, 0), max(cy * size + size, 0))
                        cols = slice(max(cx * size, 0), max(cx * size + size, 0))
                        logs = (log_n + bias[level])[rows, cols].flatten()
                        if logs.numel() == 0 or bool((logs == -math.inf).all()):
                            continue
                        share = torch.softmax(logs, 0)
                        value = (values[:, rows, cols].flatten(1) * share).sum(1)
                        spline = 1.0
                        if level > 0 and window > 1:
                            spline = (b_spline((ty + 0.5) / size - cy - 0.5) * b_spline((tx + 0.5) / size - cx - 0.5))
                        mean_occupancy = torch.logsumexp(logs, 0) - math.log(size * size)
                        apart = features[:, ty, tx, None] - features[:, rows, cols].flatten(1)
                        distance = (apart.square().sum(0) * share).sum()
                        scores.append(preference[level, ty, tx] + mean_occupancy + math.log(spline) - distance)
                        found.append(value)
            if scores:
                weights = torch.softmax(torch.stack(scores), 0)
                out[:, ty, tx] = (weights[:, None] * torch.stack(found)).sum(0)
    return out


def random_planes(seed: int, height: int, width: int, levels: int, spread: float = 1.0) -> list[Tensor]:
    draw = torch.Generator().manual_seed(seed)

    def normal(*shape: int) -> Tensor:
        return torch.randn(*shape, generator=draw, dtype=torch.float64)

    log_n = normal(1, height, width) * 3
    log_n[torch.rand(log_n.shape, generator=draw) < 0.3] = -math.inf
    return [normal(1, 3, height, width) * spread, normal(1, levels, height, width),
            normal(1, levels, height, width), log_n, normal(1, 2, height, width).exp()]


@pytest.mark.parametrize("windows", [(3,), (5,), (3, 3), (5, 1, 3), (1, 3, 3)])
@pytest.mark.parametrize("shape", [(6, 7), (1, 1), (1, 5), (9, 2)])
def test_filter_equals_the_definition(shape: tuple[int, int], windows: tuple[int, ...]) -> None:
    planes = random_planes(1, *shape, len(windows))
    expected = oracle(*(plane[0] for plane in planes), windows)
    torch.testing.assert_close(affinity_filter(*planes, windows)[0], expected)


def test_inactive_cells_are_left_out_and_still_serve_as_sources() -> None:
    planes = random_planes(4, 130, 200, 4)
    pair = [torch.cat([plane, plane.flip(-1)]) for plane in planes]
    expected = affinity_filter(*pair, (3, 3, 1, 3))
    active = torch.rand(2, 3, 4, generator=torch.Generator().manual_seed(5)) < 0.5
    wanted = active.repeat_interleave(64, 1).repeat_interleave(64, 2)[:, None, :130, :200]
    assert bool(wanted.any())
    with torch.no_grad():
        torch.testing.assert_close(affinity_filter(*pair, (3, 3, 1, 3)), expected)
        torch.testing.assert_close(affinity_filter(*pair, (3, 3, 1, 3), active), torch.where(wanted, expected, 0))


def test_active_cells_of_another_shape_or_with_a_gradient_are_refused() -> None:
    planes = random_planes(4, 65, 64, 1)
    with pytest.raises(ValueError, match=r"expected \(1, 2, 1\)"), torch.no_grad():
        affinity_filter(*planes, (3,), torch.ones(1, 1, 1, dtype=torch.bool))
    with pytest.raises(ValueError, match="no gradient"):
        affinity_filter(*planes, (3,), torch.ones(1, 2, 1, dtype=torch.bool))


def test_derivative_of_the_filter() -> None:
    features, bias, preference, log_n, values = random_planes(2, 4, 5, 2)
    known = log_n > -math.inf

    def run(features: Tensor, bias: Tensor, preference: Tensor, finite: Tensor, values: Tensor) -> Tensor:
        return affinity_filter(features, bias, preference, torch.where(known, finite, -math.inf), values, (3, 3))

    inputs = (features, bias, preference, torch.where(known, log_n, 0), values)
    assert torch.autograd.gradcheck(run, tuple(x.requires_grad_() for x in inputs))


@pytest.mark.parametrize("shift", [-1e4, -200.0, 200.0])
def test_occupancies_far_outside_single_precision(shift: float) -> None:
    features, bias, preference, log_n, values = random_planes(3, 8, 8, 3)
    expected = affinity_filter(features, bias, preference, log_n, values, (3, 3, 3))
    single = [plane.float() for plane in (features, bias, preference, log_n + shift, values)]
    torch.testing.assert_close(affinity_filter(*single, (3, 3, 3)).double(), expected, rtol=1e-2, atol=1e-4)


@pytest.mark.parametrize("window", [3, 5])
@pytest.mark.parametrize("size", [2, 4, 32])
def test_splines_are_a_partition_of_unity(size: int, window: int) -> None:
    # a wider window stretches the spline, so its cells sum to a constant only up to a common factor of window / 3
    total = spline_logs(size, window, torch.zeros(1, dtype=torch.float64)).exp().sum(0)
    torch.testing.assert_close(total, torch.full_like(total, window / 3), rtol=0.02, atol=0)


def test_pooling_ignores_empty_pixels_and_survives_tiny_occupancies() -> None:
    log_n = torch.tensor([[[-math.inf, -500.0], [-math.inf, -500.0]]])
    planes = torch.tensor([[[[7.0, 1.0], [7.0, 3.0]]]])
    occupancy, means = pool_cells(log_n, planes, 2)
    torch.testing.assert_close(means, torch.full((1, 1, 1, 1), 2.0))
    torch.testing.assert_close(occupancy, torch.full((1, 1, 1), -500 + math.log(0.5)))
    occupancy, means = pool_cells(torch.full((1, 2, 2), -math.inf), planes, 2)
    assert occupancy.item() == -math.inf
    assert means.item() == 0
