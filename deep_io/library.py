"""Pixels read by the OpenEXR library, whatever the attributes, the names and the path of the file are.

The library gives up on a file for one attribute that its Python side does not know or cannot decode, and prints what
goes wrong with pixels on standard output and, below Python, on standard error. So it gets a file in memory with bare
headers, and its words as an exception.
"""

from __future__ import annotations

import os
import re
import shutil
import sys
import tempfile
import threading
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from io import BytesIO
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from deep_io.errors import InputError
from deep_io.header import FileHeaders
from deep_io.reheading import bare_header, read_chunk_table, reheaded

_COPY_BYTES = 1 << 20
# How the library says that memory ran out. What its decoders say is less: "Unable to run decoder".
_NO_MEMORY = ("memoryerror", "bad_alloc", "out_of_memory", "out of memory")
# What the decoders of all threads take beside the pixels, rounded up: DWAB of many channels has chunks of megabytes.
_DECODER_BYTES = 64 << 20
_CORE = re.compile(rb"<python_buffer>: .*\n?")  # what the C core writes of a file in memory
_one_at_a_time = threading.Lock()  # sys.stdout is everybody's.


def read_with_library(file: BinaryIO, headers: FileHeaders, path: str) -> list[dict[str, NDArray[Any]]]:
    """All parts of the file: channel name, as in `headers`, -> (H, W) pixels, or objects with a deep pixel's samples.

    Raises InputError when the library cannot read all of them, MemoryError when it is the memory.
    """
    return decode_with_library(_bare_file(file, headers, path), headers, path)


def decode_with_library(stream: BytesIO, headers: FileHeaders, path: str) -> list[dict[str, NDArray[Any]]]:
    """As `read_with_library`, of an EXR in memory that has the parts and channels of `headers` in bare headers."""
    import OpenEXR  # 70 ms of start-up that the decoders of rows.py do not need.

    try:
        with _said() as said, _core_silenced(), OpenEXR.File(stream, separate_channels=True) as opened:
            parts = [[channel.pixels for _, channel in sorted(part.channels.items())] for part in opened.parts]
    except Exception as error:  # RuntimeError, ValueError, UnicodeDecodeError, ZeroDivisionError ...: it has no family.
        if isinstance(error, MemoryError):
            raise
        raise InputError(f"{path}: the OpenEXR library cannot read it: {' '.join(str(error).split())}") from error
    del stream
    whole = len(parts) == len(headers.parts)
    if said or not whole or any(len(mine.channels) != len(got) for mine, got in zip(headers.parts, parts, strict=True)):
        # Each line is "Warning: Exception raised reading pixel data for part 0 - Unable to ...".
        text = "; ".join(line.partition(" - ")[2] or line for line in "".join(said).splitlines())
        _raise_for_memory(headers, text, path)
        raise InputError(f"{path}: the pixels are truncated or corrupt{text and f' (OpenEXR: {text})'}")
    # Part and file order the channels by the bytes of their names, bare or not.
    return [dict(zip(mine.channel_names, got, strict=True)) for mine, got in zip(headers.parts, parts, strict=True)]


def _bare_file(file: BinaryIO, headers: FileHeaders, path: str) -> BytesIO:
    """In memory, not a stream of ours: the library swallows what signals raise while Python code of a stream runs."""
    table = read_chunk_table(file, headers, path)
    try:
        start = reheaded(headers, table, [bare_header(headers, index, path) for index in range(len(headers.parts))])
    except ValueError as error:
        raise InputError(f"{path}: {error}") from error
    stream = BytesIO()
    stream.write(start)
    try:
        file.seek(headers.end + table.nbytes)
        shutil.copyfileobj(file, stream, _COPY_BYTES)
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror or error}") from error
    stream.seek(0)
    return stream


def _raise_for_memory(headers: FileHeaders, text: str, path: str) -> None:
    """MemoryError if the library says so, or if what it needed for flat pixels is not to be had."""
    if any(words in text.lower() for words in _NO_MEMORY):
        raise MemoryError(f"{path}: {text}")
    pixels = sum(part.data_window.width * part.data_window.height * part.sample_bytes
                 for part in headers.parts if not part.is_deep)
    try:
        np.empty(pixels + _DECODER_BYTES, np.uint8)
    except MemoryError as error:
        raise MemoryError(f"{path}: {error}") from error


@contextmanager
def _said() -> Iterator[list[str]]:
    """What the calling thread prints while inside, instead of printing it; other threads print as ever."""
    with _one_at_a_time:
        stdout = sys.stdout
        listener = _Listener(stdout)
        sys.stdout = listener
        try:
            yield listener.said
        finally:
            sys.stdout = stdout


@contextmanager
def _core_silenced() -> Iterator[None]:
    """Keeps what the library's C core writes on file descriptor 2 from it; what others write meanwhile comes after."""
    with ExitStack() as stack:
        try:
            heard = stack.enter_context(tempfile.TemporaryFile())
            kept = os.dup(2)
        except OSError:  # no place for a temporary file, or no standard error: then the core speaks, or none hears it
            heard = None
        if heard is None:
            yield
            return
        stack.callback(os.close, kept)
        os.dup2(heard.fileno(), 2)
        try:
            yield
        finally:
            os.dup2(kept, 2)
            heard.seek(0)
            others = b"".join(_CORE.sub(b"", line) for line in heard)
            with suppress(OSError), open(kept, "wb", closefd=False) as stderr:
                stderr.write(others)


class _Listener:
    """Standard output with one thread's text kept back."""

    def __init__(self, stdout: Any) -> None:
        self.said: list[str] = []
        self._stdout, self._thread = stdout, threading.get_ident()

    def write(self, text: str) -> int:
        if threading.get_ident() != self._thread:
            return int(self._stdout.write(text))
        self.said.append(text)
        return len(text)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stdout, name)
