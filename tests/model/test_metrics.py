"""The metrics against hand counts, independent implementations and the properties that define them."""

from __future__ import annotations

import math

import flip_evaluator
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from skimage.metrics import peak_signal_noise_ratio, structural_similarity

from model import metrics


def random_pair(seed: int, shape: tuple[int, int] = (24, 31), noise: float = 0.2) -> tuple[np.ndarray, np.ndarray]:
    """A smooth picture in linear light and a noisy version of it."""
    rng = np.random.default_rng(seed)
    ramp = np.add.outer(np.linspace(0.02, 2.0, shape[0]), np.sin(np.linspace(0.0, 6.0, shape[1])) + 1.0)
    reference = ramp[..., None] * rng.uniform(0.2, 1.5, 3)
    return reference * rng.lognormal(0.0, noise, reference.shape), reference


def test_the_common_scale_brings_the_mean_without_fireflies_to_one_half() -> None:
    _, reference = random_pair(0)
    k = metrics.common_scale(reference)
    clipped = np.minimum(reference, np.percentile(reference, 99))
    assert (k * clipped).mean() == pytest.approx(0.5)


def test_errors_equal_a_hand_count_on_two_pixels() -> None:
    r = np.array([[[0.5, 0.5, 0.5], [0.0, 1.0, 2.0]]])
    d = np.array([[[0.5, 0.7, 0.5], [0.1, 1.0, 1.0]]])
    relative = [0.04 / 0.26, 0.01 / 0.01, 1.0 / 4.01]
    assert metrics.relmse(d, r) == pytest.approx(sum(relative) / 6)
    assert metrics.relmse(d, r, 0.0001) == pytest.approx((0.04 / 0.2501 + 0.01 / 0.0001 + 1.0 / 4.0001) / 6)
    assert metrics.smape(d, r) == pytest.approx((0.2 / 1.21 + 0.1 / 0.11 + 1.0 / 3.01) / 6)
    assert metrics.relmse_trimmed(d, r) == pytest.approx(relative[0] / 3)  # the second pixel is the worse one


def test_scores_of_an_image_against_itself_are_perfect() -> None:
    _, reference = random_pair(1)
    scores = metrics.score(reference, reference)
    assert (scores.relmse, scores.relmse_trimmed, scores.relmse_small_epsilon, scores.smape) == (0, 0, 0, 0)
    assert scores.psnr == math.inf
    assert scores.ssim == pytest.approx(1.0)
    assert scores.energy == 1.0
    assert scores.flip == pytest.approx(0.0, abs=1e-6)


@given(st.integers(0, 2**20), st.floats(1e-3, 1e3))
@settings(max_examples=20, deadline=None)
def test_scores_do_not_depend_on_the_exposure_of_the_picture(seed: int, factor: float) -> None:
    image, reference = random_pair(seed)
    one = metrics.score(image, reference, with_flip=False)
    other = metrics.score(factor * image, factor * reference, with_flip=False)
    for name in ("relmse", "relmse_trimmed", "relmse_small_epsilon", "smape", "psnr", "ssim", "energy"):
        assert getattr(other, name) == pytest.approx(getattr(one, name), rel=1e-9)


@pytest.mark.parametrize("seed", range(3))
def test_ssim_agrees_with_scikit_image(seed: int) -> None:
    image, reference = random_pair(seed)
    expected = structural_similarity(
        metrics.tone_mapped(reference),
        metrics.tone_mapped(image),
        data_range=1.0,
        channel_axis=-1,
        gaussian_weights=True,
        sigma=1.5,
        use_sample_covariance=False,
    )
    assert metrics.ssim(image, reference) == pytest.approx(expected, abs=1e-9)


def test_psnr_agrees_with_scikit_image() -> None:
    image, reference = random_pair(5)
    expected = peak_signal_noise_ratio(metrics.tone_mapped(reference), metrics.tone_mapped(image), data_range=1.0)
    assert metrics.psnr(image, reference) == pytest.approx(expected)


def test_flip_agrees_with_flip_evaluator_on_the_scaled_images() -> None:
    image, reference = random_pair(6)
    k = metrics.common_scale(reference)
    _, expected, _ = flip_evaluator.evaluate((k * reference).astype("f4"), (k * image).astype("f4"), "HDR")
    assert metrics.score(image, reference).flip == pytest.approx(expected, rel=1e-5)


def test_tone_mapping_is_monotone_and_continuous_where_its_two_pieces_meet() -> None:
    x = np.linspace(0.0, 1.2, 20001)
    steps = np.diff(metrics.tone_mapped(x))
    assert (steps > 0).all()
    assert steps.max() < 12.92 * (x[1] - x[0]) * 1.01


def test_two_halves_give_an_error_free_of_the_references_noise() -> None:
    rng = np.random.default_rng(7)
    truth = np.full((200, 200, 3), 0.5)
    image = truth + rng.normal(0.0, 0.05, truth.shape)
    a, b = (truth + rng.normal(0.0, 0.03, truth.shape) for _ in range(2))
    true_error = metrics.relmse(image, truth)
    scores = metrics.score(image, a, b, with_flip=False)
    assert scores.relmse_unbiased == pytest.approx(true_error, rel=0.05)
    assert scores.floor == pytest.approx(metrics.relmse((a + b) / 2, truth), rel=0.05)
    assert scores.relmse == pytest.approx(scores.relmse_unbiased + scores.floor, rel=0.05)


def test_one_firefly_leaves_the_trimmed_error_alone() -> None:
    image, reference = random_pair(8, (40, 40))
    marred = image.copy()
    marred[3, 4] = 1e4
    before, after = (metrics.score(picture, reference, with_flip=False) for picture in (image, marred))
    assert after.relmse > 1e3 * before.relmse
    assert after.relmse_trimmed == pytest.approx(before.relmse_trimmed, rel=0.02)


def test_ssim_of_an_image_smaller_than_its_window_is_not_a_number() -> None:
    image, reference = random_pair(9, (10, 40))
    assert math.isnan(metrics.ssim(image, reference))


def test_a_black_reference_is_refused() -> None:
    with pytest.raises(ValueError, match="no light"):
        metrics.score(np.ones((4, 4, 3)), np.zeros((4, 4, 3)))
    with pytest.raises(ValueError, match="no light in it: no value is above 0"):
        metrics.common_scale(np.full((4, 4, 3), -1.0))


def test_a_reference_whose_negative_values_outweigh_its_light_is_not_called_dark() -> None:
    reference = np.full((4, 4, 3), -1.0)
    reference[0] = 2.0
    with pytest.raises(ValueError, match=r"mean is -0\.25, .*negative values outweigh its light"):
        metrics.common_scale(reference)


def test_sizes_that_differ_are_both_named() -> None:
    with pytest.raises(ValueError, match="5 x 4 and 4 x 5"):
        metrics.score(np.ones((4, 5, 3)), np.ones((5, 4, 3)))


def test_values_that_are_not_finite_are_counted_and_refused() -> None:
    image = np.ones((4, 4, 3))
    image[0, 0, 1] = np.nan
    image[2, 3] = np.inf
    with pytest.raises(ValueError, match="the image has 2 pixels"):
        metrics.score(image, np.ones((4, 4, 3)))


def test_the_geometric_mean_is_the_root_of_the_product() -> None:
    assert metrics.geometric_mean([0.1, 10.0, 8.0]) == pytest.approx(2.0)
    assert metrics.geometric_mean([1.0, 0.0]) == 0.0
    assert math.isnan(metrics.geometric_mean([]))


def test_bootstrap_intervals_cover_the_true_mean_about_as_often_as_they_say() -> None:
    rng = np.random.default_rng(10)
    covered = 0
    for _ in range(100):
        low, high = metrics.bootstrap_interval(
            rng.normal(3.0, 1.0, 30).tolist(), lambda v: float(np.mean(v)), resamples=300
        )
        covered += low <= 3.0 <= high
    assert 86 <= covered <= 100


def test_bootstrap_intervals_repeat() -> None:
    values = [0.1, 0.2, 0.4, 0.3]
    assert metrics.bootstrap_interval(values) == metrics.bootstrap_interval(values)
