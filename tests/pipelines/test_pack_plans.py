"""Which renders become which frame: seeds, sequences, and what is refused before anything is written."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from deep_io.errors import InputError, UsageError
from deep_io.flat import write_flat
from pipelines.pack import PackOptions, pack, pack_frames, plan
from tests.pipelines.flat_render_files import read, render, write_renders


def same_picture(pictures: list[dict[str, np.ndarray]]) -> list[dict[str, np.ndarray]]:
    return [pictures[0], pictures[1], pictures[0]]


def narrower(pictures: list[dict[str, np.ndarray]]) -> list[dict[str, np.ndarray]]:
    return [pictures[0], {name: pixels[:, :-1] for name, pixels in pictures[1].items()}]


def fewer_channels(pictures: list[dict[str, np.ndarray]]) -> list[dict[str, np.ndarray]]:
    return [pictures[0], {name: pixels for name, pixels in pictures[1].items() if name != "Z"}]


@pytest.mark.parametrize(("change", "message"), [
    (same_picture, r"s2\.exr: holds the same picture as .*s0\.exr; render every frame with another seed"),
    (narrower, r"s1\.exr: its data window is 12x9 at 0,0, that of .*s0\.exr is 13x9"),
    (fewer_channels, r"s1\.exr: its channels differ: Z only in .*s0\.exr"),
])
def test_renders_that_do_not_fit_together_are_refused_and_nothing_is_written(tmp_path, change, message):
    paths = write_renders(tmp_path, change([render(seed) for seed in range(3)]))
    with pytest.raises(InputError, match=message):
        pack(paths, tmp_path / "deep.exr")
    assert sorted(os.listdir(tmp_path)) == [path.name for path in paths]


def test_pictures_of_one_colour_may_be_alike(tmp_path):
    black = {name: np.zeros((2, 2), np.float16) for name in "RGBA"}
    report = pack(write_renders(tmp_path, [black, black]), tmp_path / "deep.exr")
    assert report is not None


def test_two_layers_for_one_role_are_refused_and_mapped(tmp_path):
    pictures = [{**render(seed), "depth.Y": render(seed)["Z"]} for seed in range(2)]
    paths = write_renders(tmp_path, pictures)
    with pytest.raises(InputError, match="both match the role 'depth'"):
        pack(paths, tmp_path / "deep.exr")
    report = pack(paths, tmp_path / "deep.exr", PackOptions(overrides={"depth": "depth"}))
    assert report is not None


def test_existing_outputs_are_refused_or_skipped_and_never_an_input(tmp_path):
    paths = write_renders(tmp_path, [render(seed) for seed in range(2)])
    out = tmp_path / "deep.exr"
    out.write_bytes(b"old")
    with pytest.raises(UsageError, match="--overwrite"):
        pack(paths, out)
    assert pack(paths, out, PackOptions(existing="skip")) is None
    assert out.read_bytes() == b"old"
    with pytest.raises(UsageError, match="is the input"):
        pack(paths, paths[1], PackOptions(existing="overwrite"))
    with pytest.raises(InputError, match="folder"):
        pack(paths, tmp_path / "absent" / "deep.exr")


@pytest.fixture
def shot(tmp_path: Path) -> Callable[[str], Path]:
    """Three seeds of frames 10 and 11."""
    for seed in (1, 2, 3):
        for frame in (10, 11):
            write_flat(tmp_path / f"shot.s{seed}.{frame:04d}.exr", render(100 * frame + seed))
    return lambda name: tmp_path / name


def test_seeds_expand_to_the_files_of_every_frame(shot):
    jobs = plan([shot("shot.s@SEED@.####.exr")], shot("deep.####.exr"), seeds="1-3")
    assert [job.number for job in jobs] == [10, 11]
    assert [path.name for path in jobs[0].sources] == ["shot.s1.0010.exr", "shot.s2.0010.exr", "shot.s3.0010.exr"]
    assert jobs[1].target == shot("deep.0011.exr")
    report = pack_frames(jobs, progress="none")
    assert report.exit_code == 0
    assert read(jobs[1].target).counts.max() == 3
    again = pack_frames(jobs, PackOptions(existing="skip"), progress="none")
    assert all(frame.skipped for frame in again.frames)


def test_patterns_one_per_seed_and_single_files_are_planned_alike(shot):
    patterns = [shot(f"shot.s{seed}.####.exr") for seed in (1, 2)]
    (job,) = plan(patterns, shot("deep.####.exr"), frames="11")
    assert [path.name for path in job.sources] == ["shot.s1.0011.exr", "shot.s2.0011.exr"]
    (job,) = plan([shot("shot.s@SEED@.0010.exr")], shot("deep.exr"), seeds="1,3")
    assert (job.number, len(job.sources), job.target) == (None, 2, shot("deep.exr"))


@pytest.mark.parametrize(("sources", "target", "options", "error", "message"), [
    (["shot.s@SEED@.####.exr"], "deep.####.exr", {"seeds": "1-4"}, InputError, r"s4\.####\.exr: no file matches"),
    (["shot.s@SEED@.####.exr"], "deep.exr", {"seeds": "1-3"}, InputError, "OUT is a single file"),
    (["shot.s1.####.exr"], "deep.exr", {}, InputError, "OUT is a single file"),
    (["shot.s1.####.exr", "shot.s2.0010.exr"], "deep.####.exr", {}, InputError, "single file among sequences"),
    (["shot.s1.0010.exr"], "deep.####.exr", {}, InputError, "OUT is a sequence"),
    (["shot.s@SEED@.####.exr"], "deep.####.exr", {}, UsageError, "give the seeds with --seeds"),
    (["shot.s1.####.exr"], "deep.####.exr", {"seeds": "1-3"}, UsageError, "does not hold @SEED@"),
    (["a.exr", "b.exr"], "deep.exr", {"seeds": "1-3"}, UsageError, "takes one name"),
    (["shot.s1.0010.exr"], "deep.exr", {"frames": "10"}, UsageError, "no pattern such as ####"),
    ([], "deep.exr", {}, UsageError, "at least one render"),
    (["absent.exr"], "deep.exr", {}, InputError, "no such file"),
])
def test_plans_that_make_no_sense_are_errors(shot, sources, target, options, error, message):
    with pytest.raises(error, match=message):
        plan([shot(name) for name in sources], shot(target), **options)


def test_a_frame_that_any_seed_lacks_is_missed(shot):
    shot("shot.s1.0010.exr").unlink()
    for seeds in ((1, 2), (2, 1)):
        with pytest.raises(InputError, match=r"s1\.####\.exr: 1 of 2 frames are missing: 10"):
            plan([shot(f"shot.s{seed}.####.exr") for seed in seeds], shot("out.####.exr"))


def test_seeds_keep_their_zeros(tmp_path):
    for seed in range(8, 12):
        (tmp_path / f"s{seed:02d}.exr").touch()
    (job,) = plan([tmp_path / "s@SEED@.exr"], tmp_path / "out.exr", "08-11")
    assert [source.name for source in job.sources] == ["s08.exr", "s09.exr", "s10.exr", "s11.exr"]


def test_a_render_in_the_place_of_the_output_is_not_overwritten(tmp_path):
    paths = write_renders(tmp_path, [render(seed) for seed in range(3)])
    before = paths[-1].read_bytes()
    with pytest.raises(UsageError, match="is a flat EXR, which pack does not replace; name OUT last"):
        pack_frames(plan(paths[:-1], paths[-1]), PackOptions(existing="overwrite"))
    assert paths[-1].read_bytes() == before
