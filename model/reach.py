"""How far one pixel's influence goes, exactly: halos of tiles are this wide.

Worked out backwards along one axis: which inputs, first to last, does the output at pixel x see? Pooling and upsampling
make the answer depend on x modulo the stride, so all x of one stride are asked. Picture borders only cut it.
"""

from __future__ import annotations

import math
from functools import lru_cache

from model.config import DIVISOR_WINDOW, Config, UNetConfig

Span = tuple[int, int]  # first and last index along an axis, inclusive


def _grow(span: Span, by: int) -> Span:
    return span[0] - by, span[1] + by


def _union(*spans: Span) -> Span:
    return min(first for first, _ in spans), max(last for _, last in spans)


def _cells(span: Span, size: int) -> Span:
    """The cells of `size` pixels that hold a span of pixels."""
    return span[0] // size, span[1] // size


def _pixels(span: Span, size: int) -> Span:
    """The pixels of a span of cells: average and max pooling."""
    return span[0] * size, span[1] * size + size - 1


def _bilinear(span: Span, size: int) -> Span:
    """The cells between whose centres (align_corners=False) a span of pixels is interpolated."""
    return math.floor((span[0] + 0.5) / size - 0.5), math.floor((span[1] + 0.5) / size - 0.5) + 1


def unet_span(span: Span, unet: UNetConfig, level: int = 0) -> Span:
    """Input pixels that the decoder's output at 1/2**level of the picture's resolution sees; span in its own pixels.

    Level 0 is the network's own output, upsampled from 1/scale; levels above 0 exist for scale 1.
    """
    if level == 0:
        span = _grow(_finished(span, unet), len(unet.head))
    return _pixels(_decoded(span, unet, level), unet.scale)


def _finished(span: Span, unet: UNetConfig) -> Span:
    """Pixels of the decoder's last output, at 1/scale of the picture's resolution, that the context sees."""
    span = _grow(span, max(len(unet.fine) - 1, 0))  # the first is 1x1
    return _bilinear(span, unet.scale) if unet.scale > 1 else span


def _decoded(span: Span, unet: UNetConfig, level: int) -> Span:
    if level == len(unet.encoder):
        return _encoded(_grow(span, len(unet.bottleneck)), unet, level)
    span = _grow(span, len(unet.decoder[-1 - level]))
    return _union(_encoded(span, unet, level), _decoded(_bilinear(span, 2), unet, level + 1))


def _encoded(span: Span, unet: UNetConfig, level: int) -> Span:
    if level == 0:
        return span
    return _encoded(_grow(_pixels(span, 2), len(unet.encoder[level - 1])), unet, level - 1)


def _output_span(x: int, config: Config, halo: int, decoded: bool) -> Span:
    """Input pixels that output pixel x sees.

    halo : how far the per-pixel statistics look by themselves
    decoded : whether what the U-Net decodes is given
    """
    def context(span: Span) -> Span:
        unet = config.unet
        return _pixels(_finished(span, unet), unet.scale) if decoded else unet_span(span, unet)

    target = (x, x)
    seen = [context(target)]
    if config.demodulation:
        sources = _grow(target, DIVISOR_WINDOW // 2)
        seen += [sources, context(sources)]
    for level, window in enumerate(config.kernel_sizes):
        size = 2**level
        if config.kernel == "affinity":  # targets keep their full resolution, and so do predictions
            sources = _grow(_pixels(_grow(_cells(target, size), window // 2), size), config.guide_reach)
            seen.append(context(sources))
        else:
            own = target if level == 0 else _bilinear(target, size)
            cells = _grow(own, window // 2)
            sources = _pixels(cells, size)
            seen.append(unet_span(own if config.variant == "pixel_gather" else cells, config.unet, level))
        seen.append(sources)
        if config.layered:  # samples of the sources are partitioned by the context at full resolution
            seen.append(context(sources))
    return _grow(_union(*seen), halo)


@lru_cache(maxsize=8)
def influence(config: Config, stride: int, halo: int, decoded: bool = False) -> int:
    """Pixels: nothing farther than this from a pixel changes it, if tiles start at multiples of `stride`.

    decoded : and if they are given what the U-Net decodes of the whole picture; for affinity kernels
    """
    spans = ((x, _output_span(x, config, halo, decoded)) for x in range(stride))
    return max(max(x - first, last - x) for x, (first, last) in spans)
