"""The untrained baseline: what it keeps, what it clamps, what it blurs."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from model.baseline import blur, clamp_and_blur, pixel_means


def test_pixel_means_are_the_weighted_means_of_each_pixels_samples() -> None:
    counts = np.array([[2, 0, 1]])
    weight = np.array([0.25, 0.75, 1.0])
    values = np.array([[4.0, 0.0], [0.0, 8.0], [5.0, 6.0]])
    assert pixel_means(counts, weight, values).tolist() == [[[1.0, 6.0], [0.0, 0.0], [5.0, 6.0]]]


@pytest.mark.parametrize("shape", [(20, 30), (1, 1), (3, 2)])
def test_blur_is_scipys_gaussian_of_sigma_one(shape: tuple[int, int]) -> None:
    image = np.random.default_rng(0).random((*shape, 3))
    np.testing.assert_allclose(blur(image), gaussian_filter(image, (1, 1, 0), mode="reflect"), rtol=1e-12)


def test_one_firefly_sample_cannot_outshine_the_clamp() -> None:
    counts = np.full((16, 16), 4)
    radiance = np.full((1024, 3), 0.5)
    radiance[500] = 1e6
    picture = clamp_and_blur(counts, np.full(1024, 0.25), radiance)
    np.testing.assert_allclose(picture, 0.5, rtol=1e-12)


def test_a_frame_without_samples_is_black() -> None:
    assert not clamp_and_blur(np.zeros((2, 3), int), np.zeros(0), np.zeros((0, 3))).any()
