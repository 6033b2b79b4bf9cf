"""The a-trous filter: it removes noise, stops at the guides' edges, and is a weighted mean of what is there."""

from __future__ import annotations

import numpy as np
import pytest

from model.atrous import SPLINE, atrous, bounded_depth


def noisy(seed: int, size: int = 48) -> np.ndarray:
    return np.random.default_rng(seed).gamma(4.0, 0.25, (size, size, 3)).astype(np.float32)


def halves(size: int = 48, width: int = 3) -> np.ndarray:
    """A guide with an edge down the middle."""
    image = np.zeros((size, size, width), np.float32)
    image[:, size // 2 :] = 1.0
    return image


def test_a_constant_stays_constant() -> None:
    color = np.full((20, 30, 3), 0.37, np.float32)
    np.testing.assert_allclose(atrous(color, {"normal": halves()[:20, :30]}), color, rtol=1e-6)


def test_noise_shrinks_and_the_mean_stays() -> None:
    color = noisy(0)
    result = atrous(color, {})
    assert result.std() < 0.3 * color.std()
    assert result.mean() == pytest.approx(color.mean(), rel=0.05)


def test_light_does_not_cross_an_edge_of_a_guide() -> None:
    color = 1.0 + 0.1 * (noisy(1) - 1.0)
    color[:, 24:] += 0.3  # too small a step for the colour weights alone
    mixed = atrous(color, {})
    kept = atrous(color, {"albedo": halves()})
    assert mixed[:, 23].mean() > 1.05
    assert kept[:, 23].mean() == pytest.approx(1.0, abs=0.02)
    assert kept[:, 24].mean() == pytest.approx(1.3, abs=0.02)


def test_the_output_scales_with_the_input() -> None:
    color = noisy(2)
    np.testing.assert_allclose(atrous(64.0 * color, {}), 64.0 * atrous(color, {}), rtol=1e-5)


def test_one_level_is_the_equation() -> None:
    """Against the published sum, written out for one inner pixel."""
    color, normal = noisy(3, 9), noisy(4, 9) - 0.5
    exposure = 1.0 / color.mean(dtype=np.float64)
    seen = np.log1p(color.astype(np.float64) * exposure) / 2.0
    total, norm = np.zeros(3), 0.0
    for row in range(-2, 3):
        for column in range(-2, 3):
            there = 4 + row, 4 + column
            distance = ((seen[4, 4] - seen[there]) ** 2).sum() + (((normal[4, 4] - normal[there]) / 0.3) ** 2).sum()
            weight = SPLINE[row + 2] * SPLINE[column + 2] * np.exp(-distance)
            total += weight * color[there]
            norm += weight
    np.testing.assert_allclose(atrous(color, {"normal": normal}, levels=1)[4, 4], total / norm, rtol=1e-5)


def test_black_stays_black_and_tiny_pictures_work() -> None:
    assert not atrous(np.zeros((3, 2, 3), np.float32), {}).any()
    assert atrous(noisy(5, 1), {}).shape == (1, 1, 3)


def test_guides_of_another_size_or_name_are_refused() -> None:
    with pytest.raises(ValueError, match="unknown guide 'motion'"):
        atrous(noisy(0), {"motion": halves()})
    with pytest.raises(ValueError, match="depth"):
        atrous(noisy(0), {"depth": halves(20, 1)})


def test_bounded_depth_knows_no_unit_and_puts_misses_last() -> None:
    depth = np.array([[1.0], [2.0], [4.0], [1e10]])
    hit = np.array([[True], [True], [True], [False]])
    found = bounded_depth(depth, hit)
    assert found.ravel().tolist() == pytest.approx([1 / 3, 1 / 2, 2 / 3, 1.0])
    np.testing.assert_allclose(bounded_depth(depth * 1000.0, hit), found, rtol=1e-6)
