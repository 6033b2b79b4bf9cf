"""Layers in over form: over gives back their sum, whatever the layers, and the samples are as deep tools need them."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import OpenImageIO as oiio
import pytest
from hypothesis import given
from hypothesis import strategies as st

from deep_io import Window, write_deep
from deep_io.layer_encoding import MIN_WEIGHT, OverLayers, deep_samples, encode_layers
from deep_io.roles import MISS_DEPTH
from tests.deep_io.oracles import seeded

TYPES = (np.float16, np.float32)
HALF_MAX = 65504.0

Layer = tuple[float, float, float, tuple[float, float, float]]  # weight before normalisation, covered share, depth, C

WEIGHTS = st.one_of(st.sampled_from([0.0, 0.0, 1e-30, 1e-6, 2.0**-11, 2.0**-10, 1e-3, 0.5, 1.0]), st.floats(0, 1))
SHARES = st.one_of(st.sampled_from([0.0, 1.0, 1.0]), st.floats(0, 1))
DEPTHS = st.one_of(st.sampled_from([1.0, 2.0, 3.0, np.inf]), st.floats(0.125, 1e6))
COLORS = st.one_of(st.sampled_from([0.0, 1.0, -1.0, 1e-7, 1e4]), st.floats(-100, 1e4))
BEYOND_HALF = st.one_of(COLORS, st.floats(-1e30, 1e30))


def pixels_of(layers: int, colors: st.SearchStrategy[float]) -> st.SearchStrategy[list[list[Layer]]]:
    layer = st.tuples(WEIGHTS, SHARES, DEPTHS, st.tuples(colors, colors, colors))
    return st.lists(st.lists(layer, min_size=layers, max_size=layers), min_size=1, max_size=10)


FRAMES = st.integers(1, 5).flatmap(lambda layers: pixels_of(layers, COLORS))
BRIGHT_FRAMES = st.integers(1, 5).flatmap(lambda layers: pixels_of(layers, BEYOND_HALF))


def arrays(frame: Sequence[Sequence[Layer]]) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """color (L, 3, P), weight, coverage and depth (L, P) that keep the rules of a denoiser's layers."""
    table = np.array([[(w, a, z, *c) for w, a, z, c in pixel] for pixel in frame], np.float64).transpose(1, 2, 0)
    weight = table[:, 0]
    total = weight.sum(0)
    weight = np.where(total > 0, weight / np.where(total > 0, total, 1), 0).astype(np.float32)
    coverage = weight * table[:, 1].astype(np.float32)
    color = np.where(weight[:, None] > 0, table[:, 3:], 0).astype(np.float32)
    depth = np.where(coverage > 0, table[:, 2], np.inf).astype(np.float32)
    return color, weight, coverage, depth


def front_first(layers: OverLayers) -> tuple[np.ndarray, np.ndarray]:
    """Over in float32, nearest first, with a running alpha."""
    color, alpha = np.zeros(layers.color.shape[1:], np.float32), np.zeros(layers.alpha.shape[1], np.float32)
    for here, a in zip(layers.color.astype(np.float32), layers.alpha.astype(np.float32), strict=True):
        color, alpha = color + (1 - alpha) * here, alpha + (1 - alpha) * a
    return color, alpha


def back_first(layers: OverLayers) -> tuple[np.ndarray, np.ndarray]:
    """Over in float32, farthest first."""
    color, alpha = np.zeros(layers.color.shape[1:], np.float32), np.zeros(layers.alpha.shape[1], np.float32)
    for here, a in zip(layers.color[::-1].astype(np.float32), layers.alpha[::-1].astype(np.float32), strict=True):
        color, alpha = here + (1 - a) * color, a + (1 - a) * alpha
    return color, alpha


def tolerance(contributions: np.ndarray, dtype: type) -> np.ndarray:
    """What rounding may change: (L, ...) -> (...)."""
    total = np.abs(contributions.astype(np.float64)).sum(0)
    return total * 2**-10 + 2**-23 if dtype == np.float16 else total * 1e-5 + 1e-37


def assert_sums(made: tuple[np.ndarray, np.ndarray], color: np.ndarray, coverage: np.ndarray, dtype: type) -> None:
    for got, contributions in zip(made, (color, coverage), strict=True):
        wanted = contributions.astype(np.float64).sum(0)
        assert (np.abs(got - wanted) <= tolerance(contributions, dtype)).all()


@seeded
@given(FRAMES, st.sampled_from(TYPES), st.booleans())
def test_over_gives_the_sum_of_the_layers(frame: list[list[Layer]], dtype: type, by_depth: bool) -> None:
    color, weight, coverage, depth = arrays(frame)
    encoded = encode_layers(color, weight, coverage, depth, dtype, by_depth)
    for over in (front_first, back_first):
        assert_sums(over(encoded), color, coverage, dtype)
    assert encoded.clamped == 0


@seeded
@given(BRIGHT_FRAMES, st.booleans())
def test_over_gives_the_sum_of_very_bright_layers_in_float(frame: list[list[Layer]], by_depth: bool) -> None:
    color, weight, coverage, depth = arrays(frame)
    encoded = encode_layers(color, weight, coverage, depth, np.float32, by_depth)
    for over in (front_first, back_first):
        assert_sums(over(encoded), color, coverage, np.float32)


@seeded
@given(BRIGHT_FRAMES, st.booleans())
def test_half_is_clamped_only_where_the_pixel_itself_is_beyond_its_range(frame: list[list[Layer]], by_depth: bool
                                                                         ) -> None:
    color, weight, coverage, depth = arrays(frame)
    encoded = encode_layers(color, weight, coverage, depth, np.float16, by_depth)
    assert np.isfinite(encoded.color).all()
    fits = np.abs(color.astype(np.float64)).sum(0) <= HALF_MAX
    made, alpha = front_first(encoded)
    assert (np.abs(made - color.astype(np.float64).sum(0)) <= tolerance(color, np.float16))[fits].all()
    assert (np.abs(alpha - coverage.sum(0)) <= tolerance(coverage, np.float16)).all()
    assert not encoded.clamped or not fits.all()


@seeded
@given(BRIGHT_FRAMES, st.sampled_from(TYPES))
def test_deep_samples_are_sorted_without_equal_depths_and_opaque_only_at_the_back(frame: list[list[Layer]], dtype: type
                                                                                  ) -> None:
    color, weight, coverage, depth = arrays(frame)
    samples = deep_samples(encode_layers(color, weight, coverage, depth, dtype, True), Window(3, 4, 2 + len(frame), 4))
    assert samples.channels["Z"].dtype == np.float32
    assert {samples.channels[name].dtype for name in "RGBA"} == {np.dtype(dtype)}
    offsets = samples.offsets
    for pixel, (first, last) in enumerate(zip(offsets[:-1], offsets[1:], strict=True)):
        z, alpha = samples.channels["Z"][first:last], samples.channels["A"][first:last]
        assert (np.diff(z) > 0).all()
        assert np.isfinite(z).all()
        assert (alpha[:-1] < 1).all()
        assert ((alpha >= 0) & (alpha <= 1)).all()
        assert last - first <= len(weight)
        if weight[:, pixel].sum() == 0:
            assert last == first


@seeded
@given(FRAMES, st.sampled_from(TYPES))
def test_a_flat_layer_shows_only_what_is_its_own(frame: list[list[Layer]], dtype: type) -> None:
    """In the layers' own order a layer of enough weight is never moved to another picture."""
    color, weight, coverage, depth = arrays(frame)
    encoded = encode_layers(color, weight, coverage, depth, dtype, False)
    absent = ~encoded.present
    assert not encoded.alpha[absent].any()
    assert not encoded.color.swapaxes(1, 2)[absent].any()
    assert (encoded.depth[absent] == MISS_DEPTH).all()
    if dtype == np.float16:
        fits = np.abs(color).sum((0, 1)) < HALF_MAX * MIN_WEIGHT / 4  # what is brighter may join the layer in front
        assert encoded.present[(weight >= MIN_WEIGHT) & (coverage > 1e-6) & fits].all()


@seeded
@given(FRAMES.filter(lambda frame: any(layer[0] > 0 for pixel in frame for layer in pixel)))
def test_openimageio_flattens_the_deep_samples_to_the_sum(tmp_path_factory: pytest.TempPathFactory,
                                                          frame: list[list[Layer]]) -> None:
    color, weight, coverage, depth = arrays(frame)
    path = tmp_path_factory.mktemp("flatten") / "layers.exr"
    for dtype in TYPES:
        samples = deep_samples(encode_layers(color, weight, coverage, depth, dtype, True),
                               Window(0, 0, len(frame) - 1, 0))
        write_deep(path, samples)
        flat = flattened(path)
        assert_sums((flat[:3], flat[3]), color, coverage, dtype)


def flattened(path: Path) -> np.ndarray:
    """(4, P) R, G, B, A by OpenImageIO."""
    flat = oiio.ImageBufAlgo.flatten(oiio.ImageBuf(str(path)))
    assert not flat.has_error, flat.geterror()
    pixels = flat.get_pixels(oiio.FLOAT)
    names = list(flat.spec().channelnames)
    return np.stack([pixels[..., names.index(name)].ravel() for name in "RGBA"])


def one_pixel(*layers: Layer) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    return arrays([list(layers)])


def test_layers_are_sorted_by_depth() -> None:
    encoded = encode_layers(*one_pixel((0.5, 1, 7.0, (1, 2, 3)), (0.5, 1, 2.0, (4, 5, 6))), np.float32, True)
    assert encoded.depth[:, 0].tolist() == [2, 7]
    assert encoded.color[0, :, 0].tolist() == [4, 5, 6]
    assert encoded.alpha[:, 0].tolist() == [0.5, 1]


def test_without_depth_order_the_pictures_keep_their_layers() -> None:
    encoded = encode_layers(*one_pixel((0.5, 1, 7.0, (1, 2, 3)), (0.5, 1, 2.0, (4, 5, 6))), np.float32, False)
    assert encoded.depth[:, 0].tolist() == [7, 2]
    assert encoded.color[0, :, 0].tolist() == [1, 2, 3]


def test_a_faint_layer_joins_the_heavier_neighbour_and_takes_its_place() -> None:
    faint = one_pixel((2.0**-12, 1, 1.0, (1, 0, 0)), (1.0, 1, 2.0, (1, 1, 1)))
    deep = encode_layers(*faint, np.float32, True)
    assert deep.present[:, 0].tolist() == [True, False]
    assert deep.depth[0, 0] == 2
    pictures = encode_layers(*faint, np.float32, False)
    assert pictures.present[:, 0].tolist() == [False, True]
    assert pictures.color[1, :, 0].tolist() == [2, 1, 1]
    assert pictures.alpha[:, 0].tolist() == [0, 1]


def test_layers_of_equal_depth_are_one_sample() -> None:
    encoded = encode_layers(*one_pixel((0.25, 1, 3.0, (1, 0, 0)), (0.75, 1, 3.0, (0, 1, 0))), np.float32, True)
    assert encoded.present[:, 0].tolist() == [True, False]
    assert encoded.color[0, :, 0].tolist() == [1, 1, 0]
    assert encoded.alpha[0, 0] == 1


def test_a_sky_is_light_without_alpha_at_the_depth_of_a_miss() -> None:
    encoded = encode_layers(*one_pixel((1.0, 0, np.inf, (0.5, 0.6, 0.7)),), np.float32, True)
    assert encoded.alpha[0, 0] == 0
    assert encoded.depth[0, 0] == np.float32(MISS_DEPTH)
    assert encoded.present[0, 0]


def test_a_value_that_would_leave_halfs_range_joins_the_layer_in_front() -> None:
    front, back = (0.998, 1, 1.0, (1, 1, 1)), (0.002, 1, 2.0, (6e4, 0, 0))
    encoded = encode_layers(*one_pixel(front, back), np.float16, True)
    assert encoded.present[:, 0].tolist() == [True, False]
    assert encoded.clamped == 0
    assert encode_layers(*one_pixel(front, back), np.float32, True).present.all()


def test_what_half_cannot_hold_at_all_is_clamped_and_counted() -> None:
    encoded = encode_layers(*one_pixel((1.0, 1, 1.0, (1e6, -1e6, 1))), np.float16, True)
    assert encoded.color[0, :, 0].tolist() == [HALF_MAX, -HALF_MAX, 1]
    assert encoded.clamped == 2


@seeded
@given(st.lists(st.floats(2.0**-100, 2.0**126, width=32), min_size=1, max_size=20))
def test_depth_is_rounded_to_sixteen_bits(depths: list[float]) -> None:
    frame: list[list[Layer]] = [[(1.0, 1.0, depth, (1, 1, 1))] for depth in depths]
    encoded = encode_layers(*arrays(frame), np.float16, True)
    wanted = np.array(depths, np.float32)
    assert (np.abs(encoded.depth[0] - wanted) <= wanted * 2.0**-16).all()
    assert not (encoded.depth.view(np.uint32) & 0xFF).any()
