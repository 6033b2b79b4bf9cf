"""What info says of a file: counted by hand on small files of every kind."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from deep_io import DeepSamples, DeepWriter, Header, InputError, Window, write_deep
from deep_io.attributes import attribute
from pipelines.info import file_info


def write(path: Path, counts: list[list[int]], channels: dict[str, list[float]], **attributes: str) -> Path:
    """A deep file of half channels with the given samples."""
    table = np.array(counts, np.int32)
    height, width = table.shape
    window = Window(10, 20, 10 + width - 1, 20 + height - 1)
    arrays = {name: np.array(values, np.float32 if name == "Z" else np.float16) for name, values in channels.items()}
    samples = DeepSamples(table, arrays, window)
    header = Header.of_samples(samples).with_attributes(
        {name.replace("__", ":"): attribute(value, "string") for name, value in attributes.items()}
    )
    write_deep(path, samples, header)
    return path


@pytest.fixture
def small(tmp_path: Path) -> Path:
    """2 x 2 pixels with 2, 0, 1 and 3 samples; one of the six is a miss, one has a NaN radiance."""
    return write(
        tmp_path / "small.exr",
        [[2, 0], [1, 3]],
        {
            "R": [1, 2, 3, 4, 5, np.nan],
            "G": [0, 0, 0, 0, 0, 0],
            "B": [0.5] * 6,
            "A": [1, 1, 1, 1, 0, 1],
            "Z": [1, 2, 3, 4, 1e10, 6],
            "roughness": [0.25, 0.5, 1, 1, 0, 1],
            "time": [0.5, 0.5, 1, 1, 0.25, 1],
        },
        owner="somebody",
    )


def test_samples_pixels_and_misses_are_counted(small: Path) -> None:
    found = file_info(small).as_dict()
    assert (found["pixels"], found["empty_pixels"], found["samples"], found["misses"]) == (4, 1, 5, 1)
    assert found["samples_per_pixel"] == {"min": [0], "mean": [1.25], "max": [2]}
    assert found["repairs"] == {"radiance": 1}
    assert found["weighting"] == "uniform"


def test_only_what_the_file_stores_is_counted_under_over(tmp_path: Path) -> None:
    channels = {"R": [1, 1, 2], "G": [1, 1, 2], "B": [1, 1, 2], "A": [0.5, 0.5, 0.5], "Z": [1, 2, 3]}
    path = write(tmp_path / "over.exr", [[2, 0], [1, 0]], channels, lbmc__weighting="over")
    found = file_info(path).as_dict()
    assert (found["pixels"], found["empty_pixels"], found["samples"], found["misses"]) == (4, 2, 3, 0)
    assert found["samples_per_pixel"] == {"min": [0], "mean": [0.75], "max": [2]}
    assert found["roles"]["coverage"]["min"] == [1]


def test_first_hit_roles_leave_misses_out_and_radiance_keeps_them(small: Path) -> None:
    roles = file_info(small).as_dict()["roles"]
    assert roles["radiance"] == {"min": [1, 0, 0.5], "mean": [3, 0, 0.5], "max": [5, 0, 0.5]}
    assert roles["depth"] == {"min": [1], "mean": [2.5], "max": [4]}
    assert roles["time"] == {"min": [0.5], "mean": [0.75], "max": [1]}
    assert roles["roughness"] == {"min": [0.25], "mean": [0.6875], "max": [1]}


def test_blocks_add_up_to_the_whole(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    counts = rng.integers(0, 5, (300, 40))
    total = int(counts.sum())
    names = ["R", "G", "B", "Z"]
    path = write(tmp_path / "many.exr", counts.tolist(), {n: rng.uniform(0.5, 9, total).tolist() for n in names})
    roles = file_info(path).as_dict()["roles"]
    assert roles["radiance"]["mean"] == pytest.approx([4.75] * 3, rel=0.05)
    assert file_info(path).as_dict()["samples"] == total


def test_the_header_is_shown_and_json_is_plain(small: Path) -> None:
    found = file_info(small)
    plain = json.loads(json.dumps(found.as_dict(), allow_nan=False))
    part = plain["parts"][0]
    assert part["data_window"] == [10, 20, 11, 21]
    assert part["channels"]["Z"] == "float32"
    assert part["attributes"]["owner"] == "somebody"
    assert plain["mapping"]["depth"] == ["Z"]
    text = "\n".join(found.lines())
    for expected in (
        "2 x 2, (10, 20) to (11, 21)",
        "somebody",
        "radiance   <- R G B",
        "1 x radiance",
        "1 of them misses",
    ):
        assert expected in text


def test_the_part_that_was_read_is_told(tmp_path: Path) -> None:
    channels = {name: np.ones(2, np.float16) for name in "RGB"}
    samples = DeepSamples(np.ones((1, 2), np.int32), channels, Window(0, 0, 1, 0))
    headers = [replace(Header.of_samples(samples), name=name) for name in ("left", "right")]
    with DeepWriter(tmp_path / "two.exr", headers) as writer:
        for part in (0, 1):
            writer.write(samples, part)
    assert [file_info(tmp_path / "two.exr", part=name).part for name in ("left", "right", "1")] == [0, 1, 1]


def test_broken_values_that_are_finite_are_repairs_too(tmp_path: Path) -> None:
    channels = {"R": [1.0, 1], "G": [1, 1], "B": [1, 1], "Z": [-1, 2]}
    assert file_info(write(tmp_path / "negative.exr", [[2]], channels)).as_dict()["repairs"] == {"depth": 1}
    sound = file_info(write(tmp_path / "sound.exr", [[2]], {**channels, "Z": [1, 2]}))
    assert "repaired    nothing: no value is broken" in sound.lines()


def test_fractional_alpha_without_a_weighting_is_refused(tmp_path: Path) -> None:
    path = write(tmp_path / "f.exr", [[1]], {"R": [1], "G": [1], "B": [1], "A": [0.5], "Z": [1]})
    with pytest.raises(InputError, match="--weighting"):
        file_info(path)
    assert file_info(path, weighting="over").weighting == "over"
    assert file_info(path, weighting="over").as_dict()["samples"] == 1  # without the virtual miss behind it


def test_the_headers_weighting_is_followed(tmp_path: Path) -> None:
    channels = {"R": [0.5, 1], "G": [1, 1], "B": [1, 1], "A": [0.5, 1], "Z": [1, 2]}
    path = write(tmp_path / "p.exr", [[2]], channels, lbmc__weighting="packed")
    found = file_info(path)
    assert found.weighting == "packed"
    assert found.as_dict()["roles"]["coverage"]["min"] == [1]
