"""Filtering by direct kernels: every tap's logit is predicted, and every target is normalised exactly.

With l_d(s) the logit of tap d at source s and n_s the source's occupancy, target t gets

    out_t = sum_d exp(l_d(s) + log n_s) value_s / sum_d exp(l_d(s) + log n_s),    s = t - d  (splatting)

under the largest l + log n over the taps that reach t, so nothing over- or underflows. For gathering, the logit is the
target's own, l_d(t). The log of the denominator, the mass, is returned too: with it, results over disjoint sets of
sources (layers, samples, blocks of rows) are merged exactly.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor

Tap = tuple[int, tuple[slice, slice], tuple[slice, slice]]


def _overlap(shift: int, length: int) -> tuple[slice, slice]:
    """Targets and sources of a shift along one axis: target = source + shift, both inside the picture."""
    return slice(max(shift, 0), length + min(shift, 0)), slice(max(-shift, 0), length - max(shift, 0))


def taps(size: int, height: int, width: int) -> Iterator[Tap]:
    """The taps of a size x size kernel that meet the picture: number, target rows and columns, source rows and columns.

    Tap number k moves by (k // size - size // 2, k % size - size // 2) pixels from source to target.
    """
    radius = size // 2
    for number in range(size * size):
        down, right = number // size - radius, number % size - radius
        if abs(down) < height and abs(right) < width:
            rows, cols = _overlap(down, height), _overlap(right, width)
            yield number, (rows[0], cols[0]), (rows[1], cols[1])


class _KernelFilter(torch.autograd.Function):
    """The tap loop with a hand-written derivative: K^2 shifted copies of the picture are never held at once."""

    @staticmethod
    def forward(ctx: Any, logits: Tensor, log_n: Tensor, values: Tensor, size: int,
                gather: bool) -> tuple[Tensor, Tensor]:
        height, width = log_n.shape[-2:]
        per_tap = values.shape[1] > 1
        peak = torch.full_like(log_n, -torch.inf)
        for tap, target, source in taps(size, height, width):
            score = logits[:, tap][:, *(target if gather else source)] + log_n[:, *source]
            at = peak[:, *target]
            torch.maximum(at, score, out=at)
        peak = torch.where(peak == -torch.inf, 0, peak)
        total = torch.zeros_like(log_n)
        out = values.new_zeros(values.shape[0], *values.shape[2:])
        for tap, target, source in taps(size, height, width):
            score = logits[:, tap][:, *(target if gather else source)] + log_n[:, *source]
            weight = score.sub_(peak[:, *target]).exp_()
            total[:, *target] += weight
            plane = values[:, tap if per_tap else 0]
            for k in range(out.shape[1]):
                out[:, k][:, *target].addcmul_(weight, plane[:, k][:, *source])
        some = total > 0
        safe = torch.where(some, total, 1)
        out /= safe[:, None]
        mass = torch.where(some, torch.log(safe) + peak, -torch.inf)
        ctx.save_for_backward(logits, log_n, values, out, mass)
        ctx.size, ctx.gather = size, gather
        return out, mass

    @staticmethod
    def backward(ctx: Any, grad: Tensor, grad_mass: Tensor) -> Any:
        logits, log_n, values, out, mass = ctx.saved_tensors
        height, width = log_n.shape[-2:]
        per_tap = values.shape[1] > 1
        divide = torch.where(mass == -torch.inf, torch.inf, mass)  # weight 0 at targets that nothing reaches
        common = grad_mass - (grad * out).sum(1)  # (B, H, W): every tap's logit shares it
        to_logits, to_n, to_values = torch.zeros_like(logits), torch.zeros_like(log_n), torch.zeros_like(values)
        for tap, target, source in taps(ctx.size, height, width):
            side = target if ctx.gather else source
            score = logits[:, tap][:, *side] + log_n[:, *source]
            weight = score.sub_(divide[:, *target]).exp_()
            plane, back = values[:, tap if per_tap else 0], to_values[:, tap if per_tap else 0]
            inner = common[:, *target].clone()
            for k in range(out.shape[1]):
                pull = grad[:, k][:, *target]
                inner.addcmul_(pull, plane[:, k][:, *source])
                back[:, k][:, *source].addcmul_(weight, pull)
            inner *= weight  # d loss / d logit
            to_logits[:, tap][:, *side] = inner
            to_n[:, *source] += inner
        return to_logits, to_n, to_values, None, None


def kernel_filter(logits: Tensor, log_n: Tensor, values: Tensor, gather: bool = False) -> tuple[Tensor, Tensor]:
    """Filters pictures by predicted kernels.

    Parameters
    ----------
    logits : (B, K*K, H, W); K odd; of the source pixel's taps, or with `gather` of the target's
    log_n : (B, H, W) log occupancy of each source, -inf for none
    values : (B, C, H, W) per unit of occupancy, or (B, K*K, C, H, W) where they differ from tap to tap

    Returns
    -------
    (B, C, H, W) means over the sources in reach, 0 where there is none, and (B, H, W) the log of their mass,
    log sum exp(l + log n), -inf where there is none.
    """
    size = round(logits.shape[1] ** 0.5)
    if size * size != logits.shape[1] or size % 2 == 0:
        raise ValueError(f"{logits.shape[1]} logits per pixel are not a square kernel of odd size")
    if values.dim() == 4:
        values = values[:, None]
    apply: Callable[..., tuple[Tensor, Tensor]] = _KernelFilter.apply
    return apply(logits, log_n, values, size, gather)


def merge(first: tuple[Tensor, Tensor], second: tuple[Tensor, Tensor]) -> tuple[Tensor, Tensor]:
    """Means and masses of the union of two disjoint sets of sources."""
    mass = torch.logaddexp(first[1], second[1])
    safe = torch.where(mass == -torch.inf, 0, mass)
    means = sum(part * torch.exp(log - safe)[:, None] for part, log in (first, second))
    assert isinstance(means, Tensor)
    return means, mass


class RowMerger:
    """Filters a tall picture in blocks of rows, and merges what the blocks' halos share.

    Kernels are made block by block, so that they never exist for a whole picture. Without a gradient only.
    """

    def __init__(self, means: Tensor, mass: Tensor) -> None:
        """means (B, C, H, W) and mass (B, H, W): where to put results; overwritten."""
        self.means, self.mass = means.zero_(), mass.fill_(-torch.inf)

    def splat(self, first: int, logits: Tensor, log_n: Tensor, values: Tensor) -> None:
        """Adds a block of sources: rows `first` and following; arguments as for `kernel_filter`."""
        radius = round(logits.shape[1] ** 0.5) // 2
        above = min(radius, first)
        below = min(radius, self.mass.shape[1] - first - log_n.shape[1])
        pad = (0, 0, above, below)
        new = kernel_filter(F.pad(logits, pad), F.pad(log_n, pad, value=-torch.inf), F.pad(values, pad))
        rows = slice(first - above, first + log_n.shape[1] + below)
        self.means[:, :, rows], self.mass[:, rows] = merge((self.means[:, :, rows], self.mass[:, rows]), new)

    def gather(self, first: int, logits: Tensor, log_n: Tensor, values: Tensor) -> None:
        """Sets a block of targets: logits of the rows `first` and following; log_n and values of the whole picture."""
        radius = round(logits.shape[1] ** 0.5) // 2
        height = logits.shape[-2]
        above = min(radius, first)
        below = min(radius, self.mass.shape[1] - first - height)
        rows = slice(first - above, first + height + below)
        means, mass = kernel_filter(F.pad(logits, (0, 0, above, below)), log_n[:, rows], values[:, :, rows], True)
        inside = slice(above, above + height)
        self.means[:, :, first : first + height] = means[:, :, inside]
        self.mass[:, first : first + height] = mass[:, inside]
