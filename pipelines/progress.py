"""How a running job tells where it is: one interface, four voices (bar, plain, openjd, none).

A job counts units (frames, scenes, epochs) and says how much of the current one is done. A bar redraws its line and so
is only ever drawn on a terminal; everything that may end in a log is written as whole, flushed lines.
"""

from __future__ import annotations

import shutil
import sys
import time
from collections.abc import Callable
from types import TracebackType
from typing import Literal, Self, TextIO

ProgressKind = Literal["auto", "bar", "plain", "openjd", "none"]

SECONDS_BETWEEN_LINES = 0.5
"""Least time between two plain lines: often enough for a farm's watchdog, seldom enough for a reader."""
SECONDS_BETWEEN_REDRAWS = 0.05


class Progress:
    """Counts units of work and reports the whole job's fraction; this base class keeps the count and stays silent.

    Use as a context manager, or call `close` when the job ends, however it ends. `total` is the number of units;
    `begin(label)` starts the next unit, `update(fraction)` says how much of it is done (0 to 1), `finish()` ends it.
    """

    def __init__(self, total: int = 1) -> None:
        self.total = max(total, 1)
        self.finished = 0
        self.label = ""
        self.fraction = 0.0

    def begin(self, label: str) -> None:
        """Starts the next unit; `label` names it for a reader (a frame number, a file)."""
        self.label = _one_line(label)
        self.fraction = 0.0
        self._show(forced=False)

    def update(self, fraction: float) -> None:
        """Says that `fraction` (0 to 1) of the current unit is done; never goes backwards."""
        self.fraction = max(self.fraction, min(fraction, 1.0))
        self._show(forced=False)

    def finish(self) -> None:
        """Ends the current unit, whether it succeeded or not."""
        self.finished = min(self.finished + 1, self.total)
        self.fraction = 0.0
        self._show(forced=self.finished == self.total)

    def note(self, text: str) -> None:
        """Tells the reader something that is not a failure: one line on stderr, past any bar."""
        print(_one_line(text), file=sys.stderr, flush=True)

    def fail(self, text: str) -> None:
        """Tells the reader, and the farm where it listens, that a unit failed: one line starting `ERROR:`."""
        self.note(f"ERROR: {text}")

    def close(self) -> None:
        """Leaves the terminal in order. Further calls do nothing."""

    @property
    def done(self) -> float:
        """Fraction of the whole job that is done, 0 to 1."""
        return min((self.finished + self.fraction) / self.total, 1.0)

    def _show(self, *, forced: bool) -> None:
        pass

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()


class PlainProgress(Progress):
    """`Progress: 42%` lines, whole percents, flushed, at most one in SECONDS_BETWEEN_LINES; the last one is 100 %."""

    def __init__(
        self, total: int = 1, stream: TextIO | None = None, clock: Callable[[], float] = time.monotonic
    ) -> None:
        super().__init__(total)
        self._stream = stream if stream is not None else sys.stderr
        self._clock = clock
        self._shown = -1
        self._next = clock()

    def _show(self, *, forced: bool) -> None:
        percent = int(100.0 * self.done)
        if percent == self._shown or (self._clock() < self._next and not forced):
            return
        self._shown = percent
        self._next = self._clock() + SECONDS_BETWEEN_LINES
        print(self._line(percent), file=self._stream, flush=True)

    def _line(self, percent: int) -> str:
        return f"Progress: {percent}%"


class OpenjdProgress(PlainProgress):
    """Open Job Description messages, which its runner reads from standard output."""

    def __init__(
        self, total: int = 1, stream: TextIO | None = None, clock: Callable[[], float] = time.monotonic
    ) -> None:
        super().__init__(total, stream if stream is not None else sys.stdout, clock)

    def begin(self, label: str) -> None:
        print(f"openjd_status: {_one_line(label)}", file=self._stream, flush=True)
        super().begin(label)

    def fail(self, text: str) -> None:
        print(f"openjd_fail: {_one_line(text)}", file=self._stream, flush=True)
        super().fail(text)

    def _line(self, percent: int) -> str:
        return f"openjd_progress: {percent}"


class BarProgress(Progress):
    """One line of a terminal, redrawn: label, bar, percent, and the time left once it can be guessed."""

    BAR_COLUMNS = 30

    def __init__(
        self, total: int = 1, stream: TextIO | None = None, clock: Callable[[], float] = time.monotonic
    ) -> None:
        super().__init__(total)
        self._stream = stream if stream is not None else sys.stderr
        self._clock = clock
        self._started = clock()
        self._next = self._started
        self._drawn = False

    def note(self, text: str) -> None:
        self._wipe()
        super().note(text)
        self._show(forced=True)

    def close(self) -> None:
        self._wipe()

    def _show(self, *, forced: bool) -> None:
        now = self._clock()
        if now < self._next and not forced:
            return
        self._next = now + SECONDS_BETWEEN_REDRAWS
        filled = int(self.BAR_COLUMNS * self.done)
        bar = "█" * filled + "░" * (self.BAR_COLUMNS - filled)
        unit = f"{min(self.finished + 1, self.total)}/{self.total}"
        line = f"{bar} {int(100 * self.done):3d}%  {unit}  {self._left(now)}  {self.label}"
        columns = shutil.get_terminal_size().columns
        self._stream.write(f"\r\x1b[K{line[: columns - 1]}")
        self._stream.flush()
        self._drawn = True

    def _left(self, now: float) -> str:
        if self.done <= 0.0:
            return "--:--"
        left = round((now - self._started) * (1.0 - self.done) / self.done)
        hours, seconds = divmod(left, 3600)
        minutes, seconds = divmod(seconds, 60)
        return f"{hours:d}:{minutes:02d}:{seconds:02d}" if hours else f"{minutes:02d}:{seconds:02d}"

    def _wipe(self) -> None:
        if self._drawn:
            self._stream.write("\r\x1b[K")
            self._stream.flush()
            self._drawn = False


def make_progress(kind: ProgressKind = "auto", total: int = 1) -> Progress:
    """The progress reporter for `kind`.

    `auto` is a bar where stderr is a terminal and plain lines elsewhere. `bar` asked for without a terminal also gives
    plain lines: a carriage return never reaches a log.
    """
    if kind in ("auto", "bar"):
        kind = "bar" if sys.stderr.isatty() else "plain"
    if kind == "none":
        return Progress(total)
    reporters: dict[str, Callable[[int], Progress]] = {
        "bar": BarProgress,
        "plain": PlainProgress,
        "openjd": OpenjdProgress,
    }
    return reporters[kind](total)


def _one_line(text: str) -> str:
    return " ".join(text.split())
