"""The denoiser: path samples in, layers out. One class for every `Config` whose kernels come from affinity.

The flow, top to bottom: encode and embed the samples, gather the context, partition and splat the samples to layers,
predict features per layer, filter, composite. At inference the per-sample stages run in chunks that fit the caches.
"""

from __future__ import annotations

from collections.abc import Iterator

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from model.affinity import affinity_filter
from model.compositing import Layers, fill_holes, transmittance
from model.config import Config
from model.features import FrameScale, divisor, encode, feature_groups, log_depth, log_radiance
from model.networks import Mlp, Products, UNet
from model.partition import initial_logits, kept_logits, relative_depth, splat
from model.samples import Samples, Segments

CHUNK_SAMPLES = 32768  # per-sample stages at inference: about 4 MB of activations at width 32
GUIDE_SCALES = (2.0, 2.0, 2.0, 3.0, 1.5, 1.5, 1.5)  # normal, log depth, divisor: the joint bilateral filter at step 0
DIVISOR_GUIDE_SCALE = 6.0  # the divisor's own, sharper kernel
DIVISOR_WINDOW = (5,)
# columns of a splat after log n and log w: radiance, demodulated radiance, coverage, coverage * depth, divisor, normal,
# log depth, embedding
SPLAT_VALUES = slice(2, 10)
GUIDES = slice(10, 17)
SPLAT = slice(2, 17)
PIXEL_STATISTICS = 6
CONFIDENCE_START = -3.0  # softplus(-3) = 0.05: nearly unbiased at the start


class SampleReducer(nn.Module):
    """Samples -> embeddings (N, E). A role that is absent leaves the first layer; a present one adds its own bias."""

    def __init__(self, config: Config) -> None:
        super().__init__()
        self.groups = feature_groups(config.roles, derived=config.encoding == "log")
        self.mlp = Mlp([sum(self.groups.values())], config.reducer)
        self.presence = nn.Parameter(torch.zeros(len(self.groups), config.reducer[0]))
        spans, start = {}, 0
        for name, width in self.groups.items():
            spans[name] = (start, start + width)
            start += width
        self.spans = spans

    def forward(self, samples: Samples, scale: FrameScale) -> Tensor:
        features = encode(samples, scale, self.groups)
        present = [k for k, name in enumerate(self.groups) if name in features]
        columns = [c for name in self.groups if name in features for c in range(*self.spans[name])]
        first = self.mlp.groups[0]
        assert isinstance(first, nn.Linear)
        weight = first.weight if len(columns) == first.in_features else first.weight[:, columns]
        bias = first.bias + self.presence[present].sum(0)
        x = torch.cat([features[name] for name in self.groups if name in features], 1)
        with self.mlp.products(x):
            hidden = F.linear(x, weight, bias)
        return self.mlp.rest(hidden, activate_last=True)


class Denoiser(nn.Module):
    """A layer denoiser. `forward(samples, scale)` returns `Layers`.

    Parameters
    ----------
    config : what it is made of

    Notes
    -----
    The output is linear in radiance for a fixed partition and fixed kernels, and scales with it exactly when `scale`
    is measured from the same input. Pictures of any size are accepted; halos and tiles are the caller's business,
    `reach` says how far a pixel's influence goes.
    """

    def __init__(self, config: Config) -> None:
        super().__init__()
        self.config = config
        embedding = config.embedding
        self.reducer = SampleReducer(config)
        self.unet = UNet(self._context_inputs(), config.unet)
        context = config.unet.out_channels
        self.partitioner = Mlp(
            [context, embedding + 1], (*config.partitioner, config.partition_logits + int(config.confidence))
        )
        self.prior_strength = nn.Parameter(torch.tensor(1.5))
        levels = len(config.kernel_sizes)
        # per layer: features, bias and preference per level, guide gate, demodulation mix, divisor's gate and bias
        self.generator_sizes = (config.affinity_features, levels, levels, 1, 1, 1, 1)
        self.generator = Mlp([context, embedding + 2], (*config.generator, sum(self.generator_sizes)))
        self.layer_bias = nn.Parameter(torch.zeros(config.partition_logits, config.generator[0]))
        guides = torch.zeros(config.affinity_features, len(GUIDE_SCALES))
        for k, value in enumerate(GUIDE_SCALES):
            guides[k % config.affinity_features, k] = value
        self.guide_matrix = nn.Parameter(guides)
        with torch.no_grad():  # at step 0 the partition is the depth prior's and the kernel the guides'
            for mlp in (self.partitioner, self.generator):
                last = mlp.layers[-1]
                assert isinstance(last, nn.Linear)
                last.weight.mul_(0.1)
                last.bias.zero_()
            if config.confidence:
                last = self.partitioner.layers[-1]
                assert isinstance(last, nn.Linear)
                last.bias[-1] = CONFIDENCE_START

    def set_product_dtype(self, dtype: torch.dtype | None) -> Denoiser:
        """Lets matrix products and convolutions run in bfloat16 or float16; everything else stays in float32."""
        for module in self.modules():
            if isinstance(module, Products):
                module.product_dtype = dtype
        return self

    def _context_inputs(self) -> int:
        embedding = self.config.embedding
        return 2 * embedding + PIXEL_STATISTICS if self.config.statistics else embedding

    @property
    def reach(self) -> int:
        """Pixels: nothing farther than this from a pixel changes it."""
        unet, radius = self.config.unet, 0
        size = unet.scale
        for block in self.config.unet.encoder:
            radius += len(block) * size + size
            size *= 2
        radius += len(unet.bottleneck) * size
        for block in unet.decoder:
            radius += size
            size //= 2
            radius += len(block) * size
        radius += len(unet.head) * size + size
        kernel = max(2**level * (window // 2 + 1) for level, window in enumerate(self.config.kernel_sizes))
        return radius + kernel + DIVISOR_WINDOW[0] // 2 + 4

    @property
    def stride(self) -> int:
        """Tiles start at multiples of this many pixels, so that pooling cells and levels coincide."""
        return max(self.config.unet.stride, 2 ** (len(self.config.kernel_sizes) - 1))

    def forward(self, samples: Samples, scale: FrameScale, layers: int | None = None) -> Layers:
        """Denoises a batch of pictures.

        `layers`: 1 to `config.partition_logits`; default `config.layers`. Returns `Layers` of samples.shape.
        """
        keep = kept_logits(layers or self.config.layers, self.config.partition_logits)
        segments = Segments(samples.counts)
        relative = None
        if self.config.depth_prior and "depth" in samples.roles:
            relative = relative_depth(samples, segments, scale)
        context, embedding = self._context(samples, relative, scale)
        parts = []
        for part, rows, part_relative in self._chunks(samples, relative):
            if len(part.weight) < len(samples.weight):  # of several chunks: cheaper to repeat than to keep
                embedding = self.reducer(part, scale)
            planes = self._splat(part, embedding, part_relative, context[rows], scale, keep)  # (p, L, K)
            parts.append((planes, self._predict(planes, context[rows], keep)))
        batch, height, width = samples.shape

        def picture(rows: list[Tensor]) -> Tensor:  # (P, L, K) -> (B * L, K, H, W)
            whole = torch.cat(rows, 0) if len(rows) > 1 else rows[0]
            whole = whole.view(batch, height, width, len(keep), -1).permute(0, 3, 4, 1, 2)
            return whole.reshape(batch * len(keep), -1, height, width)

        splats = picture([planes for planes, _ in parts])
        predictions = picture([prediction for _, prediction in parts])
        return self._filter(splats, predictions, batch, scale)

    # --- per sample -----------------------------------------------------------------------------------------------

    def _chunks(self, samples: Samples, relative: Tensor | None) -> Iterator[tuple[Samples, slice, Tensor | None]]:
        """Pixel ranges of about CHUNK_SAMPLES samples; one range when a gradient is wanted."""
        pixels = samples.counts.numel()
        total = samples.weight.numel()
        if torch.is_grad_enabled() or total <= CHUNK_SAMPLES:
            yield samples, slice(0, pixels), relative
            return
        ends = samples.counts.long().cumsum(0)
        first = start = 0
        while first < pixels:
            last = int(torch.searchsorted(ends, start + CHUNK_SAMPLES, right=True))
            last = min(max(last, first + 1), pixels)
            stop = int(ends[last - 1])
            part = Samples(
                (1, 1, last - first),
                samples.counts[first:last],
                samples.weight[start:stop],
                samples.coverage[start:stop],
                {role: values[start:stop] for role, values in samples.roles.items()},
            )
            yield part, slice(first, last), None if relative is None else relative[start:stop]
            first, start = last, stop

    def _context(self, samples: Samples, relative: Tensor | None, scale: FrameScale) -> tuple[Tensor, Tensor]:
        """(P, C) rows of context, and the embeddings (n, E) of the last chunk."""
        rows = []
        for part, _, part_relative in self._chunks(samples, relative):
            embedding = self.reducer(part, scale)
            rows.append(self._context_rows(part, embedding, part_relative, scale))
        batch, height, width = samples.shape
        picture = torch.cat(rows, 0).view(batch, height, width, -1).permute(0, 3, 1, 2)  # channels last in memory
        stride = self.config.unet.stride
        padded = F.pad(picture, (0, -width % stride, 0, -height % stride))
        context: Tensor = self.unet(padded)[..., :height, :width]
        return context.permute(0, 2, 3, 1).reshape(batch * height * width, -1).to(picture.dtype), embedding

    def _context_rows(self, samples: Samples, embedding: Tensor, relative: Tensor | None, scale: FrameScale) -> Tensor:
        segments = Segments(samples.counts)
        weight = samples.weight[:, None]
        embedding = embedding.to(weight.dtype)
        if not self.config.statistics:
            return segments.sum(weight * embedding)
        radiance = samples.roles["radiance"]
        luminance = radiance.mean(1, keepdim=True)
        offset = torch.zeros_like(luminance) if relative is None else relative
        moments = torch.cat([embedding, radiance, luminance, offset], 1)
        mean = segments.weighted_sum(weight, moments)[:, 0]
        deviation = moments - segments.expand(mean)
        variance = segments.weighted_sum(weight, deviation * deviation)[:, 0]
        concentration = segments.sum(weight * weight)
        count = torch.log2(torch.where(concentration > 0, concentration, 1)) * -0.25
        e = embedding.shape[1]
        return torch.cat(
            [
                mean[:, :e],
                variance[:, :e],
                log_radiance(mean[:, e : e + 3], scale.exposure),
                torch.log1p(variance[:, e + 3 : e + 4].sqrt() * scale.exposure),
                variance[:, e + 4 :].sqrt(),
                count,
            ],
            1,
        )

    def _splat(self, samples: Samples, embedding: Tensor, relative: Tensor | None, context: Tensor, scale: FrameScale,
               keep: list[int]) -> Tensor:
        """(P, L, K) rows: log n, log w, then per unit of occupancy what SPLAT_VALUES and its neighbours name."""
        segments = Segments(samples.counts)
        offset = relative if relative is not None else torch.zeros_like(samples.weight[:, None])
        shared = segments.expand(self.partitioner.first(0, context))
        mine = self.partitioner.first(1, torch.cat([embedding, offset.to(embedding.dtype)], 1))
        raw = self.partitioner.rest(shared + mine).to(samples.weight.dtype)
        logits = raw[:, keep] + initial_logits(relative, self.prior_strength, keep)
        log_weight = torch.log(samples.weight[:, None])
        radiance = samples.roles["radiance"]
        if self.config.confidence:
            brightness = log_radiance(radiance.amax(1, keepdim=True), scale.exposure)
            log_weight = log_weight - F.softplus(raw[:, -1:]) * brightness
        hit = (samples.coverage > 0).to(radiance.dtype)[:, None]
        depth = torch.where(hit > 0, samples.roles["depth"], scale.depth) if "depth" in samples.roles else hit
        normal = samples.roles["normal"] * hit if "normal" in samples.roles else radiance.new_zeros(radiance.shape)
        by = divisor(samples)
        coverage = samples.coverage[:, None]
        values = torch.cat(
            [radiance, radiance / by, coverage, coverage * depth, by, normal, log_depth(depth, scale.depth),
             embedding.to(radiance.dtype)], 1,
        )
        result = splat(log_weight, torch.log_softmax(logits, 1), values, segments)
        return torch.cat([result.log_n[..., None], result.log_w[..., None], result.values], 2)

    # --- per pixel and layer ---------------------------------------------------------------------------------------

    def _predict(self, planes: Tensor, context: Tensor, keep: list[int]) -> Tensor:
        """The generator: planes (P, L, K) and context (P, C) -> (P, L, sum(generator_sizes))."""
        log_n, log_w, values = planes[..., :1], planes[..., 1:2], planes[..., SPLAT.stop :]
        share = torch.exp(log_w - torch.where(log_n == -torch.inf, 0, log_n))  # w / n in 0..1
        embedding = values / torch.where(share > 0, share, 1)
        weight = torch.exp(log_n)  # below 1 where confidence is low or layers in front took the weight
        shared = self.generator.first(0, context)[:, None]  # (P, 1, hidden)
        mine = self.generator.first(1, torch.cat([embedding, share, weight], 2))
        return self.generator.rest(shared + mine + self.layer_bias[keep]).to(planes.dtype)

    def _filter(self, splats: Tensor, predictions: Tensor, batch: int, scale: FrameScale) -> Layers:
        """splats (B*L, K, H, W) and predictions (B*L, G, H, W) -> composited layers."""
        log_n, log_w = splats[:, 0], splats[:, 1]
        share = torch.exp(log_w - torch.where(log_n == -torch.inf, 0, log_n))[:, None]  # w / n
        own = torch.where(share > 0, share, 1)  # values per unit of the layer's own weight: divide by this
        features, bias, preference, gate, mix, divisor_gate, divisor_bias = predictions.split(self.generator_sizes, 1)
        guides = splats[:, GUIDES] / own
        guides = torch.cat([guides[:, 3:7], guides[:, :3]], 1)  # normal, log depth, divisor
        guided = torch.einsum("bghw,fg->bfhw", guides, self.guide_matrix)
        features = features + guided * (2 * torch.sigmoid(gate))
        values = torch.cat([splats[:, SPLAT_VALUES], share], 1)
        out = affinity_filter(features, bias, preference, log_n, values, self.config.kernel_sizes)
        plain, reduced, coverage, depth, alpha = out.split((3, 3, 1, 1, 1), 1)
        if self.config.demodulation:
            sharp = guides[:, 4:] * (DIVISOR_GUIDE_SCALE * torch.sigmoid(divisor_gate))
            zero = torch.zeros_like(divisor_bias)
            factor = affinity_filter(sharp, divisor_bias, zero, log_w, guides[:, 4:], DIVISOR_WINDOW)
            # no own weight near the target: nothing to multiply by, the plain path stands
            amount = torch.sigmoid(mix) * (factor.amax(1, keepdim=True) > 0)
            plain = torch.lerp(plain, reduced * factor, amount)
        height, width = log_n.shape[-2:]
        alpha = alpha.view(batch, -1, height, width).clamp(0, 1)
        through = transmittance(alpha)
        scaled = [plane.view(batch, -1, plane.shape[1], height, width) for plane in (plain, coverage, depth)]
        color, covered, depths = (plane * through[:, :, None] for plane in scaled)
        return fill_holes(Layers(
            color=color,
            weight=through * alpha,
            coverage=torch.minimum(covered[:, :, 0], through * alpha),
            depth=torch.where(covered > 0, depths / torch.where(covered > 0, covered, 1), torch.inf)[:, :, 0],
        ))
