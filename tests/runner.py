"""Runs `lbmc` for the tests: in this process, or as the installed program. Not a test itself."""

from __future__ import annotations

import contextlib
import io
import os
import subprocess
import sys
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

import pytest

from pipelines.rendering.backend import RendererMissingError, find_llvm

LBMC = Path(sys.executable).parent / "lbmc"


@dataclass(frozen=True)
class Finished:
    """How a run ended and what it said."""

    code: int
    out: str
    err: str


Runner = Callable[..., Finished]


def environment(extra: Mapping[str, str] | None = None) -> dict[str, str]:
    """This process's environment without what would change lbmc's behaviour, plus `extra`."""
    kept = {name: value for name, value in os.environ.items() if not name.startswith(("LBMC_", "PYTHON"))}
    return {**kept, **(extra or {})}


def installed(*arguments: object, env: Mapping[str, str] | None = None, cwd: Path | None = None) -> Finished:
    """Runs the installed `lbmc` as a user's shell would."""
    run = subprocess.run(
        [LBMC, *map(str, arguments)], capture_output=True, text=True, env=environment(env), cwd=cwd, timeout=600
    )
    return Finished(run.returncode, run.stdout, run.stderr)


def in_process(*arguments: object, env: Mapping[str, str] | None = None, cwd: Path | None = None) -> Finished:
    """Runs `lbmc_cli.main.main` here, which is faster and shows up in a debugger."""
    from lbmc_cli.main import main

    out, err = io.StringIO(), io.StringIO()
    before = dict(os.environ)
    here = Path.cwd()
    try:
        os.environ.update(env or {})
        os.chdir(cwd or here)
        with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
            code = main([str(argument) for argument in arguments])
    finally:
        os.chdir(here)
        os.environ.clear()
        os.environ.update(before)
    return Finished(code, out.getvalue(), err.getvalue())


def require_renderer() -> None:
    """Skips the module of tests that calls it where nothing can be rendered, and says why."""
    pytest.importorskip("mitsuba")
    try:
        find_llvm()
    except RendererMissingError as missing:
        pytest.skip(str(missing), allow_module_level=True)
