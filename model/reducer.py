"""What a network sees of each sample and of each pixel: embeddings, and the statistics the context starts from."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from model.config import Config
from model.features import FrameScale, encode, feature_groups, held_groups, log_radiance
from model.networks import Mlp, linear_columns
from model.samples import Samples, columns

PIXEL_STATISTICS = 6  # log mean radiance (3), log spread of luminance, spread of relative depth, effective count
LUMINANCE_LIMIT = 1e18  # its square must stay in the range of float32


class SampleReducer(nn.Module):
    """Samples -> embeddings (N, E). A role that is absent leaves the first layer; a present one adds its own bias, and
    of a held one nothing but that is left."""

    def __init__(self, config: Config) -> None:
        super().__init__()
        derived = config.encoding == "log"
        self.groups = feature_groups(config.roles, derived)
        self.mlp = Mlp([sum(self.groups.values())], config.reducer)
        self.presence = nn.Parameter(torch.zeros(len(self.groups), config.reducer[0])) if derived else None
        spans, start = {}, 0
        for name, width in self.groups.items():
            spans[name] = (start, start + width)
            start += width
        self.spans = spans

    def forward(self, samples: Samples, scale: FrameScale) -> Tensor:
        features = encode(samples, scale, self.groups)
        there = {*features, *held_groups(samples)}
        present = [k for k, name in enumerate(self.groups) if name in there]
        inputs = [c for name in self.groups if name in features for c in range(*self.spans[name])]
        first = self.mlp.groups[0]
        assert isinstance(first, nn.Linear)
        weight = first.weight if len(inputs) == first.in_features else first.weight[:, inputs]
        bias = first.bias if self.presence is None else first.bias + self.presence[present].sum(0)
        x = columns([features[name] for name in self.groups if name in features])
        with self.mlp.products(x):
            hidden = linear_columns(x, weight, bias)
        return self.mlp.rest(hidden, activate_last=True)


class LogFeatures(nn.Module):
    """Samples -> their features (N, E) as they are, 0 for a role that is absent: no network."""

    def __init__(self, config: Config) -> None:
        super().__init__()
        self.groups = feature_groups(config.roles, config.encoding == "log")

    def forward(self, samples: Samples, scale: FrameScale) -> Tensor:
        features = encode(samples, scale, self.groups)
        radiance = samples.roles["radiance"]
        absent = {name: radiance.new_zeros(len(radiance), width) for name, width in self.groups.items()}
        return columns([features.get(name, absent[name]) for name in self.groups])


def context_inputs(config: Config) -> int:
    """Channels of the context network's input, see `pixel_rows`."""
    spread = config.statistics or not config.reducer
    return (2 if spread else 1) * config.embedding + (PIXEL_STATISTICS if config.statistics else 0)


def pixel_rows(
    samples: Samples, embedding: Tensor, relative: Tensor | None, scale: FrameScale, config: Config
) -> Tensor:
    """(P, context_inputs) what the context network sees of each pixel, 0 for one without samples.

    The weighted mean of the embeddings (N, E). Without a reducer also their population variance. With
    `config.statistics` also that, and PIXEL_STATISTICS numbers; `relative` begins with depth against the surroundings.
    """
    segments = samples.segments
    weight = samples.weight[:, None]
    embedding = embedding.to(weight.dtype)
    if not config.statistics:
        mean = segments.weighted_sum(weight, embedding)[:, 0]
        if config.reducer:
            return mean.contiguous()
        deviation = embedding - segments.expand(mean)
        return columns([mean, segments.weighted_sum(weight, deviation * deviation)[:, 0]]).contiguous()
    radiance = samples.roles["radiance"]
    luminance = radiance.mean(1, keepdim=True).clamp(-LUMINANCE_LIMIT, LUMINANCE_LIMIT)
    offset = torch.zeros_like(luminance) if relative is None or not config.depth_prior else relative[:, :1]
    moments = columns([embedding, radiance, luminance, offset])
    mean = segments.weighted_sum(weight, moments)[:, 0]
    deviation = moments - segments.expand(mean)
    variance = segments.weighted_sum(weight, deviation * deviation)[:, 0]
    squares = weight * weight if samples.squares is None else samples.squares[:, None]
    concentration = segments.sum(squares)
    count = torch.log2(torch.where(concentration > 0, concentration, 1)) * -0.25
    e = embedding.shape[1]
    return columns(
        [
            mean[:, :e],
            variance[:, :e],
            log_radiance(mean[:, e : e + 3], scale.exposure),
            torch.log1p(variance[:, e + 3 : e + 4].sqrt() * scale.exposure),
            variance[:, e + 4 :].sqrt(),
            count,
        ]
    ).contiguous()
