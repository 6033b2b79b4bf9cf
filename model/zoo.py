"""The networks of weight files: presets by name, and reading and writing of weight files as networks.

How a weight file is laid out, and what can be known of it without torch, is weight_files.py's.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import torch
from safetensors import safe_open
from safetensors.torch import save as serialize

from model.config import Config
from model.denoiser import Denoiser
from model.weight_files import (
    FORMAT,
    METADATA_KEY,
    MIRRORED,
    MIRRORED_KEY,
    SUFFIX,
    digest_of,
    presets,
    read_document,
    weight_path,
)

__all__ = ["SUFFIX", "Weights", "find", "list_models", "presets", "save"]


@dataclass(frozen=True)
class Weights:
    """One weight file and what its metadata says.

    name : of the preset, or the file's stem
    path : the file, which may be another preset's
    config : the network's
    info : "description", "recipe", "data", "steps", "scores": whatever training wrote down
    mirrored : whether results are averaged over the frame and its mirror images
    """

    name: str
    path: Path
    config: Config
    info: dict[str, Any]
    mirrored: bool = False

    @cached_property
    def digest(self) -> str:
        """The first 12 hex digits of the file's SHA-256."""
        return digest_of(self.path)

    def load(self) -> Denoiser:
        """The network in float32, in evaluation mode. Raises ValueError where the tensors do not fit the config."""
        net = Denoiser(self.config)
        with safe_open(self.path, "pt") as file:
            state = {key: file.get_tensor(key).float() for key in file.keys()}
        try:
            net.load_state_dict(state)
        except RuntimeError:
            raise ValueError(f"{self.path}: its weights are of another version of lbmc's network; train it again or "
                             f"use the lbmc that wrote it") from None
        return net.eval()


def find(name: str | None = None) -> Weights:
    """The weights of a preset, of a .safetensors file, or (None) of the default preset.

    Raises ValueError: no such preset (the message lists those there are), or not a weight file of lbmc.
    """
    path = weight_path(name)
    document = read_document(path)
    config, info = Config.from_dict(document["config"]), document["info"]
    if name is not None and name in MIRRORED:
        return Weights(name, path, config, info, mirrored=True)
    return Weights(path.stem, path, config, info, mirrored=bool(info.get(MIRRORED_KEY)))


def list_models() -> list[Weights]:
    """Every preset that ships, in the order of their names."""
    return [find(name) for name in presets()]


def save(net: Denoiser, path: Path, info: dict[str, Any]) -> None:
    """Writes a weight file. Its bytes depend on the weights, the config and `info` alone; its permissions on the umask,
    or on the file that is replaced."""
    document = {"format": FORMAT, "config": net.config.to_dict(), "info": info}
    state = {key: value.to(torch.float16).contiguous() for key, value in net.state_dict().items()}
    # As bytes: safetensors' own writing leaves files that nobody but their owner can read.
    path.write_bytes(serialize(state, {METADATA_KEY: json.dumps(document, sort_keys=True)}))
