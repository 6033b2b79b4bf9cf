"""Packing flat renders: any deep reader flattens the file to the renders' mean, and lbmc reads the renders back."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import OpenEXR
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from deep_io import Window, read_headers
from deep_io.errors import InputError, UsageError
from deep_io.flat import FlatImage, read_flat, write_flat, write_flat_parts
from deep_io.header import Header, channels_of
from deep_io.path_samples import PathSamples, SampleReader
from pipelines import flat_renders
from pipelines.pack import OVERFLOW, PackOptions, pack, pack_frames, plan
from pipelines.survey import survey

OIIOTOOL = Path(sys.executable).with_name("oiiotool")
WIDTH, HEIGHT = 13, 9
HALF = 2.0**-10  # relative rounding of a half, twice


def render(seed: int, half: bool = True, fractions: bool = True, depth: bool = True) -> dict[str, np.ndarray]:
    """One noisy render: background in the upper rows (A = 0, Z = 1e10), the same surface depth in many pixels."""
    rng = np.random.default_rng(seed)
    shape = (HEIGHT, WIDTH)
    alpha = rng.choice([0.0, 1.0, 0.25, 0.5] if fractions else [0.0, 1.0], shape)
    alpha[:2] = 0
    dtype = np.float16 if half else np.float32
    picture = {name: rng.exponential(1.0, shape).astype(dtype) for name in "RGB"}
    picture["A"] = alpha.astype(dtype)
    if depth:
        picture["Z"] = np.where(alpha > 0, rng.choice([2.0, 3.0, 5.5], shape), 1e10).astype(np.float32)
    return picture


def write_renders(folder: Path, pictures: Sequence[Mapping[str, Any]], header: Header | None = None) -> list[Path]:
    paths = [folder / f"s{index}.exr" for index in range(len(pictures))]
    for path, picture in zip(paths, pictures, strict=True):
        write_flat(path, picture, header)
    return paths


def flatten(path: Path) -> dict[str, np.ndarray]:
    """The picture that OpenImageIO composites from a deep file."""
    flat = path.with_suffix(".flat.exr")
    subprocess.run([OIIOTOOL, path, "--flatten", "-d", "float", "-o", flat], check=True)
    return {name: pixels.astype(np.float64) for name, pixels in read_flat(flat).channels.items()}


def read(path: Path, **options: Any) -> PathSamples:
    with SampleReader(path, threads=1, **options) as reader:
        return reader.read()


def mean(pictures: Sequence[Mapping[str, np.ndarray]], name: str) -> np.ndarray:
    return np.mean([picture[name].astype(np.float64) for picture in pictures], axis=0)


@pytest.mark.parametrize("count", [1, 2, 8, 16, 17, 40])
@pytest.mark.parametrize("half", [True, False])
def test_the_flattened_file_is_the_mean_of_the_renders(tmp_path, count, half):
    pictures = [render(seed, half) for seed in range(count)]
    out = tmp_path / "deep.exr"
    report = pack(write_renders(tmp_path, pictures), out, PackOptions(pixel_type="half" if half else "float"))
    assert report is not None
    assert report.samples == count
    flat = flatten(out)
    rounding = HALF if half and count <= 16 else 1e-5
    for name in "RGB":
        np.testing.assert_allclose(flat[name], mean(pictures, name), rtol=rounding, atol=rounding * 1e-2)
    np.testing.assert_allclose(flat["A"], mean(pictures, "A"), atol=1e-5)


@settings(derandomize=True, deadline=None, max_examples=15, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.integers(1, 6), st.integers(0, 1000))
def test_what_was_packed_reads_back_as_uniform_samples(tmp_path, count, seed):
    pictures = [render(100 * seed + index) for index in range(count)]
    out = tmp_path / "deep.exr"
    pack(write_renders(tmp_path, pictures), out, PackOptions(existing="overwrite"))
    samples = read(out)
    assert (samples.counts == count).all()
    np.testing.assert_allclose(samples.weight, 1 / count)
    per_pixel = samples.roles["radiance"].reshape(HEIGHT, WIDTH, count, 3)
    stored = np.stack([np.stack([picture[name] for name in "RGB"], axis=-1) for picture in pictures], axis=2)
    # The samples are sorted by depth, so compare what is independent of order.
    np.testing.assert_allclose(np.sort(per_pixel, axis=2), np.sort(stored.astype(np.float32), axis=2), rtol=HALF)
    alpha = np.stack([picture["A"] for picture in pictures], axis=2).astype(np.float32)
    np.testing.assert_allclose(np.sort(samples.coverage.reshape(alpha.shape), axis=2), np.sort(alpha, axis=2),
                               atol=1e-5)
    depth = samples.roles["depth"].reshape(alpha.shape)
    assert ((depth == 0) == (samples.coverage.reshape(alpha.shape) == 0)).all()


def test_depth_is_strictly_increasing_and_misses_stay_misses(tmp_path):
    from deep_io import read_deep

    out = tmp_path / "deep.exr"
    pack(write_renders(tmp_path, [render(seed) for seed in range(8)]), out)
    deep, header = read_deep(out)
    z = deep.channels["Z"].reshape(HEIGHT * WIDTH, 8)
    assert (np.diff(z, axis=1) > 0).all()
    assert header.get("lbmc:weighting") == "packed"
    assert (header.type, header.compression) == ("deepscanline", "zips")
    assert {c.name: c.dtype for c in header.channels} == {"R": np.float16, "G": np.float16, "B": np.float16,
                                                          "A": np.float32, "Z": np.float32}


def blender(seed: int, transparent: bool = False) -> list[FlatImage]:
    """One part per pass with the part's name repeated in the channels, as Blender 5 writes by default."""
    picture = render(seed, fractions=False)
    rng = np.random.default_rng(seed + 1000)
    miss = picture["A"] == 0
    alpha = picture["A"] if transparent else np.ones_like(picture["A"])
    shape, view = picture["R"].shape, "ViewLayer"
    normal = np.where(miss[..., None], 0, [0.6, 0.0, -0.8]).astype(np.float32)
    passes = {"Combined": {"R": picture["R"], "G": picture["G"], "B": picture["B"], "A": alpha},
              "Depth": {"Z": picture["Z"]},
              "Denoising Normal": {axis: normal[..., index] for index, axis in enumerate("XYZ")},
              "Vector": {axis: np.zeros(shape, np.float32) for axis in "XYZW"},
              "Diffuse Color": {name: rng.random(shape).astype(np.float16) for name in "RGB"}}
    attributes = {"BlenderMultiChannel": "Blender V2.55.1 and newer", "cycles.ViewLayer.samples": "1"}
    return [FlatImage.of({f"{view}.{name}.{key}": pixels for key, pixels in channels.items()}, name=f"{view}.{name}",
                         attributes=attributes) for name, channels in passes.items()]


def test_blender_parts_pack_with_every_pass_and_an_opaque_sky_is_no_hit(tmp_path):
    paths = [tmp_path / f"s{seed}.exr" for seed in range(3)]
    renders = [blender(seed) for seed in range(3)]
    for path, parts in zip(paths, renders, strict=True):
        write_flat_parts(path, parts)
    out = tmp_path / "deep.exr"
    report = pack(paths, out)
    assert report is not None
    assert report.mapping.renderer == "blender"
    assert any("Vector" in line for line in report.lines())
    flat = flatten(out)
    beauties = [{name[-1]: pixels for name, pixels in parts[0].channels.items()} for parts in renders]
    for name in "RGB":
        np.testing.assert_allclose(flat[name], mean(beauties, name), rtol=HALF, atol=1e-5)
    np.testing.assert_allclose(flat["A"], 1, atol=1e-5)
    samples = read(out)
    assert set(samples.roles) == {"radiance", "depth", "normal", "albedo"}
    depths = np.stack([parts[1].channels["ViewLayer.Depth.Z"] for parts in renders], axis=2)
    assert samples.coverage.sum() == (depths < 1e10).sum()
    hit = samples.coverage == 1
    # Denoising Normal looks along the view: z is mirrored.
    np.testing.assert_allclose(samples.roles["normal"][hit], np.tile([0.6, 0, 0.8], (hit.sum(), 1)), atol=1e-3)
    assert (samples.roles["normal"][~hit] == 0).all()


def test_world_normals_without_a_camera_are_kept_as_world_and_said(tmp_path):
    pictures = []
    for seed in range(2):
        picture = render(seed, fractions=False)
        pictures.append({**picture, **{f"N.{axis}": np.full((HEIGHT, WIDTH), value, np.float16)
                                       for axis, value in zip("XYZ", (1, 0, 0), strict=True)}})
    like = FlatImage.of(pictures[0], attributes={"arnold/version": "7"}).header
    out = tmp_path / "deep.exr"
    report = pack(write_renders(tmp_path, pictures, like), out)
    assert report is not None
    assert any("world space" in note for note in report.notes)
    with pytest.raises(InputError, match="world space"):
        SampleReader(out)
    # With the camera at hand the normals are stored in view space, and no reader needs it again.
    matrix = (0.0, 0.0, 1.0, 0.0, -1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0)
    like = like.with_attributes({"worldToCamera": matrix})
    pack(write_renders(tmp_path, pictures, like), out, PackOptions(existing="overwrite"))
    samples = read(out)
    np.testing.assert_allclose(samples.roles["normal"][samples.coverage == 1][0], [0, 0, -1], atol=1e-3)


def test_frames_of_mitsuba_pack_with_the_field_of_view(tmp_path):
    import mitsuba

    mitsuba.set_variant("scalar_rgb")
    scene = mitsuba.load_dict({
        "type": "scene", "integrator": {"type": "aov", "aovs": "dd.y:depth,nn:sh_normal,albedo:albedo",
                                        "image": {"type": "path", "max_depth": 3}},
        "sensor": {"type": "perspective", "fov": 60,
                   "film": {"type": "hdrfilm", "width": 12, "height": 8, "rfilter": {"type": "box"},
                            "pixel_format": "rgba", "component_format": "float32"}},
        "wall": {"type": "rectangle",
                 "to_world": mitsuba.ScalarTransform4f().translate([1, 0, 5]).rotate([0, 1, 0], 180)},
        "sky": {"type": "constant"}})
    paths = []
    for seed in range(4):
        mitsuba.render(scene, spp=1, seed=seed)
        paths.append(tmp_path / f"m{seed}.exr")
        scene.sensors()[0].film().write(str(paths[-1]))
    out = tmp_path / "deep.exr"
    overrides = {"normal": "none"}
    report = pack(paths, out, PackOptions(overrides=overrides, camera="60"))
    assert report is not None
    assert report.mapping.renderer == "mitsuba"
    samples = read(out)
    hit = samples.coverage == 1
    assert 0 < hit.sum() < hit.size
    # The wall is parallel to the image plane: its planar depth is 5 everywhere, up to the offset within a pixel.
    np.testing.assert_allclose(samples.roles["depth"][hit], 5, rtol=0.03)
    flat = flatten(out)
    pictures = [read_flat(path).channels for path in paths]
    np.testing.assert_allclose(flat["G"], mean(pictures, "G"), rtol=HALF, atol=1e-4)


def test_samples_of_broken_radiance_are_left_out_and_the_rest_keeps_its_mean(tmp_path):
    pictures = [render(seed, half=False) for seed in range(3)]
    pictures[1]["G"][4, 5] = np.nan
    pictures[2]["A"][3, 3] = np.inf
    out = tmp_path / "deep.exr"
    report = pack(write_renders(tmp_path, pictures), out, PackOptions(pixel_type="float"))
    assert report is not None
    assert report.repairs["radiance"] == 1
    assert report.repairs["coverage"] == 1
    samples = read(out)
    assert samples.counts[4, 5] == 2
    assert not samples.repairs
    expected = (pictures[0]["R"][4, 5] + pictures[2]["R"][4, 5]) / 2
    np.testing.assert_allclose(flatten(out)["R"][4, 5], expected, rtol=1e-5)


def test_radiance_too_large_to_be_light_is_left_out_as_in_denoising(tmp_path):
    """What uninitialised buffers hold: as finite as it is, the sums of any reader would overflow."""
    pictures = [render(seed, half=False) for seed in range(3)]
    for number, picture in enumerate(pictures):
        picture |= {f"key.{c}": picture[c] / 2 for c in "RGB"}
        picture["R"][2, 3] = np.finfo(np.float32).max
        picture["G"][4, 5] = [np.finfo(np.float32).max, 1.0, 2.0][number]
        picture["key.B"][1, 1] = [-np.finfo(np.float32).max, 1.0, 2.0][number]
    out = tmp_path / "deep.exr"
    report = pack(write_renders(tmp_path, pictures), out, PackOptions(layers=("key",)))
    assert report is not None
    assert (report.repairs["radiance"], report.repairs["key.B"]) == (4, 1)
    assert f"{out}: 4 samples left out: their radiance is not finite, or beyond 1e+30" in report.lines()
    assert not any("beyond the range of half" in note for note in report.notes)
    samples = read(out)
    assert (samples.counts[2, 3], samples.counts[4, 5]) == (0, 2)
    assert not samples.repairs
    flat = flatten(out)
    assert all(np.isfinite(values).all() for values in flat.values())
    np.testing.assert_allclose(flat["G"][4, 5], 1.5, rtol=HALF)
    np.testing.assert_allclose(flat["key.B"][1, 1], 1.0, rtol=HALF)


def test_radiance_that_overflowed_half_is_kept_and_told_as_such(tmp_path):
    pictures = [render(seed) for seed in range(3)]
    pictures[0]["R"][4, 5] = pictures[1]["G"][2, 2] = np.inf
    pictures[2]["B"][1, 1] = np.nan
    out = tmp_path / "deep.exr"
    report = pack(write_renders(tmp_path, pictures), out)
    assert report is not None
    assert +report.repairs == {"radiance": 1, OVERFLOW: 2}
    told = [line for line in report.lines() if line.startswith(f"{out}: ") and "per pixel" not in line]
    assert told == [f"{out}: 1 samples left out: their radiance is not finite, or beyond 1e+30",
                    f"{out}: 2 samples of radiance stored as Inf, which in half is an overflow: read as 65504"]
    samples = read(out)
    assert (samples.counts[4, 5], samples.counts[2, 2], samples.counts[1, 1]) == (3, 3, 2)
    np.testing.assert_allclose(samples.roles["radiance"].max(), 65504, rtol=HALF)


def test_unknown_depths_stay_unknown_however_many_a_pixel_has(tmp_path):
    pictures = [render(seed, fractions=False) for seed in range(4)]
    for picture in pictures:
        picture["Z"][picture["A"] > 0] = np.nan
    pictures[0]["A"][5, 5], pictures[0]["Z"][5, 5] = 1, 7
    out = tmp_path / "deep.exr"
    report = pack(write_renders(tmp_path, pictures), out)
    assert report is not None
    assert report.repairs["depth"] > HEIGHT * WIDTH
    samples = read(out)
    hit = samples.coverage > 0
    assert sorted(set(samples.roles["depth"][hit, 0].tolist())) == [0, 7]
    assert not samples.repairs
    assert survey([samples]).depth == 7


def test_radiance_beyond_half_is_written_as_float(tmp_path):
    pictures = [render(seed, half=False) for seed in range(2)]
    pictures[0]["R"][5, 5] = 1e6
    out = tmp_path / "deep.exr"
    report = pack(write_renders(tmp_path, pictures), out)
    assert report is not None
    assert any("beyond the range of half" in note for note in report.notes)
    assert read(out).roles["radiance"].max() == pytest.approx(1e6)


def test_renders_without_depth_or_alpha_pack_without_inventing_them(tmp_path):
    pictures = [{name: pixels for name, pixels in render(seed).items() if name in "RGB"} for seed in range(4)]
    out = tmp_path / "deep.exr"
    pack(write_renders(tmp_path, pictures), out)
    samples = read(out)
    assert set(samples.roles) == {"radiance"}
    assert (samples.coverage == 1).all()
    np.testing.assert_allclose(flatten(out)["B"], mean(pictures, "B"), rtol=HALF, atol=1e-5)


def test_further_layers_flatten_like_radiance(tmp_path):
    pictures = [{**render(seed), **{f"key.{name}": render(seed + 50)[name] for name in "RGB"}} for seed in range(4)]
    out = tmp_path / "deep.exr"
    pack(write_renders(tmp_path, pictures), out, PackOptions(layers=("key",)))
    np.testing.assert_allclose(flatten(out)["key.R"], mean(pictures, "key.R"), rtol=HALF, atol=1e-5)
    with pytest.raises(InputError, match="--layer fill: there is no such layer; .*: key"):
        pack(write_renders(tmp_path, pictures), tmp_path / "other.exr", PackOptions(layers=("fill",)))


@pytest.mark.parametrize("layer", ["P", "id", "CryptoObject00", "albedo"])
def test_what_is_no_light_is_no_layer_to_carry_along(tmp_path, layer):
    names = {"P": "XYZ", "CryptoObject00": "RGBA", "albedo": "RGB"}
    pictures = [render(seed) for seed in range(2)]
    for picture in pictures:
        picture |= {f"{name}.{suffix}": picture["R"].astype(np.float32) for name, of in names.items() for suffix in of}
        picture["id"] = np.ones((HEIGHT, WIDTH), np.uint32)
    whole = Window(0, 0, WIDTH - 1, HEIGHT - 1)
    like = Header(channels_of({"R": np.float16}), whole, whole)
    like = like.with_attributes({"cryptomatte/1/name": "CryptoObject"})
    with pytest.raises(InputError, match=f"--layer {layer}: .* no role: none"):
        pack(write_renders(tmp_path, pictures, like), tmp_path / "deep.exr", PackOptions(layers=(layer,)))
    assert not (tmp_path / "deep.exr").exists()


@pytest.mark.parametrize("albedo", [False, True])
def test_a_layer_of_light_with_the_name_of_a_role_is_not_that_role(tmp_path, albedo):
    """Arnold's lobe `specular` beside its `specular_albedo`, or alone."""
    pictures = [render(seed) for seed in range(4)]
    for seed, picture in enumerate(pictures):
        picture |= {f"specular.{name}": render(seed + 50)[name] for name in "RGB"}
        if albedo:
            picture |= {f"specular_albedo.{name}": np.full((HEIGHT, WIDTH), 0.25, np.float16) for name in "RGB"}
    layer, out = "specular_light" if albedo else "specular", tmp_path / "deep.exr"
    whole = Window(0, 0, WIDTH - 1, HEIGHT - 1)
    like = Header(channels_of({"R": np.float16}), whole, whole)
    pack(write_renders(tmp_path, pictures, like.with_attributes({"arnold/version": "7"})), out,
         PackOptions(layers=("specular",)))
    np.testing.assert_allclose(flatten(out)[f"{layer}.G"], mean(pictures, "specular.G"), rtol=HALF, atol=1e-5)
    samples = read(out)
    assert ("specular" in samples.roles) == albedo
    if albedo:
        assert set(np.unique(samples.roles["specular"][samples.coverage > 0])) == {0.25}
    with SampleReader(out) as reader:
        assert reader.mapping.unused == tuple(f"{layer}.{name}" for name in "BGR")


def test_windows_and_user_attributes_are_kept(tmp_path):
    pictures = [render(seed) for seed in range(2)]
    like = Header(channels_of({"R": np.float16}), Window(4, -3, 4 + WIDTH - 1, -3 + HEIGHT - 1), Window(0, 0, 99, 49),
                  pixel_aspect=1.5).with_attributes({"owner": "me", "lbmc:weighting": "over"})
    out = tmp_path / "deep.exr"
    pack(write_renders(tmp_path, pictures, like), out)
    (header,) = read_headers(out)
    assert (header.data_window, header.display_window) == (like.data_window, like.display_window)
    assert header.pixel_aspect == 1.5
    assert header.get("owner") == "me"
    assert header.get("lbmc:weighting") == "packed"


def same_picture(pictures: list[dict[str, np.ndarray]]) -> list[dict[str, np.ndarray]]:
    return [pictures[0], pictures[1], pictures[0]]


def narrower(pictures: list[dict[str, np.ndarray]]) -> list[dict[str, np.ndarray]]:
    return [pictures[0], {name: pixels[:, :-1] for name, pixels in pictures[1].items()}]


def fewer_channels(pictures: list[dict[str, np.ndarray]]) -> list[dict[str, np.ndarray]]:
    return [pictures[0], {name: pixels for name, pixels in pictures[1].items() if name != "Z"}]


@pytest.mark.parametrize(("change", "message"), [
    (same_picture, r"s2\.exr: holds the same picture as .*s0\.exr; render every frame with another seed"),
    (narrower, r"s1\.exr: its data window is 12x9 at 0,0, that of .*s0\.exr is 13x9"),
    (fewer_channels, r"s1\.exr: its channels differ: Z only in .*s0\.exr"),
])
def test_renders_that_do_not_fit_together_are_refused_and_nothing_is_written(tmp_path, change, message):
    paths = write_renders(tmp_path, change([render(seed) for seed in range(3)]))
    with pytest.raises(InputError, match=message):
        pack(paths, tmp_path / "deep.exr")
    assert sorted(os.listdir(tmp_path)) == [path.name for path in paths]


def test_pictures_of_one_colour_may_be_alike(tmp_path):
    black = {name: np.zeros((2, 2), np.float16) for name in "RGBA"}
    report = pack(write_renders(tmp_path, [black, black]), tmp_path / "deep.exr")
    assert report is not None


def test_two_layers_for_one_role_are_refused_and_mapped(tmp_path):
    pictures = [{**render(seed), "depth.Y": render(seed)["Z"]} for seed in range(2)]
    paths = write_renders(tmp_path, pictures)
    with pytest.raises(InputError, match="both match the role 'depth'"):
        pack(paths, tmp_path / "deep.exr")
    report = pack(paths, tmp_path / "deep.exr", PackOptions(overrides={"depth": "depth"}))
    assert report is not None


def test_existing_outputs_are_refused_or_skipped_and_never_an_input(tmp_path):
    paths = write_renders(tmp_path, [render(seed) for seed in range(2)])
    out = tmp_path / "deep.exr"
    out.write_bytes(b"old")
    with pytest.raises(UsageError, match="--overwrite"):
        pack(paths, out)
    assert pack(paths, out, PackOptions(existing="skip")) is None
    assert out.read_bytes() == b"old"
    with pytest.raises(UsageError, match="is the input"):
        pack(paths, paths[1], PackOptions(existing="overwrite"))
    with pytest.raises(InputError, match="folder"):
        pack(paths, tmp_path / "absent" / "deep.exr")


def write_tiled(path: Path, picture: Mapping[str, Any]) -> None:
    tiles = OpenEXR.TileDescription()
    tiles.xSize, tiles.ySize = 8, 5
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.tiledimage, "tiles": tiles}
    OpenEXR.File(header, dict(picture)).write(str(path))


@pytest.mark.parametrize("stored", ["none", "piz", "zip", "tiles"])
@pytest.mark.parametrize("held", [1, 1000, 10**9])
def test_the_bytes_do_not_depend_on_how_the_renders_are_stored_or_how_much_is_held(tmp_path, monkeypatch, stored, held):
    pictures = [render(seed) for seed in range(3)]
    paths, out = write_renders(tmp_path, pictures), tmp_path / "deep.exr"
    pack(paths, out)
    expected = out.read_bytes()
    for path, picture in zip(paths, pictures, strict=True):
        if stored == "tiles":
            write_tiled(path, picture)
        else:
            write_flat(path, picture, compression=stored)
    monkeypatch.setattr(flat_renders, "BAND_BYTES", held)
    report = pack(paths, out, PackOptions(existing="overwrite"))
    assert report is not None
    assert out.read_bytes() == expected
    times_over = any("times over" in note for note in report.notes)
    assert times_over == (held < 10**9 and stored != "none")


def test_pixels_that_are_damaged_at_the_end_leave_no_output(tmp_path):
    paths = write_renders(tmp_path, [render(seed) for seed in range(3)])
    write_flat(paths[1], {name: np.tile(values, (20, 1)) for name, values in render(1).items()})
    for seed in (0, 2):
        write_flat(paths[seed], {name: np.tile(values, (20, 1)) for name, values in render(seed).items()})
    data = bytearray(paths[1].read_bytes())
    data[-200:-100] = bytes(100)
    paths[1].write_bytes(data)
    with pytest.raises(InputError, match=r"s1\.exr: the pixels are truncated or corrupt"):
        pack(paths, tmp_path / "deep.exr")
    assert sorted(os.listdir(tmp_path)) == [path.name for path in paths]


PEAK_OF_PACK = """
import resource, sys
import OpenEXR
from pipelines.pack import pack
*sources, target = sys.argv[1:]
before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
pack(sources, target)
print(1024 * (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before))
"""


@pytest.mark.skipif(sys.platform != "linux", reason="the unit of ru_maxrss is the system's")
def test_memory_does_not_grow_with_the_height_of_the_renders(tmp_path):
    rng, paths = np.random.default_rng(0), [tmp_path / f"s{seed}.exr" for seed in range(8)]
    for path in paths:
        row = rng.exponential(1, (16, 32)).astype(np.float32)
        write_flat(path, {name: np.tile(row, (512, 1)) for name in "RGBAZ"})
    renders = 8 * 5 * 4 * 32 * 16 * 512
    command = [sys.executable, "-c", PEAK_OF_PACK, *paths, tmp_path / "deep.exr"]
    grown = int(subprocess.run(command, check=True, capture_output=True, text=True).stdout)
    assert grown < renders / 2


@pytest.fixture
def shot(tmp_path: Path) -> Callable[[str], Path]:
    """Three seeds of frames 10 and 11."""
    for seed in (1, 2, 3):
        for frame in (10, 11):
            write_flat(tmp_path / f"shot.s{seed}.{frame:04d}.exr", render(100 * frame + seed))
    return lambda name: tmp_path / name


def test_seeds_expand_to_the_files_of_every_frame(shot):
    jobs = plan([shot("shot.s@SEED@.####.exr")], shot("deep.####.exr"), seeds="1-3")
    assert [job.number for job in jobs] == [10, 11]
    assert [path.name for path in jobs[0].sources] == ["shot.s1.0010.exr", "shot.s2.0010.exr", "shot.s3.0010.exr"]
    assert jobs[1].target == shot("deep.0011.exr")
    report = pack_frames(jobs, progress="none")
    assert report.exit_code == 0
    assert read(jobs[1].target).counts.max() == 3
    again = pack_frames(jobs, PackOptions(existing="skip"), progress="none")
    assert all(frame.skipped for frame in again.frames)


def test_patterns_one_per_seed_and_single_files_are_planned_alike(shot):
    patterns = [shot(f"shot.s{seed}.####.exr") for seed in (1, 2)]
    (job,) = plan(patterns, shot("deep.####.exr"), frames="11")
    assert [path.name for path in job.sources] == ["shot.s1.0011.exr", "shot.s2.0011.exr"]
    (job,) = plan([shot("shot.s@SEED@.0010.exr")], shot("deep.exr"), seeds="1,3")
    assert (job.number, len(job.sources), job.target) == (None, 2, shot("deep.exr"))


@pytest.mark.parametrize(("sources", "target", "options", "error", "message"), [
    (["shot.s@SEED@.####.exr"], "deep.####.exr", {"seeds": "1-4"}, InputError, r"s4\.####\.exr: no file matches"),
    (["shot.s@SEED@.####.exr"], "deep.exr", {"seeds": "1-3"}, InputError, "OUT is a single file"),
    (["shot.s1.####.exr"], "deep.exr", {}, InputError, "OUT is a single file"),
    (["shot.s1.####.exr", "shot.s2.0010.exr"], "deep.####.exr", {}, InputError, "single file among sequences"),
    (["shot.s1.0010.exr"], "deep.####.exr", {}, InputError, "OUT is a sequence"),
    (["shot.s@SEED@.####.exr"], "deep.####.exr", {}, UsageError, "give the seeds with --seeds"),
    (["shot.s1.####.exr"], "deep.####.exr", {"seeds": "1-3"}, UsageError, "does not hold @SEED@"),
    (["a.exr", "b.exr"], "deep.exr", {"seeds": "1-3"}, UsageError, "takes one name"),
    (["shot.s1.0010.exr"], "deep.exr", {"frames": "10"}, UsageError, "no pattern such as ####"),
    ([], "deep.exr", {}, UsageError, "at least one render"),
    (["absent.exr"], "deep.exr", {}, InputError, "no such file"),
])
def test_plans_that_make_no_sense_are_errors(shot, sources, target, options, error, message):
    with pytest.raises(error, match=message):
        plan([shot(name) for name in sources], shot(target), **options)


def test_a_frame_that_any_seed_lacks_is_missed(shot):
    shot("shot.s1.0010.exr").unlink()
    for seeds in ((1, 2), (2, 1)):
        with pytest.raises(InputError, match=r"s1\.####\.exr: 1 of 2 frames are missing: 10"):
            plan([shot(f"shot.s{seed}.####.exr") for seed in seeds], shot("out.####.exr"))


def test_seeds_keep_their_zeros(tmp_path):
    for seed in range(8, 12):
        (tmp_path / f"s{seed:02d}.exr").touch()
    (job,) = plan([tmp_path / "s@SEED@.exr"], tmp_path / "out.exr", "08-11")
    assert [source.name for source in job.sources] == ["s08.exr", "s09.exr", "s10.exr", "s11.exr"]


def test_a_render_in_the_place_of_the_output_is_not_overwritten(tmp_path):
    paths = write_renders(tmp_path, [render(seed) for seed in range(3)])
    before = paths[-1].read_bytes()
    with pytest.raises(UsageError, match="is a flat EXR, which pack does not replace; name OUT last"):
        pack_frames(plan(paths[:-1], paths[-1]), PackOptions(existing="overwrite"))
    assert paths[-1].read_bytes() == before
