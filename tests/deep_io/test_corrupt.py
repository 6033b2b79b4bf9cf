"""Damaged and hostile files end as one-line InputErrors that name the file, and where it can be known the row."""

import os
import resource
import struct
import warnings
import zlib

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from deep_io import DeepReader, Header, InputError, MemoryCostWarning, Window, read_deep, write_deep
from deep_io.header import encode_header, parse_headers
from tests.deep_io.deep_files import openexr_part, random_samples, seeded, write_openexr

LEADER = struct.Struct("<i3Q")
ROWS = 10


class Damaged:
    """A good file whose bytes can be changed row by row."""

    def __init__(self, path, compression="zips"):
        self.path = path
        self.samples = random_samples(smooth=True)
        write_deep(path, self.samples, compression=compression)
        with path.open("rb") as file:
            self.table = parse_headers(file, "").end
        self.data = bytearray(path.read_bytes())
        self.offsets = list(struct.unpack_from(f"<{ROWS}q", self.data, self.table))

    def leader(self, row):
        return list(LEADER.unpack_from(self.data, self.offsets[row]))

    def set_leader(self, row, **fields):
        values = dict(zip(("y", "table", "data", "unpacked"), self.leader(row), strict=True)) | fields
        LEADER.pack_into(self.data, self.offsets[row], *values.values())

    def refused(self, match):
        self.path.write_bytes(self.data)
        with pytest.raises(InputError, match=rf"bad\.exr: {match}") as caught:
            read_deep(self.path, threads=1)
        assert "\n" not in str(caught.value)


@pytest.fixture(params=["none", "rle", "zips"])
def damaged(request, tmp_path):
    return Damaged(tmp_path / "bad.exr", request.param)


def test_a_row_stored_twice_is_named(damaged):
    damaged.set_leader(4, y=6)
    damaged.refused("row 6: stored twice")


def test_a_row_outside_the_window_is_named(damaged):
    damaged.set_leader(4, y=-100)
    damaged.refused("row 9: its chunk claims to be row -100")


@pytest.mark.parametrize("field", ["table", "data", "unpacked"])
@pytest.mark.parametrize("value", [2**63, 2**64 - 1, 2**40])
def test_sizes_beyond_the_file_are_named(damaged, field, value):
    damaged.set_leader(3, **{field: value})
    damaged.refused("row 8: ")


@pytest.mark.parametrize("offset", [1, 2**40, 2**62])
def test_offsets_outside_the_file_are_refused(damaged, offset):
    struct.pack_into("<q", damaged.data, damaged.table, offset)
    damaged.refused("row ")


def test_a_count_table_of_the_wrong_sum_is_named(tmp_path):
    damaged = Damaged(tmp_path / "bad.exr", "none")
    last = damaged.offsets[2] + LEADER.size + 4 * 15
    (total,) = struct.unpack_from("<i", damaged.data, last)
    for value in (total - 1, total + 1, -1, 2**31 - 1):
        struct.pack_into("<i", damaged.data, last, value)
        damaged.refused("row 7: the sample counts are corrupt")


def test_counts_that_fall_are_named(tmp_path):
    damaged = Damaged(tmp_path / "bad.exr", "none")
    struct.pack_into("<i", damaged.data, damaged.offsets[2] + LEADER.size + 4 * 8, 2**30)
    damaged.refused("row 7: the sample counts are corrupt")
    struct.pack_into("<i", damaged.data, damaged.offsets[2] + LEADER.size + 4 * 8, -(2**31))
    damaged.refused("row 7: the sample counts are corrupt")


def test_damaged_pixels_name_the_row(tmp_path):
    damaged = Damaged(tmp_path / "bad.exr", "zips")
    _, table, data, _ = damaged.leader(5)
    middle = damaged.offsets[5] + LEADER.size + table + data // 2
    damaged.data[middle:middle + 8] = bytes(b ^ 0xA5 for b in damaged.data[middle:middle + 8])
    damaged.refused("row 10: the compressed data is corrupt")


def test_other_rows_of_a_damaged_file_can_be_read(tmp_path):
    damaged = Damaged(tmp_path / "bad.exr", "zips")
    begin = damaged.offsets[5] + LEADER.size
    damaged.data[begin:begin + 20] = bytes(20)
    damaged.path.write_bytes(damaged.data)
    with DeepReader(damaged.path) as reader:
        assert reader.read(5, 10).total == damaged.samples.counts[:5].sum()
        with pytest.raises(InputError, match="row 10"):
            reader.read(9, 12)


def test_every_truncation_is_an_input_error(damaged):
    whole = bytes(damaged.data)
    for size in range(0, len(whole), max(1, len(whole) // 300)):
        damaged.data = whole[:size]
        damaged.refused("")


@settings(seeded, max_examples=300)
@given(st.data())
def test_any_changed_bytes_are_refused_or_read_within_bounds(damaged, data):
    changed = bytearray(damaged.data)
    for _ in range(data.draw(st.integers(1, 3))):
        place = data.draw(st.integers(0, len(changed) - 1))
        changed[place] = data.draw(st.integers(0, 255))
    damaged.path.write_bytes(changed)
    message = ""
    try:
        samples, header = read_deep(damaged.path, threads=1)
    except InputError as error:
        message = str(error)
    if message:
        assert "bad.exr: " in message
        assert "\n" not in message
    else:
        assert samples.window == header.data_window
        assert samples.counts.min() >= 0


FAR = 2**30 - 2  # the largest bound that a window may have


def promise(path, window, compression="zips", tail=b"", **attributes):
    """A file of a header alone, that promises a picture of `window`."""
    header = Header.of_samples(random_samples(), window).with_attributes(attributes)
    header = Header(header.channels, window, window, compression=compression, structure=header.attributes)
    path.write_bytes(struct.pack("<iI", 20000630, 0x802) + encode_header(header) + tail)


@pytest.mark.parametrize("window", [
    Window(0, 0, FAR, 0), Window(0, 0, 0, FAR), Window(0, 0, FAR, FAR), Window(-FAR, -FAR, FAR, FAR),
    Window(0, 0, 99999, 99999),
])
@pytest.mark.parametrize("compression", ["none", "rle", "zips", "zstd"])
def test_a_header_that_promises_more_than_the_file_holds_allocates_nothing(tmp_path, window, compression):
    path = tmp_path / "bad.exr"
    promise(path, window, compression, tail=bytes(5000))
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    with pytest.raises(InputError, match=r"bad\.exr: the header promises \d+ x \d+ pixels"):
        DeepReader(path)
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 20_000  # kB


def test_a_chunk_count_that_contradicts_the_window_is_refused(tmp_path):
    promise(tmp_path / "bad.exr", Window(0, 0, 9, 9), tail=bytes(9000), chunkCount=11)
    with pytest.raises(InputError, match="promises 11 chunks for 10 rows"):
        DeepReader(tmp_path / "bad.exr")


def one_row(path, width, samples, packed):
    """A file of one row whose chunk says what it is told to."""
    promise(path, Window(0, 0, width - 1, 0))
    counts = np.zeros(width, "<i4")
    counts[-1] = samples
    differences = np.diff(np.concatenate((counts.view(np.uint8)[0::2], counts.view(np.uint8)[1::2])), prepend=0) + 128
    differences[0] -= 128
    table = zlib.compress(differences.astype(np.uint8).tobytes(), 9)
    table = table if len(table) < counts.nbytes else counts.tobytes()
    start = path.stat().st_size + 8
    with path.open("ab") as file:
        file.write(struct.pack("<q", start) + LEADER.pack(0, len(table), len(packed), samples * 12) + table + packed)


def test_a_row_that_promises_more_than_deflate_can_hold_is_refused_before_inflating(tmp_path):
    one_row(tmp_path / "bad.exr", 16, 2**26, b"\x78\x9c" + bytes(300))
    with pytest.raises(InputError, match="row 0: promises more than its packed bytes can hold"):
        DeepReader(tmp_path / "bad.exr")


def test_a_row_that_inflates_beyond_its_promise_is_refused(tmp_path):
    one_row(tmp_path / "bad.exr", 16, 1000, zlib.compress(bytes(30_000_000), 9)[:9000])
    with pytest.raises(InputError, match="row 0: the compressed data is corrupt"):
        read_deep(tmp_path / "bad.exr")


def test_a_very_dense_row_is_not_an_attack(tmp_path):
    raw = bytes(1_200_000)
    differences = bytes([0]) + bytes([128]) * (len(raw) - 1)
    one_row(tmp_path / "good.exr", 16, 100_000, zlib.compress(differences, 9))
    samples = read_deep(tmp_path / "good.exr")[0]
    assert samples.total == 100_000
    assert not samples.channels["Z"].any()


@pytest.mark.parametrize("compression", ["zip", "piz", "dwaa", "htj2k256"])
def test_compressions_that_deep_data_cannot_have_are_named(tmp_path, compression):
    promise(tmp_path / "bad.exr", Window(0, 0, 0, 0), compression, tail=bytes(900))
    with pytest.raises(InputError, match=rf"bad\.exr: deep data cannot be compressed with {compression}; .*ZIPS"):
        DeepReader(tmp_path / "bad.exr")


def test_an_unknown_compression_is_named(tmp_path):
    promise(tmp_path / "bad.exr", Window(0, 0, 0, 0), "zips", tail=bytes(900))
    data = (tmp_path / "bad.exr").read_bytes()
    key = b"compression\0compression\0\x01\0\0\0"
    (tmp_path / "bad.exr").write_bytes(data.replace(key + b"\x02", key + b"\xc8"))
    with pytest.raises(InputError, match=r"unknown\(200\)"):
        DeepReader(tmp_path / "bad.exr")


@pytest.mark.parametrize(("compression", "tile"), [("zstd", None), ("zips", (4, 3)), ("zstd", (8, 8))])
def test_damage_on_the_library_path_is_an_input_error(tmp_path, compression, tile):
    path = tmp_path / "bad.exr"
    write_openexr(path, openexr_part(random_samples(smooth=True), compression, tile))
    whole = path.read_bytes()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", MemoryCostWarning)
        for size in range(0, len(whole), max(1, len(whole) // 50)):
            path.write_bytes(whole[:size])
            with pytest.raises(InputError, match=r"bad\.exr: ") as caught:
                read_deep(path)
            assert "\n" not in str(caught.value)


def test_a_folder_is_an_input_error(tmp_path):
    with pytest.raises(InputError, match="is a folder; name an EXR file"):
        read_deep(tmp_path)


def test_refused_files_are_closed(damaged):
    damaged.set_leader(4, y=6)
    before = len(os.listdir("/proc/self/fd"))
    for _ in range(5):
        damaged.refused("row 6")
    assert len(os.listdir("/proc/self/fd")) == before


def zstd_rows(path, width, rows, table):
    """A ZSTD file without samples, every row of which has `table` as its packed count table."""
    promise(path, Window(0, 0, width - 1, rows - 1), "zstd")
    size = LEADER.size + len(table)
    start = path.stat().st_size + 8 * rows
    with path.open("ab") as file:
        file.write(b"".join(struct.pack("<q", start + row * size) for row in range(rows)))
        file.write(b"".join(LEADER.pack(row, len(table), 0, 0) + table for row in range(rows)))


@pytest.mark.parametrize("table", [bytes(40), b"zstd-exr".ljust(40, b"\0"),
                                   b"zstd-exr" + bytes(8) + struct.pack("<Q", 10**6) + b"\x28\xb5\x2f\xfd" + bytes(12)])
def test_what_is_no_zstd_is_refused_before_the_library_allocates_the_frame(tmp_path, table):
    zstd_rows(tmp_path / "bad.exr", 200_000, 30, table)
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    with pytest.raises(InputError, match=r"bad\.exr: row 0: the compressed data is corrupt$"):
        DeepReader(tmp_path / "bad.exr")
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 20_000  # kB


def test_damage_that_only_the_library_sees_names_the_file_and_prints_nothing(tmp_path, capfd):
    table = b"zstd-exr\1" + bytes(7) + struct.pack("<Q", 16) + b"\x28\xb5\x2f\xfd" + bytes(12)
    zstd_rows(tmp_path / "bad.exr", 200, 3, table)
    with pytest.warns(MemoryCostWarning), pytest.raises(InputError, match=r"bad\.exr: .*\(OpenEXR: Unable to"):
        DeepReader(tmp_path / "bad.exr")
    assert capfd.readouterr() == ("", "")


def test_a_zstd_frame_that_the_machine_cannot_hold_is_refused(tmp_path, monkeypatch):
    write_openexr(tmp_path / "large.exr", openexr_part(random_samples(), "zstd"))
    monkeypatch.setattr("deep_io.library_reader._machine_memory", lambda: 1000)
    with pytest.raises(InputError, match=r"large\.exr: reading its ZSTD deep data takes about \d+ MiB of memory, more"):
        DeepReader(tmp_path / "large.exr")


def test_zstd_data_is_read_whatever_the_attributes_are(tmp_path):
    path = tmp_path / "odd.exr"
    write_openexr(path, openexr_part(random_samples(), "zstd", owner="Mxller"))
    path.write_bytes(path.read_bytes().replace(b"Mxller", b"M\xfcller"))
    with pytest.warns(MemoryCostWarning):
        samples, header = read_deep(path)
    assert samples.total == random_samples().total
    assert header.get("owner") == "M\udcfcller"
