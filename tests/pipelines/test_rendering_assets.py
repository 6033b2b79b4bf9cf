"""Procedural assets of the renderer and the starts of its paths: no Mitsuba needed."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pipelines.rendering import environment, textures
from pipelines.rendering.backend import OLDEST_LLVM, RendererMissingError, find_llvm, llvm_version
from pipelines.rendering.camera import Camera
from pipelines.rendering.geometry import box, lathe, random_rotation, superellipsoid, torus, tube
from pipelines.rendering.interiors import glowing_window
from pipelines.rendering.layouts import LAYOUTS
from pipelines.rendering.materials import QUOTAS, SLOT_KINDS
from pipelines.rendering.patterns import concentric_disk, join, make_pattern, shuffle_order, shutter_times
from pipelines.rendering.stage import Stage
from pipelines.rendering.tracer import Motion

TIME_BINS = 16


@pytest.mark.parametrize("name", textures.TEXTURES)
def test_textures_are_reflectances_that_are_not_flat(name: str) -> None:
    image = textures.make_texture(np.random.default_rng(3), name)
    assert image.shape == (textures.SIZE, textures.SIZE, 3)
    assert image.min() >= 0.02
    assert image.max() <= 0.95
    assert name == "plain" or image.std() > 0.005


@pytest.mark.parametrize("name", ["sky", "studio", "spots", "uniform"])
def test_environments_are_finite_and_shine(name: str) -> None:
    image = getattr(environment, name)(np.random.default_rng(4))
    assert image.shape == (environment.HEIGHT, environment.WIDTH, 3)
    assert np.isfinite(image).all()
    assert image.min() >= 0
    assert image.max() > 0


def test_an_environment_facing_a_window_keeps_what_enters_it_and_nothing_else() -> None:
    whole = environment.uniform(np.random.default_rng(5), 1.0)
    kept = environment.facing(whole, [np.array([1.0, 0.0, 0.0])])
    lit = kept.max(2) > 0
    assert 0.4 < lit.mean() < 0.5
    np.testing.assert_array_equal(kept[lit], whole[lit])


@pytest.mark.parametrize("layout", LAYOUTS)
@pytest.mark.parametrize("seed", range(3))
def test_every_layout_gives_sound_meshes_in_slots_of_their_material(layout: str, seed: int) -> None:
    stage = Stage(np.random.default_rng(seed))
    LAYOUTS[layout][1](stage)
    assert stage.camera is not None
    assert len(stage.placed) > 5
    for thing in stage.placed:
        mesh = thing.mesh
        assert np.isfinite(mesh.vertices).all()
        assert np.isfinite(mesh.uv).all()
        assert mesh.faces.max() < len(mesh.vertices)
        assert thing.slot in stage.materials
        assert stage.materials[thing.slot].kind == SLOT_KINDS[thing.slot]


def test_the_same_seed_gives_the_same_stage() -> None:
    first, second = (Stage(np.random.default_rng(7)) for _ in range(2))
    for stage in (first, second):
        LAYOUTS["tabletop"][1](stage)
    for a, b in zip(first.placed, second.placed, strict=True):
        assert a.slot == b.slot
        np.testing.assert_array_equal(a.mesh.vertices, b.mesh.vertices)


def test_a_kind_of_material_never_takes_more_slots_than_it_has() -> None:
    stage = Stage(np.random.default_rng(8))
    slots = {stage.material("glass") for _ in range(20)}
    assert len(slots) == QUOTAS["glass"]


def test_solids_face_outwards() -> None:
    """The signed volume of a closed mesh is positive when its faces turn counter-clockwise seen from outside."""
    straight = np.linspace([0, 0, 0], [1, 0, 0], 9)
    for mesh, volume in (
            (box([1, 2, 3]), 6.0), (superellipsoid([2, 2, 2], 1.0, 64), 4 / 3 * np.pi),
            (torus(1.0, 0.2, 256, 128), 2 * np.pi**2 * 0.04), (tube(straight, 0.1, 128), 2 / 3 * np.pi * 0.01),
            (lathe([[0, 0], [0.5, 0], [0.5, 1], [0, 1]], 128), np.pi / 4)):
        a, b, c = (mesh.vertices[mesh.faces[:, k]] for k in range(3))
        # Seen from the origin, the open ends of the tube take a third of its volume away.
        assert float((a * np.cross(b, c)).sum()) / 6 == pytest.approx(volume, rel=0.01)


def test_the_panel_outside_a_window_shines_into_the_room() -> None:
    for along, inward in (([1.0, 0, 0], [0, 0, 1.0]), ([0, 0, 1.0], [-1.0, 0, 0]), ([-1.0, 0, 0], [0, 0, -1.0])):
        stage = Stage(np.random.default_rng(1))
        glowing_window(stage, np.zeros(3), np.array(along), np.array(inward), (1.0, 1.0, 2.0, 2.0))
        mesh = stage.placed[0].mesh
        for face in mesh.faces:
            a, b, c = mesh.vertices[face]
            # An area light shines on the side from which its faces turn counter-clockwise.
            assert np.cross(b - a, c - a) @ inward > 0
        assert ((mesh.vertices @ inward) < 0).all(), "it hangs outside"


def test_a_tube_keeps_its_distance_from_its_path() -> None:
    path = np.stack([np.linspace(0, 1, 9), np.zeros(9), np.zeros(9)], 1)
    vertices = tube(path, 0.1, 8).vertices
    np.testing.assert_allclose(np.hypot(vertices[:, 1], vertices[:, 2]), 0.1, rtol=1e-5)


def test_motion_is_rigid_and_rests_at_the_middle_of_the_shutter() -> None:
    rng = np.random.default_rng(9)
    vertices = rng.normal(size=(20, 3)).astype(np.float32)
    motion = Motion(rng.normal(size=3), rng.normal(size=3), rng.normal(size=3))
    np.testing.assert_allclose(motion.at(vertices, 0.5), vertices, atol=1e-5)
    edges = np.linalg.norm(np.diff(motion.at(vertices, 0.9), axis=0), axis=1)
    np.testing.assert_allclose(edges, np.linalg.norm(np.diff(vertices, axis=0), axis=1), rtol=1e-4)
    rotation = random_rotation(rng)
    np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(rotation) == pytest.approx(1)


@settings(derandomize=True, deadline=None)
@given(st.integers(1, 70), st.sampled_from([None, TIME_BINS]), st.booleans())
def test_mean_time_is_the_middle_of_the_shutter(samples: int, bins: int | None, stratified: bool) -> None:
    pattern = make_pattern(np.random.default_rng(1), 12, samples, stratified, bins)
    assert pattern.time.shape == (12, samples)
    assert pattern.time.min() >= 0
    assert pattern.time.max() <= 1
    # An odd sample is a draw from its stratum, or from the whole shutter where that has bins.
    slack = 0.5 / samples / (1 if bins else samples) if samples % 2 else 0
    assert np.abs(pattern.time.mean(1) - 0.5).max() <= slack + 1e-6
    assert np.hypot(pattern.lens_x, pattern.lens_y).max() <= 1 + 1e-6


def test_whole_sets_of_samples_use_every_time_bin_equally() -> None:
    time = shutter_times(np.random.default_rng(2), (5, 3 * TIME_BINS), TIME_BINS)
    counts = np.stack([np.bincount((row * TIME_BINS).astype(int), minlength=TIME_BINS) for row in time])
    assert (counts == 3).all()


@pytest.mark.parametrize("bins", [None, TIME_BINS])
@pytest.mark.parametrize("samples", [1, 3, 4, 21])
def test_any_number_of_samples_is_spread_evenly_over_the_shutter(samples: int, bins: int | None) -> None:
    """So that few samples and the many of a reference show the same blur."""
    pixels = 4000
    time = shutter_times(np.random.default_rng(3), (pixels, samples), bins)
    counts = np.bincount((time.ravel() * TIME_BINS).astype(int), minlength=TIME_BINS)
    expected = pixels * samples / TIME_BINS
    assert np.abs(counts - expected).max() < 5 * np.sqrt(expected)


def test_stratified_patterns_put_one_sample_in_every_stratum() -> None:
    pattern = make_pattern(np.random.default_rng(3), 6, 16, True, None)
    strata = np.sort(np.floor(pattern.jitter_x * 16).astype(int), axis=1)
    np.testing.assert_array_equal(strata, np.broadcast_to(np.arange(16), (6, 16)))


def test_the_disk_is_covered_evenly() -> None:
    u = np.random.default_rng(4).random((2, 200_000), np.float32)
    x, y = concentric_disk(u[0], u[1])
    assert float((np.hypot(x, y) < 0.5).mean()) == pytest.approx(0.25, abs=0.005)
    assert float(x.mean()) == pytest.approx(0, abs=0.005)


def test_sample_order_is_shuffled_within_pixels_only() -> None:
    order = shuffle_order(np.random.default_rng(5), 300, 32).reshape(300, 32)
    np.testing.assert_array_equal(np.sort(order, axis=1), np.arange(300 * 32).reshape(300, 32))
    time = shutter_times(np.random.default_rng(6), (300, 32), None).ravel()[order]
    assert abs(float(time[:, :4].mean()) - 0.5) < 0.03, "the first samples of a pixel favour no part of the shutter"


def test_joined_patterns_hold_both() -> None:
    rng = np.random.default_rng(7)
    a, b = make_pattern(rng, 4, 3, False, None), make_pattern(rng, 4, 5, False, None)
    np.testing.assert_array_equal(join(a, b).time, np.concatenate([a.time, b.time], 1))


def test_a_resized_camera_sees_the_same_angle_and_blurs_the_same_part_of_the_picture() -> None:
    camera = Camera.look_at([0, 0, 5], [0, 0, 0], 40).resized(64).with_lens(4.0, 3.0)
    larger = camera.resized(128)
    assert larger.focal / larger.size == pytest.approx(camera.focal / camera.size)
    assert larger.aperture == camera.aperture


def test_llvm_versions_are_read_from_file_names() -> None:
    assert llvm_version("/usr/lib/x86_64-linux-gnu/libLLVM.so.19.1") == 19
    assert llvm_version("/usr/lib/llvm-14/lib/libLLVM.so") == 14
    assert llvm_version("/usr/lib64/libLLVM-17.so") == 17
    assert llvm_version("/opt/homebrew/opt/llvm@18/lib/libLLVM.dylib") == 18
    assert llvm_version("/somewhere/libLLVM.so") is None


def test_a_missing_or_old_llvm_gives_one_line_with_the_cure(monkeypatch: pytest.MonkeyPatch, tmp_path: object) -> None:
    monkeypatch.setenv("DRJIT_LIBLLVM_PATH", f"{tmp_path}/libLLVM.so")
    with pytest.raises(RendererMissingError, match="does not exist.*libllvm19") as missing:
        find_llvm()
    assert "\n" not in str(missing.value)
    old = f"{tmp_path}/libLLVM-{OLDEST_LLVM - 1}.so"
    with open(old, "w"):
        monkeypatch.setenv("DRJIT_LIBLLVM_PATH", old)
    with pytest.raises(RendererMissingError, match="too old.*DRJIT_LIBLLVM_PATH"):
        find_llvm()
    monkeypatch.delenv("DRJIT_LIBLLVM_PATH")
    monkeypatch.setattr("pipelines.rendering.backend.SEARCH", (f"{tmp_path}/*.so",))
    with pytest.raises(RendererMissingError, match="no usable LLVM"):
        find_llvm()


def test_a_missing_mitsuba_gives_one_line_with_the_cure(monkeypatch: pytest.MonkeyPatch) -> None:
    from pipelines.rendering import backend

    monkeypatch.setitem(__import__("sys").modules, "mitsuba", None)
    monkeypatch.setattr(backend, "find_llvm", lambda: "/nowhere/libLLVM.so.19")
    monkeypatch.setenv("DRJIT_LIBLLVM_PATH", "/nowhere/libLLVM.so.19")
    with pytest.raises(RendererMissingError, match="install lbmc with its extra 'render'"):
        backend.load_mitsuba.__wrapped__()
