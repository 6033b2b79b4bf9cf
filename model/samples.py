"""The network's input: path samples of a batch of images, flat, pixel after pixel (CSR).

`Segments` holds the reductions over the samples of each pixel. Nothing here knows what a feature means.

The networks work on samples by turns: the first sample of every pixel, then the second ones, and so on, in tables
stored column by column. What is done to a column or to the samples of a pixel then runs through memory in one go, which
is several times faster than rows of a few numbers.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

ROLE_WIDTHS: Mapping[str, int] = {
    "radiance": 3,
    "coverage": 1,
    "depth": 1,
    "normal": 3,
    "albedo": 3,
    "specular": 3,
    "roughness": 1,
    "motion": 2,
    "coc": 1,
    "lens": 2,
    "time": 1,
}


def columns(parts: Sequence[Tensor]) -> Tensor:
    """(N, ..., C_k) -> (N, ..., sum of C_k), stored column by column."""
    return torch.cat([part.movedim(0, -1) for part in parts], -2).movedim(-1, 0)


def by_turns(rows: Tensor, pixels: int) -> Tensor:
    """(N, C) in the pixels' order, equally many samples in each -> by turns, stored column by column."""
    return rows.reshape(pixels, -1, rows.shape[1]).permute(2, 1, 0).reshape(rows.shape[1], -1).T


class Segments:
    """Which samples belong to which pixel, and sums, maxima and gathers over them.

    Parameters
    ----------
    counts : (P,) integer tensor, samples of each pixel, any of them may be 0.

    When every pixel holds the same number of samples the reductions are reshapes; otherwise they go by index.
    """

    def __init__(self, counts: Tensor) -> None:
        self.counts = counts
        self.pixels = counts.numel()
        low, high = (int(counts.min()), int(counts.max())) if self.pixels else (0, 0)
        self.uniform: int | None = high if low == high and high > 0 else None
        self.total = self.pixels * high if self.uniform else int(counts.sum())
        self._index: Tensor | None = None

    @property
    def index(self) -> Tensor:
        """(N,) int64: the pixel of each sample."""
        if self._index is None:
            pixels = torch.arange(self.pixels, device=self.counts.device)
            self._index = torch.repeat_interleave(pixels, self.counts.long(), output_size=self.total)
        return self._index

    def expand(self, per_pixel: Tensor) -> Tensor:
        """(P, ...) -> (N, ...): each sample gets its pixel's value."""
        if self.uniform is not None:
            shape = (self.pixels, self.uniform, *per_pixel.shape[1:])
            return per_pixel.unsqueeze(1).expand(shape).reshape(self.total, *per_pixel.shape[1:])
        return per_pixel[self.index]

    def sum(self, per_sample: Tensor) -> Tensor:
        """(N, C) -> (P, C): sums over each pixel's samples, 0 for a pixel without any."""
        if self.uniform is not None:
            return per_sample.view(self.pixels, self.uniform, -1).sum(1)
        out = per_sample.new_zeros(self.pixels, per_sample.shape[1])
        return out.index_add(0, self.index, per_sample)

    def weighted_sum(self, weight: Tensor, per_sample: Tensor) -> Tensor:
        """weight (N, L), per_sample (N, C) -> (P, L, C): sum_i weight_il * value_ic."""
        if self.uniform is not None:
            left = weight.view(self.pixels, self.uniform, -1).transpose(1, 2)  # (P, L, n)
            return torch.bmm(left, per_sample.view(self.pixels, self.uniform, -1))
        products = weight[:, :, None] * per_sample[:, None]  # (N, L, C)
        return self.sum(products.flatten(1)).view(self.pixels, *products.shape[1:])

    def max(self, per_sample: Tensor) -> Tensor:
        """(N, C) -> (P, C): maxima over each pixel's samples, -inf for a pixel without any. Not differentiated."""
        values = per_sample.detach()
        if self.uniform is not None:
            return values.view(self.pixels, self.uniform, -1).amax(1)
        out = values.new_full((self.pixels, values.shape[1]), -torch.inf)
        index = self.index[:, None].expand_as(values)
        return out.scatter_reduce(0, index, values, "amax")


class _WeightedSum(torch.autograd.Function):
    """weight (L, turns, P), values (C, turns, P) -> (L, C, P), with a derivative that takes a column at a time.

    Of all columns at once, the products would be written and read again for every layer: 3 times slower in training.
    """

    @staticmethod
    def forward(ctx: Any, weight: Tensor, values: Tensor) -> Tensor:
        ctx.save_for_backward(weight, values)
        return torch.stack([(values * layer).sum(1) for layer in weight])

    @staticmethod
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor, Tensor]:
        weight, values = ctx.saved_tensors
        to_weight, to_values = torch.zeros_like(weight), torch.zeros_like(values)
        for column, value in enumerate(values):
            for layer, own in enumerate(weight):
                to_weight[layer].addcmul_(value, grad[layer, column])
                to_values[column].addcmul_(own, grad[layer, column])
        return to_weight, to_values


class Turns(Segments):
    """`Segments` of samples by turns: every pixel has the same number, at least one; see `Samples.by_turns`."""

    def _apart(self, per_sample: Tensor) -> Tensor:
        """(N, C) -> (C, turns, P)."""
        return per_sample.T.reshape(per_sample.shape[1], -1, self.pixels)

    def expand(self, per_pixel: Tensor) -> Tensor:
        """(P, C) -> (N, C)."""
        turns = self.total // self.pixels
        return per_pixel.T[:, None].expand(-1, turns, -1).reshape(per_pixel.shape[1], -1).T

    def sum(self, per_sample: Tensor) -> Tensor:
        """(N, C) -> (P, C)."""
        return self._apart(per_sample).sum(1).T

    def weighted_sum(self, weight: Tensor, per_sample: Tensor) -> Tensor:
        """weight (N, L), per_sample (N, C) -> (P, L, C)."""
        apply: Callable[..., Tensor] = _WeightedSum.apply
        return apply(self._apart(weight), self._apart(per_sample)).permute(2, 0, 1)

    def max(self, per_sample: Tensor) -> Tensor:
        """(N, C) -> (P, C). Not differentiated."""
        return self._apart(per_sample.detach()).amax(1).T


@dataclass
class Samples:
    """Path samples of a batch of B images of H x W pixels, in pixel order (image, row, column).

    Attributes
    ----------
    shape : (B, H, W)
    counts : (B*H*W,) integer; samples of each pixel
    weight : (N,) >= 0, sums to 1 over each pixel that has samples
    coverage : (N,) 0..1; features of a sample with coverage 0 (a miss) are never read
    roles : role -> (N, width) float32, see ROLE_WIDTHS; "radiance" always, linear, any scale
    extra : (N, E) values to filter by the radiance's own partition and kernels; never features. None: there are none
    lights : how many of its first columns are parts of the radiance, with the same texture
    squares : (N,) what each sample adds to the sum of squared weights of its pixel, which tells how noisy it is; None:
        the square of its weight. One that stands for several alike has theirs
    held : roles that are known to say nothing, such as motion where nothing moves: present, with features of 0
    turns : the samples are not in pixel order but by turns, and every pixel has the same number
    """

    shape: tuple[int, int, int]
    counts: Tensor
    weight: Tensor
    coverage: Tensor
    roles: dict[str, Tensor]
    extra: Tensor | None = None
    lights: int = 0
    squares: Tensor | None = None
    held: frozenset[str] = frozenset()
    turns: bool = False

    def __post_init__(self) -> None:
        batch, height, width = self.shape
        if self.counts.numel() != batch * height * width:
            raise ValueError(f"{self.counts.numel()} counts for {batch}x{height}x{width} pixels")
        if "radiance" not in self.roles:
            raise ValueError("the radiance role is required")
        for role, values in self.roles.items():
            if role not in ROLE_WIDTHS:
                raise ValueError(f"unknown role {role!r}; known: {', '.join(ROLE_WIDTHS)}")
            if values.shape != (self.weight.numel(), ROLE_WIDTHS[role]):
                raise ValueError(f"role {role}: shape {tuple(values.shape)}, expected ({self.weight.numel()}, "
                                 f"{ROLE_WIDTHS[role]})")
        if self.extra is not None and (self.extra.dim() != 2 or len(self.extra) != self.weight.numel()):
            raise ValueError(f"extra: shape {tuple(self.extra.shape)}, expected ({self.weight.numel()}, any)")
        if self.lights % 3 or self.lights > (0 if self.extra is None else self.extra.shape[1]):
            raise ValueError(f"{self.lights} columns of lights: three to a light, all of them in extra")

    @property
    def segments(self) -> Segments:
        """The reductions over each pixel's samples."""
        return Turns(self.counts) if self.turns else Segments(self.counts)

    def by_turns(self) -> Samples:
        """The same samples by turns, or as they are where pixels differ in their number of samples."""
        if self.turns or Segments(self.counts).uniform is None:
            return self
        pixels = self.counts.numel()

        def column(values: Tensor) -> Tensor:
            return by_turns(values[:, None], pixels)[:, 0]

        return Samples(
            self.shape,
            self.counts,
            column(self.weight),
            column(self.coverage),
            {role: by_turns(values, pixels) for role, values in self.roles.items()},
            None if self.extra is None else by_turns(self.extra, pixels),
            self.lights,
            None if self.squares is None else column(self.squares),
            self.held,
            turns=True,
        )

    def like(self, rows: Tensor) -> Tensor:
        """(N, C) in pixel order -> in the order of these samples."""
        return by_turns(rows, self.counts.numel()) if self.turns else rows

    def in_pixel_order(self, rows: Tensor) -> Tensor:
        """The inverse of `like`."""
        return by_turns(rows, rows.shape[0] // self.counts.numel()) if self.turns else rows

    def pixel_range(self, first: int, last: int, start: int, stop: int) -> Samples:
        """Pixels first..last (exclusive), whose samples are start..stop, as one image row."""
        return self._part(slice(first, last), slice(start, stop), last - first)

    def picked(self, pixels: Tensor, index: Tensor) -> Samples:
        """Pixels by number, whose samples are `index`, as one image row."""
        return self._part(pixels, index, len(pixels))

    def _part(self, pixels: slice | Tensor, own: slice | Tensor, count: int) -> Samples:
        return Samples(
            (1, 1, count),
            self.counts[pixels],
            self.weight[own],
            self.coverage[own],
            {role: values[own] for role, values in self.roles.items()},
            None if self.extra is None else self.extra[own],
            self.lights,
            None if self.squares is None else self.squares[own],
            self.held,
        )
