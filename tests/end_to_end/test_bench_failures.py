"""What one method cannot do on one scene does not end `lbmc bench`: real shortages of memory, in real processes."""

from __future__ import annotations

import html
import json
import os
import subprocess
import sys
from importlib import import_module
from pathlib import Path
from typing import Any

import pytest

from deep_io import Window
from pipelines.bench.job import bench
from pipelines.bench.memory import measurable
from pipelines.bench.options import BenchOptions
from pipelines.bench.results import Results
from tests.end_to_end.bench_scenes import write_pair
from tests.end_to_end.scenes import random_weights
from tests.runner import in_process

HOME = Path(__file__).resolve().parents[2]
ROOM = 195 << 20
"""Bytes of address space above what a bench of a few samples takes: enough for all but a network on 1.7 million."""
LITTLE = """
import re, resource, sys
from lbmc_cli.main import main
room, few, out, *words = sys.argv[1:]
main(["bench", few, "--out", f"{out}/few", "--match", "few", *words])
size = int(re.search(r"VmSize:\\s*(\\d+) kB", open("/proc/self/status").read())[1]) * 1024
resource.setrlimit(resource.RLIMIT_AS, (size + int(room),) * 2)
print("now with little memory", file=sys.stderr, flush=True)
sys.exit(main(["bench", few, "--out", f"{out}/both", *words]))
"""
KILLED = """#!/bin/sh
task=$(cat)
case "$task" in *'"name": "lbmc tiny"'*) kill -9 $$ ;; esac
printf '%s' "$task" | exec {python} "$@"
"""
pytestmark = pytest.mark.skipif(not measurable(), reason="this system does not tell what a process holds")


@pytest.fixture(scope="module")
def weights(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return random_weights(tmp_path_factory.mktemp("weights") / "tiny.safetensors")


def load(out: Path) -> dict[str, Any]:
    found: dict[str, Any] = json.loads((out / "results.json").read_text("utf-8"))
    return found


def test_a_network_that_runs_out_of_memory_on_one_scene_leaves_that_cell_out(weights: Path, tmp_path: Path) -> None:
    write_pair(tmp_path, "few", 1, samples=48)
    write_pair(tmp_path, "many", 2, samples=48, window=Window(0, 0, 223, 159))
    words = ("--model", weights, "--no-paper", "--no-memory", "--no-savings", "--no-curves", "--no-flip", "--repeats",
             1, "--frame", 16, "--progress", "plain")
    environment = {**os.environ, "PYTHONPATH": str(HOME) if (HOME / "model").is_dir() else "", "MALLOC_ARENA_MAX": "1"}
    command = [sys.executable, "-c", LITTLE, str(ROOM), tmp_path, tmp_path, *map(str, words)]
    run = subprocess.run(["sh", "-c", 'ulimit -s 1024; exec "$@"', "sh", *command], capture_output=True, text=True,
                         check=False, env=environment)  # stacks of threads count as address space
    assert run.returncode == 1, run.stderr
    said = run.stderr.partition("now with little memory\n")[2]
    cell = "lbmc tiny on many, no error: out of memory"
    told = [line for line in said.splitlines() if cell in line]
    assert len(told) == 2, said  # when it happened, and at the end
    assert told[0].startswith("ERROR: ")
    assert said.index("failed:\n") < said.rindex(told[1])
    found = load(tmp_path / "both")
    scored = {(row["scene"], row["method"]) for row in found["measurements"] if row["scores"]}
    names = {method["name"] for method in found["methods"]}
    assert scored == {(scene, name) for scene in ("few", "many") for name in names} - {("many", "lbmc tiny")}
    timed = {row["method"] for row in found["measurements"] if row["cpu"]}
    assert timed == names
    assert "| lbmc tiny | – | – |" in run.stdout  # no mean over other scenes than those of its neighbours
    for name in ("results.md", "report.html"):
        assert cell in html.unescape((tmp_path / "both" / name).read_text("utf-8"))


def test_a_measurement_of_memory_that_is_killed_leaves_that_cell_out(
    weights: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write_pair(tmp_path, "scene", 1)
    python = tmp_path / "python"
    python.write_text(KILLED.format(python=sys.executable), "utf-8")
    python.chmod(0o755)
    monkeypatch.setattr(sys, "executable", str(python))  # of the processes whose memory is measured
    run = in_process("bench", tmp_path, "--out", tmp_path / "out", "--model", weights, "--no-paper", "--no-savings",
                     "--no-curves", "--no-flip", "--repeats", 1, "--frame", 0, "--progress", "none")
    assert run.code == 1
    why = ("failed in a process of its own: stopped by signal 9, as where the machine's memory runs out; run on a "
           "machine with more")
    assert f"ERROR: lbmc tiny on scene, no memory: {why}\n" in run.err
    found = load(tmp_path / "out")
    assert set(found["memory"]) == {method["name"] for method in found["methods"]} - {"lbmc tiny"}
    assert found["gaps"] == [{"method": "lbmc tiny", "scene": "scene", "what": "memory", "why": why}]
    assert Results.from_dict(found).to_dict() == found
    assert all(row["scores"] and row["cpu"] for row in found["measurements"])


def test_results_in_which_something_failed_are_not_kept(
    weights: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    for folder in ("benchmarks", "docs"):
        monkeypatch.syspath_prepend(str(HOME / folder))
    script = import_module("readme")
    scenes, kept = tmp_path / "scenes", tmp_path / "kept.json"
    scenes.mkdir()
    for seed, name in enumerate(("good", "bad")):
        write_pair(scenes, name, seed)
    options = BenchOptions(scenes, tmp_path / "out", (str(weights),), repeats=1, frame=0, paper=False, curves=False,
                           savings=False, memory=False, growth=(), flip=False, overwrite=True, progress="none")
    whole = bench(options)
    assert script.keep(whole, options.out / "results.json", kept)
    before = kept.read_bytes()
    assert json.loads(before)["failed"] == {}
    (scenes / "bad.deep.exr").write_bytes((scenes / "bad.deep.exr").read_bytes()[:-100])
    capsys.readouterr()
    partial = bench(options)
    capsys.readouterr()
    assert not script.keep(partial, options.out / "results.json", kept)
    said = capsys.readouterr().err
    assert said.startswith(f"ERROR: {options.out / 'results.json'}: not kept as {kept}")
    assert f"  bad: {scenes / 'bad.deep.exr'}: row 23: " in said
    assert kept.read_bytes() == before
