"""The survey: what it measures, and that neither units nor blocks of rows change it."""

from __future__ import annotations

from collections import Counter

import numpy as np
import pytest

from deep_io.path_samples import PathSamples
from deep_io.samples import Window
from pipelines.survey import Survey, exposure_of, survey


def frame(seed: int = 0, height: int = 37, width: int = 50) -> PathSamples:
    """Random samples, 0 to 4 in a pixel, some of them misses."""
    rng = np.random.default_rng(seed)
    counts = rng.integers(0, 5, (height, width)).astype(np.int32)
    total = int(counts.sum())
    coverage = (rng.random(total) < 0.8).astype(np.float32)
    weight = np.repeat(1 / np.maximum(counts.ravel(), 1), counts.ravel()).astype(np.float32)
    roles = {
        "radiance": rng.lognormal(0, 2, (total, 3)).astype(np.float32),
        "depth": rng.uniform(1, 9, (total, 1)).astype(np.float32) * coverage[:, None],
        "roughness": np.full((total, 1), 0.5, np.float32),
    }
    return PathSamples(counts, weight, coverage, roles, Window(-3, 10, width - 4, height + 9), Counter(depth=2))


def rows(block: PathSamples, first: int, last: int) -> PathSamples:
    part = slice(*(int(block.counts[:row].sum()) for row in (first, last)))
    window = block.window.rows(block.window.ymin + first, block.window.ymin + last)
    return PathSamples(block.counts[first:last], block.weight[part], block.coverage[part],
                       {role: values[part] for role, values in block.roles.items()}, window)


def scaled(block: PathSamples, radiance: float, depth: float) -> PathSamples:
    factor = {"radiance": np.float32(radiance), "depth": np.float32(depth)}
    roles = {role: values * factor.get(role, np.float32(1)) for role, values in block.roles.items()}
    return PathSamples(block.counts, block.weight, block.coverage, roles, block.window)


def test_counts_and_repairs() -> None:
    block = frame()
    seen = survey([block])
    assert (seen.pixels, seen.samples) == (block.counts.size, block.weight.size)
    assert seen.empty_pixels == int((block.counts == 0).sum())
    assert seen.repairs == {"depth": 2}


@pytest.mark.parametrize("cuts", [[1], [16], [5, 7, 31]])
def test_blocks_change_nothing(cuts: list[int]) -> None:
    block = frame()
    edges = [0, *cuts, block.counts.shape[0]]
    parts = [rows(block, a, b) for a, b in zip(edges[:-1], edges[1:], strict=True)]
    whole, cut = survey([block]), survey(parts)
    assert cut.exposure == pytest.approx(whole.exposure, rel=1e-12)
    assert cut.depth == pytest.approx(whole.depth, rel=1e-12)
    assert (cut.samples, cut.mixed) == (whole.samples, whole.mixed)


@pytest.mark.parametrize("factor", [1e-6, 0.37, 12345.0])
def test_exposure_and_depth_follow_the_units(factor: float) -> None:
    plain, other = survey([frame()]), survey([scaled(frame(), factor, 1 / factor)])
    assert other.exposure * factor == pytest.approx(plain.exposure, rel=1e-5)
    assert other.depth * factor == pytest.approx(plain.depth, rel=1e-5)


def test_exposure_is_one_over_the_radiance_of_a_constant_frame_of_any_size() -> None:
    for shape in [(1, 1), (16, 16), (17, 40)]:
        assert exposure_of(np.full((*shape, 3), 4.0, np.float32)) == pytest.approx(0.25)


def test_a_black_frame_has_exposure_one_and_a_frame_without_hits_depth_one() -> None:
    block = frame()
    block.roles["radiance"][:] = 0
    block.coverage[:] = 0
    seen: Survey = survey([block])
    assert (seen.exposure, seen.depth) == (1.0, 1.0)


def test_a_frame_of_denormal_numbers_is_black_because_its_exposure_would_be_infinite() -> None:
    assert exposure_of(np.full((5, 5, 3), 1e-40, np.float32)) == 1.0
    assert np.isfinite(np.float32(exposure_of(np.full((5, 5, 3), 1e-29, np.float32))))


def test_depth_mixes_where_surfaces_or_the_sky_share_a_pixel() -> None:
    depth = np.array([2.0, 2.1, 2.0, 3.0, 2.0, 0.0, 0.0, 0.0], np.float32)[:, None]  # two samples a pixel
    coverage = np.array([1, 1, 1, 1, 1, 0, 0, 0], np.float32)
    roles = {"radiance": np.ones((8, 3), np.float32), "depth": depth}
    counts = np.full((1, 4), 2, np.int32)
    seen = survey([PathSamples(counts, np.full(8, 0.5, np.float32), coverage, roles, Window(0, 0, 3, 0))])
    assert seen.mixed == 0.5


def test_the_largest_of_a_role_is_followed_until_it_says_something() -> None:
    block = frame()
    block.roles["motion"] = np.full((block.total, 2), 0.01, np.float32)
    block.roles["motion"][-1, 1] = -0.03
    seen = survey([rows(block, 0, 20), rows(block, 20, 37)])
    assert seen.largest == {"roughness": np.inf, "motion": pytest.approx(0.03)}
    assert seen.hits == int((block.coverage > 0).sum())
