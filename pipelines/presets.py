"""What `lbmc models` shows: the weights that ship, with what their files say about themselves. Imports no torch."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from model import weight_files


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
    return [_preset(weight_files.weight_path(name)) for name in weight_files.presets()]


def _preset(path: Path) -> Preset:
    document = weight_files.read_document(path)
    return Preset(
        name=path.stem,
        default=path.stem == weight_files.DEFAULT_PRESET,
        path=str(path),
        bytes=path.stat().st_size,
        digest=weight_files.digest_of(path),
        config=document["config"],
        info=document["info"],
    )
