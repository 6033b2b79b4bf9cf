"""Parts of a flat render merged under names that say what they are."""

from __future__ import annotations

import numpy as np
import pytest

from deep_io import Window
from deep_io.errors import InputError
from deep_io.flat import FlatImage, write_flat_parts
from deep_io.header import Header, channels_of
from pipelines.flat_renders import merge_parts, read_renders


def part(name: str, channels: str, value: float = 0, **attributes: object) -> FlatImage:
    return FlatImage.of({channel: np.full((2, 3), value + index, np.float16) for index, channel in
                         enumerate(channels.split())}, name=name, attributes=attributes)


def test_bare_names_take_their_part_but_the_beauty_stays_bare():
    merged = merge_parts([part("albedo", "R G B", 10), part("main", "R G B A", 20), part("N", "X Y Z", 30),
                          part("depth", "Z", 40)], "x.exr")
    assert sorted(merged.channels) == ["A", "B", "G", "N.X", "N.Y", "N.Z", "R", "albedo.B", "albedo.G", "albedo.R",
                                       "depth.Z"]
    assert merged.channels["R"][0, 0] == 20
    assert merged.channels["N.Z"][0, 0] == 32


def test_names_that_repeat_their_part_stay_and_attributes_of_all_parts_are_kept():
    merged = merge_parts([part("VL.Combined", "VL.Combined.R VL.Combined.G VL.Combined.B", owner="me"),
                          part("VL.Depth", "VL.Depth.Z", owner="you", shot="7")], "x.exr")
    assert "VL.Depth.Z" in merged.channels
    assert merged.header.get("owner") == "me"
    assert merged.header.get("shot") == "7"


def test_a_render_of_bare_parts_maps_to_roles(tmp_path):
    for seed in range(2):
        write_flat_parts(tmp_path / f"{seed}.exr", [part("rgba", "R G B A", seed), part("N", "X Y Z"),
                                                    part("diffuse_albedo", "R G B")])
    stack = read_renders([tmp_path / "0.exr", tmp_path / "1.exr"])
    assert stack.mapping.roles == ("radiance", "coverage", "normal", "albedo")
    block = stack.block(0, 1)
    assert block.channels["R"].tolist() == [0, 1] * 3
    assert (block.counts == 2).all()


def test_parts_with_different_windows_are_an_error():
    other = FlatImage({"Z": np.zeros((2, 3), np.float16)},
                      Header(channels_of({"Z": np.float16}), Window(1, 0, 3, 1), Window(0, 0, 2, 1), "depth"))
    with pytest.raises(InputError, match=r"x\.exr: the windows of parts 'main' and 'depth' differ"):
        merge_parts([part("main", "R G B"), other], "x.exr")


@pytest.mark.parametrize(("names", "beauty"), [
    (("diffuse", "rgba"), "rgba"),
    (("diffuse", "beauty", "glossy"), "beauty"),
    (("albedo", "main"), "main"),
    (("primary", "albedo", "diffuse_albedo"), "primary"),
])
def test_the_beauty_is_the_part_that_its_name_says_or_that_is_left(names: tuple[str, ...], beauty: str) -> None:
    merged = merge_parts([part(name, "R G B A", 10 * number) for number, name in enumerate(names)], "x.exr")
    assert merged.channels["R"][0, 0] == 10 * names.index(beauty)


def test_of_parts_that_all_could_be_the_beauty_none_is_taken(tmp_path) -> None:
    for seed in range(2):
        write_flat_parts(tmp_path / f"{seed}.exr", [part("diffuse", "R G B A", seed), part("glossy", "R G B A"),
                                                    part("primary", "R G B A", 5 + seed)])
    files = [tmp_path / "0.exr", tmp_path / "1.exr"]
    with pytest.raises(InputError, match=r"--map radiance=LAYER \(there are diffuse, glossy, primary\)"):
        read_renders(files)
    stack = read_renders(files, {"radiance": "primary"})
    assert stack.block(0, 1).channels["primary.R"].tolist() == [5, 6] * 3


def test_two_channels_that_would_get_one_name_are_an_error() -> None:
    with pytest.raises(InputError, match=r"x\.exr: part 'albedo' and another one both hold the channel 'albedo\.R'"):
        merge_parts([part("rgba", "R G B A albedo.R albedo.G albedo.B"), part("albedo", "R G B")], "x.exr")
