"""Compositing front to back and jointly, mixing of levels, and the filling of holes."""

from __future__ import annotations

import math

import pytest
import torch
import torch.nn.functional as F
from torch import Tensor

from model.compositing import Layers, composite, fill_holes, mix_levels, to_layers


def random_means(seed: int, layers: int, height: int, width: int) -> Tensor:
    means = torch.rand(1, layers, 6, height, width, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    means[:, :, 3] *= means[:, :, 5]  # coverage is at most the share
    means[:, -1, 5] = 1  # the background is opaque
    return means


def test_front_to_back_is_the_over_operator() -> None:
    means = random_means(1, 4, 3, 2)
    visible = composite(means)
    expected, through = torch.zeros(3, 3, 2, dtype=torch.float64), torch.ones(3, 2, dtype=torch.float64)
    for layer in means[0]:
        expected = expected + through * layer[:3]
        through = through * (1 - layer[5])
    torch.testing.assert_close(visible[0, :, :3].sum(0), expected)
    torch.testing.assert_close(visible[:, :, 5].sum(1), torch.ones(1, 3, 2, dtype=torch.float64))
    assert bool((visible[:, :, 3] <= visible[:, :, 5]).all())


def test_joint_compositing_averages_layers_by_their_mass() -> None:
    means = random_means(2, 3, 2, 2)
    mass = torch.tensor([0.0, -1000.0, -math.inf], dtype=torch.float64)[None, :, None, None].expand(1, 3, 2, 2).clone()
    mass[..., 1, 1] = -math.inf
    visible = composite(means, mass)
    torch.testing.assert_close(visible[:, 0, :5, 0], means[:, 0, :5, 0])
    assert bool((visible[..., 1, 1] == 0).all())
    assert bool((visible[:, 2] == 0).all())


def test_a_pyramid_mixes_finished_levels_and_skips_those_that_reach_nothing() -> None:
    fine, coarse = composite(random_means(3, 2, 8, 8)), composite(random_means(4, 2, 4, 4))
    preference = torch.randn(1, 2, 8, 8, dtype=torch.float64)
    mixed = mix_levels([fine, coarse], preference)
    up = F.interpolate(coarse.flatten(1, 2), size=(8, 8), mode="bilinear", align_corners=False).view_as(fine)
    lam = torch.softmax(preference, 1)[:, :, None, None]  # (1, levels, 1, 1, 8, 8)
    torch.testing.assert_close(mixed, lam[:, 0] * fine + lam[:, 1] * up)
    fine[..., :3] = 0  # no sample in reach there
    mixed = mix_levels([fine, coarse], preference)
    torch.testing.assert_close(mixed[..., :3], up[..., :3])
    torch.testing.assert_close(mix_levels([fine, torch.zeros_like(coarse)], preference), fine)


def test_depth_is_that_of_the_hits_or_infinite() -> None:
    visible = torch.zeros(1, 1, 6, 1, 2)
    visible[0, 0, :, 0, 0] = torch.tensor([1.0, 1.0, 1.0, 0.5, 3.5, 1.0])
    assert to_layers(visible).depth[0, 0, 0].tolist() == [7.0, math.inf]


@pytest.mark.parametrize(("height", "width"), [(7, 5), (1, 9), (1, 1), (16, 16)])
def test_holes_take_the_mean_of_the_smallest_cell_that_has_any(height: int, width: int) -> None:
    visible = torch.zeros(1, 2, 6, height, width)
    visible[0, :, :, 0, 0] = torch.tensor([[2.0, 2.0, 2.0, 0.25, 1.0, 0.25], [6.0, 6.0, 6.0, 0.5, 5.0, 0.75]])
    filled = fill_holes(to_layers(visible))
    torch.testing.assert_close(filled.beauty(), torch.full((1, 3, height, width), 8.0))
    torch.testing.assert_close(filled.alpha(), torch.full((1, height, width), 0.75))
    torch.testing.assert_close(filled.depth[0, 0], torch.full((height, width), 4.0))


def test_filling_leaves_reached_pixels_and_empty_pictures_alone() -> None:
    visible = composite(random_means(5, 2, 6, 6)).float()
    visible[..., 2:4, 2:4] = 0
    layers = to_layers(visible)
    filled = fill_holes(layers)
    kept = torch.ones(6, 6, dtype=torch.bool)
    kept[2:4, 2:4] = False
    torch.testing.assert_close(filled.color[..., kept], layers.color[..., kept])
    torch.testing.assert_close(filled.weight.sum(1), torch.ones(1, 6, 6))
    nothing: Layers = to_layers(torch.zeros(1, 2, 6, 4, 4))
    assert bool((fill_holes(nothing).color == 0).all())
    assert bool((fill_holes(nothing).weight == 0).all())


def test_a_layer_with_hardly_any_coverage_has_a_gradient() -> None:
    """Its depth is a quotient of two vanishing numbers; the square of the lower one is 0 in float32."""
    visible = torch.zeros(1, 2, 6, 1, 2)
    visible[:, :, 5] = 0.5
    visible[:, :, 3] = torch.tensor([0.5, 1e-30])  # the second pixel's layers hardly cover it
    visible[:, :, 4] = visible[:, :, 3] * 7
    visible.requires_grad_()
    layers = to_layers(visible)
    torch.testing.assert_close(layers.depth.detach(), torch.full((1, 2, 1, 2), 7.0))
    layers.depth.log().sum().backward()
    assert visible.grad is not None
    assert visible.grad.isfinite().all()
    assert visible.grad[0, 0, 4, 0, 0] != 0
