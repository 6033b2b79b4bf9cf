"""What we write, OpenEXR and OpenImageIO read bit-exact; what they write, we read bit-exact."""

import warnings
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from deep_io import DeepSamples, Header, MemoryCostWarning, Window, read_deep, read_headers, write_deep
from tests.deep_io.deep_files import (
    assert_same,
    openexr_part,
    random_samples,
    read_oiio,
    read_openexr,
    seeded,
    values_of,
    write_oiio,
    write_openexr,
)

DTYPES = st.sampled_from([np.float16, np.float32, np.uint32])
NAMES = st.text("abcXYZ.019_ é", min_size=1, max_size=60).filter(lambda name: len(name.encode()) < 200)
QUICK = settings(seeded, max_examples=60)


@st.composite
def deep_samples(draw):
    """Any small window, any counts (empty pixels, rows and frames among them), 1 to 5 channels of any type and name."""
    width, height = draw(st.integers(1, 20)), draw(st.integers(1, 12))
    x, y = draw(st.integers(-1000, 1000)), draw(st.integers(-1000, 1000))
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    counts = rng.integers(0, draw(st.sampled_from([1, 2, 3, 9, 60])), (height, width)).astype(np.int32)
    counts[rng.random(height) < draw(st.sampled_from([0, 0.3]))] = 0
    smooth = draw(st.booleans())
    channels = draw(st.dictionaries(NAMES, DTYPES, min_size=1, max_size=5))
    total = int(counts.sum())
    return DeepSamples(counts, {name: values_of(rng, total, dtype, smooth) for name, dtype in channels.items()},
                       Window(x, y, x + width - 1, y + height - 1))


def finite(samples: DeepSamples) -> DeepSamples:
    """Without NaNs, whose payload OpenImageIO's Python floats do not carry."""
    channels = {name: np.nan_to_num(values, nan=1) if values.dtype.kind == "f" else values
                for name, values in samples.channels.items()}
    return replace(samples, channels=channels)


@QUICK
@given(deep_samples(), st.sampled_from(["none", "rle", "zips"]), st.sampled_from(["increasing", "decreasing"]))
def test_what_we_write_openexr_and_we_read_bit_exact(tmp_path, samples, compression, line_order):
    path = tmp_path / "a.exr"
    write_deep(path, samples, replace(Header.of_samples(samples), line_order=line_order), compression, threads=1)
    back, header = read_deep(path, threads=1)
    assert_same(back, samples)
    assert (header.compression, header.line_order) == (compression, line_order)
    assert_same(read_openexr(path), samples)


@QUICK
@given(deep_samples(), st.sampled_from(["none", "rle", "zips"]))
def test_what_we_write_openimageio_reads_bit_exact(tmp_path, samples, compression):
    samples = finite(samples)
    write_deep(tmp_path / "a.exr", samples, compression=compression, threads=1)
    assert_same(read_oiio(tmp_path / "a.exr"), samples)


@QUICK
@given(deep_samples(), st.sampled_from(["none", "rle", "zips", "zstd"]),
       st.sampled_from([None, (4, 4), (5, 3), (32, 32)]))
def test_what_openexr_writes_we_read_bit_exact(tmp_path, samples, compression, tile):
    write_openexr(tmp_path / "a.exr", openexr_part(samples, compression, tile))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", MemoryCostWarning)
        assert_same(read_deep(tmp_path / "a.exr", threads=1)[0], samples)


@QUICK
@given(st.lists(deep_samples(), min_size=1, max_size=3), st.sampled_from(["none", "zips"]),
       st.sampled_from([None, (16, 16), (8, 4)]))
def test_what_openimageio_writes_we_read_bit_exact(tmp_path, parts, compression, tile):
    parts = [finite(samples) for samples in parts]
    write_oiio(tmp_path / "a.exr", parts, compression, tile)
    kinds = {header.type for header in read_headers(tmp_path / "a.exr")}
    assert kinds == {"deeptile" if tile else "deepscanline"}
    for index, samples in enumerate(parts):
        assert_same(read_deep(tmp_path / "a.exr", index, threads=1)[0], samples)


@pytest.mark.parametrize("compression", ["none", "rle", "zips"])
@pytest.mark.parametrize("smooth", [False, True])
def test_pixels_of_thousands_of_samples_survive_everywhere(tmp_path, compression, smooth):
    samples = random_samples(4, Window(2, 2, 9, 4), 5000, smooth=smooth)
    ours, theirs = tmp_path / "ours.exr", tmp_path / "theirs.exr"
    write_deep(ours, samples, compression=compression)
    assert_same(read_deep(ours)[0], samples)
    assert_same(read_openexr(ours), samples)
    write_openexr(theirs, openexr_part(samples, compression))
    assert_same(read_deep(theirs)[0], samples)
