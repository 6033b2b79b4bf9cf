"""Every command test that asks for `lbmc` runs twice: in this process and as the installed program."""

from __future__ import annotations

import pytest

from tests.runner import Runner, in_process, installed


@pytest.fixture(params=[in_process, installed], ids=["in_process", "installed"])
def lbmc(request: pytest.FixtureRequest) -> Runner:
    runner: Runner = request.param
    return runner
