"""Jobs of rendering: what is written, resuming, workers, halves of references, files of scenes, the command."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

from deep_io import read_deep
from deep_io.errors import InputError, UsageError
from deep_io.flat import read_flat
from model.metrics import common_scale, reference_floor
from pipelines.rendering.camera import Camera
from pipelines.rendering.file_scene import FileTracer
from pipelines.rendering.job import RenderOptions, render_example, render_scenes
from pipelines.rendering.patterns import make_pattern
from pipelines.rendering.shots import RenderSettings
from pipelines.rendering.tracer import Motion
from tests.runner import in_process, require_renderer

require_renderer()

Array = npt.NDArray[np.float32]

SIZE = 32
TIME_BINS = 16  # of the shutter, in moving scenes
SMALL = RenderSettings(samples=4, reference=4, size=SIZE, layout="tabletop")

SCENE = """<scene version="3.0.0">
  <sensor type="perspective"><float name="fov" value="50"/>
    <transform name="to_world"><lookat origin="0,1,4" target="0,0.5,0" up="0,1,0"/></transform></sensor>
  <emitter type="constant"><rgb name="radiance" value="0.3"/></emitter>
  <shape type="sphere"><point name="center" x="0.5" y="2.5" z="1"/><float name="radius" value="0.1"/>
    <emitter type="area"><rgb name="radiance" value="60"/></emitter></shape>
  <shape type="rectangle"><transform name="to_world"><scale value="4"/><rotate x="1" angle="-90"/></transform>
    <bsdf type="diffuse"><rgb name="reflectance" value="0.6,0.2,0.1"/></bsdf></shape>
  <shape type="cube"><transform name="to_world"><scale value="0.4"/><translate y="0.4"/></transform>
    <bsdf type="roughconductor"><float name="alpha" value="0.09"/></bsdf></shape>
</scene>
"""


def options(folder: Path, **more: Any) -> RenderOptions:
    return RenderOptions(folder, **({"count": 2, "seed": 10, "settings": SMALL, "threads": 1} | more))


def test_a_job_goes_on_where_it_was_stopped(tmp_path: Path) -> None:
    report = render_scenes(options(tmp_path), "none")
    assert report.exit_code == 0
    assert len(report.values) == 2
    files = {path: path.read_bytes() for path in tmp_path.iterdir()}
    assert {path.name for path in files} == {"contact-sheet.png"} | {
        f"scene{seed:06d}{end}" for seed in (10, 11) for end in (".deep.exr", ".ref.exr", ".json")}
    times = {path: path.stat().st_mtime_ns for path in files}
    # Without its JSON an example is incomplete, whatever else is there.
    (tmp_path / "scene000011.json").unlink()
    again = render_scenes(options(tmp_path), "none")
    assert [frame.label for frame in again.frames] == ["scene000011"]
    for path, content in files.items():
        assert path.read_bytes() == content
        assert (path.stat().st_mtime_ns == times[path]) == ("000010" in path.name)


def test_files_hold_the_canonical_channels(tmp_path: Path) -> None:
    render_scenes(options(tmp_path, count=1, contact_sheet=False), "none")
    samples, header = read_deep(tmp_path / "scene000010.deep.exr")
    assert (samples.counts == 4).all()
    assert set(header.channel_names) == {
        *"RGBAZ", "N.X", "N.Y", "N.Z", "roughness", "motion.X", "motion.Y", "coc", "lens.X", "lens.Y", "time",
        *(f"{role}.{c}" for role in ("albedo", "specular") for c in "RGB")}
    assert {channel.name: channel.dtype for channel in header.channels}["Z"] == np.float32
    assert all(np.isfinite(values.astype(np.float32)).all() for values in samples.channels.values())
    reference = read_flat(tmp_path / "scene000010.ref.exr").channels
    assert set(reference) == set("RGBA")
    assert all(np.isfinite(values).all() for values in reference.values())
    about = json.loads((tmp_path / "scene000010.json").read_text())
    assert about["kind"] == "tabletop"


def test_other_settings_do_not_mix_with_what_is_there(tmp_path: Path) -> None:
    render_scenes(options(tmp_path, count=1, contact_sheet=False), "none")
    with pytest.raises(UsageError, match="other settings"):
        render_scenes(options(tmp_path, count=1, settings=RenderSettings(8, 4, SIZE, "tabletop")), "none")
    scene = tmp_path / "room.xml"
    scene.write_text(SCENE)
    (tmp_path / "files").mkdir()
    of_scene = options(tmp_path / "files", count=1, settings=RenderSettings(2, 2, SIZE), contact_sheet=False)
    render_scenes(of_scene, "none")
    with pytest.raises(UsageError, match="other settings"):
        render_scenes(replace(of_scene, scene=scene), "none")
    about = tmp_path / "files" / "scene000010.json"
    about.write_text("[]")
    with pytest.raises(InputError, match="scene000010.json: is not an example's JSON; delete it"):
        render_scenes(of_scene, "none")


def test_a_reference_in_halves_is_two_of_one_expectation_and_changes_nothing_else(tmp_path: Path) -> None:
    settings = RenderSettings(samples=4, reference=64, size=SIZE, layout="outdoor")
    plain = options(tmp_path, count=1, settings=settings, contact_sheet=False)
    render_scenes(plain, "none")
    files = {path: path.read_bytes() for path in tmp_path.glob("*.exr")}
    in_halves = replace(plain, settings=replace(settings, halves=True))
    assert len(render_scenes(in_halves, "none").frames) == 1, "the other half is still to be rendered"
    assert {path: path.read_bytes() for path in files} == files
    assert render_scenes(in_halves, "none").frames == render_scenes(plain, "none").frames == ()
    one, other = (np.stack([read_flat(tmp_path / f"scene000010{end}").channels[c] for c in "RGB"], -1)
                  for end in (".ref.exr", ".ref2.exr"))
    assert not np.array_equal(one, other)
    assert other.mean() == pytest.approx(one.mean(), rel=0.05)
    about = json.loads((tmp_path / "scene000010.json").read_text())
    floor = reference_floor(*(common_scale((one.astype(float) + other) / 2) * half.astype(float)
                              for half in (one, other)))
    assert about["reference_floor"] == pytest.approx(floor, rel=1e-3)
    assert 0 < floor < about["relmse8"]
    # One whose JSON does not know of its half was stopped in between.
    about["settings"]["halves"] = False
    (tmp_path / "scene000010.json").write_text(json.dumps(about))
    assert len(render_scenes(in_halves, "none").frames) == 1


def test_moving_objects_have_references_in_halves_too() -> None:
    settings = RenderSettings(4, 4, SIZE, "tabletop", motion=True)
    plain, halved = (render_example(4, replace(settings, halves=halves), threads=1) for halves in (False, True))
    assert plain.other_half is None
    assert halved.other_half is not None
    np.testing.assert_array_equal(plain.reference, halved.reference)
    assert not np.array_equal(halved.other_half, halved.reference)
    assert halved.other_half.mean() == pytest.approx(halved.reference.mean(), rel=0.3)


def test_another_scene_of_the_same_file_name_does_not_mix_with_what_is_there(tmp_path: Path) -> None:
    scene = tmp_path / "room.xml"
    scene.write_text(SCENE)
    of_scene = options(tmp_path / "files", count=1, settings=RenderSettings(2, 2, SIZE), contact_sheet=False,
                       scene=scene)
    assert render_scenes(of_scene, "none").exit_code == 0
    assert render_scenes(of_scene, "none").frames == ()
    scene.write_text(SCENE.replace("0.6", "0.5"))
    with pytest.raises(UsageError, match="scene000010.json: was rendered of .*room.xml before that changed"):
        render_scenes(of_scene, "none")
    about = tmp_path / "files" / "scene000010.json"
    older = json.loads(about.read_text())
    del older["scene_digest"]
    about.write_text(json.dumps(older))
    assert render_scenes(of_scene, "none").frames == ()


def test_workers_give_the_same_examples_as_one_process(tmp_path: Path) -> None:
    for folder, workers in (("one", 1), ("two", 2)):
        report = render_scenes(options(tmp_path / folder, workers=workers, contact_sheet=False), "none")
        assert report.exit_code == 0
    for path in (tmp_path / "one").iterdir():
        assert path.read_bytes() == (tmp_path / "two" / path.name).read_bytes()


def test_a_scene_file_gives_views_with_features_and_motion(tmp_path: Path) -> None:
    scene = tmp_path / "room.xml"
    scene.write_text(SCENE)
    settings = RenderSettings(8, 8, SIZE, defocus=True, motion=True)
    shots = [render_example(seed, settings, scene, threads=1) for seed in (1, 2, 1)]
    for shot in shots:
        hit = shot.channels["A"] > 0
        assert shot.about["kind"] == "file"
        assert shot.about["motion_95"] > 0.2
        assert np.isfinite(shot.reference).all()
        floor = hit & (shot.channels["roughness"] == 1) & (shot.channels["albedo.R"] > 0)
        np.testing.assert_allclose(shot.channels["albedo.R"][floor], 0.6, atol=1e-3)
        metal = hit & (np.abs(shot.channels["roughness"] - 0.3) < 1e-3)
        assert (shot.channels["albedo.R"][metal] == 0).all()
        assert (shot.channels["specular.R"][metal] > 0.5).all()
    # The scene stays loaded between views; what moved must be back in its place.
    np.testing.assert_array_equal(shots[0].reference, shots[2].reference)


NAMELESS = """<scene version="3.0.0">
  <sensor type="perspective"><transform name="to_world"><lookat origin="0,1,4" target="0,0.5,0" up="0,1,0"/></transform>
  </sensor><emitter type="constant"/>
  <shape type="rectangle"><transform name="to_world"><scale value="4"/><rotate x="1" angle="-90"/></transform></shape>
  <shape type="obj"><string name="filename" value="sheet.obj"/></shape>
</scene>
"""
GROUPED = """<scene version="3.0.0"><emitter type="constant"/>
  <shape type="shapegroup" id="group"><shape type="cube"/></shape><shape type="instance"><ref id="group"/></shape>
</scene>"""
# A triangle with normals of the modeller's own, which are not those of its face.
SHEET = "v -0.3 0 0\nv 0.3 0 0\nv 0 0.6 0\nvn 0.5 0 0.866\nf 1//1 2//1 3//1\n"


def test_shapes_without_a_name_move_and_keep_their_own_normals(tmp_path: Path) -> None:
    (tmp_path / "scene.xml").write_text(NAMELESS)
    (tmp_path / "sheet.obj").write_text(SHEET)
    tracer = FileTracer(tmp_path / "scene.xml", threads=1)
    assert len(tracer.movable()) == 1
    camera = Camera.look_at([0, 0.3, 2], [0, 0.3, 0], 25).resized(SIZE)
    still, moving = (make_pattern(np.random.default_rng(1), SIZE**2, TIME_BINS, False, bins)
                     for bins in (None, TIME_BINS))
    before = tracer.trace(camera, still, 1)
    tracer.set_motions({number: Motion(np.array([0.2, 0.0, 0.0]), np.zeros(3), centre)
                        for number, centre in tracer.movable().items()})
    assert np.quantile(tracer.trace(camera, moving, 1)["motion.X"], 0.99) > 2
    tracer.close()
    after = tracer.trace(camera, still, 1)
    for name, values in before.items():
        np.testing.assert_array_equal(values, after[name], err_msg=name)
    assert np.isclose(before["N.X"], 0.5, atol=0.01).any()


@pytest.mark.parametrize(("text", "complaint"), [
    (GROUPED, "instances"),
    ("<scene version='3.0.0'><shape type='nonsense'/></scene>", "not a scene that Mitsuba can load"),
    ("<scene version='3.0.0'><shape type='sphere'/></scene>", "no lights"),
    ("not XML", "not a scene that Mitsuba can load"),
])
def test_an_unfit_scene_file_is_refused_by_name(tmp_path: Path, text: str, complaint: str) -> None:
    scene = tmp_path / "bad.xml"
    scene.write_text(text)
    with pytest.raises(InputError, match=complaint) as refused:
        render_example(1, SMALL, scene, threads=1)
    assert str(scene) in str(refused.value)
    assert "\n" not in str(refused.value)


def test_the_command_renders_and_reports(tmp_path: Path) -> None:
    run = in_process("render", tmp_path / "out", "--count", 1, "--seed", 2, "--samples", 4, "--reference", 4,
                     "--size", SIZE, "--layout", "tabletop", "--threads", 1, "--progress", "plain")
    assert run.code == 0, run.err
    assert "Progress: 100%" in run.err
    assert (tmp_path / "out" / "contact-sheet.png").read_bytes().startswith(b"\x89PNG")


@pytest.mark.parametrize(("arguments", "code", "complaint"), [
    (["--layout", "cellar"], 2, "interior"),
    (["--size", 33], 2, "multiple of 4"),
    (["--scene", "nowhere.xml"], 3, "nowhere.xml"),
    (["--scene", "nowhere.xml", "--layout", "outdoor"], 2, "one of the two"),
])
def test_the_command_refuses_in_one_line(tmp_path: Path, arguments: list[object], code: int, complaint: str) -> None:
    run = in_process("render", tmp_path, "--count", 1, *arguments)
    assert run.code == code
    assert run.err.startswith("ERROR:")
    assert complaint in run.err
    assert run.err.count("\n") == 1
