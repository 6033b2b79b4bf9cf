"""Bands: they cover every row once, start on the network's grid, hold their halo and keep to the budget."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st

from pipelines.tiles import memory_needed, plan_bands

SIZES = st.integers(1, 3000)


@given(height=SIZES, width=SIZES, per_pixel=st.floats(0, 64), reach=st.integers(0, 300),
       stride=st.sampled_from([1, 2, 16, 32]), memory=st.integers(1, 1 << 34))
def test_bands_cover_the_frame_with_their_halos(
    height: int, width: int, per_pixel: float, reach: int, stride: int, memory: int
) -> None:
    bands = plan_bands(height, width, per_pixel, reach, stride, memory)
    assert [row for band in bands for row in range(band.y0, band.y1)] == list(range(height))
    for band in bands:
        assert band.read0 % stride == 0
        assert band.y0 % stride == 0
        assert band.read0 <= max(band.y0 - reach, 0)
        assert band.read1 == min(band.y1 + reach, height)


@given(height=SIZES, width=SIZES, per_pixel=st.floats(0, 64))
def test_one_band_when_the_budget_allows_it(height: int, width: int, per_pixel: float) -> None:
    needed = memory_needed(height, width, per_pixel)
    assert len(plan_bands(height, width, per_pixel, 100, 32, needed)) == 1


def test_a_smaller_budget_gives_shorter_bands_within_it() -> None:
    whole = memory_needed(2000, 1920, 8)
    bands = plan_bands(2000, 1920, 8, 100, 32, whole // 2)
    assert 1 < len(bands) < 20
    assert max(memory_needed(band.read1 - band.read0, 1920, 8) for band in bands) <= whole // 2
