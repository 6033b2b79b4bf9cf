"""Configurations: the published sizes, refusals, and the way through JSON."""

from __future__ import annotations

import dataclasses
import json
from typing import Any

import pytest

from model.config import CONFIGS, FAST, LAYER, OPTIMIZED, PIXEL_GATHER, SAMPLE_SPLAT, Config
from model.cost import count


@pytest.mark.parametrize(
    ("name", "parameters"),
    [
        ("layer", 17_284_435),
        ("layer_w", 17_284_435),
        ("sample_splat", 17_278_721),  # without the partitioner
        ("pixel_gather", 17_288_225),  # 40 inputs to the U-Net, no reducer
        ("optimized", 16_561_152),
    ],
)
def test_published_variants_keep_their_size(name: str, parameters: int) -> None:
    assert count(CONFIGS[name]).parameters == parameters


@pytest.mark.parametrize("name", sorted(CONFIGS))
def test_a_config_survives_json(name: str) -> None:
    config = CONFIGS[name]
    assert config.name == name
    assert Config.from_dict(json.loads(json.dumps(config.to_dict()))) == config


@pytest.mark.parametrize(
    ("config", "changes", "message"),
    [
        (LAYER, {"layers": 3}, "3 layers with 2"),
        (LAYER, {"kernel_sizes": (4,)}, "odd"),
        (LAYER, {"demodulation": True}, "demodulation"),
        (LAYER, {"unet": dataclasses.replace(LAYER.unet, decoder=LAYER.unet.decoder[1:])}, "decoder"),
        (SAMPLE_SPLAT, {"partition_logits": 2}, "no partitioner"),
        (SAMPLE_SPLAT, {"kernel_sizes": (5, 5)}, "full resolution"),
        (SAMPLE_SPLAT, {"kernel": "affinity"}, "direct kernels"),
        (PIXEL_GATHER, {"confidence": True}, "no partitioner"),
        (OPTIMIZED, {"unet": dataclasses.replace(OPTIMIZED.unet, scale=2)}, "decoder block of its resolution"),
        (FAST, {"partition_logits": 6}, "6 partition logits"),
    ],
)
def test_what_cannot_be_built_is_refused(config: Config, changes: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        dataclasses.replace(config, **changes)
