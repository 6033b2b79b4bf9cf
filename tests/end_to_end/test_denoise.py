"""`lbmc denoise` as a user runs it: what is written, what is kept, what is refused, what is said."""

from __future__ import annotations

import json
import os
import re
import signal
import subprocess
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import OpenEXR
import pytest
from safetensors import safe_open
from safetensors.torch import save_file

from deep_io import Header, Window
from deep_io.deep_writer import DeepWriter
from pipelines import __version__
from tests.end_to_end.scenes import (
    WINDOW,
    changed,
    noisy_scene,
    random_weights,
    read_flat,
    rgb,
    without_samples,
    write_scene,
)
from tests.runner import LBMC, Runner, environment, in_process, installed

TINY = Window(0, 0, 23, 15)


@pytest.fixture(scope="module")
def weights(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return random_weights(tmp_path_factory.mktemp("weights") / "random.safetensors")


@pytest.mark.parametrize("runner", [in_process, installed])
def test_a_beauty_of_the_inputs_windows_is_written(runner: Runner, weights: Path, tmp_path: Path) -> None:
    source = write_scene(
        tmp_path / "in.exr", owner="somebody", lbmc__weighting="uniform", capDate="2020:01:01 00:00:00"
    )
    run = runner("denoise", source, tmp_path / "out.exr", "--model", weights)
    assert run.code == 0, run.err
    assert run.out == ""
    assert re.search(r"^Progress: 100%$", run.err, re.MULTILINE)
    channels, header = read_flat(tmp_path / "out.exr")
    assert set(channels) == {"R", "G", "B", "A"}
    for pixels in channels.values():
        assert pixels.dtype == np.float16
        assert pixels.shape == (WINDOW.height, WINDOW.width)
        assert np.isfinite(pixels).all()
    low, high = header["dataWindow"]
    assert (*low, *high) == (WINDOW.xmin, WINDOW.ymin, WINDOW.xmax, WINDOW.ymax)
    assert header["owner"] == "somebody"
    assert header["lbmc:version"] == __version__
    assert header["lbmc:model"] == "random"
    assert "lbmc:weighting" not in header
    assert header["type"] == OpenEXR.scanlineimage


def test_the_same_input_gives_the_same_bytes(weights: Path, tmp_path: Path) -> None:
    source = write_scene(tmp_path / "in.exr")
    outputs = [tmp_path / "a.exr", tmp_path / "b.exr"]
    for output in outputs:
        assert in_process("denoise", source, output, "--model", weights, "--threads", "1").code == 0
    assert outputs[0].read_bytes() == outputs[1].read_bytes()


def test_the_pixel_type_and_compression_asked_for(weights: Path, tmp_path: Path) -> None:
    source = write_scene(tmp_path / "in.exr", noisy_scene(2, TINY))
    words = ("--model", weights, "--pixel-type", "float", "--compression", "piz")
    assert in_process("denoise", source, tmp_path / "out.exr", *words).code == 0
    channels, header = read_flat(tmp_path / "out.exr")
    assert channels["R"].dtype == np.float32
    assert header["compression"] == OpenEXR.PIZ_COMPRESSION


def test_a_sequence_is_denoised_frame_by_frame(weights: Path, tmp_path: Path) -> None:
    for number in range(1001, 1006):
        write_scene(tmp_path / f"in.{number}.exr", noisy_scene(number, TINY))
    words = ("--model", weights, "--frames", "1001-1005x2")
    run = in_process("denoise", tmp_path / "in.####.exr", tmp_path / "out.%04d.exr", *words)
    assert run.code == 0, run.err
    assert sorted(path.name for path in tmp_path.glob("out*")) == ["out.1001.exr", "out.1003.exr", "out.1005.exr"]
    assert "3 of 3 frames done" in run.err


def test_a_gap_in_a_sequence_is_told_and_is_an_error_of_frames_that_are_named(weights: Path, tmp_path: Path) -> None:
    for number in (1, 2, 4):
        write_scene(tmp_path / f"in.{number:04d}.exr", noisy_scene(number, TINY))
    words = ("denoise", tmp_path / "in.####.exr", tmp_path / "out.####.exr", "--model", weights)
    run = in_process(*words, "--frames", "1-4")
    assert run.code == 3
    assert "1 of 4 frames are missing: 3" in run.err
    run = in_process(*words)
    assert run.code == 0
    assert len(re.findall(r"^.*in\.####\.exr: frames not on disk, skipped: 3 ", run.err, re.MULTILINE)) == 1
    assert "not on disk" not in in_process(*words, "--frames", "1-2,4", "--overwrite").err


def test_a_frame_that_fails_does_not_stop_the_others_and_is_listed_at_the_end(weights: Path, tmp_path: Path) -> None:
    for number in (1, 2, 3):
        write_scene(tmp_path / f"in.{number:04d}.exr", noisy_scene(number, TINY))
    broken = tmp_path / "in.0002.exr"
    broken.write_bytes(broken.read_bytes()[:-200])
    run = in_process("denoise", tmp_path / "in.####.exr", tmp_path / "out.####.exr", "--model", weights)
    assert run.code == 1
    assert sorted(path.name for path in tmp_path.glob("out*")) == ["out.0001.exr", "out.0003.exr"]
    assert len(re.findall(r"^ERROR: .*in\.0002\.exr", run.err, re.MULTILINE)) == 1
    assert "in.0002.exr" in run.err.split("failed frames:")[1]
    assert "2 of 3 frames done, 1 failed" in run.err


def test_an_output_that_is_not_named_as_an_exr_is_refused(weights: Path, tmp_path: Path) -> None:
    source = write_scene(tmp_path / "in.exr")
    for words in (["denoise", "--model", weights], ["pack"]):
        run = in_process(*words, source, tmp_path / "out.jpg")
        assert run.code == 2
        assert "ends in .exr" in run.err
    assert list(tmp_path.iterdir()) == [source]


def test_a_resumed_sequence_gives_the_bytes_of_one_that_was_never_stopped(weights: Path, tmp_path: Path) -> None:
    for number in (1, 2, 3):
        scene = noisy_scene(number, TINY)
        brighter = {name: scene.channels[name] * np.float16(number) for name in "RGB"}
        write_scene(tmp_path / f"in.{number}.exr", changed(scene, **brighter))
    broken = tmp_path / "in.1.exr"
    broken.write_bytes(broken.read_bytes()[:-200])
    words = ("denoise", tmp_path / "in.#.exr", tmp_path / "out.#.exr", "--model", weights, "--skip-existing")
    assert in_process(*words).code == 1
    whole = (tmp_path / "out.3.exr").read_bytes()
    (tmp_path / "out.3.exr").unlink()
    assert in_process(*words).code == 1  # frame 1 fails again, 2 decides although it is skipped
    assert (tmp_path / "out.3.exr").read_bytes() == whole


def test_an_existing_output_is_refused_kept_or_replaced(weights: Path, tmp_path: Path) -> None:
    source, output = write_scene(tmp_path / "in.exr", noisy_scene(3, TINY)), tmp_path / "out.exr"
    output.write_text("precious")
    refused = in_process("denoise", source, output, "--model", weights)
    assert refused.code == 2
    assert "--overwrite" in refused.err
    kept = in_process("denoise", source, output, "--model", weights, "--skip-existing")
    assert kept.code == 0
    assert "skipped" in kept.err
    assert output.read_text() == "precious"
    assert in_process("denoise", source, output, "--model", weights, "--overwrite").code == 0
    assert rgb(output).shape == (TINY.height, TINY.width, 3)


@pytest.mark.parametrize("link", [os.symlink, os.link])
def test_an_input_is_never_written_over(link: Callable[[Path, Path], None], weights: Path, tmp_path: Path) -> None:
    source = write_scene(tmp_path / "in.exr", noisy_scene(3, TINY))
    before = source.read_bytes()
    link(source, tmp_path / "link.exr")
    for output in (source, tmp_path / "link.exr"):
        run = in_process("denoise", source, output, "--model", weights, "--overwrite")
        assert run.code == 2
        assert "input" in run.err
    assert source.read_bytes() == before


def test_what_lbmc_wrote_is_taken_only_with_force(weights: Path, tmp_path: Path) -> None:
    source = write_scene(tmp_path / "in.exr", noisy_scene(3, TINY), lbmc__model="fast")
    run = in_process("denoise", source, tmp_path / "out.exr", "--model", weights)
    assert run.code == 3
    assert "--force" in run.err
    assert in_process("denoise", source, tmp_path / "out.exr", "--model", weights, "--force").code == 0


def test_broken_samples_are_left_out_and_counted(weights: Path, tmp_path: Path) -> None:
    samples = noisy_scene(4, TINY)
    red, roughness = samples.channels["R"].copy(), samples.channels["roughness"].copy()
    red[[5, 50]], roughness[np.flatnonzero(samples.channels["A"])[-3:]] = np.nan, np.inf
    source = write_scene(tmp_path / "in.exr", changed(samples, R=red, roughness=roughness))
    run = in_process("denoise", source, tmp_path / "out.exr", "--model", weights)
    assert run.code == 0
    assert "2 radiance" in run.err
    assert "3 roughness" in run.err
    assert np.isfinite(rgb(tmp_path / "out.exr")).all()


@pytest.mark.parametrize("channel", ["R", "N.X", "albedo.G", "roughness", "coc", "lens.Y", "Z"])
def test_the_largest_float_in_a_channel_does_not_ruin_the_picture(
    channel: str, weights: Path, tmp_path: Path
) -> None:
    samples = noisy_scene(4, TINY, dtype=np.float32)
    values = samples.channels[channel].copy()
    values[::9] = np.finfo(np.float32).max
    source = write_scene(tmp_path / "in.exr", changed(samples, **{channel.replace(".", "__"): values}))
    run = in_process("denoise", source, tmp_path / "out.exr", "--model", weights, "--pixel-type", "float")
    assert run.code == 0
    told = re.search(r"\d+ (radiance|normal|albedo|roughness|coc|lens)\b", run.err)
    assert bool(told) == (channel != "Z")  # there it is a miss
    channels, _ = read_flat(tmp_path / "out.exr")
    assert all(np.isfinite(pixels).all() and np.abs(pixels).max() < 1e3 for pixels in channels.values())


def test_a_frame_of_nothing_but_broken_samples_fails_and_is_not_written_black(weights: Path, tmp_path: Path) -> None:
    samples = noisy_scene(0, TINY)
    source = write_scene(tmp_path / "in.exr", changed(samples, R=np.full_like(samples.channels["R"], np.nan)))
    run = in_process("denoise", source, tmp_path / "out.exr", "--model", weights)
    assert run.code == 3
    assert "in.exr: no sample has a finite radiance" in run.err
    assert list(tmp_path.iterdir()) == [source]


def test_a_first_frame_of_nothing_but_broken_samples_does_not_decide_for_the_shot(
    weights: Path, tmp_path: Path
) -> None:
    for number in (1, 2, 3):
        scene = noisy_scene(number, TINY)
        darker = {name: scene.channels[name] * np.float16(0.02) for name in "RGB"}
        write_scene(tmp_path / f"in.{number}.exr", changed(scene, **darker))
    broken = noisy_scene(1, TINY)
    write_scene(tmp_path / "in.1.exr", changed(broken, R=np.full_like(broken.channels["R"], np.nan)))
    words = ("denoise", tmp_path / "in.#.exr", "--model", weights, "--exposure-from", "2")
    assert in_process(*words, tmp_path / "named.#.exr", "--frames", "2-3").code == 0
    run = in_process(*words[:-2], tmp_path / "out.#.exr")
    assert run.code == 1
    assert "in.1.exr: no sample has a finite radiance" in run.err
    for number in (2, 3):
        assert (tmp_path / f"out.{number}.exr").read_bytes() == (tmp_path / f"named.{number}.exr").read_bytes()


@pytest.mark.parametrize("words", [(), ("--no-adapt",)])
def test_an_over_frame_without_samples_is_black_and_transparent_and_decides_nothing(
    words: tuple[str, ...], weights: Path, tmp_path: Path
) -> None:
    """An element that is not in the picture yet, or no more."""
    for number in (1, 2, 3):
        scene = noisy_scene(number, TINY) if number == 2 else without_samples(TINY)
        write_scene(tmp_path / f"in.{number}.exr", scene, lbmc__weighting="over")
    words = ("--model", weights, *words)
    run = in_process("denoise", tmp_path / "in.#.exr", tmp_path / "out.#.exr", *words)
    assert run.code == 0, run.err
    assert in_process("denoise", tmp_path / "in.2.exr", tmp_path / "alone.exr", *words).code == 0
    assert (tmp_path / "out.2.exr").read_bytes() == (tmp_path / "alone.exr").read_bytes()
    for number in (1, 3):
        channels, _ = read_flat(tmp_path / f"out.{number}.exr")
        assert set(channels) == {"R", "G", "B", "A"}
        assert all(pixels.shape == (TINY.height, TINY.width) and not pixels.any() for pixels in channels.values())


def test_a_budget_that_no_band_is_small_enough_for_is_told_once(weights: Path, tmp_path: Path) -> None:
    for number in (1, 2):
        write_scene(tmp_path / f"in.{number}.exr", noisy_scene(number, TINY))
    words = ("denoise", tmp_path / "in.#.exr", tmp_path / "out.#.exr", "--model", weights, "--memory")
    run = in_process(*words, "2MiB")
    assert run.code == 0
    told = [line for line in run.err.splitlines() if "--memory" in line]
    assert len(told) == 1
    assert re.search(r"in\.1\.exr: needs about 0\.\d+ GiB .*, more than the 0\.00195 GiB of --memory", told[0])
    assert "--memory" not in in_process(*words, "4GiB", "--overwrite").err


def test_kept_channels_are_the_pixel_means_of_their_finite_values(weights: Path, tmp_path: Path) -> None:
    samples = noisy_scene(0, TINY)
    lens = samples.channels["lens.X"].copy()
    lens[::7] = np.nan
    source = write_scene(tmp_path / "in.exr", changed(samples, lens__X=lens))
    words = ("--model", weights, "--keep", "lens", "--keep", "c?c")
    assert in_process("denoise", source, tmp_path / "out.exr", *words).code == 0
    channels, _ = read_flat(tmp_path / "out.exr")
    assert set(channels) == {"R", "G", "B", "A", "lens.X", "lens.Y", "coc"}
    for name, values in {**samples.channels, "lens.X": lens}.items():
        if name not in ("lens.X", "lens.Y", "coc"):
            continue
        finite = np.isfinite(values)
        sums = np.bincount(samples.pixel_index[finite], values[finite].astype(np.float64), samples.counts.size)
        counts = np.bincount(samples.pixel_index[finite], minlength=samples.counts.size)
        expected = (sums / np.maximum(counts, 1)).reshape(samples.counts.shape)
        assert channels[name].dtype == np.float16
        np.testing.assert_allclose(channels[name], expected, rtol=1e-3, atol=1e-6)


def test_a_glob_of_channels_to_keep_passes_ids_by_and_a_name_does_not(weights: Path, tmp_path: Path) -> None:
    samples = noisy_scene(0, TINY)
    source = write_scene(tmp_path / "in.exr", changed(samples, coid=np.arange(samples.total, dtype=np.uint32)))
    words = ("denoise", source, tmp_path / "out.exr", "--model", weights, "--keep")
    refused = in_process(*words, "coid")
    assert refused.code == 3
    assert "--ids coid" in refused.err
    assert in_process(*words, "co*").code == 0
    assert set(read_flat(tmp_path / "out.exr")[0]) == {"R", "G", "B", "A", "coc"}


def test_a_glob_of_channels_to_keep_passes_the_hashes_of_a_cryptomatte_by(weights: Path, tmp_path: Path) -> None:
    samples = noisy_scene(0, TINY)
    hashes = np.ones(samples.total, np.float32)
    source = write_scene(tmp_path / "in.exr", changed(samples, object00__R=hashes, object00__G=hashes),
                         **{"cryptomatte/abcdefg/name": "object"})
    words = ("denoise", source, tmp_path / "out.exr", "--model", weights, "--keep")
    assert in_process(*words, "*").code == 0
    kept = set(read_flat(tmp_path / "out.exr")[0])
    assert "coc" in kept
    assert not [name for name in kept if name.startswith("object")]
    (tmp_path / "out.exr").unlink()
    refused = in_process(*words, "object00")
    assert refused.code == 3
    assert "--ids object to" in refused.err


def test_the_beautys_own_channels_cannot_be_kept_and_globs_pass_them_by(weights: Path, tmp_path: Path) -> None:
    source, out = write_scene(tmp_path / "in.exr", noisy_scene(0, TINY)), tmp_path / "out.exr"
    refused = in_process("denoise", source, out, "--model", weights, "--keep", "coc", "--keep", "R")
    assert refused.code == 2
    assert "ERROR: --keep R: is the beauty's own channel, written denoised; leave it out of --keep\n" in refused.err
    assert not out.exists()
    assert in_process("denoise", source, out, "--model", weights, "--keep", "[Rc]*").code == 0
    assert {"R", "coc"} < set(read_flat(out)[0])


def test_values_beyond_half_are_clamped_counted_and_said(weights: Path, tmp_path: Path) -> None:
    samples = noisy_scene(5, TINY, dtype=np.float32)
    bright = {name: samples.channels[name] * np.float32(1e7) for name in "RGB"}
    source = write_scene(tmp_path / "in.exr", changed(samples, **bright))
    run = in_process("denoise", source, tmp_path / "out.exr", "--model", weights)
    assert run.code == 0
    assert re.search(r"\d+ values beyond half's range were clamped", run.err)
    assert rgb(tmp_path / "out.exr").max() == 65504


def test_a_dry_run_says_everything_and_writes_nothing(weights: Path, tmp_path: Path) -> None:
    source = write_scene(tmp_path / "in.exr")
    run = in_process("denoise", source, tmp_path / "out.exr", "--model", weights, "--dry-run")
    assert run.code == 0
    assert list(tmp_path.iterdir()) == [source]
    for word in ("radiance   <- R G B", "weighting: uniform", "layers: ", "light: held", "exposure: ", "MiB"):
        assert word in run.out
    run = in_process("denoise", source, tmp_path / "out.exr", "--model", weights, "--dry-run", "--keep", "absent")
    assert run.code == 3
    assert "no channel or layer 'absent' to keep" in run.err
    run = in_process("denoise", source, tmp_path / "out.exr", "--model", weights, "--dry-run", "--keep", "lens")
    assert "kept as pixel means: lens.X lens.Y" in run.out
    assert run.out.startswith(f"{source} -> {tmp_path / 'out.exr'}\n")


def test_a_dry_run_calls_no_channel_unused_that_is_asked_for(weights: Path, tmp_path: Path) -> None:
    samples = noisy_scene(0, TINY)
    more = {name: np.ones(samples.total, kind) for name, kind in
            (("fog", np.float16), ("haze", np.float16), ("id", np.uint32), ("mist", np.float16))}
    source = write_scene(tmp_path / "in.exr", changed(samples, **more))
    words = ("denoise", source, tmp_path / "out.exr", "--model", weights, "--dry-run")

    def unused(*asked: str) -> list[str]:
        run = in_process(*words, *asked)
        assert run.code == 0, run.err
        return next(line.split()[1:] for line in run.out.splitlines() if line.startswith("  unused"))

    assert unused() == ["fog", "haze", "id", "mist"]
    assert unused("--aov", "fog", "--keep", "haze", "--ids", "id") == ["mist"]


def test_a_reader_that_leaves_a_dry_run_fails_no_frame(weights: Path, tmp_path: Path) -> None:
    for number in (1, 2, 3):
        write_scene(tmp_path / f"in.{number}.exr", noisy_scene(number, TINY))
    command = [LBMC, "denoise", tmp_path / "in.#.exr", tmp_path / "out.#.exr", "--model", weights, "--dry-run",
               "--progress", "none"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, env=environment()) as process:
        assert process.stdout is not None
        assert process.stderr is not None
        process.stdout.close()
        assert process.stderr.read() == b""


def test_a_part_is_chosen_by_name_before_number(weights: Path, tmp_path: Path) -> None:
    scenes = [noisy_scene(number, TINY) for number in (1, 2)]
    headers = [replace(Header.of_samples(scene), name=name) for scene, name in zip(scenes, "10", strict=True)]
    with DeepWriter(tmp_path / "in.exr", headers) as writer:
        for number, scene in enumerate(scenes):
            writer.write(scene, number)
    write_scene(tmp_path / "first.exr", scenes[0])
    words = ("--model", weights)
    assert in_process("denoise", tmp_path / "in.exr", tmp_path / "out.exr", "--part", "1", *words).code == 0
    assert in_process("denoise", tmp_path / "first.exr", tmp_path / "alone.exr", *words).code == 0
    assert np.array_equal(rgb(tmp_path / "out.exr"), rgb(tmp_path / "alone.exr"))
    for command in (("denoise", tmp_path / "in.exr", tmp_path / "no.exr", *words), ("info", tmp_path / "in.exr")):
        run = in_process(*command, "--part", "\u00b2")
        assert run.code == 3
        assert "has no part '\u00b2'; its parts are 1, 0" in run.err


def test_a_gpu_that_is_not_there_is_a_usage_error(weights: Path, tmp_path: Path) -> None:
    source = write_scene(tmp_path / "in.exr", noisy_scene(3, TINY))
    run = in_process("denoise", source, tmp_path / "out.exr", "--model", weights, "--device", "cuda:63")
    assert run.code == 2
    assert "cuda:63" in run.err


def test_weights_of_another_version_are_a_usage_error(weights: Path, tmp_path: Path) -> None:
    source = write_scene(tmp_path / "in.exr")
    with safe_open(weights, "pt") as file:
        metadata, tensors = file.metadata(), {name: file.get_tensor(name) for name in file.keys()}
    name, tensor = next(iter(tensors.items()))
    save_file({**tensors, name: tensor.repeat(2, *[1] * (tensor.ndim - 1))}, tmp_path / "wider.safetensors", metadata)
    document = json.loads(metadata["lbmc"])
    document["config"]["unheard_of"] = 1
    save_file(tensors, tmp_path / "fields.safetensors", {"lbmc": json.dumps(document)})
    for stem in ("wider", "fields"):
        run = in_process("denoise", source, tmp_path / "out.exr", "--model", tmp_path / f"{stem}.safetensors")
        assert run.code == 2
        assert re.fullmatch(rf"ERROR: --model: .*{stem}.safetensors: .*another version of lbmc.*\n", run.err)


def test_openjd_progress_goes_to_standard_output(weights: Path, tmp_path: Path) -> None:
    source = write_scene(tmp_path / "in.exr", noisy_scene(3, TINY))
    run = installed("denoise", source, tmp_path / "out.exr", "--model", weights, "--progress", "openjd")
    assert run.code == 0
    assert "openjd_progress: 100" in run.out.splitlines()


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_a_signal_leaves_no_file_behind(number: signal.Signals, weights: Path, tmp_path: Path) -> None:
    for frame in range(1, 60):
        write_scene(tmp_path / f"in.{frame:04d}.exr", noisy_scene(frame, TINY))
    command = [LBMC, "denoise", tmp_path / "in.####.exr", tmp_path / "out.####.exr", "--model", weights]
    with subprocess.Popen(command, stderr=subprocess.PIPE, text=True, env=environment()) as process:
        assert process.stderr is not None
        for line in process.stderr:
            if re.match(r"Progress: [1-9]", line):
                break
        process.send_signal(number)
        _, rest = process.communicate(timeout=60)
    assert process.returncode == 128 + number, rest
    assert rest.splitlines()[-1].startswith("ERROR: ")
    time.sleep(0.1)
    assert not list(tmp_path.glob(".*"))
    for output in tmp_path.glob("out.*.exr"):
        assert rgb(output).shape == (TINY.height, TINY.width, 3)
