"""Processes that render side by side, and that end when the one that started them does, however it ends.

A pipe tells them: its writing end is held by the parent alone, so it closes even where the parent is killed outright.
"""

from __future__ import annotations

import multiprocessing
import os
import signal
import threading
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from multiprocessing.connection import Connection

from deep_io.errors import LbmcError
from pipelines.signals import StoppedError, stopped_by_signals

GRACE = 5.0  # seconds for a stopped worker to remove its half-written file; then it ends as it is
SIGNAL_CODE = 128

Work = Callable[[int], str]


@contextmanager
def worker_pool(workers: int, work: Work, seeds: Iterable[int]) -> Iterator[Work]:
    """`work` as a function whose results for `seeds` are already being made by `workers` processes, at most one a seed.

    `work` and its results must be picklable. It raises what `work` raised, and LbmcError when a worker was killed.
    When the block is left by an exception, StoppedError included, the workers stop at once and leave no part of a file.
    """
    # Spawned, not forked: Dr.Jit's threads do not survive a fork.
    context = multiprocessing.get_context("spawn")
    listening, alive = context.Pipe(duplex=False)
    pool = ProcessPoolExecutor(workers, context, _end_with_parent, (listening,))
    try:
        with _ctrl_c_blocked(), _killed_workers_told():
            futures: dict[int, Future[str]] = {seed: pool.submit(_work_until_stopped, work, seed) for seed in seeds}
            # The pool learns which workers to watch when something is submitted or done. The last submission may have
            # started a worker, whose death would go unnoticed until another one's work is done.
            pool.submit(_nothing)

        def result(seed: int) -> str:
            with _killed_workers_told():
                return futures[seed].result()

        yield result
    except BaseException:
        alive.close()
        raise
    finally:
        pool.shutdown(wait=True, cancel_futures=True)
        alive.close()
        listening.close()


@contextmanager
def _killed_workers_told() -> Iterator[None]:
    try:
        yield
    except BrokenProcessPool as broken:
        raise LbmcError("a worker process was killed, perhaps for want of memory; run the same command again to go on, "
                        "with fewer --workers") from broken


@contextmanager
def _ctrl_c_blocked() -> Iterator[None]:
    """Processes started inside never see Ctrl-C, which a terminal sends to all: the parent tells them to stop."""
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def _end_with_parent(listening: Connection) -> None:
    """Runs in each worker as it starts."""
    threading.Thread(target=_wait_for_the_end, args=(listening,), daemon=True).start()


def _wait_for_the_end(listening: Connection) -> None:
    # Nothing is ever sent: the pipe becomes readable when its other end closes.
    listening.poll(None)
    os.kill(os.getpid(), signal.SIGTERM)
    threading.Event().wait(GRACE)
    os._exit(SIGNAL_CODE + signal.SIGTERM)


def _nothing() -> None:
    pass


def _work_until_stopped(work: Work, seed: int) -> str:
    """`work(seed)` in a worker. A signal ends it in order, and the process with it: the pool would go on otherwise."""
    try:
        with stopped_by_signals():
            return work(seed)
    except StoppedError as stopped:
        os._exit(SIGNAL_CODE + stopped.number)
