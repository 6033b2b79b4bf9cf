"""Packing flat renders: any deep reader flattens the file to the renders' mean, and lbmc reads the renders back."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from deep_io import Window, read_headers
from deep_io.errors import InputError
from deep_io.flat import FlatImage, read_flat, write_flat_parts
from deep_io.header import Header, channels_of
from deep_io.path_samples import SampleReader
from pipelines.pack import OVERFLOW, PackOptions, pack
from pipelines.survey import survey
from tests.pipelines.flat_render_files import HALF, HEIGHT, WIDTH, flatten, mean, read, render, write_renders


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


def test_alpha_beyond_its_range_is_clipped_and_told_but_for_rounding(tmp_path):
    pictures = [render(seed) for seed in range(2)]
    pictures[0]["A"][:2, 0] = 1.25, 1.0005
    pictures[1]["A"][3, 3] = -0.5
    out = tmp_path / "deep.exr"
    report = pack(write_renders(tmp_path, pictures), out)
    assert report is not None
    assert f"{out}: 2 samples of an alpha below 0 or above 1, stored as 0 or 1" in report.lines()
    expected = np.mean([np.clip(picture["A"], 0, 1) for picture in pictures], 0)
    np.testing.assert_allclose(flatten(out)["A"], expected, atol=1e-6)


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
