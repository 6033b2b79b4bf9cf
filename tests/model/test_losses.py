"""Training losses against values worked out by hand."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch

from model import losses
from model.losses import LossWeights, smape, smoothed, tone_mapped, total_loss


def picture(value: float) -> torch.Tensor:
    return torch.full((1, 3, 4, 4), value)


def test_the_tone_mapped_error_is_that_of_srgb_of_the_logarithm() -> None:
    def curve(value: float) -> float:
        return 1.055 * math.log1p(value) ** (1 / 2.4) - 0.055

    assert float(tone_mapped(picture(1.0), picture(3.0))) == pytest.approx((curve(1.0) - curve(3.0)) ** 2, rel=1e-5)
    assert float(tone_mapped(picture(-1.0), picture(0.0))) == 0.0


def test_the_total_is_the_weighted_sum_of_the_terms_asked_for() -> None:
    one, other = picture(1.0), picture(3.0)
    smape = LossWeights(smape=1.0, relative=0.0, pooled=())
    assert float(total_loss(one, other, smape)) == pytest.approx(2 / 4.01)
    toned = LossWeights(smape=0.0, relative=0.0, tone_mapped=2.0, pooled=())
    assert float(total_loss(one, other, toned)) == pytest.approx(2 * float(tone_mapped(one, other)))


def minimum(weights: LossWeights, targets: torch.Tensor) -> float:
    """The constant picture at which the gradient of the mean loss over noisy targets (B, 3, H, W) vanishes."""
    low, high = 0.05, 3.0
    for _ in range(14):
        level = torch.tensor((low + high) / 2, requires_grad=True)
        total_loss(level.expand_as(targets), targets, weights).backward()
        assert level.grad is not None
        low, high = (low, level.item()) if level.grad > 0 else (level.item(), high)
    return (low + high) / 2


def test_only_the_noise2noise_error_has_its_minimum_at_the_mean_of_noisy_targets() -> None:
    generator = torch.Generator().manual_seed(1)
    targets = -torch.log(torch.rand((4, 3, 16, 16), generator=generator).clamp_min(1e-6))  # mean 1, median 0.69
    plain = LossWeights(smape=0.0, relative=0.0, pooled=())
    assert minimum(replace(plain, noise2noise=1.0), targets) == pytest.approx(float(targets.mean()), rel=0.03)
    assert minimum(replace(plain, smape=1.0), targets) < 0.9
    assert minimum(replace(plain, tone_mapped=1.0), targets) < 0.95
    assert minimum(replace(plain, pooled=((16, 1.0),)), targets) == pytest.approx(1.0, rel=0.06)


def test_a_firefly_in_the_target_does_not_own_the_logarithmic_term() -> None:
    weights = LossWeights(smape=0.0, relative=1.0, pooled=())
    prediction = torch.full((1, 3, 8, 8), 0.5, requires_grad=True)
    target = torch.full((1, 3, 8, 8), 0.6)
    target[0, :, 4, 4] = 1e5
    total_loss(prediction, target, weights).backward()
    assert prediction.grad is not None
    size = prediction.grad.abs()
    assert float(size[0, 0, 4, 4]) < 200 * float(size[0, 0, 0, 0])


def test_the_loss_of_a_batch_is_the_mean_of_its_crops_losses() -> None:
    """Processes that share a batch rely on it."""
    generator = torch.Generator().manual_seed(2)
    prediction, target = (torch.rand((3, 3, 32, 32), generator=generator) for _ in range(2))
    weights = LossWeights(noise2noise=0.3, tone_mapped=0.2)
    parts = [float(total_loss(prediction[k : k + 1], target[k : k + 1], weights)) for k in range(3)]
    assert float(total_loss(prediction, target, weights)) == pytest.approx(sum(parts) / 3, rel=1e-5)


@pytest.mark.parametrize("term", ["smape", "relative", "leaks", "noise2noise", "tone_mapped"])
def test_a_black_prediction_has_a_finite_gradient(term: str) -> None:
    weights = replace(LossWeights(smape=0.0, relative=0.0, pooled=()), **{term: 1.0})
    prediction = torch.zeros((1, 3, 4, 4), requires_grad=True)
    total_loss(prediction, picture(0.5), weights).backward()
    assert prediction.grad is not None
    assert torch.isfinite(prediction.grad).all()
    assert bool((prediction.grad != 0).any())


def test_a_lamp_that_leaks_into_the_dark_is_measured_by_the_dark() -> None:
    relative = LossWeights(smape=0.0, relative=1.0, pooled=())
    expected = 19.5**2 / (2.1**2 + 0.01)  # 4 * 0.5 + 0.1 rather than 20
    saturated = math.log(expected / (1 + expected / 100) + 1e-3)
    assert float(total_loss(picture(20.0), picture(0.5), relative)) == pytest.approx(saturated, rel=1e-5)


def test_a_pooled_cell_larger_than_the_picture_is_the_picture() -> None:
    draw = torch.Generator().manual_seed(4)
    prediction, target = (torch.rand(2, 3, 12, 16, generator=draw) for _ in range(2))
    weights = LossWeights(smape=0.0, relative=0.0, pooled=((64, 1.0),))
    blocks = [picture[..., :12, :12].mean((2, 3)) for picture in (prediction, target)]  # square cells, the rest is cut
    assert float(total_loss(prediction, target, weights)) == pytest.approx(float(smape(*blocks)), rel=1e-4)


def test_a_leak_counts_by_the_dark_it_is_in_and_by_its_own_size_at_most() -> None:
    leaks = LossWeights(smape=0.0, leaks=1.0, relative=0.0, pooled=())

    def expected(prediction: float, divisor: float) -> float:
        error = (prediction - 0.5) ** 2 / (divisor**2 + 0.01)
        return math.log(error / (1 + error / 30) + 1e-3)

    assert float(total_loss(picture(1.0), picture(0.5), leaks)) == pytest.approx(expected(1.0, 0.5), rel=1e-5)
    assert float(total_loss(picture(20.0), picture(0.5), leaks)) == pytest.approx(expected(20.0, 5.0), rel=1e-5)


def test_the_noise_of_a_reference_hardly_moves_the_minimum_of_leaks() -> None:
    """Divided by the noisy reference itself, the minimum would be E[1 / y] / E[1 / y^2], 8 % below the mean."""
    draw = torch.Generator().manual_seed(5)
    targets = 1 + 0.2 * torch.randn((4, 3, 32, 32), generator=draw)
    leaks = LossWeights(smape=0.0, leaks=1.0, relative=0.0, pooled=())
    assert minimum(leaks, targets) == pytest.approx(1.0, abs=0.02)


def test_smoothing_takes_noise_and_leaves_edges() -> None:
    draw = torch.Generator().manual_seed(6)
    clean = torch.full((1, 3, 32, 32), 0.2)
    clean[..., 16:] = 20.0
    noisy = clean * (1 + 0.2 * torch.randn(clean.shape, generator=draw))  # of each colour; a mean of 9 has 0.067
    error = (smoothed(noisy) / clean - 1).square().mean((0, 1, 2)).sqrt()  # (32,) by distance from the edge
    assert float(error.max()) < 0.12
    assert float(error.mean()) < 0.06


def test_darkness_is_the_share_of_light_that_is_lost_with_one_slope_up_to_twice_the_light() -> None:
    weights = LossWeights(smape=0.0, darkness=1.0, relative=0.0, pooled=())
    assert float(total_loss(picture(0.3), picture(0.4), weights)) == pytest.approx(0.25)
    assert float(total_loss(picture(0.5), picture(0.4), weights)) == pytest.approx(-0.25)
    assert float(total_loss(picture(0.5), picture(0.0), weights)) == 0.0
    assert float(total_loss(picture(1.3), picture(0.5), weights)) == -1.0
    slopes = []
    for value in (0.1, 0.7, 1.3):
        prediction = torch.full((1, 3, 4, 4), value, requires_grad=True)
        total_loss(prediction, picture(0.5), weights).backward()
        assert prediction.grad is not None
        slopes.append(prediction.grad)
    torch.testing.assert_close(slopes[0], slopes[1])
    assert bool((slopes[0] < 0).all())
    assert bool((slopes[2] == 0).all())
    lamp = picture(0.4)
    lamp[..., 1, 1] = 300.0
    larger = lamp.clone()
    larger[..., 1, 2] = 300.0  # its edge
    assert -0.3 < float(total_loss(larger, lamp, weights)) < 0
    assert float(total_loss(2 * lamp, lamp, weights)) > -1
    red = picture(0.4) * torch.tensor([1.0, 0.0, 0.0])[:, None, None]
    assert float(total_loss(picture(0.3), red, weights)) == pytest.approx(0.25 / 3)


def test_held_error_is_least_at_the_clean_picture_whatever_the_noise() -> None:
    torch.manual_seed(0)
    clean = torch.rand(1, 3, 64, 64, dtype=torch.float64) + 0.5
    noise = torch.randn(1, 3, 64, 64, dtype=torch.float64)
    known = torch.ones(1, 1, 64, 64, dtype=torch.bool)
    slopes = []
    for factor in (0.9, 1.0, 1.1):
        gain = torch.tensor(factor, dtype=torch.float64, requires_grad=True)
        losses.held_error(clean * gain, clean + noise, torch.ones_like(clean), known).backward()
        assert gain.grad is not None
        slopes.append(float(gain.grad))
    assert slopes[0] < -0.03
    assert abs(slopes[1]) < 0.02
    assert slopes[2] > 0.03


def test_held_error_counts_known_pixels_alone_and_noisy_ones_little() -> None:
    prediction, held = torch.ones(1, 3, 4, 4), torch.full((1, 3, 4, 4), 2.0)
    known = torch.ones(1, 1, 4, 4, dtype=torch.bool)
    plain = losses.held_error(prediction, held, torch.zeros_like(held), known)
    assert float(plain) == pytest.approx(1 / 1.01)
    held[..., 0] = 1e6
    known[..., 0] = False
    assert float(losses.held_error(prediction, held, torch.zeros_like(held), known)) == pytest.approx(1 / 1.01)
    noisy = losses.held_error(prediction, held, torch.full_like(held, 98.99), known)
    assert float(noisy) == pytest.approx(0.01)


def test_drift_counts_where_the_samples_tell_nothing() -> None:
    start = torch.ones(1, 3, 4, 4)
    moved = start * 1.1
    assert float(losses.drift(moved, start, torch.zeros_like(start))) == 0
    assert float(losses.drift(moved, start, torch.full_like(start, 1e6))) == pytest.approx(0.01 / 1.01, rel=1e-4)
    assert float(losses.drift(start, start, torch.ones_like(start))) == 0
