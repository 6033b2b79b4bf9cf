"""Heat maps and panels: the numbers they draw and the colours they draw them in."""

from __future__ import annotations

import io

import numpy as np
import pytest
from PIL import Image

from model.metrics import score
from pipelines.pictures import (
    HEAT_MAP_CORNER,
    diverging_colors,
    heat_map,
    panel,
    panel_figure,
    pooled,
    signed_error,
    worst_regions,
)


def pair(shape: tuple[int, int] = (40, 60)) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(3)
    reference = rng.uniform(0.2, 2.0, (*shape, 3))
    return reference * rng.lognormal(0.0, 0.3, reference.shape), reference


def oklab_of(srgb: np.ndarray) -> np.ndarray:
    linear = np.where(srgb <= 0.04045, srgb / 12.92, ((srgb + 0.055) / 1.055) ** 2.4)
    to_cone = np.array(
        [
            [0.4122214708, 0.5363325363, 0.0514459929],
            [0.2119034982, 0.6806995451, 0.1073969566],
            [0.0883024619, 0.2817188376, 0.6299787005],
        ]
    )
    to_lab = np.array(
        [
            [0.2104542553, 0.7936177850, -0.0040720468],
            [1.9779984951, -2.4285922050, 0.4505937099],
            [0.0259040371, 0.7827717662, -0.8086757660],
        ]
    )
    return np.cbrt(linear @ to_cone.T) @ to_lab.T


def test_the_mean_square_of_the_signed_error_is_the_relmse() -> None:
    image, reference = pair()
    assert (signed_error(image, reference) ** 2).mean() == pytest.approx(score(image, reference).relmse)


def test_darker_is_negative_and_brighter_positive() -> None:
    _, reference = pair()
    assert (signed_error(0.9 * reference, reference) < 0).all()
    assert (signed_error(1.1 * reference, reference) > 0).all()


def test_colours_are_perceptually_even_and_symmetric_in_lightness() -> None:
    lab = oklab_of(diverging_colors())
    steps = np.linalg.norm(np.diff(lab, axis=0), axis=1)
    assert steps.max() < 1.2 * steps.min()
    np.testing.assert_allclose(lab[:, 0], lab[::-1, 0], atol=0.01)
    assert lab[128, 0] > 0.96


def test_worst_regions_are_disjoint_and_start_with_the_worst() -> None:
    error = np.full((40, 60), 0.01)
    error[5:9, 7:11] = -0.9
    error[30:34, 40:44] = 0.5
    error[20, 20] = 100.0
    corners = worst_regions(error, 8)
    assert len(corners) == 3
    (row, column), second = corners[0], corners[1]
    assert row <= 5
    assert row + 8 >= 9
    assert column <= 7
    assert column + 8 >= 11
    assert 26 <= second[0] <= 30
    for i, a in enumerate(corners):
        for b in corners[i + 1 :]:
            assert abs(a[0] - b[0]) >= 8 or abs(a[1] - b[1]) >= 8


def test_what_rounding_leaves_is_no_region() -> None:
    error = np.zeros((200, 300))
    error[50:60, 50:60] = np.random.default_rng(0).uniform(0.1, 0.9, (10, 10))
    assert len(worst_regions(error, 40)) == 1


def test_no_region_is_worst_where_there_is_no_error() -> None:
    assert worst_regions(np.zeros((20, 20)), 4) == []
    assert worst_regions(np.ones((3, 20)), 4) == []


def test_the_heat_map_is_a_picture_with_blue_where_the_image_is_too_dark() -> None:
    _, reference = pair()
    drawn = np.asarray(Image.open(io.BytesIO(heat_map(0.7 * reference, reference))).convert("RGB")).astype(int)
    middle = drawn[drawn.shape[0] // 3 : drawn.shape[0] // 2, drawn.shape[1] // 3 : drawn.shape[1] // 2]
    assert (middle[..., 2] > middle[..., 0] + 20).mean() > 0.9


@pytest.mark.parametrize("shape", [(40, 60), (1, 1), (3, 700), (700, 3)])
def test_every_pixel_is_a_square_of_the_heat_map(shape: tuple[int, int]) -> None:
    image, reference = pair(shape)
    drawn = np.asarray(Image.open(io.BytesIO(heat_map(image, reference))).convert("RGB")).astype(float)
    dots = 600 // shape[1] if shape[1] < 600 and shape[0] < 600 else 1
    left, top = HEAT_MAP_CORNER
    squares = drawn[top : top + shape[0] * dots, left : left + shape[1] * dots]
    steps = (np.clip(signed_error(image, reference), -1.0, 1.0) + 1.0) / 2.0 * 257.0
    colors = 255.0 * diverging_colors()[np.minimum(steps.astype(int), 256)]
    np.testing.assert_allclose(squares, colors.repeat(dots, axis=0).repeat(dots, axis=1), atol=1.0)


def test_blocks_keep_thin_lines_and_noise_and_the_sign() -> None:
    error = np.zeros((7, 10))
    error[:, 3], error[6, 8] = -0.5, 30.0
    found = pooled(error, 3)
    assert found.shape == (3, 4)
    np.testing.assert_allclose(found[:, 1], -0.5 / 3**0.5)
    assert found[2, 2] == pytest.approx(1.0 / 3**0.5)  # one row of three pixels is left; clamped at 1
    assert not found[:, 0].any()
    noise = np.random.default_rng(1).choice([-0.4, 0.4], (30, 30))
    np.testing.assert_allclose(np.abs(pooled(noise, 5)), 0.4)
    np.testing.assert_array_equal(pooled(error, 1), np.clip(error, -1.0, 1.0))


def test_the_overview_of_a_panel_loses_no_thin_line() -> None:
    reference = np.full((300, 1500, 3), 0.5)
    image = reference.copy()
    image[:, 100:1500:189] *= 3.0  # eight lines of one pixel
    image[220:280, 600:800] *= 3.0  # draws the marks of the regions away from the rows looked at
    drawn = np.asarray(Image.open(io.BytesIO(panel({"image": image}, reference))).convert("RGB")).astype(int)
    top = drawn[40:60, drawn.shape[1] * 63 // 100 : -100]
    red = (top[..., 0] > top[..., 2] + 30).mean(axis=0) > 0.9
    assert np.count_nonzero(np.diff(red.astype(int)) == 1) == 8


def test_the_scale_of_a_panel_says_what_its_colours_mean() -> None:
    image, reference = pair()
    labels = [axes.get_ylabel() for axes in panel_figure({"image": image}, reference).axes]
    assert "relative error: blue too dark, red too bright" in labels


@pytest.mark.parametrize("shape", [(40, 60), (1, 1), (2, 90)])
def test_panels_are_drawn_for_any_size(shape: tuple[int, int]) -> None:
    image, reference = pair(shape)
    drawn = Image.open(io.BytesIO(panel({"noisy": image, "denoised": reference * 1.01}, reference, "a title")))
    assert drawn.width > 1000
