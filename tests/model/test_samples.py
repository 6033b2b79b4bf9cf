"""Segment reductions against loops over pixels, and what `Samples` refuses."""

from __future__ import annotations

import math
from typing import Any

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from model.samples import Samples, Segments, Turns


def pieces(counts: list[int], values: Tensor) -> list[Tensor]:
    return list(values.split(counts))


@settings(max_examples=40, deadline=None, derandomize=True)
@given(st.lists(st.integers(0, 4), min_size=1, max_size=8) | st.integers(1, 5).map(lambda n: [n] * 4))
def test_reductions_equal_a_loop_over_pixels(counts: list[int]) -> None:
    draw = torch.Generator().manual_seed(sum(counts))
    values = torch.randn(sum(counts), 3, generator=draw, dtype=torch.float64)
    weight = torch.rand(sum(counts), 2, generator=draw, dtype=torch.float64)
    segments = Segments(torch.tensor(counts, dtype=torch.int32))
    parts, weights = pieces(counts, values), pieces(counts, weight)
    torch.testing.assert_close(segments.sum(values), torch.stack([part.sum(0) for part in parts]))
    lowest = torch.full((3,), -math.inf, dtype=torch.float64)
    expected = torch.stack([part.amax(0) if len(part) else lowest for part in parts])
    torch.testing.assert_close(segments.max(values), expected)
    products = torch.stack([own.T @ part for own, part in zip(weights, parts, strict=True)])
    torch.testing.assert_close(segments.weighted_sum(weight, values), products)
    numbered = torch.arange(len(counts), dtype=torch.float64)[:, None]
    torch.testing.assert_close(segments.expand(numbered), numbered.repeat_interleave(torch.tensor(counts), 0))


@pytest.mark.parametrize("count", [1, 3])
def test_reductions_by_turns_equal_those_in_pixel_order(count: int) -> None:
    draw = torch.Generator().manual_seed(count)
    counts = torch.full((5,), count)
    values, weight = (torch.randn(5 * count, width, generator=draw, dtype=torch.float64) for width in (3, 2))
    given = Samples((1, 1, 5), counts, weight[:, 0], weight[:, 1], {"radiance": values}, extra=weight)
    turned = given.by_turns()
    assert turned.turns
    torch.testing.assert_close(turned.in_pixel_order(turned.like(values)), values, rtol=0, atol=0)
    for mine, theirs in ((turned.weight, given.weight), (turned.coverage, given.coverage)):
        torch.testing.assert_close(turned.in_pixel_order(mine[:, None])[:, 0], theirs, rtol=0, atol=0)
    mine, theirs, radiance = turned.segments, given.segments, turned.roles["radiance"]
    assert turned.extra is not None
    torch.testing.assert_close(mine.sum(radiance), theirs.sum(values))
    torch.testing.assert_close(mine.max(radiance), theirs.max(values))
    torch.testing.assert_close(mine.weighted_sum(turned.extra, radiance), theirs.weighted_sum(weight, values))
    per_pixel = torch.randn(5, 4, generator=draw)
    torch.testing.assert_close(mine.expand(per_pixel), turned.like(theirs.expand(per_pixel)))


def test_derivative_of_weighted_sums_by_turns() -> None:
    draw = torch.Generator().manual_seed(3)
    weight, values = (torch.randn(6, width, generator=draw, dtype=torch.float64).requires_grad_() for width in (2, 3))
    turns = Turns(torch.full((3,), 2))
    assert torch.autograd.gradcheck(turns.weighted_sum, (weight, values))


def test_samples_of_uneven_pixels_stay_in_pixel_order() -> None:
    uneven = samples()
    assert uneven.by_turns() is uneven


def samples(**changes: Any) -> Samples:
    fields: dict[str, Any] = {
        "shape": (1, 1, 2), "counts": torch.tensor([1, 2]), "weight": torch.tensor([1.0, 0.5, 0.5]),
        "coverage": torch.ones(3), "roles": {"radiance": torch.ones(3, 3)},
    }
    return Samples(**{**fields, **changes})


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"shape": (1, 2, 2)}, "2 counts for 1x2x2"),
        ({"roles": {"depth": torch.ones(3, 1)}}, "radiance role is required"),
        ({"roles": {"radiance": torch.ones(3, 3), "colour": torch.ones(3, 3)}}, "unknown role 'colour'"),
        ({"roles": {"radiance": torch.ones(3, 1)}}, "role radiance"),
    ],
)
def test_inconsistent_samples_are_refused(changes: dict[str, object], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        samples(**changes)
