"""`lbmc bench` where references come as two independent halves: NAME.ref.exr and NAME.ref2.exr."""

from __future__ import annotations

import html
import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from deep_io import Window
from pipelines.bench.results import Results
from pipelines.bench.scenes import find_scenes
from pipelines.flat_pictures import read_rgb
from tests.end_to_end.bench_scenes import WINDOW, write_halves, write_pair, write_reference
from tests.end_to_end.scenes import random_weights
from tests.runner import in_process

QUICK = ("--no-paper", "--no-memory", "--no-savings", "--no-curves", "--no-flip", "--repeats", 1, "--frame", 0,
         "--progress", "none")


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two scenes with halves, and one with a whole reference."""
    folder = tmp_path_factory.mktemp("scenes")
    for seed, name in enumerate(("first", "second")):
        write_halves(folder, name, seed)
    write_pair(folder, "whole", 3)
    return folder


@pytest.fixture(scope="module")
def weights(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return random_weights(tmp_path_factory.mktemp("weights") / "tiny.safetensors")


@pytest.fixture(scope="module")
def report(folder: Path, weights: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("bench")
    run = in_process("bench", folder, "--out", out, "--model", weights, *QUICK)
    assert run.code == 0, run.err
    return out


@pytest.fixture(scope="module")
def results(report: Path) -> dict[str, Any]:
    loaded: dict[str, Any] = json.loads((report / "results.json").read_text("utf-8"))
    return loaded


def test_errors_are_those_that_compare_gives_for_two_halves(
    results: dict[str, Any], folder: Path, weights: Path, tmp_path: Path
) -> None:
    assert in_process("denoise", folder / "first.deep.exr", tmp_path / "out.exr", "--model", weights, "--threads", 1,
                      "--device", "cpu").code == 0
    run = in_process("compare", tmp_path / "out.exr", folder / "first.ref.exr", "--other-half",
                     folder / "first.ref2.exr", "--no-flip", "--json")
    (expected,) = json.loads(run.out)["images"]
    rows = {(row["scene"], row["method"]): row["scores"] for row in results["measurements"]}
    found = rows["first", "lbmc tiny"]
    for name in ("relmse", "relmse_unbiased", "floor", "smape", "psnr", "energy"):
        assert found[name] == pytest.approx(expected[name], rel=1e-6), name
    assert 0.0 < found["relmse_unbiased"] < found["relmse"]
    assert rows["whole", "lbmc tiny"]["relmse_unbiased"] is None
    floors = {scene["name"]: scene["floor"] for scene in results["scenes"]}
    assert floors["first"] == pytest.approx(expected["floor"], rel=1e-6)
    assert floors["whole"] is None


def test_means_are_of_the_scenes_with_halves_alone(results: dict[str, Any]) -> None:
    (found,) = results["unbiased"].values()
    assert found["scenes"] == ["first", "second"]
    assert found["floor"] == pytest.approx(np.mean([scene["floor"] for scene in results["scenes"][:2]]))
    rows = [row["scores"] for row in results["measurements"]
            if row["method"] == "noisy" and row["scores"]["floor"] is not None]
    assert found["methods"]["noisy"] == pytest.approx(
        [np.mean([row[key] for row in rows]) for key in ("relmse", "relmse_unbiased")])
    assert json.loads(json.dumps(Results.from_dict(results).to_dict())) == results


def test_table_and_page_have_each_scene_the_floor_and_the_means(results: dict[str, Any], report: Path) -> None:
    (means,) = results["unbiased"].values()
    pair = "{:.4f} / {:.4f}".format(*means["methods"]["lbmc tiny"])
    table = (report / "results.md").read_text("utf-8")
    section = table[table.index("## relMSE free of the reference's noise") :].split("\n\n")[1]
    lines = [line.strip("| ").split(" | ") for line in section.splitlines()[2:]]
    rows = {name: cells for name, *cells in lines}
    assert list(rows) == ["first", "second", "mean"]
    assert rows["mean"][0] == f"{means['floor']:.4f}"
    assert pair in rows["mean"]
    assert "Of 2 of 3 scenes the reference is the mean of two independent halves" in table
    page = html.unescape((report / "report.html").read_text("utf-8"))
    for words in (pair, f"{means['floor']:.4f}", "relMSE free of the reference's noise"):
        assert words in page


def test_without_halves_nothing_is_said_of_them(folder: Path, weights: Path, tmp_path: Path) -> None:
    run = in_process("bench", folder, "--match", "whole", "--out", tmp_path, "--model", weights, *QUICK)
    assert run.code == 0, run.err
    assert "halves" not in run.out
    assert "reference's noise" not in (tmp_path / "report.html").read_text("utf-8").replace("&#x27;", "'")
    assert json.loads((tmp_path / "results.json").read_text("utf-8"))["unbiased"] == {}


def test_the_reference_is_the_mean_of_both_halves(folder: Path) -> None:
    first = find_scenes(folder)[0]
    halves = [read_rgb(folder / f"first.{kind}.exr").rgb for kind in ("ref", "ref2")]
    np.testing.assert_allclose(first.reference.rgb, np.mean(halves, axis=0), rtol=1e-6)


def other_size(folder: Path) -> None:
    write_reference(folder / "first.ref2.exr", np.ones((8, 9, 3)), Window(0, 0, 8, 7))


def moved(folder: Path) -> None:
    rgb = read_rgb(folder / "first.ref2.exr").rgb
    write_reference(folder / "first.ref2.exr", rgb, Window(1, 0, WINDOW.xmax + 1, WINDOW.ymax))


def same(folder: Path) -> None:
    shutil.copy(folder / "first.ref.exr", folder / "first.ref2.exr")


def broken(folder: Path) -> None:
    rgb = read_rgb(folder / "first.ref2.exr").rgb
    rgb[3, 4] = np.nan
    write_reference(folder / "first.ref2.exr", rgb)


@pytest.mark.parametrize("harm", [other_size, moved, same, broken])
def test_a_half_that_does_not_fit_is_refused_in_the_words_of_compare(
    harm: Callable[[Path], None], folder: Path, weights: Path, tmp_path: Path
) -> None:
    scenes = tmp_path / "scenes"
    shutil.copytree(folder, scenes)
    harm(scenes)
    reference, half = scenes / "first.ref.exr", scenes / "first.ref2.exr"
    compared = in_process("compare", reference, reference, "--other-half", half, "--progress", "none")
    assert compared.code == 3
    assert compared.err.startswith("ERROR: ")
    run = in_process("bench", scenes, "--match", "[fw]*", "--out", tmp_path / "out", "--model", weights, *QUICK)
    assert run.code == 1
    why = compared.err.removeprefix("ERROR: ").strip()
    assert run.err.splitlines()[0] == f"ERROR: {why}"
    assert run.err.splitlines()[-1] == f"  first: {why}"
    found = json.loads((tmp_path / "out" / "results.json").read_text("utf-8"))
    assert found["failed"] == {"first": why}
    assert [scene["name"] for scene in found["scenes"]] == ["whole"]
