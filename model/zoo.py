"""The weights that ship with lbmc: presets by name, and reading and writing of weight files.

A weight file is safetensors, float16, with one JSON document in its metadata: the network's config and how it was
trained (data, steps, scores). Nothing is downloaded and nothing in a file is executed.
"""

from __future__ import annotations

import hashlib
import json
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file

from model.config import Config
from model.denoiser import Denoiser

WEIGHTS = Path(__file__).parent / "weights"
SUFFIX = ".safetensors"
METADATA_KEY = "lbmc"
FORMAT = 1
DEFAULT_PRESET = "fast"


@dataclass(frozen=True)
class Weights:
    """One weight file and what its metadata says.

    name : preset name, the file's stem
    config : the network's
    info : "description", "recipe", "data", "steps", "scores": whatever training wrote down
    """

    name: str
    path: Path
    config: Config
    info: dict[str, Any]

    @cached_property
    def digest(self) -> str:
        """The first 12 hex digits of the file's SHA-256."""
        return hashlib.sha256(self.path.read_bytes()).hexdigest()[:12]

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


def presets() -> list[str]:
    """Names of the presets that ship, sorted."""
    return sorted(path.stem for path in WEIGHTS.glob(f"*{SUFFIX}"))


def find(name: str | None = None) -> Weights:
    """The weights of a preset, of a .safetensors file, or (None) of the default preset.

    Raises ValueError: no such preset (the message lists those there are), or not a weight file of lbmc.
    """
    if name is None:
        name = DEFAULT_PRESET
    path = Path(name) if name.endswith(SUFFIX) else WEIGHTS / f"{name}{SUFFIX}"
    if not path.is_file():
        if name.endswith(SUFFIX):
            raise ValueError(f"{path}: no such weight file")
        raise ValueError(f"no preset {name!r}; there are {', '.join(presets()) or 'none'}, or pass a {SUFFIX} file")
    try:
        with safe_open(path, "pt") as file:
            metadata = file.metadata() or {}
    except (SafetensorError, OSError) as error:
        raise ValueError(f"{path}: not a safetensors file ({error})") from None
    if METADATA_KEY not in metadata:
        raise ValueError(f"{path}: weights, but not of lbmc (no {METADATA_KEY!r} entry in its metadata)")
    document = json.loads(metadata[METADATA_KEY])
    if document["format"] != FORMAT:
        raise ValueError(f"{path}: weight format {document['format']}, this lbmc reads {FORMAT}; upgrade lbmc")
    return Weights(path.stem, path, Config.from_dict(document["config"]), document["info"])


def list_models() -> list[Weights]:
    """Every preset that ships, in the order of their names."""
    return [find(name) for name in presets()]


def save(net: Denoiser, path: Path, info: dict[str, Any]) -> None:
    """Writes a weight file. Its bytes depend on the weights, the config and `info` alone."""
    document = {"format": FORMAT, "config": net.config.to_dict(), "info": info}
    state = {key: value.to(torch.float16).contiguous() for key, value in net.state_dict().items()}
    save_file(state, path, {METADATA_KEY: json.dumps(document, sort_keys=True)})
