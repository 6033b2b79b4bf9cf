"""A network's weights in a wider network that computes the same (Net2Net, Chen et al. 2016).

What the narrow network has keeps its place. New channels start at random and are read by nothing that was there before,
so that training begins where the narrow network ended.
"""

from __future__ import annotations

from dataclasses import replace

from torch import Tensor

from model.config import Config
from model.denoiser import Denoiser

__all__ = ["widened"]


def widened(narrow: Denoiser, config: Config) -> Denoiser:
    """A network of `config` that computes what `narrow` does.

    Widths are those of the U-Net, of the partitioner and of the generator. Raises ValueError where anything else
    differs, where a layer is narrower or missing, and for direct kernels.
    """
    before = narrow.config
    same = replace(config, name=before.name, unet=before.unet, partitioner=before.partitioner,
                   generator=before.generator) if config.kernel == "affinity" else None
    if same != before or config.unet.scale != before.unet.scale:
        raise ValueError("more than widths differ")
    wide = Denoiser(config).to(next(narrow.parameters()).dtype)
    old, new = narrow.state_dict(), wide.state_dict()
    if old.keys() != new.keys() or any(values.dim() != new[name].dim() for name, values in old.items()):
        raise ValueError("the layers are not the same")
    joins = _joined_inputs(narrow), _joined_inputs(wide)
    for name, values in old.items():
        if values.shape != new[name].shape:
            sizes = [joined.get(name, list(state[name].shape[1:2]))
                     for joined, state in zip(joins, (old, new), strict=True)]
            values = _placed(name, values, new[name], *sizes)
        new[name] = values
    wide.load_state_dict(new)
    return wide


def _placed(name: str, old: Tensor, new: Tensor, narrow: list[int], wide: list[int]) -> Tensor:
    """`old` (O,) or (O, I, ...) in place of what `new` has there.

    narrow, wide : how many of the inputs each of the joined sources has, in `old` and in `new`
    """
    larger = any(a > b for a, b in zip([len(old), *narrow], [len(new), *wide], strict=True))
    if larger or old.shape[2:] != new.shape[2:]:
        raise ValueError(f"{name} of {tuple(old.shape)} is no part of {tuple(new.shape)}")
    result = new.clone()
    if not narrow:
        result[: len(old)] = old
        return result
    result[: len(old)] = 0
    for source, place in zip(old.split(narrow, 1), result.split(wide, 1), strict=True):
        place[: len(old), : source.shape[1]] = source
    return result


def _joined_inputs(net: Denoiser) -> dict[str, list[int]]:
    """The inputs of the decoder's first convolutions: channels from below, then of the skip."""
    config = net.config.unet
    below = [config.bottleneck[-1], *(widths[-1] for widths in config.decoder[:-1])]
    found = {}
    for number, channels in enumerate(below):
        name = f"unet.decoder.{number}.convolutions.0.weight"
        found[name] = [channels, net.state_dict()[name].shape[1] - channels]
    return found
