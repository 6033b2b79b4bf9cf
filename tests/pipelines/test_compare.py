"""Comparing files: what is measured, and what is refused with both names."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import OpenEXR
import pytest

from deep_io import DeepSamples, InputError, Window, write_deep
from deep_io.flat import FlatImage, write_flat_parts
from model.metrics import score
from pipelines.compare import compare, mean_scores, score_lines, scores_as_dict
from pipelines.flat_pictures import read_rgb


def write_flat(path: Path, rgb: np.ndarray, corner: tuple[int, int] = (0, 0), names: Sequence[str] = "RGB") -> Path:
    """A flat scanline EXR of float channels (H, W, of `names`) whose data window starts at `corner` (x, y)."""
    height, width = rgb.shape[:2]
    window = (np.array(corner, np.int32), np.array([corner[0] + width - 1, corner[1] + height - 1], np.int32))
    header = {"type": OpenEXR.scanlineimage, "compression": OpenEXR.ZIP_COMPRESSION, "dataWindow": window}
    channels = {name: np.ascontiguousarray(rgb[..., i], np.float32) for i, name in enumerate(names)}
    OpenEXR.File(header, channels).write(str(path))
    return path


def picture(seed: int, shape: tuple[int, int] = (16, 20)) -> np.ndarray:
    return np.random.default_rng(seed).uniform(0.1, 2.0, (*shape, 3)).astype(np.float32)


def test_files_score_as_their_pixels_do(tmp_path: Path) -> None:
    image, reference = write_flat(tmp_path / "a.exr", picture(0)), write_flat(tmp_path / "b.exr", picture(1))
    assert compare(image, reference).scores == score(picture(0), picture(1))


def test_two_halves_are_averaged_and_give_the_unbiased_error(tmp_path: Path) -> None:
    paths = [write_flat(tmp_path / f"{seed}.exr", picture(seed)) for seed in range(3)]
    found = compare(*paths)
    assert found.scores == score(picture(0), picture(1), picture(2))
    assert found.scores.floor is not None
    np.testing.assert_allclose(found.target, (picture(1) + picture(2)) / 2, rtol=1e-6)
    assert any("free of the reference's noise" in line for line in score_lines(found.scores))


@pytest.mark.parametrize(("shape", "corner"), [((16, 21), (0, 0)), ((16, 20), (3, -2))])
def test_windows_that_differ_are_both_named(tmp_path: Path, shape: tuple[int, int], corner: tuple[int, int]) -> None:
    image = write_flat(tmp_path / "a.exr", picture(0))
    reference = write_flat(tmp_path / "b.exr", picture(1, shape), corner)
    with pytest.raises(
        InputError, match=rf"a.exr is 20 x 16 at \(0, 0\), but .*b.exr is {shape[1]} x 16 at \({corner[0]}"
    ):
        compare(image, reference)


def test_a_black_reference_is_refused(tmp_path: Path) -> None:
    image = write_flat(tmp_path / "a.exr", picture(0))
    reference = write_flat(tmp_path / "b.exr", np.zeros((16, 20, 3)))
    with pytest.raises(InputError, match="b.exr: the reference has no light"):
        compare(image, reference)


def test_a_reference_that_is_black_but_for_some_pixels_is_not_called_dark(tmp_path: Path) -> None:
    stars = np.zeros((16, 20, 3))
    stars[3, 3] = 5.0
    with pytest.raises(InputError, match=r"b.exr: 99 % of the reference's values are black"):
        compare(write_flat(tmp_path / "a.exr", picture(0)), write_flat(tmp_path / "b.exr", stars))


def test_pixels_that_are_not_finite_are_counted(tmp_path: Path) -> None:
    broken = picture(0)
    broken[3, 4, 1], broken[5, 5] = np.nan, np.inf
    with pytest.raises(InputError, match="a.exr: 2 pixels are not finite"):
        compare(write_flat(tmp_path / "a.exr", broken), write_flat(tmp_path / "b.exr", picture(1)))


def test_a_file_without_colour_is_refused(tmp_path: Path) -> None:
    image = write_flat(tmp_path / "a.exr", picture(0), names="XYZ")
    with pytest.raises(InputError, match="a.exr: no R, G, B"):
        compare(image, write_flat(tmp_path / "b.exr", picture(1)))


def test_a_layer_is_read_where_it_is_and_a_picture_alone_as_it_is(tmp_path: Path) -> None:
    names = ("R", "G", "B", "diffuse.R", "diffuse.G", "diffuse.B", "id.x")
    channels = np.concatenate([picture(0), picture(1), picture(2)[..., :1]], axis=-1)
    layers = write_flat(tmp_path / "layers.exr", channels, names=names)
    plain = write_flat(tmp_path / "plain.exr", picture(3))
    np.testing.assert_array_equal(read_rgb(layers).rgb, picture(0))
    np.testing.assert_array_equal(read_rgb(layers, layer="diffuse").rgb, picture(1))
    np.testing.assert_array_equal(read_rgb(plain, part="beauty", layer="diffuse").rgb, picture(3))
    assert compare(layers, plain, layer="diffuse").scores == score(picture(1), picture(3))
    with pytest.raises(InputError, match=r"layers.exr: no layer 'id' with a colour; its layers are diffuse"):
        read_rgb(layers, layer="id")  # not the beauty, silently


def test_a_part_is_found_by_name_number_and_layer(tmp_path: Path) -> None:
    def part(seed: int, name: str, layer: str = "") -> FlatImage:
        return FlatImage.of({f"{layer}{c}": picture(seed)[..., i] for i, c in enumerate("RGB")}, name=name)

    path = tmp_path / "parts.exr"
    write_flat_parts(path, [part(0, "first", "key."), part(1, "second"), part(2, "third")])
    for words, seed in (({}, 1), ({"part": "third"}, 2), ({"part": "2"}, 2), ({"layer": "key"}, 0),
                        ({"part": "first", "layer": "key"}, 0)):
        np.testing.assert_array_equal(read_rgb(path, **words).rgb, picture(seed))
    with pytest.raises(InputError, match="has no part 'none'; its parts are first, second, third"):
        read_rgb(path, "none")
    for words in ({"layer": "none"}, {"part": "second", "layer": "key"}):
        with pytest.raises(InputError, match="no layer '.*' with a colour"):
            read_rgb(path, **words)


def test_a_file_whose_colour_is_a_layers_says_how_to_take_it(tmp_path: Path) -> None:
    path = write_flat(tmp_path / "layer.exr", picture(0), names=("beauty.R", "beauty.G", "beauty.B"))
    with pytest.raises(InputError, match=r"no R, G, B channels \(its channels: beauty.B, .*\); .*--layer beauty"):
        read_rgb(path)


@pytest.mark.parametrize("copy", [False, True])
def test_halves_that_are_one_picture_are_refused(copy: bool, tmp_path: Path) -> None:
    image, reference = write_flat(tmp_path / "a.exr", picture(0)), write_flat(tmp_path / "b.exr", picture(1))
    half = write_flat(tmp_path / "c.exr", picture(1)) if copy else reference
    with pytest.raises(InputError, match=f"b.exr and .*{half.name} are the same picture; two independent"):
        compare(image, reference, half)


def test_a_deep_file_is_refused(tmp_path: Path) -> None:
    channels: dict[str, np.ndarray] = {name: np.ones(1, np.float16) for name in "RGB"}
    write_deep(tmp_path / "a.exr", DeepSamples(np.ones((1, 1), np.int32), channels, Window(0, 0, 0, 0)))
    with pytest.raises(InputError, match=r"a.exr: is a deep EXR where a flat one is needed; lbmc denoise \S*a.exr OUT"):
        compare(tmp_path / "a.exr", tmp_path / "a.exr")


def test_means_are_geometric_for_relmse_only() -> None:
    rows = [score(factor * picture(1), picture(1), with_flip=False) for factor in (1.1, 1.4)]
    means = mean_scores(rows)
    assert means["relmse"] == pytest.approx((rows[0].relmse * rows[1].relmse) ** 0.5)
    assert means["smape"] == pytest.approx((rows[0].smape + rows[1].smape) / 2)
    assert means["flip"] is None


def test_json_has_no_infinity() -> None:
    perfect = scores_as_dict(score(picture(0), picture(0)))
    assert perfect["psnr"] is None
    assert perfect["relmse"] == 0.0
