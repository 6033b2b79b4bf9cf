"""What weight files say of themselves, read without their tensors and without torch: `lbmc models` must be quick.

A weight file is safetensors, float16, with one JSON document in its metadata under METADATA_KEY:
{"format": FORMAT, "config": the network's Config, "info": how it was trained (description, recipe, data, steps,
scores)}. Nothing is downloaded and nothing in a file is executed. The network itself is zoo.py's.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Any

from safetensors import SafetensorError, safe_open

WEIGHTS = Path(__file__).parent / "weights"
SUFFIX = ".safetensors"
METADATA_KEY = "lbmc"
FORMAT = 1
DEFAULT_PRESET = "fast"
MIRRORED: Mapping[str, str] = MappingProxyType({"best": "high"})
"""Presets without a file of their own: the preset whose weights run on the frame and its mirror images, averaged."""
MIRRORED_KEY = "mirrored"
"""Of a file's "info": whether these weights, tuned from those of such a preset, run so as well."""


def presets() -> list[str]:
    """Names of the presets that ship, sorted."""
    files = {path.stem for path in WEIGHTS.glob(f"*{SUFFIX}")}
    return sorted(files | {name for name, weights in MIRRORED.items() if weights in files})


def weight_path(name: str | None = None) -> Path:
    """The file of a preset's weights, a .safetensors file, or (None) that of the default preset.

    Raises ValueError without one.
    """
    if name is None:
        name = DEFAULT_PRESET
    path = Path(name) if name.endswith(SUFFIX) else WEIGHTS / f"{MIRRORED.get(name, name)}{SUFFIX}"
    if not path.is_file():
        if name.endswith(SUFFIX):
            raise ValueError(f"{path}: no such weight file")
        raise ValueError(f"no preset {name!r}; there are {', '.join(presets()) or 'none'}, or pass a {SUFFIX} file")
    return path


def read_document(path: Path) -> dict[str, Any]:
    """The JSON document with a file's "config" and "info". Raises ValueError for what is not ours."""
    try:
        with safe_open(path, "np") as file:
            metadata = file.metadata() or {}
    except (SafetensorError, OSError) as error:
        raise ValueError(f"{path}: not a safetensors file ({error})") from None
    if METADATA_KEY not in metadata:
        raise ValueError(f"{path}: weights, but not of lbmc (no {METADATA_KEY!r} entry in its metadata)")
    try:
        document: dict[str, Any] = json.loads(metadata[METADATA_KEY])
        stated = document["format"]
    except (ValueError, TypeError, KeyError):
        raise ValueError(f"{path}: its {METADATA_KEY!r} metadata is broken; copy or train the weights again") from None
    if stated != FORMAT:
        raise ValueError(f"{path}: weight format {stated}, this lbmc reads {FORMAT}; upgrade lbmc")
    return document


def digest_of(path: Path) -> str:
    """The first 12 hex digits of a file's SHA-256, as written into denoised files."""
    return hashlib.sha256(path.read_bytes()).hexdigest()[:12]
