"""The frame of the command line: help, version, exit codes, error lines, shadowed packages, signals, start-up."""

from __future__ import annotations

import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from lbmc_cli.main import COMMANDS
from pipelines import __version__
from tests.runner import LBMC, Runner, environment, in_process, installed


@pytest.mark.parametrize("flag", ["--help", "-h"])
def test_help_lists_every_command_and_ends_with_0(lbmc: Runner, flag: str) -> None:
    run = lbmc(flag)
    assert run.code == 0
    assert run.err == ""
    for name in COMMANDS:
        assert f"\n  {name} " in run.out


@pytest.mark.parametrize("name", COMMANDS)
def test_every_command_explains_itself(name: str) -> None:
    run = in_process(name, "--help")
    assert run.code == 0
    assert f"Usage: lbmc {name}" in run.out
    assert "--debug" in run.out


def test_version(lbmc: Runner) -> None:
    assert lbmc("--version").out == f"lbmc {__version__}\n"


def test_no_command_shows_the_help_as_a_usage_error(lbmc: Runner) -> None:
    run = lbmc()
    assert run.code == 2
    assert "Usage: lbmc" in run.err


@pytest.mark.parametrize(
    "arguments",
    [["nonsense"], ["denoise"], ["denoise", "a", "b", "--nonsense"], ["denoise", "a", "b", "--layers", "6"]],
)
def test_wrong_usage_is_one_line_and_exit_code_2(lbmc: Runner, arguments: list[str]) -> None:
    run = lbmc(*arguments)
    assert run.code == 2
    assert run.out == ""
    assert run.err.startswith("ERROR: ")
    assert run.err.count("\n") == 1


def test_help_imports_nothing_heavy() -> None:
    heavy = ("torch", "numpy", "OpenEXR", "OpenImageIO", "matplotlib", "mitsuba", "deep_io", "model")
    code = f"""
import sys
from lbmc_cli.main import main
for words in (["--help"], ["--version"], *([name, "--help"] for name in {list(COMMANDS)!r})):
    assert main(words) == 0
print([name for name in {heavy!r} if name in sys.modules], file=sys.stderr)
"""
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, env=environment(), check=True)
    assert run.stderr == "[]\n"


@pytest.mark.parametrize("package", ["model", "pipelines", "deep_io"])
def test_another_package_of_our_name_on_pythonpath_is_named(package: str, tmp_path: Path) -> None:
    (tmp_path / package).mkdir()
    (tmp_path / package / "__init__.py").write_text("")
    run = installed("info", "x.exr", env={"PYTHONPATH": str(tmp_path)})
    assert run.code == 1
    assert run.err.startswith("ERROR: lbmc needs its own package")
    assert str(tmp_path / package) in run.err
    assert "PYTHONPATH" in run.err
    assert run.err.count("\n") == 1


def test_a_module_file_of_our_name_is_named_too(tmp_path: Path) -> None:
    (tmp_path / "model.py").write_text("")
    run = installed("info", "x.exr", env={"PYTHONPATH": str(tmp_path)})
    assert run.code == 1
    assert str(tmp_path / "model.py") in run.err


SLEEPER = """
import sys, time
import click
from lbmc_cli import main as program

@click.command()
def info():
    try:
        print("started", flush=True)
        time.sleep(60)
    finally:
        print("cleaned up", flush=True)

program.LazyGroup.get_command = lambda self, context, name: info
sys.exit(program.main(["info"]))
"""


@pytest.mark.parametrize(
    ("number", "code", "word"), [(signal.SIGINT, 130, "interrupted"), (signal.SIGTERM, 143, "terminated")]
)
def test_signals_clean_up_and_end_with_their_code(number: signal.Signals, code: int, word: str) -> None:
    with subprocess.Popen(
        [sys.executable, "-c", SLEEPER], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=environment()
    ) as process:
        assert process.stdout is not None
        assert process.stdout.readline() == "started\n"
        time.sleep(0.05)
        process.send_signal(number)
        out, err = process.communicate(timeout=30)
    assert process.returncode == code
    assert out == "cleaned up\n"
    assert err.strip() == f"ERROR: {word}"


def test_a_reader_that_leaves_early_is_no_crash() -> None:
    process = subprocess.Popen([LBMC, "--help"], stdout=subprocess.PIPE, stderr=subprocess.PIPE, env=environment())
    assert process.stdout is not None
    assert process.stderr is not None
    process.stdout.close()
    assert b"Traceback" not in process.stderr.read()
    process.stderr.close()
    process.wait(timeout=30)
