"""What `lbmc models` shows: the weights that ship, with what their files say about themselves. Imports no torch."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from model import weight_files


@dataclass(frozen=True)
class Preset:
    """One preset. `info` is what training wrote into the file: description, recipe, data, steps, scores.

    weights : the preset whose file it is
    mirrored : whether results are averaged over the frame and its mirror images; `info` then speaks of one run alone
    """

    name: str
    default: bool
    path: str
    bytes: int
    digest: str
    """First 12 hex digits of the file's SHA-256, as written into denoised files."""
    config: dict[str, Any]
    info: dict[str, Any]
    weights: str
    mirrored: bool

    @property
    def description(self) -> str:
        """One line on what it is."""
        if self.mirrored:
            return f"The weights of {self.weights}, averaged over the frame and its mirror images; four times the work."
        return str(self.info.get("description", ""))


def presets() -> list[Preset]:
    """Every preset that ships, by name. Raises ValueError when a weight file in the package is broken."""
    return [_preset(name) for name in weight_files.presets()]


def _preset(name: str) -> Preset:
    path = weight_files.weight_path(name)
    document = weight_files.read_document(path)
    return Preset(
        name=name,
        default=name == weight_files.DEFAULT_PRESET,
        path=str(path),
        bytes=path.stat().st_size,
        digest=weight_files.digest_of(path),
        config=document["config"],
        info=document["info"],
        weights=path.stem,
        mirrored=name in weight_files.MIRRORED,
    )
