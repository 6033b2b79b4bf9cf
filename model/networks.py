"""The two building blocks of every denoiser: a multilayer perceptron on rows and a U-Net on pictures.

Leaky ReLU (slope 0.01) after every layer but an MLP's last, Xavier initialisation, no normalisation layers.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from model.config import UNetConfig

LEAK = 0.01

Box = tuple[slice, slice]
"""Rows and columns of a picture, with starts and stops."""


class Products(nn.Module):
    """A module whose matrix products may run in a lower precision than float32; its outputs keep that type."""

    product_dtype: torch.dtype | None = None  # None: the type of the inputs

    def products(self, like: Tensor) -> torch.autocast:
        """The context that every product of this module runs in."""
        low = self.product_dtype
        return torch.autocast(like.device.type, dtype=low or torch.bfloat16, enabled=low is not None)


def _xavier(module: nn.Linear | nn.Conv2d) -> None:
    nn.init.xavier_uniform_(module.weight, nn.init.calculate_gain("leaky_relu", LEAK))
    if module.bias is not None:
        nn.init.zeros_(module.bias)


def linear_columns(x: Tensor, weight: Tensor, bias: Tensor | None) -> Tensor:
    """`F.linear` of tables (N, C) and of (N, L, C) stored column by column, in that order; of others as they are."""
    if x.dim() == 2:
        return (weight @ x.T if bias is None else torch.addmm(bias[:, None], weight, x.T)).T
    if x.dim() > 3 or x.stride(0) != 1:
        return F.linear(x, weight, bias)
    layers = [linear_columns(layer, weight, bias).T for layer in x.unbind(1)]  # (outputs, N) each
    return torch.stack(layers).permute(2, 0, 1)


def _activate(table: Tensor) -> Tensor:
    """Leaky ReLU, in place without a gradient: with one, a transposed view that is overwritten is copied twice."""
    return F.leaky_relu(table, LEAK, inplace=not torch.is_grad_enabled())


class Mlp(Products):
    """Rows (N, inputs) -> (N, widths[-1]).

    The first layer is split by input group, W [a; b] = W_a a + W_b b, so that a group that many rows share (the context
    of a pixel's samples) is multiplied once per pixel: `first(group, x)` gives one group's part, `rest` finishes.
    """

    def __init__(self, groups: Sequence[int], widths: Sequence[int]) -> None:
        super().__init__()
        self.groups = nn.ModuleList(nn.Linear(size, widths[0], bias=k == 0) for k, size in enumerate(groups))
        self.layers = nn.ModuleList(nn.Linear(a, b) for a, b in pairwise(widths))
        whole = nn.Linear(sum(groups), widths[0])  # Xavier sees the layer as one matrix
        _xavier(whole)
        with torch.no_grad():
            for linear, block in zip(self.groups, torch.split(whole.weight, list(groups), 1), strict=True):
                assert isinstance(linear, nn.Linear)
                linear.weight.copy_(block)
                if linear.bias is not None:
                    linear.bias.zero_()
        for layer in self.layers:
            assert isinstance(layer, nn.Linear)
            _xavier(layer)

    def first(self, group: int, x: Tensor) -> Tensor:
        """One group's part of the first layer: (N, groups[group]) -> (N, widths[0]), before the activation."""
        with self.products(x):
            linear = self.groups[group]
            assert isinstance(linear, nn.Linear)
            return linear_columns(x, linear.weight, linear.bias)

    def rest(self, x: Tensor, activate_last: bool = False) -> Tensor:
        """From the sum of the first layer's parts, which may be overwritten, to the output."""
        with self.products(x):
            for layer in self.layers:
                assert isinstance(layer, nn.Linear)
                x = linear_columns(_activate(x), layer.weight, layer.bias)
        return _activate(x) if activate_last else x


class _Block(nn.Module):
    def __init__(self, inputs: int, widths: Sequence[int]) -> None:
        super().__init__()
        sizes = [inputs, *widths]
        self.convolutions = nn.ModuleList(
            nn.Conv2d(a, b, 3, padding=1) for a, b in pairwise(sizes)
        )
        for convolution in self.convolutions:
            assert isinstance(convolution, nn.Conv2d)
            _xavier(convolution)

    def forward(self, x: Tensor) -> Tensor:
        for convolution in self.convolutions:
            x = F.leaky_relu_(convolution(x), LEAK)
        return x


class _Fine(nn.Module):
    """Adds to an upsampled context what the picture itself shows between the pixels of the coarser network.

    The last layer starts at zero: the context is at first the upsampled one.
    """

    def __init__(self, inputs: int, context: int, widths: Sequence[int]) -> None:
        super().__init__()
        self.from_picture = nn.Conv2d(inputs, widths[0], 1)
        self.from_context = nn.Conv2d(context, widths[0], 1, bias=False)
        for convolution in (self.from_picture, self.from_context):
            _xavier(convolution)
        self.block = _Block(widths[0], widths[1:])
        self.last = nn.Conv2d(widths[-1], context, 1)
        nn.init.zeros_(self.last.weight)
        assert self.last.bias is not None
        nn.init.zeros_(self.last.bias)

    def forward(self, picture: Tensor, context: Tensor, box: Box | None = None) -> Tensor:
        """picture (B, inputs, H, W), context (B, C, H / scale, W / scale) -> (B, C, H, W).

        `box` : elsewhere the result is 0
        """
        scale = picture.shape[-1] // context.shape[-1]
        if box is None:
            return self._refined(picture, context, scale)
        halo = len(self.block.convolutions) + scale  # so far do pixels, and the edge of what is enlarged, reach
        rows, cols = (slice(max(side.start - halo, 0) // scale, -(-(side.stop + halo) // scale)) for side in box)
        top, left = rows.start * scale, cols.start * scale
        near = picture[..., top : rows.stop * scale, left : cols.stop * scale]
        refined = self._refined(near, context[..., rows, cols], scale)
        result = refined.new_zeros(*refined.shape[:2], *picture.shape[-2:])
        inside = (..., slice(box[0].start - top, box[0].stop - top), slice(box[1].start - left, box[1].stop - left))
        result[..., box[0], box[1]] = refined[inside]
        return result

    def _refined(self, picture: Tensor, context: Tensor, scale: int) -> Tensor:
        return _enlarged(context, scale) + self._added(picture, _enlarged(self.from_context(context), scale))

    def _added(self, picture: Tensor, hidden: Tensor) -> Tensor:
        x = self.block(F.leaky_relu_(self.from_picture(picture) + hidden, LEAK))
        added: Tensor = self.last(x)
        return added


def _enlarged(x: Tensor, scale: int) -> Tensor:
    return F.interpolate(x, scale_factor=scale, mode="bilinear", align_corners=False)


class UNet(Products):
    """Pictures (B, inputs, H, W) -> context (B, out_channels, H, W), H and W multiples of `config.stride`.

    Each encoder block ends in a 2x2 max-pool; skips are the pooled outputs and the raw input, as published.
    """

    def __init__(self, inputs: int, config: UNetConfig) -> None:
        super().__init__()
        self.config = config
        skips = [inputs, *(widths[-1] for widths in config.encoder[:-1])]
        sizes = [inputs, *(widths[-1] for widths in config.encoder)]
        self.encoder = nn.ModuleList(_Block(a, widths) for a, widths in zip(sizes, config.encoder, strict=False))
        self.bottleneck = _Block(sizes[-1], config.bottleneck)
        self.decoder = nn.ModuleList()
        below = config.bottleneck[-1]
        for skip, widths in zip(reversed(skips), config.decoder, strict=True):
            self.decoder.append(_Block(below + skip, widths))
            below = widths[-1]
        self.head = _Block(below, config.head)
        self.fine = _Fine(inputs, config.out_channels, config.fine) if config.fine else None

    def forward(self, picture: Tensor) -> Tensor:
        return self.levels(picture)[-1]

    def levels(self, picture: Tensor, box: Box | None = None) -> list[Tensor]:
        """The decoder's outputs, coarsest first; the last one is `finished`, the context."""
        *coarser, last = self.decoded(self.pooled(picture))
        return [*coarser, self.finished(picture, last, box)]

    def pooled(self, picture: Tensor) -> Tensor:
        """The picture at the resolution that the network works at."""
        return F.avg_pool2d(picture, self.config.scale) if self.config.scale > 1 else picture

    def decoded(self, x: Tensor) -> list[Tensor]:
        """Of a pooled picture the decoder's outputs, coarsest first; the last one has been through the head."""
        with self.products(x):
            skips, outputs = [], []
            for block in self.encoder:
                skips.append(x)
                x = F.max_pool2d(block(x), 2)
            x = self.bottleneck(x)
            for block, skip in zip(self.decoder, reversed(skips), strict=True):
                x = block(torch.cat([_enlarged(x, 2), skip], 1))
                outputs.append(x)
            outputs[-1] = self.head(x)
            return outputs

    def finished(self, picture: Tensor, decoded: Tensor, box: Box | None = None) -> Tensor:
        """The last of `decoded` at the picture's resolution.

        `box` : where it is wanted; elsewhere it may be 0
        """
        with self.products(picture):
            if self.fine is not None:
                context: Tensor = self.fine(picture, decoded, box)
                return context
            return _enlarged(decoded, self.config.scale) if self.config.scale > 1 else decoded
