"""The denoiser: path samples in, layers out. One class for every `Config`.

The flow, top to bottom: embed the samples, gather the context, partition and splat the samples to the layers of their
pixel, predict kernels, filter, composite. At inference the per-sample stages run in chunks that fit the caches.
"""

from __future__ import annotations

from collections.abc import Iterator

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from model.chunks import Chunk, Index, chunks, in_one_chunk, together
from model.compositing import Layers, composite, fill_holes, to_layers
from model.config import Config
from model.direct import filter_direct, make_generators, splat_samples
from model.features import FrameScale, log_radiance
from model.guided import (
    GUIDED_COLUMNS,
    filter_guided,
    generator_sizes,
    guide_values,
    initial_guides,
    noise_values,
    predict,
)
from model.networks import Mlp, Products, UNet
from model.partition import (
    OUTLIER_START,
    PRIOR_WINDOW,
    basic_values,
    extra_values,
    initial_logits,
    kept_logits,
    outlierness,
    relative_depth,
    splat,
)
from model.reach import influence
from model.reducer import LogFeatures, SampleReducer, context_inputs, pixel_rows
from model.samples import Samples, columns
from model.targets import TARGET_CELL, box_of, cells_with, sources_of

CONFIDENCE_START = -3.0  # softplus(-3) = 0.05: nearly unbiased at the start
OUTLIER_RATE_START = -1.5  # softplus(-1.5) = 0.2: what each log unit beyond OUTLIER_START adds to gamma


class Denoiser(nn.Module):
    """A layer denoiser. `forward(samples, scale)` returns `Layers`.

    Parameters
    ----------
    config : what it is made of

    Notes
    -----
    The output is linear in radiance for a fixed partition and fixed kernels, and scales with it exactly when `scale`
    is measured from the same input. Pictures of any size are accepted; halos and tiles are the caller's business,
    `reach` says how far a pixel's influence goes. It computes in the type of the samples and of its own parameters,
    float64 for a reference; `set_product_dtype` lowers the precision of the matrix products alone.
    """

    def __init__(self, config: Config) -> None:
        super().__init__()
        self.config = config
        self.reducer = SampleReducer(config) if config.reducer else LogFeatures(config)
        self.unet = UNet(context_inputs(config), config.unet)
        context, embedding = config.unet.out_channels, config.embedding
        if config.layered:
            outputs = config.partition_logits + int(config.confidence)
            mine = embedding + int(config.depth_prior) + int(config.confidence)
            self.partitioner = Mlp([context, mine], (*config.partitioner, outputs))
        if config.depth_prior:
            self.prior_strength = nn.Parameter(torch.tensor(1.5))
        if config.confidence:
            self.outlier_rate = nn.Parameter(torch.tensor(OUTLIER_RATE_START))
        if config.kernel == "direct":
            finest_first = [context, *(widths[-1] for widths in reversed(config.unet.decoder[:-1]))]
            self.generators = make_generators(config, finest_first)
        else:
            self.generator = Mlp([context, embedding + 2], (*config.generator, sum(generator_sizes(config))))
            self.layer_bias = nn.Parameter(torch.zeros(config.partition_logits, config.generator[0]))
            self.guide_matrix = nn.Parameter(initial_guides(config))
        self._start_small()

    def _start_small(self) -> None:
        """At step 0 the partition is the depth prior's and an affinity kernel the guides'."""
        config = self.config
        with torch.no_grad():
            if config.depth_prior:
                _shrink(self.partitioner)
            if config.kernel == "affinity":
                _shrink(self.generator)
            if config.confidence:
                _last(self.partitioner).bias[-1] = CONFIDENCE_START

    def set_product_dtype(self, dtype: torch.dtype | None) -> Denoiser:
        """Lets matrix products and convolutions run in bfloat16 or float16; everything else stays in float32."""
        for module in self.modules():
            if isinstance(module, Products):
                module.product_dtype = dtype
        return self

    @property
    def reach(self) -> int:
        """Pixels: nothing farther than this from a pixel changes it."""
        return influence(self.config, self.stride, self._statistics_reach)

    @property
    def tile_reach(self) -> int | None:
        """The same for a tile that is given what `decoded_context` made of the whole picture. None: it cannot be, for
        direct kernels are made of every level of the context."""
        if self.config.kernel == "direct":
            return None
        return influence(self.config, self.stride, self._statistics_reach, decoded=True)

    @property
    def _statistics_reach(self) -> int:
        return PRIOR_WINDOW // 2 if self.config.depth_prior else 0

    @property
    def stride(self) -> int:
        """Tiles start at multiples of this many pixels, so that pooling cells and levels coincide."""
        return max(self.config.unet.stride, 1 << (len(self.config.kernel_sizes) - 1))

    def forward(self, samples: Samples, scale: FrameScale, layers: int | None = None, fill: bool = True,
                wanted: Tensor | None = None, decoded: Tensor | None = None) -> Layers:
        """Denoises a batch of pictures.

        Parameters
        ----------
        samples : any number in any pixel
        scale : the frame's (or shot's), measured over the whole frame
        layers : 1 to `config.partition_logits`; default `config.layers`
        fill : fill targets that no sample reaches (`fill_holes`); a caller with tiles does that for the whole frame
        wanted : (B, H, W) bool; pixels whose result will be used, at least one. What is computed of the others is not
            said; all samples count all the same. None: every pixel
        decoded : these pixels' part, padded to the stride, of the `decoded_context` of a larger picture, so that its
            halo need not be wider than `tile_reach`

        Returns
        -------
        `Layers` of samples.shape.
        """
        config = self.config
        keep = kept_logits(layers or config.layers, config.partition_logits)
        if in_one_chunk(samples) and config.variant != "sample_splat":
            samples = samples.by_turns()
        if torch.is_grad_enabled() or config.kernel != "affinity" or (wanted is not None and bool(wanted.all())):
            wanted = None
        seen = None if wanted is None else sources_of(wanted, config.kernel_sizes, config.guide_reach)
        relative = self._surroundings(samples, scale)
        contexts, embedding = self._context(samples, relative, scale, seen, decoded)
        context = _rows(contexts[0], samples.shape)  # (P, C)
        if config.variant == "sample_splat":
            visible = self._splat_samples(samples, embedding, context, scale)
        elif config.kernel == "direct":
            visible = self._filter_direct(samples, embedding, relative, contexts, context, scale, keep)
        else:
            visible = self._filter_affinity(samples, embedding, relative, context, scale, keep, wanted, seen)
        result = to_layers(visible)
        return fill_holes(result) if fill else result

    def partition(self, samples: Samples, scale: FrameScale, layers: int | None = None, decoded: Tensor | None = None
                  ) -> Tensor:
        """(N, L): how each sample is shared among the layers, front first; rows sum to 1. As in `forward`."""
        keep = kept_logits(layers or self.config.layers, self.config.partition_logits)
        if not self.config.layered:
            return torch.ones_like(samples.weight[:, None])
        relative = self._surroundings(samples, scale)
        contexts, _ = self._context(samples, relative, scale, decoded=decoded)
        context = _rows(contexts[0], samples.shape)
        shares = []
        for part in chunks(samples, relative):
            embedding = self.reducer(part.samples, scale)
            log_partition, _ = self._partition(part, embedding, context[part.pixels], scale, keep)
            shares.append((part.own, part.samples.in_pixel_order(log_partition.exp())))
        return together(shares, len(samples.weight))

    def _surroundings(self, samples: Samples, scale: FrameScale) -> Tensor | None:
        """(N, 1 or 2) each sample against its neighbourhood: depth (0: unknown), then radiance; None for neither."""
        segments, found = samples.segments, []
        if self.config.depth_prior:
            known = "depth" in samples.roles
            unknown = torch.zeros_like(samples.weight[:, None])
            found.append(relative_depth(samples, segments, scale) if known else unknown)
        if self.config.confidence:
            found.append(outlierness(samples, segments, scale))
        return columns(found) if found else None

    # --- context ---------------------------------------------------------------------------------------------------

    def unet_inputs(self, samples: Samples, scale: FrameScale) -> Tensor:
        """(B, C, h, w) what the U-Net sees, at its own resolution; the pixels are padded to the stride before."""
        picture, _ = self._inputs(samples, self._surroundings(samples, scale), scale)
        return self.unet.pooled(picture)

    def decoded_context(self, inputs: Tensor) -> Tensor:
        """(B, C, h, w) `unet_inputs` of a whole picture -> what the U-Net decodes of them, for its tiles."""
        return self.unet.decoded(inputs)[-1]

    def _inputs(self, samples: Samples, relative: Tensor | None, scale: FrameScale) -> tuple[Tensor, Tensor]:
        """The picture (B, C, H, W) that the context is made of, padded to the stride; the embeddings (n, E) of the last
        chunk."""
        rows = []
        for part in chunks(samples, relative):
            embedding = self.reducer(part.samples, scale)
            rows.append((part.pixels, pixel_rows(part.samples, embedding, part.relative, scale, self.config)))
        batch, height, width = samples.shape
        picture = together(rows, samples.counts.numel()).view(batch, height, width, -1)
        picture = picture.permute(0, 3, 1, 2)  # channels last in memory
        stride = self.config.unet.stride
        return F.pad(picture, (0, -width % stride, 0, -height % stride)), embedding

    def _context(self, samples: Samples, relative: Tensor | None, scale: FrameScale, seen: Tensor | None = None,
                 decoded: Tensor | None = None) -> tuple[list[Tensor], Tensor]:
        """Context pictures, finest first, of the size padded to the stride; the embeddings (n, E) of the last chunk.

        `seen` : (B, H, W) bool, pixels whose context will be used; None: all. With `decoded` there is the finest alone
        """
        picture, embedding = self._inputs(samples, relative, scale)
        box = None if seen is None else box_of(seen)
        levels = self.unet.levels(picture, box) if decoded is None else [self.unet.finished(picture, decoded, box)]
        return [level.to(picture.dtype) for level in reversed(levels)], embedding

    # --- samples to layers -----------------------------------------------------------------------------------------

    def _splat_chunks(self, samples: Samples, embedding: Tensor, relative: Tensor | None, context: Tensor,
                      scale: FrameScale, keep: list[int], sources: Tensor | None = None
                      ) -> Iterator[tuple[Index, Tensor]]:
        """Rows of pixels and their splat, chunk by chunk; `embedding` is used if it is that of all samples."""
        for part in chunks(samples, relative, sources):
            if part.samples is not samples:  # of several chunks: cheaper to repeat than to keep
                embedding = self.reducer(part.samples, scale)
            yield part.pixels, self._splat(part, embedding, context[part.pixels], scale, keep)

    def _splat(self, part: Chunk, embedding: Tensor, context: Tensor, scale: FrameScale, keep: list[int]) -> Tensor:
        """(P, L, K) rows: log n, log w, then per unit of occupancy basic values, guides if needed, embedding, what
        noise is measured by if needed, extra."""
        samples = part.samples
        segments = samples.segments
        log_weight = torch.log(samples.weight[:, None])
        log_partition = torch.zeros_like(log_weight)
        if self.config.layered:
            log_partition, loss = self._partition(part, embedding, context, scale, keep)
            log_weight = log_weight - loss
        values = [basic_values(samples, scale)]
        if self.config.kernel == "affinity":
            values.append(guide_values(samples, scale))
        values.append(embedding.to(values[0].dtype))
        if self.config.texture_reliability:
            values.append(noise_values(samples))
        values += extra_values(samples)
        result = splat(log_weight, log_partition, columns(values), segments)
        return columns([result.log_n[..., None], result.log_w[..., None], result.values])

    def _partition(self, part: Chunk, embedding: Tensor, context: Tensor, scale: FrameScale, keep: list[int]
                   ) -> tuple[Tensor, Tensor | float]:
        """(N, L) log of the partition, and what the confidence takes from the log of each weight, (N, 1)."""
        samples, relative = part.samples, part.relative
        config = self.config
        mine = embedding if relative is None else columns([embedding, relative.to(embedding.dtype)])
        shared = samples.segments.expand(self.partitioner.first(0, context))
        raw = self.partitioner.rest(shared + self.partitioner.first(1, mine)).to(samples.weight.dtype).split(1, 1)
        logits = columns([raw[layer] for layer in keep])
        if config.depth_prior and relative is not None:
            logits = logits + initial_logits(relative[:, :1], self.prior_strength, keep, config.partition_logits)
        log_partition = logits - torch.logsumexp(logits, 1, keepdim=True)  # faster than log_softmax on columns
        if not config.confidence:
            return log_partition, 0.0
        brightness = log_radiance(samples.roles["radiance"].amax(1, keepdim=True), scale.exposure)
        assert relative is not None
        beyond = (relative[:, -1:] - OUTLIER_START).clamp_min(0)
        gamma = F.softplus(raw[-1]) + F.softplus(self.outlier_rate) * beyond
        return log_partition, gamma * brightness

    # --- kernels, filter, compositing ------------------------------------------------------------------------------

    def _filter_affinity(self, samples: Samples, embedding: Tensor, relative: Tensor | None, context: Tensor,
                         scale: FrameScale, keep: list[int], wanted: Tensor | None, seen: Tensor | None) -> Tensor:
        """(B, L, 6 + E, H, W) visible planes."""
        planes, predictions = [], []
        sources, active, box = None, None, (slice(None), slice(None))
        if wanted is not None and seen is not None:
            sources, box = seen.flatten(), box_of(seen)
            active = cells_with(wanted[:, *box], TARGET_CELL).repeat_interleave(len(keep), 0)
        for rows, part in self._splat_chunks(samples, embedding, relative, context, scale, keep, sources):
            end = GUIDED_COLUMNS + self.config.embedding
            predictions.append((rows, predict(self.generator, self.layer_bias[keep], part[..., :end], context[rows])))
            # the embedding has done its work
            planes.append((rows, columns([part[..., :GUIDED_COLUMNS], part[..., end:]])))
        empty = planes[0][1].new_zeros(planes[0][1].shape[-1])
        empty[:2] = -torch.inf  # log n, log w: where no kernel looks there may as well be nothing
        splats = _picture(together(planes, samples.counts.numel(), empty), samples.shape).flatten(0, 1)
        predicted = _picture(together(predictions, samples.counts.numel()), samples.shape).flatten(0, 1)
        splats, predicted = splats[..., *box], predicted[..., *box]
        means = filter_guided(splats, predicted, self.guide_matrix, self.config, scale, samples.lights, active)
        visible = composite(means.view(samples.shape[0], len(keep), *means.shape[1:]))
        if visible.shape[-2:] == samples.shape[1:]:
            return visible
        whole = visible.new_zeros(*visible.shape[:3], *samples.shape[1:])
        whole[..., *box] = visible
        return whole

    def _filter_direct(self, samples: Samples, embedding: Tensor, relative: Tensor | None, contexts: list[Tensor],
                       context: Tensor, scale: FrameScale, keep: list[int]) -> Tensor:
        """(B, L, 6 + E, H, W) visible planes."""
        planes = together(list(self._splat_chunks(samples, embedding, relative, context, scale, keep)),
                          samples.counts.numel())
        return filter_direct(_picture(planes, samples.shape), contexts, self.generators, self.config)

    def _splat_samples(self, samples: Samples, embedding: Tensor, context: Tensor, scale: FrameScale) -> Tensor:
        """(B, 1, 6 + E, H, W) visible planes."""
        if len(embedding) < len(samples.weight):
            parts = [(part.own, part.samples.in_pixel_order(self.reducer(part.samples, scale)))
                     for part in chunks(samples, None)]
            embedding = together(parts, len(samples.weight))
        generator = self.generators[0]
        assert isinstance(generator, Mlp)
        values = columns([basic_values(samples, scale), *extra_values(samples)])
        return splat_samples(samples, values, embedding, context, generator)


def _rows(picture: Tensor, shape: tuple[int, int, int]) -> Tensor:
    """(B, C, H', W') cut to the samples' shape -> (P, C)."""
    batch, height, width = shape
    return picture[..., :height, :width].permute(0, 2, 3, 1).reshape(batch * height * width, -1)


def _picture(whole: Tensor, shape: tuple[int, int, int]) -> Tensor:
    """(P, L, K) -> (B, L, K, H, W)."""
    batch, height, width = shape
    return whole.view(batch, height, width, *whole.shape[1:]).permute(0, 3, 4, 1, 2).contiguous()


def _last(mlp: Mlp) -> nn.Linear:
    layer = mlp.layers[-1]
    assert isinstance(layer, nn.Linear)
    return layer


def _shrink(mlp: Mlp) -> None:
    """The last layer starts at a tenth of its usual size, so that what is added to its output decides at first."""
    _last(mlp).weight.mul_(0.1)
    _last(mlp).bias.zero_()
