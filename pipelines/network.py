"""The network of a job: which weights, on which device, in which precision. What it cannot have is a usage error."""

from __future__ import annotations

import torch

from deep_io.errors import UsageError
from model import zoo
from model.denoiser import Denoiser


def find_weights(name: str | None) -> zoo.Weights:
    """A preset or weight file. Raises UsageError."""
    try:
        return zoo.find(name)
    except ValueError as error:
        raise UsageError(f"--model: {error}") from None
    except (KeyError, TypeError) as error:  # a config with other fields than ours
        raise UsageError(f"--model: {name}: its config is of another version of lbmc's network; train it again or use "
                         f"the lbmc that wrote it") from error


def load_network(weights: zoo.Weights) -> Denoiser:
    """The network of a weight file. Raises UsageError where its tensors are not those of this lbmc's networks."""
    try:
        return weights.load()
    except ValueError as error:
        raise UsageError(f"--model: {error}") from error


def choose_device(name: str) -> torch.device:
    """auto: the first GPU if there is one. Raises UsageError where CUDA is asked for and absent."""
    if name == "auto":
        return torch.device("cuda" if torch.cuda.is_available() else "cpu")
    device = torch.device(name)
    if device.type == "cuda" and (device.index or 0) >= torch.cuda.device_count():
        raise UsageError(f"--device {name}: this machine shows {torch.cuda.device_count()} CUDA devices to PyTorch; "
                         f"pass --device cpu, or install a CUDA build of torch")
    return device


def product_dtype(precision: str, device: torch.device) -> torch.dtype | None:
    """The type of matrix products; None is float32. `auto`: bf16 on a GPU, float32 on a CPU."""
    if precision == "auto":
        return torch.bfloat16 if device.type == "cuda" else None
    return {"fp32": None, "bf16": torch.bfloat16, "fp16": torch.float16}[precision]
