"""The scripts that measure and draw: paper.py and its like in benchmarks, layers_alive.py, readme.py; figures.py."""

from __future__ import annotations

import dataclasses
import json
import os
import subprocess
import sys
from importlib import import_module
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
from PIL import Image

from deep_io import Window
from deep_io.errors import InputError
from deep_io.path_samples import SampleReader
from model.baseline import pixel_means
from model.metrics import score
from pipelines.bench.methods import MethodSpec
from pipelines.bench.results import CurvePoint, GrowthPoint, Measurement, Results, SceneInfo
from pipelines.flat_pictures import read_rgb
from tests.end_to_end.bench_scenes import WINDOW, write_halves, write_pair
from tests.end_to_end.scenes import changed, noisy_scene, random_weights, write_scene

HOME = Path(__file__).resolve().parents[2]
SQUARE = Window(0, 0, 31, 31)


@pytest.fixture
def script(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    """benchmarks/readme.py as a module."""
    for folder in ("benchmarks", "docs"):
        monkeypatch.syspath_prepend(str(HOME / folder))
    return import_module("readme")


def run(path: str, *words: object) -> str:
    """What a script says, run as its documentation has it."""
    environment = {**os.environ, "PYTHONPATH": str(HOME) if (HOME / "model").is_dir() else ""}
    done = subprocess.run([sys.executable, HOME / path, *map(str, words)], capture_output=True, text=True, check=False,
                          env=environment)
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_quality_measures_against_the_mean_of_both_halves(tmp_path: Path) -> None:
    folder, result = tmp_path / "scenes", tmp_path / "quality.json"
    folder.mkdir()
    write_halves(folder, "first", 1)
    write_pair(folder, "whole", 2)
    run("benchmarks/quality.py", folder, "--no-oidn", "--json", result)
    found = json.loads(result.read_text("utf-8"))
    one, other = (read_rgb(folder / f"first.{kind}.exr").rgb for kind in ("ref", "ref2"))
    with SampleReader(folder / "first.deep.exr") as reader:
        samples = reader.read()
    noisy = pixel_means(samples.counts, samples.weight, samples.roles["radiance"])
    expected = score(noisy, one, other, with_flip=False)
    for name in ("relmse", "relmse_unbiased", "floor", "smape"):
        assert found["first"]["noisy"][name] == pytest.approx(getattr(expected, name), rel=1e-6), name
    assert found["whole"]["noisy"]["floor"] is None


def test_the_papers_networks_are_trained_scored_and_kept(tmp_path: Path) -> None:
    data = tmp_path / "data"
    data.mkdir()
    for seed, name in enumerate(("one", "two")):
        write_pair(data, name, seed, samples=16, window=SQUARE)
    (data / "two.json").write_text(json.dumps({"coc_95": 5.0}), "utf-8")
    words = (data, "--work", tmp_path / "work", "--score", f"val2={data}", "--steps", 2, "--json",
             tmp_path / "rows.json")
    run("benchmarks/paper.py", *words, "--only", "OPTIMIZED")
    first = json.loads((tmp_path / "rows.json").read_text("utf-8"))
    assert first["scenes"] == ["one", "two"]
    assert set(first["rows"]) == {"OPTIMIZED.1"}
    row = first["rows"]["OPTIMIZED.1"]
    assert (row["steps"], row["layers"], row["group"]) == (2, 2, "paper")
    assert set(row["scenes"]["val2"]) == {"one", "two"}
    assert first["blurred"] == {"val2": ["two"]}
    assert all(0 < scene["relmse"] < 100 and 0 < scene["smape"] < 1 for scene in row["scenes"]["val2"].values())
    with SampleReader(tmp_path / "work" / "scenes" / "val2" / "one.deep.exr") as reader:
        assert reader.total == 8 * 32 * 32  # of 16
    write_pair(data, "three", 3, samples=16, window=SQUARE)  # comes too late: all networks have the same scenes
    said = run("benchmarks/paper.py", *words, "--only", "pixel aggregate", "--seed", 2)
    assert "OPTIMIZED" not in said
    second = json.loads((tmp_path / "rows.json").read_text("utf-8"))
    assert second["scenes"] == first["scenes"]
    assert set(second["rows"]) == {"OPTIMIZED.1", "pixel-aggregate.2"}
    assert second["rows"]["OPTIMIZED.1"] == row


def test_networks_of_a_group_are_trained_alike(script: ModuleType) -> None:
    reduced = import_module("reduced")
    runs = reduced.runs()
    assert len({one.key for one in runs}) == len(runs)
    for one in runs:
        others = [other for other in runs if other.group == one.group]
        for other in others:
            alike = dataclasses.replace(other.recipe, layers=one.recipe.layers, seed=one.recipe.seed,
                                        loss=one.recipe.loss)
            assert alike == one.recipe
    losses = {one.name for one in runs if one.group == "paper" and one.recipe.loss != reduced.SMAPE}
    assert losses == {reduced.TONE_MAPPED_LAYER}
    counts = [one.config.layers for one in runs if one.name.startswith("LAYER, ") and one.name.endswith(("r", "s"))]
    assert counts == [1, 3, 4, 5]
    pairs = {one.recipe.seed for one in runs if one.name == "fast"}
    assert pairs == {one.recipe.seed for one in runs if one.name == "pixel aggregate"} == {1, 2, 3}


def test_every_network_of_the_paper_and_ours_is_timed_beside_oidn(script: ModuleType, tmp_path: Path) -> None:
    rows = tmp_path / "rows.json"
    rows.write_text(json.dumps({"scenes": ["one"], "rows": {"kept": {"steps": 3}}}), "utf-8")
    run("benchmarks/paper_times.py", "--frame", 32, "--repeats", 1, "--json", rows)
    found = json.loads(rows.read_text("utf-8"))
    assert found["rows"] == {"kept": {"steps": 3}}
    seconds = found["times"]["cpu_seconds_a_megapixel"]
    assert set(seconds) == {one.name for one in import_module("reduced").runs()} | {"clamp and blur",
                                                                                   found["times"]["yardstick"]}
    assert all(value > 0 for value in seconds.values())
    assert seconds["LAYER, tone-mapped L2"] == seconds["LAYER"]  # one network, trained in two ways
    assert found["times"]["machine"]["threads"] == 1


def reduced_row(name: str, steps: int, relmse: float, group: str = "paper") -> dict[str, Any]:
    """A row as benchmarks/paper.py makes it, of one scene a set."""
    errors = {"relmse": relmse, "trimmed": relmse, "smape": relmse}
    return {"name": name, "group": group, "seed": 1, "steps": steps, "batch": 2, "crop": 64, "layers": 2,
            "cpu_seconds_a_step": 0.1, "scenes": {"val2": {"s": errors}, "shared": {"t": errors}}}


def test_rows_are_kept_group_by_group_and_only_of_equal_steps(script: ModuleType, tmp_path: Path) -> None:
    kept = {"A.1": reduced_row("A", 250, 0.2), "B.1": reduced_row("B", 250, 0.3),
            "C.1": reduced_row("C", 9, 0.1, "ours")}
    found = {"A.1": reduced_row("A", 3000, 0.1), "B.1": reduced_row("B", 3000, 0.2),
             "C.1": reduced_row("C", 3000, 0.1, "ours")}
    mine, theirs = tmp_path / "mine.json", tmp_path / "theirs.json"
    mine.write_text(json.dumps({"scenes": ["one"], "rows": kept, "times": {"frame": 8}}), "utf-8")
    theirs.write_text(json.dumps({"scenes": ["one"], "rows": found}), "utf-8")
    run("benchmarks/keep_paper.py", theirs, "--json", mine)
    document = json.loads(mine.read_text("utf-8"))
    assert document["rows"] == {"A.1": found["A.1"], "B.1": found["B.1"], "C.1": kept["C.1"]}
    assert document["times"] == {"frame": 8}
    keep = import_module("keep_paper")
    for rows, words in (({"A.1": found["A.1"]}, r"has no B\.1"),
                        ({**found, "B.1": kept["B.1"]}, r"rows of \[250, 3000\] steps")):
        with pytest.raises(InputError, match=words):
            keep.replaced(kept, rows, "paper")


def test_sentences_about_the_papers_networks_are_counted_from_the_rows(
    script: ModuleType, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    tables = import_module("paper_tables")
    names = {"LAYER": 0.10, "PIXELGATHER": 0.12, "OPTIMIZED": 0.08, "LAYER, tone-mapped L2": 0.11}
    rows = {name: reduced_row(name, 3000, error) for name, error in names.items()}
    document = {"scenes": ["one", "two"], "blurred": {"val2": ["s"], "shared": ["t"]}, "rows": rows,
                "untrained": {"clamp and blur": reduced_row("", 0, 0.11)}}
    (tmp_path / "paper.json").write_text(json.dumps(document), "utf-8")
    monkeypatch.setattr(tables, "PAPER", tmp_path / "paper.json")
    told = " ".join(tables.training().split())
    assert "3,000 steps of 2 crops of 64 x 64 pixels, 300 CPU seconds, on 2 procedural scenes" in told
    assert "of the 4 networks, 2 on 14 of our own and 2 on 12 further have a lower relMSE" in told
    told = " ".join(tables.agreement().split())
    assert "on both sets of scenes PIXELGATHER; on neither OPTIMIZED." in told
    assert "+10 % SMAPE and +10 % relMSE on 14 of our own" in tables.losses_sentence()
    rows["LAYER"]["steps"] = 250
    (tmp_path / "paper.json").write_text(json.dumps(document), "utf-8")
    with pytest.raises(ValueError, match="differ in steps"):
        tables.training()


def test_layers_are_judged_where_depth_mixes(tmp_path: Path) -> None:
    scene = noisy_scene(0, WINDOW)
    pixel = scene.pixel_index
    column = pixel % WINDOW.width
    depth = np.where(column < 10, 2.0 + (np.arange(scene.total) % 2), 3.0).astype(np.float32)  # 2 and 3, or 3 alone
    write_scene(tmp_path / "motion.deep.exr", changed(scene, Z=depth, A=np.ones(scene.total, np.float16)))
    pair = write_pair(tmp_path, "still", 1)
    assert pair.total
    (tmp_path / "motion.ref.exr").write_bytes((tmp_path / "still.ref.exr").read_bytes())
    out = tmp_path / "alive.json"
    said = run("benchmarks/layers_alive.py", f"ours={tmp_path}", "--model", random_weights(tmp_path / "w.safetensors"),
               "--json", out)
    assert "motion: depth mixes in" in said
    rows = json.loads(out.read_text("utf-8"))["sets"]["ours"]
    assert (rows["motion"]["blurred"], rows["still"]["blurred"]) == (True, False)
    several = (scene.counts > 1) & (np.arange(WINDOW.width) < 10)
    assert rows["motion"]["mixed"] == pytest.approx(several.mean(), abs=1e-4)
    for key in ("samples", "filtered"):  # an untrained partition starts from depth
        found = rows["motion"][key]
        assert 0.1 < found["front"] < 0.9
        assert found["nearer"] > 0.9


def synthetic(relmse: float = 0.02, seconds: float = 1.0) -> Results:
    """A bench of two methods on one scene."""
    specs = [MethodSpec("OIDN + albedo, normal", "OIDN", "oidn", "guided"), MethodSpec("lbmc x", "lbmc", "lbmc", "x")]
    rows = [Measurement("s", spec.name, {"relmse": error, "flip": None}, {"filter": cpu}, {"filter": cpu}, 1.0)
            for spec, error, cpu in zip(specs, (0.03, relmse), (2.0, seconds), strict=True)]
    curve = [CurvePoint("s", spec.name, count, 0.1 / count, 0.1) for spec in specs for count in (1, 2, 4)]
    growth = [GrowthPoint(name, count, 1e6 * count, 1e-6 * count, 1e-6 * count)
              for name in ("LAYER", "SAMPLESPLAT", "lbmc x") for count in (4, 64)]
    return Results({"threads": 1}, {}, specs, [SceneInfo("s", 8, 8, 8)], rows, curve, growth)


def test_errors_and_times_are_held_against_the_repositorys(script: ModuleType) -> None:
    kept = synthetic()
    assert list(script.differing_errors(synthetic(0.020019), kept)) == []
    (line,) = script.differing_errors(synthetic(0.02003), kept)
    assert "lbmc x on s: relmse" in line
    assert list(script.differing_times(synthetic(seconds=1.2), kept)) == []
    (line,) = script.differing_times(synthetic(seconds=1.3), kept)
    assert "lbmc x: 0.65 times" in line
    kept.measurements.pop()
    assert list(script.differing_errors(synthetic(), kept)) == ["lbmc x on s: only here"]


def test_charts_are_drawn_from_results(script: ModuleType, tmp_path: Path) -> None:
    source = tmp_path / "results.json"
    source.write_text(json.dumps(synthetic().to_dict()), "utf-8")
    run("docs/figures.py", source, "--out", tmp_path)
    pictures = {name: np.asarray(Image.open(tmp_path / f"{name}.png").convert("L")) for name in ("speed", "growth")}
    assert all((picture < 100).mean() > 0.001 for picture in pictures.values())
    figures = import_module("figures")
    errors = figures.error_by_samples(synthetic())
    assert errors["lbmc x"] == {1: pytest.approx(0.1), 2: pytest.approx(0.05), 4: pytest.approx(0.025), 8: 0.02}
