"""Texture: the light that falls in is averaged across surfaces, their texture is the target's own."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
import torch.nn.functional as F
from torch import Tensor, nn

from model.config import DIVISOR_WINDOW, Config
from model.denoiser import Denoiser
from model.features import FrameScale
from model.guided import generator_sizes
from model.samples import Samples
from tests.model.random_models import SMALL, random_network, random_samples

MEASURED = replace(SMALL["fast"], confidence=False)  # its weights would favour dark samples
CONFIG = replace(MEASURED, texture_reliability=False)
HEIGHT, WIDTH = 18, 24
LIGHT = torch.tensor([0.4, 1.5, 6.0], dtype=torch.float64)
MIX, TRUST = sum(generator_sizes(CONFIG)[:5]), -1  # rows of what is predicted


def _denoised(samples: Samples, mix: float = 0.0, trust: float = -50.0, config: Config = CONFIG) -> Tensor:
    """(3, H, W) in one layer by wide kernels that take no notice of surfaces.

    mix : far below 0 the plain path, far above 0 the target's own texture; `trust` far above 0: as measured instead
    """
    net: Denoiser = random_network(config, 4)
    last = net.generator.layers[-1]
    assert isinstance(last, nn.Linear)
    with torch.no_grad():
        net.guide_matrix.zero_()
        last.weight.zero_()
        last.bias.zero_()[MIX] = mix
        last.bias[TRUST] = trust
        result: Tensor = net(samples, FrameScale(1.0, 2.0), 1).beauty()[0]
    return result


def _two_surfaces_in_each_pixel(texture: float = 0.05) -> tuple[Samples, Tensor]:
    """Samples of two albedos in each pixel, lit so that only its mean is albedo times light, and (3, H, W) its albedo.

    A dark half beside a light one, and a texture of single pixels on both, so strong.
    """
    draw = torch.Generator().manual_seed(1)
    albedo = 0.05 + texture * torch.rand(HEIGHT, WIDTH, 2, 3, generator=draw, dtype=torch.float64)
    albedo[:, WIDTH // 2 :] += 0.8
    samples = random_samples(2, (1, HEIGHT, WIDTH), 2)
    samples = replace(samples, coverage=torch.ones_like(samples.coverage), weight=torch.full_like(samples.weight, 0.5))
    samples.roles["depth"] = torch.full_like(samples.roles["depth"], 2.0)
    samples.roles["albedo"] = albedo.reshape(-1, 3)
    samples.roles["specular"] = torch.zeros_like(samples.roles["specular"])
    samples.roles["radiance"] = LIGHT * albedo.flip(2).reshape(-1, 3)  # the dark of the two shows the other's light
    return samples, albedo.mean(2).permute(2, 0, 1)


def _is_of_the_neighbourhood(picture: Tensor, albedo: Tensor) -> Tensor:
    """(3, H, W) bool: whether a pixel is within the albedos of the divisor's window."""
    around = F.pad(albedo, (DIVISOR_WINDOW // 2,) * 4, mode="replicate")
    lightest = F.max_pool2d(around, DIVISOR_WINDOW, 1)
    darkest = -F.max_pool2d(-around, DIVISOR_WINDOW, 1)
    return (picture >= darkest - 1e-9) & (picture <= lightest + 1e-9)


def test_light_is_found_whatever_surfaces_the_kernels_average() -> None:
    samples, albedo = _two_surfaces_in_each_pixel()
    shown = _denoised(samples, 50.0) / LIGHT[:, None, None]
    assert bool(_is_of_the_neighbourhood(shown, albedo).all())
    plain = _denoised(samples, -50.0) / LIGHT[:, None, None]
    assert not bool(_is_of_the_neighbourhood(plain, albedo).all())


@pytest.mark.parametrize("follows", [0.0, 0.5, 1.0])
def test_how_much_radiance_follows_its_surface_is_measured(follows: float) -> None:
    """The rest is light that surfaces do not colour, such as a reflection of the sky."""
    samples, albedo = _two_surfaces_in_each_pixel(texture=0.005)
    samples.roles["radiance"] = follows * samples.roles["radiance"] + (1 - follows) * LIGHT / 2
    expected = LIGHT[:, None, None] * (follows * albedo + (1 - follows) / 2)

    def error(shown: Tensor) -> float:
        return float(((shown - expected).abs() / expected).mean())

    assert error(_denoised(samples, trust=50.0)) < 0.02
    if follows < 1:
        assert error(_denoised(samples, 50.0)) > 0.04
    if follows > 0:
        assert error(_denoised(samples, -50.0)) > 0.04


def test_without_samples_near_a_target_the_plain_path_stands() -> None:
    """The divisor's window sees nothing in the middle of a hole that coarser cells still fill."""
    samples, _ = _two_surfaces_in_each_pixel()
    there = torch.ones(HEIGHT, WIDTH, dtype=torch.bool)
    there[6:13, 8:15] = False
    kept = there.flatten().repeat_interleave(2)
    samples = replace(samples, counts=there.flatten().int() * 2, weight=samples.weight[kept],
                      coverage=samples.coverage[kept],
                      roles={role: values[kept] for role, values in samples.roles.items()})
    open_, closed = _denoised(samples, 50.0), _denoised(samples, -50.0)
    assert bool((closed[:, 9, 11] > 0).all())
    assert torch.equal(open_[:, 9, 11], closed[:, 9, 11])
    assert not torch.allclose(open_[:, 2, 2], closed[:, 2, 2])


def _textured(noise: float, count: int) -> Samples:
    """Pixels of random albedo, lit in proportion to it, `count` samples each, whose albedo is off by `noise`."""
    draw = torch.Generator().manual_seed(3)
    samples = random_samples(2, (1, HEIGHT, WIDTH), count)
    rows = HEIGHT * WIDTH, count, 3
    clean = 0.3 + 0.4 * torch.rand(rows[0], 1, 3, generator=draw, dtype=torch.float64) * (noise == 0)
    albedo = (clean + noise * (torch.rand(rows, generator=draw, dtype=torch.float64) - 0.5)).reshape(-1, 3)
    weight = torch.full_like(samples.weight, 1 / count)
    samples = replace(samples, coverage=torch.ones_like(samples.coverage), weight=weight)
    roles = {"depth": torch.full_like(samples.roles["depth"], 2.0), "albedo": albedo,
             "specular": torch.zeros_like(albedo), "radiance": LIGHT * albedo}
    return replace(samples, roles=samples.roles | roles)


def test_a_slope_over_clean_divisors_is_trusted_whatever_is_predicted() -> None:
    samples = _textured(0.0, 4)
    measured, predicted = (_denoised(samples, -50.0, trust) for trust in (50.0, -50.0))
    apart = (measured - predicted).abs().mean()
    assert apart > 0.03 * predicted.mean()
    assert (_denoised(samples, -50.0, config=MEASURED) - measured).abs().mean() < 0.1 * apart


def test_a_slope_over_noise_is_trusted_as_far_as_is_predicted() -> None:
    """All that the divisors differ by is their samples' noise."""
    samples = _textured(0.4, 8)
    measured, predicted = (_denoised(samples, -50.0, trust) for trust in (50.0, -50.0))
    apart = (measured - predicted).abs().mean()
    assert apart > 0.02 * predicted.mean()
    assert (_denoised(samples, -50.0, config=MEASURED) - predicted).abs().mean() < 0.25 * apart


def test_of_one_sample_a_pixel_nothing_tells_the_noise() -> None:
    samples = _textured(0.0, 1)
    assert torch.equal(_denoised(samples, -50.0, config=MEASURED), _denoised(samples, -50.0))


def test_reliability_without_a_slope_is_refused() -> None:
    with pytest.raises(ValueError, match="slope"):
        replace(SMALL["fast"], texture_slope=False)
