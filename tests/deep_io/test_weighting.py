"""Uniform and packed weights against slow oracles, and against compositing as any deep reader does it."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from deep_io.csr import by_rank, depth_order, strictly_increasing
from deep_io.weighting import decode_packed, decode_uniform, encode_packed, has_fractions, uniform_weights
from tests.deep_io.oracles import PIXELS, flat_arrays, per_pixel, seeded


@seeded
@given(PIXELS)
def test_uniform_weights_are_one_over_n_and_leave_samples_in_place(pixels):
    counts, _, alpha, radiance = flat_arrays(pixels)
    decoded = decode_uniform(counts, radiance, alpha)
    assert decoded.order is None
    for pixel, weight in zip(pixels, per_pixel(counts, decoded.weight), strict=True):
        assert weight == pytest.approx([1 / len(pixel) for _ in pixel])
    np.testing.assert_array_equal(decoded.radiance, radiance)
    np.testing.assert_array_equal(decoded.coverage, alpha)


@seeded
@given(PIXELS)
def test_packed_samples_composite_front_to_back_to_their_mean(pixels):
    counts, depth, alpha, radiance = flat_arrays(pixels)
    packed = encode_packed(counts, alpha, depth)
    colour = radiance[packed.order].astype(np.float64) * packed.scale[:, None]
    for pixel, z, a, rgb in zip(pixels, *(per_pixel(counts, v) for v in (packed.depth, packed.alpha, colour)),
                                strict=True):
        assert (np.diff(z) > 0).all()
        assert ((a >= 0) & (a <= 1)).all()
        transmittance, total = 1.0, np.zeros(3)
        for one_alpha, one_colour in zip(a, rgb, strict=True):
            total += transmittance * one_colour
            transmittance *= 1 - one_alpha
        n = max(len(pixel), 1)
        np.testing.assert_allclose(total, np.array([1, 2, 4]) * sum(s[2] for s in pixel) / n, rtol=1e-9, atol=1e-9)
        assert 1 - transmittance == pytest.approx(sum(s[1] for s in pixel) / n, abs=1e-9)


@seeded
@given(PIXELS, st.sampled_from([np.float16, np.float32]))
def test_packed_decodes_to_the_samples_that_were_encoded(pixels, dtype):
    counts, depth, alpha, radiance = flat_arrays(pixels)
    packed = encode_packed(counts, alpha, depth)
    stored_alpha = packed.alpha.astype(dtype)
    stored = (radiance[packed.order] * packed.scale[:, None]).astype(np.float32)
    decoded = decode_packed(counts, stored, stored_alpha, packed.depth)
    rounding = {np.float16: 2.0**-6, np.float32: 1e-5}[dtype]  # six samples' rounding adds up
    np.testing.assert_allclose(decoded.coverage, alpha[packed.order], atol=rounding)
    np.testing.assert_allclose(decoded.radiance, radiance[packed.order], rtol=rounding, atol=1e-6)


def test_packed_binary_coverage_decodes_exactly_even_from_half_alpha_of_a_thousand_samples():
    rng = np.random.default_rng(1)
    counts = np.array([1000, 17], np.int32)
    coverage = (rng.random(1017) < 0.7).astype(np.float32)
    depth = rng.random(1017).astype(np.float32)
    packed = encode_packed(counts, coverage, depth)
    decoded = decode_packed(counts, np.ones((1017, 3), np.float32), packed.alpha.astype(np.float16), packed.depth)
    np.testing.assert_array_equal(decoded.coverage, coverage[packed.order])


def test_packed_samples_out_of_order_are_sorted_before_decoding():
    counts = np.array([3], np.int32)
    packed = encode_packed(counts, np.ones(3), np.array([3.0, 1.0, 2.0]))
    shuffled = np.array([2, 0, 1])
    rgb = np.repeat(packed.scale[:, None], 3, axis=1)
    decoded = decode_packed(counts, rgb[shuffled], packed.alpha[shuffled].astype(np.float32), packed.depth[shuffled])
    np.testing.assert_array_equal(decoded.order, [1, 2, 0])
    np.testing.assert_allclose(decoded.radiance, 1, rtol=1e-6)


@pytest.mark.parametrize(("alpha", "expected"), [
    ([0, 1, 1], False), ([0, 0.5], True), ([0.9999999], False), ([np.nan, 1], False), ([-0.0, 1], False),
    ([1.001], True), ([], False),
])
@pytest.mark.parametrize("dtype", [np.float16, np.float32])
def test_fractions_are_found_in_half_and_float(alpha, expected, dtype):
    assert has_fractions(np.array(alpha, dtype)) is expected


@seeded
@given(PIXELS)
def test_ranks_visit_every_sample_once_in_order_of_the_pixel(pixels):
    counts, depth, _, _ = flat_arrays(pixels)
    seen: list[list[float]] = [[] for _ in pixels]
    for here, of in by_rank(counts):
        for pixel, value in zip(np.arange(len(pixels))[of], depth[here], strict=True):
            seen[pixel].append(value)
    assert seen == [[np.float32(s[0]) for s in pixel] for pixel in pixels]


@seeded
@given(PIXELS)
def test_depth_order_sorts_stably_within_pixels(pixels):
    counts, depth, _, _ = flat_arrays(pixels)
    order = depth_order(counts, depth)
    expected, start = [], 0
    for pixel in pixels:
        expected += [start + i for i in sorted(range(len(pixel)), key=lambda i: np.float32(pixel[i][0]))]
        start += len(pixel)
    np.testing.assert_array_equal(np.arange(depth.size) if order is None else order, expected)
    if order is None:
        assert expected == list(range(depth.size))


def test_equal_depths_part_by_single_float_steps_also_at_the_depth_of_misses():
    counts = np.array([3, 0, 2], np.int32)
    depth = strictly_increasing(counts, np.array([1e10, 1e10, 1e10, 5, 5], np.float32))
    assert (np.diff(depth[:3]) > 0).all()
    assert depth[0] == np.float32(1e10)
    assert depth[4] == np.nextafter(np.float32(5), np.float32(6))


def test_uniform_weights_of_pixels_without_samples_take_no_room():
    np.testing.assert_allclose(uniform_weights(np.array([[0, 2], [1, 0]], np.int32)), [0.5, 0.5, 1])
