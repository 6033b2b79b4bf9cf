"""The light of a whole picture, held to that of its samples."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import numpy.typing as npt
import pytest

from pipelines import light
from pipelines.inference import FrameLayers
from pipelines.light import hold_light

HEIGHT, WIDTH = 96, 144
NOTHING = np.zeros((HEIGHT, WIDTH), np.bool_)
FloatArray = npt.NDArray[np.float32]


def _layers(beauty: FloatArray, extra: int = 0) -> FrameLayers:
    """Two layers whose sum is the beauty (H, W), the same in R, G and B, and so are the extra values."""
    plane = beauty.astype(np.float32)
    parts = np.stack([0.3 * plane, 0.7 * plane])
    share = np.stack([np.full_like(plane, 0.3), np.full_like(plane, 0.7)])
    return FrameLayers(np.repeat(parts[:, None], 3, 1), share, share.copy(), np.ones_like(share),
                       np.repeat(parts[:, None], extra, 1))


def _truth() -> FloatArray:
    """(H, W) a picture with bright and dark parts."""
    y, x = np.mgrid[:HEIGHT, :WIDTH]
    picture: FloatArray = (1 + np.sin(x / 9) * np.cos(y / 7) * 0.8 + 3 * (x > 100)).astype(np.float32)
    return picture


def _samples(truth: FloatArray, noise: float | FloatArray, seed: int = 0) -> FloatArray:
    rng = np.random.default_rng(seed)
    noisy: FloatArray = (truth * (1 + noise * rng.standard_normal(truth.shape))).astype(np.float32)
    return noisy


def _light(layers: FrameLayers) -> float:
    return float(layers.beauty().mean(dtype=np.float64))


@pytest.mark.parametrize("left", [0.94, 1.05])
def test_light_that_is_lost_or_added_is_put_right(left: float) -> None:
    truth = _truth()
    layers = _layers(truth * left)
    hold_light(layers, _samples(truth, 0.2), NOTHING)
    assert _light(layers) == pytest.approx(float(truth.mean()), rel=0.005)


def test_where_samples_and_picture_agree_nothing_changes() -> None:
    truth = _truth()
    quiet = np.arange(WIDTH) < 70
    noise = np.where(quiet, 0, 0.5).astype(np.float32)
    before = truth * np.where(quiet, 1, 0.95).astype(np.float32)
    layers = _layers(before)
    hold_light(layers, _samples(truth, noise), NOTHING)
    far = np.arange(WIDTH) < 40  # from any noise, by a few cells
    np.testing.assert_allclose(layers.beauty()[:, far, 0], before[:, far], rtol=1e-6)
    assert layers.beauty()[:, 100:].mean() > before[:, 100:].mean() * 1.02


def test_settled_pixels_are_left_as_they_are() -> None:
    truth = _truth()
    settled = NOTHING.copy()
    settled[:64, :64] = True
    layers = _layers(truth * 0.95)
    hold_light(layers, _samples(truth, 0.2), settled)
    np.testing.assert_allclose(layers.beauty()[settled][:, 0], truth[settled] * np.float32(0.95), rtol=1e-6)
    assert layers.beauty()[~settled].mean() == pytest.approx(float(truth[~settled].mean()), rel=0.01)


def test_samples_that_tell_little_change_little() -> None:
    truth = _truth()
    samples = _samples(truth, 30.0, seed=1)
    layers = _layers(truth)
    hold_light(layers, samples, NOTHING)
    wrong = abs(float(samples.mean()) / float(truth.mean()) - 1)
    assert wrong > 0.05
    assert abs(_light(layers) / float(truth.mean()) - 1) < wrong / 20


def test_pixels_without_samples_say_nothing() -> None:
    truth = _truth()
    samples = _samples(truth, 0.2)
    samples[:, :60] = np.nan
    layers = _layers(truth * 0.95)
    hold_light(layers, samples, NOTHING)
    known = layers.beauty()[:, 60:].mean(dtype=np.float64)
    assert known == pytest.approx(float(truth[:, 60:].mean()), rel=0.005)


def test_lights_follow_and_nothing_else_does() -> None:
    truth = _truth()
    layers = _layers(truth * 0.95, extra=5)
    before = replace(layers, **{name: getattr(layers, name).copy() for name in vars(layers)})
    hold_light(layers, _samples(truth, 0.2), NOTHING, lights=3)
    np.testing.assert_array_equal(layers.extra[:, :3], layers.color)
    assert not np.allclose(layers.color, before.color)
    for name in ("weight", "coverage", "depth"):
        np.testing.assert_array_equal(getattr(layers, name), getattr(before, name))
    np.testing.assert_array_equal(layers.extra[:, 3:], before.extra[:, 3:])


@pytest.mark.parametrize("firefly", [30.0, 300.0, 3000.0])
def test_a_firefly_makes_no_bright_square(firefly: float) -> None:
    truth = np.ones((HEIGHT, WIDTH), np.float32)
    samples = _samples(truth, 0.02)
    samples[40, 70] = firefly
    layers = _layers(truth)
    hold_light(layers, samples, NOTHING)
    assert layers.beauty().max() - 1 < 4.1 * min((firefly - 1) / truth.size, 0.02)


def test_rows_are_gathered_in_blocks_without_a_seam(monkeypatch: pytest.MonkeyPatch) -> None:
    truth = _truth()[:93, :131]  # cells at the end are smaller
    samples = _samples(truth, 0.3)
    found = []
    for rows in (1000, 1):
        monkeypatch.setattr(light, "ROWS", rows)
        layers = _layers(truth * 0.95)
        hold_light(layers, samples, NOTHING[:93, :131])
        found.append(layers.color)
    np.testing.assert_array_equal(*found)
    assert not np.allclose(found[0], _layers(truth * 0.95).color)


@pytest.mark.parametrize("factor", [1e-20, 1e-3, 1e20])
def test_the_unit_of_radiance_is_irrelevant(factor: float) -> None:
    truth = _truth()
    samples = _samples(truth, 0.3)
    one, other = _layers(truth * 0.95), _layers(truth * np.float32(0.95 * factor))
    hold_light(one, samples, NOTHING)
    hold_light(other, samples * np.float32(factor), NOTHING)
    np.testing.assert_allclose(other.color / np.float32(factor), one.color, rtol=1e-4)


@pytest.mark.parametrize(("height", "width"), [(96, 144), (93, 131), (90, 9), (1, 50)])
def test_a_mirrored_picture_gives_the_mirrored_result(height: int, width: int) -> None:
    truth = _truth()[:height, :width]
    noise = np.where(np.arange(width) < width / 3, 0.02, 0.3).astype(np.float32)
    samples, nothing = _samples(truth, noise), NOTHING[:height, :width]
    one, other = _layers(truth * 0.95), _layers(truth[::-1, ::-1] * 0.95)
    hold_light(one, samples, nothing)
    hold_light(other, samples[::-1, ::-1].copy(), nothing)
    np.testing.assert_allclose(other.color[..., ::-1, ::-1], one.color, rtol=1e-5)


@pytest.mark.parametrize("size", range(1, 60))
def test_cells_cover_the_picture_and_are_alike_from_either_side(size: int) -> None:
    edges = light._edges(size)
    assert (edges[0], edges[-1]) == (0, size)
    assert 0 < np.diff(edges).min() <= np.diff(edges).max() <= light.CELL + 1
    np.testing.assert_array_equal(size - edges[::-1], edges)


@pytest.mark.parametrize(("height", "width"), [(1, 2), (3, 2), (2, 1), (16, 700), (300, 1)])
def test_small_and_narrow_pictures(height: int, width: int) -> None:
    truth = np.full((height, width), 2.0, np.float32)
    layers = _layers(truth * 0.95)
    hold_light(layers, _samples(truth, 0.05), np.zeros((height, width), np.bool_))
    assert layers.color.shape == (2, 3, height, width)
    assert (abs(layers.beauty() / 2 - 0.975) < 0.045).all()


@pytest.mark.parametrize("hard", ["black", "firefly", "no samples", "one pixel", "negative"])
def test_hard_pictures_stay_finite_and_sane(hard: str) -> None:
    truth = _truth()
    samples = _samples(truth, 0.3)
    before = truth * np.float32(0.95)
    if hard == "black":
        before, samples = np.zeros_like(truth), np.zeros_like(truth)
    elif hard == "firefly":
        samples[40, 70] = 3e38
    elif hard == "no samples":
        samples[:] = np.nan
    elif hard == "one pixel":
        before, samples = before[:1, :1], samples[:1, :1]
    else:
        before, samples = -before, -samples
    layers = _layers(before)
    hold_light(layers, samples, NOTHING[: len(before), : before.shape[1]])
    assert np.isfinite(layers.color).all()
    # one firefly says nothing of the rest; without light there is nothing to hold
    np.testing.assert_allclose(layers.beauty()[..., 0], before, rtol=0.01)
