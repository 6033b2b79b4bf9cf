"""Ordinary deep as weighted samples: the weighted sum is the flattened pixel, whatever the samples are."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given

from deep_io.over import decode_over, encode_over
from tests.deep_io.oracles import PIXELS, flat_arrays, flattened, per_pixel, seeded


@seeded
@given(PIXELS)
def test_the_weighted_mean_of_over_samples_is_the_flattened_pixel(pixels):
    counts, depth, alpha, radiance = flat_arrays(pixels)
    decoded = decode_over(counts, radiance, alpha, depth)
    assert np.isfinite(decoded.radiance).all()
    for pixel, weight, coverage, rgb in zip(pixels, *(per_pixel(decoded.counts, v) for v in
                                                      (decoded.weight, decoded.coverage, decoded.radiance)),
                                            strict=True):
        exact = [tuple(float(np.float32(v)) for v in sample) for sample in pixel]
        colour, opacity = flattened(exact)
        assert weight.sum() == pytest.approx(1, abs=1e-5)
        assert (weight > 0).all()
        assert (weight * coverage).sum() == pytest.approx(opacity, abs=1e-5)
        got = weight.astype(np.float64) @ rgb
        np.testing.assert_allclose(got, np.array([1, 2, 4]) * colour, rtol=1e-4, atol=1e-5 * max(1, colour))


def decode(pixel):
    counts, depth, alpha, radiance = flat_arrays([pixel])
    return decode_over(counts, radiance, alpha, depth)


def test_an_empty_pixel_is_one_virtual_miss():
    decoded = decode([])
    assert decoded.counts.tolist() == [1]
    assert decoded.order.tolist() == [-1]
    assert decoded.weight.tolist() == [1]
    assert decoded.coverage.tolist() == [0]
    assert decoded.radiance.tolist() == [[0, 0, 0]]


def test_an_opaque_sample_ends_the_pixel():
    decoded = decode([(1, 1, 4), (2, 1, 9)])
    assert decoded.order.tolist() == [0]
    assert decoded.radiance[0].tolist() == [4, 8, 16]


def test_what_is_left_of_the_weight_is_a_virtual_miss_and_comes_last():
    decoded = decode([(2, 0.5, 1), (1, 0.25, 1)])
    assert decoded.order.tolist() == [1, 0, -1]
    np.testing.assert_allclose(decoded.weight, [0.25, 0.375, 0.375])
    assert decoded.coverage.tolist() == [1, 1, 0]
    np.testing.assert_allclose(decoded.radiance[:, 0], [4, 2, 0])


def test_an_emissive_sample_hands_on_to_the_next_behind_that_has_weight():
    decoded = decode([(1, 0, 6), (2, 0, 1), (3, 0.5, 1)])
    assert decoded.order.tolist() == [2, -1]
    np.testing.assert_allclose(decoded.radiance[:, 0], [16, 0])


def test_an_emissive_sample_with_nothing_behind_gives_to_the_virtual_miss():
    decoded = decode([(1, 0.5, 1), (2, 0, 3)])
    assert decoded.order.tolist() == [0, -1]
    np.testing.assert_allclose(decoded.radiance[:, 0], [2, 3])


def test_an_emissive_sample_at_the_depth_of_an_opaque_one_keeps_its_light():
    decoded = decode([(1, 1, 2), (1, 0, 3)])
    assert decoded.order.tolist() == [0]
    assert decoded.radiance[0, 0] == 5


def test_equal_depths_share_their_joint_alpha_by_extinction():
    decoded = decode([(1, 0.5, 0.5), (1, 0.75, 0.75)])
    np.testing.assert_allclose(decoded.weight, [0.875 / 3, 0.875 * 2 / 3, 0.125], rtol=1e-6)
    np.testing.assert_allclose(decoded.radiance[:2, 0], [1, 1], rtol=1e-6)


def test_opaque_samples_at_one_depth_share_it_alone():
    decoded = decode([(1, 1, 2), (1, 0.5, 7), (1, 1, 4)])
    assert decoded.order.tolist() == [0, 2]
    np.testing.assert_allclose(decoded.weight, [0.5, 0.5])
    assert decoded.radiance[:, 0].tolist() == [2, 4]


def test_light_too_strong_for_a_tiny_alpha_stays_finite_and_is_not_lost():
    decoded = decode([(1, 1e-36, 1e4), (2, 0.5, 1)])
    assert np.isfinite(decoded.radiance).all()
    assert decoded.weight.astype(np.float64) @ decoded.radiance[:, 0] == pytest.approx(1e4 + 1, rel=1e-6)


@seeded
@given(PIXELS)
def test_weighted_samples_survive_the_over_form(pixels):
    pixels = [[(depth, 1.0 if alpha > 0 else 0.0, value) for depth, alpha, value in pixel] for pixel in pixels]
    counts, depth, alpha, radiance = flat_arrays(pixels)
    shares = [np.arange(1, n + 1) / max(n * (n + 1) / 2, 1) for n in counts]
    weight = np.concatenate([*shares, np.zeros(0)])
    packed = encode_over(counts, weight, alpha, depth)
    decoded = decode_over(counts, radiance[packed.order] * packed.scale[:, None], packed.alpha, packed.depth)
    mean = [w @ c for w, c in zip(per_pixel(counts, weight), per_pixel(counts, radiance.astype(float)), strict=True)]
    got = [w.astype(float) @ c for w, c in zip(per_pixel(decoded.counts, decoded.weight),
                                               per_pixel(decoded.counts, decoded.radiance), strict=True)]
    np.testing.assert_allclose(np.array(got), np.array(mean).reshape(-1, 3), rtol=1e-4, atol=1e-4)
