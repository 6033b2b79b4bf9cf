"""The documentation against the program: tables, links, commands, options, variables and code."""

from __future__ import annotations

import re
import subprocess
import sys
from functools import cache
from pathlib import Path

import pytest

from lbmc_cli.main import COMMANDS
from tests.runner import environment, in_process

HOME = Path(__file__).resolve().parents[2]
PAGES = [HOME / "README.md", *sorted((HOME / "docs").glob("*.md"))]
SCRIPTS = sorted((HOME / "examples").glob("*.sh"))

OPTION = re.compile(r"(?<![\w-])--[a-z][a-z-]+")
COMMAND_LINE = re.compile(r"^ *lbmc ([a-z-]+)(.*)$", re.MULTILINE)
LINK = re.compile(r"\[[^\]]*\]\(([^)\s]+)\)")
VARIABLE = re.compile(r"\bLBMC_[A-Z_]+\b")
PYTHON = re.compile(r"```python\n(.*?)```", re.DOTALL)
OTHER_PROGRAMS = ("pip ", "python ", "oiiotool ", "blender ", "mitsuba ", "torchrun ")


@cache
def options_of(command: str) -> frozenset[str]:
    run = in_process(command, "--help")
    assert run.code == 0, run.err
    return frozenset(OPTION.findall(run.out))


def all_options() -> set[str]:
    return set().union(*(options_of(command) for command in COMMANDS), {"--version", "--help"})


def own_text(page: Path) -> str:
    """The page without the lines that call other programs, whose options are theirs."""
    lines = page.read_text("utf-8").replace("\\\n", "").splitlines()
    return "\n".join(line for line in lines if not any(f"{name}" in line for name in OTHER_PROGRAMS))


def page_id(page: Path) -> str:
    return page.name


def test_tables_state_what_the_code_states() -> None:
    run = subprocess.run(
        [sys.executable, HOME / "docs" / "tables.py"], capture_output=True, text=True, env=environment(), cwd=HOME
    )
    assert run.returncode == 0, run.stdout + run.stderr


@pytest.mark.parametrize("page", PAGES, ids=page_id)
def test_links_lead_somewhere(page: Path) -> None:
    for target in LINK.findall(page.read_text("utf-8")):
        if "://" in target:
            continue
        path, _, anchor = target.partition("#")
        file = (page.parent / path) if path else page
        # The tests' copy of the project leaves LICENSE out; everything else that is linked is beside the pages.
        assert file.exists() or file.name == "LICENSE", target
        if anchor:
            heads = re.findall(r"^#+ (.*)$", file.read_text("utf-8"), re.MULTILINE)
            assert anchor in {re.sub(r"[^\w -]", "", head.lower()).replace(" ", "-") for head in heads}, target


@pytest.mark.parametrize("page", [*PAGES, *SCRIPTS], ids=page_id)
def test_command_lines_use_options_that_exist(page: Path) -> None:
    for command, rest in COMMAND_LINE.findall(page.read_text("utf-8")):
        assert command in COMMANDS, command
        words = rest.split("#")[0] if " #" in rest else rest
        assert set(OPTION.findall(words)) <= options_of(command), f"lbmc {command}{rest}"


@pytest.mark.parametrize("page", PAGES, ids=page_id)
def test_options_named_in_passing_exist(page: Path) -> None:
    assert set(OPTION.findall(own_text(page))) <= all_options()


@pytest.mark.parametrize("page", [*PAGES, *SCRIPTS], ids=page_id)
def test_environment_variables_stand_for_options(page: Path) -> None:
    known = {
        f"LBMC_{prefix}{option[2:].replace('-', '_').upper()}"
        for command in COMMANDS
        for option in options_of(command)
        for prefix in ("", f"{command.replace('-', '_').upper()}_")
    }
    assert set(VARIABLE.findall(page.read_text("utf-8"))) <= known


def test_every_command_is_shown_in_use_in_the_readme() -> None:
    used = {command for command, _ in COMMAND_LINE.findall((HOME / "README.md").read_text("utf-8"))}
    assert used == set(COMMANDS)


@pytest.mark.parametrize("page", [page for page in PAGES if PYTHON.search(page.read_text("utf-8"))], ids=page_id)
def test_code_in_the_pages_runs(page: Path, tmp_path: Path) -> None:
    for code in PYTHON.findall(page.read_text("utf-8")):
        run = subprocess.run(
            [sys.executable, "-c", code], capture_output=True, text=True, env=environment(), cwd=tmp_path
        )
        assert run.returncode == 0, run.stderr


def test_the_file_that_the_format_page_writes_is_a_deep_sample_file(tmp_path: Path) -> None:
    (code,) = PYTHON.findall((HOME / "docs" / "file-format.md").read_text("utf-8"))
    subprocess.run([sys.executable, "-c", code], check=True, env=environment(), cwd=tmp_path)
    run = in_process("info", tmp_path / "shot.deep.exr")
    assert run.code == 0, run.err
    assert "weighting   uniform" in run.out
    assert "lbmc:weighting" in run.out  # said by the header: a fractional alpha stops no job
