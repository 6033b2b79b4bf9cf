"""The line codec against a plain byte-by-byte reading of the format, and its bounds."""

import zlib

import deflate
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from deep_io import codec, rle
from tests.deep_io.deep_files import seeded

COMPRESSIONS = st.sampled_from(codec.COMPRESSIONS)
RUNS = st.lists(st.tuples(st.integers(0, 255), st.integers(1, 300)), max_size=40)


def plain_transform(data: bytes) -> bytes:
    """Even bytes, odd bytes, then differences plus 128, one byte at a time."""
    halves = data[0::2] + data[1::2]
    return bytes(byte if i == 0 else (byte - halves[i - 1] + 128) % 256 for i, byte in enumerate(halves))


def plain_rle_decode(packed: bytes) -> bytes:
    out, at = bytearray(), 0
    while at < len(packed):
        count = packed[at] - 256 if packed[at] > 127 else packed[at]
        if count < 0:
            out += packed[at + 1:at + 1 - count]
            at += 1 - count
        else:
            out += packed[at + 1:at + 2] * (count + 1)
            at += 2
    return bytes(out)


def smooth(size: int) -> np.ndarray:
    return (1000 * np.sin(np.arange(size) / 50)).astype(np.int16).view(np.uint16)


@seeded
@given(st.binary(max_size=400).filter(lambda data: len(data) % 2 == 0), COMPRESSIONS)
def test_every_line_survives_the_round_trip(data, compression):
    packed = codec.encode(np.frombuffer(data, np.uint16), compression)
    assert len(packed) <= len(data)
    assert codec.decode(packed, len(data), compression).tobytes() == data


@pytest.mark.parametrize("compression", codec.COMPRESSIONS)
@pytest.mark.parametrize("pairs", [1, 2, 8191, 8192, 8193, 12345, 65536, 163840, 200001])
def test_long_lines_survive_the_round_trip(compression, pairs):
    for line in (smooth(pairs), np.random.default_rng(pairs).integers(0, 9, pairs).astype(np.uint16)):
        packed = codec.encode(line, compression)
        assert np.array_equal(codec.decode(packed, 2 * pairs, compression), line)


def test_zips_is_the_deflated_transform():
    line = smooth(3000)
    assert zlib.decompress(codec.encode(line, "zips")) == plain_transform(line.tobytes())
    assert codec.decode(zlib.compress(plain_transform(line.tobytes())), 6000, "zips").tobytes() == line.tobytes()


def test_incompressible_data_is_stored_raw():
    line = np.random.default_rng(0).integers(0, 65536, 500).astype(np.uint16)
    assert codec.encode(line, "zips") == codec.encode(line, "rle") == line.tobytes()


@seeded
@given(RUNS)
def test_rle_says_what_the_format_says(runs):
    data = b"".join(bytes([value]) * length for value, length in runs) or b"x"
    packed = rle.encode(np.frombuffer(data, np.uint8))
    assert plain_rle_decode(packed) == data
    assert rle.decode(np.frombuffer(packed, np.uint8), len(data)).tobytes() == data


@seeded
@given(st.binary(max_size=300), st.integers(0, 2000))
def test_rle_of_anything_is_decoded_exactly_or_refused(packed, size):
    try:
        data = rle.decode(np.frombuffer(packed, np.uint8), size)
    except ValueError:
        return
    assert data.tobytes() == plain_rle_decode(packed)
    assert data.size == size


def test_rle_is_shorter_for_runs():
    assert len(rle.encode(np.zeros(12800, np.uint8))) == 200


@pytest.mark.parametrize("size", [2, 5998, 6002, 12000])
@pytest.mark.parametrize("compression", ["rle", "zips"])
def test_a_wrong_size_is_refused(size, compression):
    packed = codec.encode(smooth(3000), compression)
    with pytest.raises(ValueError, match=r"corrupt|expected"):
        codec.decode(packed, size, compression)


def test_a_bomb_inflates_no_further_than_asked():
    bomb = zlib.compress(bytes(50_000_000), 9)
    with pytest.raises(ValueError, match="corrupt"):
        codec.decode(bomb, 1000, "zips")


@pytest.mark.parametrize("damage", [lambda d: d[:-3], lambda d: d[:9] + bytes([d[9] ^ 255]) + d[10:], lambda d: b""])
def test_damaged_deflate_data_is_refused(damage):
    with pytest.raises(ValueError, match=r"corrupt|expected"):
        codec.decode(damage(codec.encode(smooth(3000), "zips")), 6000, "zips")


def test_deflate_packs_no_tighter_than_the_ratio_assumed():
    zeros = bytes(10_000_000)
    for packed in (zlib.compress(zeros, 9), deflate.zlib_compress(zeros, 12)):
        assert len(zeros) <= codec.MAX_RATIO["zips"] * len(packed)


def test_small_zips_are_zips_and_smaller() -> None:
    line = smooth(6000)
    small = codec.encode(line, "zips", small=True)
    assert len(small) < len(codec.encode(line, "zips"))
    assert zlib.decompress(small) == plain_transform(line.tobytes())
