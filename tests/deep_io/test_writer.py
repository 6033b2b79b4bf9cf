"""Writing deep scanline files in blocks."""

from dataclasses import replace

import numpy as np
import pytest

from deep_io import Channel, DeepWriter, Header, Window, read_deep, read_headers, write_deep
from tests.deep_io.deep_files import assert_same, random_samples, read_oiio, read_openexr, split_rows


@pytest.mark.parametrize("line_order", ["increasing", "decreasing"])
@pytest.mark.parametrize("rows", [1, 3, 10])
def test_blocks_make_the_same_file_as_the_whole(tmp_path, line_order, rows):
    samples = random_samples(smooth=True)
    header = replace(Header.of_samples(samples), line_order=line_order)
    write_deep(tmp_path / "whole.exr", samples, header)
    blocks = split_rows(samples, rows)
    with DeepWriter(tmp_path / "blocks.exr", header) as writer:
        for block in blocks if line_order == "increasing" else reversed(blocks):
            writer.write(block)
    assert (tmp_path / "blocks.exr").read_bytes() == (tmp_path / "whole.exr").read_bytes()
    for read in (read_deep, read_openexr, read_oiio):
        back = read(tmp_path / "whole.exr")
        assert_same(back[0] if isinstance(back, tuple) else back, random_samples(smooth=True))
    assert read_headers(tmp_path / "whole.exr")[0].line_order == line_order


def test_parts_are_written_side_by_side_and_read_by_all(tmp_path):
    path = tmp_path / "parts.exr"
    parts = [random_samples(1, smooth=True), random_samples(2, Window(0, 0, 4, 4), channels={"G": np.float32})]
    parts[1].channels["G"][:] = np.arange(parts[1].total)
    headers = [replace(Header.of_samples(samples, parts[0].window), name=name, line_order=order)
               for samples, name, order in zip(parts, ("left", "right"), ("increasing", "decreasing"), strict=True)]
    with DeepWriter(path, headers) as writer:
        first, second = split_rows(parts[0], 5)
        writer.write(first)
        writer.write(parts[1], part=1)
        writer.write(second)
    assert [header.name for header in read_headers(path)] == ["left", "right"]
    for index, samples in enumerate(parts):
        assert_same(read_deep(path, index)[0], samples)
        assert_same(read_openexr(path, index), samples)
        assert_same(read_oiio(path, index), samples)


def test_parts_need_names_and_one_display_window(tmp_path):
    header = Header.of_samples(random_samples())
    for headers, message in (([header, header], "need names"), ([], "need names"), (
            [replace(header, name="a"), replace(header, name="b", display_window=Window(0, 0, 1, 1))], "share one")):
        with pytest.raises(ValueError, match=message):
            DeepWriter(tmp_path / "a.exr", headers)
    assert not (tmp_path / "a.exr").exists()


def test_a_single_part_in_a_multi_part_file_needs_all_rows_too(tmp_path):
    samples = random_samples()
    header = replace(Header.of_samples(samples), name="only")
    with DeepWriter(tmp_path / "a.exr", [header]) as writer:
        writer.write(samples)
    assert_same(read_deep(tmp_path / "a.exr", "only")[0], samples)
    with pytest.raises(ValueError, match="0 of 10 rows"):
        DeepWriter(tmp_path / "b.exr", [header]).close()


def test_structure_is_the_files_own_and_the_rest_is_kept(tmp_path):
    samples = random_samples()
    header = Header.of_samples(samples, Window(0, 0, 99, 99), {"owner": "me"})
    stale = replace(header, type="deeptile", compression="zstd", name="beauty", structure=header.with_attributes(
        {"chunkCount": 99, "tiles": 1}).attributes)
    write_deep(tmp_path / "a.exr", samples, stale, "rle")
    found = read_headers(tmp_path / "a.exr")[0]
    assert (found.type, found.compression, found.name) == ("deepscanline", "rle", "beauty")
    assert found.get("owner") == "me"
    assert found.get("chunkCount") == samples.window.height
    assert found.get("maxSamplesPerPixel") == samples.counts.max()
    assert "tiles" not in found.structure


def test_channels_beyond_the_header_are_left_out(tmp_path):
    samples = random_samples()
    header = Header((Channel("Z", np.dtype(np.float32)),), samples.window, samples.window)
    write_deep(tmp_path / "a.exr", samples, header)
    assert list(read_deep(tmp_path / "a.exr")[0].channels) == ["Z"]


def test_strided_values_are_written_right(tmp_path):
    samples = random_samples()
    values = np.stack([samples.channels["R"], samples.channels["A"]], axis=1)
    strided = replace(samples, channels={**samples.channels, "R": values[:, 0], "A": values[:, 1]})
    write_deep(tmp_path / "a.exr", strided)
    assert_same(read_deep(tmp_path / "a.exr")[0], samples)
    assert_same(read_openexr(tmp_path / "a.exr"), samples)


def test_blocks_out_of_order_and_missing_rows_are_refused(tmp_path):
    samples = random_samples()
    blocks = split_rows(samples, 4)
    header = Header.of_samples(samples)
    with pytest.raises(ValueError, match="not the next"), DeepWriter(tmp_path / "a.exr", header) as writer:
        writer.write(blocks[1])
    with pytest.raises(ValueError, match=r"a\.exr: 4 of 10 rows"), DeepWriter(tmp_path / "a.exr", header) as writer:
        writer.write(blocks[0])
    with pytest.raises(ValueError, match="not the next"), DeepWriter(tmp_path / "a.exr", header) as writer:
        writer.write(replace(samples, window=Window(-3, 6, 12, 15)))


@pytest.mark.parametrize(("change", "message"), [
    ({"channels": ()}, "at least one channel"),
    ({"channels": (Channel("R", np.dtype(np.float64)),)}, "float16, float32 or uint32"),
    ({"channels": (Channel("R", np.dtype(np.float16), (2, 2)),)}, "not subsampled"),
    ({"channels": 2 * (Channel("R", np.dtype(np.float16)),)}, "named twice"),
    ({"line_order": "random"}, "random line order"),
])
def test_headers_that_cannot_be_written_are_refused_before_the_file_exists(tmp_path, change, message):
    header = replace(Header.of_samples(random_samples()), **change)
    with pytest.raises(ValueError, match=message):
        DeepWriter(tmp_path / "a.exr", header)
    assert not (tmp_path / "a.exr").exists()


def test_unknown_compressions_are_refused(tmp_path):
    with pytest.raises(ValueError, match="none, rle, zips, not 'zip'"):
        DeepWriter(tmp_path / "a.exr", Header.of_samples(random_samples()), "zip")


@pytest.mark.parametrize("channels", [
    {"A": np.float16},
    {"A": np.float16, "R": np.float32, "Z": np.float32, "id": np.uint32},
])
def test_samples_that_do_not_fit_the_header_are_refused(tmp_path, channels):
    header = Header.of_samples(random_samples())
    with pytest.raises(ValueError, match="need a"), DeepWriter(tmp_path / "a.exr", header) as writer:
        writer.write(random_samples(channels=channels))
