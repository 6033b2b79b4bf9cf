"""Cells with nothing to do: which they are, whatever the windows and blocks, and what stands for alike samples."""

from __future__ import annotations

import numpy as np
import pytest

from deep_io.path_samples import PathSamples
from deep_io.samples import Window
from pipelines.cells import ALIKE, Cells, CellSurvey, merged


def frame(window: Window, per_pixel: int = 2, seed: int = 0) -> PathSamples:
    """A background of its own brightness in every pixel; carries one light."""
    rng = np.random.default_rng(seed)
    pixels = window.width * window.height
    radiance = np.repeat(rng.uniform(0.1, 9, (pixels, 3)), per_pixel, 0).astype(np.float32)
    total = len(radiance)
    return PathSamples(
        np.full((window.height, window.width), per_pixel, np.int32),
        np.full(total, 1 / per_pixel, np.float32),
        np.zeros(total, np.float32),
        {"radiance": radiance, "depth": np.zeros((total, 1), np.float32)},
        window,
        extra=rng.uniform(0, 1, (total, 1)).astype(np.float32),
    )


def cells(block: PathSamples, display: Window, cuts: tuple[int, ...] = ()) -> Cells:
    survey = CellSurvey((display.xmin, display.ymin))
    edges = [0, *cuts, block.counts.shape[0]]
    for first, last in zip(edges[:-1], edges[1:], strict=True):
        own = slice(*(int(block.counts[:row].sum()) for row in (first, last)))
        survey.add(PathSamples(
            block.counts[first:last], block.weight[own], block.coverage[own],
            {role: values[own] for role, values in block.roles.items()},
            block.window.rows(block.window.ymin + first, block.window.ymin + last), extra=block.extra[own]))
    return survey.result()


def at(block: PathSamples, x: int, y: int) -> int:
    """The first sample of the pixel at (x, y) of the image plane."""
    return int(block.offsets[(y - block.window.ymin) * block.window.width + x - block.window.xmin])


DISPLAY = Window(0, 0, 199, 149)


def test_a_hit_keeps_its_cell_of_the_display_windows_grid_and_no_other() -> None:
    block = frame(Window(-10, 50, 149, 139))  # cell columns -1, 0, 1, 2 and cell rows 0, 1, 2
    block.coverage[at(block, 64, 63)] = 1
    found = cells(block, DISPLAY)
    busy = np.zeros((3, 4), np.bool_)
    busy[0, 2] = True
    np.testing.assert_array_equal(found.passed, ~busy)
    ys, xs = np.nonzero(~found.mask)
    assert (xs.min() - 10, xs.max() - 10, ys.min() + 50, ys.max() + 50) == (64, 127, 50, 63)


@pytest.mark.parametrize("cuts", [(1,), (13, 14, 60), tuple(range(1, 90))])
def test_blocks_of_rows_change_nothing(cuts: tuple[int, ...]) -> None:
    block = frame(Window(-10, 50, 149, 139))
    block.coverage[at(block, 70, 100)] = 1
    whole, cut = cells(block, DISPLAY), cells(block, DISPLAY, cuts)
    np.testing.assert_array_equal(cut.passed, whole.passed)
    np.testing.assert_array_equal(cut.known, whole.known)
    np.testing.assert_array_equal(cut.means, whole.means)


def test_misses_that_differ_are_work_and_those_that_hardly_do_are_not() -> None:
    block = frame(Window(0, 0, 127, 63))
    block.roles["radiance"][:] = 1
    block.roles["radiance"][at(block, 3, 5)] *= 1 - ALIKE / 2
    block.roles["radiance"][at(block, 90, 5), 1] *= 1 - ALIKE * 1.5
    found = cells(block, DISPLAY)
    assert found.passed.tolist() == [[True, False]]
    assert int(found.alike.sum()) == 128 * 64 - 2


def test_means_are_those_of_radiance_and_of_what_is_carried() -> None:
    block = frame(Window(0, 0, 63, 63))
    found = cells(block, DISPLAY)
    assert found.means is not None
    mean = np.concatenate([block.roles["radiance"], block.extra], 1).reshape(64, 64, 2, 4).mean(2)
    np.testing.assert_allclose(found.means, mean, rtol=1e-6)


def test_a_cell_without_samples_passes_and_its_pixels_are_unknown() -> None:
    block = frame(Window(0, 0, 127, 63))
    block.coverage[:] = 1
    some = np.ones((64, 128), np.bool_)
    some[:, 64:] = False
    kept = np.repeat(some.ravel(), 2)
    block = PathSamples(block.counts * some, block.weight[kept], block.coverage[kept],
                        {role: values[kept] for role, values in block.roles.items()}, block.window,
                        extra=block.extra[kept])
    found = cells(block, DISPLAY)
    assert found.passed.tolist() == [[False, True]]
    assert not found.known.any()


def test_merged_samples_weigh_what_all_did() -> None:
    block = frame(Window(0, 0, 7, 3), per_pixel=4)
    alike = np.zeros((4, 8), np.bool_)
    alike[1, 2:5] = alike[3, 7] = True
    block.weight[:] = np.random.default_rng(1).dirichlet(np.ones(4), 32).ravel()
    less, squares = merged(block, alike)
    np.testing.assert_array_equal(less.counts, np.where(alike, 1, 4))
    assert less.total == len(squares) == 32 * 4 - 4 * 3

    def sums(values: np.ndarray, of: PathSamples) -> np.ndarray:
        return np.add.reduceat(values, of.offsets[:-1], 0)

    np.testing.assert_allclose(sums(less.weight, less), 1, rtol=1e-6)
    np.testing.assert_allclose(sums(squares, less), sums(block.weight**2, block), rtol=1e-6)
    for values, before in ((less.roles["radiance"], block.roles["radiance"]), (less.extra, block.extra)):
        np.testing.assert_allclose(sums(less.weight[:, None] * values, less),
                                   sums(block.weight[:, None] * before, block), rtol=1e-5)


def test_a_few_alike_pixels_are_not_worth_sorting() -> None:
    block = frame(Window(0, 0, 63, 63))
    block.coverage[2 * 64 :] = 1
    assert not cells(block, DISPLAY).alike.any()
