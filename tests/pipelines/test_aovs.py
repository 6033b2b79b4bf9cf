"""Which channels an AOV's name stands for, and how each kind is filtered."""

from __future__ import annotations

import numpy as np
import pytest

from deep_io import Header, InputError, Window
from deep_io.attributes import attribute
from deep_io.header import channels_of
from deep_io.role_matching import map_roles
from deep_io.roles import MISS_DEPTH
from pipelines.aovs import Aov, Aovs, beauty_channels, find_aovs
from pipelines.inference import FrameLayers

NAMES = ("R", "G", "B", "A", "Z", "N.X", "N.Y", "N.Z", "albedo.R", "albedo.G", "albedo.B", "key.R", "key.G", "key.B",
         "key.A", "fog", "pos.X", "pos.Y", "pos.Z", "crypto00.R", "crypto00.G")
WINDOW = Window(0, 0, 1, 0)
HEADER = Header(channels_of({**dict.fromkeys(NAMES, np.float16), "id": np.uint32}), WINDOW, WINDOW,
                attributes={"cryptomatte/1234567/name": attribute("crypto")})
MAPPING = map_roles(HEADER.channel_names)


def find(*names: str) -> Aovs:
    return find_aovs(names, HEADER, MAPPING, "in.exr")


@pytest.mark.parametrize(
    ("name", "expected"),
    [
        ("key", Aov(("key.R", "key.G", "key.B"), ("key.R", "key.G", "key.B"), "light")),
        ("fog", Aov(("fog",), ("fog",), "data")),
        ("key.R", Aov(("key.R",), ("key.R",), "data")),
        ("pos", Aov(("pos.X", "pos.Y", "pos.Z"), ("pos.X", "pos.Y", "pos.Z"), "data")),
        ("albedo", Aov(("albedo.R", "albedo.G", "albedo.B"), ("albedo.R", "albedo.G", "albedo.B"), "data")),
        ("normal", Aov(("N.X", "N.Y", "N.Z"), ("N.X", "N.Y", "N.Z"), "data")),
        ("Z", Aov(("Z",), ("Z",), "depth")),
        ("depth", Aov(("Z",), ("Z",), "depth")),
    ],
)
def test_a_name_is_a_layer_a_channel_or_a_role(name: str, expected: Aov) -> None:
    assert find(name, name).groups == (expected,)


def test_lights_come_before_data_as_the_reader_carries_them() -> None:
    aovs = find("fog", "key", "pos", "Z")
    assert aovs.channels("light") == ["key.R", "key.G", "key.B"]
    assert aovs.outputs == ["key.R", "key.G", "key.B", "fog", "pos.X", "pos.Y", "pos.Z"]
    assert aovs.depth == "Z"


@pytest.mark.parametrize(
    ("name", "said"),
    [
        ("rim", "no AOV 'rim'; there are .*key.*fog"),
        ("id", "--ids id"),
        ("crypto00", "--ids crypto writes"),
        ("crypto00.G", "--ids crypto writes"),
        ("R", "the beauty itself"),
        ("radiance", "the beauty itself"),
        ("A", "the beauty itself"),
    ],
)
def test_unknown_names_ids_and_the_beauty_are_refused(name: str, said: str) -> None:
    with pytest.raises(InputError, match=said):
        find(name)


@pytest.mark.parametrize("name", ["R", "A", "Z"])
def test_an_aov_cannot_take_the_name_of_the_beauty_or_of_another_depth(name: str) -> None:
    header = Header(channels_of(dict.fromkeys((*"RGBAZ", *"XYW", "far.Z", "key.R", "key.G", "key.B"), np.float32)),
                    WINDOW, WINDOW)
    mapping = map_roles(header.channel_names, {"radiance": "key", "coverage": "W", "depth": "far"})
    with pytest.raises(InputError, match=f"in.exr: --aov {name}: {name} is the .* name in an output"):
        find_aovs(["X", name], header, mapping, "in.exr")
    assert find_aovs(["depth"], header, mapping, "in.exr").depth == "Z"


@pytest.mark.parametrize(("first", "second", "channel"), [
    ("key", "key.R", "key.R"), ("key.G", "key", "key.G"), ("depth", "Z", "Z"), ("N", "normal", "N.X"),
])
def test_two_aovs_cannot_write_the_same_channel(first: str, second: str, channel: str) -> None:
    with pytest.raises(InputError, match=f"in.exr: --aov {second}: {channel} is written by --aov {first} already"):
        find(first, second)


def test_the_depth_is_one_aov_whatever_it_is_called() -> None:
    header = Header(channels_of(dict.fromkeys((*"RGBA", "far.Z"), np.float32)), WINDOW, WINDOW)
    mapping = map_roles(header.channel_names, {"depth": "far"})
    assert find_aovs(["far.Z"], header, mapping, "in.exr").depth == "far.Z"
    with pytest.raises(InputError, match="--aov depth: Z is written by --aov far.Z already"):
        find_aovs(["far.Z", "depth"], header, mapping, "in.exr")


def test_the_beautys_aovs_are_sums_and_its_depth_a_mean() -> None:
    ones = np.ones((2, 1, 2), np.float32)
    coverage = np.array([[[0.25, 0.0]], [[0.75, 0.0]]], np.float32)
    depth = np.array([[[2.0, np.inf]], [[6.0, np.inf]]], np.float32)
    extra = np.stack([ones * 0.5, ones * 2], 1)[:, :, 0][:, :, None]
    layers = FrameLayers(np.zeros((2, 3, 1, 2), np.float32), ones / 2, coverage, depth, extra)
    groups = Aovs((Aov(("fog",), ("fog",), "data"), Aov(("Z",), ("Z",), "depth"), Aov(("ao",), ("ao",), "data")))
    planes = beauty_channels(groups, layers)
    assert planes["fog"].tolist() == [[1, 1]]
    assert planes["ao"].tolist() == [[4, 4]]
    assert planes["Z"].tolist() == [[5, np.float32(MISS_DEPTH)]]
