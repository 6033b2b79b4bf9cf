"""Rendered examples: the conventions of the deep sample file, unbiasedness, determinism, what is turned down."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import pytest

from deep_io.flat import HALF_MAX
from pipelines.rendering import environment
from pipelines.rendering import geometry as g
from pipelines.rendering.camera import Camera
from pipelines.rendering.job import render_example
from pipelines.rendering.patterns import make_pattern
from pipelines.rendering.shots import RenderSettings, estimated_noise, is_worth_rendering, scale_and_cut
from pipelines.rendering.stage import Stage
from pipelines.rendering.stage_scene import StageTracer
from pipelines.rendering.tracer import MISS_DEPTH, Motion
from pipelines.rendering.views import CAMERA_MOTION_RANGE, View, add_camera_motion
from tests.runner import require_renderer

require_renderer()

Array = npt.NDArray[np.float32]

SIZE = 32
TIME_BINS = 16  # of the shutter, in moving scenes
HALF_WIDTH = 2.0  # of the wall that the camera looks at
SMALL = RenderSettings(samples=4, reference=4, size=SIZE, layout="tabletop")


def wall_stage(height: float = 0.0) -> Stage:
    """A wall at z = 0 whose colour is its position: red = x, green = y, over -HALF_WIDTH..HALF_WIDTH."""
    stage = Stage(np.random.default_rng(0))
    side = 2 * HALF_WIDTH
    wall = g.quad([-HALF_WIDTH, -HALF_WIDTH, height], [side, 0, 0], [0, side, 0])
    color = np.concatenate([(wall.vertices[:, :2] + HALF_WIDTH) / side, np.full((4, 1), 0.5)], 1).astype(np.float32)
    stage.add(g.Mesh(wall.vertices, wall.faces, wall.uv, color), stage.material("colored"))
    stage.environment = environment.uniform(np.random.default_rng(0), 1.0)
    stage.camera = lambda rng: Camera.look_at([0, 0, 3], [0, 0, 0], 60)
    return stage


def trace(stage: Stage, camera: Camera, samples: int, motions: dict[int, Motion] | None = None,
          seed: int = 1) -> tuple[dict[str, Array], Array, Array]:
    """The channels as (P, S) tables, and the pixel positions (P, S) at which the paths started."""
    tracer = StageTracer(stage, threads=1)
    tracer.set_motions(motions or {})
    pattern = make_pattern(np.random.default_rng(seed), camera.size**2, samples, False, TIME_BINS if motions else None)
    channels = tracer.trace(camera, pattern, seed)
    tracer.close()
    pixel = np.arange(camera.size**2)[:, None]
    x, y = pixel % camera.size + pattern.jitter_x, pixel // camera.size + pattern.jitter_y
    return {name: values.reshape(-1, samples) for name, values in channels.items()}, x, y


def pinhole(camera: Camera, point: npt.NDArray[np.float64]) -> tuple[npt.NDArray[np.float64], ...]:
    """Pixel positions of world points (..., 3) in the camera's middle pose, in NumPy and from the definition."""
    v = point - camera.origin
    z = v @ camera.forward
    return (camera.size / 2 + camera.focal * (v @ camera.right) / z,
            camera.size / 2 - camera.focal * (v @ camera.up) / z)


def test_depth_is_planar_normals_face_the_camera_and_misses_are_empty() -> None:
    camera = Camera.look_at([0, 0, 3], [0, 0, 0], 80).resized(SIZE)
    channels, _, _ = trace(wall_stage(), camera, 4)
    hit = channels["A"] == 1
    assert 0.3 < hit.mean() < 0.9
    np.testing.assert_allclose(channels["Z"][hit], 3.0, rtol=1e-5)
    for name, value in {"N.X": 0.0, "N.Y": 0.0, "N.Z": 1.0, "roughness": 1.0, "specular.R": 0.0}.items():
        np.testing.assert_allclose(channels[name][hit], value, atol=1e-5)
    assert (channels["Z"][~hit] == np.float32(MISS_DEPTH)).all()
    for name in ("N.X", "N.Z", "albedo.R", "motion.X", "coc"):
        assert (channels[name][~hit] == 0).all()


@pytest.mark.parametrize("moves", ["nothing", "camera", "object", "both"])
def test_pixel_is_pinhole_projection_plus_motion_minus_coc_times_lens(moves: str) -> None:
    """The wall's colour tells where it was hit, so the identity is checked through the whole renderer."""
    camera = Camera.look_at([0.4, 0.2, 3], [0, 0.1, 0], 45, roll=0.3).resized(SIZE).with_lens(6.0, 1.5)
    if moves in ("camera", "both"):
        camera = Camera(**{**vars(camera), "shift": np.array([0.05, -0.03, 0.0]), "turn": np.array([0.0, 0.01, 0.02])})
    motions = {0: Motion(np.array([0.2, 0.1, 0.0]), np.zeros(3), np.zeros(3))} if moves in ("object", "both") else None
    channels, x, y = trace(wall_stage(), camera, TIME_BINS, motions)
    hit = channels["A"] == 1
    assert hit.mean() > 0.9
    width = 2 * HALF_WIDTH
    rest = np.stack([channels["albedo.R"] * width - HALF_WIDTH, channels["albedo.G"] * width - HALF_WIDTH,
                     np.zeros_like(x)], -1)
    there_x, there_y = pinhole(camera, rest)
    late = channels["time"] - 0.5
    found_x = there_x + channels["motion.X"] * late - channels["coc"] * channels["lens.X"]
    found_y = there_y + channels["motion.Y"] * late - channels["coc"] * channels["lens.Y"]
    # Motion along the screen is not quite linear in time, hence the wider bound where something moves.
    bound = 0.005 if moves == "nothing" else 0.15
    assert np.abs(found_x - x)[hit].max() < bound
    assert np.abs(found_y - y)[hit].max() < bound
    assert np.abs(channels["coc"][hit]).max() > 2
    if moves != "nothing":
        assert np.hypot(channels["motion.X"], channels["motion.Y"])[hit].mean() > 0.5


def test_coc_is_positive_behind_the_focus_plane_and_zero_on_it() -> None:
    for height, sign in ((0.0, 1), (1.0, 0), (1.5, -1)):
        camera = Camera.look_at([0, 0, 3], [0, 0, 0], 40).resized(SIZE).with_lens(5.0, 2.0)
        channels, _, _ = trace(wall_stage(height), camera, 1)
        coc = channels["coc"][channels["A"] == 1]
        assert (np.sign(np.round(coc, 4)) == sign).all()


def busy_stage() -> Stage:
    """A few shiny things on a floor under a sky, in front of empty background."""
    stage = Stage(np.random.default_rng(3))
    rng = stage.rng
    stage.add(g.quad([-3, 0, -3], [0, 0, 6], [6, 0, 0]), stage.material("matte", texture=stage.textured("checker")))
    for k, kind in enumerate(("plastic", "metal", "matte", "cutout")):
        slot = stage.material(kind, **({} if kind == "metal" else {"texture": stage.textured()}))
        stage.add(g.superellipsoid([0.8] * 3), slot, [0.9 * k - 1.4, 0.4, float(rng.normal()) * 0.3], movable=True)
    stage.environment = environment.sky(np.random.default_rng(2), [0.3, 1.0, 0.4])
    stage.camera = lambda rng: Camera.look_at([0, 1.5, 4], [0, 0.3, 0], 40)
    return stage


@pytest.mark.parametrize("moving", [False, True])
def test_samples_and_reference_have_one_expectation(moving: bool) -> None:
    """Two independent estimates of every block of pixels differ as their variances say, with no bias."""
    camera = Camera.look_at([0, 1.5, 4], [0, 0.3, 0], 40).resized(SIZE).with_lens(3.0, 3.5)
    motions = {2: Motion(np.array([0.3, 0.1, 0.0]), np.array([0.0, 0.5, 0.0]), np.array([-0.5, 0.4, 0.0]))}
    tables = [trace(busy_stage(), camera, samples, motions if moving else None, seed)[0]
              for samples, seed in ((32, 11), (64, 12))]
    means, variances = [], []
    for table in tables:
        light = np.minimum(table["R"] + table["G"] + table["B"], 60.0).astype(np.float64)
        blocks = light.reshape(SIZE // 8, 8, SIZE // 8, 8, -1).transpose(0, 2, 1, 3, 4).reshape(16, 64, -1)
        means.append(blocks.mean((1, 2)))
        variances.append((blocks.var(2, ddof=1) / blocks.shape[2]).sum(1) / 64**2)
    z = (means[0] - means[1]) / np.sqrt(variances[0] + variances[1])
    assert np.abs(z).max() < 4.5
    assert abs(float(z.mean())) < 4 / np.sqrt(len(z))
    # Both contain noise, or the test could not fail.
    assert np.std(z) > 0.3


def test_stored_samples_agree_with_the_stored_reference() -> None:
    shot = render_example(5, RenderSettings(samples=32, reference=64, size=SIZE, layout="outdoor"), threads=1)
    radiance = np.stack([shot.channels[c] for c in "RGB"], -1).reshape(SIZE**2, 32, 3).astype(np.float64)
    reference = shot.reference[..., :3].reshape(-1, 3).astype(np.float64)
    spread = np.sqrt((radiance.var(1, ddof=1) * (1 / 32 + 1 / 64)).sum()) / radiance.shape[0] / 3
    assert abs(radiance.mean() - reference.mean()) < 5 * np.sqrt(3) * spread
    coverage = shot.channels["A"].reshape(SIZE, SIZE, 32).mean(2)
    assert np.abs(coverage - shot.reference[..., 3]).mean() < 0.05
    assert shot.about["energy"] == pytest.approx(radiance.mean() / reference.mean(), rel=1e-3)


def test_a_seed_gives_the_same_example_every_time_and_another_seed_another() -> None:
    first, again, other = (render_example(seed, SMALL, threads=1) for seed in (2, 2, 3))
    for name, values in first.channels.items():
        np.testing.assert_array_equal(values, again.channels[name])
    np.testing.assert_array_equal(first.reference, again.reference)
    assert first.about == again.about
    assert not np.array_equal(first.reference, other.reference)


def test_defocus_and_motion_can_be_forced_and_forbidden() -> None:
    still = render_example(4, RenderSettings(4, 4, SIZE, "tabletop", defocus=False, motion=False), threads=1)
    assert not still.about["defocus"]
    assert still.about["coc_95"] == still.about["motion_95"] == 0
    moved = render_example(4, RenderSettings(4, 4, SIZE, "tabletop", defocus=True, motion=True), threads=1)
    assert moved.about["defocus"]
    assert moved.about["camera_motion"] or moved.about["object_motion"]
    assert moved.about["coc_95"] > 0.5
    assert moved.about["motion_95"] > 0.2


def test_a_moving_camera_moves_the_middle_of_the_scene_by_the_pixels_asked_for() -> None:
    camera = Camera.look_at([0, 0, 3], [0, 0, 0], 30).resized(SIZE)
    tracer = StageTracer(wall_stage(), threads=1)
    pattern = make_pattern(np.random.default_rng(0), SIZE**2, 1, False, None)
    for seed in range(12):
        view = add_camera_motion(View(camera, np.array([3.0], np.float32)), np.random.default_rng(seed))
        channels = tracer.trace(view.camera, pattern, 1)
        moved = float(np.median(np.hypot(channels["motion.X"], channels["motion.Y"])))
        assert CAMERA_MOTION_RANGE[0] * 0.9 < moved < CAMERA_MOTION_RANGE[1] * 1.3, seed
    tracer.close()


def test_lights_shine_and_reflect_nothing() -> None:
    stage = Stage(np.random.default_rng(0))
    side = 2 * HALF_WIDTH
    stage.add(g.quad([-HALF_WIDTH, -HALF_WIDTH, 0], [side, 0, 0], [0, side, 0]), stage.light([1.0, 2.0, 3.0]))
    stage.environment = environment.uniform(np.random.default_rng(0), 1.0)
    stage.camera = lambda rng: Camera.look_at([0, 0, 3], [0, 0, 0], 30)
    channels, _, _ = trace(stage, Camera.look_at([0, 0, 3], [0, 0, 0], 30).resized(SIZE), 2)
    for name, value in {"R": 1.0, "G": 2.0, "B": 3.0, "albedo.R": 0.0}.items():
        np.testing.assert_allclose(channels[name], value, rtol=1e-5)


def test_samples_and_reference_are_cut_alike_and_within_half() -> None:
    """Else a lamp would be brighter in the reference, which is stored as float, than in any sample."""
    light = {"R": [1e9, 30.0, 3.0], "G": [1e9, 30.0, 3.0], "B": [1e9, 30.0, 3.0]}
    emission = {f"emission.{c}": [1e9, 0.0, 1.0] for c in "RGB"}
    channels = {name: np.array(values, np.float32) for name, values in (light | emission).items()}
    scale_and_cut(channels, 2.0, 50.0, 8.0)
    for c in "RGB":
        np.testing.assert_allclose(channels[c], [HALF_MAX, 50.0 * 8, 3.0 * 2 * 8], rtol=1e-6)
    assert set(channels) == set("RGB")


def test_a_lens_that_reaches_through_things_beside_it_is_turned_down() -> None:
    stage = busy_stage()
    # A curtain just outside the picture, which a wide lens sees from both sides.
    stage.add(g.quad([0.5, 0, 3.4], [0, 0, 1.2], [0, 3, 0]), stage.material("matte", texture=stage.textured("plain")))
    tracer = StageTracer(stage, threads=1)
    camera = stage.camera(stage.rng).resized(64)
    verdicts = [is_worth_rendering(tracer, View(camera.with_lens(coc, 4.0), np.ones(1, np.float32)), False,
                                   np.random.default_rng(seed)) for coc in (2.0, 600.0) for seed in range(4)]
    tracer.close()
    assert any(verdicts[:4])
    assert not any(verdicts[4:])


def test_estimated_noise_is_that_of_fewer_samples() -> None:
    rng = np.random.default_rng(1)
    paths = (0.5 + rng.normal(0, 0.2, (16 * 16, 400, 3))).astype(np.float32)
    eight = paths[:, :8].mean(1)
    measured = float(((eight - 0.5) ** 2 / (0.5**2 + 0.01)).mean())
    assert estimated_noise(paths) == pytest.approx(measured, rel=0.15)
