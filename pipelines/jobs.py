"""Runs the frames of a job one after another: what fails is collected, the others still run, all are timed.

What a frame means is the caller's: this module knows order, failures, exit codes and timings only.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Generic, TypeVar

from deep_io.errors import LbmcError
from pipelines.progress import Progress
from pipelines.signals import raise_if_stopped

EXIT_OK = 0
EXIT_SOME_FAILED = 1
MORE_MEMORY = "run on a machine with more"
NO_MEMORY = ("can't allocate memory", "out of memory")  # in the RuntimeErrors of torch, on a CPU and on a GPU

Frame = TypeVar("Frame")
Value = TypeVar("Value")


class FrameSkippedError(Exception):
    """Raised by a frame's work when there is nothing to do (its output exists and may stay); not a failure."""


@dataclass(frozen=True)
class FrameResult(Generic[Value]):
    """How one frame went. Exactly one of `value`, `error` and `skipped` says so."""

    label: str
    seconds: float
    """Wall time."""
    cpu_seconds: float
    """CPU time of the whole process, all threads, while the frame ran."""
    value: Value | None = None
    error: Exception | None = None
    skipped: str | None = None
    """Why the frame was skipped."""
    told: str = ""
    """What a reader was told of the error."""

    @property
    def exit_code(self) -> int:
        """0, the error's own code, or 1 for an error that is not ours."""
        if self.error is None:
            return EXIT_OK
        return self.error.exit_code if isinstance(self.error, LbmcError) else EXIT_SOME_FAILED


@dataclass(frozen=True)
class JobReport(Generic[Value]):
    """How all frames went, in their order."""

    frames: tuple[FrameResult[Value], ...]
    cpu_known: bool = True
    """Whether the CPU seconds are the frames' own; those of other processes are not known."""
    left_out: Mapping[str, str] = field(default_factory=dict)
    """Label of each frame that could not be tried -> why; as good as failed."""

    @property
    def failed(self) -> tuple[FrameResult[Value], ...]:
        return tuple(frame for frame in self.frames if frame.error is not None)

    @property
    def values(self) -> tuple[Value, ...]:
        """What the frames that succeeded gave."""
        return tuple(frame.value for frame in self.frames if frame.value is not None)

    @property
    def exit_code(self) -> int:
        """0 if no frame failed or was left out; the common code if every frame failed for one reason; else 1."""
        codes = {frame.exit_code for frame in self.frames}
        if not self.failed:
            return EXIT_SOME_FAILED if self.left_out else EXIT_OK
        return codes.pop() if len(codes) == 1 else EXIT_SOME_FAILED

    def summary(self) -> str:
        """One line: how many frames were done, skipped, left out and failed, and what a frame took."""
        done = [frame for frame in self.frames if frame.error is None and frame.skipped is None]
        skipped = len(self.frames) - len(done) - len(self.failed)
        total = len(self.frames) + len(self.left_out)
        words = [f"{len(done)} of {total} {'frame' if total == 1 else 'frames'} done"]
        if skipped:
            words.append(f"{skipped} skipped")
        if self.left_out:
            words.append(f"{len(self.left_out)} left out")
        if self.failed:
            words.append(f"{len(self.failed)} failed")
        if done:
            wall = sum(frame.seconds for frame in done) / len(done)
            cpu = sum(frame.cpu_seconds for frame in done) / len(done)
            words.append(f"{wall:.2f} s a frame" + (f" ({cpu:.2f} CPU s)" if self.cpu_known else ""))
        return ", ".join(words)


def run_frames(
    frames: Sequence[Frame],
    work: Callable[[Frame, Progress], Value],
    progress: Progress,
    label: Callable[[Frame], str] = str,
    here: bool = True,
    cure: str = MORE_MEMORY,
) -> JobReport[Value]:
    """Calls `work(frame, progress)` for every frame in order and returns how each went.

    `work` may call `progress.update` and `progress.note`; begin and finish happen here. An exception fails its frame
    only: it is told at once through `progress.fail` and kept in the report. FrameSkippedError skips the frame.
    KeyboardInterrupt, StoppedError and other BaseExceptions end the job, and so does a BrokenPipeError: nobody reads
    what the job says. `here`: the work is done by this process, so that its CPU seconds are those of the frame. `cure`:
    what to do where memory runs out, see `describe_error`.
    """
    results: list[FrameResult[Value]] = []
    for frame in frames:
        name = label(frame)
        progress.begin(name)
        wall, cpu = time.perf_counter(), time.process_time()
        value: Value | None = None
        error: Exception | None = None
        skipped: str | None = None
        told = ""
        try:
            value = work(frame, progress)
        except FrameSkippedError as reason:
            skipped = str(reason)
            progress.note(f"{name}: skipped, {reason}")
        except BrokenPipeError:
            raise
        except Exception as failure:
            error, told = failure, describe_error(failure, cure)
            progress.fail(told)
        seconds, cpu_seconds = time.perf_counter() - wall, time.process_time() - cpu
        results.append(FrameResult(name, seconds, cpu_seconds, value, error, skipped, told))
        progress.finish()
        raise_if_stopped()
    return JobReport(tuple(results), here)


def describe_error(error: BaseException, cure: str = MORE_MEMORY) -> str:
    """One line for a reader. Errors that are not ours name their type, since their text alone rarely says enough.

    `cure` is what the reader can do where memory ran out.
    """
    text = " ".join(str(error).split())
    if isinstance(error, LbmcError):
        return text
    if isinstance(error, OSError) and error.strerror:
        return f"{error.filename}: {error.strerror}" if error.filename else error.strerror
    if isinstance(error, MemoryError):
        return f"out of memory{': ' + text if text else ''}; {cure}"
    if isinstance(error, RuntimeError) and any(words in text.lower() for words in NO_MEMORY):
        return f"out of memory; {cure}"
    return f"{type(error).__name__}: {text} (unexpected; --debug shows where)"
