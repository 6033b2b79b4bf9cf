"""What `lbmc models` shows: the weights that ship, with what their files say about themselves."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from model.zoo import DEFAULT_PRESET, Weights, list_models


@dataclass(frozen=True)
class Preset:
    """One preset. `info` is what training wrote into the file: description, recipe, data, steps, scores."""

    name: str
    default: bool
    path: str
    bytes: int
    digest: str
    """First 12 hex digits of the file's SHA-256, as written into denoised files."""
    config: dict[str, Any]
    info: dict[str, Any]


def presets() -> list[Preset]:
    """Every preset that ships, by name. Raises ValueError when a weight file in the package is broken."""
    return [_preset(weights) for weights in list_models()]


def _preset(weights: Weights) -> Preset:
    return Preset(
        name=weights.name,
        default=weights.name == DEFAULT_PRESET,
        path=str(weights.path),
        bytes=weights.path.stat().st_size,
        digest=weights.digest,
        config=weights.config.to_dict(),
        info=weights.info,
    )
