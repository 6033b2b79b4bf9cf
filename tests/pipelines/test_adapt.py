"""What the survey decides: one layer where nothing is hit, roles held where they say nothing, once for a shot."""

from __future__ import annotations

from dataclasses import fields, is_dataclass
from pathlib import Path

import numpy as np
import pytest
import torch
from torch.utils._python_dispatch import TorchDispatchMode

from deep_io import DeepSamples, Window
from model import zoo
from model.config import FAST
from model.denoiser import Denoiser
from pipelines.denoise import Job, denoise_frames
from pipelines.options import DenoiseOptions
from pipelines.plan import FramePlan
from tests.end_to_end.scenes import changed, noisy_scene, random_weights, rgb, write_scene
from tests.runner import in_process


def plane(hits: bool) -> DeepSamples:
    """16 x 16 pixels of two samples, on one surface or on none."""
    counts = np.full((16, 16), 2, np.int32)
    total = int(counts.sum())
    channels: dict[str, np.ndarray] = {c: np.linspace(0.1, 2, total).astype(np.float16) for c in "RGB"}
    channels["A"] = np.full(total, hits, np.float16)
    channels["Z"] = np.full(total, 5.0, np.float32)
    return DeepSamples(counts, channels, Window(0, 0, 15, 15))


@pytest.mark.parametrize(
    ("hits", "choices", "expected"),
    [(True, {}, 2), (False, {}, 1), (False, {"adapt": False}, 2), (True, {"layers": 3}, 3), (False, {"layers": 3}, 3)],
)
def test_layers_follow_the_scene(tmp_path: Path, hits: bool, choices: dict[str, int], expected: int) -> None:
    source = write_scene(tmp_path / "in.deep.exr", plane(hits))
    weights = random_weights(tmp_path / "w.safetensors")
    job = Job(DenoiseOptions(str(source), str(tmp_path / "out.exr"), model=str(weights), **choices))
    with job.open(source) as reader:
        assert job.plan(source, reader, lambda _: None).shot.layers == expected


def test_what_is_kept_of_a_frame_holds_no_picture(tmp_path: Path) -> None:
    """A report holds the plans of all frames of a job: pictures in them would be memory that grows."""
    source = write_scene(tmp_path / "in.deep.exr", plane(False))
    weights = random_weights(tmp_path / "w.safetensors")
    options = DenoiseOptions(str(source), str(tmp_path / "out.exr"), model=str(weights), progress="none")
    job = Job(options)
    with job.open(source) as reader:
        before = job.plan(source, reader, lambda _: None)
    after = denoise_frames(options).values[0].plan
    assert sum(array.size >= 16 * 16 for array in arrays(before)) >= 3
    assert max(array.size for array in arrays(after)) < 16 * 16
    assert after.lines() == before.lines()


def arrays(part: object) -> list[np.ndarray]:
    """All arrays in a dataclass and what it is made of."""
    if isinstance(part, np.ndarray):
        return [part]
    inside = [getattr(part, field.name) for field in fields(part)] if is_dataclass(part) else []
    return [array for one in inside for array in arrays(one)]


def moving(motion: float, blur: float = 0.0, seed: int = 0, last: float | None = None) -> DeepSamples:
    """A noisy scene with a shutter: all hits move so many pixels and are blurred so much; `last` moves the last hit."""
    samples = noisy_scene(seed)
    hit = samples.channels["A"] > 0
    along = np.where(hit, motion, 0.0).astype(np.float16)
    if last is not None:
        along[np.flatnonzero(hit)[-1]] = last
    more = {"motion.X": along, "motion.Y": np.zeros_like(along), "coc": np.where(hit, blur, 0.0).astype(np.float16),
            "time": np.random.default_rng(seed).uniform(0, 1, samples.total).astype(np.float16)}
    return DeepSamples(samples.counts, {**samples.channels, **more}, samples.window)


def planned(tmp_path: Path, samples: DeepSamples, adapt: bool = True) -> FramePlan:
    source = write_scene(tmp_path / "in.deep.exr", samples)
    weights = random_weights(tmp_path / "w.safetensors")
    job = Job(DenoiseOptions(str(source), str(tmp_path / "out.exr"), model=str(weights), adapt=adapt))
    with job.open(source) as reader:
        return job.plan(source, reader, lambda _: None)


@pytest.mark.parametrize(
    ("motion", "blur", "held"),
    [
        (0.0, 0.0, {"coc", "lens", "motion", "time"}),
        (0.05, 3.0, {"motion", "time"}),
        (4.0, 0.01, {"coc", "lens"}),
        (4.0, 3.0, set()),
    ],
)
def test_roles_without_a_use_are_held(tmp_path: Path, motion: float, blur: float, held: set[str]) -> None:
    plan = planned(tmp_path, moving(motion, blur))
    assert plan.held == held
    assert not held & {*plan.roles}
    assert {*plan.roles} | held >= {"radiance", "depth", "motion", "time", "coc", "lens"}


def test_one_moving_sample_in_the_last_row_keeps_motion_and_time(tmp_path: Path) -> None:
    assert planned(tmp_path, moving(0.0, 3.0, last=0.25)).held == set()


def test_a_role_that_is_zero_is_held_and_changes_nothing(tmp_path: Path) -> None:
    samples = moving(4.0, 3.0)
    black = {name: np.zeros(samples.total, np.float16) for name in ("albedo.R", "albedo.G", "albedo.B")}
    samples = DeepSamples(samples.counts, {**samples.channels, **black}, samples.window)
    assert planned(tmp_path, samples).held == {"albedo"}
    found = [output(tmp_path, samples, *words) for words in ((), ("--no-adapt",))]
    np.testing.assert_allclose(found[0], found[1], rtol=1e-5, atol=1e-6)


def output(folder: Path, samples: DeepSamples, *words: str) -> np.ndarray:
    source, target = write_scene(folder / "a.exr", samples), folder / f"a{len(words)}.out.exr"
    weights = random_weights(folder / "w.safetensors")
    run = in_process("denoise", source, target, "--model", weights, "--pixel-type", "float", "--progress", "none",
                     *words)
    assert run.code == 0, run.err
    return rgb(target)


def test_no_adapt_holds_nothing_and_a_frame_without_hits_decides_nothing(tmp_path: Path) -> None:
    assert planned(tmp_path, moving(0.0), adapt=False).held == set()
    empty = changed(moving(0.0), A=np.zeros(moving(0.0).total, np.float16))
    empty.channels["Z"][:] = 1e10
    assert planned(tmp_path, empty).shot.decided.held == set()


def test_the_first_frame_decides_and_a_later_one_that_differs_is_told_once(tmp_path: Path) -> None:
    weights = random_weights(tmp_path / "w.safetensors")
    for number, motion in ((1, 0.0), (2, 4.0), (3, 4.0)):
        write_scene(tmp_path / f"in.000{number}.exr", moving(motion, 3.0, number))
    words = ("--model", weights, "--pixel-type", "float", "--progress", "plain")
    run = in_process("denoise", tmp_path / "in.####.exr", tmp_path / "out.####.exr", *words)
    assert run.code == 0, run.err
    assert run.err.count("has motion") + run.out.count("has motion") == 1
    assert "in.0002.exr" in next(line for line in (run.err + run.out).splitlines() if "has motion" in line)
    alone = in_process("denoise", tmp_path / "in.####.exr", tmp_path / "late.####.exr", *words, "--frames", "2-3",
                       "--exposure-from", "1")
    assert alone.code == 0, alone.err
    assert (tmp_path / "late.0003.exr").read_bytes() == (tmp_path / "out.0003.exr").read_bytes()


def without(samples: DeepSamples, *layers: str) -> DeepSamples:
    kept = {name: values for name, values in samples.channels.items() if name.partition(".")[0] not in layers}
    return DeepSamples(samples.counts, kept, samples.window)


def test_a_role_that_only_one_of_a_frame_and_the_deciding_one_has_is_told_once(tmp_path: Path) -> None:
    weights = random_weights(tmp_path / "w.safetensors")
    scene = noisy_scene(0)
    for number, missing in ((1, ("roughness",)), (2, ("albedo", "N", "roughness")), (3, ("albedo",)), (4, ("Z",))):
        write_scene(tmp_path / f"in.{number}.exr", without(scene, *missing))
    words = ("denoise", tmp_path / "in.#.exr", "--model", weights)
    run = in_process(*words, tmp_path / "out.#.exr")
    assert run.code == 0, run.err
    told = [line for line in run.err.splitlines() if "the frame that decided for the shot" in line]
    assert [line.partition(", which")[0] for line in told] == [
        f"{tmp_path}/in.2.exr: lacks normal, albedo", f"{tmp_path}/in.3.exr: has roughness",
        f"{tmp_path}/in.4.exr: lacks depth"]
    assert "--map normal=none --map albedo=none" in told[0]
    chunk = in_process(*words, tmp_path / "chunk.#.exr", "--frames", "3", "--exposure-from", "1")
    assert "in.3.exr: lacks albedo" in chunk.err
    drop = (word for role in ("normal", "albedo", "roughness", "depth") for word in ("--map", f"{role}=none"))
    assert "decided for the shot" not in in_process(*words, tmp_path / "less.#.exr", *drop).err


class ValuesComputed(TorchDispatchMode):
    """Counts the values that tensor operations write, in place or anew: work, whatever the clock says. Views are none.

    Most of the denoiser's time goes into moving values, filter taps foremost; multiply-adds would weigh them little.
    """

    count = 0

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):  # type: ignore[no-untyped-def]
        result = func(*args, **(kwargs or {}))
        if isinstance(result, torch.Tensor) and not func.is_view:
            self.count += result.numel()
        return result


TALL = Window(0, 0, 63, 1023)
"""Cells do their work by rows: a narrow frame shows what a wide one of as many rows would."""


def below(background: str) -> DeepSamples:
    """A noisy frame of 1024 rows, or only its lower half, below a sky that changes smoothly or below no samples."""
    own_sky = 8  # rows, cut off
    noise = noisy_scene(0, Window(TALL.xmin, TALL.ymin - own_sky, TALL.xmax, TALL.ymax), most=2)
    first = int(noise.counts[:own_sky].sum())
    counts, channels = noise.counts[own_sky:], {name: values[first:] for name, values in noise.channels.items()}
    upper = np.arange(TALL.height) < TALL.height // 2
    above = np.repeat(upper, counts.sum(1))
    if background == "no samples":
        channels = {name: values[~above] for name, values in channels.items()}
        counts = np.where(upper[:, None], 0, counts).astype(np.int32)
    if background == "smooth sky":
        place = np.linspace(0.2, 1, int(above.sum())) + np.random.default_rng(0).uniform(-1e-3, 1e-3, int(above.sum()))
        for name, values in channels.items():
            channels[name] = values.copy()
            channels[name][above] = place if name in "RGB" else 1e10 if name == "Z" else 0
    return DeepSamples(counts, channels, TALL)


@pytest.fixture
def real_weights(tmp_path: Path) -> Path:
    """Untrained weights of the widths, windows and reach that ship: the work is that of the trained ones."""
    torch.manual_seed(0)
    zoo.save(Denoiser(FAST), tmp_path / "fast.safetensors", {"description": "random"})
    return tmp_path / "fast.safetensors"


def work(folder: Path, samples: DeepSamples, weights: Path) -> int:
    """Of the real command."""
    source = write_scene(folder / "in.exr", samples)
    with ValuesComputed() as computed:
        run = in_process("denoise", source, folder / "out.exr", "--model", weights, "--layers", 2, "--overwrite",
                         "--threads", 1, "--progress", "none")
    assert run.code == 0, run.err
    return computed.count


def test_a_frame_that_is_half_empty_or_sky_takes_at_least_35_percent_less_work_than_a_full_one(
    tmp_path: Path, real_weights: Path
) -> None:
    full = work(tmp_path, below("more noise"), real_weights)
    pixels = TALL.width * TALL.height
    assert full > 1000 * pixels  # the filter alone has hundreds of taps of a dozen values
    for background in ("no samples", "smooth sky"):
        assert work(tmp_path, below(background), real_weights) <= 0.65 * full, background
