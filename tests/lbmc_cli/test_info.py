"""`lbmc info`: text and JSON of a file, and the options that say how it is read."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from deep_io import DeepSamples, Header, Window, write_deep
from tests.end_to_end.scenes import changed, noisy_scene, write_scene
from tests.runner import Runner, in_process, installed

SMALL = Window(2, 3, 17, 14)


@pytest.fixture
def source(tmp_path: Path) -> Path:
    return write_scene(tmp_path / "in.exr", noisy_scene(0, SMALL), owner="somebody")


def test_text_names_windows_roles_weighting_and_attributes(lbmc: Runner, source: Path) -> None:
    run = lbmc("info", source)
    assert run.code == 0
    assert run.err == ""
    for word in ("16 x 12, (2, 3) to (17, 14)", "radiance   <- R G B", "weighting   uniform", "somebody", "per pixel"):
        assert word in run.out


def test_json_is_valid_and_complete(lbmc: Runner, source: Path) -> None:
    found = json.loads(lbmc("info", source, "--json").out)
    samples = noisy_scene(0, SMALL)
    assert found["samples"] == samples.total
    assert found["pixels"] == 16 * 12
    assert found["samples_per_pixel"]["max"] == [4]
    assert found["weighting"] == "uniform"
    assert set(found["roles"]) == {"radiance", "coverage", "depth", "normal", "albedo", "roughness", "coc", "lens"}


def test_header_text_that_is_not_utf8_is_shown_escaped(tmp_path: Path) -> None:
    source = write_scene(tmp_path / "in.exr", noisy_scene(0, SMALL), owner="caf\udce9")  # Latin-1, as it is read
    run = installed("info", source, env={"PYTHONIOENCODING": "utf-8:strict"})
    assert (run.code, run.err) == (0, "")
    assert "caf\\udce9" in run.out
    assert "samples " in run.out


def test_json_says_null_of_attributes_that_are_not_finite(lbmc: Runner, tmp_path: Path) -> None:
    samples = noisy_scene(0, SMALL)
    header = Header.of_samples(samples).with_attributes(
        {"far": float("inf"), "gain": float("nan"), "near": 0.5, "span": (1.0, float("-inf"))})
    write_deep(tmp_path / "in.exr", samples, header)

    def refuse(word: str) -> None:
        raise AssertionError(f"{word} is no JSON")

    found = json.loads(lbmc("info", tmp_path / "in.exr", "--json").out, parse_constant=refuse)
    attributes = found["parts"][0]["attributes"]
    assert {name: attributes[name] for name in ("far", "gain", "near", "span")} == {
        "far": None, "gain": None, "near": 0.5, "span": [1, None]}


def test_map_moves_and_drops_roles(source: Path) -> None:
    words = ("--map", "coc=roughness", "--map", "roughness=", "--json")
    mapping = json.loads(in_process("info", source, *words).out)["mapping"]
    assert mapping["coc"] == ["roughness"]
    assert "roughness" not in mapping


def test_an_unknown_role_is_a_usage_error_that_lists_the_roles(lbmc: Runner, source: Path) -> None:
    run = lbmc("info", source, "--map", "colour=R")
    assert run.code == 2
    assert "radiance" in run.err
    assert run.err.count("\n") == 1


def test_a_layer_that_is_not_there_is_named_with_those_that_are(source: Path) -> None:
    run = in_process("info", source, "--map", "normal=Nw")
    assert run.code == 3
    assert "Nw" in run.err
    assert "albedo" in run.err


def test_debug_shows_where_an_error_comes_from(tmp_path: Path) -> None:
    (tmp_path / "bad.exr").write_text("no")
    for words in (("--debug", "info"), ("info", "--debug")):
        run = in_process(*words, tmp_path / "bad.exr")
        assert run.code == 3
        assert "Traceback" in run.err
        assert run.err.splitlines()[-1].startswith("ERROR: ")
    assert "Traceback" not in in_process("info", tmp_path / "bad.exr").err


def test_samples_without_depth_or_alpha_are_said_to_be(tmp_path: Path) -> None:
    samples = noisy_scene(0, SMALL)
    bare = DeepSamples(samples.counts, {name: samples.channels[name] for name in "RGB"}, SMALL)
    run = in_process("info", write_scene(tmp_path / "bare.exr", bare))
    assert run.code == 0
    assert "depth      -- missing" in run.out


def test_a_file_that_a_job_would_refuse_is_shown_before_it_is_refused(lbmc: Runner, tmp_path: Path) -> None:
    samples = noisy_scene(0, SMALL)
    fractional = changed(samples, A=np.full(samples.total, 0.5, np.float16))
    run = lbmc("info", write_scene(tmp_path / "fractional.exr", fractional))
    assert run.code == 3
    for words in ("16 x 12, (2, 3) to (17, 14)", "albedo.B:float16", "normal     <- N.X N.Y N.Z", "would refuse"):
        assert words in run.out
    assert run.err.startswith("ERROR: ")
    assert "--weighting uniform or over" in run.err

    colourless = DeepSamples(samples.counts, {"Z": samples.channels["Z"]}, SMALL)
    source = write_scene(tmp_path / "colourless.exr", colourless)
    run = lbmc("info", source)
    assert run.code == 3
    assert "Z:float32" in run.out
    assert "roles" not in run.out
    assert "--map radiance=LAYER" in run.err
    assert json.loads(lbmc("info", source, "--json").out)["parts"][0]["channels"] == {"Z": "float32"}


def test_of_a_sequence_the_first_frame_is_shown(lbmc: Runner, tmp_path: Path) -> None:
    for number in (1003, 1002):
        write_scene(tmp_path / f"shot.{number}.exr", noisy_scene(number, SMALL))
    run = lbmc("info", tmp_path / "shot.####.exr")
    assert (run.code, run.err) == (0, "")
    assert run.out == lbmc("info", tmp_path / "shot.1002.exr").out


def test_a_sequence_without_frames_is_told(lbmc: Runner, tmp_path: Path) -> None:
    run = lbmc("info", tmp_path / "shot.####.exr")
    assert (run.code, run.err) == (3, f"ERROR: {tmp_path}/shot.####.exr: no file matches the pattern\n")
