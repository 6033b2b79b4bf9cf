"""`lbmc tune`: weights fitted to a shot by its own samples, and what is refused."""

from __future__ import annotations

import signal
import subprocess
from pathlib import Path

import numpy as np
import OpenEXR
import pytest

from deep_io import DeepSamples, Window
from deep_io.path_samples import SampleReader
from deep_io.roles import ROLES
from model import zoo
from model.metrics import common_scale, relative_squared_error
from tests.end_to_end.scenes import (
    changed,
    noisy_scene,
    random_weights,
    read_flat,
    rgb,
    without_samples,
    write_scene,
)
from tests.runner import LBMC, Finished, Runner, environment, in_process, installed

EXAMPLES = Path(__file__).resolve().parents[2] / "examples/scenes"
WINDOW = Window(-5, 3, 34, 34)
"""40 x 32 pixels."""
QUIET = ("--threads", "1", "--progress", "none")


@pytest.fixture
def weights(tmp_path: Path) -> Path:
    return random_weights(tmp_path / "random.safetensors")


def tuned(source: Path | str, target: Path, weights: Path, *more: object) -> Finished:
    return in_process("tune", source, target, "--model", weights, "--steps", "2", *QUIET, *more)


def error_of(picture: np.ndarray, reference: np.ndarray) -> float:
    k = common_scale(reference)
    return float(relative_squared_error(picture * k, reference * k).mean())


def test_less_error_on_the_shipped_example_without_its_reference(tmp_path: Path) -> None:
    source = EXAMPLES / "interior.deep.exr"
    reference = rgb(EXAMPLES / "interior.ref.exr")
    run = installed("tune", source, tmp_path / "shot.safetensors", "--steps", "12", *QUIET)
    assert run.code == 0, run.err
    assert "steps: 12, crops: 1, frames: 1" in run.err
    errors = {}
    for name, model in (("fast", "fast"), ("shot", tmp_path / "shot.safetensors")):
        done = installed("denoise", source, tmp_path / f"{name}.exr", "--model", model, *QUIET)
        assert done.code == 0, done.err
        errors[name] = error_of(rgb(tmp_path / f"{name}.exr"), reference)
        assert read_flat(tmp_path / f"{name}.exr")[1]["lbmc:model"] == name
    assert errors["shot"] < 0.98 * errors["fast"]


def test_a_sequence_is_looked_at_here_and_there(tmp_path: Path, weights: Path) -> None:
    for number in range(1, 6):
        write_scene(tmp_path / f"shot.{number:04d}.exr", noisy_scene(number, WINDOW))
    run = tuned(tmp_path / "shot.####.exr", tmp_path / "shot.safetensors", weights, "--most-frames", "3")
    assert run.code == 0, run.err
    assert "frames: 3" in run.err
    found = zoo.find(str(tmp_path / "shot.safetensors"))
    assert found.info["tuned"]["frames"] == 3
    assert 0 < found.info["tuned"]["share"] <= 1
    assert found.info["tuned"]["weights"] == zoo.find(str(weights)).digest
    assert found.info["description"] == "random, tuned to shot.####.exr"
    before, after = (zoo.find(str(path)).load().state_dict() for path in (weights, tmp_path / "shot.safetensors"))
    assert any((before[name] != after[name]).any() for name in before)
    few = tuned(tmp_path / "shot.####.exr", tmp_path / "few.safetensors", weights, "--frames", "2-3")
    assert "frames: 2" in few.err


def test_the_same_again_gives_the_same_bytes_and_another_seed_others(tmp_path: Path, weights: Path) -> None:
    source = write_scene(tmp_path / "in.exr", noisy_scene(0, WINDOW))
    for name, seed in (("a", 1), ("b", 1), ("c", 2)):
        assert tuned(source, tmp_path / f"{name}.safetensors", weights, "--seed", seed).code == 0
    a, b, c = ((tmp_path / f"{name}.safetensors").read_bytes() for name in "abc")
    assert a == b
    assert a != c


def test_frames_larger_than_a_crop_and_ragged_pixels(tmp_path: Path, weights: Path) -> None:
    source = write_scene(tmp_path / "in.exr", noisy_scene(0, Window(0, 0, 149, 139)))
    run = tuned(source, tmp_path / "out.safetensors", weights)
    assert run.code == 0, run.err
    assert "crops: 4" in run.err
    dry = in_process("denoise", source, tmp_path / "no.exr", "--model", tmp_path / "out.safetensors", "--dry-run")
    assert dry.code == 0, dry.err


def test_a_packed_file_is_tuned_to_as_the_samples_it_holds(tmp_path: Path, weights: Path) -> None:
    samples = noisy_scene(0, WINDOW, most=1)
    names = ("a", "b", "c", "d")
    rng = np.random.default_rng(0)
    for name in names:
        height, width = samples.counts.shape
        picture = {channel: values.reshape(height, width) for channel, values in samples.channels.items()}
        picture |= {c: (picture[c].astype(np.float32) * rng.lognormal(0, 1, (height, width))).astype(np.float16)
                    for c in "RGB"}
        OpenEXR.File({"type": OpenEXR.scanlineimage}, picture).write(str(tmp_path / f"{name}.exr"))
    packed = in_process("pack", *(tmp_path / f"{name}.exr" for name in names), tmp_path / "deep.exr", "--progress",
                        "none")
    assert packed.code == 0, packed.err
    with SampleReader(tmp_path / "deep.exr") as reader:
        held = reader.read()
    hit = held.coverage > 0
    channels = {"A": held.coverage}
    for role, values in held.roles.items():
        channels |= dict(zip(ROLES[role].channels, values.T.astype(np.float32), strict=True))
    channels["Z"] = np.where(hit, channels["Z"], np.float32(1e10))
    plain = DeepSamples(held.counts, {name: np.ascontiguousarray(v) for name, v in channels.items()}, held.window)
    write_scene(tmp_path / "plain.exr", plain, lbmc__weighting="uniform")
    states = []
    for name in ("deep", "plain"):
        run = tuned(tmp_path / f"{name}.exr", tmp_path / f"{name}.safetensors", weights)
        assert run.code == 0, run.err
        states.append(zoo.find(str(tmp_path / f"{name}.safetensors")).load().state_dict())
    start = zoo.find(str(weights)).load().state_dict()
    moved = max(float((states[0][name] - start[name]).abs().max()) for name in start)
    apart = max(float((states[0][name] - states[1][name]).abs().max()) for name in start)
    assert moved > 0
    assert apart <= 0.1 * moved


def test_weights_tuned_from_mirrored_ones_are_mirrored(tmp_path: Path) -> None:
    source = write_scene(tmp_path / "in.exr", noisy_scene(0, WINDOW))
    run = in_process("tune", source, tmp_path / "shot.safetensors", "--model", "best", "--steps", "1", *QUIET)
    assert run.code == 0, run.err
    dry = in_process("denoise", source, tmp_path / "no.exr", "--model", tmp_path / "shot.safetensors", "--dry-run")
    assert "model: shot, the mean of 4 runs" in dry.out


def refused(run: Finished, code: int, *words: str) -> None:
    assert run.code == code
    (line,) = [line for line in run.err.splitlines() if line.startswith("ERROR:")]
    for word in words:
        assert word in line


def test_what_cannot_be_tuned_to_is_refused_in_a_line_and_nothing_is_written(tmp_path: Path, weights: Path) -> None:
    target = tmp_path / "out.safetensors"
    single = write_scene(tmp_path / "single.exr", noisy_scene(0, WINDOW, most=1))
    refused(tuned(single, target, weights), 3, "single.exr", "no pixel holds two samples")
    over = noisy_scene(0, WINDOW)
    over = changed(over, A=(0.5 * over.channels["A"]).astype(np.float16))
    refused(tuned(write_scene(tmp_path / "over.exr", over, lbmc__weighting="over"), target, weights), 3, "over.exr",
            "composited over each other")
    black = noisy_scene(0, WINDOW)
    black = changed(black, **{name: np.zeros(black.total, np.float16) for name in "RGB"})
    refused(tuned(write_scene(tmp_path / "black.exr", black), target, weights), 3, "black.exr", "no light")
    refused(tuned(write_scene(tmp_path / "none.exr", without_samples(WINDOW)), target, weights), 3, "none.exr")
    refused(tuned(single, tmp_path / "out.####.safetensors", weights), 2, "out.####.safetensors", "whole shot")
    refused(tuned(tmp_path / "absent.exr", target, weights), 3, "absent.exr")
    assert not target.exists()
    assert not list(tmp_path.glob(".*"))


def test_outputs_are_guarded(lbmc: Runner, tmp_path: Path, weights: Path) -> None:
    source = write_scene(tmp_path / "in.exr", noisy_scene(0, WINDOW))
    words = ("--model", weights, "--steps", "1", *QUIET)
    refused(lbmc("tune", source, tmp_path / "out.exr", *words), 2, "out.exr", ".safetensors")
    refused(lbmc("tune", source, weights, *words), 2, "random.safetensors", "exists", "--overwrite")
    before = weights.read_bytes()
    skipped = lbmc("tune", source, weights, *words, "--skip-existing")
    assert skipped.code == 0
    assert weights.read_bytes() == before
    replaced = lbmc("tune", source, weights, *words, "--overwrite")
    assert replaced.code == 0, replaced.err
    assert weights.read_bytes() != before


def test_a_lone_black_frame_of_a_shot_is_passed_over(tmp_path: Path, weights: Path) -> None:
    write_scene(tmp_path / "shot.1.exr", noisy_scene(0, WINDOW))
    black = noisy_scene(1, WINDOW)
    write_scene(tmp_path / "shot.2.exr", changed(black, **{n: np.zeros(black.total, np.float16) for n in "RGB"}))
    run = tuned(tmp_path / "shot.#.exr", tmp_path / "out.safetensors", weights)
    assert run.code == 0, run.err
    assert "frames: 1" in run.err
    assert "shot.2.exr: nothing to learn from" in run.err


def test_the_frame_that_decides_for_the_shot_decides_here_too(tmp_path: Path, weights: Path) -> None:
    samples = noisy_scene(0, WINDOW)
    write_scene(tmp_path / "shot.1.exr", samples)
    write_scene(tmp_path / "shot.2.exr", changed(samples, **{name: (64 * samples.channels[name]).astype(np.float16)
                                                             for name in "RGB"}))
    for name, words in (("own", ()), ("other", ("--exposure-from", "2"))):
        run = tuned(tmp_path / "shot.1.exr", tmp_path / f"{name}.safetensors", weights, *words)
        assert run.code == 0, run.err
    own, other = ((tmp_path / f"{name}.safetensors").read_bytes() for name in ("own", "other"))
    assert own != other
    refused(tuned(tmp_path / "shot.1.exr", tmp_path / "x.safetensors", weights, "--exposure-from", "7"), 3, "shot.7")


def test_one_sample_beyond_all_bounds_harms_nothing(tmp_path: Path, weights: Path) -> None:
    samples = noisy_scene(0, WINDOW, dtype=np.float32)
    red = samples.channels["R"].copy()
    red[100] = 1e25
    run = tuned(write_scene(tmp_path / "in.exr", changed(samples, R=red)), tmp_path / "out.safetensors", weights)
    if run.code == 0:
        state = zoo.find(str(tmp_path / "out.safetensors")).load().state_dict()
        assert all(bool(values.isfinite().all()) for values in state.values())
    else:
        refused(run, 3, "in.exr", "went astray")
        assert not (tmp_path / "out.safetensors").exists()


def test_a_signal_ends_it_between_two_steps_and_leaves_nothing(tmp_path: Path, weights: Path) -> None:
    source = write_scene(tmp_path / "in.exr", noisy_scene(0, WINDOW))
    command = [LBMC, "tune", source, tmp_path / "out.safetensors", "--model", weights, "--steps", "100000", "--threads",
               "1", "--progress", "plain"]
    with subprocess.Popen([*map(str, command)], stderr=subprocess.PIPE, text=True, env=environment()) as process:
        assert process.stderr is not None
        line = ""
        while not line.startswith("Progress: 2"):  # the first fifth is reading
            line = process.stderr.readline()
            assert line, "it ended by itself"
        process.send_signal(signal.SIGTERM)
        rest = process.stderr.read()
        assert process.wait(60) == 143, rest
    assert not (tmp_path / "out.safetensors").exists()
    assert not list(tmp_path.glob(".*"))


def test_one_pixel_and_many_samples_are_enough(tmp_path: Path, weights: Path) -> None:
    samples = noisy_scene(0, Window(0, 0, 0, 0), 1)
    dense = DeepSamples(np.full((1, 1), 600, np.int32), {name: np.repeat(values, 600)
                                                         for name, values in samples.channels.items()}, samples.window)
    run = tuned(write_scene(tmp_path / "in.exr", dense), tmp_path / "out.safetensors", weights)
    assert run.code == 0, run.err


def test_samples_that_are_alike_teach_nothing_and_break_nothing(tmp_path: Path, weights: Path) -> None:
    samples = noisy_scene(0, WINDOW)
    flat = changed(samples, **{name: np.full(samples.total, 0.5, np.float16) for name in "RGB"})
    source = write_scene(tmp_path / "in.exr", flat)
    assert tuned(source, tmp_path / "out.safetensors", weights).code == 0
    state = zoo.find(str(tmp_path / "out.safetensors")).load().state_dict()
    assert all(bool(values.isfinite().all()) for values in state.values())
