"""Input that cannot be denoised: one clear line on stderr, exit code 3, and no output."""

from __future__ import annotations

import struct
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import OpenEXR
import pytest

from deep_io import DeepSamples, Window, write_deep
from tests.end_to_end.scenes import changed, noisy_scene, random_weights, without_samples, write_scene
from tests.runner import Finished, Runner, environment, in_process, installed

SMALL = Window(0, 0, 15, 11)


@pytest.fixture
def weights(tmp_path: Path) -> Path:
    return random_weights(tmp_path / "random.safetensors")


def small() -> DeepSamples:
    return noisy_scene(1, SMALL)


def flat(path: Path) -> None:
    header = {"type": OpenEXR.scanlineimage, "compression": OpenEXR.ZIP_COMPRESSION}
    OpenEXR.File(header, {name: np.ones((4, 4), np.float32) for name in "RGB"}).write(str(path))


def without_colour(path: Path) -> None:
    samples = small()
    write_scene(path, DeepSamples(samples.counts, {"Z": samples.channels["Z"]}, SMALL))


def role_claimed_twice(path: Path) -> None:
    samples = small()
    extra = {f"normal.{axis}": samples.channels[f"N.{axis}"] for axis in "XYZ"}
    write_scene(path, DeepSamples(samples.counts, {**samples.channels, **extra}, SMALL))


def fractional_alpha(path: Path) -> None:
    samples = small()
    write_scene(path, changed(samples, A=np.full(samples.total, 0.5, np.float16)))


def truncated(path: Path) -> None:
    write_scene(path, small())
    whole = path.read_bytes()
    path.write_bytes(whole[: len(whole) * 2 // 3])


def corrupt_row(path: Path) -> None:
    write_scene(path, small())
    whole = bytearray(path.read_bytes())
    whole[-40:] = bytes(40)
    path.write_bytes(whole)


def promises_too_much(path: Path) -> None:
    """The data window says 30000 x 30000 pixels; the file holds 16 x 12."""
    write_scene(path, small())
    whole = bytearray(path.read_bytes())
    for name in (b"dataWindow", b"displayWindow"):
        at = whole.index(name + b"\0box2i\0") + len(name) + len(b"\0box2i\0") + 4
        whole[at : at + 16] = struct.pack("<4i", 0, 0, 29999, 29999)
    path.write_bytes(whole)


def no_sample(path: Path) -> None:
    channels: dict[str, np.ndarray] = {name: np.zeros(0, np.float16) for name in "RGBA"}
    write_deep(path, DeepSamples(np.zeros((4, 4), np.int32), channels, Window(0, 0, 3, 3)))


def empty_packed(path: Path) -> None:
    write_scene(path, without_samples(SMALL), lbmc__weighting="packed")


def nothing_but_nan(path: Path) -> None:
    samples = small()
    write_scene(path, changed(samples, R=np.full(samples.total, np.nan, np.float16)))


def empty_over(path: Path) -> None:
    write_scene(path, without_samples(SMALL), lbmc__weighting="over")


def unknown_compression(path: Path) -> None:
    write_scene(path, small())
    whole = bytearray(path.read_bytes())
    at = whole.index(b"compression\0compression\0") + len(b"compression\0compression\0") + 4
    whole[at] = 77
    path.write_bytes(whole)


def uint_radiance(path: Path) -> None:
    samples = small()
    ones = np.ones(samples.total, np.uint32)
    write_scene(path, changed(samples, R=ones, G=ones, B=ones))


def not_an_exr(path: Path) -> None:
    path.write_text("not a picture")


def empty_file(path: Path) -> None:
    path.touch()


BAD_FILES: list[tuple[Callable[[Path], None], tuple[str, ...]]] = [
    (flat, ("flat", "lbmc pack")),
    (without_colour, ("R, G, B", "--map radiance=")),
    (role_claimed_twice, ("'N'", "'normal'", "--map normal=")),
    (fractional_alpha, ("alpha", "--weighting uniform or over")),
    (truncated, ("row", "truncated")),
    (corrupt_row, ("row 11",)),
    (promises_too_much, ("30000",)),
    (no_sample, ("no sample",)),
    (empty_packed, ("no sample",)),
    (unknown_compression, ("compress",)),
    (uint_radiance, ("uint",)),
    (not_an_exr, ("not an EXR",)),
    (empty_file, ("not an EXR",)),
]


def assert_refused(run: Finished, output: Path, *words: str, code: int = 3) -> None:
    lines = run.err.splitlines()
    assert run.code == code, run.err
    assert [line for line in lines if not line.startswith(("ERROR:", "Progress:"))] == []
    (error,) = [line for line in lines if line.startswith("ERROR:")]
    for word in words:
        assert word in error
    assert not output.exists()
    assert not list(output.parent.glob(".*.tmp*")) if output.parent.exists() else True


@pytest.mark.parametrize(("make", "words"), BAD_FILES, ids=[make.__name__ for make, _ in BAD_FILES])
def test_denoise_refuses(make: Callable[[Path], None], words: tuple[str, ...], weights: Path, tmp_path: Path) -> None:
    source, output = tmp_path / "bad.exr", tmp_path / "out.exr"
    make(source)
    assert_refused(in_process("denoise", source, output, "--model", weights), output, "bad.exr", *words)


@pytest.mark.parametrize(("make", "words"), BAD_FILES, ids=[make.__name__ for make, _ in BAD_FILES])
def test_info_refuses_alike(make: Callable[[Path], None], words: tuple[str, ...], tmp_path: Path) -> None:
    source = tmp_path / "bad.exr"
    make(source)
    assert_refused(in_process("info", source), tmp_path / "none.exr", "bad.exr", *words)


def test_the_installed_program_refuses_alike(weights: Path, tmp_path: Path) -> None:
    flat(tmp_path / "bad.exr")
    run = installed("denoise", tmp_path / "bad.exr", tmp_path / "out.exr", "--model", weights)
    assert_refused(run, tmp_path / "out.exr", "bad.exr", "lbmc pack")


@pytest.mark.parametrize("runner", [in_process, installed])
def test_a_file_that_is_missing(runner: Runner, weights: Path, tmp_path: Path) -> None:
    run = runner("denoise", tmp_path / "none.exr", tmp_path / "out.exr", "--model", weights)
    assert_refused(run, tmp_path / "out.exr", "none.exr")


def test_an_output_folder_that_does_not_exist(weights: Path, tmp_path: Path) -> None:
    source = write_scene(tmp_path / "in.exr", small())
    run = in_process("denoise", source, tmp_path / "none" / "out.exr", "--model", weights)
    assert_refused(run, tmp_path / "none" / "out.exr", "none", "does not exist")


def test_a_sequence_into_a_single_file(weights: Path, tmp_path: Path) -> None:
    write_scene(tmp_path / "in.0001.exr", small())
    run = in_process("denoise", tmp_path / "in.####.exr", tmp_path / "out.exr", "--model", weights)
    assert_refused(run, tmp_path / "out.exr", "sequence", "####")


def test_frames_that_are_missing_are_listed(weights: Path, tmp_path: Path) -> None:
    for number in (1, 3):
        write_scene(tmp_path / f"in.{number:04d}.exr", small())
    words = ("denoise", tmp_path / "in.####.exr", tmp_path / "out.####.exr", "--model", weights, "--frames", "1-4")
    assert_refused(in_process(*words), tmp_path / "out.0001.exr", "2 of 4 frames are missing", "2,4")


def test_a_missing_input_is_said_without_the_seconds_that_torch_takes_to_import(tmp_path: Path) -> None:
    code = f"""
import sys
from lbmc_cli.main import main
for command in ("denoise", "export-layers"):
    assert main([command, {str(tmp_path / "none.exr")!r}, {str(tmp_path / "out.exr")!r}]) == 3
print("torch" in sys.modules)
"""
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, env=environment(), check=True)
    assert run.stderr.count("none.exr: no such file") == 2
    assert run.stdout == "False\n"


@pytest.mark.parametrize(("frame", "code", "words"), [
    ("9", 3, ("in.0009.exr", "no such file")),
    ("none.exr", 3, ("none.exr", "no such file")),
    ("flat.exr", 3, ("flat.exr", "is a flat EXR")),
    ("nan.exr", 3, ("nan.exr", "no sample has a finite radiance; render the frame again")),
    ("empty.exr", 3, ("empty.exr", "no sample anywhere, so it cannot decide for others")),
])
def test_a_bad_exposure_frame_fails_the_job_once_and_before_the_work(
    frame: str, code: int, words: tuple[str, ...], weights: Path, tmp_path: Path
) -> None:
    for number in (1, 2):
        write_scene(tmp_path / f"in.{number:04d}.exr", small())
    flat(tmp_path / "flat.exr")
    nothing_but_nan(tmp_path / "nan.exr")
    empty_over(tmp_path / "empty.exr")
    run = in_process("denoise", "in.####.exr", "out.####.exr", "--model", weights, "--exposure-from", frame,
                     cwd=tmp_path)
    assert_refused(run, tmp_path / "out.0001.exr", *words, code=code)
    assert "Progress" not in run.err


def test_a_bare_number_as_exposure_frame_needs_a_numbered_input(weights: Path, tmp_path: Path) -> None:
    source = write_scene(tmp_path / "in.exr", small())
    run = in_process("denoise", source, tmp_path / "out.exr", "--model", weights, "--exposure-from", "9")
    assert_refused(run, tmp_path / "out.exr", "--exposure-from 9", "no frame number", code=2)


def test_weights_that_do_not_exist_are_a_usage_error_that_lists_the_presets(tmp_path: Path) -> None:
    source = write_scene(tmp_path / "in.exr", small())
    run = in_process("denoise", source, tmp_path / "out.exr", "--model", "nonsense")
    assert_refused(run, tmp_path / "out.exr", "nonsense", code=2)
