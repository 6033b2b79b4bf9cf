"""Channel names to roles: every renderer's names, one claim per role, errors that name the layers."""

from __future__ import annotations

import numpy as np
import pytest

from deep_io.errors import InputError, UsageError
from deep_io.role_matching import map_roles, renderer_of
from deep_io.roles import ROLES

CANONICAL = [name for role in ROLES.values() for name in role.channels]

BLENDER = ["ViewLayer.Combined.R", "ViewLayer.Combined.G", "ViewLayer.Combined.B", "ViewLayer.Combined.A",
           "ViewLayer.Depth.Z", "ViewLayer.Normal.X", "ViewLayer.Normal.Y", "ViewLayer.Normal.Z",
           "ViewLayer.Vector.X", "ViewLayer.Vector.Y", "ViewLayer.Vector.Z", "ViewLayer.Vector.W",
           "ViewLayer.Diffuse Color.R", "ViewLayer.Diffuse Color.G", "ViewLayer.Diffuse Color.B",
           "ViewLayer.Glossy Color.R", "ViewLayer.Glossy Color.G", "ViewLayer.Glossy Color.B",
           "ViewLayer.Denoising Depth.Z", "ViewLayer.Roughness.X"]


def test_canonical_channels_map_to_all_roles_in_their_own_conventions():
    mapping = map_roles(CANONICAL)
    assert list(mapping.sources) == list(ROLES)
    for role, source in mapping.sources.items():
        assert source.channels == ROLES[role].channels
    assert mapping["normal"].space == "view"
    assert mapping["depth"].depth == "z"
    assert mapping.unused == ()
    assert mapping.remarks == ()


def test_only_radiance_is_required():
    mapping = map_roles(["B", "G", "R"])
    assert list(mapping.sources) == ["radiance"]
    assert mapping["radiance"].channels == ("R", "G", "B")
    assert "1 everywhere" in mapping.coverage_rule


def test_blender_layers_map_with_their_spaces_and_the_reasons_for_what_is_left_out():
    mapping = map_roles(BLENDER, attributes=["BlenderMultiChannel", "cycles.ViewLayer.samples"])
    assert mapping.renderer == "blender"
    assert mapping["coverage"].channels == ("ViewLayer.Combined.A",)
    assert mapping["depth"].channels == ("ViewLayer.Depth.Z",)
    assert mapping["normal"].space == "world"
    assert mapping["albedo"].layer == "ViewLayer.Diffuse Color"
    assert mapping["specular"].layer == "ViewLayer.Glossy Color"
    assert mapping["roughness"].channels == ("ViewLayer.Roughness.X",)
    assert "motion" not in mapping
    assert any("Vector" in remark for remark in mapping.remarks)
    assert any("Denoising Depth" in remark for remark in mapping.remarks)
    assert "ViewLayer.Vector.W" in mapping.unused


@pytest.mark.parametrize(("names", "attributes", "role", "channels", "space"), [
    (["R", "G", "B", "N.X", "N.Y", "N.Z"], ["arnold/host/name"], "normal", ("N.X", "N.Y", "N.Z"), "world"),
    (["R", "G", "B", "N.X", "N.Y", "N.Z"], [], "normal", ("N.X", "N.Y", "N.Z"), "view"),
    (["R", "G", "B", "N.X", "N.Y", "N.Z"], ["arnold/host/name", "lbmc:weighting"], "normal", ("N.X", "N.Y", "N.Z"),
     "view"),
    (["R", "G", "B", "Nn.r", "Nn.g", "Nn.b"], [], "normal", ("Nn.r", "Nn.g", "Nn.b"), "camera-z-forward"),
    (["R", "G", "B", "Ns.X", "Ns.Y", "Ns.Z", "N.X", "N.Y", "N.Z"], ["renderTimeSeconds"], "normal",
     ("Ns.X", "Ns.Y", "Ns.Z"), "camera-z-forward"),
    (["R", "G", "B", "nn.X", "nn.Y", "nn.Z"], ["generatedBy"], "normal", ("nn.X", "nn.Y", "nn.Z"), "world"),
    (["C.r", "C.g", "C.b", "C.a", "hitN.x", "hitN.y", "hitN.z"], [], "normal", ("hitN.x", "hitN.y", "hitN.z"), "world"),
    (["R", "G", "B", "VL.Denoising Normal.X", "VL.Denoising Normal.Y", "VL.Denoising Normal.Z"], [], "normal",
     ("VL.Denoising Normal.X", "VL.Denoising Normal.Y", "VL.Denoising Normal.Z"), "camera-z-forward"),
    (["R", "G", "B", "diffuse.red", "diffuse.green", "diffuse.blue"], ["vrayInfo/vrayversion"], "albedo",
     ("diffuse.red", "diffuse.green", "diffuse.blue"), "view"),
    (["R", "G", "B", "diffuse_albedo.R", "diffuse_albedo.G", "diffuse_albedo.B"], [], "albedo",
     ("diffuse_albedo.R", "diffuse_albedo.G", "diffuse_albedo.B"), "view"),
    (["Ci.r", "Ci.g", "Ci.b", "a", "z"], [], "radiance", ("Ci.r", "Ci.g", "Ci.b"), "view"),
    (["beauty.red", "beauty.green", "beauty.blue"], [], "radiance", ("beauty.red", "beauty.green", "beauty.blue"),
     "view"),
    (["R", "G", "B", "P.X", "P.Y", "P.Z"], ["renderTimeSeconds"], "depth", ("P.Z",), "view"),
])
def test_renderer_names_map_in_their_space(names, attributes, role, channels, space):
    mapping = map_roles(names, attributes=attributes)
    assert mapping[role].channels == channels
    assert mapping[role].space == space


def test_mitsuba_depth_is_a_distance_whose_zero_is_a_miss():
    mapping = map_roles(["R", "G", "B", "A", "dd.y.T"], attributes=["generatedBy"])
    assert mapping["depth"].channels == ("dd.y.T",)
    assert mapping["depth"].depth == "distance"
    assert mapping["depth"].zero_is_miss


def test_two_layers_for_one_role_are_an_error_naming_both_and_the_option_resolves_it():
    names = ["R", "G", "B", "Normal.X", "Normal.Y", "Normal.Z", "N.X", "N.Y", "N.Z"]
    with pytest.raises(InputError, match=r"shot\.exr: 'Normal' and 'N' both match the role 'normal'.*--map normal="):
        map_roles(names, source="shot.exr")
    mapping = map_roles(names, {"normal": "Normal"})
    assert mapping["normal"].layer == "Normal"
    assert mapping["normal"].space == "world"
    assert "normal" not in map_roles(names, {"normal": "none"})


def test_two_view_layers_with_a_beauty_are_an_error():
    names = [f"{layer}.Combined.{c}" for layer in ("Front", "Back") for c in "RGBA"]
    with pytest.raises(InputError, match=r"'Front\.Combined' and 'Back\.Combined'"):
        map_roles(names)
    mapping = map_roles(names, {"radiance": "Back.Combined"})
    assert mapping["coverage"].channels == ("Back.Combined.A",)


def test_alpha_and_a_coverage_layer_are_an_error_naming_both():
    names = ["R", "G", "B", "A", "coverage.R"]
    with pytest.raises(InputError, match="'A' and 'coverage' both match the role 'coverage'"):
        map_roles(names)
    assert map_roles(names, {"coverage": "coverage"})["coverage"].channels == ("coverage.R",)
    assert map_roles(names, {"coverage": "A"})["coverage"].channels == ("A",)
    assert map_roles(names, attributes=["vrayInfo/version"])["coverage"].channels == ("A",)


def test_an_option_takes_any_layer_and_any_single_channel():
    names = ["R", "G", "B", "mine.R", "mine.G", "mine.B", "extra.Q", "extra.x"]
    mapping = map_roles(names, {"albedo": "mine", "roughness": "extra.Q", "time": "extra.x"})
    assert mapping["albedo"].channels == ("mine.R", "mine.G", "mine.B")
    assert mapping["roughness"].channels == ("extra.Q",)
    assert mapping["time"].channels == ("extra.x",)
    assert "by --map" in mapping["albedo"].convention


@pytest.mark.parametrize(("overrides", "error", "message"), [
    ({"albedo": "absent"}, InputError, "no such layer"),
    ({"albedo": "narrow"}, InputError, "takes 3 channels"),
    ({"colour": "mine"}, UsageError, "unknown role"),
])
def test_wrong_options_are_errors(overrides, error, message):
    with pytest.raises(error, match=message):
        map_roles(["R", "G", "B", "narrow.R", "narrow.G"], overrides)


@pytest.mark.parametrize("names", [["Y"], ["R", "G"], ["Z", "A"], ["diffuse.R", "diffuse.G", "diffuse.B"]])
def test_no_rgb_is_an_error_that_says_how_to_choose(names):
    with pytest.raises(InputError, match=r"x\.exr: no R, G, B channels.*--map radiance"):
        map_roles(names, source="x.exr")


def test_an_incomplete_beauty_is_listed_by_what_it_has():
    with pytest.raises(InputError, match=r"there are R G, albedo\)"):
        map_roles(["R", "G", "albedo.R", "albedo.G", "albedo.B"])


def test_uint_radiance_is_an_error():
    dtypes = {name: np.dtype(np.float16) for name in "RGB"} | {"G": np.dtype(np.uint32)}
    with pytest.raises(InputError, match="'G' is uint"):
        map_roles(["R", "G", "B"], dtypes=dtypes)


def test_an_incomplete_layer_is_remarked_and_not_used():
    mapping = map_roles(["R", "G", "B", "albedo.R", "albedo.G"])
    assert "albedo" not in mapping
    assert mapping.remarks == ("albedo is not used as albedo: it has only albedo.R albedo.G",)


def test_the_mapping_prints_a_line_for_every_role():
    lines = map_roles(BLENDER).lines()
    text = "\n".join(lines)
    for role in ROLES:
        assert any(line.startswith(role) for line in lines)
    assert "world space, to be turned by the camera" in text
    assert "motion     -- missing" in text
    assert "ViewLayer.Combined.A, 0 where the depth says miss" in text


def test_arnold_specular_lighting_is_no_specular_colour():
    names = ["R", "G", "B", "specular.R", "specular.G", "specular.B"]
    assert "specular" in map_roles(names)
    assert "specular" not in map_roles(names, attributes=["arnold/version"])


def test_the_renderer_is_recognised_by_its_attributes():
    assert renderer_of(["compression", "Arnold/version"]) == "arnold"
    assert renderer_of(["cycles.ViewLayer.samples"]) == "blender"
    assert renderer_of(["owner"]) == ""
