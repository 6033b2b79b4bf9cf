"""The frame loop: what fails is collected, what works goes on, and the exit code says which it was."""

from __future__ import annotations

import pytest
import torch

from deep_io.errors import InputError, UsageError
from pipelines.jobs import FrameSkippedError, JobReport, describe_error, run_frames
from pipelines.progress import Progress


def run(outcomes: dict[int, object]) -> JobReport[object]:
    """Runs frames 1 to n; an outcome that is an exception is raised, any other is returned."""

    def work(frame: int, progress: Progress) -> object:
        progress.update(0.5)
        outcome = outcomes[frame]
        if isinstance(outcome, BaseException):
            raise outcome
        return outcome

    return run_frames(list(outcomes), work, Progress(len(outcomes)))


def test_a_failed_frame_does_not_stop_the_others() -> None:
    report = run({1: "a", 2: InputError("f.2.exr: truncated"), 3: "c"})
    assert report.values == ("a", "c")
    assert [frame.label for frame in report.failed] == ["2"]
    assert report.exit_code == 1
    assert report.summary().startswith("2 of 3 frames done, 1 failed")


def test_cpu_seconds_are_told_only_of_work_that_this_process_did() -> None:
    here, elsewhere = (run_frames([1], lambda frame, _: frame, Progress(1), here=here) for here in (True, False))
    assert here.summary().endswith(" CPU s)")
    assert elsewhere.summary().endswith(" s a frame")


@pytest.mark.parametrize(
    ("outcomes", "code"),
    [
        ({1: "a", 2: "b"}, 0),
        ({1: InputError("x")}, 3),
        ({1: UsageError("x")}, 2),
        ({1: OSError("x")}, 1),
        ({1: InputError("x"), 2: InputError("y")}, 3),
        ({1: InputError("x"), 2: UsageError("y")}, 1),
        ({1: FrameSkippedError("exists"), 2: "b"}, 0),
        ({1: FrameSkippedError("exists"), 2: InputError("x")}, 1),
        ({}, 0),
    ],
)
def test_exit_codes(outcomes: dict[int, object], code: int) -> None:
    assert run(outcomes).exit_code == code


def test_failures_and_skips_are_told_when_they_happen(capsys: pytest.CaptureFixture[str]) -> None:
    run({1: InputError("f.1.exr: row 7 is corrupt"), 2: FrameSkippedError("f.2.exr exists")})
    assert capsys.readouterr().err.splitlines() == ["ERROR: f.1.exr: row 7 is corrupt", "2: skipped, f.2.exr exists"]


def test_an_interrupt_ends_the_job() -> None:
    with pytest.raises(KeyboardInterrupt):
        run({1: "a", 2: KeyboardInterrupt(), 3: "c"})


def test_a_reader_that_left_ends_the_job_and_fails_no_frame(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(BrokenPipeError):
        run({1: "a", 2: BrokenPipeError(), 3: "c"})
    assert capsys.readouterr().err == ""


def test_the_cure_for_too_little_memory_is_the_jobs_own(capsys: pytest.CaptureFixture[str]) -> None:
    def work(frame: int, progress: Progress) -> None:
        raise MemoryError

    (frame,) = run_frames([1], work, Progress(1), cure="take less").failed
    assert capsys.readouterr().err == "ERROR: out of memory; take less\n"
    assert frame.told == "out of memory; take less"


def test_every_frame_is_timed_also_the_failed() -> None:
    report = run({1: "a", 2: InputError("x")})
    assert all(frame.seconds > 0.0 and frame.cpu_seconds >= 0.0 for frame in report.frames)


def test_errors_are_described_in_one_line() -> None:
    assert describe_error(InputError("a.exr:\nis flat")) == "a.exr: is flat"
    assert describe_error(PermissionError(13, "Permission denied", "b.exr")) == "b.exr: Permission denied"
    assert describe_error(MemoryError()) == "out of memory; run on a machine with more"
    with pytest.raises(RuntimeError) as caught:
        torch.empty(1 << 52)
    for error in (caught.value, torch.OutOfMemoryError("CUDA out of memory. Tried to allocate 9.00 GiB.")):
        assert describe_error(error, "do this") == "out of memory; do this"
    assert "(unexpected" in describe_error(RuntimeError("mat1 and mat2 cannot be multiplied"))
    assert describe_error(KeyError("x")).startswith("KeyError: 'x' (unexpected")
