"""The scripts of examples/, run by bash with the installed `lbmc` on PATH, as a user would run them."""

from __future__ import annotations

import os
import re
import subprocess
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import OpenImageIO as oiio
import pytest

from deep_io import Window, read_headers
from deep_io.flat import write_flat
from deep_io.header import Header
from tests.end_to_end.scenes import changed, noisy_scene, random_weights, rgb, write_scene
from tests.runner import LBMC, Finished, environment

EXAMPLES = Path(__file__).resolve().parents[2] / "examples"
SCRIPTS = sorted(EXAMPLES.glob("*.sh"))
SCENES = ("interior", "defocus-motion")
SMALL = Window(0, 0, 23, 17)
MOST_BYTES = 3_000_000
"""What an example may weigh: it is downloaded with every clone."""


@pytest.fixture(scope="module")
def weights(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return random_weights(tmp_path_factory.mktemp("weights") / "random.safetensors")


def run(script: str, *arguments: object, weights: Path, cwd: Path, env: Mapping[str, str] | None = None) -> Finished:
    """Runs a script of examples/ in `cwd`; the weights reach it as a user would set them, by LBMC_MODEL."""
    path = f"{LBMC.parent}{os.pathsep}{os.environ['PATH']}"
    ended = subprocess.run(
        ["bash", EXAMPLES / script, *map(str, arguments)],
        capture_output=True,
        text=True,
        cwd=cwd,
        env=environment({"PATH": path, "LBMC_MODEL": str(weights), "LBMC_THREADS": "1", **(env or {})}),
        timeout=600,
    )
    return Finished(ended.returncode, ended.stdout, ended.stderr)


def write_shot(folder: Path, *numbers: int) -> None:
    """Frames of a shot that gets nearer and brighter, so that each frame by itself would be scaled differently."""
    for number in numbers:
        samples = noisy_scene(number, SMALL)
        rise = np.float16(1.0 + 0.5 * (number % 10))
        depth = samples.channels["Z"]
        near = np.where(depth < 1e10, depth / np.float32(rise), depth)
        brighter = {name: samples.channels[name] * rise for name in "RGB"}
        write_scene(folder / f"noisy.{number}.exr", changed(samples, **brighter, Z=near))


def write_render(path: Path, seed: int) -> Path:
    """A flat render of one sample per pixel, with AOVs."""
    samples = noisy_scene(seed, SMALL, most=1)
    shape = (SMALL.height, SMALL.width)
    channels = {name: values.reshape(shape) for name, values in samples.channels.items()}
    write_flat(path, channels, Header.of_samples(samples), "zip")
    return path


@pytest.mark.parametrize("script", SCRIPTS, ids=lambda path: path.name)
def test_every_script_says_what_it_does_and_stops_at_the_first_error(script: Path) -> None:
    lines = script.read_text("utf-8").splitlines()
    assert lines[0] == "#!/usr/bin/env bash"
    assert lines[1].startswith("# ")
    assert "set -euo pipefail" in lines
    assert os.access(script, os.X_OK)


@pytest.mark.parametrize("script", ["sequence.sh", "farm_chunk.sh", "pack_denoise_export.sh"])
def test_too_few_arguments_show_the_usage(script: str, weights: Path, tmp_path: Path) -> None:
    ended = run(script, weights=weights, cwd=tmp_path)
    assert ended.code == 2
    assert ended.err.startswith("usage: ")


@pytest.mark.parametrize("name", SCENES)
@pytest.mark.parametrize("kind", ["deep", "ref"])
def test_the_example_scenes_are_small(name: str, kind: str) -> None:
    path = EXAMPLES / "scenes" / f"{name}.{kind}.exr"
    assert path.stat().st_size < MOST_BYTES
    assert [header.is_deep for header in read_headers(path)] == [kind == "deep"]


def test_demo_denoises_measures_and_draws_both_examples(weights: Path, tmp_path: Path) -> None:
    ended = run("demo.sh", tmp_path / "demo", weights=weights, cwd=tmp_path)
    assert ended.code == 0, ended.err
    for name in SCENES:
        assert rgb(tmp_path / "demo" / f"{name}.exr").shape == rgb(EXAMPLES / "scenes" / f"{name}.ref.exr").shape
        assert (tmp_path / "demo" / f"{name}.png").read_bytes().startswith(b"\x89PNG")
        # Even an untrained network starts as a bilateral filter of the guides, which is better than noise.
        (factor,) = re.findall(rf"^{name}: relMSE noisy \S+, denoised \S+ \(([\d.]+) times less\)$", ended.out, re.M)
        assert float(factor) > 1.0
    assert ended.out.count("SMAPE") == len(SCENES)


def test_sequence_can_be_run_again_after_a_failure(weights: Path, tmp_path: Path) -> None:
    write_shot(tmp_path, 1001, 1002, 1003)
    second = tmp_path / "noisy.1002.exr"
    whole = second.read_bytes()
    second.write_bytes(whole[:-100])
    words = ("noisy.####.exr", "beauty.%04d.exr", "1001-1003")
    failed = run("sequence.sh", *words, weights=weights, cwd=tmp_path)
    assert failed.code == 1
    assert "some frames failed" in failed.err
    assert sorted(path.name for path in tmp_path.glob("beauty.*")) == ["beauty.1001.exr", "beauty.1003.exr"]

    second.write_bytes(whole)
    again = run("sequence.sh", *words, weights=weights, cwd=tmp_path)
    assert again.code == 0, again.err
    assert "1 of 3 frames done, 2 skipped" in again.err
    assert "all frames of 1001-1003 are there" in again.out


def test_sequence_tells_wrong_options_from_unsuitable_input(weights: Path, tmp_path: Path) -> None:
    write_shot(tmp_path, 1001)
    words = ("noisy.####.exr", "beauty.####.exr")
    usage = run("sequence.sh", *words, "1001", "--layers", "9", weights=weights, cwd=tmp_path)
    assert usage.code == 2
    missing = run("sequence.sh", *words, "1001-1004", weights=weights, cwd=tmp_path)
    assert missing.code == 3
    assert "1002-1004" in missing.err
    assert "nothing was written" in missing.err
    assert not list(tmp_path.glob("beauty.*"))


def test_chunks_of_a_shot_give_the_frames_of_one_job(weights: Path, tmp_path: Path) -> None:
    write_shot(tmp_path, 1001, 1002, 1003, 1004)
    for first, last in ((1001, 1002), (1003, 1004)):
        words = ("noisy.####.exr", "chunk.####.exr", first, last, 1001)
        assert run("farm_chunk.sh", *words, weights=weights, cwd=tmp_path).code == 0
    whole = run("sequence.sh", "noisy.####.exr", "whole.####.exr", "1001-1004", weights=weights, cwd=tmp_path)
    assert whole.code == 0, whole.err
    for number in range(1001, 1005):
        assert (tmp_path / f"chunk.{number}.exr").read_bytes() == (tmp_path / f"whole.{number}.exr").read_bytes()


def test_a_chunk_reports_progress_as_the_farm_wants_it(weights: Path, tmp_path: Path) -> None:
    write_shot(tmp_path, 1001)
    words = ("noisy.####.exr", "beauty.####.exr", 1001, 1001, 1001)
    plain = run("farm_chunk.sh", *words, weights=weights, cwd=tmp_path)
    assert "Progress: 100%" in plain.err.splitlines()
    openjd = run("farm_chunk.sh", *words, "--overwrite", weights=weights, cwd=tmp_path,
                 env={"LBMC_PROGRESS": "openjd"})
    assert openjd.code == 2  # --overwrite contradicts the script's --skip-existing
    openjd = run("farm_chunk.sh", *words, weights=weights, cwd=tmp_path, env={"LBMC_PROGRESS": "openjd"})
    assert openjd.code == 0
    assert "openjd_progress: 100" in openjd.out.splitlines()


def test_renders_are_packed_denoised_and_exported(weights: Path, tmp_path: Path) -> None:
    renders = [write_render(tmp_path / f"shot.s{seed}.exr", seed).name for seed in range(1, 5)]
    ended = run("pack_denoise_export.sh", "out", *renders, weights=weights, cwd=tmp_path)
    assert ended.code == 0, ended.err
    beauty = rgb(tmp_path / "out" / "beauty.exr").astype(np.float64)
    flat = oiio.ImageBufAlgo.flatten(oiio.ImageBuf(str(tmp_path / "out" / "layers.deep.exr")))
    names = list(flat.spec().channelnames)
    flattened = flat.get_pixels(oiio.FLOAT)[..., [names.index(name) for name in "RGB"]]
    np.testing.assert_allclose(flattened, beauty, rtol=2.0**-8, atol=2.0**-10)
