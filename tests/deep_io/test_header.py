"""Headers of every kind of EXR: parsed by our own code, encoded byte-exact."""

import os
import struct
from dataclasses import replace
from fractions import Fraction

import numpy as np
import OpenEXR
import OpenImageIO as oiio
import pytest
from hypothesis import given
from hypothesis import strategies as st

from deep_io import Channel, Header, InputError, Window, read_deep, read_headers, write_deep
from deep_io.attributes import Attribute, attribute
from deep_io.header import channels_of, encode_header, needs_long_names, parse_headers
from tests.deep_io.deep_files import openexr_part, random_samples, seeded, write_openexr

STANDARD = {
    "aString": "a text with ünïcode", "anInt": -5, "aFloat": 0.25, "names": ["left", "right eye", ""],
    "v2i": (1, -2), "v2f": (1.5, 2.0), "v3i": (1, 2, 3), "v3f": (0.5, 1.5, 2.5),
    "worldToCamera": tuple(float(i) for i in range(16)), "m33": tuple(i / 2 for i in range(9)),
    "floats": (1.0, 2.0, 3.0, 4.0, 5.0),
}
TYPED = {
    "aDouble": ("double", 0.1), "aBox2i": ("box2i", (1, 2, 3, 4)), "aBox2f": ("box2f", (1.0, 2.0, 3.0, 4.0)),
    "v2d": ("v2d", (0.1, 0.2)), "v3d": ("v3d", (0.1, 0.2, 0.3)), "m33d": ("m33d", tuple(i / 3 for i in range(9))),
    "m44d": ("m44d", tuple(i / 3 for i in range(16))), "chromaticities": ("chromaticities", (0.5,) * 8),
    "aRate": ("rational", (24000, 1001)), "keyCode": ("keycode", (1, 2, 3, 4, 5, 4, 64)),
    "timeCode": ("timecode", (0x01020304, 7)), "deepImageState": ("deepImageState", 1), "envmap": ("envmap", 0),
}


def header_of(**changes) -> Header:
    return replace(Header(channels_of({"R": np.float16}), Window(0, 0, 3, 1), Window(0, 0, 7, 7)), **changes)


@pytest.mark.parametrize(("name", "value"), STANDARD.items())
def test_plain_values_take_their_natural_type_and_come_back(name, value):
    assert attribute(value).value == value


@pytest.mark.parametrize(("kind", "value"), TYPED.values())
def test_standard_types_come_back(kind, value):
    assert attribute(value, kind) == Attribute(kind, attribute(value, kind).data)
    assert attribute(value, kind).value == value


@pytest.mark.parametrize("value", [None, object(), (), ("a", 1), {"a": 1}])
def test_values_without_an_exr_type_are_refused(value):
    with pytest.raises(TypeError):
        attribute(value)


@seeded
@given(st.binary(max_size=80), st.sampled_from(["string", "stringvector", "m44f", "v2i", "floatvector", "mystery"]))
def test_reading_a_value_never_fails(data, kind):
    assert Attribute(kind, data).value is not None


def test_attributes_are_written_as_the_libraries_read_them(tmp_path):
    path = tmp_path / "a.exr"
    samples = random_samples()
    header = Header.of_samples(samples, Window(-10, -10, 30, 30), STANDARD).with_attributes(
        {name: attribute(value, kind) for name, (kind, value) in TYPED.items()
         if kind != "deepImageState"})  # OpenEXR's Python binding refuses whole files for this standard attribute.
    write_deep(path, samples, replace(header, pixel_aspect=1.5))
    seen = OpenEXR.File(str(path), separate_channels=True).parts[0].header
    assert seen["aString"] == STANDARD["aString"]
    assert seen["anInt"] == -5
    assert seen["names"] == STANDARD["names"]
    assert np.array_equal(np.ravel(seen["worldToCamera"]), STANDARD["worldToCamera"])
    assert seen["aDouble"] == 0.1
    assert seen["aRate"] == Fraction(24000, 1001)
    assert seen["pixelAspectRatio"] == 1.5
    assert tuple(seen["displayWindow"][1]) == (30, 30)
    spec = oiio.ImageInput.open(str(path)).spec(0)
    assert spec.getattribute("aString") == STANDARD["aString"]
    assert (spec.full_x, spec.full_width) == (-10, 41)


def test_attributes_written_by_the_library_come_back_byte_exact(tmp_path):
    first, second = tmp_path / "a.exr", tmp_path / "b.exr"
    samples = random_samples()
    matrix = np.arange(16, dtype=np.float32).reshape(4, 4)
    write_openexr(first, openexr_part(samples, comments="hello", worldToCamera=matrix, owner="me", capDate="2020",
                                      keyCode=OpenEXR.KeyCode(1, 2, 3, 4, 5, 4, 64), when=OpenEXR.TimeCode()))
    read, header = read_deep(first)
    assert header.get("comments") == "hello"
    assert header.get("worldToCamera") == tuple(range(16))
    write_deep(second, read, header)
    again = read_headers(second)[0]
    assert again.attributes == header.attributes
    assert replace(again, structure={}) == replace(header, structure={})


def test_unknown_types_and_bytes_that_are_not_utf8_are_kept(tmp_path):
    strange = {"studio:blob": Attribute("blobType", b"\x00\xff\x01"), "latin": Attribute("string", b"caf\xe9")}
    samples = random_samples()
    write_deep(tmp_path / "a.exr", samples, replace(Header.of_samples(samples), attributes=strange))
    found = read_headers(tmp_path / "a.exr")[0].attributes
    assert {name: found[name] for name in strange} == strange
    assert attribute(found["latin"].value).data == b"caf\xe9"


def test_long_names_set_the_flag_and_read_in_both_libraries(tmp_path):
    path, name = tmp_path / "a.exr", "ViewLayer with a long name.Denoising Albedo.R"
    samples = random_samples(channels={name: np.float16, "Z": np.float32})
    write_deep(path, samples)
    assert path.read_bytes()[5] & 0x04
    assert name in OpenEXR.File(str(path), separate_channels=True).parts[0].channels
    assert name in oiio.ImageInput.open(str(path)).spec(0).channelnames
    assert name in read_headers(path)[0].channel_names
    assert not needs_long_names(header_of())
    with pytest.raises(ValueError, match="1 to 255 bytes"):
        encode_header(header_of(channels=channels_of({"x" * 256: np.float16})))


def test_channels_are_sorted_by_bytes():
    assert [c.name for c in channels_of({"b": np.float16, "a": np.float16, "é": np.uint32, "B": np.float32})] == [
        "B", "a", "b", "é"]
    with pytest.raises(ValueError, match="float64"):
        channels_of({"R": np.float64})


@pytest.mark.parametrize("compression", ["none", "rle", "zips", "zip", "piz", "pxr24", "b44", "b44a", "dwaa", "dwab"])
@pytest.mark.parametrize("tiled", [False, True])
def test_flat_headers_are_read(tmp_path, compression, tiled):
    path = tmp_path / "flat.exr"
    spec = oiio.ImageSpec(70, 50, 3, oiio.HALF)
    spec.x, spec.y = -4, 9
    spec.attribute("compression", compression)
    if tiled:
        spec.tile_width = spec.tile_height = 32
    output = oiio.ImageOutput.create(str(path))
    assert output.open(str(path), spec)
    assert output.write_image(np.zeros((50, 70, 3), np.float32))
    output.close()
    (header,) = read_headers(path)
    assert header.compression == compression
    assert header.type == ("tiledimage" if tiled else "scanlineimage")
    assert header.data_window == Window(-4, 9, 65, 58)
    assert header.channels == tuple(Channel(name, np.dtype(np.float16)) for name in "BGR")
    assert not header.is_deep


def test_all_parts_are_read(tmp_path):
    path = tmp_path / "parts.exr"
    left, right = random_samples(1), random_samples(2, channels={"G": np.float32})
    write_openexr(path, openexr_part(left, name="left"), openexr_part(right, "rle", name="right"))
    headers = read_headers(path)
    assert [(h.name, h.compression, h.channel_names) for h in headers] == [
        ("left", "zips", ("A", "R", "Z", "id")), ("right", "rle", ("G",))]


@pytest.mark.parametrize(("name", "stored"), [
    ("channels", Attribute("chlist", b"R\0" + struct.pack("<iIii", 7, 0, 1, 1) + b"\0")),
    ("channels", Attribute("chlist", b"R\0" + struct.pack("<iIii", 1, 0, 0, 1) + b"\0")),
    ("channels", Attribute("chlist", 2 * (b"R\0" + struct.pack("<iIii", 1, 0, 1, 1)) + b"\0")),
    ("channels", Attribute("chlist", b"R\0" + struct.pack("<iIi", 1, 0, 1))),
    ("channels", Attribute("chlist", b"")),
    ("dataWindow", Attribute("box2i", struct.pack("<4i", 5, 0, 4, 9))),
    ("dataWindow", Attribute("box2i", b"1234")),
    ("lineOrder", Attribute("string", b"up")),
    ("compression", None),
])
def test_a_corrupt_required_attribute_is_named(tmp_path, name, stored):
    plain = encode_header(header_of())
    start = plain.index(name.encode() + b"\0")
    kind_end = plain.index(b"\0", start + len(name) + 1) + 1
    (size,) = struct.unpack_from("<i", plain, kind_end)
    patch = b"" if stored is None else (name.encode() + b"\0" + stored.type.encode() + b"\0"
                                        + struct.pack("<i", len(stored.data)) + stored.data)
    path = tmp_path / "a.exr"
    path.write_bytes(struct.pack("<iI", 20000630, 0x802) + plain[:start] + patch + plain[kind_end + 4 + size:])
    with pytest.raises(InputError, match=r"a\.exr: the header('s| has no| names)") as caught:
        read_headers(path)
    assert "\n" not in str(caught.value)


def test_every_truncation_of_a_header_is_an_input_error(tmp_path):
    path = tmp_path / "a.exr"
    samples = random_samples()
    write_deep(path, samples)
    with path.open("rb") as file:
        end = parse_headers(file, "a.exr").end
    data = path.read_bytes()
    for size in range(end):
        path.write_bytes(data[:size])
        with pytest.raises(InputError, match=r"a\.exr: "):
            read_headers(path)


@seeded
@given(st.binary(min_size=0, max_size=300))
def test_random_bytes_after_the_magic_are_an_input_error_or_a_header(tmp_path_factory, data):
    path = tmp_path_factory.getbasetemp() / "random.exr"
    path.write_bytes(struct.pack("<iI", 20000630, 0x802) + data)
    with pytest.raises(InputError, match=r"random\.exr: "):
        read_headers(path)


@pytest.mark.parametrize("data", [b"", b"short", b"\x89PNG\r\n\x1a\n" + bytes(100)])
def test_other_files_are_not_exrs(tmp_path, data):
    (tmp_path / "a.exr").write_bytes(data)
    with pytest.raises(InputError, match=r"a\.exr: not an EXR file"):
        read_headers(tmp_path / "a.exr")


def test_a_missing_file_is_an_input_error(tmp_path):
    with pytest.raises(InputError, match=r"nowhere\.exr: cannot be opened: No such file"):
        read_headers(tmp_path / "nowhere.exr")


def test_a_pipe_is_refused_and_not_waited_for(tmp_path):
    os.mkfifo(tmp_path / "pipe.exr")
    with pytest.raises(InputError, match=r"pipe\.exr: is a pipe or a device"):
        read_headers(tmp_path / "pipe.exr")


@pytest.mark.parametrize("window", [
    Window(0, 0, 2**30 - 1, 0), Window(-(2**30) + 1, 0, 0, 0), Window(0, 0, 0, 2**31 - 1),
])
def test_windows_beyond_the_format_are_refused_as_openexr_refuses_them(tmp_path, window):
    header = replace(header_of(), display_window=window)
    (tmp_path / "a.exr").write_bytes(struct.pack("<iI", 20000630, 2) + encode_header(header))
    with pytest.raises(InputError, match=r"a\.exr: the header's displayWindow is beyond"):
        read_headers(tmp_path / "a.exr")


@pytest.mark.parametrize("aspect", [0.0, -1.0, float("inf"), float("nan")])
def test_a_pixel_aspect_that_makes_no_sense_is_refused(tmp_path, aspect):
    header = header_of(pixel_aspect=aspect)
    (tmp_path / "a.exr").write_bytes(struct.pack("<iI", 20000630, 2) + encode_header(header))
    with pytest.raises(InputError, match=r"a\.exr: the header's pixelAspectRatio is .* must be positive and finite"):
        read_headers(tmp_path / "a.exr")


def test_a_version_from_the_future_is_refused(tmp_path):
    (tmp_path / "a.exr").write_bytes(struct.pack("<iI", 20000630, 3) + encode_header(header_of()))
    with pytest.raises(InputError, match="version"):
        read_headers(tmp_path / "a.exr")
