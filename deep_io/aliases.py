"""The names that renderers give to what lbmc calls roles: one row per layer name, facts only, no logic.

A row says which role a layer plays, in which space its normals are and what its depth measures. `role_matching.py`
does the matching. A layer whose convention is not documented well enough to convert has no row on purpose: a role
that is missing costs a little quality, a role that is wrong costs the picture.
"""

from __future__ import annotations

from dataclasses import dataclass

# Spaces of normals. "view" is the project's own: x right, y up, z toward the camera.
VIEW = "view"
CAMERA_Z_FORWARD = "camera-z-forward"  # left-handed camera space of RenderMan and pbrt: z along the view direction
WORLD = "world"

# Kinds of depth: planar camera-space z, or the length of the camera ray.
PLANAR = "z"
DISTANCE = "distance"


@dataclass(frozen=True)
class Alias:
    """One row: `layer` (compared without case, after any view-layer or part prefix) plays `role`.

    `renderer` "" holds for every file; a name holds only for files recognised as that renderer's, and then wins over
    the general row of the same layer. `component` picks one channel of a wider layer for a role of one number.
    `zero_is_miss` holds for depths that are 0, not 1e10, where the camera ray hit nothing.
    """

    role: str
    layer: str
    renderer: str = ""
    space: str = VIEW
    depth: str = PLANAR
    component: int | None = None
    zero_is_miss: bool = False
    note: str = ""


# How a file shows who wrote it: (start of an attribute's name, lower case; renderer). The first match counts.
# `lbmc:` stands first: pack keeps the renderer's own attributes but has already converted the channels.
RENDERER_MARKS: tuple[tuple[str, str], ...] = (
    ("lbmc:", "lbmc"),
    ("arnold/", "arnold"),
    ("blendermultichannel", "blender"),
    ("cycles.", "blender"),
    ("vrayinfo/", "vray"),
    ("husk:", "karma"),
    ("generatedby", "mitsuba"),
    ("rendertimeseconds", "pbrt"),
)

# Suffixes of a layer's channels, lower case -> position within the layer.
COMPONENTS: dict[str, int] = {
    "r": 0, "red": 0, "x": 0, "u": 0,
    "g": 1, "green": 1, "y": 1, "v": 1,
    "b": 2, "blue": 2, "z": 2,
    "a": 3, "alpha": 3, "w": 3,
    "t": 0,
}  # fmt: skip

# Channels without a layer that belong together as the main picture.
BARE_COMPONENTS: dict[str, int] = {
    "r": 0, "red": 0,
    "g": 1, "green": 1,
    "b": 2, "blue": 2,
    "a": 3, "alpha": 3,
}  # fmt: skip

ALIASES: tuple[Alias, ...] = (
    # radiance; its fourth component is the coverage
    Alias("radiance", ""),
    Alias("radiance", "rgb"),
    Alias("radiance", "rgba"),
    Alias("radiance", "beauty"),
    Alias("radiance", "ci"),  # RenderMan
    Alias("radiance", "c"),  # Karma
    Alias("radiance", "combined"),  # Blender
    # coverage on its own
    Alias("coverage", "coverage"),
    # depth
    Alias("depth", "z"),
    Alias("depth", "depth"),  # Blender (planar, 1e10 on a miss), Karma
    Alias("depth", "zdepth"),  # V-Ray: distance to the camera's XY plane
    Alias("depth", "z_depth"),
    Alias("depth", "vrayzdepth"),
    Alias("depth", "hitpz"),  # Karma
    Alias("depth", "p", "pbrt", component=2, note="z of the camera-space position"),
    Alias("depth", "depth", "mitsuba", depth=DISTANCE, zero_is_miss=True),
    Alias("depth", "dd.y", "mitsuba", depth=DISTANCE, zero_is_miss=True),  # the name in Mitsuba's own example
    Alias("depth", "hitdist", depth=DISTANCE),  # Karma
    Alias("depth", "distance", depth=DISTANCE),
    # normal
    Alias("normal", "n"),
    Alias("normal", "n", "arnold", space=WORLD),
    Alias("normal", "n_denoise", space=WORLD),  # Arnold
    Alias("normal", "normal", space=WORLD),  # Blender
    Alias("normal", "denoising normal", space=CAMERA_Z_FORWARD),  # Blender
    Alias("normal", "nn", "mitsuba", space=WORLD),  # the name in Mitsuba's own example
    Alias("normal", "nn", space=CAMERA_Z_FORWARD),  # RenderMan
    Alias("normal", "sh_normal", space=WORLD),  # Mitsuba
    Alias("normal", "n", "mitsuba", space=WORLD),
    Alias("normal", "__nworld", space=WORLD),  # RenderMan
    Alias("normal", "nworld", space=WORLD),
    Alias("normal", "hitn", space=WORLD),  # Karma
    Alias("normal", "ns", space=CAMERA_Z_FORWARD),  # pbrt's GBuffer film, coordinatesystem "camera" (its default)
    Alias("normal", "normals", note="V-Ray: screen space, off view space by the ray's angle"),
    Alias("normal", "vraynormals", note="V-Ray: screen space, off view space by the ray's angle"),
    # albedo
    Alias("albedo", "albedo"),
    Alias("albedo", "alb", "mitsuba"),
    Alias("albedo", "diffuse_albedo"),  # Arnold
    Alias("albedo", "diffuse color"),  # Blender
    Alias("albedo", "diffcol"),
    Alias("albedo", "denoising albedo"),
    Alias("albedo", "diffusefilter"),  # V-Ray
    Alias("albedo", "diffuse_filter"),
    Alias("albedo", "vraydiffusefilter"),
    Alias("albedo", "diffuse", "vray", note="V-Ray's diffuse is the surface colour, not the lighting"),
    # specular
    Alias("specular", "specular"),
    Alias("specular", "specular_albedo"),  # Arnold
    Alias("specular", "glossy color"),  # Blender
    Alias("specular", "glosscol"),
    Alias("specular", "reflectionfilter"),  # V-Ray
    Alias("specular", "reflection_filter"),
    Alias("specular", "vrayreflectionfilter"),
    # one number or two
    Alias("roughness", "roughness"),
    Alias("motion", "motion"),
    Alias("coc", "coc"),
    Alias("lens", "lens"),
    Alias("time", "time"),
)

# Layers that look like a role and are none: layer, renderer ("" any), reason shown beside the mapping.
NOT_A_ROLE: tuple[tuple[str, str, str], ...] = (
    ("vector", "", "Blender's Vector is per frame, not per shutter, and all zero under motion blur"),
    ("denoising depth", "", "Blender's Denoising Depth is not the depth of the hit"),
    ("coverage", "vray", "V-Ray's coverage is the part of one object in the pixel, not alpha"),
    ("specular", "arnold", "Arnold's specular is lighting; specular_albedo is the colour"),
    ("n", "pbrt", "pbrt's N is the geometric normal; Ns is the shading normal"),
    ("motionvector", "", "unit and shutter of motion vectors differ between set-ups; convert to motion.X, motion.Y"),
    ("velocity", "", "the unit of velocities differs between set-ups; convert to motion.X, motion.Y"),
)
