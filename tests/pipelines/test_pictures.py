"""Heat maps and panels: the numbers they draw and the colours they draw them in."""

from __future__ import annotations

import io

import numpy as np
import pytest
from PIL import Image

from model.metrics import score
from pipelines.pictures import diverging_colors, heat_map, panel, signed_error, worst_regions


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


def test_no_region_is_worst_where_there_is_no_error() -> None:
    assert worst_regions(np.zeros((20, 20)), 4) == []
    assert worst_regions(np.ones((3, 20)), 4) == []


def test_the_heat_map_is_a_picture_with_blue_where_the_image_is_too_dark() -> None:
    _, reference = pair()
    drawn = np.asarray(Image.open(io.BytesIO(heat_map(0.7 * reference, reference))).convert("RGB")).astype(int)
    middle = drawn[drawn.shape[0] // 3 : drawn.shape[0] // 2, drawn.shape[1] // 3 : drawn.shape[1] // 2]
    assert (middle[..., 2] > middle[..., 0] + 20).mean() > 0.9


@pytest.mark.parametrize("shape", [(40, 60), (1, 1), (2, 90)])
def test_panels_are_drawn_for_any_size(shape: tuple[int, int]) -> None:
    image, reference = pair(shape)
    drawn = Image.open(io.BytesIO(panel({"noisy": image, "denoised": reference * 1.01}, reference, "a title")))
    assert drawn.width > 1000
