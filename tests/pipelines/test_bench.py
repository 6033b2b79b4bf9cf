"""The parts of a bench: the clock, thinned scenes, the front, the means, the charts, the growth of cost."""

from __future__ import annotations

import re
import time
from collections.abc import Iterator
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import OpenEXR
import pytest
import torch

from deep_io import Window, read_deep
from deep_io.errors import InputError, LbmcError, UsageError
from model.config import LAYER, SAMPLE_SPLAT
from model.cost import count
from model.denoiser import Denoiser
from pipelines.bench.charts import Line, Mark, Style, bars, lines, number, scatter
from pipelines.bench.clock import Clock
from pipelines.bench.growth import growth
from pipelines.bench.memory import measurable, peak_memory
from pipelines.bench.methods import MethodSpec, make, method_specs
from pipelines.bench.report import Gallery
from pipelines.bench.results import Measurement, Results, SceneInfo, pareto
from pipelines.bench.scenes import enlarge, find_scenes, thin, without_reference, write_enlarged, write_thinned
from pipelines.bench.tables import memory_frames, methods_table
from tests.deep_io.deep_files import openexr_part, write_openexr
from tests.end_to_end.bench_scenes import WINDOW, write_pair
from tests.end_to_end.scenes import noisy_scene
from tests.model.random_models import SMALL

STYLE = Style("#123456")


def wait(seconds: float) -> None:
    """Keeps the processor busy, so that CPU seconds pass too."""
    end = time.process_time() + seconds
    while time.process_time() < end:
        pass


def test_nested_stages_exclude_each_other_and_add_up() -> None:
    clock = Clock()
    before = time.process_time()
    with clock.stage("outer"):
        wait(0.02)
        with clock.stage("inner"):
            wait(0.05)
        wait(0.01)
    spent = time.process_time() - before
    times = clock.take()
    assert times.cpu["outer"] >= 0.03
    assert times.cpu["inner"] >= 0.05
    assert times.cpu["outer"] + times.cpu["inner"] == pytest.approx(spent, abs=0.01)
    assert times.wall["inner"] >= 0.05
    assert clock.take().cpu == {}


def test_a_stage_that_fails_is_closed() -> None:
    clock = Clock()
    with pytest.raises(KeyError), clock.stage("outer"), clock.stage("inner"):
        raise KeyError
    with clock.stage("later"):
        wait(0.01)
    assert clock.take().cpu["later"] >= 0.01


class Worker:
    def work(self, seconds: float) -> str:
        wait(seconds)
        return "done"

    def items(self) -> Iterator[int]:
        for item in range(3):
            wait(0.01)
            yield item


def test_watched_methods_return_what_they_did_and_are_timed() -> None:
    clock, worker, seen = Clock(), Worker(), []
    clock.watch(worker, "work", "work", seen.append)
    clock.watch(worker, "items", "items")
    with clock.stage("rest"):
        assert worker.work(0.02) == "done"
        for _ in worker.items():
            wait(0.02)
    times = clock.take()
    assert seen == ["done"]
    assert times.cpu["work"] >= 0.02
    assert times.cpu["items"] >= 0.03
    assert times.cpu["rest"] >= 0.06  # the loop's body is not the generator's


def test_thinned_samples_are_nested_and_pixels_with_fewer_keep_theirs() -> None:
    scene = noisy_scene(3, most=6)
    values = {**scene.channels, "number": np.arange(scene.total, dtype=np.uint32)}
    scene.channels = values
    thinned = {most: thin(scene, most) for most in (1, 2, 4, 8)}
    for most, found in thinned.items():
        np.testing.assert_array_equal(found.counts, np.minimum(scene.counts, most))
        chosen = found.channels["number"].astype(int)
        assert (np.diff(chosen) > 0).all()  # stored order, nothing twice
        np.testing.assert_array_equal(scene.pixel_index[chosen], found.pixel_index)
    for few, many in ((1, 2), (2, 4), (4, 8)):
        assert set(thinned[few].channels["number"]) <= set(thinned[many].channels["number"])
    first = thinned[1].channels["number"] - scene.offsets[:-1]
    assert 0.5 < first.mean() < 2.5  # not always a pixel's first sample
    np.testing.assert_array_equal(thin(scene, 2).channels["number"], thinned[2].channels["number"])


def test_a_thinned_file_is_the_scene_with_fewer_samples(tmp_path: Path) -> None:
    write_pair(tmp_path, "scene", 1, samples=8)
    (scene,) = find_scenes(tmp_path)
    assert scene.thinned_counts() == [1, 2, 4]
    write_thinned(scene, 2, tmp_path / "two.exr")
    samples, header = read_deep(tmp_path / "two.exr")
    assert (samples.counts == 2).all()
    assert header.data_window == read_deep(scene.source)[1].data_window


def test_tiles_in_random_order_are_thinned_and_enlarged(tmp_path: Path) -> None:
    samples = write_pair(tmp_path, "scene", 1)
    write_openexr(tmp_path / "scene.deep.exr", openexr_part(samples, tile=(16, 8), lineOrder=OpenEXR.RANDOM_Y))
    (scene,) = find_scenes(tmp_path)
    write_thinned(scene, 2, tmp_path / "two.exr")
    assert (read_deep(tmp_path / "two.exr")[0].counts == 2).all()
    assert write_enlarged(scene, 40, tmp_path / "large.exr") == 0.0016
    assert read_deep(tmp_path / "large.exr")[1].data_window == Window(0, 0, 39, 39)


def test_an_enlarged_scene_is_its_mirror_images() -> None:
    scene = noisy_scene(2, WINDOW)
    scene.channels = {"number": np.arange(scene.total, dtype=np.uint32)}
    large = enlarge(scene, 70)
    assert large.counts.shape == (70, 70)
    height, width = scene.counts.shape
    for y, x, old_y, old_x in ((0, 0, 0, 0), (height, 3, height - 1, 3), (5, width + 2, 5, width - 3),
                               (2 * height, 2 * width, 0, 0), (69, 69, 69 - 2 * height, 69 - 2 * width)):
        new, old = y * 70 + x, old_y * width + old_x
        np.testing.assert_array_equal(
            large.channels["number"][large.offsets[new] : large.offsets[new + 1]],
            np.arange(scene.offsets[old], scene.offsets[old + 1]))
    assert enlarge(scene, 8).counts.shape == (height, width)
    middle = enlarge(scene, 8, exact=True)
    assert middle.counts.shape == (8, 8)
    old = (height - 8) // 2 * width + (width - 8) // 2
    np.testing.assert_array_equal(
        middle.channels["number"][: middle.counts[0, 0]], np.arange(scene.offsets[old], scene.offsets[old + 1]))


def test_scenes_are_chosen_by_name(tmp_path: Path) -> None:
    for name in ("indoor-a", "outdoor-b"):
        write_pair(tmp_path, name, 1)
    assert [scene.name for scene in find_scenes(tmp_path, "out*")] == ["outdoor-b"]
    (tmp_path / "outdoor-b.ref.exr").rename(tmp_path / "outdoor-c.ref.exr")
    assert without_reference(tmp_path) == ["outdoor-b.deep.exr"]
    assert without_reference(tmp_path, "in*") == []
    with pytest.raises(InputError, match=r"no name in common .* 'none\*'"):
        find_scenes(tmp_path, "none*")


def test_the_front_holds_what_nothing_beats() -> None:
    points = {"slow, good": (9.0, 0.1), "fast, bad": (1.0, 0.9), "beaten": (3.0, 0.95), "middle": (4.0, 0.5),
              "as good, slower": (5.0, 0.5)}
    assert pareto(points) == ["fast, bad", "middle", "slow, good"]


def test_the_front_holds_nothing_that_is_hardly_better_than_what_is_faster() -> None:
    points = {"fast": (1.0, 0.5), "1 % better": (2.0, 0.495), "2.5 % better": (3.0, 0.4875), "perfect": (9.0, 0.0),
              "also": (10.0, 0.0)}
    assert pareto(points) == ["fast", "perfect"]  # the third is 1.5 % better than the second, which is faster
    del points["1 % better"]
    assert pareto(points) == ["fast", "2.5 % better", "perfect"]


def scored(count: int) -> Results:
    """A method on so many scenes, with relMSEs of 0.01, 0.02, ..."""
    scenes = [SceneInfo(f"s{n}", 10, 10, 8) for n in range(count)]
    rows = [Measurement(scene.name, "m", {"relmse": 0.01 * n, "smape": 0.1}, {"filter": 1.0}, {"filter": 1.0}, 1.0)
            for n, scene in enumerate(scenes, 1)]
    return Results({}, {}, [MethodSpec("m", "classical", "blur")], scenes, rows)


def test_few_scenes_have_a_range_and_no_interval() -> None:
    one, few, many = (methods_table(scored(count), 8) for count in (1, 4, 5))
    assert (few.head[2], many.head[2]) == ("range", "interval")
    assert few.rows[0][2] == "0.0100 to 0.0400"
    low, high = (float(word) for word in many.rows[0][2].split(" to "))
    assert 0.01 < low < 0.026 < high < 0.05  # around the geometric mean, within the range
    assert one.rows[0][2] == "–"
    assert "bootstrap" not in one.note + few.note
    assert "95 % bootstrap interval" in many.note


def test_the_table_says_who_gets_a_star() -> None:
    table = methods_table(scored(2), 8)
    assert table.rows[0][0] == "m ★"
    assert "at least 2 % below that of every faster method" in table.note


def test_means_are_per_megapixel_and_geometric_for_relmse() -> None:
    scenes = [SceneInfo("a", 1000, 1000, 8), SceneInfo("b", 1000, 3000, 8), SceneInfo("c", 10, 10, 32)]
    spec = MethodSpec("m", "classical", "blur")
    rows = [Measurement(name, "m", {"relmse": error, "smape": error}, {"read": 1.0, "filter": 2.0}, {"filter": 4.0},
                        size) for name, error, size in (("a", 0.01, 1.0), ("b", 0.04, 3.0), ("c", 1.0, 1e-4))]
    results = Results({}, {}, [spec], scenes, rows)
    assert results.groups() == [8, 32]
    found = results.summary(8)["m"]
    assert found.scores["relmse"] == pytest.approx(0.02)
    assert found.scores["smape"] == pytest.approx(0.025)
    assert found.cpu == {"read": pytest.approx(0.5), "filter": pytest.approx(1.0)}
    assert found.own_cpu == pytest.approx(1.0)
    assert found.own_wall == pytest.approx(2.0)


def test_memory_says_on_which_frames_it_was_measured() -> None:
    protocol = {"example": "a", "frame": 512, "untrained_frame": 256}
    results = Results({}, protocol, [MethodSpec("m", "classical", "blur")], [SceneInfo("a", 1000, 100, 8)])
    assert memory_frames(results) == "a, 1000 x 512"
    results.methods.append(MethodSpec("LAYER", "paper", "untrained", "LAYER"))
    assert memory_frames(results) == "a, 1000 x 512, of untrained networks on 256 x 256"


@pytest.mark.parametrize(("value", "text"), [(0.0, "0"), (0.01234, "0.0123"), (12.0, "12"), (19612.3, "19,612"),
                                             (1.5e6, "1.5 M"), (3e-6, "3e-06"), (float("nan"), "–")])
def test_numbers_are_short(value: float, text: str) -> None:
    assert number(value) == text


def test_charts_are_well_formed_and_show_what_they_are_given() -> None:
    marks = [Mark("a <b>", STYLE, 1.0, 0.1, "first"), Mark("c", STYLE, 10.0, 0.01, "second"),
             Mark("no error", STYLE, 5.0, None, "third")]
    drawn = scatter(marks, ["a <b>", "c"], "seconds", "relMSE")
    curves = lines([Line("up & down", STYLE, [(1.0, 2.0), (2.0, 1.0)]), Line("none", STYLE, [])], "samples", "error")
    stacked = bars([("one", {"read": 1.0, "write": 2.0}), ("two", {})], {"read": "#111", "write": "#222"},
                   {"read": "read", "write": "write"}, "s")
    for svg in (drawn, curves, stacked):
        ElementTree.fromstring(svg)
    assert drawn.count('class="mark"') == 3
    assert drawn.count('class="front"') == 1
    assert "a &lt;b&gt;" in drawn
    assert "up &amp; down" in curves
    assert "none" not in curves
    first, second = (float(width) for width in re.findall(r'width="([\d.]+)" height="18"', stacked))
    assert second == pytest.approx(2 * first, rel=0.01)


def test_points_of_a_scatter_stand_where_their_values_are() -> None:
    svg = scatter([Mark("left", STYLE, 1.0, 1.0, ""), Mark("right", STYLE, 100.0, 0.01, "")], [], "x", "y")
    places = re.findall(r'cx="([\d.]+)" cy="([\d.]+)"', svg)
    (left_x, top_y), (right_x, bottom_y) = (map(float, place) for place in places)
    assert left_x < right_x
    assert top_y < bottom_y


def test_cost_grows_far_slower_for_layers_than_for_samples() -> None:
    points = {(p.network, p.samples): p for p in growth(
        {"LAYER": LAYER, "SAMPLESPLAT": SAMPLE_SPLAT}, {"LAYER": Denoiser(SMALL["layer"]).eval()}, [4, 64], 16, 1)}
    for name, config in (("LAYER", LAYER), ("SAMPLESPLAT", SAMPLE_SPLAT)):
        expected = sum(count(config).multiply_adds(64, config.layers).values())
        assert points[name, 64].multiply_adds == expected
    assert points["LAYER", 4].cpu is not None
    assert points["SAMPLESPLAT", 4].cpu is None


def test_methods_are_named_once_and_models_that_are_not_there_refused(tmp_path: Path) -> None:
    names = [spec.name for spec in method_specs(("a/x.safetensors", "y"), True, True)]
    assert len(set(names)) == len(names)
    assert {"lbmc x", "lbmc y", "LAYER_w (untrained)", "OIDN prefiltered"} <= set(names)
    with pytest.raises(UsageError, match="no such weight file"):
        make(MethodSpec("m", "lbmc", "lbmc", str(tmp_path / "none.safetensors")), 1, tmp_path)


@pytest.mark.skipif(not measurable(), reason="this system does not tell what a process holds")
def test_memory_is_that_of_the_method_alone(tmp_path: Path) -> None:
    write_pair(tmp_path, "scene", 1)
    held = torch.ones(64 << 20)  # 256 MB of ours, which the new process must not be charged for
    spec = MethodSpec("noisy", "input", "mean")
    assert 0 < peak_memory(spec, tmp_path / "scene.deep.exr", 1, tmp_path) < held.nbytes
    with pytest.raises(LbmcError, match=r"^failed in a process of its own: .*missing\.exr: cannot be opened"):
        peak_memory(spec, tmp_path / "missing.exr", 1, tmp_path)


def test_large_images_are_cut_to_their_middle() -> None:
    gallery = Gallery()
    picture = np.full((10, 1500, 3), 0.5)
    gallery.add("scene", "reference", picture, picture)
    assert gallery.sizes["scene"] == (1024, 10)
    assert gallery.cropped
