"""What stops the OpenEXR library does not stop lbmc: odd attributes, names and paths, and its own way to report."""

from __future__ import annotations

import os
import struct
import subprocess
import sys
import threading
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

import numpy as np
import OpenEXR
import OpenImageIO as oiio
import pytest

from deep_io import DeepReader, Window, library
from deep_io.attributes import Attribute
from deep_io.chunks import chunk_count
from deep_io.errors import InputError
from deep_io.flat import FlatImage, read_flat, read_flat_parts, write_flat, write_flat_parts
from deep_io.header import Header, parse_headers, read_headers
from deep_io.library import _core_silenced, _said
from deep_io.reheading import read_chunk_table, reheaded
from tests.deep_io.deep_files import openexr_part, random_samples, write_openexr

MULLER = "Müller".encode("latin-1")
ODD = {
    "Latin-1 string": Attribute("string", MULLER),
    "Latin-1 strings": Attribute("stringvector", struct.pack("<i", len(MULLER)) + MULLER),
    "rational 0/0": Attribute("rational", bytes(8)),
    "key code of zeros": Attribute("keycode", bytes(28)),
    "unknown to the binding": Attribute("deepImageState", b"\1"),
    "senseless manifest": Attribute("idmanifest", b"\1\0\0\0" * 4),
}


def picture(height: int = 37, width: int = 21, names: str = "RGB", seed: int = 0) -> dict[str, np.ndarray]:
    rng = np.random.default_rng(seed)
    return {name: rng.exponential(1, (height, width)).astype(np.float16) for name in names}


def write_tiled(path: Path, channels: dict[str, np.ndarray], mode: OpenEXR.LevelMode = OpenEXR.LevelMode.ONE_LEVEL,
                rounding: OpenEXR.LevelRoundingMode = OpenEXR.LevelRoundingMode.ROUND_DOWN) -> None:
    tiles = OpenEXR.TileDescription()
    tiles.xSize, tiles.ySize, tiles.mode, tiles.roundingMode = 8, 4, mode, rounding
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.tiledimage, "tiles": tiles}
    with OpenEXR.File(header, dict(channels)) as file:
        file.write(str(path))


def change(path: Path, **changes: dict[str, Attribute]) -> None:
    """Give the one part of a file other attributes or structure."""
    with path.open("rb") as file:
        headers = parse_headers(file, "")
        table = read_chunk_table(file, headers, "")
        chunks = file.read()
    (part,) = headers.parts
    part = replace(part, **{field: {**getattr(part, field), **values} for field, values in changes.items()})
    path.write_bytes(reheaded(headers, table, [part]) + chunks)


@pytest.mark.parametrize("odd", ODD.values(), ids=ODD)
@pytest.mark.parametrize("tiled", [False, True])
def test_no_attribute_keeps_a_flat_file_from_being_read(tmp_path, odd, tiled):
    path, channels = tmp_path / "flat.exr", picture()
    (write_tiled if tiled else write_flat)(path, channels)
    change(path, attributes={"odd": odd, "d\udcfcrer": odd})
    image = read_flat(path)
    for name, pixels in channels.items():
        np.testing.assert_array_equal(image.channels[name], pixels)
    assert image.header.attributes["odd"] == image.header.attributes["d\udcfcrer"] == odd


@pytest.mark.parametrize("compression", ["zip", "dwaa"])
def test_channels_and_parts_may_have_latin_1_names(tmp_path, compression):
    path = tmp_path / "flat.exr"
    channels = {f"{layer}{name}": pixels for seed, layer in enumerate(("", "lixht.", "Z"))
                for name, pixels in picture(names="RGBA", seed=seed).items()}
    write_flat_parts(path, [FlatImage.of(channels, name="paxt"), FlatImage.of(channels, name="other")], compression)
    plain = read_flat(path).channels
    path.write_bytes(path.read_bytes().replace(b"lixht.", b"li\xfcht.").replace(b"paxt", b"pa\xfct"))
    first, second = read_flat_parts(path)
    assert first.header.name == "pa\udcfct"
    for image in (first, second):
        assert sorted(image.channels) == sorted(name.replace("lix", "li\udcfc") for name in channels)
        for name, pixels in plain.items():
            np.testing.assert_array_equal(image.channels[name.replace("lix", "li\udcfc")], pixels)


def test_a_path_may_be_latin_1(tmp_path):
    path = os.fsdecode(os.fsencode(tmp_path) + b"/f\xfc.exr")
    write_flat(tmp_path / "flat.exr", picture())
    try:
        os.rename(tmp_path / "flat.exr", path)
    except OSError:
        pytest.skip("the file system takes only UTF-8")
    np.testing.assert_array_equal(read_flat(path).channels["R"], picture()["R"])


@pytest.mark.parametrize("mode", [OpenEXR.LevelMode.ONE_LEVEL, OpenEXR.LevelMode.MIPMAP_LEVELS,
                                  OpenEXR.LevelMode.RIPMAP_LEVELS])
@pytest.mark.parametrize("rounding", [OpenEXR.LevelRoundingMode.ROUND_DOWN, OpenEXR.LevelRoundingMode.ROUND_UP])
@pytest.mark.parametrize("size", [(37, 100), (1, 9), (64, 64), (1, 1)])
def test_tiles_of_all_levels_are_counted(tmp_path, mode, rounding, size):
    """The first tile lies right behind the chunk table."""
    path = tmp_path / "tiled.exr"
    write_tiled(path, picture(*size), mode, rounding)
    with path.open("rb") as file:
        headers = parse_headers(file, "")
        offsets = read_chunk_table(file, headers, "")
    assert offsets[offsets > 0].min() == headers.end + 8 * chunk_count(headers.parts[0], "")


def test_a_mipmap_is_read(tmp_path):
    path, pixels = tmp_path / "mip.exr", np.random.default_rng(0).random((37, 100, 3)).astype(np.float32)
    buffer = oiio.ImageBuf(oiio.ImageSpec(100, 37, 3, oiio.FLOAT))
    buffer.set_pixels(oiio.ROI(0, 100, 0, 37), pixels)
    assert oiio.ImageBufAlgo.make_texture(oiio.MakeTxTexture, buffer, str(path))
    change(path, attributes={"owner": ODD["Latin-1 string"]})
    np.testing.assert_array_equal(read_flat(path).channels["R"], pixels[..., 0])


@pytest.mark.parametrize("tiles", [Attribute("v2f", struct.pack("<2f", 4, 4)), Attribute("tiledesc", bytes(9)),
                                   Attribute("tiledesc", b"\4")])
def test_senseless_tiles_are_named(tmp_path, tiles):
    flat, deep = tmp_path / "flat.exr", tmp_path / "deep.exr"
    write_tiled(flat, picture())
    write_openexr(deep, openexr_part(random_samples(), "zips", (4, 4)))
    change(flat, structure={"tiles": tiles})
    change(deep, structure={"tiles": tiles})
    with pytest.raises(InputError, match=r"flat\.exr: the header's tiles are"):
        read_flat(flat)
    with pytest.raises(InputError, match=r"deep\.exr: the header's tiles are"):
        DeepReader(deep)


def test_headers_that_promise_more_chunks_than_the_file_holds_are_named(tmp_path):
    path = tmp_path / "flat.exr"
    write_flat(path, picture(), compression="none")
    (header,) = read_headers(path)
    with path.open("rb") as file:
        headers = parse_headers(file, "")
    tall = replace(header, data_window=Window(0, 0, 20, 2**29))
    path.write_bytes(reheaded(headers, np.empty(0, "<u8"), [tall]) + bytes(1000))
    with pytest.raises(InputError, match=r"flat\.exr: the headers promise 536870913 chunks"):
        read_flat(path)


def test_what_the_library_says_of_damaged_pixels_is_in_the_error_and_not_printed(tmp_path, capfd):
    path = tmp_path / "flat.exr"
    write_flat(path, picture(height=64))
    data = bytearray(path.read_bytes())
    data[-900:-600] = bytes(300)
    path.write_bytes(data)
    with pytest.raises(InputError, match=r"flat\.exr: the pixels are [^\n]* \(OpenEXR: Unable to [^\n]*\)$"):
        read_flat(path)
    assert capfd.readouterr() == ("", "")


def test_a_truncated_file_is_told_without_the_library(tmp_path, capfd):
    path = tmp_path / "flat.exr"
    write_flat(path, picture(height=64))
    path.write_bytes(path.read_bytes()[:-100])
    with pytest.raises(InputError, match="they run past the end of the file"):
        read_flat(path)
    assert capfd.readouterr() == ("", "")


def test_what_others_say_on_standard_error_comes_after_the_core_is_silenced(capfd):
    with suppress(KeyError), _core_silenced():
        os.write(2, b"50 %<python_buffer>: (EXR_ERR) of the core\n<python_buffer>: and more\ntheirs\n")
        raise KeyError
    assert capfd.readouterr().err == "50 %theirs\n"
    os.write(2, b"after\n")
    assert capfd.readouterr().err == "after\n"


@pytest.mark.parametrize("missing", ["a place for temporary files", "standard error"])
def test_nothing_is_silenced_where_that_cannot_be(missing, monkeypatch, capfd):
    def fail(*_: object) -> int:
        raise OSError(missing)

    name = "TemporaryFile" if missing != "standard error" else "dup"
    monkeypatch.setattr(library.tempfile if name == "TemporaryFile" else library.os, name, fail)
    with _core_silenced():
        os.write(2, b"said\n")
    monkeypatch.undo()
    assert capfd.readouterr().err == "said\n"


def test_other_threads_print_while_the_library_is_listened_to(capsys):
    stdout = sys.stdout
    with _said() as said:
        print("mine")
        other = threading.Thread(target=print, args=("theirs",))
        other.start()
        other.join()
    assert "".join(said) == "mine\n"
    assert capsys.readouterr().out == "theirs\n"
    assert sys.stdout is stdout


SHORT_OF_MEMORY = """
import resource, sys
import OpenEXR
from deep_io.flat import read_flat
pages = int(open("/proc/self/statm").read().split()[0])
resource.setrlimit(resource.RLIMIT_AS, (pages * resource.getpagesize() + (60 << 20), resource.RLIM_INFINITY))
try:
    read_flat(sys.argv[1])
except MemoryError as error:
    sys.exit(f"memory: {error}")
"""


@pytest.mark.skipif(not Path("/proc/self/statm").exists(), reason="asks Linux how much memory is mapped")
def test_memory_that_runs_out_is_a_memory_error(tmp_path):
    path = tmp_path / "flat.exr"
    write_flat(path, {name: np.zeros((2000, 2500), np.float32) for name in "RGBA"}, compression="zips")
    ended = subprocess.run([sys.executable, "-c", SHORT_OF_MEMORY, path], capture_output=True, text=True, check=False)
    assert ended.stderr.splitlines()[-1].startswith(f"memory: {path}: ")
    assert ended.stdout == ""


def test_a_header_without_odd_things_is_reheaded_to_itself(tmp_path):
    path = tmp_path / "flat.exr"
    write_flat(path, picture(), Header.of_samples(random_samples(window=Window(0, 0, 20, 36))))
    data = path.read_bytes()
    change(path)
    assert path.read_bytes() == data
