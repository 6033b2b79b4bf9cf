"""`lbmc models`: the weights that ship, and what they say of themselves."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

from model import weight_files, zoo
from tests.end_to_end.scenes import random_weights
from tests.runner import Runner, environment, in_process


def test_every_weight_file_of_the_package_is_listed(lbmc: Runner) -> None:
    run = lbmc("models")
    assert run.code == 0
    for name in zoo.presets():
        assert name in run.out


def test_json_tells_config_recipe_and_hash(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    random_weights(tmp_path / "tiny.safetensors")
    monkeypatch.setattr(weight_files, "WEIGHTS", tmp_path)
    monkeypatch.setattr(weight_files, "DEFAULT_PRESET", "tiny")
    (found,) = json.loads(in_process("models", "--json").out)
    assert found["name"] == "tiny"
    assert found["digest"] == zoo.find("tiny").digest
    assert found["bytes"] == (tmp_path / "tiny.safetensors").stat().st_size
    assert found["config"]["variant"] == "layer"
    assert found["info"] == {"description": "random"}


def test_without_presets_it_says_what_to_do(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(weight_files, "WEIGHTS", tmp_path)
    assert "--model" in in_process("models").out


def test_listing_them_imports_no_torch() -> None:
    code = """
import sys
from lbmc_cli.main import main
assert main(["models"]) == 0
print("torch" in sys.modules, file=sys.stderr)
"""
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, env=environment(), check=True)
    assert run.stderr == "False\n"
