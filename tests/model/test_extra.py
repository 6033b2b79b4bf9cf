"""Further values through the radiance's own partition and kernels, and the partition by itself, for every variant."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from model.features import FrameScale
from tests.model.random_models import SMALL, random_counts, random_network, random_samples

SCALE = FrameScale(1.0, 2.0)
SHAPE = (1, 17, 20)


@pytest.mark.parametrize("name", SMALL)
def test_lights_that_sum_to_the_radiance_are_denoised_to_its_sum(name: str) -> None:
    net = random_network(SMALL[name], 2)
    samples = random_samples(3, SHAPE, random_counts(5, 340, 4, 0.1))
    layers = min(SMALL[name].partition_logits, 3)
    radiance = samples.roles["radiance"]
    part = radiance * torch.rand(radiance.shape, generator=torch.Generator().manual_seed(1)).to(radiance)
    extra = torch.cat([part, radiance - part, samples.coverage[:, None]], 1)
    with torch.no_grad():
        alone = net(samples, SCALE, layers)
        made = net(replace(samples, extra=extra, lights=6), SCALE, layers)
    assert torch.allclose(made.color, alone.color, rtol=1e-12, atol=0)
    assert torch.allclose(made.extra[:, :, :3] + made.extra[:, :, 3:6], made.color, rtol=1e-9, atol=1e-12)
    assert torch.allclose(made.extra[:, :, 6], made.coverage, rtol=1e-9, atol=1e-12)
    assert alone.extra.shape[2] == 0


@pytest.mark.parametrize("name", SMALL)
def test_the_partition_shares_every_sample_among_the_layers(name: str) -> None:
    net = random_network(SMALL[name], 2)
    samples = random_samples(3, SHAPE, random_counts(5, 340, 4, 0.1))
    layers = min(SMALL[name].partition_logits, 3)
    with torch.no_grad():
        shares = net.partition(samples, SCALE, layers)
    assert shares.shape == (len(samples.weight), layers)
    assert (shares >= 0).all()
    assert torch.allclose(shares.sum(1), torch.ones_like(samples.weight))


def test_extra_of_the_wrong_size_is_refused() -> None:
    samples = random_samples(3, (1, 2, 2))
    with pytest.raises(ValueError, match="extra"):
        replace(samples, extra=torch.zeros(3, 2))
    with pytest.raises(ValueError, match="lights"):
        replace(samples, extra=torch.zeros(len(samples.weight), 3), lights=2)
