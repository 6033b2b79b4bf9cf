"""Every command test that asks for `lbmc` runs twice: in this process and as the installed program."""

from __future__ import annotations

import signal

import pytest

from tests.runner import Runner, in_process, installed


@pytest.fixture(params=[in_process, installed], ids=["in_process", "installed"])
def lbmc(request: pytest.FixtureRequest) -> Runner:
    runner: Runner = request.param
    return runner


def pytest_configure() -> None:
    """A background job of a shell ignores Ctrl-C, and so would every program that the tests start and interrupt."""
    if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
        signal.signal(signal.SIGINT, signal.default_int_handler)
