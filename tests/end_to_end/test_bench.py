"""`lbmc bench` on two tiny scenes: the three files, what they say, and what is refused."""

from __future__ import annotations

import html
import json
import re
import shutil
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from deep_io import Window
from model.metrics import score
from model.weight_files import MIRRORED, presets
from pipelines.bench.methods import oidn_installed
from pipelines.bench.results import Results
from pipelines.flat_pictures import read_rgb
from tests.end_to_end.bench_scenes import write_pair, write_reference
from tests.end_to_end.scenes import random_weights
from tests.runner import Finished, Runner, in_process

QUICK = ("--no-paper", "--no-memory", "--no-savings", "--no-curves", "--no-flip", "--repeats", 1, "--frame", 0,
         "--progress", "none")


UNPAIRED = "Left out, without a NAME.ref.exr beside NAME.deep.exr: alone.deep.exr."


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two scenes, and files that are no scenes."""
    folder = tmp_path_factory.mktemp("scenes")
    write_pair(folder, "first", 1)
    write_pair(folder, "second", 2)
    shutil.copy(folder / "first.deep.exr", folder / "alone.deep.exr")
    return folder


@pytest.fixture(scope="module")
def weights(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return random_weights(tmp_path_factory.mktemp("weights") / "tiny.safetensors")


@pytest.fixture(scope="module")
def report(folder: Path, weights: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A bench with everything but the paper's networks, whose time is long."""
    out = tmp_path_factory.mktemp("bench") / "out"
    run = in_process("bench", folder, "--out", out, "--model", weights, "--repeats", 2, "--frame", 0,
                     "--no-paper", "--progress", "plain")
    assert run.code == 0, run.err
    assert "Progress: 100%" in run.err
    assert UNPAIRED in run.err
    assert run.out.startswith("# Speed against error")
    return out


@pytest.fixture(scope="module")
def results(report: Path) -> dict[str, Any]:
    loaded: dict[str, Any] = json.loads((report / "results.json").read_text("utf-8"))
    return loaded


def test_every_method_is_measured_on_every_scene(results: dict[str, Any]) -> None:
    names = {method["name"] for method in results["methods"]}
    wanted = {"noisy", "clamp and blur", "à-trous wavelets", "lbmc tiny"}
    if oidn_installed():
        wanted |= {"OIDN colour", "OIDN + albedo, normal", "OIDN prefiltered"}
    assert names == wanted
    assert [scene["name"] for scene in results["scenes"]] == ["first", "second"]
    assert {(row["scene"], row["method"]) for row in results["measurements"]} == {
        (scene, name) for scene in ("first", "second") for name in names}


def test_errors_are_those_of_the_command_and_the_metrics(
    results: dict[str, Any], folder: Path, weights: Path, tmp_path: Path
) -> None:
    assert in_process("denoise", folder / "first.deep.exr", tmp_path / "out.exr", "--model", weights,
                      "--threads", 1, "--device", "cpu").code == 0
    expected = score(read_rgb(tmp_path / "out.exr").rgb, read_rgb(folder / "first.ref.exr").rgb)
    (found,) = (row for row in results["measurements"] if (row["scene"], row["method"]) == ("first", "lbmc tiny"))
    for name in ("relmse", "smape", "psnr", "ssim", "flip", "energy"):
        assert found["scores"][name] == pytest.approx(getattr(expected, name), rel=1e-6), name


def test_time_is_split_into_stages(results: dict[str, Any]) -> None:
    stages = {row["method"]: set(row["cpu"]) for row in results["measurements"]}
    assert stages["à-trous wavelets"] == {"read", "flatten", "filter", "write"}
    network = {"read", "survey", "reducer", "unet", "partitioner", "generator", "filter", "write"}
    assert stages["lbmc tiny"] == network
    for row in results["measurements"]:
        assert set(row["cpu"]) == set(row["wall"])
        assert all(seconds >= 0.0 for seconds in (*row["cpu"].values(), *row["wall"].values()))
        assert row["wall"]["read"] > 0.0


def test_times_can_be_of_a_larger_frame(folder: Path, weights: Path, tmp_path: Path) -> None:
    words = [48 if word == 0 else word for word in QUICK]
    run = in_process("bench", folder, "--out", tmp_path, "--model", weights, *words)
    assert run.code == 0, run.err
    assert "repeated in mirror image to 48 x 48" in run.out
    rows = json.loads((tmp_path / "results.json").read_text("utf-8"))["measurements"]
    assert all(row["scores"] for row in rows)
    timed = {(row["scene"], row["megapixels"]) for row in rows if row["cpu"]}
    assert timed == {("first", 48 * 48 / 1e6)}


def test_machine_and_protocol_are_stated(results: dict[str, Any], report: Path) -> None:
    machine, table = results["machine"], (report / "results.md").read_text("utf-8")
    assert machine["threads"] == 1
    for name in ("processor", "torch", "numpy", "OpenEXR", "lbmc", "python"):
        assert machine[name]
        assert str(machine[name]) in table
    assert results["protocol"]["repeats"] == 2
    assert "medians" in table
    assert f"- {UNPAIRED}" in table
    assert results["protocol"]["without_reference"] == ["alone.deep.exr"]
    assert results["failed"] == {}


def test_fewer_samples_are_measured_too(results: dict[str, Any]) -> None:
    assert {(point["scene"], point["samples"]) for point in results["curve"]} == {
        (scene, samples) for scene in ("first", "second") for samples in (1, 2)}
    noisy = {point["samples"]: point["relmse"] for point in results["curve"]
             if (point["scene"], point["method"]) == ("first", "noisy")}
    assert noisy[1] > noisy[2]


def test_growth_counts_the_papers_networks_and_ours(results: dict[str, Any]) -> None:
    products = {(p["network"], p["samples"]): p["multiply_adds"] for p in results["growth"]}
    assert {samples for _, samples in products} == {4, 8, 16, 32, 64}
    growth = {name: products[name, 64] / products[name, 4] for name in ("LAYER", "SAMPLESPLAT")}
    assert growth["LAYER"] < 1.5 < 4.0 < growth["SAMPLESPLAT"]
    assert {p["network"] for p in results["growth"] if p["cpu"] is not None} == {"lbmc tiny"}


def test_memory_is_measured(results: dict[str, Any], report: Path) -> None:
    if Path("/proc/self/status").is_file():
        assert set(results["memory"]) == {method["name"] for method in results["methods"]}
        assert all(0 < peak < 4 << 30 for peak in results["memory"].values())
        assert results["memory"]["noisy"] < results["memory"]["lbmc tiny"]
        for name in ("results.md", "report.html"):
            assert "eak memory on first, 32 x 24" in (report / name).read_text("utf-8")


def test_the_page_asks_for_nothing_from_outside(report: Path) -> None:
    page = (report / "report.html").read_text("utf-8")
    assert "default-src 'none'" in page
    sources = re.findall(r"""(?:src|href|url)\s*[=(:]\s*["']?([^"'\s>)]{5})""", page)
    assert not [source for source in sources if source.startswith(("http", "//", "file:"))]
    assert not re.search(r"https?://(?!www\.w3\.org)", page)
    assert page.count("<svg") >= 5
    assert "Pareto front" in page


def test_results_survive_json(results: dict[str, Any]) -> None:
    assert json.loads(json.dumps(Results.from_dict(results).to_dict())) == results
    with pytest.raises(ValueError, match="format 0"):
        Results.from_dict({**results, "format": 0})


def test_an_unscored_network_has_a_time_and_no_error(
    folder: Path, tmp_path: Path, weights: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The paper's networks, on a frame of their own, which is smaller even than the scene."""
    monkeypatch.setattr("pipelines.bench.protocol.UNTRAINED_FRAME", 16)
    words = [40 if word == 0 else word for word in QUICK if word != "--no-paper"]
    run = in_process("bench", folder, "--match", "first", "--out", tmp_path, "--model", weights, *words)
    assert run.code == 0, run.err
    found = json.loads((tmp_path / "results.json").read_text("utf-8"))
    rows = {row["method"]: row for row in found["measurements"]}
    for name in ("PIXELGATHER", "SAMPLESPLAT", "LAYER", "LAYER_w", "OPTIMIZED"):
        assert rows[f"{name} (untrained)"]["scores"] is None
        assert rows[f"{name} (untrained)"]["cpu"]["unet"] > 0.0
        assert rows[f"{name} (untrained)"]["megapixels"] == 16 * 16 / 1e6
    assert rows["lbmc tiny"]["megapixels"] == 40 * 40 / 1e6
    assert "on 16 x 16 pixels of it" in run.out
    assert {p["network"] for p in found["growth"] if p["cpu"]} == {"LAYER", "SAMPLESPLAT", "lbmc tiny"}
    assert re.search(r"\| LAYER \(untrained\) \| – \|", run.out)


def test_every_preset_that_ships_is_a_method_unless_models_are_named(folder: Path, tmp_path: Path) -> None:
    words = [word for word in QUICK if word != "--no-savings"]
    run = in_process("bench", folder, "--match", "first", "--out", tmp_path, *words)
    assert run.code == 0, run.err
    found = json.loads((tmp_path / "results.json").read_text("utf-8"))
    ours = [method["name"] for method in found["methods"] if method["family"] == "lbmc"]
    assert ours[0] == "lbmc fast"
    assert sorted(ours) == [f"lbmc {name}" for name in presets()]
    scores = {row["method"]: row["scores"] for row in found["measurements"]}
    for name in presets():
        out = tmp_path / f"{name}.exr"
        assert in_process("denoise", folder / "first.deep.exr", out, "--model", name, "--threads", 1, "--device",
                          "cpu").code == 0
        expected = score(read_rgb(out).rgb, read_rgb(folder / "first.ref.exr").rgb, with_flip=False)
        assert scores[f"lbmc {name}"]["relmse"] == pytest.approx(expected.relmse, rel=1e-6), name
    averaged = [f"lbmc {name}" for name in MIRRORED]
    assert found["protocol"]["averaged"] == averaged
    assert {point["model"] for point in found["savings"]} == {*ours} - {*averaged}  # those of one run
    assert f"{', '.join(averaged)}: the mean of several runs" in run.out
    assert all(f"| {name}" in run.out for name in ours)


def test_results_that_exist_are_kept(report: Path, folder: Path) -> None:
    before = (report / "results.json").read_bytes()
    run = in_process("bench", folder, "--out", report, *QUICK)
    assert run.code == 2
    assert "--overwrite" in run.err
    assert "--skip-existing" not in run.err  # bench has no such option
    assert (report / "results.json").read_bytes() == before


def test_without_oidn_the_report_says_how_to_get_it(
    folder: Path, weights: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("pipelines.bench.protocol.oidn_installed", lambda: False)
    run = in_process("bench", folder, "--match", "first", "--out", tmp_path, "--model", weights, *QUICK)
    assert run.code == 0, run.err
    assert "| OIDN" not in run.out
    for name in ("results.md", "report.html"):
        text = (tmp_path / name).read_text("utf-8").replace("&#x27;", "'")
        assert "install lbmc with its extra 'bench'" in text


def assert_one_line(run: Finished, *words: str) -> None:
    assert run.code == 3
    assert run.out == ""
    assert run.err.startswith("ERROR: ")
    assert run.err.count("\n") == 1
    for word in words:
        assert word in run.err


def test_a_folder_without_pairs_is_refused(lbmc: Runner, folder: Path, tmp_path: Path) -> None:
    shutil.copy(folder / "first.deep.exr", tmp_path / "one.deep.exr")
    shutil.copy(folder / "first.ref.exr", tmp_path / "other.ref.exr")
    assert_one_line(lbmc("bench", tmp_path, "--out", tmp_path / "out"), str(tmp_path), "no name in common")
    assert not (tmp_path / "out").exists()


def truncate(path: Path) -> None:
    """Is seen when the file is opened."""
    path.write_bytes(path.read_bytes()[:-100])


def corrupt(path: Path) -> None:
    """Is seen only when the last rows are decompressed."""
    path.write_bytes(path.read_bytes()[:-200] + bytes(200))


@pytest.mark.parametrize("size", [0, 40])  # of the frames that are timed: the broken scene's own would be the first
def test_scenes_that_cannot_be_read_are_left_out_and_the_others_measured(
    lbmc: Runner, folder: Path, weights: Path, tmp_path: Path, size: int
) -> None:
    scenes, out = tmp_path / "scenes", tmp_path / "out"
    shutil.copytree(folder, scenes)
    for kind in ("deep", "ref"):
        shutil.copy(scenes / f"second.{kind}.exr", scenes / f"third.{kind}.exr")
    corrupt(scenes / "first.deep.exr")
    truncate(scenes / "third.deep.exr")
    words = [size if word == 0 else "plain" if word == "none" else word for word in QUICK if word != "--no-curves"]
    run = lbmc("bench", scenes, "--out", out, "--model", weights, *words)
    assert run.code == 1
    lines = run.err.splitlines()
    first, third = ([line for line in lines if line.startswith(f"ERROR: {scenes / name}.deep.exr: row 23: ")]
                    for name in ("first", "third"))
    assert len(first) == len(third) == 1
    told = [lines.index(line) for line in (*third, *first, "Progress: 100%", "failed:")]
    assert told == sorted(told)
    assert lines[-2:] == [line.replace("ERROR:", f"  {name}:") for line, name in ((third[0], "third"),
                                                                                 (first[0], "first"))]
    found = json.loads((out / "results.json").read_text("utf-8"))
    assert [scene["name"] for scene in found["scenes"]] == ["second"]
    assert {row["scene"] for row in found["measurements"]} == {row["scene"] for row in found["curve"]} == {"second"}
    assert all(row["scores"] and row["cpu"] for row in found["measurements"])
    assert set(found["failed"]) == {"third", "first"}
    line = f"Left out, since they cannot be read: {found['failed']['third']}; {found['failed']['first']}."
    for name in ("results.md", "report.html"):
        assert line in html.unescape((out / name).read_text("utf-8"))


@pytest.mark.parametrize("harm", [truncate, corrupt])
def test_of_scenes_that_all_cannot_be_read_nothing_is_written(
    harm: Callable[[Path], None], folder: Path, weights: Path, tmp_path: Path
) -> None:
    scenes, out = tmp_path / "scenes", tmp_path / "out"
    shutil.copytree(folder, scenes)
    for name in ("first", "second"):
        harm(scenes / f"{name}.deep.exr")
    run = in_process("bench", scenes, "--out", out, "--model", weights, *QUICK)
    assert run.code == 3
    for name in ("first", "second"):
        assert run.err.count(f"{name}.deep.exr: row 23: ") == 1
    assert harm is truncate or run.err.endswith(f"ERROR: {scenes}: no scene is left to measure\n")
    assert not out.exists() or not list(out.iterdir())


def test_a_file_in_place_of_the_folder_is_refused_with_the_cure(folder: Path, weights: Path, tmp_path: Path) -> None:
    run = in_process("bench", folder, "--match", "first", "--out", weights, "--model", weights, *QUICK)
    assert run.code == 3
    assert "tiny.safetensors: cannot be made a folder" in run.err
    assert "name another --out" in run.err


def test_a_folder_that_is_not_there_is_refused(tmp_path: Path) -> None:
    assert_one_line(in_process("bench", tmp_path / "none"), "none: no such folder")


def test_sizes_that_differ_are_both_said(tmp_path: Path) -> None:
    write_pair(tmp_path, "scene", 1)
    write_reference(tmp_path / "scene.ref.exr", np.ones((8, 9, 3)), Window(0, 0, 8, 7))
    assert_one_line(in_process("bench", tmp_path), "scene.deep.exr is 32 x 24", "scene.ref.exr is 9 x 8")


@pytest.mark.parametrize(("value", "words"), [(0.0, "no light"), (np.nan, "not finite")])
def test_references_that_nothing_can_be_measured_on_are_refused(tmp_path: Path, value: float, words: str) -> None:
    write_pair(tmp_path, "scene", 1)
    write_reference(tmp_path / "scene.ref.exr", np.full((24, 32, 3), value))
    assert_one_line(in_process("bench", tmp_path), "scene.ref.exr", words)


def test_a_model_that_is_not_there_leaves_no_folder_behind(folder: Path, tmp_path: Path) -> None:
    run = in_process("bench", folder, "--out", tmp_path / "out", "--model", "none", *QUICK)
    assert run.code == 2
    assert "none" in run.err
    assert not (tmp_path / "out").exists()


def test_two_models_of_one_name_are_refused(folder: Path, weights: Path, tmp_path: Path) -> None:
    shutil.copy(weights, tmp_path / weights.name)
    run = in_process("bench", folder, "--out", tmp_path / "out", "--model", weights, "--model",
                     tmp_path / weights.name)
    assert_one_line(run, "tiny.safetensors", "rename")


def test_without_pillow_nothing_is_made(
    folder: Path, weights: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "PIL", None)
    run = in_process("bench", folder, "--out", tmp_path / "out", "--model", weights, *QUICK)
    assert run.code == 2
    assert "need Pillow: install lbmc with its extra 'bench'" in run.err
    assert not list(tmp_path.iterdir())
