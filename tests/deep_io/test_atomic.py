"""Outputs appear whole or not at all, and never onto an input."""

from __future__ import annotations

import errno
import os
import re
import signal
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest

from deep_io.atomic import Inputs, atomic_output, output_action
from deep_io.errors import InputError, OutputError, UsageError
from deep_io.flat import write_flat


def test_the_output_appears_at_the_end_with_the_permissions_of_the_umask(tmp_path):
    target = tmp_path / "out.exr"
    with atomic_output(target) as temporary:
        temporary.write_bytes(b"whole")
        assert not target.exists()
        assert temporary.parent == tmp_path
        assert temporary.suffix == ".exr"
    assert target.read_bytes() == b"whole"
    assert os.listdir(tmp_path) == ["out.exr"]
    umask = os.umask(0)
    os.umask(umask)
    assert target.stat().st_mode & 0o777 == 0o666 & ~umask


def test_the_permissions_of_a_replaced_file_are_kept(tmp_path):
    target = tmp_path / "out.exr"
    target.write_bytes(b"old")
    target.chmod(0o640)
    with atomic_output(target) as temporary:
        temporary.write_bytes(b"new")
    assert target.read_bytes() == b"new"
    assert target.stat().st_mode & 0o777 == 0o640


@pytest.mark.parametrize("name", ["x" * 251 + ".exr", "ä" * 125 + ".exr", "b\udcffd.exr", "100% of #1.exr"])
def test_every_name_that_the_file_system_takes_can_be_written_through_every_library(tmp_path, name):
    with atomic_output(tmp_path / name) as temporary:
        write_flat(temporary, {"R": np.zeros((2, 2), np.float16)})
    assert os.listdir(tmp_path) == [name]


@pytest.mark.parametrize("error", [ValueError, KeyboardInterrupt, SystemExit])
def test_an_exception_removes_the_temporary_file_and_keeps_the_old_output(tmp_path, error):
    target = tmp_path / "out.exr"
    target.write_bytes(b"old")

    def fail() -> None:
        with atomic_output(target) as temporary:
            temporary.write_bytes(b"half")
            raise error

    with pytest.raises(error):
        fail()
    assert target.read_bytes() == b"old"
    assert os.listdir(tmp_path) == ["out.exr"]


@pytest.mark.parametrize("named", [False, True])
def test_an_error_of_the_disk_names_the_output_and_not_the_temporary_file(tmp_path, named):
    target = tmp_path / "out.exr"

    def fail() -> None:
        with atomic_output(target) as temporary:
            temporary.write_bytes(b"half")
            raise OSError(f"{temporary}: no space") if named else OSError(errno.ENOSPC, "no space")

    with pytest.raises(OutputError) as caught:
        fail()
    assert str(caught.value) == f"{target}: cannot be written: no space"
    assert os.listdir(tmp_path) == []


def test_an_exception_before_anything_was_written_is_passed_on(tmp_path):
    with pytest.raises(ZeroDivisionError), atomic_output(tmp_path / "out.exr"):
        raise ZeroDivisionError
    assert os.listdir(tmp_path) == []


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_signals_that_raise_leave_no_temporary_file(tmp_path, number):
    script = (
        "import signal, sys, time\n"
        "from deep_io.atomic import atomic_output\n"
        "def terminate(number, frame):\n"
        "    raise SystemExit(128 + number)\n"
        "signal.signal(signal.SIGTERM, terminate)\n"
        "signal.signal(signal.SIGINT, terminate)\n"
        "with atomic_output(sys.argv[1]) as temporary:\n"
        "    temporary.write_bytes(b'half')\n"
        "    print('written', flush=True)\n"
        "    time.sleep(60)\n"
    )
    root = Path(__file__).parents[2]
    with subprocess.Popen([sys.executable, "-c", script, str(tmp_path / "out.exr")], stdout=subprocess.PIPE,
                          cwd=root) as process:
        assert process.stdout is not None
        assert process.stdout.readline() == b"written\n"
        assert len(os.listdir(tmp_path)) == 1
        process.send_signal(number)
        assert process.wait(30) == 128 + number
    assert os.listdir(tmp_path) == []


def test_an_existing_output_is_refused_skipped_or_replaced(tmp_path):
    target = tmp_path / "out.exr"
    assert output_action(target)
    target.write_bytes(b"old")
    with pytest.raises(UsageError, match=r"out\.exr: exists; pass --overwrite.*--skip-existing"):
        output_action(target)
    assert not output_action(target, existing="skip")
    assert output_action(target, existing="overwrite")


@pytest.mark.parametrize("link", [None, os.link, os.symlink])
def test_an_output_is_never_an_input_whatever_the_options(tmp_path, link):
    source = tmp_path / "in.exr"
    source.write_bytes(b"precious")
    target = tmp_path / "sub" / ".." / "in.exr"
    (tmp_path / "sub").mkdir()
    if link is not None:
        target = tmp_path / "alias.exr"
        link(source, target)
    inputs = [tmp_path / "other.exr", source, tmp_path / "third.exr"]
    for existing in ("refuse", "overwrite", "skip"):
        for known in (inputs, Inputs(inputs)):
            with pytest.raises(UsageError, match=rf"is the input {re.escape(str(source))} itself"):
                output_action(target, known, existing)


@pytest.mark.parametrize("link", [None, os.link, os.symlink])
def test_inputs_that_were_looked_up_once_serve_every_output_of_a_job(tmp_path, link):
    sources = [tmp_path / f"in.{number}.exr" for number in range(20)]
    for source in sources:
        source.write_bytes(source.name.encode())
    inputs = Inputs(iter(sources))
    for number, source in enumerate(sources):
        name = source
        if link is not None:
            name = tmp_path / f"alias.{number}.exr"
            link(source, name)
        assert inputs.same_as(name) == str(source)
        assert inputs.same_as(tmp_path / f"out.{number}.exr") is None
        assert output_action(tmp_path / f"out.{number}.exr", inputs)


def test_a_link_to_a_file_that_is_not_there_is_that_input_all_the_same(tmp_path):
    os.symlink(tmp_path / "later.exr", tmp_path / "alias.exr")
    with pytest.raises(UsageError, match="is the input"):
        output_action(tmp_path / "alias.exr", [tmp_path / "later.exr"])


@contextmanager
def protected_folder() -> Iterator[Path]:
    """A folder that this process may read and not write, also where the tests are run by root, who writes anywhere."""
    nobody = 65534
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        (folder / "there.exr").write_bytes(b"old")
        folder.chmod(0o555)
        root = os.geteuid() == 0
        if root:
            os.setresuid(nobody, nobody, 0)
        try:
            yield folder
        finally:
            if root:
                os.setresuid(0, 0, 0)
            folder.chmod(0o755)


def test_an_output_to_be_left_as_it_is_may_lie_in_a_folder_that_cannot_be_written():
    with protected_folder() as folder:
        assert not output_action(folder / "there.exr", existing="skip")
        for name, existing in (("there.exr", "overwrite"), ("there.exr", "refuse"), ("new.exr", "skip")):
            with pytest.raises(InputError, match="cannot be written to"):
                output_action(folder / name, existing=existing)


def test_a_missing_folder_is_an_unsuitable_input_and_a_folder_is_no_file(tmp_path):
    with pytest.raises(InputError, match="does not exist; make it first"):
        output_action(tmp_path / "absent" / "out.exr")
    with pytest.raises(UsageError, match="is a folder"):
        output_action(tmp_path, existing="overwrite")
    with pytest.raises(InputError), atomic_output(tmp_path / "absent" / "out.exr"):
        pass
    assert os.listdir(tmp_path) == []
