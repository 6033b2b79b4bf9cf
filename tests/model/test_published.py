"""The published variants, written out plainly in the linear domain, equal the denoiser.

No log domain, no split first layers, no chunks: concatenated inputs, one loop over pixels and one over taps.
"""

from __future__ import annotations

import pytest
import torch
import torch.nn.functional as F
from torch import Tensor

from model.denoiser import Denoiser
from model.features import FrameScale, encode
from model.networks import Mlp
from model.samples import ROLE_WIDTHS, Samples
from tests.model.random_models import SMALL, random_counts, random_network, random_samples

SCALE = FrameScale(0.8, 2.0)
SHAPE = (1, 8, 8)  # the U-Net's stride: nothing is padded
SIZE = 5


def mlp(net: Mlp, x: Tensor) -> Tensor:
    """The MLP with its first layer as one matrix."""
    groups = [group for group in net.groups if isinstance(group, torch.nn.Linear)]
    x = F.linear(x, torch.cat([group.weight for group in groups], 1), groups[0].bias)
    for layer in net.layers:
        x = layer(F.leaky_relu(x, 0.01))
    return x


class Plain:
    """Per-sample and per-pixel quantities of one picture, as the paper defines them."""

    def __init__(self, net: Denoiser, samples: Samples) -> None:
        self.net, self.samples = net, samples
        self.pixel = torch.repeat_interleave(torch.arange(64), samples.counts.long())
        groups = [role for role in ROLE_WIDTHS if role != "coverage"]
        features = encode(samples, SCALE, groups)
        order = torch.cat([features[role] for role in net.config.roles], 1)  # (N, 20)
        self.weight = samples.weight[:, None]
        if net.config.reducer:
            reducer = net.reducer.mlp
            assert isinstance(reducer, Mlp)
            self.embedding = F.leaky_relu(mlp(reducer, order), 0.01)
            inputs = self.per_pixel(self.weight * self.embedding)
        else:
            self.embedding = order
            mean = self.per_pixel(self.weight * order)
            square = self.per_pixel(self.weight * order**2)
            inputs = torch.cat([mean, square - mean**2], 1)
        picture = inputs.T.reshape(1, -1, 8, 8)
        self.context = net.unet(picture)[0].flatten(1).T  # (P, C)
        radiance = samples.roles["radiance"]
        coverage = samples.coverage[:, None]
        self.values = torch.cat([radiance, coverage, torch.ones_like(coverage)], 1)  # (N, 5)

    def per_pixel(self, per_sample: Tensor) -> Tensor:
        return torch.zeros(64, per_sample.shape[1], dtype=per_sample.dtype).index_add(0, self.pixel, per_sample)

    def spread(self, kernel: Tensor, values: Tensor) -> Tensor:
        """Splats (P, T) kernels times (P, C) values to (P, C) targets."""
        out = torch.zeros(8, 8, values.shape[1], dtype=values.dtype)
        for y in range(8):
            for x in range(8):
                for tap in range(SIZE * SIZE):
                    ty, tx = y + tap // SIZE - SIZE // 2, x + tap % SIZE - SIZE // 2
                    if 0 <= ty < 8 and 0 <= tx < 8:
                        out[ty, tx] += kernel[8 * y + x, tap] * values[8 * y + x]
        return out.flatten(0, 1)

    def collect(self, kernel: Tensor, values: Tensor) -> Tensor:
        """Gathers (P, C) values with (P, T) kernels of the targets; tap k reads from -(offset of tap k)."""
        out = torch.zeros(8, 8, values.shape[1], dtype=values.dtype)
        for y in range(8):
            for x in range(8):
                for tap in range(SIZE * SIZE):
                    sy, sx = y - tap // SIZE + SIZE // 2, x - tap % SIZE + SIZE // 2
                    if 0 <= sy < 8 and 0 <= sx < 8:
                        out[y, x] += kernel[8 * y + x, tap] * values[8 * sy + sx]
        return out.flatten(0, 1)

    def kernel(self, context: Tensor, embedding: Tensor) -> Tensor:
        generator = self.net.generators[0]
        assert isinstance(generator, Mlp)
        return torch.exp(mlp(generator, torch.cat([context, embedding], 1)))

    def partition(self) -> Tensor:
        logits = mlp(self.net.partitioner, torch.cat([self.context[self.pixel], self.embedding], 1))
        return torch.softmax(logits, 1)

    def layers(self) -> list[tuple[Tensor, Tensor, Tensor]]:
        """Per layer, back in the linear domain: own sums (R, a, w), occupancy n, kernel."""
        share = self.partition()
        out = []
        for layer in range(share.shape[1]):
            own = self.weight * share[:, layer : layer + 1]
            behind = self.weight * share[:, layer:].sum(1, keepdim=True)
            kernel = self.kernel(self.context, self.per_pixel(own * self.embedding))
            out.append((self.per_pixel(own * self.values), self.per_pixel(behind), kernel))
        return out


def front_to_back(plain: Plain) -> Tensor:
    color, through = torch.zeros(64, 4, dtype=torch.float64), torch.ones(64, 1, dtype=torch.float64)
    for own, occupancy, kernel in plain.layers():
        filtered = plain.spread(kernel, torch.cat([own, occupancy], 1))
        color += through * filtered[:, :4] / filtered[:, 5:]
        through = through * (1 - filtered[:, 4:5] / filtered[:, 5:])
    return color


def jointly(plain: Plain) -> Tensor:
    filtered = sum(plain.spread(kernel, own) for own, _, kernel in plain.layers())
    assert isinstance(filtered, Tensor)
    return filtered[:, :4] / filtered[:, 4:]


def per_sample(plain: Plain) -> Tensor:
    kernel = plain.kernel(plain.context[plain.pixel], plain.embedding) * plain.weight
    taps = plain.per_pixel((kernel[:, :, None] * plain.values[:, None]).flatten(1)).view(64, SIZE * SIZE, 5)
    filtered = sum(
        plain.spread(torch.eye(SIZE * SIZE, dtype=torch.float64)[tap].expand(64, -1), taps[:, tap])
        for tap in range(SIZE * SIZE)
    )
    assert isinstance(filtered, Tensor)
    return filtered[:, :4] / filtered[:, 4:]


def gathered(plain: Plain) -> Tensor:
    means = plain.per_pixel(plain.weight * plain.values)
    kernel = plain.kernel(plain.context, plain.per_pixel(plain.weight * plain.embedding))
    filtered = plain.collect(kernel, means)
    return filtered[:, :4] / filtered[:, 4:]


@torch.no_grad()
@pytest.mark.parametrize("counts", ["uniform", "ragged"])
@pytest.mark.parametrize(
    ("variant", "definition"),
    [("layer", front_to_back), ("layer_w", jointly), ("sample_splat", per_sample), ("pixel_gather", gathered)],
)
def test_denoiser_equals_the_published_equations(variant: str, definition: object, counts: str) -> None:
    net = random_network(SMALL[variant], 21)
    samples = random_samples(21, SHAPE, 3 if counts == "uniform" else random_counts(21, 64, 4, 0.2))
    layers = net(samples, SCALE, net.config.partition_logits)
    assert callable(definition)
    expected = definition(Plain(net, samples)).T.reshape(4, 8, 8)
    torch.testing.assert_close(layers.beauty()[0], expected[:3])
    torch.testing.assert_close(layers.alpha()[0], expected[3])
