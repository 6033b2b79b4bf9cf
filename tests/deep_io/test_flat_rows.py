"""Rows read alone are the rows of the whole picture, bit for bit, whatever the file is like; broken files are named."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import OpenEXR
import OpenImageIO as oiio
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from deep_io import Window, write_deep
from deep_io.attributes import Attribute
from deep_io.errors import InputError
from deep_io.flat import COMPRESSIONS, FlatImage, read_flat_parts, write_flat, write_flat_parts
from deep_io.flat_rows import FlatRows
from deep_io.header import Header, channels_of, parse_headers
from deep_io.reheading import read_chunk_table
from tests.deep_io.deep_files import random_samples

WIDTH, HEIGHT = 21, 300  # taller than the tallest chunk, of 256 rows
TILE = (8, 12)


def picture(seed: int = 0) -> dict[str, np.ndarray]:
    """Channels of every type; names that DWA takes for colours, and one that it does not."""
    rng = np.random.default_rng(seed)
    shape = (HEIGHT, WIDTH)
    half = {name: rng.exponential(1, shape).astype(np.float16) for name in ("R", "G", "key.B", "other")}
    return half | {"Z": rng.exponential(9, shape).astype(np.float32),
                   "id": rng.integers(0, 2**32, shape).astype(np.uint32)}


def like() -> Header:
    """A data window that is not the display window."""
    return Header(channels_of({"R": np.float16}), Window(-5, -7, WIDTH - 6, HEIGHT - 8), Window(0, 0, 99, 199))


def library_header(compression: str, **more: Any) -> dict[str, Any]:
    box = (np.array([-5, -7], np.int32), np.array([WIDTH - 6, HEIGHT - 8], np.int32))
    return {"compression": COMPRESSIONS[compression], "type": OpenEXR.scanlineimage, "dataWindow": box, **more}


def tiles(mode: OpenEXR.LevelMode = OpenEXR.LevelMode.ONE_LEVEL) -> dict[str, Any]:
    description = OpenEXR.TileDescription()
    description.xSize, description.ySize, description.mode = *TILE, mode
    description.roundingMode = OpenEXR.LevelRoundingMode.ROUND_UP
    return {"type": OpenEXR.tiledimage, "tiles": description}


def write_with_library(path: Path, *parts: tuple[dict[str, Any], dict[str, np.ndarray]]) -> None:
    named = [OpenEXR.Part(dict(header), channels, f"part{index}") for index, (header, channels) in enumerate(parts)]
    OpenEXR.File(named).write(str(path))


def zero_table(path: Path, entries: slice = slice(None)) -> None:
    """What a writer leaves that was killed: a chunk table that is not filled in."""
    data = bytearray(path.read_bytes())
    with path.open("rb") as file:
        headers = parse_headers(file, "")
        table = read_chunk_table(file, headers, "").copy()
    table[entries] = 0
    data[headers.end:headers.end + table.nbytes] = table.tobytes()
    path.write_bytes(data)


def assert_rows_are_those_of_the_whole(path: Path, steps: tuple[int, ...] = (1, 17, 64, 300)) -> None:
    """In blocks of any height, of every part."""
    rows = FlatRows(path)
    for part, image in enumerate(read_flat_parts(path)):
        window = image.window
        for step in steps:
            for y0 in range(window.ymin, window.ymax + 1, step * (1 if step > 1 else 23)):
                y1 = min(y0 + step, window.ymax + 1)
                block = rows.read(part, y0, y1, image.channels)
                for name, pixels in image.channels.items():
                    expected = pixels[y0 - window.ymin:y1 - window.ymin]
                    assert block[name].dtype == expected.dtype
                    assert block[name].tobytes() == expected.tobytes()


@pytest.mark.parametrize("compression", list(COMPRESSIONS))
@pytest.mark.parametrize("tiled", [False, True])
def test_rows_are_bit_exact_in_every_compression(tmp_path, compression, tiled):
    path = tmp_path / "flat.exr"
    write_with_library(path, (library_header(compression, **(tiles() if tiled else {})), picture()))
    assert_rows_are_those_of_the_whole(path)
    assert FlatRows(path).rows_together(0) == (TILE[1] if tiled else {
        "none": 1, "rle": 1, "zips": 1, "zip": 16, "pxr24": 16, "dwab": 256}.get(compression, 32))


@settings(derandomize=True, deadline=None, max_examples=30, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(first=st.integers(0, HEIGHT - 1), last=st.integers(0, HEIGHT - 1))
def test_any_rows_can_be_read_in_any_order(tmp_path, first, last):
    path, channels = tmp_path / "flat.exr", picture()
    if not path.exists():
        write_flat(path, channels, like(), "zip")
    top, bottom = min(first, last), max(first, last) + 1
    block = FlatRows(path).read(0, top - 7, bottom - 7, ["Z", "id"])
    assert sorted(block) == ["Z", "id"]
    np.testing.assert_array_equal(block["id"], channels["id"][top:bottom])
    np.testing.assert_array_equal(block["Z"], channels["Z"][top:bottom])


@pytest.mark.parametrize("mode", [OpenEXR.LevelMode.MIPMAP_LEVELS, OpenEXR.LevelMode.RIPMAP_LEVELS])
def test_of_a_pyramid_the_full_resolution_is_read(tmp_path, mode):
    """Also of one whose smaller levels were never written, as the library leaves them."""
    path, channels = tmp_path / "pyramid.exr", picture()
    OpenEXR.File(library_header("zip", **tiles(mode)), dict(channels)).write(str(path))
    block = FlatRows(path).read(0, 20, 90, channels)
    for name, pixels in channels.items():
        np.testing.assert_array_equal(block[name], pixels[27:97])


def test_of_a_finished_mipmap_the_full_resolution_is_read(tmp_path):
    path, pixels = tmp_path / "mip.exr", np.stack([picture()[name] for name in "RGZ"], -1).astype(np.float32)
    buffer = oiio.ImageBuf(oiio.ImageSpec(WIDTH, HEIGHT, 3, oiio.FLOAT))
    buffer.set_pixels(oiio.ROI(0, WIDTH, 0, HEIGHT), pixels)
    assert oiio.ImageBufAlgo.make_texture(oiio.MakeTxTexture, buffer, str(path))
    assert_rows_are_those_of_the_whole(path)


def test_parts_may_be_cut_in_different_ways(tmp_path):
    path = tmp_path / "parts.exr"
    write_with_library(path, (library_header("zip"), picture(1)), (library_header("zips", **tiles()), picture(2)),
                       (library_header("piz"), picture(3)))
    assert_rows_are_those_of_the_whole(path)
    rows = FlatRows(path)
    assert [rows.rows_together(part) for part in range(3)] == [16, TILE[1], 32]


def test_rows_may_be_stored_from_the_bottom_upwards(tmp_path):
    path = tmp_path / "upwards.exr"
    OpenEXR.File(library_header("zip", lineOrder=OpenEXR.DECREASING_Y), picture()).write(str(path))
    assert FlatRows(path).headers[0].line_order == "decreasing"
    assert_rows_are_those_of_the_whole(path)


def test_attributes_and_names_that_the_library_does_not_take_are_no_obstacle(tmp_path):
    path = tmp_path / "flat.exr"
    channels = {f"lixht.{name}": pixels for name, pixels in picture().items()}
    odd = {"odd": Attribute("string", b"M\xfcller"), "state": Attribute("deepImageState", b"\1")}
    write_flat_parts(path, [FlatImage.of(channels, like(), name, odd) for name in ("paxt", "other")], "dwaa")
    path.write_bytes(path.read_bytes().replace(b"lixht.", b"li\xfcht.").replace(b"paxt", b"pa\xfct"))
    assert "li\udcfcht.R" in FlatRows(path).headers[0].channel_names
    assert_rows_are_those_of_the_whole(path)


@pytest.mark.parametrize("tiled", [False, True])
@pytest.mark.parametrize("entries", [slice(None), slice(2, 3), slice(-1, None)])
def test_a_chunk_table_that_was_not_filled_in_is_rebuilt(tmp_path, tiled, entries):
    path = tmp_path / "flat.exr"
    header = library_header("zip", **(tiles() if tiled else {}))
    write_with_library(path, (header, picture(1)), (header, picture(2)))
    zero_table(path, entries)
    assert_rows_are_those_of_the_whole(path)


def test_rows_that_a_killed_writer_left_out_are_named_at_once(tmp_path):
    path = tmp_path / "flat.exr"
    write_flat(path, picture(), like())
    path.write_bytes(path.read_bytes()[:-2000])
    zero_table(path)
    with pytest.raises(InputError, match=r"flat\.exr: row 281: missing"):  # 18 whole chunks of 16 rows from -7
        FlatRows(path)


def test_truncated_and_deep_files_are_refused_when_they_are_opened(tmp_path):
    path = tmp_path / "flat.exr"
    write_flat(path, picture(), like())
    path.write_bytes(path.read_bytes()[:-100])
    with pytest.raises(InputError, match=r"flat\.exr: the pixels .* run past the end of the file"):
        FlatRows(path)
    write_deep(path, random_samples())
    with pytest.raises(InputError, match=r"flat\.exr: is a deep EXR"):
        FlatRows(path)


def test_damaged_pixels_are_named_and_the_other_rows_are_read(tmp_path, capfd):
    path, channels = tmp_path / "flat.exr", picture()
    write_flat(path, channels, like())
    data = bytearray(path.read_bytes())
    data[-900:-600] = bytes(300)
    path.write_bytes(data)
    rows = FlatRows(path)
    np.testing.assert_array_equal(rows.read(0, -7, 100, ["R"])["R"], channels["R"][:107])
    with pytest.raises(InputError, match=r"flat\.exr: the pixels are [^\n]* \(OpenEXR: Unable to [^\n]*\)$"):
        rows.read(0, 280, HEIGHT - 7, ["R"])
    assert capfd.readouterr() == ("", "")


def test_a_chunk_table_that_points_elsewhere_is_an_error_and_not_another_row(tmp_path):
    path = tmp_path / "flat.exr"
    write_flat(path, picture(), like())
    with path.open("rb") as file:
        headers = parse_headers(file, "")
        table = read_chunk_table(file, headers, "").copy()
    table[[3, 4]] = table[[4, 3]]
    table[5] += 9
    data = bytearray(path.read_bytes())
    data[headers.end:headers.end + table.nbytes] = table.tobytes()
    path.write_bytes(data)
    rows = FlatRows(path)
    rows.read(0, -7, 41, ["R"])
    for chunk in (3, 4, 5):
        with pytest.raises(InputError, match=rf"flat\.exr: row {16 * chunk - 7}: .* the chunk table is wrong"):
            rows.read(0, 16 * chunk - 7, 16 * chunk - 6, ["R"])


def test_a_file_that_changes_meanwhile_is_an_error(tmp_path):
    path = tmp_path / "flat.exr"
    write_flat(path, picture(1))
    rows = FlatRows(path)
    rows.read(0, 0, 5, ["R"])
    write_flat(path, picture(2))
    with pytest.raises(InputError, match=r"flat\.exr: was changed while it was read"):
        rows.read(0, 5, 10, ["R"])
    path.unlink()
    with pytest.raises(InputError, match=r"flat\.exr: cannot be opened"):
        rows.read(0, 5, 10, ["R"])
