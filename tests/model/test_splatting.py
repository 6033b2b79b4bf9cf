"""Direct kernels against a per-pixel oracle, their derivative, and merging of partial results."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor

from model.splatting import RowMerger, kernel_filter, merge


def oracle(logits: Tensor, log_n: Tensor, values: Tensor, gather: bool) -> tuple[Tensor, Tensor]:
    """The definition, one target and one source at a time; values (B, K*K, C, H, W)."""
    batch, taps, height, width = logits.shape
    size, radius = round(math.sqrt(taps)), round(math.sqrt(taps)) // 2
    means = torch.zeros(batch, values.shape[2], height, width, dtype=logits.dtype)
    mass = torch.full((batch, height, width), -math.inf, dtype=logits.dtype)
    for b in range(batch):
        for ty in range(height):
            for tx in range(width):
                scores, found = [], []
                for sy in range(height):
                    for sx in range(width):
                        dy, dx = ty - sy + radius, tx - sx + radius
                        if 0 <= dy < size and 0 <= dx < size and log_n[b, sy, sx] > -math.inf:
                            tap = dy * size + dx
                            own = logits[b, tap, ty, tx] if gather else logits[b, tap, sy, sx]
                            scores.append(own + log_n[b, sy, sx])
                            found.append(values[b, tap, :, sy, sx])
                if scores:
                    stacked = torch.stack(scores)
                    mass[b, ty, tx] = torch.logsumexp(stacked, 0)
                    means[b, :, ty, tx] = (torch.softmax(stacked, 0)[:, None] * torch.stack(found)).sum(0)
    return means, mass


def random_planes(seed: int, batch: int, taps: int, height: int, width: int) -> tuple[Tensor, Tensor, Tensor]:
    draw = torch.Generator().manual_seed(seed)
    logits = torch.randn(batch, taps, height, width, generator=draw, dtype=torch.float64) * 3
    log_n = torch.randn(batch, height, width, generator=draw, dtype=torch.float64) * 4
    log_n[torch.rand(log_n.shape, generator=draw) < 0.4] = -math.inf
    values = torch.rand(batch, taps, 2, height, width, generator=draw, dtype=torch.float64)
    return logits, log_n, values


@pytest.mark.parametrize("gather", [False, True])
@pytest.mark.parametrize("shape", [(5, 4), (1, 1), (1, 7), (9, 2)])
def test_filter_equals_the_definition(shape: tuple[int, int], gather: bool) -> None:
    logits, log_n, values = random_planes(1, 2, 9, *shape)
    for per_tap in (values, values[:, :1].expand_as(values)):
        means, mass = kernel_filter(logits, log_n, per_tap if per_tap is values else values[:, 0], gather)
        expected_means, expected_mass = oracle(logits, log_n, per_tap, gather)
        torch.testing.assert_close(means, expected_means)
        torch.testing.assert_close(mass, expected_mass)


@pytest.mark.parametrize("gather", [False, True])
@pytest.mark.parametrize("per_tap", [False, True])
def test_derivative_of_the_filter(gather: bool, per_tap: bool) -> None:
    logits, log_n, values = random_planes(2, 1, 9, 3, 4)
    values = values if per_tap else values[:, 0]
    known = log_n > -math.inf

    def run(logits: Tensor, finite: Tensor, values: Tensor) -> tuple[Tensor, Tensor]:
        means, mass = kernel_filter(logits, torch.where(known, finite, -math.inf), values, gather)
        return means, torch.where(mass == -math.inf, 0, mass)

    inputs = (logits, torch.where(known, log_n, 0), values)
    assert torch.autograd.gradcheck(run, tuple(x.requires_grad_() for x in inputs))


def test_merged_halves_equal_the_whole() -> None:
    logits, log_n, values = random_planes(3, 2, 25, 6, 5)
    values = values[:, 0]
    left = torch.rand(log_n.shape, generator=torch.Generator().manual_seed(4)) < 0.5
    parts = [kernel_filter(logits, torch.where(half, log_n, -math.inf), values) for half in (left, ~left)]
    means, mass = merge(*parts)
    expected = kernel_filter(logits, log_n, values)
    torch.testing.assert_close(means, expected[0])
    torch.testing.assert_close(mass, expected[1])


@pytest.mark.parametrize("rows", [1, 2, 3, 7])
@pytest.mark.parametrize("gather", [False, True])
def test_blocks_of_rows_equal_the_whole(rows: int, gather: bool) -> None:
    logits, log_n, values = random_planes(5, 1, 25, 8, 5)
    values = values[:, 0]
    merger = RowMerger(torch.empty_like(values), torch.empty_like(log_n))
    for first in range(0, 8, rows):
        block = slice(first, first + rows)
        if gather:
            merger.gather(first, logits[:, :, block], log_n, values)
        else:
            merger.splat(first, logits[:, :, block], log_n[:, block], values[:, :, block])
    expected = kernel_filter(logits, log_n, values, gather)
    torch.testing.assert_close(merger.means, expected[0])
    torch.testing.assert_close(merger.mass, expected[1])


def test_huge_and_tiny_logits_stay_exact_in_single_precision() -> None:
    logits, log_n, values = random_planes(6, 1, 9, 5, 5)
    for shift in (-1e4, -300.0, 300.0, 1e4):
        means, mass = kernel_filter(logits.float(), (log_n + shift).float(), values[:, 0].float())
        expected = kernel_filter(logits, log_n, values[:, 0])[0]
        torch.testing.assert_close(means.double(), expected, rtol=5e-3, atol=5e-3)  # float32 steps are 1e-3 at 1e4
        assert torch.equal(mass == -math.inf, means.sum(1) == 0)


def test_even_kernels_are_refused() -> None:
    with pytest.raises(ValueError, match="odd"):
        kernel_filter(torch.zeros(1, 16, 2, 2), torch.zeros(1, 2, 2), torch.zeros(1, 1, 2, 2))
