"""Flat EXRs: what is written reads back bit-exact here, in OpenEXR and in OpenImageIO, attributes included."""

from __future__ import annotations

import resource
from pathlib import Path

import numpy as np
import OpenEXR
import OpenImageIO as oiio
import pytest

from deep_io import Channel, Header, Window, read_headers, write_deep
from deep_io.attributes import Attribute, attribute
from deep_io.errors import InputError
from deep_io.flat import COMPRESSIONS, FlatImage, kept_attributes, read_flat, read_flat_parts, to_half, write_flat
from deep_io.flat import write_flat_parts as write_parts
from tests.deep_io.deep_files import random_samples

LOSSLESS = ["none", "rle", "zips", "zip", "piz"]


def picture(seed: int = 0, height: int = 37, width: int = 21) -> dict[str, np.ndarray]:
    rng = np.random.default_rng(seed)
    return {"R": rng.standard_normal((height, width)).astype(np.float16),
            "G": rng.standard_normal((height, width)).astype(np.float32),
            "layer.id": rng.integers(0, 2**32, (height, width)).astype(np.uint32)}


def header_of_input() -> Header:
    """What an input may carry: odd windows, aspect, attributes of known and unknown types, and file-bound ones."""
    return Header((Channel("R", np.dtype(np.float16)),), Window(-3, 5, 17, 41), Window(0, 0, 99, 49), pixel_aspect=2.0,
                  type="deepscanline", attributes={
                      "owner": attribute("a person with a rather long attribute value"),
                      "an attribute with a name of more than thirty-one bytes": attribute(7),
                      "worldToCamera": attribute(tuple(float(i) for i in range(16))),
                      "framesPerSecond": attribute((24000, 1001), "rational"),
                      "studio:blob": Attribute("studiotype", bytes(range(50))),
                      "chromaticities": attribute((0.64, 0.33, 0.3, 0.6, 0.15, 0.06, 0.3127, 0.329), "chromaticities"),
                      "views": attribute(["left", "right"]),
                      "preview": Attribute("preview", bytes(12)),
                      "deepImageState": attribute(1, "deepImageState"),
                      "lbmc:model": attribute("fast")})


def assert_same(channels: dict[str, np.ndarray], other: dict[str, np.ndarray]) -> None:
    assert sorted(channels) == sorted(other)
    for name, pixels in channels.items():
        assert other[name].dtype == pixels.dtype
        np.testing.assert_array_equal(other[name], pixels)


@pytest.mark.parametrize("compression", LOSSLESS)
def test_pixels_read_back_bit_exact_here_and_in_both_libraries(tmp_path, compression):
    path, channels = tmp_path / "flat.exr", picture()
    write_flat(path, channels, header_of_input(), compression)
    assert_same(channels, read_flat(path).channels)
    with OpenEXR.File(str(path), separate_channels=True) as file:
        assert_same(channels, {name: channel.pixels for name, channel in file.channels().items()})
    image = oiio.ImageInput.open(str(path))
    for index, name in enumerate(image.spec().channelnames):
        stored = image.read_image(0, 0, index, index + 1, image.spec().channelformat(index))
        np.testing.assert_array_equal(np.asarray(stored).reshape(channels[name].shape), channels[name])
    image.close()


@pytest.mark.parametrize("compression", list(COMPRESSIONS))
def test_every_compression_is_stated_and_readable(tmp_path, compression):
    path = tmp_path / "flat.exr"
    write_flat(path, {"R": np.full((300, 5), 0.5, np.float16)}, compression=compression)
    (header,) = read_headers(path)
    assert header.compression == compression
    np.testing.assert_allclose(read_flat(path).channels["R"], 0.5, rtol=0.01)


def test_windows_aspect_and_user_attributes_are_kept_byte_for_byte_and_the_others_are_not(tmp_path):
    path, source = tmp_path / "flat.exr", header_of_input()
    write_flat(path, picture(), source, attributes={"lbmc:version": "1"})
    (header,) = read_headers(path)
    assert (header.data_window, header.display_window) == (source.data_window, source.display_window)
    assert header.pixel_aspect == 2.0
    for name, value in kept_attributes(source).items():
        assert header.attributes[name] == value
    assert "preview" not in header.attributes
    assert "deepImageState" not in header.attributes
    assert "lbmc:model" not in header.attributes
    assert header.get("lbmc:version") == "1"
    with OpenEXR.File(str(path), header_only=True) as file:
        assert file.header()["owner"] == source.get("owner")


def test_an_attribute_that_the_library_does_not_know_is_no_obstacle(tmp_path):
    path = tmp_path / "flat.exr"
    write_flat(path, picture(), attributes={"state": Attribute("deepImageState", b"\1"), "owner": "me"})
    with pytest.raises(RuntimeError, match="deepImageState"):
        OpenEXR.File(str(path), separate_channels=True)
    image = read_flat(path)
    assert_same(picture(), image.channels)
    assert image.header.get("owner") == "me"


def test_parts_read_back_with_their_names_and_attributes(tmp_path):
    path = tmp_path / "parts.exr"
    images = [FlatImage.of(picture(index), header_of_input(), name=f"part{index}", attributes={"index": index})
              for index in range(3)]
    write_parts(path, images, "zips")
    back = read_flat_parts(path)
    assert [image.header.name for image in back] == ["part0", "part1", "part2"]
    for index, image in enumerate(back):
        assert image.header.get("index") == index
        assert_same(images[index].channels, image.channels)
    assert_same(images[1].channels, read_flat(path, "part1").channels)
    assert_same(images[2].channels, read_flat(path, 2).channels)
    with OpenEXR.File(str(path), separate_channels=True) as file:
        for index, part in enumerate(file.parts):
            assert_same(images[index].channels, {name: channel.pixels for name, channel in part.channels.items()})
    with pytest.raises(InputError, match="its parts are part0, part1, part2"):
        read_flat(path, "part3")


def test_without_a_part_the_one_with_rgb_is_read(tmp_path):
    path = tmp_path / "parts.exr"
    grey = np.zeros((2, 2), np.float16)
    write_parts(path, [FlatImage.of({"Z": grey}, name="depth"),
                       FlatImage.of({"R": grey, "G": grey, "B": grey}, name="beauty")])
    assert read_flat(path).header.name == "beauty"


def test_the_same_input_gives_the_same_bytes(tmp_path):
    for name in ("a.exr", "b.exr"):
        write_flat(tmp_path / name, picture(), header_of_input())
    assert (tmp_path / "a.exr").read_bytes() == (tmp_path / "b.exr").read_bytes()


def test_strided_arrays_are_written_right(tmp_path):
    path = tmp_path / "flat.exr"
    pixels = np.arange(60, dtype=np.float32).reshape(4, 5, 3)
    write_flat(path, {name: pixels[:, :, index] for index, name in enumerate("RGB")})
    np.testing.assert_array_equal(read_flat(path).channels["G"], pixels[:, :, 1])


@pytest.mark.parametrize("keep", [0.2, 0.6, 0.98])
def test_truncated_files_are_errors(tmp_path, keep):
    path = tmp_path / "flat.exr"
    write_flat(path, picture(height=200, width=200))
    data = path.read_bytes()
    path.write_bytes(data[:int(len(data) * keep)])
    with pytest.raises(InputError, match=r"flat\.exr"):
        read_flat(path)


def test_deep_files_and_what_is_no_exr_are_errors(tmp_path):
    deep = tmp_path / "deep.exr"
    write_deep(deep, random_samples())
    with pytest.raises(InputError, match="deep EXR where a flat one"):
        read_flat(deep)
    text = tmp_path / "text.exr"
    text.write_text("not a picture")
    with pytest.raises(InputError, match="not an EXR"):
        read_flat(text)


def test_images_that_cannot_be_written_are_refused(tmp_path):
    grey = np.zeros((2, 2), np.float16)
    with pytest.raises(ValueError, match="one shape"):
        FlatImage.of({"R": grey, "G": np.zeros((3, 2), np.float16)})
    with pytest.raises(ValueError, match="do not fit the data window"):
        FlatImage.of({"R": grey}, header_of_input())
    with pytest.raises(ValueError, match="distinct names"):
        write_parts(tmp_path / "x.exr", [FlatImage.of({"R": grey})] * 2)
    with pytest.raises(ValueError, match="not 'zstd'"):
        write_flat(tmp_path / "x.exr", {"R": grey}, compression="zstd")
    with pytest.raises(OSError, match="absent"):
        write_flat(tmp_path / "absent" / "x.exr", {"R": grey})
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("kept", [0, 0.3, 0.9, 0.999])
@pytest.mark.parametrize("height", [3, 200])
def test_a_disk_that_takes_only_a_part_is_an_error(tmp_path, height, kept):
    """A small picture waits whole in the library's buffer, whose last flush nobody checks."""
    path, pixels = tmp_path / "x.exr", picture(height=height)
    write_flat(path, pixels)
    _, most = before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (int(kept * path.stat().st_size), most))
    try:
        with pytest.raises(OSError, match=r"File too large|only a part of it"):
            write_flat(path, pixels)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)


def test_half_clamps_and_counts():
    half, clamped = to_half(np.array([1.0, -1e9, 7e4, np.inf, 65504, np.nan]))
    np.testing.assert_array_equal(half, np.array([1, -65504, 65504, 65504, 65504, np.nan], np.float16))
    assert clamped == 3


def test_the_reference_pictures_of_a_library_are_read(tmp_path: Path):
    path = tmp_path / "oiio.exr"
    spec = oiio.ImageSpec(6, 4, 3, oiio.HALF)
    spec.attribute("compression", "dwaa")
    output = oiio.ImageOutput.create(str(path))
    assert output.open(str(path), spec)
    assert output.write_image(np.full((4, 6, 3), 0.25, np.float32))
    output.close()
    np.testing.assert_allclose(read_flat(path).channels["B"], 0.25, rtol=0.01)
