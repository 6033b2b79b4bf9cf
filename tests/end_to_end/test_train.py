"""`lbmc train` as a user runs it: several processes, signals and resuming, pictures, and what it refuses."""

from __future__ import annotations

import csv
import os
import re
import shutil
import signal
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from deep_io.flat import write_flat
from model import zoo
from model.config import FAST, OPTIMIZED
from model.denoiser import Denoiser
from pipelines.training.loop import Trainer
from pipelines.training.recipe import Recipe, changed
from tests.pipelines.training_data import SIZE, uneven, write_example
from tests.runner import LBMC, environment, in_process

TORCHRUN = Path(sys.executable).parent / "torchrun"
TWO = (TORCHRUN, "--standalone", "--nproc-per-node", "2", "--no-python", "--")
STEPS, EVERY = 6, 2
QUICK = ("--steps", STEPS, "--validate-every", EVERY, "--batch", 3, "--crop", 32, "--threads", 1, "--set", "warmup=1",
         "--set", "bfloat16=false")


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Scenes in `data`, one of them adaptive, and one in `held`."""
    folder = tmp_path_factory.mktemp("train")
    for name in ("data", "held"):
        (folder / name).mkdir()
    write_example(folder / "data", "a", 1)
    write_example(folder / "data", "b", 2)
    write_example(folder / "data", "uneven", 3, uneven(3))
    write_example(folder / "held", "c", 4)
    return folder


def command(folder: Path, out: str, before: tuple[object, ...] = ()) -> list[str]:
    words = (*before, LBMC, "train", folder / "data", folder / out, "--validation", folder / "held", *QUICK)
    return [str(word) for word in words]


def run(folder: Path, out: str, before: tuple[object, ...] = ()) -> str:
    done = subprocess.run(command(folder, out, before), capture_output=True, text=True, env=environment(), timeout=600)
    assert done.returncode == 0, done.stderr
    return done.stdout


def stopped(folder: Path, out: str, number: signal.Signals, before: tuple[object, ...] = ()) -> tuple[int, str]:
    """Starts a run, sends it a signal after its first validation; returns how it ended and what it said to stderr.

    The signal goes to the whole group of processes, as Ctrl-C on a terminal does.
    """
    process = subprocess.Popen(command(folder, out, before), stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
                               env=environment(), start_new_session=True)
    assert process.stdout is not None
    for line in process.stdout:
        if line.startswith(f"step {EVERY}"):
            os.killpg(process.pid, number)
            break
    _, err = process.communicate(timeout=600)
    return process.returncode, err


def curve(folder: Path, out: str) -> np.ndarray:
    with (folder / out / "curve.csv").open() as file:
        return np.array([[float(value) for value in row.values()] for row in csv.DictReader(file)])


FRONT = 5
"""The column of the front layer's share."""


def assert_one_curve(found: np.ndarray, expected: np.ndarray) -> None:
    """To rounding, as sums over processes have it: Adam's first steps are as long for a gradient that is all rounding
    as for any other, so what is measured on the weights scatters more than the losses of equal batches, and the layers'
    shares, which are steep in them, most."""
    front = np.arange(found.shape[1]) == FRONT
    np.testing.assert_allclose(found[:, :2], expected[:, :2], rtol=1e-3)  # step, loss
    np.testing.assert_allclose(found[:, ~front], expected[:, ~front], rtol=2e-2, atol=5e-4)
    np.testing.assert_allclose(found[:, front], expected[:, front], rtol=5e-2)


def step_of(folder: Path, out: str) -> int:
    return int(torch.load(folder / out / "checkpoint.pt", weights_only=True)["step"])


@pytest.fixture(scope="module")
def whole(folder: Path) -> np.ndarray:
    """The curve of a run that nothing interrupted, in one process."""
    said = run(folder, "whole")
    assert "3 scenes, 1 held out, crops of 32 pixels, 1 process on cpu, from step 0" in said
    assert f"wrote {folder / 'whole' / 'fast.safetensors'}" in said
    rows = curve(folder, "whole")
    assert rows[:, 0].tolist() == [2, 4, 6]
    return rows


def test_two_processes_make_the_curve_and_the_weights_of_one(folder: Path, whole: np.ndarray) -> None:
    said = run(folder, "two", TWO)
    assert "2 processes on cpu" in said
    assert said.count("step 2 ") == said.count("wrote ") == 1
    assert_one_curve(curve(folder, "two"), whole)
    mine, theirs = (zoo.find(str(folder / out / "fast.safetensors")).load() for out in ("whole", "two"))
    a, b = (torch.nn.utils.parameters_to_vector(net.parameters()).detach() for net in (mine, theirs))
    # Adam's first steps are as long for a gradient that is all rounding as for any other: a few weights may differ.
    assert float((a - b).norm() / a.norm()) < 2e-3
    assert float((a - b).abs().gt(1e-3).float().mean()) < 1e-3


@pytest.mark.parametrize(("number", "code", "word"), [(signal.SIGTERM, 143, "terminated"),
                                                      (signal.SIGINT, 130, "interrupted")])
def test_a_run_that_is_stopped_resumes_to_the_same_curve(
    folder: Path, whole: np.ndarray, number: signal.Signals, code: int, word: str
) -> None:
    out = f"stopped{code}"
    ended, err = stopped(folder, out, number)
    assert ended == code, err
    assert err.splitlines()[-1] == f"ERROR: {word}"
    assert EVERY <= step_of(folder, out) < STEPS
    assert not (folder / out / "fast.safetensors").exists()
    said = run(folder, out)
    assert f"from step {EVERY}" in said or f"from step {EVERY + 1}" in said
    np.testing.assert_allclose(curve(folder, out), whole, rtol=1e-6)


def test_a_group_that_is_stopped_resumes_to_the_same_curve_in_one_process(folder: Path, whole: np.ndarray) -> None:
    ended, err = stopped(folder, "group", signal.SIGINT, TWO)
    assert ended != 0
    assert EVERY <= step_of(folder, "group") < STEPS, err
    run(folder, "group")
    assert_one_curve(curve(folder, "group"), whole)


def test_a_run_leaves_pictures_and_a_recipe_that_makes_the_same_run(folder: Path, whole: np.ndarray) -> None:
    assert (folder / "whole" / "curve.png").read_bytes().startswith(b"\x89PNG")
    assert len(list((folder / "whole" / "panels").glob("step*.png"))) == len(whole)
    again = in_process("train", folder / "data", folder / "whole", "--validation", folder / "held", "--threads", 1,
                       "--recipe", folder / "whole" / "recipe.json")
    assert again.code == 0, again.err
    assert "from step 6" in again.out


def test_what_one_process_of_a_group_refuses_ends_all_with_one_line(folder: Path, tmp_path: Path) -> None:
    shutil.copytree(folder / "data", tmp_path / "data")
    (tmp_path / "data" / "b.ref.exr").unlink()
    words = [*TWO, LBMC, "train", tmp_path / "data", tmp_path / "run", "--validation", folder / "held", *QUICK]
    done = subprocess.run([str(word) for word in words], capture_output=True, text=True, env=environment(), timeout=600)
    assert done.returncode != 0
    errors = [line for line in done.stderr.splitlines() if line.startswith("ERROR: ")]
    assert len(errors) == 1
    assert "b.ref.exr is missing" in errors[0]


def lose_reference(data: Path, held: Path) -> None:
    (data / "a.ref.exr").unlink()


def shrink_reference(data: Path, held: Path) -> None:
    write_flat(data / "a.ref.exr", dict.fromkeys("RGB", np.ones((SIZE, 7), np.float32)))


def poison_reference(data: Path, held: Path) -> None:
    write_flat(held / "c.ref.exr", dict.fromkeys("RGB", np.full((SIZE, SIZE), np.inf, np.float32)))


def leave_one(data: Path, held: Path) -> None:
    for path in [*data.glob("b.*"), *data.glob("uneven.*")]:
        path.unlink()


def leave_none_held(data: Path, held: Path) -> None:
    for path in held.iterdir():
        path.unlink()


def hold_the_same(data: Path, held: Path) -> None:
    shutil.rmtree(held)
    held.symlink_to(data)


def lose_data(data: Path, held: Path) -> None:
    shutil.rmtree(data)


@pytest.mark.parametrize(
    ("damage", "named"),
    [
        (lose_reference, "data/a.deep.exr: its reference a.ref.exr is missing"),
        (shrink_reference, "data/a.ref.exr: 7x40 pixels at (0, 0), but a.deep.exr has 40x40 pixels at (0, 0)"),
        (poison_reference, "held/c.ref.exr: NaN or Inf in the reference"),
        (leave_one, "data: 1 scene; 2 or more are needed"),
        (leave_none_held, "held: no *.deep.exr files"),
        (hold_the_same, "held: is the training folder itself"),
        (lose_data, "data: no such folder"),
    ],
)
def test_unsuitable_data_end_in_one_line_before_training_starts(
    folder: Path, tmp_path: Path, damage: Callable[[Path, Path], None], named: str
) -> None:
    data, held = tmp_path / "data", tmp_path / "held"
    for name in ("data", "held"):
        shutil.copytree(folder / name, tmp_path / name)
    damage(data, held)
    done = in_process("train", data, tmp_path / "run", "--validation", held, *QUICK)
    assert done.code == 3
    assert done.err.startswith("ERROR: ")
    assert done.err.count("\n") == 1
    assert named in done.err
    assert not (tmp_path / "run").exists()


def test_weights_recipes_and_folders_that_do_not_fit_are_refused_before_training_starts(
    folder: Path, whole: np.ndarray, tmp_path: Path
) -> None:
    other = tmp_path / "other.safetensors"
    zoo.save(Denoiser(OPTIMIZED), other, {})
    (tmp_path / "file").write_text("")
    start = ("train", folder / "data", tmp_path / "run", "--validation", folder / "held", *QUICK)
    onto = ("train", folder / "data", folder / "whole", "--validation", folder / "held", *QUICK)
    cases = [
        ((*start, "--network", "fast", "--start", other), "its network, 'optimized', differs from the 'fast' to be "
                                                          "trained in unet.encoder, "),
        ((*onto, "--start", other), "its network, 'optimized', differs from the 'fast' to be trained in unet.enc"),
        ((*start, "--start", tmp_path / "none.safetensors"), "none.safetensors: no such weight file"),
        ((*onto, "--network", "optimized"), "whole/checkpoint.pt: its network, 'fast', differs from the 'optimized' of "
                                         "--network in name, unet.encoder, "),
        ((*onto, "--seed", 5), "whole/checkpoint.pt: was made by another recipe (differs in seed)"),
        ((*start, "--network", "huge"), "--network huge: there are layer"),
        ((*start, "--set", "warmpu=3"), "no field warmpu"),
        ((*start, "--set", 'only="generator"'), "whose other parts are trained; name its weights with --start"),
        ((*start, "--set", "hold_layers=1"), "holds the layers of weights that training starts from; name them with"),
        ((*start, "--set", 'only="kernels"'), "fast has no part 'kernels'; there are reducer, unet, partitioner, gen"),
        (("train", folder / "data", tmp_path / "file", "--validation", folder / "held", *QUICK), "file: is a file"),
    ]
    if not torch.cuda.is_available():
        cases.append(((*start, "--device", "cuda"), "--device cuda:0: this machine shows 0 CUDA devices"))
    for words, named in cases:
        done = in_process(*words)
        assert done.code == 2, done.err
        assert done.err.startswith("ERROR: ")
        assert named in done.err
    assert not (tmp_path / "run").exists()


def test_without_a_network_named_that_of_the_starting_weights_is_trained(folder: Path, tmp_path: Path) -> None:
    mine = replace(FAST, name="mine", affinity_features=4)
    zoo.save(Denoiser(mine), tmp_path / "mine.safetensors", {})
    done = in_process("train", folder / "data", tmp_path / "run", "--validation", folder / "held", *QUICK,
                      "--start", tmp_path / "mine.safetensors")
    assert done.code == 0, done.err
    assert zoo.find(str(tmp_path / "run" / "mine.safetensors")).config == mine


def test_a_run_of_a_network_that_has_changed_since_goes_on_with_its_own(folder: Path, tmp_path: Path) -> None:
    older = replace(FAST, affinity_features=4, filtered_guides=False)
    words = ("train", folder / "data", tmp_path, "--validation", folder / "held", "--steps", 2, *QUICK[2:])
    recipe = changed(Recipe(), ["steps=2", "validate_every=2", "batch=3", "crop=32", "warmup=1", "bfloat16=false"])
    Trainer(older, recipe, tmp_path).save()
    refused = in_process(*words, "--network", "fast")
    assert refused.code == 2
    assert re.fullmatch(r"ERROR: .*checkpoint.pt: its network, 'fast', differs from the 'fast' of --network in "
                        r"affinity_features, filtered_guides; .*or go on without --network\n", refused.err)
    done = in_process(*words)
    assert done.code == 0, done.err
    assert zoo.find(str(tmp_path / "fast.safetensors")).config == older


def test_a_run_that_is_out_of_time_says_so_and_has_no_weights_yet(folder: Path, tmp_path: Path) -> None:
    words = ("train", folder / "data", tmp_path / "run", "--validation", folder / "held", *QUICK)
    done = in_process(*words, "--seconds", 1e-9)
    assert done.code == 0, done.err
    assert done.out.splitlines()[-1] == f"stopped at step 0 of {STEPS}; the same command goes on"
    assert not list((tmp_path / "run").glob("*.safetensors"))
    assert step_of(tmp_path, "run") == 0


@pytest.mark.parametrize("out", ["file/run", "x" * 300, "there/" + "x" * 300])
def test_a_folder_that_cannot_be_written_to_is_refused_before_the_data_are_read(
    out: str, folder: Path, tmp_path: Path
) -> None:
    (tmp_path / "file").write_text("")
    done = in_process("train", folder / "data", tmp_path / out, "--validation", folder / "held", *QUICK,
                      "--cache", tmp_path / "cache")
    assert done.code == 3
    assert re.fullmatch(r"ERROR: .*: cannot be written to \(.*\); name another folder for the run\n", done.err)
    assert [path.name for path in tmp_path.iterdir()] == ["file"]
