"""Reading deep scanline parts: rows, channels, blocks, parts, threads, unfinished files."""

import struct
import warnings
from dataclasses import replace

import numpy as np
import pytest

from deep_io import DeepReader, Header, InputError, Window, read_deep, write_deep
from deep_io.header import parse_headers
from deep_io.samples import concatenate
from tests.deep_io.deep_files import assert_same, openexr_part, random_samples, write_oiio, write_openexr


@pytest.fixture
def deep_file(tmp_path):
    samples = random_samples(smooth=True)
    write_deep(tmp_path / "a.exr", samples)
    return tmp_path / "a.exr", samples


def zero_chunk_table(path, part=0):
    """What a writer that was killed leaves behind: the chunks, but no table."""
    with path.open("rb") as file:
        headers = parse_headers(file, "")
    data = bytearray(path.read_bytes())
    for index, header in enumerate(headers.parts):
        begin = headers.end + 8 * sum(h.get("chunkCount") for h in headers.parts[:index])
        data[begin:begin + 8 * header.get("chunkCount")] = bytes(8 * header.get("chunkCount"))
    path.write_bytes(data)
    return headers


def test_rows_are_absolute_and_channels_are_chosen(deep_file):
    path, samples = deep_file
    with DeepReader(path) as reader:
        assert reader.total == samples.total
        assert np.array_equal(reader.samples_per_row, samples.counts.sum(axis=1))
        part = reader.read(7, 10, ["Z", "A"])
    assert list(part.channels) == ["Z", "A"]
    assert part.window == samples.window.rows(7, 10)
    assert np.array_equal(part.counts, samples.counts[2:5])
    begin, end = samples.offsets[[2 * 16, 5 * 16]]
    assert part.channels["Z"].tobytes() == samples.channels["Z"][begin:end].tobytes()


@pytest.mark.parametrize("rows", [(4, 8), (5, 16), (9, 9), (9, 8)])
def test_rows_outside_the_window_are_refused(deep_file, rows):
    with DeepReader(deep_file[0]) as reader, pytest.raises(ValueError, match="not within 5 to 15"):
        reader.read(*rows)


def test_a_channel_that_does_not_exist_is_a_key_error(deep_file):
    with DeepReader(deep_file[0]) as reader, pytest.raises(KeyError, match="nope"):
        reader.read(channels=["nope"])


@pytest.mark.parametrize("max_bytes", [1, 1000, 3000, 1 << 30])
def test_blocks_are_the_whole_in_pieces(deep_file, max_bytes):
    path, samples = deep_file
    with DeepReader(path) as reader:
        blocks = list(reader.blocks(max_bytes))
        assert all(b.window.height == 1 or sum(v.nbytes for v in b.channels.values()) <= max_bytes for b in blocks)
        assert_same(concatenate(blocks), samples)
        assert [list(b.channels) for b in reader.blocks(max_bytes, ["R"])] == [["R"]] * len(list(
            reader.blocks(max_bytes, ["R"])))


def test_counts_alone_can_be_read(deep_file):
    path, samples = deep_file
    with DeepReader(path) as reader:
        block = reader.read(channels=[])
    assert block.channels == {}
    assert np.array_equal(block.counts, samples.counts)


def test_threads_change_nothing(tmp_path):
    samples = random_samples(window=Window(0, 0, 63, 70), smooth=True)
    for threads in (1, 2, 5):
        write_deep(tmp_path / f"{threads}.exr", samples, threads=threads)
        assert (tmp_path / f"{threads}.exr").read_bytes() == (tmp_path / "1.exr").read_bytes()
        assert_same(read_deep(tmp_path / "1.exr", threads=threads)[0], samples)


def test_parts_are_found_by_name_and_number(tmp_path):
    path = tmp_path / "parts.exr"
    left, right = random_samples(1, smooth=True), random_samples(2, Window(0, 0, 4, 4), channels={"G": np.float32})
    write_openexr(path, openexr_part(left, "rle", name="left"),
                  openexr_part(right, "none", name="right", displayWindow=openexr_part(left).header["displayWindow"]))
    for part, samples in (("left", left), (0, left), ("right", right), (1, right), ("1", right)):
        assert_same(read_deep(path, part)[0], samples)
    with pytest.raises(InputError, match=r"2 deep parts; choose one with --part: left, right"):
        read_deep(path)
    for part in ("centre", 2, "-1"):
        with pytest.raises(InputError, match=r"no part .*; its parts are left, right"):
            read_deep(path, part)


def test_the_only_deep_part_is_found_behind_a_flat_one(tmp_path):
    import OpenEXR
    path = tmp_path / "mixed.exr"
    samples = random_samples(smooth=True)
    part = openexr_part(samples, name="deep")
    flat = OpenEXR.Part({"type": OpenEXR.scanlineimage, "displayWindow": part.header["displayWindow"]},
                        {"Y": np.zeros((40, 30), np.float32)}, "flat")
    write_openexr(path, flat, part)
    assert_same(read_deep(path)[0], samples)
    with pytest.raises(InputError, match="part 'flat' is flat; the deep parts are deep"):
        read_deep(path, "flat")
    zero_chunk_table(path)
    assert_same(read_deep(path)[0], samples)


@pytest.mark.parametrize("line_order", ["increasing", "decreasing"])
def test_a_zeroed_chunk_table_is_rebuilt(tmp_path, line_order):
    path = tmp_path / "a.exr"
    samples = random_samples(smooth=True)
    write_deep(path, samples, replace(Header.of_samples(samples), line_order=line_order))
    zero_chunk_table(path)
    assert_same(read_deep(path)[0], samples)


def test_a_zeroed_chunk_table_is_rebuilt_in_every_part(tmp_path):
    path = tmp_path / "a.exr"
    parts = [random_samples(1, smooth=True), random_samples(2, Window(0, 0, 4, 4), channels={"G": np.float32})]
    write_oiio(path, parts)
    assert len(zero_chunk_table(path).parts) == 2
    for part, samples in enumerate(parts):
        assert_same(read_deep(path, part)[0], samples)


def test_an_unfinished_file_names_the_first_missing_row(deep_file):
    path, samples = deep_file
    zero_chunk_table(path)
    with path.open("rb") as file:
        end = parse_headers(file, "").end + 8 * samples.window.height
    data = path.read_bytes()
    path.write_bytes(data[:end + (len(data) - end) // 2])
    with pytest.raises(InputError, match=r"a\.exr: row \d+: missing; the file has \d of 10 rows"):
        DeepReader(path)


def test_a_chunk_table_in_file_order_reads_as_well(deep_file):
    """The chunks say which rows they are; the table of some writers is not sorted by row."""
    path, samples = deep_file
    with path.open("rb") as file:
        begin = parse_headers(file, "").end
    data = bytearray(path.read_bytes())
    size = 8 * samples.window.height
    table = struct.unpack(f"<{size // 8}q", data[begin:begin + size])
    data[begin:begin + size] = struct.pack(f"<{size // 8}q", *table[::-1])
    path.write_bytes(data)
    assert_same(read_deep(path)[0], samples)


def test_a_flat_file_says_how_to_pack(tmp_path):
    import OpenEXR
    with OpenEXR.File({"type": OpenEXR.scanlineimage}, {"RGB": np.zeros((4, 5, 3), np.float16)}) as file:
        file.write(str(tmp_path / "flat.exr"))
    with pytest.raises(InputError, match=r"flat\.exr: is a flat EXR.*lbmc pack FRAMES\.\.\. OUT"):
        read_deep(tmp_path / "flat.exr")


@pytest.mark.parametrize("compression", ["none", "rle", "zips", "zstd"])
@pytest.mark.parametrize("tile", [None, (4, 3), (64, 64)])
def test_tiled_and_zstd_parts_are_read_and_zstd_warns(tmp_path, compression, tile):
    path = tmp_path / "a.exr"
    samples = random_samples(smooth=True)
    write_openexr(path, openexr_part(samples, compression, tile))
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        with DeepReader(path) as reader:
            assert_same(reader.read(), samples)
            assert_same(concatenate(list(reader.blocks(1000))), samples)
            assert np.array_equal(reader.read(8, 9, ["R"]).counts, samples.counts[3:4])
    expected = f"{path}: ZSTD deep data is read through the OpenEXR library, the whole frame at once"
    assert [str(w.message).startswith(expected) for w in caught] == [True] * (compression == "zstd")


def test_importing_deep_io_does_not_import_torch_or_the_libraries():
    import subprocess
    import sys
    code = "import sys, deep_io; sys.exit(bool({'torch', 'OpenEXR', 'OpenImageIO'} & set(sys.modules)))"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0
