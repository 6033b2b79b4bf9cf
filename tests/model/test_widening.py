"""A wider network that computes the same, from which training may go on."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from model.config import FAST, HIGH, Config, UNetConfig
from model.features import FrameScale
from model.widening import widened
from tests.model.random_models import SMALL, random_network, random_samples

NARROW = SMALL["fast"]
WIDE = replace(
    NARROW,
    name="wide",
    unet=UNetConfig(encoder=((7, 5), (9,)), bottleneck=(8,), decoder=((6,), (9, 8)), scale=2, fine=(6, 3)),
    partitioner=(8,),
    generator=(12,),
)


@pytest.mark.parametrize("layers", [1, 2, 3])
def test_a_widened_network_computes_what_the_narrow_one_did(layers: int) -> None:
    net, samples, scale = random_network(NARROW, 1), random_samples(2, (2, 24, 32)), FrameScale()
    with torch.no_grad():
        before, after = (each(samples, scale, layers) for each in (net, widened(net, WIDE)))
    torch.testing.assert_close(after.beauty(), before.beauty(), rtol=1e-9, atol=1e-12)
    torch.testing.assert_close(after.weight, before.weight, rtol=1e-9, atol=1e-12)


def test_what_is_new_can_learn() -> None:
    """It is read by nothing at first, but what would read it has a derivative."""
    torch.manual_seed(3)
    net = widened(random_network(NARROW, 3), WIDE)
    net(random_samples(4, (1, 24, 32)), FrameScale(), layers=2).beauty().square().mean().backward()
    weight = net.get_parameter("unet.decoder.1.convolutions.1.weight")  # 9 channels to 8, where there were 6 to 5
    assert weight.grad is not None
    assert weight[:5, 6:].eq(0).all()
    assert weight.grad[:5, 6:].ne(0).any()
    assert weight[5:].ne(0).all()


def test_high_is_a_wider_fast() -> None:
    net, samples, scale = random_network(FAST, 5), random_samples(6, (1, 32, 32)), FrameScale()
    wide = widened(net, HIGH)
    assert wide.config == HIGH
    with torch.no_grad():
        torch.testing.assert_close(wide(samples, scale).color, net(samples, scale).color, rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize(("config", "message"), [
    (replace(WIDE, generator=(6,)), "is no part of"),
    (replace(WIDE, unet=replace(WIDE.unet, bottleneck=(5,))), "is no part of"),
    (replace(WIDE, generator=(12, 12)), "the layers are not the same"),
    (replace(WIDE, unet=replace(WIDE.unet, fine=(6, 3, 3))), "the layers are not the same"),
    (replace(WIDE, kernel_sizes=(5, 3, 3, 3)), "more than widths differ"),
    (replace(WIDE, reducer=(9, 5)), "more than widths differ"),
    (SMALL["layer"], "more than widths differ"),
])
def test_networks_that_do_not_contain_it_are_refused(config: Config, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        widened(random_network(NARROW, 6), config)
