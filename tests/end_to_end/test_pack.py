"""`lbmc pack`, and what other tools and `lbmc denoise` make of its files."""

from __future__ import annotations

import json
import subprocess
from pathlib import Path

import numpy as np
import OpenEXR
import pytest

from tests.end_to_end.scenes import random_weights, read_flat, rgb
from tests.runner import LBMC, Runner, environment, in_process

OIIOTOOL = LBMC.with_name("oiiotool")
SHAPE = (10, 14)


def write_render(path: Path, seed: int, shape: tuple[int, int] = SHAPE) -> Path:
    """One-sample render: colour, fractional alpha, depth, albedo; the left third of the picture misses."""
    rng = np.random.default_rng(seed)
    hit = np.broadcast_to(np.arange(shape[1]) >= shape[1] // 3, shape)
    alpha = np.where(hit, rng.choice([0.25, 0.5, 1.0], shape), 0.0)
    channels = {name: (rng.lognormal(0.0, 0.7, shape) * np.maximum(alpha, 0.1)) for name in "RGB"}
    channels |= {"A": alpha, "Z": np.where(hit, rng.uniform(1.0, 9.0, shape), 1e10)}
    channels |= {f"albedo.{name}": np.where(hit, rng.uniform(0.2, 0.9, shape), 0.0) for name in "RGB"}
    header = {"type": OpenEXR.scanlineimage, "compression": OpenEXR.ZIP_COMPRESSION}
    OpenEXR.File(header, {n: np.ascontiguousarray(v, np.float32) for n, v in channels.items()}).write(str(path))
    return path


@pytest.fixture
def renders(tmp_path: Path) -> list[Path]:
    return [write_render(tmp_path / f"seed{seed}.exr", seed) for seed in range(6)]


def test_oiiotool_flattens_a_packed_file_to_the_mean_of_the_renders(
    lbmc: Runner, renders: list[Path], tmp_path: Path
) -> None:
    packed, flat = tmp_path / "packed.exr", tmp_path / "flat.exr"
    run = lbmc("pack", *renders, packed, "--pixel-type", "float")
    assert run.code == 0, run.err
    subprocess.run([OIIOTOOL, packed, "--flatten", "-d", "float", "-o", flat], check=True, env=environment())
    flattened, _ = read_flat(flat)
    for name in "RGBA":
        mean = np.mean([read_flat(path)[0][name] for path in renders], axis=0)
        np.testing.assert_allclose(flattened[name], mean, rtol=2e-5, atol=1e-6)


def test_info_reads_the_packed_samples_back_as_the_renders_pixels(renders: list[Path], tmp_path: Path) -> None:
    packed = tmp_path / "packed.exr"
    assert in_process("pack", *renders, packed, "--pixel-type", "float").code == 0
    found = json.loads(in_process("info", packed, "--json").out)
    assert found["weighting"] == "packed"
    assert found["samples_per_pixel"] == {"min": [6], "mean": [6], "max": [6]}
    pixels = np.stack([rgb(path) for path in renders])
    assert found["roles"]["radiance"]["mean"] == pytest.approx(pixels.mean((0, 1, 2)).tolist(), rel=1e-5)
    assert found["roles"]["radiance"]["max"] == pytest.approx(pixels.max((0, 1, 2)).tolist(), rel=1e-4)


def test_a_packed_file_is_denoised(renders: list[Path], tmp_path: Path) -> None:
    packed, output = tmp_path / "packed.exr", tmp_path / "out.exr"
    assert in_process("pack", *renders, packed).code == 0
    weights = random_weights(tmp_path / "random.safetensors")
    run = in_process("denoise", packed, output, "--model", weights)
    assert run.code == 0, run.err
    assert rgb(output).shape == (*SHAPE, 3)


def test_sequences_by_seed(tmp_path: Path) -> None:
    for seed in (1, 2, 3):
        for frame in (1, 2):
            write_render(tmp_path / f"shot.s{seed}.{frame:04d}.exr", 10 * seed + frame)
    words = ("pack", "--seeds", "1-3", tmp_path / "shot.s@SEED@.####.exr", tmp_path / "deep.####.exr")
    run = in_process(*words)
    assert run.code == 0, run.err
    assert sorted(path.name for path in tmp_path.glob("deep*")) == ["deep.0001.exr", "deep.0002.exr"]
    assert run.err.count("filter box") == 1
    assert run.err.count("3 samples per pixel") == 2


def test_the_same_seed_twice_is_refused(lbmc: Runner, renders: list[Path], tmp_path: Path) -> None:
    twin = tmp_path / "twin.exr"
    twin.write_bytes(renders[0].read_bytes())
    run = lbmc("pack", *renders, twin, tmp_path / "packed.exr")
    assert run.code == 3
    assert "seed0.exr" in run.err
    assert "twin.exr" in run.err
    assert not (tmp_path / "packed.exr").exists()


def test_windows_that_differ_are_refused(renders: list[Path], tmp_path: Path) -> None:
    other = write_render(tmp_path / "other.exr", 77, (10, 15))
    run = in_process("pack", *renders, other, tmp_path / "packed.exr")
    assert run.code == 3
    assert "other.exr" in run.err
    assert not (tmp_path / "packed.exr").exists()


def test_an_existing_output_is_refused(renders: list[Path], tmp_path: Path) -> None:
    output = tmp_path / "packed.exr"
    output.write_text("precious")
    assert in_process("pack", *renders, output).code == 2
    assert output.read_text() == "precious"
    assert in_process("pack", *renders, renders[0], "--overwrite").code == 2
