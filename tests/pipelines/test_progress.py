"""What each kind of progress writes, and where."""

from __future__ import annotations

import io

import pytest

from pipelines.progress import BarProgress, OpenjdProgress, PlainProgress, Progress, make_progress


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


class Clock:
    """A clock that moves only when told to."""

    def __init__(self) -> None:
        self.now = 0.0

    def __call__(self) -> float:
        return self.now


def run_job(progress: Progress, clock: Clock, frames: int = 2, steps: int = 4) -> None:
    with progress:
        for frame in range(frames):
            progress.begin(f"frame {1001 + frame}")
            for step in range(1, steps + 1):
                clock.now += 1.0
                progress.update(step / steps)
            progress.finish()


def test_plain_lines_rise_in_whole_percents_and_end_at_100() -> None:
    stream, clock = io.StringIO(), Clock()
    run_job(PlainProgress(2, stream, clock), clock)
    percents = [0, 12, 25, 37, 50, 62, 75, 87, 100]
    assert stream.getvalue().splitlines() == [f"Progress: {p}%" for p in percents]


def test_plain_lines_are_spared_when_updates_come_fast_but_the_last_one_comes() -> None:
    stream, clock = io.StringIO(), Clock()
    with PlainProgress(1, stream, clock) as progress:
        progress.begin("frame")
        for step in range(1000):
            progress.update(step / 1000)
        progress.finish()
    assert stream.getvalue().splitlines() == ["Progress: 0%", "Progress: 100%"]


def test_progress_never_goes_back() -> None:
    stream, clock = io.StringIO(), Clock()
    progress = PlainProgress(1, stream, clock)
    for fraction in (0.5, 0.2, 0.7):
        clock.now += 1.0
        progress.update(fraction)
    assert stream.getvalue().splitlines() == ["Progress: 50%", "Progress: 70%"]


def test_openjd_messages_are_those_its_runner_reads() -> None:
    stream, clock = io.StringIO(), Clock()
    progress = OpenjdProgress(1, stream, clock)
    progress.begin("frame 1001")
    clock.now = 1.0
    progress.update(0.5)
    progress.fail("shot.1001.exr: is\ncorrupt")
    assert stream.getvalue().splitlines() == [
        "openjd_status: frame 1001",
        "openjd_progress: 0",
        "openjd_progress: 50",
        "openjd_fail: shot.1001.exr: is corrupt",
    ]


def test_the_bar_redraws_one_line_and_wipes_it_at_the_end() -> None:
    stream, clock = Terminal(), Clock()
    run_job(BarProgress(2, stream, clock), clock)
    written = stream.getvalue()
    assert "\n" not in written
    assert "100%" in written
    assert "frame 1002" in written
    assert written.endswith("\r\x1b[K")


def test_the_bar_says_how_much_time_is_left() -> None:
    stream, clock = Terminal(), Clock()
    progress = BarProgress(1, stream, clock)
    clock.now = 100.0
    progress.update(0.01)
    assert "2:45:00" in stream.getvalue()


@pytest.mark.parametrize("kind", ["auto", "bar", "plain"])
def test_no_carriage_return_reaches_a_log(
    kind: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    clock = Clock()
    run_job(make_progress(kind, 2), clock)
    written = capsys.readouterr()
    assert "Progress: 100%" in written.err
    assert "\r" not in written.err + written.out


def test_a_terminal_gets_a_bar(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sys.stderr", Terminal())
    assert isinstance(make_progress("auto"), BarProgress)
    assert isinstance(make_progress("plain"), PlainProgress)


def test_none_is_silent_but_failures_are_still_told(capsys: pytest.CaptureFixture[str]) -> None:
    clock = Clock()
    progress = make_progress("none", 2)
    run_job(progress, clock)
    progress.fail("a.exr: broken")
    written = capsys.readouterr()
    assert written.out == ""
    assert written.err == "ERROR: a.exr: broken\n"
