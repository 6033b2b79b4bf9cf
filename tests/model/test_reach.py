"""`Denoiser.reach` is right and not needlessly large."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from model.config import FAST, LAYER, Config, UNetConfig
from model.denoiser import Denoiser
from model.features import FrameScale
from model.networks import UNet
from model.reach import unet_span
from tests.model.random_models import HALF_UNET, SMALL, UNET, random_network, random_samples, with_roles

ROUNDING = 1e-13  # in float64


def thin(unet: UNetConfig) -> UNetConfig:
    """The same network with one channel everywhere."""
    def ones(blocks: tuple[tuple[int, ...], ...]) -> tuple[tuple[int, ...], ...]:
        return tuple(tuple(1 for _ in block) for block in blocks)

    return UNetConfig(ones(unet.encoder), ones((unet.bottleneck,))[0], ones(unet.decoder), ones((unet.head,))[0],
                      unet.scale, ones((unet.fine,))[0])


@pytest.mark.parametrize("config", [UNET, HALF_UNET, replace(HALF_UNET, fine=()), FAST.unet, LAYER.unet])
def test_span_of_a_unet_is_exact(config: UNetConfig) -> None:
    """With positive weights, no biases and a dark picture, an output is above 0 only if it sees the one light."""
    net = UNet(1, thin(config)).double()
    with torch.no_grad():
        for name, parameter in net.named_parameters():
            parameter.fill_(0.0 if name.endswith("bias") else 0.3)
    first, last = unet_span((0, 0), config)
    size = 2 * (max(-first, last) // config.stride + 2) * config.stride
    pictures = torch.eye(size)[:, None, None]  # (lights, 1, 1, size): one light each
    pictures = torch.nn.functional.pad(pictures, (0, 0, 0, config.stride - 1)).double()
    with torch.no_grad():
        outputs = [net.levels(lights) for lights in pictures.split(32)]
    for level in range(1 if config.scale > 1 else min(3, len(config.decoder))):
        seen = torch.cat([(levels[-1 - level] > 0).any(2)[:, 0] for levels in outputs])  # (light, output)
        middle = (size >> level) // 2
        for x in range(middle, middle + (config.stride >> level)):
            lights = torch.nonzero(seen[:, x])[:, 0]
            assert unet_span((x, x), config, level) == (int(lights.min()), int(lights.max()))


def changed_radius(net: Denoiser, size: int, at: int, tile: bool = False) -> int:
    """How far along a row of pixels a disturbance of pixel `at` goes; for a tile, if what the U-Net decodes stays."""
    samples = random_samples(1, (1, 1, size), 2)
    changed = {role: values.clone() for role, values in samples.roles.items()}
    span = slice(2 * at, 2 * at + 2)
    changed["radiance"][span] *= 50
    changed["depth"][span] *= 3
    changed["albedo"][span] *= 0.5
    with torch.no_grad():
        decoded = net.decoded_context(net.unet_inputs(samples, FrameScale())) if tile else None
        first = net(samples, FrameScale(), fill=False, decoded=decoded)
        second = net(with_roles(samples, **changed), FrameScale(), fill=False, decoded=decoded)
    difference = (first.color - second.color).abs().amax((0, 1, 2, 3))
    touched = torch.nonzero(difference > ROUNDING * first.color.max())[:, 0]
    return int((touched - at).abs().max())


def wide_network(config: Config) -> Denoiser:
    """Whose kernels look as far as they can."""
    net = random_network(config, 2)
    with torch.no_grad():
        for parameter in net.parameters():  # small weights: kernels stay wide, so every tap counts
            parameter.mul_(0.3)
        for parameter in net.unet.parameters():  # positive ones: nothing cancels
            parameter.abs_()
    return net


@pytest.mark.parametrize("variant", sorted(SMALL))
def test_nothing_farther_than_reach_changes_and_something_nearly_as_far_does(variant: str) -> None:
    net = wide_network(SMALL[variant])
    centre = (net.reach // net.stride + 2) * net.stride
    radii = [changed_radius(net, 2 * centre, centre + k) for k in range(net.stride)]
    assert max(radii) <= net.reach
    assert max(radii) >= 0.75 * net.reach


@pytest.mark.parametrize("filtered", [False, True])
def test_the_same_for_a_tile_of_a_decoded_picture(filtered: bool) -> None:
    net = wide_network(replace(SMALL["fast"], filtered_guides=filtered))
    assert net.tile_reach is not None
    centre = (net.tile_reach // net.stride + 2) * net.stride
    radii = [changed_radius(net, 2 * centre, centre + k, tile=True) for k in range(net.stride)]
    assert max(radii) <= net.tile_reach
    assert max(radii) >= 0.75 * net.tile_reach
