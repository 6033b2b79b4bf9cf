"""From the channels of deep samples to path samples: weighting decoded, roles mapped, spaces converted, values mended.

Works on samples in memory; opening files and reading blocks of rows is path_samples.py's business.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from deep_io.camera import Camera
from deep_io.conventions import DEPTH_ATTRIBUTE, Conventions, resolve
from deep_io.csr import Index, offsets_of, pixels_of
from deep_io.errors import InputError, UsageError
from deep_io.header import Header
from deep_io.over import decode_over
from deep_io.role_matching import map_roles
from deep_io.roles import MISS_DEPTH, ROLES, RoleMap
from deep_io.samples import DeepSamples, Window
from deep_io.weighting import (
    ATTRIBUTE,
    RADIANCE_LAYERS,
    WEIGHTINGS,
    Weighted,
    decode_packed,
    decode_uniform,
    has_fractions,
    uniform_weights,
)

Values = NDArray[np.float32]

_LARGEST_HALF = np.float32(65504)
# Beyond these a value is as broken as Inf: FLT_MAX is what uninitialised or overflowed buffers hold, and the network's
# sums and products of such values would overflow. A feature beyond half's range is none either.
LARGEST_RADIANCE = np.float32(1e30)
LARGEST_FEATURE = _LARGEST_HALF
# Files of over and packed form hold no two equal depths in a pixel: a second unknown depth, 0, is stored as 1e-45.
_SMALLEST_DEPTH = np.finfo(np.float32).tiny


@dataclass
class PathSamples:
    """The path samples of a block of whole rows, pixel after pixel.

    counts    int32 (H, W)          samples per pixel; 0: nothing is known about the pixel
    weight    float32 (N,)          sums to 1 in every pixel that has samples
    coverage  float32 (N,)          0 where the camera ray missed, 1 where it hit, fractions for opacity
    roles     name -> float32 (N, width)   "radiance" always, the others where the file has them, "coverage" never;
                                    0 in every role but radiance where coverage is 0, and for values that were mended,
                                    so a depth of 0 is an unknown one
    window    Window                the pixels' place in the frame
    repairs   Counter               role -> samples whose value was broken (not finite, absurdly large, a negative
                                    depth) and mended
    extra     float32 (N, E)        the channels carried along, those that are parts of the radiance first
    source    int64 (N,)            which sample of the file's block each one is, -1 for a virtual miss; None: all, in
                                    their order
    """

    counts: NDArray[np.int32]
    weight: Values
    coverage: Values
    roles: dict[str, Values]
    window: Window
    repairs: Counter[str] = field(default_factory=Counter)
    extra: Values = field(default_factory=lambda: np.empty((0, 0), np.float32))
    source: Index | None = None

    @property
    def total(self) -> int:
        """N, the number of samples."""
        return self.weight.size

    @property
    def offsets(self) -> Index:
        """(H*W+1,) where each pixel's samples begin."""
        return offsets_of(self.counts)


@dataclass(frozen=True)
class Interpretation:
    """Everything that turns a file's channels into path samples; one per file, the same for all its blocks.

    declared  whether the weighting was given by the header or an option; if not, fractional alpha is refused
    lights    channels to carry along that are parts of the radiance, weighted and stored as it is
    data      channels to carry along that are anything else
    """

    header: Header
    mapping: RoleMap
    weighting: str
    declared: bool
    conventions: Conventions
    path: str
    lights: tuple[str, ...] = ()
    data: tuple[str, ...] = ()


def interpretation(header: Header, path: str, overrides: Mapping[str, str] | None = None,
                   weighting: str | None = None, normals: str = "auto", depth: str = "auto",
                   camera: Camera | None = None) -> Interpretation:
    """How the samples under a header are to be read; parameters and errors as for path_samples.SampleReader."""
    if weighting is not None and weighting not in WEIGHTINGS:
        raise UsageError(f"--weighting {weighting}: must be one of {', '.join(WEIGHTINGS)}")
    if header.get(DEPTH_ATTRIBUTE) == "none":
        overrides = {"depth": "none", **(overrides or {})}  # Z orders the samples and measures nothing
    mapping = map_roles(header.channel_names, overrides, attributes=header.attributes,
                        dtypes={channel.name: channel.dtype for channel in header.channels}, source=path,
                        lights=header.get(RADIANCE_LAYERS) or ())
    stated = header.get(ATTRIBUTE)
    chosen = weighting or stated
    if chosen is not None and chosen not in WEIGHTINGS:
        raise InputError(f"{path}: {ATTRIBUTE} is {stated!r}; pass --weighting {', '.join(WEIGHTINGS)}")
    if chosen in ("packed", "over") and "coverage" not in mapping:
        raise InputError(f"{path}: weighting {chosen} needs an alpha channel; name it with --map coverage=CHANNEL")
    return Interpretation(header, mapping, chosen or "uniform", chosen is not None,
                          resolve(header, mapping, path, normals, depth, camera), path)


def path_samples(deep: DeepSamples, how: Interpretation) -> PathSamples:
    """Deep samples held in memory as path samples. Raises InputError for fractional alpha without a weighting."""
    return decode_block(deep.counts, dict(deep.channels), deep.window, how)


def decode_block(counts: NDArray[np.int32], channels: dict[str, NDArray[np.generic]], window: Window,
                 how: Interpretation) -> PathSamples:
    """Path samples of a block; takes the channels out of `channels` role by role, so that nothing is held twice."""
    repairs: Counter[str] = Counter()
    lights, data = (_carried(names, channels, repairs) for names in (how.lights, how.data))
    radiance, broken = _radiance(how.mapping, channels, how.weighting, repairs)
    depth, alpha = _depth(how, channels), _alpha(how.mapping, channels, repairs)
    if alpha is not None and not how.declared and has_fractions(alpha):
        raise InputError(f"{how.path}: alpha is fractional and the header has no {ATTRIBUTE}, so the samples may be "
                         f"path samples or ordinary deep; pass --weighting uniform or over")
    if how.lights:
        radiance = np.concatenate([radiance, lights], axis=1)
    decoded = _weighted(how.weighting, counts, radiance, alpha, depth)
    del radiance
    if broken is not None:
        _leave_out(decoded, broken)
    _cover_by_depth(decoded, depth, how.conventions)
    misses = np.flatnonzero(decoded.coverage == 0)
    extra = _extra(decoded, data)
    roles = {"radiance": decoded.radiance[:, :3]}
    for role in how.mapping.sources:
        if role in ("radiance", "coverage"):
            continue
        stored = depth if role == "depth" and depth is not None else _stack(how.mapping, role, channels)
        roles[role] = _in_order(stored, decoded)
        _mend(roles[role], role, misses, repairs)
    if "normal" in roles:
        how.conventions.to_view(roles["normal"])
    factor = how.conventions.planar_factor(how.header, window) if "depth" in roles else None
    if factor is not None:
        roles["depth"] *= np.repeat(factor.ravel(), decoded.counts)[:, None]
    return PathSamples(decoded.counts.reshape(counts.shape), decoded.weight, decoded.coverage, roles, window, repairs,
                       extra, decoded.order)


def radiance_values(stored: NDArray[np.generic]) -> tuple[Values, NDArray[np.bool_]]:
    """A channel of light in float32 with half's overflows at half's largest value, and which values are light at all.

    Those that are not are NaN, -Inf, in a float channel Inf, and magnitudes beyond LARGEST_RADIANCE.
    """
    values = stored.astype(np.float32)
    if stored.dtype == np.float16:
        values[np.isposinf(values)] = _LARGEST_HALF
    return values, _within(values, LARGEST_RADIANCE)


def _carried(names: tuple[str, ...], channels: Mapping[str, NDArray[np.generic]], repairs: Counter[str]) -> Values:
    """(N, len(names)) float32 of channels, sound: an overflow of half is its largest value, the rest becomes 0."""
    columns = []
    for name in names:
        values = channels[name].astype(np.float32)
        if not _all_within(values, LARGEST_RADIANCE):
            repairs[name] += int((~_within(values, LARGEST_RADIANCE)).sum())
            values, sound = radiance_values(channels[name])
            values[~sound] = 0
        columns.append(values)
    return np.stack(columns, axis=1) if columns else np.empty((0, 0), np.float32)


def _extra(decoded: Weighted, data: Values) -> Values:
    """(M, E) the carried channels of the decoded samples: lights, decoded with the radiance, then data."""
    lights = decoded.radiance[:, 3:]
    if not data.shape[1]:
        return lights
    ordered = _in_order(data, decoded)
    if decoded.order is not None:
        ordered = np.where(decoded.order[:, None] < 0, np.float32(0), ordered)
    return np.concatenate([lights, ordered], axis=1)


def _weighted(weighting: str, counts: NDArray[np.int32], radiance: Values, alpha: NDArray[np.floating[Any]] | None,
              depth: Values | None) -> Weighted:
    if weighting == "uniform":
        return decode_uniform(counts, radiance, None if alpha is None else np.clip(alpha.astype(np.float32), 0, 1))
    if alpha is None:
        raise ValueError(f"weighting {weighting} without alpha")
    # A depth that is not a number says nothing about the order: behind everything.
    order = None if depth is None else np.where(np.isnan(depth[:, 0]), np.float32(np.inf), depth[:, 0])
    decode = decode_packed if weighting == "packed" else decode_over
    return decode(counts, radiance, alpha, order)


def _stack(mapping: RoleMap, role: str, channels: dict[str, NDArray[np.generic]]) -> Values:
    """(N, width) float32 of a role's channels, which are dropped from `channels` unless another role needs them."""
    names = mapping[role].channels
    shared = {name for other, source in mapping.sources.items() if other != role for name in source.channels}
    stacked = np.empty((channels[names[0]].size, len(names)), np.float32)
    for index, name in enumerate(names):
        stacked[:, index] = channels[name] if name in shared else channels.pop(name)
    return stacked


def _in_order(stored: Values, decoded: Weighted) -> Values:
    """A feature (N, width) in the order of the decoded samples (M, width)."""
    if decoded.order is None:
        return stored
    if not len(stored):  # only virtual misses
        return np.zeros((decoded.order.size, stored.shape[1]), np.float32)
    return stored[decoded.order]  # a virtual miss reads the last sample, and is zeroed with the other misses


def _within(values: Values, largest: np.float32) -> NDArray[np.bool_]:
    """Which values are numbers of a magnitude up to `largest`; NaN is not."""
    return np.abs(values) <= largest


def _all_within(values: Values, largest: np.float32) -> bool:
    """Whether all are; NaN goes through minimum and maximum and compares as false."""
    return not values.size or bool(values.max() <= largest and values.min() >= -largest)


def _radiance(mapping: RoleMap, channels: dict[str, NDArray[np.generic]], weighting: str, repairs: Counter[str]
              ) -> tuple[Values, NDArray[np.bool_] | None]:
    """Radiance (N, 3), sound, and which samples have none and must be left out (None: no sample)."""
    half = np.array([channels[name].dtype == np.float16 for name in mapping["radiance"].channels])
    radiance = _stack(mapping, "radiance", channels)
    if _all_within(radiance, LARGEST_RADIANCE):
        return radiance, None
    repairs["radiance"] += int((~_within(radiance, LARGEST_RADIANCE)).any(axis=1).sum())
    # Half's largest value is what a renderer's overflow stands for; in float, Inf is as wrong as NaN.
    radiance[np.isposinf(radiance) & half] = _LARGEST_HALF
    broken: NDArray[np.bool_] = np.logical_not(_within(radiance, LARGEST_RADIANCE).all(axis=1))
    radiance[broken] = 0
    return (radiance, broken) if weighting != "over" and bool(broken.any()) else (radiance, None)


def _depth(how: Interpretation, channels: dict[str, NDArray[np.generic]]) -> Values | None:
    return _stack(how.mapping, "depth", channels) if "depth" in how.mapping else None


def _alpha(mapping: RoleMap, channels: dict[str, NDArray[np.generic]], repairs: Counter[str]
           ) -> NDArray[np.floating[Any]] | None:
    """(N,) alpha in its stored type, which tells its rounding; what is not finite becomes 0."""
    if "coverage" not in mapping:
        return None
    stored = channels[mapping["coverage"].channels[0]]
    alpha: NDArray[np.floating[Any]] = stored.astype(stored.dtype.type if stored.dtype.kind == "f" else np.float32,
                                                     copy=False)
    finite = np.isfinite(alpha)
    if not finite.all():
        repairs["coverage"] += int((~finite).sum())
        alpha = np.where(finite, alpha, alpha.dtype.type(ROLES["coverage"].missing))
    return alpha


def _leave_out(decoded: Weighted, broken: NDArray[np.bool_]) -> None:
    """Drop the samples marked in stored order and share their weight among the rest of the pixel (equal weights)."""
    kept = np.flatnonzero(~(broken if decoded.order is None else broken[decoded.order]))
    decoded.counts = np.bincount(pixels_of(decoded.counts)[kept], minlength=decoded.counts.size).astype(np.int32)
    decoded.order = kept if decoded.order is None else decoded.order[kept]
    decoded.weight = uniform_weights(decoded.counts)
    decoded.coverage, decoded.radiance = decoded.coverage[kept], decoded.radiance[kept]


def _cover_by_depth(decoded: Weighted, depth: Values | None, conventions: Conventions) -> None:
    """A sample whose depth says miss has coverage 0, whatever its alpha: skies may be opaque, but were not hit."""
    if depth is None or not depth.size:
        return
    miss = conventions.is_miss(depth[:, 0])
    if miss.any():
        decoded.coverage = np.where(miss if decoded.order is None else miss[decoded.order], np.float32(0),
                                    decoded.coverage)


def _mend(values: Values, role: str, misses: Index, repairs: Counter[str]) -> None:
    """Set the missing value on misses and unknown depths, which does not count, and on broken values, which does.

    A depth below 0 is broken.
    """
    missing = np.float32(ROLES[role].missing)
    values[misses] = missing
    if role == "depth":
        values[(values > 0) & (values < _SMALLEST_DEPTH)] = missing
    largest = np.float32(MISS_DEPTH) if role == "depth" else LARGEST_FEATURE
    negative = role == "depth" and bool(values.size) and not values.min() >= 0
    if not negative and _all_within(values, largest):
        return
    bad = ~_within(values, largest).all(axis=1)
    if role == "depth":
        bad |= values[:, 0] < 0
    repairs[role] += int(bad.sum())
    values[bad] = missing
