"""Frame patterns and ranges, on real folders with gaps and strangers in them."""

from __future__ import annotations

from pathlib import Path

import pytest

from deep_io.errors import InputError, UsageError
from deep_io.sequences import (
    Frame,
    expand,
    frame_path,
    gaps,
    has_pattern,
    is_sequence,
    pair,
    parse_frames,
    sibling_path,
    substitute,
)


@pytest.fixture
def shot(tmp_path: Path) -> Path:
    """Frames 1001 to 1003 and 1005, and files that only look like frames."""
    for name in ("shot.1001.exr", "shot.1002.exr", "shot.1003.exr", "shot.1005.exr", "shot.1.exr", "shot.01004.exr",
                 "shot.1004.jpg", "shotgun.1004.exr", ".shot.1004.1234.tmp.exr"):
        (tmp_path / name).touch()
    return tmp_path


@pytest.mark.parametrize("pattern", ["shot.####.exr", "shot.%04d.exr", "shot.$F4.exr", "shot.@@@@.exr"])
def test_every_style_of_pattern_finds_the_frames_on_disk_in_order(shot, pattern):
    frames = expand(shot / pattern)
    assert [frame.number for frame in frames] == [1001, 1002, 1003, 1005]
    assert frames[0].source == shot / "shot.1001.exr"


def test_a_range_chooses_frames_with_a_step_and_each_once(shot):
    assert [frame.number for frame in expand(shot / "shot.####.exr", "1001-1005x2,1001")] == [1001, 1003, 1005]
    assert [frame.number for frame in expand(shot / "shot.1001-1002####.exr")] == [1001, 1002]
    assert parse_frames("3,1,2") == [3, 1, 2]


def test_missing_frames_are_all_listed(shot):
    with pytest.raises(InputError, match=r"shot\.####\.exr: 4 of 8 frames are missing: 1004,1006-1008$"):
        expand(shot / "shot.####.exr", "1001-1008")


@pytest.mark.parametrize(("numbers", "missing"), [
    ([1, 2, 3], ""), ([5], ""), ([1, 3, 5], ""), ([1, 2, 5], "3-4"), ([1, 3, 9, 7, 13], "5,11"), ([None], ""), ([], ""),
    ([0, 10, 40], "20-30x10"), ([1, 2, 10**12], f"3-{10**12 - 1}"), ([1, 1, 5], ""), ([1, 4, 9], "7"),
])
def test_gaps_are_frames_that_the_least_step_lacks(numbers, missing):
    assert gaps([Frame(number, Path("in.exr")) for number in numbers]) == missing


def test_outputs_take_their_own_pattern(shot):
    frames = pair(shot / "shot.####.exr", "out/clean.%05d.exr", "1001,1005")
    assert [frame.target for frame in frames] == [Path("out/clean.01001.exr"), Path("out/clean.01005.exr")]


def test_a_single_file_is_one_frame_without_a_number(shot):
    (frame,) = pair(shot / "shot.1001.exr", shot / "out.exr")
    assert (frame.number, frame.source, frame.target) == (None, shot / "shot.1001.exr", shot / "out.exr")
    assert str(frame) == "shot.1001.exr"


@pytest.mark.parametrize(("source", "target", "message"), [
    ("shot.####.exr", "out.exr", "IN is a sequence .* but OUT is a single file.*out.####.exr"),
    ("shot.1001.exr", "out.####.exr", "OUT is a sequence but IN"),
    ("nothing.####.exr", "out.####.exr", "no file matches the pattern"),
    ("absent/shot.####.exr", "out.####.exr", "the folder .*absent does not exist"),
    ("absent.exr", "out.exr", "no such file"),
    (".", "out.exr", "is a folder"),
])
def test_inputs_and_outputs_that_do_not_fit_are_unsuitable(shot, source, target, message):
    with pytest.raises(InputError, match=message):
        pair(shot / source, target)


@pytest.mark.parametrize("text", ["1001-", "a-b", "", "1-5x0", "1001-1100x2y", "1.5", "1-1000000000"])
def test_ranges_that_cannot_be_read_are_usage_errors(shot, text):
    with pytest.raises(UsageError, match="--frames"):
        expand(shot / "shot.####.exr", text)


@pytest.mark.parametrize("name", ["2024-11-23-####.exr", "shot_1-2-####.exr", "1001,####.exr", "shot.10x####.exr",
                                  "comp_2####.exr", "v3.####.exr"])
def test_what_ends_in_no_digit_is_a_name_and_no_range(name, tmp_path):
    (tmp_path / name.replace("####", "0001")).touch()
    assert [frame.number for frame in expand(tmp_path / name)] == [1]
    assert frame_path(name, 2) == Path(name.replace("####", "0002"))


def test_a_range_that_cannot_be_read_is_quoted_as_it_was_given(tmp_path):
    with pytest.raises(UsageError, match=r"shot\.2024-11-23####\.exr: 2024-11-23: not a frame range") as caught:
        expand(tmp_path / "shot.2024-11-23####.exr")
    assert "--frames" not in str(caught.value)
    with pytest.raises(UsageError, match="^'1-': not a frame range"):
        parse_frames("1-")
    with pytest.raises(UsageError, match="^--seeds 1-: not a frame range"):
        parse_frames("1-", "--seeds 1-")


def test_a_range_with_a_single_file_is_a_usage_error(shot):
    with pytest.raises(UsageError, match="no pattern such as ####"):
        expand(shot / "shot.1001.exr", "1001")


def test_an_existing_file_with_a_hash_in_its_name_is_a_single_file(tmp_path):
    (tmp_path / "take#2.exr").touch()
    assert not is_sequence(tmp_path / "take#2.exr")
    assert is_sequence(tmp_path / "take#3.exr")
    assert not is_sequence("renders#2/beauty.exr")


def test_a_hash_is_one_digit_and_negative_frames_are_files_too(tmp_path):
    assert frame_path("shot.##.exr", 7) == Path("shot.07.exr")
    (tmp_path / "shot.-005.exr").touch()
    assert [frame.number for frame in expand(tmp_path / "shot.####.exr")] == [-5]


def test_a_token_is_replaced_by_each_value(tmp_path):
    assert substitute("s@SEED@.####.exr", "@SEED@", [1, 2]) == ["s1.####.exr", "s2.####.exr"]
    with pytest.raises(UsageError, match="does not hold @SEED@"):
        substitute("s.####.exr", "@SEED@", [1])


@pytest.mark.parametrize("name", [
    "renders#2/shot.####.exr", "a@b/shot.####.exr", "shot_v2####.exr", "take#2.####.exr", "user@host.####.exr",
    "shot####x2.exr", "shot.####_left.exr", "x(####).exr", "x.[####].exr", "100%.####.exr", "a b é.####.exr", "####",
])
def test_only_the_number_of_a_name_is_replaced(name, tmp_path):
    expected = Path(name.replace("####", "0007"))
    assert frame_path(name, 7) == expected
    (tmp_path / expected).parent.mkdir(exist_ok=True)
    (tmp_path / expected).touch()
    assert [frame.source for frame in expand(tmp_path / name)] == [tmp_path / expected]


@pytest.mark.parametrize("name", ["user@host.exr", "take@2.exr", "beauty.exr", "$Final.exr", "100%done.exr"])
def test_a_word_with_a_sign_in_it_is_no_pattern(name, tmp_path):
    (tmp_path / "in.exr").touch()
    assert not has_pattern(name)
    assert pair(tmp_path / "in.exr", tmp_path / name)[0].target == tmp_path / name
    with pytest.raises(UsageError, match="no pattern such as ####"):
        frame_path(name, 1)


@pytest.mark.parametrize("name", ["shot.%03d.####.exr", "shot.####.####.exr"])
def test_a_name_with_two_numbers_is_refused(name, tmp_path):
    with pytest.raises(UsageError, match="write the frame number once"):
        expand(tmp_path / name)


def test_the_neighbour_of_a_single_frame_is_found_by_its_number():
    assert sibling_path("shots/shot.v2.1002.deep.exr", 998) == Path("shots/shot.v2.0998.deep.exr")
    assert sibling_path("beauty.exr", 1) is None
