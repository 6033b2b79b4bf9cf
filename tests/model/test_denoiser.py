"""The numerical invariants, over every variant with random networks and random samples."""

from __future__ import annotations

import dataclasses

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from model import chunks, direct
from model.compositing import Layers
from model.denoiser import Denoiser
from model.features import FrameScale
from model.samples import Samples
from tests.model.random_models import SMALL, random_counts, random_network, random_samples, with_roles

SCALE = FrameScale(exposure=0.7, depth=3.0)
VARIANTS = sorted(SMALL)
SHARED = settings(max_examples=60, deadline=None, derandomize=True)


def planes(layers: Layers) -> Tensor:
    """(B, L, 6, H, W) everything a network says; depth times coverage, for depth alone means nothing without."""
    depth = torch.where(layers.coverage > 0, layers.depth * layers.coverage, 0)
    return torch.cat([layers.color, layers.weight[:, :, None], layers.coverage[:, :, None], depth[:, :, None]], 2)


def assert_same(first: Layers, second: Layers, tolerance: float = 1e-9) -> None:
    """Equal to `tolerance` of each plane's largest value."""
    expected = planes(first)
    scale = expected.abs().amax((0, 1, 3, 4), keepdim=True) + 1e-30
    torch.testing.assert_close(planes(second) / scale, expected / scale, rtol=0, atol=tolerance)


@torch.no_grad()
def run(net: Denoiser, samples: Samples, scale: FrameScale = SCALE, layers: int | None = None,
        fill: bool = True, decoded: torch.Tensor | None = None) -> Layers:
    result: Layers = net(samples, scale, layers, fill, decoded=decoded)
    return result


@st.composite
def cases(draw: st.DrawFn) -> tuple[Denoiser, Samples, int]:
    """A network, samples it may be given, and a number of layers it can make."""
    config = SMALL[draw(st.sampled_from(VARIANTS))]
    seed = draw(st.integers(0, 2**31))
    shape = (draw(st.integers(1, 2)), draw(st.integers(1, 11)), draw(st.integers(1, 11)))
    most, empty = draw(st.integers(1, 5)), draw(st.sampled_from([0.0, 0.4]))
    counts = random_counts(seed, shape[0] * shape[1] * shape[2], most, empty)
    optional = [role for role in config.roles if role != "radiance"]
    without = draw(st.lists(st.sampled_from(optional), max_size=4, unique=True))
    layers = draw(st.integers(1, config.partition_logits))
    return random_network(config, seed), random_samples(seed, shape, counts, without), layers


@SHARED
@given(cases())
def test_layers_are_finite_and_share_each_pixel(case: tuple[Denoiser, Samples, int]) -> None:
    net, samples, count = case
    layers = run(net, samples, layers=count)
    assert layers.color.shape == (samples.shape[0], count, 3, *samples.shape[1:])
    assert bool(planes(layers).isfinite().all())
    assert bool((layers.weight >= 0).all())
    assert bool((layers.coverage >= 0).all())
    assert bool((layers.coverage <= layers.weight).all())
    assert torch.equal(layers.depth.isfinite(), layers.coverage > 0)
    if "depth" in samples.roles and bool((samples.coverage > 0).any()):
        inside = layers.depth[layers.coverage > 1e-100]
        hits = samples.roles["depth"][samples.coverage > 0]
        assert bool((inside >= hits.min() * 0.999).all())
        assert bool((inside <= hits.max() * 1.001).all())
    some = samples.counts.view(samples.shape[0], -1).sum(1) > 0  # a picture without any sample stays empty
    total = layers.weight.sum(1).flatten(1)
    torch.testing.assert_close(total, some.double()[:, None].expand_as(total))


@SHARED
@given(cases())
def test_constant_radiance_stays_constant(case: tuple[Denoiser, Samples, int]) -> None:
    net, samples, count = case
    color = torch.tensor([0.3, 1.7, 20.0], dtype=torch.float64)
    surface = torch.full_like(samples.roles["radiance"], 0.25)
    samples = with_roles(samples, radiance=color.expand_as(surface), albedo=surface, specular=surface)
    samples = dataclasses.replace(samples, coverage=torch.ones_like(samples.coverage))  # a miss has another divisor
    samples.roles["depth"] = torch.rand_like(samples.weight)[:, None] + 1
    beauty = run(net, samples, layers=count).beauty()
    reached = beauty.flatten(1).sum(1) > 0
    for image in beauty[reached]:
        torch.testing.assert_close(image, color[:, None, None].expand_as(image))


@SHARED
@given(cases(), st.sampled_from([1e-4, 0.125, 3.0, 1e5]))
def test_output_scales_with_radiance_and_ignores_the_unit_of_depth(
    case: tuple[Denoiser, Samples, int], factor: float
) -> None:
    net, samples, count = case
    expected = run(net, samples, layers=count)
    scaled = with_roles(samples, radiance=samples.roles["radiance"] * factor)
    bright = run(net, scaled, FrameScale(SCALE.exposure / factor, SCALE.depth), count)
    assert_same(expected, dataclasses.replace(bright, color=bright.color / factor))
    if "depth" in samples.roles:
        far = with_roles(samples, depth=samples.roles["depth"] * factor)
        moved = run(net, far, FrameScale(SCALE.exposure, SCALE.depth * factor), count)
        assert_same(expected, dataclasses.replace(moved, depth=moved.depth / factor))


@SHARED
@given(cases())
def test_order_of_samples_is_irrelevant(case: tuple[Denoiser, Samples, int]) -> None:
    net, samples, count = case
    pixel = torch.repeat_interleave(torch.arange(samples.counts.numel()), samples.counts.long())
    shuffled = torch.randperm(len(pixel), generator=torch.Generator().manual_seed(1))
    order = shuffled[torch.argsort(pixel[shuffled], stable=True)]
    other = Samples(samples.shape, samples.counts, samples.weight[order], samples.coverage[order],
                    {role: values[order] for role, values in samples.roles.items()})
    assert_same(run(net, samples, layers=count), run(net, other, layers=count))


def blind_to_count(net: Denoiser) -> Denoiser:
    """Cuts what may tell a split sample: the effective count, the last channel of the context's input, and the noise
    of divisors, which is measured by it.

    The U-Net reads it twice, at its start and through the skip to its last block; convolutions behind it, once more.
    """
    net.config = dataclasses.replace(net.config, texture_reliability=False)
    if net.config.statistics:
        unet = net.unet
        readers = [unet.encoder[0].convolutions[0], unet.decoder[-1].convolutions[0]]
        with torch.no_grad():
            for convolution in readers + ([unet.fine.from_picture] if unet.fine is not None else []):
                convolution.weight[:, -1] = 0
    return net


@SHARED
@given(cases())
def test_splitting_samples_into_halves_changes_nothing(case: tuple[Denoiser, Samples, int]) -> None:
    net, samples, count = case
    net = blind_to_count(net)
    times = torch.randint(1, 4, samples.weight.shape, generator=torch.Generator().manual_seed(2))
    pixel = torch.repeat_interleave(torch.arange(samples.counts.numel()), samples.counts.long())
    counts = torch.zeros_like(samples.counts, dtype=torch.int64).index_add(0, pixel, times)
    split = Samples(
        samples.shape, counts, (samples.weight / times).repeat_interleave(times, 0),
        samples.coverage.repeat_interleave(times, 0),
        {role: values.repeat_interleave(times, 0) for role, values in samples.roles.items()},
    )
    assert_same(run(net, samples, layers=count), run(net, split, layers=count))


def test_the_effective_count_is_seen_by_networks_with_statistics() -> None:
    """Otherwise the test above would hold for a reason it does not state."""
    net = random_network(SMALL["fast"], 3)
    samples = random_samples(3, (1, 8, 8), 2)
    halves = Samples(samples.shape, samples.counts * 2, samples.weight.repeat_interleave(2) / 2,
                     samples.coverage.repeat_interleave(2),
                     {role: values.repeat_interleave(2, 0) for role, values in samples.roles.items()})
    assert (run(net, samples).beauty() - run(net, halves).beauty()).abs().max() > 1e-6
    net = blind_to_count(net)
    assert (run(net, samples).beauty() - run(net, halves).beauty()).abs().max() < 1e-9


def crop(samples: Samples, rows: slice, cols: slice) -> Samples:
    """The samples of a window of one picture."""
    height, width = samples.shape[1:]
    inside = torch.zeros(height, width, dtype=torch.bool)
    inside[rows, cols] = True
    kept = torch.repeat_interleave(inside.flatten(), samples.counts.long())
    window = samples.counts.view(height, width)[rows, cols]
    return Samples((1, *window.shape), window.flatten(), samples.weight[kept], samples.coverage[kept],
                   {role: values[kept] for role, values in samples.roles.items()})


@pytest.mark.parametrize("variant", VARIANTS)
def test_tiles_with_a_halo_change_nothing(variant: str) -> None:
    net = random_network(SMALL[variant], 5, torch.float32)
    halo = -(-net.reach // net.stride) * net.stride
    height, width = 2 * halo + 3 * net.stride + 5, 2 * halo + 2 * net.stride + 3
    counts = random_counts(6, height * width, 3, 0.2)
    samples = random_samples(6, (1, height, width), counts, dtype=torch.float32)
    whole = run(net, samples, fill=False)
    scale = planes(whole).abs().amax((0, 1, 3, 4))
    for top, left in ((0, halo + net.stride), (halo + 2 * net.stride, 0), (halo + 2 * net.stride, halo + net.stride)):
        bottom, right = min(top + net.stride + 4, height), min(left + net.stride + 4, width)
        rows = slice(max(top - halo, 0), min(bottom + net.reach, height))
        cols = slice(max(left - halo, 0), min(right + net.reach, width))
        tile = planes(run(net, crop(samples, rows, cols), fill=False))
        inner = tile[..., top - rows.start : bottom - rows.start, left - cols.start : right - cols.start]
        expected = planes(whole)[..., top:bottom, left:right]
        error = (inner - expected).abs().amax((0, 1, 3, 4)) / scale
        assert float(error.max()) < 1e-5


@pytest.mark.parametrize("variant", [name for name in VARIANTS if SMALL[name].kernel == "affinity"])
def test_tiles_that_share_a_context_need_less_of_a_halo(variant: str) -> None:
    net = random_network(SMALL[variant], 5, torch.float32)
    assert net.tile_reach is not None
    assert net.tile_reach < net.reach
    halo = -(-net.tile_reach // net.stride) * net.stride
    height, width = 2 * halo + 3 * net.stride + 5, net.stride + 3
    samples = random_samples(6, (1, height, width), random_counts(6, height * width, 3, 0.2), dtype=torch.float32)
    whole = run(net, samples, fill=False)
    scale = planes(whole).abs().amax((0, 1, 3, 4))
    with torch.no_grad():
        decoded = net.decoded_context(net.unet_inputs(samples, SCALE))
    for top in (0, halo + net.stride, 2 * halo + 3 * net.stride):
        bottom = min(top + net.stride + 4, height)
        rows = slice(max(top - halo, 0), min(bottom + net.tile_reach, height))
        padded = -(-(rows.stop - rows.start) // net.config.unet.stride) * net.config.unet.stride
        part = slice(rows.start // net.config.unet.scale, (rows.start + padded) // net.config.unet.scale)
        tile = planes(run(net, crop(samples, rows, slice(None)), fill=False, decoded=decoded[:, :, part]))
        inner = tile[..., top - rows.start : bottom - rows.start, :]
        error = (inner - planes(whole)[..., top:bottom, :]).abs().amax((0, 1, 3, 4)) / scale
        assert float(error.max()) < 1e-5


@pytest.mark.parametrize("variant", VARIANTS)
def test_memory_budget_changes_nothing(variant: str, monkeypatch: pytest.MonkeyPatch) -> None:
    net = random_network(SMALL[variant], 7, torch.float32)
    counts = random_counts(8, 2 * 17 * 13, 4, 0.2)
    counts[40] = 300  # one pixel above every budget
    samples = random_samples(8, (2, 17, 13), counts, dtype=torch.float32)
    expected = net(samples, SCALE)  # with a gradient: one chunk
    expected = Layers(*(getattr(expected, field.name).detach() for field in dataclasses.fields(Layers)))
    monkeypatch.setattr(chunks, "CHUNK_SAMPLES", 50)
    monkeypatch.setattr(direct, "BLOCK_LOGITS", 3000)
    assert_same(expected, run(net, samples), 1e-5)


@pytest.mark.parametrize("variant", VARIANTS)
def test_extreme_radiance_weight_and_features_stay_finite(variant: str) -> None:
    net = random_network(SMALL[variant], 9, torch.float32)
    counts = random_counts(9, 1 * 12 * 10, 4, 0.3)
    samples = random_samples(9, (1, 12, 10), counts, dtype=torch.float32)
    draw = torch.Generator().manual_seed(9)
    exponent = torch.rand(samples.weight.shape, generator=draw) * -30
    weight = 10.0**exponent  # 1e-30 to 1
    bright = samples.roles["radiance"] * 10 ** (torch.rand(samples.weight.shape, generator=draw) * 6)[:, None]
    bright[::7] = -bright[::7]  # filters with negative lobes
    bright[::5] = 0
    samples = with_roles(dataclasses.replace(samples, weight=weight), radiance=bright, coc=samples.roles["coc"] * 1e6,
                         motion=samples.roles["motion"] * 1e6, depth=samples.roles["depth"] ** 20)
    result = net(samples, SCALE)
    (result.color.sum() + result.weight.sum()).backward()
    assert bool(planes(result).isfinite().all())
    torch.testing.assert_close(result.weight.sum(1), torch.ones(1, 12, 10), rtol=0, atol=1e-5)
    for name, parameter in net.named_parameters():
        assert parameter.grad is None or bool(parameter.grad.isfinite().all()), name


@pytest.mark.parametrize("variant", VARIANTS)
def test_a_firefly_near_the_end_of_single_precision_spoils_nothing(variant: str) -> None:
    net = random_network(SMALL[variant], 15, torch.float32)
    samples = random_samples(15, (1, 9, 9), 3, dtype=torch.float32)
    samples.roles["radiance"][100] = 1e36
    assert bool(planes(run(net, samples)).isfinite().all())


@pytest.mark.parametrize("variant", VARIANTS)
def test_single_precision_is_close_to_the_reference_in_double(variant: str) -> None:
    samples = random_samples(10, (1, 14, 9), 3)
    reference = random_network(SMALL[variant], 10)
    expected = run(reference, samples)
    single = Samples(samples.shape, samples.counts, samples.weight.float(), samples.coverage.float(),
                     {role: values.float() for role, values in samples.roles.items()})
    assert expected.color.dtype == expected.weight.dtype == expected.depth.dtype == torch.float64
    assert_same(expected, run(reference.float(), single), 1e-4)


@pytest.mark.parametrize("variant", VARIANTS)
def test_every_parameter_learns(variant: str) -> None:
    net = random_network(SMALL[variant], 11)
    samples = random_samples(11, (2, 16, 16), 3)
    samples.roles["radiance"][0] = 1e4  # an outlier, for what only outliers use
    net(samples, SCALE).color.square().sum().backward()
    dead = [name for name, p in net.named_parameters() if p.grad is None or not bool((p.grad != 0).any())]
    assert dead == []


@pytest.mark.parametrize("variant", VARIANTS)
def test_radiance_alone_is_enough_and_so_is_no_sample_at_all(variant: str) -> None:
    net = random_network(SMALL[variant], 16)
    optional = [role for role in SMALL[variant].roles if role != "radiance"]
    result = run(net, random_samples(16, (1, 5, 5), 2, optional))
    assert bool(planes(result).isfinite().all())
    assert float(result.color.min()) > 0
    nothing = run(net, random_samples(16, (2, 5, 5), 0))
    assert bool((planes(nothing) == 0).all())
    assert bool((nothing.depth == torch.inf).all())


def test_one_set_of_weights_serves_one_to_five_layers() -> None:
    net = random_network(SMALL["fast"], 12)
    samples = random_samples(12, (1, 10, 10), 4)
    for count in range(1, 6):
        assert run(net, samples, layers=count).color.shape[1] == count
    with pytest.raises(ValueError, match="6 layers"):
        run(net, samples, layers=6)


def test_holes_wider_than_the_kernel_are_filled_on_request() -> None:
    net = random_network(SMALL["layer"], 13)
    counts = torch.zeros(30 * 30, dtype=torch.int32)
    counts[:3] = 2
    samples = random_samples(13, (1, 30, 30), counts)
    assert float(run(net, samples, fill=False).weight.sum(1).min()) == 0
    torch.testing.assert_close(run(net, samples).weight.sum(1), torch.ones(1, 30, 30, dtype=torch.float64))


def test_low_precision_products_keep_the_outputs_type() -> None:
    for variant in VARIANTS:
        net = random_network(SMALL[variant], 14, torch.float32).set_product_dtype(torch.bfloat16)
        result = run(net, random_samples(14, (1, 8, 8), 3, dtype=torch.float32))
        assert result.color.dtype == torch.float32
        assert bool(planes(result).isfinite().all())
