"""Bands: they cover every row once, start on the network's grid, hold their halo and keep to the budget."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from deep_io import Window
from model.denoiser import Denoiser
from pipelines.frame_context import strips
from pipelines.frame_reader import FrameReader
from pipelines.plan import fit
from pipelines.tiles import DEFAULT_MEMORY, Band, FrameLoad, default_memory, plan_bands, within_reach
from tests.end_to_end.scenes import noisy_scene, write_scene
from tests.model.random_models import SMALL

SIZES = st.integers(1, 3000)


def uniform(height: int, width: int, per_pixel: int, layers: int = 2) -> FrameLoad:
    return FrameLoad(width, np.full(height, width * per_pixel), layers)


@given(height=SIZES, width=SIZES, per_pixel=st.integers(0, 64), reach=st.integers(0, 300),
       stride=st.sampled_from([1, 2, 16, 32]), memory=st.integers(1, 1 << 34))
def test_bands_cover_the_frame_with_their_halos(
    height: int, width: int, per_pixel: int, reach: int, stride: int, memory: int
) -> None:
    bands = plan_bands(uniform(height, width, per_pixel), reach, None, stride, memory)
    assert [row for band in bands for row in range(band.y0, band.y1)] == list(range(height))
    for band in bands:
        assert band.read0 % stride == 0
        assert band.y0 % stride == 0
        assert band.read0 <= max(band.y0 - reach, 0)
        assert band.read1 == min(band.y1 + reach, height)


@given(height=SIZES, width=SIZES, per_pixel=st.integers(0, 64), layers=st.integers(1, 5))
def test_one_band_when_the_budget_allows_it(height: int, width: int, per_pixel: int, layers: int) -> None:
    load = uniform(height, width, per_pixel, layers)
    assert len(plan_bands(load, 100, 50, 32, load.needed(height))) == 1


@pytest.mark.parametrize("mirrored", [False, True])
def test_a_wider_network_needs_more_for_each_pixel_and_as_much_for_each_sample(mirrored: bool) -> None:
    def needed(channels: int, per_pixel: int) -> int:
        return FrameLoad(100, np.full(100, 100 * per_pixel), 2, mirrored=mirrored, channels=channels).needed(100)

    wider = needed(128, 8) - needed(64, 8)
    assert 100 * 100 * 64 * 4 < wider == needed(128, 2) - needed(64, 2)


def tallest(bands: list[Band]) -> int:
    return max(band.read1 - band.read0 for band in bands)


def test_a_smaller_budget_gives_shorter_bands_within_it() -> None:
    load = uniform(2000, 1920, 8)
    budget = load.needed(2000) // 2
    bands, shared = plan_bands(load, 100, None, 32, budget), plan_bands(load, 400, 100, 32, budget)
    assert 1 < len(bands) <= len(shared) < 20
    assert load.needed(tallest(bands)) <= budget
    assert load.needed_shared(tallest(shared)) <= budget


def test_bands_fit_where_samples_are_densest() -> None:
    samples = np.full(2000, 1920 * 4)
    samples[700:1200] = 1920 * 64
    load = FrameLoad(1920, samples, 2)
    assert load.most_samples(500) == 500 * 1920 * 64
    assert load.most_samples(3000) == samples.sum()
    budget = load.needed(2000) * 2 // 3
    bands = plan_bands(load, 100, None, 32, budget)
    for band in bands:
        held = FrameLoad(1920, samples[band.read0 : band.read1], 2)
        assert held.needed(held.height) <= budget
    assert len(bands) > len(plan_bands(uniform(2000, 1920, 4), 100, None, 32, budget))


def test_a_frame_is_kept_only_where_that_costs_no_band_and_fits(tmp_path: Path) -> None:
    write_scene(tmp_path / "in.exr", noisy_scene(1, Window(0, 0, 40, 700)))
    net = Denoiser(SMALL["fast"])
    with FrameReader(tmp_path / "in.exr") as reader:
        whole = fit(reader, net, 2, 1 << 40)
        assert (len(whole.bands), whole.keep) == (1, True)
        for budget in (whole.memory - 1, whole.memory - reader.kept_bytes, 1):
            room = fit(reader, net, 2, budget)
            assert len(room.bands) > 1
            assert not room.keep or room.memory <= budget


@given(height=SIZES, first=SIZES, last=SIZES, rows=SIZES, stride=st.sampled_from([1, 2, 16, 32]))
def test_strips_cover_what_is_looked_at_with_a_stride_around(
    height: int, first: int, last: int, rows: int, stride: int
) -> None:
    first = first % height // stride * stride
    last = first + 1 + last % (height - first)
    found = strips(first, last, height, rows, stride)
    assert [row for strip in found for row in range(strip.y0, strip.y1)] == list(range(first, last))
    for strip in found:
        assert strip.y0 % stride == strip.read0 % stride == 0
        assert strip.read0 == max(strip.y0 - stride, 0)
        assert strip.read1 >= min(strip.y1 + stride, height)
        assert strip.read1 - strip.read0 <= max(rows, 3 * stride)


@given(busy=st.lists(st.booleans(), min_size=1, max_size=200), reach=st.integers(0, 50),
       stride=st.sampled_from([1, 2, 16, 32]))
def test_all_that_busy_rows_see_is_within_reach(busy: list[bool], reach: int, stride: int) -> None:
    first, last = within_reach(np.array(busy), reach, stride)
    assert first % stride == 0
    seen = {row for k, one in enumerate(busy) if one for row in range(max(k - reach, 0), min(k + reach + 1, len(busy)))}
    assert seen <= set(range(first, last))
    assert bool(seen) == (last > first)


@pytest.mark.parametrize(
    ("groups", "limits", "expected"),
    [
        ("0::/", {}, DEFAULT_MEMORY),
        ("0::/", {"memory.max": "max\n"}, DEFAULT_MEMORY),
        ("0::/", {"memory.max": f"{6 << 30}\n"}, 3 << 30),
        ("0::/slice/job:1", {"slice/memory.max": f"{4 << 30}\n", "slice/job:1/memory.max": "max\n"}, 2 << 30),
        ("0::/slice/job:1", {"slice/memory.max": f"{4 << 30}\n", "slice/job:1/memory.max": f"{2 << 30}\n"}, 1 << 30),
        ("0::/slice/job:1", {"other/memory.max": f"{1 << 30}\n"}, DEFAULT_MEMORY),
        ("0::/not/in/this/container", {"memory.max": f"{2 << 30}\n"}, 1 << 30),
        ("3:cpu,cpuacct:/x\n2:memory:/job\n0::/", {"memory/job/memory.limit_in_bytes": f"{2 << 30}\n",
                                                    "memory/memory.limit_in_bytes": "9223372036854771712\n"}, 1 << 30),
        ("2:memory:/job", {"memory/job/memory.limit_in_bytes": "9223372036854771712\n"}, DEFAULT_MEMORY),
        ("3:cpu,cpuacct:/x\n2:memory:/job", {"memory/x/memory.limit_in_bytes": f"{2 << 30}\n"}, DEFAULT_MEMORY),
    ],
)
def test_the_budget_is_half_of_the_least_limit_of_the_control_groups_around_the_process(
    groups: str, limits: dict[str, str], expected: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("os.sysconf", {"SC_PAGE_SIZE": 1, "SC_PHYS_PAGES": 1 << 40}.__getitem__)
    for name, text in {"proc/self/cgroup": groups, **{f"sys/fs/cgroup/{key}": v for key, v in limits.items()}}.items():
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text(text)
    assert default_memory(tmp_path) == expected


def test_a_machine_without_control_groups_has_a_budget(tmp_path: Path) -> None:
    assert 0 < default_memory(tmp_path) <= DEFAULT_MEMORY
