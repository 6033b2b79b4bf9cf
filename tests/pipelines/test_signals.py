"""Signals end jobs even where their exception gets lost."""

from __future__ import annotations

import os
import signal

import pytest

from pipelines.jobs import run_frames
from pipelines.progress import Progress
from pipelines.signals import STOPPING, StoppedError, raise_if_stopped, stopped_by_signals


@pytest.mark.parametrize("number", STOPPING)
def test_a_signal_becomes_an_exception_with_its_number(number: signal.Signals) -> None:
    with pytest.raises(StoppedError) as stopped, stopped_by_signals():
        os.kill(os.getpid(), number)
    assert stopped.value.number == number


def test_a_lost_exception_is_raised_again_after_the_frame() -> None:
    frames: list[int] = []

    def work(frame: int, progress: Progress) -> None:
        frames.append(frame)
        if frame == 2:
            # What a destructor or a C++ callback does to an exception.
            with pytest.raises(StoppedError):
                os.kill(os.getpid(), signal.SIGTERM)

    with pytest.raises(StoppedError), stopped_by_signals():
        run_frames([1, 2, 3], work, Progress(3))
    assert frames == [1, 2]


def test_a_second_signal_does_not_disturb_the_clean_up() -> None:
    cleaned: list[str] = []

    def work() -> None:
        try:
            os.kill(os.getpid(), signal.SIGINT)
        finally:
            os.kill(os.getpid(), signal.SIGTERM)
            cleaned.append("all")

    with pytest.raises(StoppedError), stopped_by_signals():
        work()
    assert cleaned == ["all"]


def test_handlers_are_put_back_and_nothing_is_remembered() -> None:
    before = [signal.getsignal(number) for number in STOPPING]
    with pytest.raises(StoppedError), stopped_by_signals():
        os.kill(os.getpid(), signal.SIGTERM)
    assert [signal.getsignal(number) for number in STOPPING] == before
    raise_if_stopped()


def test_a_signal_that_was_ignored_stays_ignored() -> None:
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        with stopped_by_signals():
            os.kill(os.getpid(), signal.SIGINT)
    finally:
        signal.signal(signal.SIGINT, before)
