"""`lbmc render` with workers, as a user runs it: what ends the command ends them, too, and leaves no part of a file."""

from __future__ import annotations

import os
import signal
import subprocess
import time
from collections.abc import Callable
from pathlib import Path

import pytest

from tests.runner import LBMC, environment, require_renderer

require_renderer()

TINY = ("--layout", "tabletop", "--size", 16, "--samples", 2, "--no-motion", "--workers", 2, "--threads", 1,
        "--progress", "none")
QUICK, ENDLESS = ("--reference", 2), ("--reference", 2_000_000)
PATIENCE = 300.0  # seconds for what takes a few, on a busy machine

pytestmark = pytest.mark.skipif(not Path("/proc/self/task").is_dir(), reason="finds processes in /proc")


def workers_of(parent: int) -> set[int]:
    """The processes that render: spawned Pythons, without multiprocessing's book-keeper."""
    children = Path(f"/proc/{parent}/task/{parent}/children").read_text().split()
    return {int(child) for child in children if b"spawn_main" in Path(f"/proc/{child}/cmdline").read_bytes()}


def state(process: int) -> list[str]:
    """The fields of /proc/PID/stat from the state on; empty once the process is gone."""
    try:
        return Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()
    except (FileNotFoundError, ProcessLookupError):
        return []


def runs(process: int) -> bool:
    return bool(state(process)) and state(process)[0] not in "ZX"


def cpu_ticks(process: int) -> int:
    return sum(map(int, state(process)[11:13]))


def wait_until(condition: Callable[[], bool], what: str) -> None:
    deadline = time.monotonic() + PATIENCE
    while not condition():
        assert time.monotonic() < deadline, f"waited in vain until {what}"
        time.sleep(0.05)


def started(out: Path, *more: object) -> tuple[subprocess.Popen[str], set[int]]:
    """The command under way, and its two workers."""
    words = [LBMC, "render", out, "--count", 40, *TINY, *more]
    process = subprocess.Popen([str(word) for word in words], stderr=subprocess.PIPE, text=True, env=environment())
    found: set[int] = set()

    def both() -> bool:
        found.update(workers_of(process.pid))
        return len(found) == 2

    wait_until(both, "two workers had started")
    return process, found


@pytest.mark.parametrize(("number", "code", "words"), [
    (signal.SIGTERM, 143, "ERROR: terminated\n"), (signal.SIGINT, 130, "ERROR: interrupted\n")])
def test_a_signal_ends_the_workers_within_their_scenes(number: int, code: int, words: str, tmp_path: Path) -> None:
    process, workers = started(tmp_path, *ENDLESS)
    # So much CPU time is enough to have imported all and to be at work on a scene that takes many minutes.
    wait_until(lambda: all(cpu_ticks(worker) > 150 for worker in workers), "the workers were at work")
    process.send_signal(number)
    _, err = process.communicate(timeout=PATIENCE)
    assert (process.returncode, err) == (code, words)
    assert not any(runs(worker) for worker in workers), "the command waits for its workers"
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("at_work", [False, True], ids=["as they start", "at work"])
def test_workers_end_when_the_command_is_killed(at_work: bool, tmp_path: Path) -> None:
    process, workers = started(tmp_path, *QUICK)
    if at_work:
        wait_until(lambda: any(tmp_path.glob("*.json")), "a scene was there")
    process.kill()
    process.wait()
    wait_until(lambda: not any(runs(worker) for worker in workers), "the workers had ended")
    if at_work:
        assert len(list(tmp_path.glob("*.json"))) < 40
    assert not list(tmp_path.glob(".*")), "no half-written file"


@pytest.mark.parametrize("more", [QUICK, (*ENDLESS, "--count", 2)], ids=["at work", "as it starts"])
def test_a_killed_worker_is_told_with_the_cure(more: tuple[object, ...], tmp_path: Path) -> None:
    process, workers = started(tmp_path, *more)
    if more == QUICK:
        wait_until(lambda: any(tmp_path.glob("*.json")), "a scene was there")
    os.kill(workers.pop(), signal.SIGKILL)
    _, err = process.communicate(timeout=PATIENCE)
    assert process.returncode == 1
    assert err.startswith("ERROR: a worker process was killed")
    assert "fewer --workers" in err
    assert not any(runs(worker) for worker in workers)
