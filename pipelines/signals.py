"""Ctrl-C and SIGTERM end a job cleanly: both become one exception that only clean-up code sees.

The exception may be lost where Python cannot propagate it (a destructor, a callback out of a library's C++ code), so
the signal is also remembered, and jobs ask for it between frames.
"""

from __future__ import annotations

import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType

STOPPING = (signal.SIGINT, signal.SIGTERM)

_received: list[int] = []


class StoppedError(BaseException):
    """A signal asked the process to end; `number` is the signal's. Not an Exception: no frame may swallow it."""

    def __init__(self, number: int) -> None:
        super().__init__(number)
        self.number = number


@contextmanager
def stopped_by_signals() -> Iterator[None]:
    """While inside, SIGINT and SIGTERM raise StoppedError in the main thread, the first time; then they are ignored.

    A signal that the parent process had ignored (`nohup`, a shell's background job) stays ignored.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return

    def stop(number: int, frame: FrameType | None) -> None:
        if not _received:
            _received.append(number)
            raise StoppedError(number)

    heeded = [number for number in STOPPING if signal.getsignal(number) is not signal.SIG_IGN]
    before = {number: signal.signal(number, stop) for number in heeded}
    try:
        yield
        raise_if_stopped()
    finally:
        _received.clear()
        for number, handler in before.items():
            signal.signal(number, handler)


@contextmanager
def signals_noted() -> Iterator[Callable[[], int]]:
    """While inside, SIGINT and SIGTERM interrupt nothing: the function given returns the first that came, 0 for none.

    For jobs that must end between two steps; they raise StoppedError themselves once they have put things in order.
    A signal that the parent process had ignored stays ignored.
    """
    noted: list[int] = []
    if threading.current_thread() is not threading.main_thread():
        yield lambda: 0
        return

    def note(number: int, frame: FrameType | None) -> None:
        noted.append(number)

    heeded = [number for number in STOPPING if signal.getsignal(number) is not signal.SIG_IGN]
    before = {number: signal.signal(number, note) for number in heeded}
    try:
        yield lambda: noted[0] if noted else 0
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def raise_if_stopped() -> None:
    """Raises StoppedError if a signal came and its exception got lost."""
    if _received:
        raise StoppedError(_received[0])
