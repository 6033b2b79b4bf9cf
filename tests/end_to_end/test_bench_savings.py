"""What `lbmc bench` says of savings: each beside the full model, where the survey chooses it and where it is forced."""

from __future__ import annotations

import html
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from deep_io import DeepSamples
from model import zoo
from pipelines.bench.savings import SAVINGS
from tests.end_to_end.bench_scenes import WINDOW, write_pair, write_reference
from tests.end_to_end.scenes import changed, random_weights, write_scene
from tests.model.random_models import SMALL, random_network
from tests.runner import in_process

QUICK = ("--no-paper", "--no-memory", "--no-curves", "--no-flip", "--repeats", 1, "--frame", 0, "--progress", "none")
ALL, NOTHING, BF16 = "all that the survey chooses", "nothing: the noise of the clock", "products in bf16"
COMMANDS: dict[str, tuple[object, ...]] = {
    "1 layer": ("--no-adapt", "--layers", 1),
    "coc and lens dropped": ("--no-adapt", "--map", "coc=none", "--map", "lens=none"),
    "motion and time dropped": ("--no-adapt", "--map", "motion=none", "--map", "time=none"),
    BF16: ("--no-adapt", "--precision", "bf16"),
    ALL: (),
}
"""Savings that `lbmc denoise` can be told to make."""


def moving(samples: DeepSamples, pixels: float) -> dict[str, np.ndarray]:
    """Channels of a motion of so many pixels, and times within the shutter."""
    motion, time = np.full(samples.total, pixels, np.float16), np.linspace(0.0, 1.0, samples.total, dtype=np.float16)
    return {"motion__X": motion, "motion__Y": motion, "time": time}


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A scene out of focus that stands still, one in focus that moves, and a sky."""
    folder = tmp_path_factory.mktemp("scenes")
    blurred, sharp, sky = (write_pair(folder, name, seed) for seed, name in enumerate(("blurred", "sharp", "sky")))
    write_scene(folder / "blurred.deep.exr", changed(blurred, **moving(blurred, 0.0)))
    write_scene(folder / "sharp.deep.exr",
                changed(sharp, coc=np.zeros(sharp.total, np.float16), **moving(sharp, 3.0)))
    plain = np.full(sky.total, 0.5, np.float16)
    write_scene(folder / "sky.deep.exr", changed(
        sky, R=plain, G=plain, B=plain, A=np.zeros(sky.total, np.float16), Z=np.full(sky.total, 1e10, np.float32)))
    write_reference(folder / "sky.ref.exr", np.full((WINDOW.height, WINDOW.width, 3), 0.51))
    return folder


@pytest.fixture(scope="module")
def weights(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Of a network to which every feature matters, as it does not to an untrained one."""
    path = tmp_path_factory.mktemp("weights") / "tiny.safetensors"
    zoo.save(random_network(SMALL["fast"], 0, torch.float32), path, {"description": "random"})
    return path


@pytest.fixture(scope="module")
def report(folder: Path, weights: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("bench")
    half = random_weights(out / "half.safetensors", 1)
    run = in_process("bench", folder, "--out", out, "--model", weights, "--contexts", weights, half, *QUICK)
    assert run.code == 0, run.err
    return out


@pytest.fixture(scope="module")
def points(report: Path) -> dict[tuple[str, str], dict[str, Any]]:
    """By saving and scene."""
    found = json.loads((report / "results.json").read_text("utf-8"))
    return {(point["saving"], point["scene"]): point for point in found["savings"]}


def test_the_survey_chooses_what_a_scene_does_without(points: dict[tuple[str, str], dict[str, Any]]) -> None:
    chosen = {saving: {scene: point["chosen"] for (name, scene), point in points.items() if name == saving}
              for saving, _ in points}
    assert list(chosen) == [*(saving.name for saving in SAVINGS), "context at half resolution"]
    assert chosen["coc and lens held"] == chosen["coc and lens dropped"] == {"blurred": False, "sharp": True}
    assert chosen["motion and time held"] == {"blurred": True, "sharp": False}
    assert chosen["1 layer"] == chosen["cells passed through"] == {"blurred": False, "sharp": False, "sky": True}
    assert chosen[ALL] == {"blurred": True, "sharp": True, "sky": True}
    for name in (NOTHING, BF16, "context at half resolution"):
        assert chosen[name] == {"blurred": None, "sharp": None, "sky": None}


@pytest.mark.parametrize("saving", COMMANDS)
def test_errors_are_those_of_the_command_told_to_save(
    saving: str, points: dict[tuple[str, str], dict[str, Any]], folder: Path, weights: Path, tmp_path: Path
) -> None:
    for words, index in ((("--no-adapt",), 0), (COMMANDS[saving], 1)):
        out = tmp_path / f"{index}.exr"
        assert in_process("denoise", folder / "sharp.deep.exr", out, "--model", weights, "--threads", 1, "--device",
                          "cpu", *words).code == 0
        run = in_process("compare", out, folder / "sharp.ref.exr", "--no-flip", "--json")
        (expected,) = json.loads(run.out)["images"]
        for key in ("relmse", "smape"):
            assert points[saving, "sharp"][key][index] == pytest.approx(expected[key], rel=1e-6)


def test_nothing_saved_changes_nothing_and_everything_is_timed(points: dict[tuple[str, str], dict[str, Any]]) -> None:
    for (saving, _), point in points.items():
        assert point["before"] > 0.0
        assert point["after"] > 0.0
        if saving == NOTHING:
            assert point["relmse"][0] == point["relmse"][1]
    assert points["1 layer", "blurred"]["relmse"][0] != points["1 layer", "blurred"]["relmse"][1]
    held, dropped = (points[f"coc and lens {word}", "sharp"]["relmse"][1] for word in ("held", "dropped"))
    assert held != dropped


def test_the_page_groups_savings_and_shows_chosen_beside_forced(report: Path) -> None:
    table = (report / "results.md").read_text("utf-8")
    section = table[table.index("## What a scene does not need") :].split("\n\n")[1]
    rows = [line.strip("| ").split(" | ") for line in section.splitlines()[2:]]
    layers = [row for row in rows if row[0] == "1 layer"]
    assert [row[1:3] for row in layers] == [["chosen by the survey", "1"], ["forced: they need the full model", "2"]]
    assert all(row[3].endswith(" %") and row[4].endswith(" %") for row in layers)  # time saved, error added
    names = [row[0] for row in rows]
    assert names == sorted(names, key=names.index)
    context = next(row for row in rows if row[0].startswith("context at half resolution"))
    assert context[0] == "context at half resolution: tiny, half"
    page = html.unescape((report / "report.html").read_text("utf-8"))
    group = page[page.index('<th scope="rowgroup" class="word" rowspan="2">1 layer</th>') :].split("</tbody>")[0]
    assert group.count("<tr>") == 1  # and that before it: one name for both rows
    for words in ("chosen by the survey", "forced: they need the full model"):
        assert f'<td class="word">{words}</td>' in group


def test_without_savings_nothing_is_said_of_them(folder: Path, weights: Path, tmp_path: Path) -> None:
    run = in_process("bench", folder, "--match", "sharp", "--out", tmp_path, "--model", weights, "--no-savings", *QUICK)
    assert run.code == 0, run.err
    assert "What a scene does not need" not in run.out
    assert json.loads((tmp_path / "results.json").read_text("utf-8"))["savings"] == []
