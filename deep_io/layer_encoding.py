"""Additive layers into over form: what a compositor's front-to-back over puts together to exactly the layers' sum.

Per pixel the layers are pooled where one by itself would be of no use, then written front to back with the
transmittance of the alphas *as rounded*:

    T = 1;  alpha_l = round(A_l / T), below 1 while anything remains behind;  RGB_l = round(C_l / T);  T *= 1 - alpha_l

so that over brings every layer back as T_l * RGB_l = C_l, to the rounding of its own value alone.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import DTypeLike, NDArray

from deep_io.roles import MISS_DEPTH
from deep_io.samples import DeepSamples, Window

Planes = NDArray[np.float32]
Flags = NDArray[np.bool_]

MIN_WEIGHT = 2.0**-10  # a layer that is less of the pixel than this joins its neighbour
# A compositor's running alpha is a float32, so it knows the third and later T only to about 6 * 2^-24 in all. A float
# value of more than this times the pixel's sum |C| would show that beyond 1e-5 of the sum.
FLOAT_GAIN = 16.0

# Depth is rounded to this many significant bits: finer than a filtered depth is known, and a third of its bytes.
DEPTH_BITS = 16

COLOR, ALPHA, WEIGHT, DEPTH = slice(0, -3), -3, -2, -1  # the planes of a stack
SUMS = slice(0, -1)  # those that add up when layers are pooled


@dataclass(frozen=True)
class OverLayers:
    """Layers of P pixels in over form, front first, in the type to be written.

    color    (L, C, P) premultiplied, and alpha (L, P); both 0 where a layer is not present
    depth    (L, P) float32; MISS_DEPTH where a layer is not present or has no hit
    present  (L, P) which layers hold anything
    clamped  values beyond the type's range although nothing lies in front of them
    """

    color: NDArray[np.floating[Any]]
    alpha: NDArray[np.floating[Any]]
    depth: Planes
    present: Flags
    clamped: int


def encode_layers(color: Planes, weight: Planes, coverage: Planes, depth: Planes | None, dtype: DTypeLike,
                  by_depth: bool) -> OverLayers:
    """Layers in over form.

    Parameters
        color     (L, C, P) C_l, what each layer adds to the beauty's R, G, B and to further channels; finite, may be
                  negative
        weight    (L, P) V_l, its share of the pixel; >= 0, sums to 1, or to 0 in a pixel that nothing reached
        coverage  (L, P) A_l, what it adds to the beauty's alpha; 0 <= A_l <= V_l
        depth     (L, P) not finite where a layer has no hit; None where depth is not known at all. Rounded to
                  DEPTH_BITS, within 1 part in 65536
        dtype     float16 or float32, of the result's color and alpha
        by_depth  True: front to back by depth, layers of equal depth pooled, for deep samples, whose place in the
                  pixel need not be their layer's. False: in the layers' own order, for one picture per layer

    Where layers are pooled, the heaviest of them takes all and lends its depth. Over of the result, nearest first or
    last, is sum C_l and sum A_l: within 2^-10 sum |C_l| + 2^-23 in half, within 1e-5 sum |C_l| in float.
    """
    layers, pixels = weight.shape
    planes = np.empty((layers, color.shape[1] + 3, pixels), np.float32)
    planes[:, COLOR], planes[:, ALPHA], planes[:, WEIGHT] = color, coverage, weight
    planes[:, DEPTH] = MISS_DEPTH
    if depth is not None:
        np.copyto(planes[:, DEPTH], _rounded(depth), where=np.isfinite(depth))
    slot = np.repeat(np.arange(layers, dtype=np.int8)[:, None], pixels, axis=1)
    if by_depth:
        _sort_by_depth(planes, slot)
    with np.errstate(over="ignore"):  # what overflows is pooled or clamped
        return _encode(planes, slot, _starts(planes, by_depth), np.dtype(dtype), in_slots=not by_depth)


def deep_samples(layers: OverLayers, window: Window, names: Sequence[str] = ("R", "G", "B")) -> DeepSamples:
    """The layers that are present as deep samples of the pixels of a window, row by row.

    `names` are those of the planes of `color`; A and Z are the others.
    """
    present = np.ascontiguousarray(layers.present.T)  # (P, L): the layers of a pixel are its samples

    def samples(plane: NDArray[Any]) -> NDArray[Any]:
        values: NDArray[Any] = plane.T[present]
        return values

    channels = {name: samples(layers.color[:, k]) for k, name in enumerate(names)}
    channels |= {"A": samples(layers.alpha), "Z": samples(layers.depth)}
    counts = layers.present.sum(axis=0, dtype=np.int32).reshape(window.height, window.width)
    return DeepSamples(counts, channels, window)


def _rounded(depth: Planes) -> Planes:
    """Depth to DEPTH_BITS significant bits; what that would make infinite stays."""
    drop = np.uint32(24 - DEPTH_BITS)
    bits = (np.ascontiguousarray(depth, np.float32).view(np.uint32) + (np.uint32(1) << (drop - np.uint32(1))))
    rounded = ((bits >> drop) << drop).view(np.float32)
    return np.where(np.isfinite(rounded), rounded, depth)


def _sort_by_depth(planes: Planes, slot: NDArray[np.int8]) -> None:
    """Sorts the layers of every pixel in place; most pixels are in order already."""
    unsorted = np.flatnonzero((planes[1:, DEPTH] < planes[:-1, DEPTH]).any(axis=0))
    order = np.argsort(planes[:, DEPTH, unsorted], axis=0, kind="stable")
    planes[..., unsorted] = np.take_along_axis(planes[..., unsorted], order[:, None], axis=0)
    slot[:, unsorted] = np.take_along_axis(slot[:, unsorted], order, axis=0)


def _starts(planes: Planes, by_depth: bool) -> Flags:
    """(L, P): which layers begin a sample of their own; the others join the one in front."""
    weight, depth = planes[:, WEIGHT], planes[:, DEPTH]
    starts = np.zeros(weight.shape, bool)
    starts[0] = True
    held = weight[0].copy()
    farthest = np.where(held > 0, depth[0], -np.inf)
    for layer in range(1, len(weight)):
        new = (weight[layer] >= MIN_WEIGHT) & (held >= MIN_WEIGHT)
        if by_depth:
            new &= depth[layer] > farthest
            np.copyto(farthest, depth[layer], where=weight[layer] > 0)
        starts[layer] = new
        held = np.where(new, weight[layer], held + weight[layer])
    return starts


def _encode(planes: Planes, slot: NDArray[np.int8], starts: Flags, dtype: np.dtype[Any], in_slots: bool) -> OverLayers:
    """Encodes with the given starts; pixels with a value too large are encoded again with fewer of them."""
    pooled, owner = _pool(planes, slot, starts)
    color, alpha = _composite(pooled, starts, dtype)
    too_large = _too_large(color, pooled, starts, dtype)
    again = np.flatnonzero(too_large.any(axis=0))
    limit = float(np.finfo(dtype).max)
    beyond = np.abs(color[0]) > limit
    beyond[:, again] = False
    clamped = int(np.count_nonzero(beyond))
    rounded = np.clip(color, -limit, limit).astype(dtype)
    present = (alpha > 0) | rounded.any(axis=1)
    depth = np.where(present, pooled[:, DEPTH], np.float32(MISS_DEPTH))
    if in_slots:
        for plane in (rounded.swapaxes(1, 2), alpha, depth, present):  # each (L, P) or (L, P, C)
            _move(plane, owner, starts, MISS_DEPTH if plane is depth else 0)
    if again.size:
        fewer = starts[:, again]
        fewer[too_large[:, again].argmax(axis=0), np.arange(again.size)] = False
        redone = _encode(planes[..., again], slot[:, again], fewer, dtype, in_slots)
        rounded[..., again], alpha[:, again] = redone.color, redone.alpha
        depth[:, again], present[:, again] = redone.depth, redone.present
        clamped += redone.clamped
    return OverLayers(rounded, alpha, depth, present, clamped)


def _pool(planes: Planes, slot: NDArray[np.int8], starts: Flags) -> tuple[Planes, NDArray[np.int8]]:
    """The planes with every layer that starts nothing summed into the one in front, and each one's heaviest layer."""
    pooled, owner = planes.copy(), slot.copy()
    heaviest = planes[:, WEIGHT].copy()
    for layer in range(len(planes) - 1, 0, -1):
        joins = ~starts[layer]
        moved = np.where(joins, pooled[layer, SUMS], 0)
        pooled[layer - 1, SUMS] += moved
        pooled[layer, SUMS] -= moved
        heavier = joins & (heaviest[layer] > heaviest[layer - 1])
        for plane in (pooled[:, DEPTH], owner, heaviest):
            np.copyto(plane[layer - 1], plane[layer], where=heavier)
    return pooled, owner


def _composite(pooled: Planes, starts: Flags, dtype: np.dtype[Any]) -> tuple[Planes, NDArray[np.floating[Any]]]:
    """C_l / T (L, C, P), not yet rounded, and the rounded alphas (L, P)."""
    below_one = np.nextafter(dtype.type(1), dtype.type(0))
    color = np.empty_like(pooled[:, COLOR])
    alpha = np.empty(starts.shape, dtype)
    remaining = np.ones(starts.shape[1], np.float32)
    for layer in range(len(pooled)):
        scale = 1 / np.where(remaining > 0, remaining, 1)
        most = np.where(starts[layer + 1:].any(axis=0), below_one, dtype.type(1))
        np.multiply(pooled[layer, COLOR], scale, out=color[layer])
        alpha[layer] = np.minimum((pooled[layer, ALPHA] * scale).astype(dtype), most)
        remaining *= 1 - alpha[layer].astype(np.float32)
    return color, alpha


def _too_large(color: Planes, pooled: Planes, starts: Flags, dtype: np.dtype[Any]) -> Flags:
    """(L, P): samples behind others whose value the type cannot hold, or over in float32 cannot bring back."""
    found = np.zeros(starts.shape, bool)
    size = np.abs(color[1:])
    found[1:] = (size > np.finfo(dtype).max).any(axis=1)
    if dtype == np.float32 and len(pooled) > 2:
        total = np.abs(pooled[:, COLOR]).sum(axis=0)
        found[1:] |= (size > FLOAT_GAIN * total).any(axis=1) & (np.cumsum(starts, axis=0)[1:] > 2)
    return found


def _move(plane: NDArray[Any], owner: NDArray[np.int8], starts: Flags, nothing: float) -> None:
    """Moves every sample from the layer it starts at to the layer it stands for, in place."""
    start, pixel = np.nonzero(starts & (owner != np.arange(len(starts), dtype=np.int8)[:, None]))
    values = plane[start, pixel]
    plane[start, pixel] = nothing
    plane[owner[start, pixel], pixel] = values
