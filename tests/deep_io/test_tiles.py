"""Deep tiled parts, as RenderMan writes them by default, streamed like scanlines."""

import struct
from dataclasses import replace

import numpy as np
import OpenEXR
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from deep_io import DeepReader, InputError, Window, read_deep, write_deep
from deep_io.attributes import attribute
from deep_io.header import encode_header, parse_headers
from deep_io.samples import concatenate
from tests.deep_io.deep_files import assert_same, openexr_part, random_samples, seeded, split_rows, write_openexr

TILE = (16, 8)
LEADER = struct.Struct("<4i3Q")


@pytest.fixture
def tiled(tmp_path):
    samples = random_samples(window=Window(-7, 3, 40, 30), smooth=True)
    write_openexr(tmp_path / "tiled.exr", openexr_part(samples, "zips", TILE))
    return tmp_path / "tiled.exr", samples


@pytest.fixture
def good_bytes(tiled):
    return tiled[0].read_bytes()


def parsed(path):
    """The header, where the chunk table begins, and the offsets in it."""
    with path.open("rb") as file:
        headers = parse_headers(file, "")
    count = headers.parts[0].get("chunkCount")
    return headers.parts[0], headers.end, list(struct.unpack_from(f"<{count}q", path.read_bytes(), headers.end))


@pytest.mark.parametrize("threads", [1, 3])
def test_any_rows_and_channels_of_tiles_are_read(tiled, threads):
    path, samples = tiled
    rows = split_rows(samples, 1)
    with DeepReader(path, threads=threads) as reader:
        assert np.array_equal(reader.samples_per_row, samples.counts.sum(axis=1))
        for y0, y1 in ((3, 31), (3, 4), (10, 12), (11, 27), (30, 31)):
            assert_same(reader.read(y0, y1), concatenate(rows[y0 - 3:y1 - 3]))
        assert list(reader.read(5, 6, ["Z"]).channels) == ["Z"]
        assert reader.read(channels=[]).counts.sum() == samples.total


@pytest.mark.parametrize("max_bytes", [1, 5000, 1 << 30])
def test_blocks_are_whole_rows_of_tiles(tiled, max_bytes):
    path, samples = tiled
    with DeepReader(path) as reader:
        blocks = list(reader.blocks(max_bytes))
    assert all((block.window.ymin - 3) % TILE[1] == 0 for block in blocks)
    assert_same(concatenate(blocks), samples)


def test_a_tiled_file_of_random_order_is_written_again_as_rows_that_increase(tmp_path):
    samples = random_samples(smooth=True)
    write_openexr(tmp_path / "tiled.exr", openexr_part(samples, tile=TILE, lineOrder=OpenEXR.RANDOM_Y))
    read, header = read_deep(tmp_path / "tiled.exr")
    assert header.line_order == "random"
    write_deep(tmp_path / "rows.exr", read, header)
    again, written = read_deep(tmp_path / "rows.exr")
    assert (written.type, written.line_order) == ("deepscanline", "increasing")
    assert_same(again, samples)


def test_smaller_levels_are_passed_over(tiled):
    path, samples = tiled
    header, end, offsets = parsed(path)
    data = path.read_bytes()
    more = {**header.structure, "chunkCount": attribute(len(offsets) + 1),
            "tiles": attribute((*TILE, 1), "tiledesc")}  # 1: mip-mapped, one more tile of a smaller level.
    chunks = end + 8 * len(offsets)
    small = LEADER.pack(0, 0, 1, 1, 0, 0, 0)
    start = data[:8] + encode_header(replace(header, structure=more))
    shift = len(start) + 8 * (len(offsets) + 1) - chunks
    table = [offset + shift for offset in offsets] + [len(data) + shift]
    path.write_bytes(start + struct.pack(f"<{len(table)}q", *table) + data[chunks:] + small)
    assert_same(read_deep(path)[0], samples)


def test_damaged_tiles_are_named(tiled):
    path, _ = tiled
    _, end, offsets = parsed(path)
    good = path.read_bytes()

    def refused(position, form, value, match):
        data = bytearray(good)
        struct.pack_into(form, data, position, value)
        path.write_bytes(data)
        with pytest.raises(InputError, match=rf"tiled\.exr: {match}"):
            read_deep(path)

    fifth = offsets[4]  # Tiles are three across, so it is tile 1 of the second row of tiles, which begins at row 11.
    refused(end, "<q", 0, "tile 0 of 12: the chunk table points outside the file")
    refused(fifth, "<i", 3, "tile 4 of 12 claims to be tile 3, 1, outside the window")
    refused(fifth, "<i", 0, "row 11: tile 0, 1 is stored twice")
    refused(fifth + 16, "<Q", 2**40, "row 11: tile 1, 1: runs past the end of the file")
    refused(fifth + 32, "<Q", 12 * 10**6, "row 11: tile 1, 1: promises more")
    refused(fifth + 32, "<Q", 12, "row 11: tile 1, 1: the sample counts are corrupt")
    refused(fifth + 45, "<Q", 0, "row 11: tile 1, 1: the compressed data is corrupt")


@pytest.mark.parametrize("size", [(0, 4), (2**31, 4)])
def test_tile_sizes_that_make_no_sense_are_refused(tiled, size):
    path, _ = tiled
    data = path.read_bytes()
    path.write_bytes(data.replace(struct.pack("<2I", *TILE), struct.pack("<2I", *size)))
    with pytest.raises(InputError, match="the header's tiles are corrupt"):
        DeepReader(path)


@settings(seeded, max_examples=150)
@given(st.data())
def test_any_changed_bytes_are_refused_or_read_within_bounds(tiled, good_bytes, data):
    path, _ = tiled
    changed = bytearray(good_bytes)
    for _ in range(data.draw(st.integers(1, 3))):
        changed[data.draw(st.integers(0, len(changed) - 1))] = data.draw(st.integers(0, 255))
    path.write_bytes(changed)
    message = "tiled.exr: "
    try:
        assert read_deep(path, threads=1)[0].counts.min() >= 0
    except InputError as error:
        message = str(error)
    assert "tiled.exr: " in message
    assert "\n" not in message


@pytest.mark.parametrize(("window", "chunks"), [
    (Window(0, 0, 2**30 - 2, 2**30 - 2), 1), (Window(0, 0, 99999, 99999), 12), (Window(0, 0, 9, 9), 2**31 - 1)])
def test_a_tiled_header_that_promises_more_than_the_file_holds_is_refused(tiled, window, chunks):
    path, _ = tiled
    header = parsed(path)[0]
    promised = replace(header, data_window=window, structure={**header.structure, "chunkCount": attribute(chunks)})
    path.write_bytes(path.read_bytes()[:8] + encode_header(promised) + bytes(3000))
    with pytest.raises(InputError, match=r"tiled\.exr: the header promises"):
        DeepReader(path)
