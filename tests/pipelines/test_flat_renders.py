"""Flat renders: parts merged under names that say what they are, and pictures told apart."""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from deep_io import Window
from deep_io.errors import InputError
from deep_io.flat import FlatImage, write_flat, write_flat_parts
from deep_io.header import Header, channels_of
from pipelines import flat_renders
from pipelines.flat_renders import merge_parts, open_renders


def part(name: str, channels: str, value: float = 0, **attributes: object) -> FlatImage:
    return FlatImage.of({channel: np.full((2, 3), value + index, np.float16) for index, channel in
                         enumerate(channels.split())}, name=name, attributes=attributes)


def merged(*parts: FlatImage) -> tuple[Header, dict[str, tuple[int, str]]]:
    return merge_parts([image.header for image in parts], "x.exr")


def test_bare_names_take_their_part_but_the_beauty_stays_bare():
    header, places = merged(part("albedo", "R G B"), part("main", "R G B A"), part("N", "X Y Z"), part("depth", "Z"))
    assert sorted(places) == ["A", "B", "G", "N.X", "N.Y", "N.Z", "R", "albedo.B", "albedo.G", "albedo.R", "depth.Z"]
    assert tuple(sorted(places)) == header.channel_names
    assert (places["R"], places["N.Z"]) == ((1, "R"), (2, "Z"))


def test_names_that_repeat_their_part_stay_and_attributes_of_all_parts_are_kept():
    header, places = merged(part("VL.Combined", "VL.Combined.R VL.Combined.G VL.Combined.B", owner="me"),
                            part("VL.Depth", "VL.Depth.Z", owner="you", shot="7"))
    assert places["VL.Depth.Z"] == (1, "VL.Depth.Z")
    assert header.get("owner") == "me"
    assert header.get("shot") == "7"


def test_a_render_of_bare_parts_maps_to_roles(tmp_path):
    for seed in range(2):
        write_flat_parts(tmp_path / f"{seed}.exr", [part("rgba", "R G B A", seed), part("N", "X Y Z"),
                                                    part("diffuse_albedo", "R G B")])
    stack = open_renders([tmp_path / "0.exr", tmp_path / "1.exr"])
    assert stack.mapping.roles == ("radiance", "coverage", "normal", "albedo")
    block = next(stack.blocks(6))
    assert block.window == Window(0, 0, 2, 0)
    assert block.channels["R"].tolist() == [0, 1] * 3
    assert (block.counts == 2).all()


def test_parts_with_different_windows_are_an_error():
    other = FlatImage({"Z": np.zeros((2, 3), np.float16)},
                      Header(channels_of({"Z": np.float16}), Window(1, 0, 3, 1), Window(0, 0, 2, 1), "depth"))
    with pytest.raises(InputError, match=r"x\.exr: the windows of parts 'main' and 'depth' differ"):
        merged(part("main", "R G B"), other)


@pytest.mark.parametrize(("names", "beauty"), [
    (("diffuse", "rgba"), "rgba"),
    (("diffuse", "beauty", "glossy"), "beauty"),
    (("albedo", "main"), "main"),
    (("primary", "albedo", "diffuse_albedo"), "primary"),
])
def test_the_beauty_is_the_part_that_its_name_says_or_that_is_left(names: tuple[str, ...], beauty: str) -> None:
    _, places = merged(*(part(name, "R G B A") for name in names))
    assert places["R"] == (names.index(beauty), "R")


def test_of_parts_that_all_could_be_the_beauty_none_is_taken(tmp_path) -> None:
    for seed in range(2):
        write_flat_parts(tmp_path / f"{seed}.exr", [part("diffuse", "R G B A", seed), part("glossy", "R G B A"),
                                                    part("primary", "R G B A", 5 + seed)])
    files = [tmp_path / "0.exr", tmp_path / "1.exr"]
    with pytest.raises(InputError, match=r"--map radiance=LAYER \(there are diffuse, glossy, primary\)"):
        open_renders(files)
    stack = open_renders(files, {"radiance": "primary"})
    assert next(stack.blocks(6)).channels["primary.R"].tolist() == [5, 6] * 3


def test_two_channels_that_would_get_one_name_are_an_error() -> None:
    with pytest.raises(InputError, match=r"x\.exr: part 'albedo' and another one both hold the channel 'albedo\.B'"):
        merged(part("rgba", "R G B A albedo.R albedo.G albedo.B"), part("albedo", "R G B"))


def write_tall(path: Path, picture: dict[str, np.ndarray], compression: str = "zip") -> Path:
    write_flat(path, picture, compression=compression)
    return path


def tall(seed: int = 0) -> dict[str, np.ndarray]:
    rng = np.random.default_rng(seed)
    return {name: rng.random((600, 4)).astype(np.float32) for name in "RGBZ"}


@pytest.mark.parametrize("row", [0, 299, 599])
def test_renders_that_differ_in_one_pixel_anywhere_are_two_pictures(tmp_path, row):
    one, other = tall(), tall()
    other["G"][row, 2] += 1
    paths = [write_tall(tmp_path / "a.exr", one), write_tall(tmp_path / "b.exr", other)]
    assert len(open_renders(paths).renders) == 2


def test_the_first_of_several_pairs_is_named_whatever_their_compression(tmp_path):
    pictures = [tall(0), tall(1), tall(2), tall(1), tall(0)]
    paths = [write_tall(tmp_path / f"{number}.exr", picture, compression) for number, (picture, compression)
             in enumerate(zip(pictures, ("zip", "zips", "piz", "none", "zip"), strict=True))]
    with pytest.raises(InputError, match=r"3\.exr: holds the same picture as .*1\.exr;"):
        open_renders(paths)


def test_pictures_of_one_colour_may_be_alike_beside_others_that_may_not(tmp_path):
    black = {name: np.zeros((600, 4), np.float32) for name in "RGBZ"}
    paths = [write_tall(tmp_path / f"{number}.exr", picture) for number, picture
             in enumerate([black, tall(), black, tall(1)])]
    assert len(open_renders(paths).renders) == 4
    with pytest.raises(InputError, match=r"1\.exr: holds the same picture as .*1\.exr;"):
        open_renders([*paths, paths[1]])


@pytest.mark.parametrize(("compressions", "together"), [
    (("zip", "zip"), 16), (("zip", "piz"), 32), (("zip", "dwab"), 256)])
def test_bands_are_whole_chunks_of_every_render(tmp_path, compressions, together):
    stack = open_renders([write_tall(tmp_path / f"{seed}.exr", tall(seed), compression)
                          for seed, compression in enumerate(compressions)])
    bands = stack.bands()
    assert [bands[0][0], bands[-1][1]] == [0, 600]
    assert all(before[1] == after[0] and after[0] % together == 0 for before, after in pairwise(bands))
    assert stack.pieces == 1


@pytest.mark.parametrize("rows", [1, 7, 40, 255])
def test_chunks_beyond_the_memory_that_may_be_held_are_read_in_pieces(tmp_path, monkeypatch, rows):
    stack = open_renders([write_tall(tmp_path / f"{seed}.exr", tall(seed), "dwab") for seed in range(2)])
    whole = np.concatenate([block.channels["Z"] for block in stack.blocks(10000)])
    monkeypatch.setattr(flat_renders, "BAND_BYTES", rows * 2 * 4 * 4 * 4)
    bands = stack.bands()
    assert [bands[0][0], bands[-1][1]] == [0, 600]
    assert max(y1 - y0 for y0, y1 in bands) <= rows
    assert stack.pieces == -(-256 // rows)
    assert all(before[1] == after[0] for before, after in pairwise(bands))
    np.testing.assert_array_equal(np.concatenate([block.channels["Z"] for block in stack.blocks(100)]), whole)


def test_only_float_light_goes_beyond_half(tmp_path):
    one, other = tall(), tall(1)
    other["B"][599, 3] = 1e5
    paths = [write_tall(tmp_path / "a.exr", one), write_tall(tmp_path / "b.exr", other)]
    stack = open_renders(paths)
    assert stack.goes_beyond_half("RGB")
    assert not stack.goes_beyond_half("RG")
    other["B"][599, 3] = np.inf  # is no light
    write_tall(paths[1], {name: values.astype(np.float16) if name == "G" else values for name, values in other.items()})
    assert not open_renders(paths).goes_beyond_half("RGB")
