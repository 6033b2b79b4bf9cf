"""benchmarks/ablations.py, what it shares with paper.py, and the tables that docs/ablation_tables.py makes of it."""

from __future__ import annotations

import dataclasses
import json
from importlib import import_module
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest

from model.cost import count
from model.denoiser import Denoiser
from pipelines.training.batches import random_batch
from pipelines.training.cache import CHANNELS
from pipelines.training.caching import build_cache
from tests.end_to_end.bench_scenes import write_pair
from tests.end_to_end.test_bench_scripts import HOME, SQUARE, run


@pytest.fixture
def ablations(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    """benchmarks/ablations.py as a module."""
    for folder in ("benchmarks", "docs"):
        monkeypatch.syspath_prepend(str(HOME / folder))
    return import_module("ablations")


@pytest.fixture
def data(tmp_path: Path) -> Path:
    """Five scenes of 16 samples per pixel."""
    folder = tmp_path / "data"
    folder.mkdir()
    for seed, name in enumerate("abcde"):
        write_pair(folder, name, seed, samples=16, window=SQUARE)
    return folder


def test_changes_have_the_budget_and_the_crops_of_the_base(ablations: ModuleType) -> None:
    runs = ablations.runs()
    assert len({one.key for one in runs}) == len(runs)
    free = ("loss", "finish", "finish_loss", "learning_rate", "muon", "partition_entropy", "depth_order")
    bases = {one.recipe.seed: one for one in runs if one.name == ablations.BASE}
    assert [one.name for one in runs[: len(bases)]] == [ablations.BASE] * len(bases)
    for one in runs[len(bases):]:
        base = bases[one.recipe.seed]
        assert (one.config, one.recipe, one.one_of, one.stored) != (base.config, base.recipe, 1, None), one.name
        alike = {name: getattr(base.recipe, name) for name in free}
        assert dataclasses.replace(one.recipe, layers=base.recipe.layers, **alike) == base.recipe, one.name
        assert one.recipe.layers == ((one.config.layers, 1.0),), one.name


def test_every_changed_network_can_be_made_and_counted(ablations: ModuleType) -> None:
    for change in ablations.CHANGES:
        net = Denoiser(change.config)
        assert count(change.config).parameters == sum(p.numel() for p in net.parameters()), change.name


def test_a_cache_of_fewer_samples_trains_on_the_first_of_each_pixel(ablations: ModuleType, data: Path,
                                                                    tmp_path: Path) -> None:
    trials = import_module("trials")
    cache = build_cache(data, tmp_path / "cache")
    fewer = trials.FewerSamples(cache, 3)
    assert [entry.samples for entry in fewer.entries] == [3] * 5
    entry = fewer.entries[0]
    whole = cache.arrays(cache.entries[0])
    np.testing.assert_array_equal(fewer.arrays(entry).samples, whole.samples[:, :, :3])
    recipe = dataclasses.replace(ablations.RECIPE, batch=1, crop=32)
    batch = random_batch(fewer, recipe, 0, entries=[entry])
    assert int(batch.samples.counts[0]) == 3  # of the 8 that the recipe draws
    first = whole.samples[:, :, :3, CHANNELS["depth"]].astype(np.float32)
    assert sorted(batch.samples.roles["depth"].flatten().tolist()) == sorted(first.ravel().tolist())


def test_rows_say_what_a_change_costs_and_brings(data: Path, tmp_path: Path) -> None:
    out = tmp_path / "rows.json"
    words = (data, "--work", tmp_path / "work", "--score", f"val2={data}", "--steps", 2, "--json", out, "--seed", 1)
    said = run("benchmarks/ablations.py", *words, "--only", "base", "--only", "1 layer", "--only", "*8 samples*")
    rows = json.loads(out.read_text("utf-8"))["rows"]
    assert set(rows) == {"base.1", "1-layer.1", "all-scenes-8-samples-stored.1"}
    assert all(key in said for key in rows)
    base, one = rows["base.1"], rows["1-layer.1"]
    assert (base["layers"], one["layers"]) == (2, 1)
    assert one["multiply_adds"] < base["multiply_adds"]
    assert 0 <= base["nearer_with_misses"] <= 1
    assert "nearer_with_misses" not in one
    assert "nearer_with_misses" not in rows["all-scenes-8-samples-stored.1"]  # layers are not its topic
    assert all(row["cpu_seconds_a_step"] > 0 and row["cpu_seconds_a_megapixel"] > 0 for row in rows.values())
    assert set(base["scenes"]["val2"]) == set("abcde")
    # other samples of the same scenes: another network
    assert rows["all-scenes-8-samples-stored.1"]["scenes"] != base["scenes"]


def test_a_share_of_the_scenes_is_spread_over_all(ablations: ModuleType, data: Path, tmp_path: Path,
                                                  monkeypatch: pytest.MonkeyPatch) -> None:
    trials = import_module("trials")
    cache = build_cache(data, tmp_path / "cache")
    drawn: list[set[str]] = []

    def noted(*words: Any, **named: Any) -> Any:
        drawn.append({entry.name for entry in named["entries"]})
        return random_batch(*words, **named)

    monkeypatch.setattr(trials, "random_batch", noted)
    change = next(change for change in ablations.CHANGES if change.one_of == 2)
    one = ablations.run_of(change, 1)
    one = dataclasses.replace(one, recipe=dataclasses.replace(one.recipe, steps=1, crop=32))
    trials.train(one, cache, list("abcde"), tmp_path / "run")
    assert drawn == [{"a", "c", "e"}]


def row(name: str, seed: int, error: float, **more: Any) -> tuple[str, dict[str, Any]]:
    """A row of one scene whose errors are all the same."""
    scenes = {"val2": {"s": {"relmse": error, "trimmed": error, "smape": error}}}
    return f"{name}.{seed}", {"name": name, "group": "kernels", "seed": seed, "multiply_adds": 25000, "scenes": scenes,
                              "cpu_seconds_a_step": 0.2, "cpu_seconds_a_megapixel": 3.0, **more}


def test_a_ratio_is_to_the_base_of_the_same_seed_and_bold_beyond_its_spread(ablations: ModuleType) -> None:
    tables = import_module("ablation_tables")
    ordered = {"nearer_with_misses": 0.93, "group": ""}
    document = {"rows": dict((
        row("base", 1, 0.10, **ordered), row("base", 2, 0.11, **ordered),
        row("within", 1, 0.105), row("within", 2, 0.1155),
        row("beyond", 1, 0.13), row("beyond", 2, 0.132),
        row("torn", 1, 0.08), row("torn", 2, 0.112),
        row("without a base", 3, 0.1),
    ))}
    page = tables.changes(document, {"beyond": "kernels", "still to do": "data"})
    lines = {line.split(" | ")[1]: line for line in page.splitlines()}
    assert "| 2 | 1 | 1 | 1 | 25.0 k | 0.20 | 3.0 | 93.0 % |" in lines["the base"]
    assert lines["within"].startswith("| kernels | within | 2 | 1.050 (1.05 to 1.05) |")
    assert "| **1.249** (1.20 to 1.30) |" in lines["beyond"]
    assert "| 0.903 (0.80 to 1.02) |" in lines["torn"]  # far off, but the seeds disagree
    for name in ("without a base", "still to do"):
        assert f"| {name} | not run | – |" in lines[name]
    assert "| largest over smallest | 1.100 | 1.100 | 1.100 |" in tables.seeds(document)


def test_one_seed_of_the_base_tells_no_difference(ablations: ModuleType) -> None:
    tables = import_module("ablation_tables")
    document = {"rows": dict((row("base", 1, 0.1), row("worse", 1, 0.5)))}
    assert "| worse | 1 | 5.000 | 5.000 | 5.000 |" in tables.changes(document)
    assert "largest" not in tables.seeds(document)
