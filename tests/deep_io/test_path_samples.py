"""Deep files as path samples: weights, roles, conversions, and what becomes of values that are not finite."""

from __future__ import annotations

import math
import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from deep_io import DeepSamples, Header, Window, write_deep
from deep_io.errors import InputError, UsageError
from deep_io.flat import read_flat
from deep_io.path_samples import PathSamples, SampleReader

NAN, INF = math.nan, math.inf


def write(path: Path, channels: Mapping[str, Any], counts: Any = None, attributes: Mapping[str, object] | None = None,
          dtype: Any = np.float16, window: Window | None = None, display: Window | None = None) -> str:
    """A deep file of one row of pixels; without counts one pixel holds all samples. Z is float32."""
    arrays = {name: np.asarray(values, np.float32 if name == "Z" else dtype) for name, values in channels.items()}
    counts = np.atleast_2d(np.asarray([len(next(iter(arrays.values())))] if counts is None else counts, np.int32))
    samples = DeepSamples(counts, arrays, window or Window(0, 0, counts.shape[1] - 1, counts.shape[0] - 1))
    write_deep(path, samples, Header.of_samples(samples, display, attributes))
    return str(path)


def read(path: str, **options: Any) -> PathSamples:
    with SampleReader(path, threads=1, **options) as reader:
        return reader.read()


@pytest.fixture
def file(tmp_path: Path) -> Path:
    return tmp_path / "in.exr"


def rgb(*values: float) -> dict[str, list[float]]:
    return {name: list(values) for name in "RGB"}


def test_uniform_samples_come_back_as_stored_with_equal_weights(file):
    path = write(file, {**rgb(1, 2, 3), "A": [1, 0, 1], "Z": [5, 1e10, 7], "N.X": [0.5, 9, 0], "N.Y": [0, 9, 0],
                        "N.Z": [0.5, 9, 1], "time": [0.25, 0.5, 0.75]}, counts=[2, 0, 1])
    samples = read(path)
    assert samples.counts.tolist() == [[2, 0, 1]]
    assert samples.weight.tolist() == [0.5, 0.5, 1]
    assert samples.coverage.tolist() == [1, 0, 1]
    assert samples.roles["radiance"].tolist() == [[1, 1, 1], [2, 2, 2], [3, 3, 3]]
    assert samples.roles["depth"].tolist() == [[5], [0], [7]]
    assert samples.roles["normal"].tolist() == [[0.5, 0, 0.5], [0, 0, 0], [0, 0, 1]]
    assert samples.roles["time"].tolist() == [[0.25], [0], [0.75]]
    assert not samples.repairs
    assert all(values.dtype == np.float32 and values.flags.c_contiguous for values in samples.roles.values())


def test_coverage_comes_from_depth_without_alpha_and_is_one_without_either(file):
    assert read(write(file, {**rgb(1, 1, 1), "Z": [1, 1e10, INF]})).coverage.tolist() == [1, 0, 0]
    assert read(write(file, rgb(1, 1))).coverage.tolist() == [1, 1]


def test_an_opaque_sky_is_a_miss(file):
    samples = read(write(file, {**rgb(1, 1), "A": [1, 1], "Z": [3, 1e10]}))
    assert samples.coverage.tolist() == [1, 0]
    assert samples.roles["depth"].tolist() == [[3], [0]]
    assert not samples.repairs


def test_a_nan_radiance_is_left_out_and_the_weights_renormalised(file):
    path = write(file, {"R": [1, NAN, 3, NAN], "G": [1, 2, 3, 4], "B": [1, 2, 3, 4], "A": [1, 1, 0, 1],
                        "time": [0.1, 0.2, 0.3, 0.4]}, counts=[3, 1])
    samples = read(path)
    assert samples.counts.tolist() == [[2, 0]]
    assert samples.weight.tolist() == [0.5, 0.5]
    assert samples.roles["radiance"][:, 0].tolist() == [1, 3]
    assert samples.roles["time"][:, 0].tolist() == [np.float32(np.float16(0.1)), 0]
    assert samples.repairs == {"radiance": 2}


def test_infinite_half_radiance_is_an_overflow_and_infinite_float_radiance_is_broken(file):
    samples = read(write(file, {"R": [INF, 1], "G": [2, -INF], "B": [3, 1]}))
    assert samples.roles["radiance"].tolist() == [[65504, 2, 3]]
    assert samples.repairs == {"radiance": 2}
    samples = read(write(file, {"R": [INF, 1], "G": [2, 1], "B": [3, 1]}, dtype=np.float32))
    assert samples.roles["radiance"].tolist() == [[1, 1, 1]]
    assert samples.weight.tolist() == [1]


def test_nan_radiance_under_over_counts_as_black_and_keeps_its_alpha(file):
    path = write(file, {"R": [NAN, 1], "G": [1, 1], "B": [1, 1], "A": [0.5, 1], "Z": [1, 2]})
    samples = read(path, weighting="over")
    assert samples.weight.tolist() == [0.5, 0.5]
    assert samples.roles["radiance"].tolist() == [[0, 0, 0], [1, 1, 1]]
    assert samples.repairs == {"radiance": 1}


def test_features_that_are_not_finite_become_missing_and_are_counted_but_not_on_misses(file):
    path = write(file, {**rgb(1, 1, 1), "A": [1, 1, 0], "Z": [NAN, -4, INF], "albedo.R": [NAN, 0.5, NAN],
                        "albedo.G": [0.5, 0.5, 0.5], "albedo.B": [0.5, 0.5, 0.5], "coc": [INF, 1, -INF]})
    samples = read(path)
    assert samples.repairs == {"depth": 2, "albedo": 1, "coc": 1}
    assert samples.roles["depth"].tolist() == [[0], [0], [0]]
    assert samples.roles["albedo"].tolist() == [[0, 0, 0], [0.5, 0.5, 0.5], [0, 0, 0]]
    assert samples.roles["coc"].tolist() == [[0], [1], [0]]
    assert samples.counts.tolist() == [[3]]


def test_numbers_as_large_as_buffers_that_overflowed_are_broken_like_infinity(file):
    largest = float(np.finfo(np.float32).max)
    path = write(file, {**rgb(1, largest, 1e29, -1), "albedo.R": [largest, 0, 0, 65504], "albedo.G": [0] * 4,
                        "albedo.B": [0] * 4, "roughness": [0.5, 0.5, -largest, 0.5]}, dtype=np.float32)
    samples = read(path)
    assert samples.roles["radiance"][:, 0].tolist() == [1, np.float32(1e29), -1]
    assert samples.roles["albedo"].tolist() == [[0, 0, 0], [0, 0, 0], [65504, 0, 0]]
    assert samples.roles["roughness"][:, 0].tolist() == [0.5, 0, 0.5]
    assert samples.repairs == {"radiance": 1, "albedo": 1, "roughness": 1}


def test_alpha_that_is_not_finite_is_no_coverage(file):
    samples = read(write(file, {**rgb(1, 1), "A": [NAN, 1]}))
    assert samples.coverage.tolist() == [0, 1]
    assert samples.repairs == {"coverage": 1}


def test_fractional_alpha_needs_a_weighting(file):
    path = write(file, {**rgb(1, 1), "A": [0.5, 1]})
    with pytest.raises(InputError, match=r"in\.exr: alpha is fractional.*pass --weighting uniform or over"):
        read(path)
    assert read(path, weighting="uniform").coverage.tolist() == [0.5, 1]
    with SampleReader(path, weighting="over") as reader:
        assert reader.weighting == "over"


def test_the_attribute_states_the_weighting_and_the_option_wins(file):
    path = write(file, {**rgb(1, 1), "A": [0.5, 1], "Z": [1, 2]}, attributes={"lbmc:weighting": "packed"})
    with SampleReader(path) as reader:
        assert reader.weighting == "packed"
        assert reader.read().roles["radiance"][:, 0].tolist() == [2, 1]
    assert read(path, weighting="over").weight.tolist() == [0.5, 0.5]


def test_an_unknown_weighting_is_an_error(file):
    path = write(file, rgb(1), attributes={"lbmc:weighting": "median"})
    with pytest.raises(InputError, match="'median'"):
        SampleReader(path)
    with pytest.raises(UsageError, match="--weighting mean"):
        SampleReader(path, weighting="mean")


@pytest.mark.parametrize("weighting", ["packed", "over"])
def test_weightings_by_alpha_need_one(file, weighting):
    with pytest.raises(InputError, match="needs an alpha channel"):
        SampleReader(write(file, rgb(1)), weighting=weighting)


def test_over_adds_virtual_misses_without_features_also_where_a_block_has_no_sample(file):
    path = write(file, {**rgb(1), "A": [0.5], "Z": [2], "roughness": [0.5]}, counts=[0, 1])
    samples = read(path, weighting="over")
    assert samples.counts.tolist() == [[1, 2]]
    assert samples.coverage.tolist() == [0, 1, 0]
    assert samples.roles["roughness"][:, 0].tolist() == [0, 0.5, 0]
    two_rows = write(file, {**rgb(1), "A": [1.0], "Z": [2]}, counts=[[0], [1]])
    with SampleReader(two_rows, weighting="over") as reader:
        empty = reader.read(0, 1)
    assert empty.counts.tolist() == [[1]]
    assert empty.roles["depth"].tolist() == [[0]]


def test_a_file_without_any_sample_is_an_error(file):
    with pytest.raises(InputError, match="no sample anywhere"):
        SampleReader(write(file, {name: [] for name in "RGB"}, counts=[0, 0]))
    for weighting in ("uniform", "packed"):
        with pytest.raises(InputError, match="no sample anywhere"):
            SampleReader(write(file, {name: [] for name in "RGBA"}, counts=[0, 0]), weighting=weighting)


def test_a_file_without_any_sample_is_an_empty_picture_under_over(file):
    path = write(file, {name: [] for name in ("R", "G", "B", "A", "Z", "roughness")}, counts=[[0, 0], [0, 0]],
                 attributes={"lbmc:weighting": "over"})
    samples = read(path)
    assert samples.counts.tolist() == [[1, 1], [1, 1]]
    assert samples.weight.tolist() == [1] * 4
    assert samples.coverage.tolist() == [0] * 4
    assert all((values == 0).all() and len(values) == 4 for values in samples.roles.values())
    with SampleReader(path) as reader:
        assert sum(block.total for block in reader.blocks(max_bytes=1)) == 4


def test_a_depth_below_any_normal_number_is_unknown_and_not_broken(file):
    """Equal depths are stored apart by the least step of a float, unknown ones, which are 0, too."""
    tiny = float(np.finfo(np.float32).tiny)
    samples = read(write(file, {**rgb(1, 1, 1, 1, 1), "Z": [0, 1e-45, 3e-45, tiny, -1e-45]}))
    assert samples.roles["depth"][:, 0].tolist() == [0, 0, 0, tiny, 0]
    assert samples.repairs == {"depth": 1}  # the negative one
    assert samples.coverage.tolist() == [1] * 5


def test_blocks_hold_the_same_samples_as_the_whole(file):
    rng = np.random.default_rng(3)
    counts = rng.integers(0, 5, (20, 7)).astype(np.int32)
    total = int(counts.sum())
    path = write(file, {name: rng.random(total) for name in ("R", "G", "B", "coc")}, counts)
    whole = read(path)
    with SampleReader(path) as reader:
        blocks = list(reader.blocks(max_bytes=300))
    assert len(blocks) > 5
    for role, values in whole.roles.items():
        np.testing.assert_array_equal(np.concatenate([block.roles[role] for block in blocks]), values)
    np.testing.assert_array_equal(np.concatenate([block.counts for block in blocks]), whole.counts)
    np.testing.assert_array_equal(np.concatenate([block.weight for block in blocks]), whole.weight)


def test_over_means_what_openimageio_flattens(file):
    rng = np.random.default_rng(5)
    counts = rng.integers(0, 6, (9, 11)).astype(np.int32)
    total = int(counts.sum())
    alpha = rng.choice([0, 0.25, 0.5, 1], total)
    depth = np.sort(rng.permutation(total)) + 1  # distinct and front to back: OpenImageIO does not sort
    path = write(file, {**{name: rng.random(total) for name in "RGB"}, "A": alpha, "Z": depth}, counts,
                 dtype=np.float32)
    flat = file.with_name("flat.exr")
    subprocess.run([Path(sys.executable).with_name("oiiotool"), path, "--flatten", "-o", flat], check=True)
    expected = read_flat(flat).channels
    samples = read(path, weighting="over")
    pixel = np.repeat(np.arange(counts.size), samples.counts.ravel())
    for index, name in enumerate("RGB"):
        got = np.bincount(pixel, samples.weight * samples.roles["radiance"][:, index].astype(np.float64), counts.size)
        np.testing.assert_allclose(got.reshape(counts.shape), expected[name], rtol=1e-5, atol=1e-6)
    got = np.bincount(pixel, samples.weight * samples.coverage, counts.size)
    np.testing.assert_allclose(got.reshape(counts.shape), expected["A"], atol=1e-6)


def matrix_attribute(rotation: np.ndarray) -> list[float]:
    matrix = np.eye(4)
    matrix[:3, :3] = rotation
    matrix[3, :3] = 5, 6, 7  # a translation, which normals ignore
    return matrix.ravel().tolist()


def test_world_normals_are_turned_by_the_header_camera_and_z_faces_the_camera(file):
    # The camera looks along world +X: camera x = world -Y, camera y = world +Z, camera z (forward) = world +X.
    rotation = np.array([[0, 0, 1], [-1, 0, 0], [0, 1, 0]])  # rows: where world x, y, z go, row vectors
    normal = {"Normal.X": [-1, 0], "Normal.Y": [0, 0], "Normal.Z": [0, 1]}
    path = write(file, {**rgb(1, 1), **normal}, attributes={"worldToCamera": tuple(matrix_attribute(2 * rotation))})
    np.testing.assert_allclose(read(path).roles["normal"], [[0, 0, 1], [0, 1, 0]], atol=1e-6)
    np.testing.assert_allclose(read(path, normals="view").roles["normal"], [[-1, 0, 0], [0, 0, 1]])


def test_world_normals_without_a_camera_are_an_error_that_names_the_cures(file, tmp_path):
    path = write(file, {**rgb(1), "Normal.X": [0], "Normal.Y": [0], "Normal.Z": [1]})
    with pytest.raises(InputError, match=r"worldToCamera; give the camera with --camera.*--normals view.*normal=none"):
        SampleReader(path)
    camera = tmp_path / "camera.txt"
    camera.write_text(" ".join(map(str, matrix_attribute(np.diag([1, 1, -1])))))
    assert read(path, camera=str(camera)).roles["normal"].tolist() == [[0, 0, 1]]


def test_camera_normals_with_z_forward_are_mirrored(file):
    path = write(file, {**rgb(1), "Ns.X": [0.5], "Ns.Y": [0.25], "Ns.Z": [-0.75]})
    assert read(path).roles["normal"].tolist() == [[0.5, 0.25, 0.75]]


def test_ray_lengths_become_planar_by_the_field_of_view(file):
    # 90 degrees over a display window of 4 pixels: focal length 2 pixels. The data window is the lower right pixel.
    display = Window(0, 0, 3, 1)
    path = write(file, {**rgb(1), "distance": [10.0]}, dtype=np.float32, window=Window(3, 1, 3, 1), display=display)
    expected = 10 / math.sqrt(1 + (1.5 / 2) ** 2 + (0.5 / 2) ** 2)
    assert read(path, camera="90").roles["depth"][0, 0] == pytest.approx(expected, rel=1e-6)
    with pytest.raises(InputError, match=r"length of the ray.*--camera DEGREES"):
        SampleReader(path)


def test_the_depth_option_says_that_a_plain_z_is_a_ray_length(file):
    path = write(file, {**rgb(1), "Z": [10.0]})
    assert read(path, depth="distance", camera="90").roles["depth"][0, 0] == pytest.approx(10)
    assert read(path).roles["depth"][0, 0] == 10


def test_the_depth_option_says_that_a_layer_of_ray_lengths_is_planar(file):
    path = write(file, {**rgb(1), "distance": [10.0]}, attributes={"lbmc:depth": "distance"})
    assert read(path, depth="z").roles["depth"][0, 0] == 10


def test_zero_is_a_miss_in_the_depth_of_mitsuba(file):
    path = write(file, {**rgb(1, 1), "A": [1, 1], "dd.y.T": [0, 4]}, attributes={"generatedBy": "Mitsuba version 3.9"})
    assert read(path, camera="1e-3").coverage.tolist() == [0, 1]


def test_our_own_attributes_state_space_and_depth(file):
    path = write(file, {**rgb(1), "Z": [1], "N.X": [0], "N.Y": [0], "N.Z": [1]},
                 attributes={"lbmc:weighting": "uniform", "lbmc:normals": "world", "lbmc:depth": "distance"})
    with pytest.raises(InputError, match="world space"):
        SampleReader(path)
    with pytest.raises(InputError, match="length of the ray"):
        SampleReader(path, normals="view")


@pytest.mark.parametrize(("camera", "error"), [("0", UsageError), ("180", UsageError), ("absent.json", InputError)])
def test_cameras_that_make_no_sense_are_errors(file, camera, error):
    with pytest.raises(error):
        SampleReader(write(file, rgb(1)), camera=camera)


def test_a_json_camera_gives_both(file, tmp_path):
    camera = tmp_path / "camera.json"
    camera.write_text('{"fieldOfView": 90, "worldToCamera": [1,0,0,0, 0,1,0,0, 0,0,-1,0, 0,0,0,1]}')
    path = write(file, {**rgb(1), "distance": [2], "Normal.X": [0], "Normal.Y": [0], "Normal.Z": [1]})
    samples = read(path, camera=str(camera))
    assert samples.roles["normal"].tolist() == [[0, 0, 1]]
    assert samples.roles["depth"][0, 0] == 2
    camera.write_text('{"fov": 90}')
    with pytest.raises(UsageError, match="fov"):
        SampleReader(path, camera=str(camera))


def test_a_singular_camera_is_an_error(file):
    path = write(file, {**rgb(1), "Normal.X": [0], "Normal.Y": [0], "Normal.Z": [1]},
                 attributes={"worldToCamera": (0.0,) * 16})
    with pytest.raises(InputError, match="singular"):
        SampleReader(path)


@pytest.mark.parametrize("text", [
    '{"fieldOfView": true}', '{"fieldOfView": NaN}', '{"worldToCamera": [' + ", ".join(["Infinity"] * 16) + "]}",
    " ".join(["nan"] * 16),
])
def test_a_camera_file_of_numbers_that_make_no_sense_is_an_error(file, tmp_path, text):
    (tmp_path / "camera.txt").write_text(text)
    with pytest.raises(UsageError, match=r"--camera .*camera\.txt: (the field of view|worldToCamera) must"):
        SampleReader(write(file, rgb(1)), camera=str(tmp_path / "camera.txt"))


def test_a_header_camera_that_is_not_finite_is_an_error(file):
    path = write(file, {**rgb(1), "Normal.X": [0], "Normal.Y": [0], "Normal.Z": [1]},
                 attributes={"worldToCamera": (float("inf"),) * 16})
    with pytest.raises(InputError, match="worldToCamera matrix is not finite"):
        SampleReader(path)


def test_the_window_is_kept(file):
    path = write(file, rgb(1, 2), counts=[1, 1], window=Window(-5, 7, -4, 7))
    assert read(path).window == Window(-5, 7, -4, 7)
