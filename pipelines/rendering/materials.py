"""Materials: a fixed table of slots, one BSDF instance and one mesh each, and what the sample features say of them.

The renderer compiles a kernel per set of BSDF instances, so every scene has exactly these slots; unused ones get a
mesh too small to be seen. Indices of refraction are fixed, all other values are opaque to the compiler.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from pipelines.rendering.textures import SIZE
from pipelines.rendering.tracer import SurfaceLook

Image = npt.NDArray[np.float32]

QUOTAS: dict[str, int] = {
    "matte": 10, "colored": 3, "plastic": 2, "roughplastic": 3, "metal": 3, "mirror": 1, "glass": 2, "frosted": 1,
    "pane": 1, "principled": 4, "translucent": 2, "cutout": 2, "light": 5,
}
SLOT_KINDS: tuple[str, ...] = tuple(kind for kind, count in QUOTAS.items() for _ in range(count))

DIELECTRIC_F0 = 0.04  # ((1.5 - 1) / (1.5 + 1))^2
GLASS_IOR = 1.5


@dataclass(frozen=True)
class Material:
    """What fills a slot. `alpha` is the GGX width, `tint` the specular colour, `emission` radiance (3,)."""

    kind: str
    texture: Image | None = None
    opacity: Image | None = None
    alpha: float = 0.1
    tint: tuple[float, float, float] = (0.9, 0.9, 0.9)
    metallic: float = 0.0
    clearcoat: float = 0.0
    emission: tuple[float, float, float] = (0.0, 0.0, 0.0)


def surface_look(material: Material, used: bool = True) -> SurfaceLook:
    """The first-hit features of a slot; the cut-outs of a slot not `used` need no attention.

    Roughness is sqrt(alpha), the artists' scale; smooth lobes have 0, purely diffuse and emitting surfaces 1.
    """
    dielectric, rough = (DIELECTRIC_F0,) * 3, material.alpha**0.5
    match material.kind:
        case "plastic":
            return SurfaceLook(specular=dielectric, roughness=0.0)
        case "roughplastic":
            return SurfaceLook(specular=dielectric, roughness=rough)
        case "metal":
            return SurfaceLook(specular=material.tint, roughness=rough, diffuse=False)
        case "mirror":
            return SurfaceLook(specular=material.tint, roughness=0.0, diffuse=False)
        case "glass" | "pane":
            return SurfaceLook(specular=dielectric, roughness=0.0, diffuse=False)
        case "frosted":
            return SurfaceLook(specular=dielectric, roughness=rough, diffuse=False)
        case "principled":
            m = material.metallic
            f0 = (1 - m) * DIELECTRIC_F0
            return SurfaceLook(albedo_gain=1 - m, specular=(f0, f0, f0), specular_by_base=m, roughness=rough)
        case "light":
            return SurfaceLook(diffuse=False)
        case "cutout":
            return SurfaceLook(cutout=used)
    return SurfaceLook()


def bsdf_dict(mi: Any, material: Material) -> dict[str, Any]:
    """Mitsuba's description of the BSDF of `material`; `mi` is the imported mitsuba module."""
    grey = np.full((SIZE, SIZE, 3), 0.5, np.float32)

    def bitmap(image: Image | None) -> dict[str, Any]:
        return {"type": "bitmap", "bitmap": mi.Bitmap(np.ascontiguousarray(grey if image is None else image)),
                "raw": True, "filter_type": "bilinear", "wrap_mode": "repeat"}

    def color(value: tuple[float, float, float]) -> dict[str, Any]:
        return {"type": "rgb", "value": list(value)}

    inner: dict[str, Any]
    match material.kind:
        case "colored":
            inner = {"type": "diffuse", "reflectance": {"type": "mesh_attribute", "name": "vertex_color"}}
        case "plastic":
            inner = {"type": "plastic", "diffuse_reflectance": bitmap(material.texture), "int_ior": GLASS_IOR}
        case "roughplastic":
            inner = {"type": "roughplastic", "diffuse_reflectance": bitmap(material.texture), "int_ior": GLASS_IOR,
                     "distribution": "ggx", "alpha": material.alpha}
        case "metal":
            inner = {"type": "roughconductor", "material": "none", "distribution": "ggx", "alpha": material.alpha,
                     "specular_reflectance": color(material.tint)}
        case "mirror":
            inner = {"type": "conductor", "material": "none", "specular_reflectance": color(material.tint)}
        case "glass":
            return {"type": "dielectric", "int_ior": GLASS_IOR, "specular_transmittance": color(material.tint)}
        case "frosted":
            return {"type": "roughdielectric", "int_ior": GLASS_IOR, "distribution": "ggx", "alpha": material.alpha}
        case "pane":
            return {"type": "thindielectric", "int_ior": GLASS_IOR}
        case "principled":
            inner = {"type": "principled", "base_color": bitmap(material.texture), "roughness": material.alpha**0.5,
                     "metallic": material.metallic, "specular": 0.5, "clearcoat": material.clearcoat,
                     "clearcoat_gloss": 0.9}
        case "translucent":
            return {"type": "principledthin", "base_color": bitmap(material.texture), "roughness": 0.6,
                    "diff_trans": 0.8, "eta": GLASS_IOR}
        case "cutout":
            opacity = np.ones((SIZE, SIZE, 1), np.float32) if material.opacity is None else material.opacity
            return {"type": "mask", "opacity": bitmap(opacity),
                    "nested": {"type": "twosided", "inner": {"type": "diffuse",
                                                             "reflectance": bitmap(material.texture)}}}
        case "light":
            inner = {"type": "diffuse", "reflectance": bitmap(np.zeros_like(grey))}
        case _:
            inner = {"type": "diffuse", "reflectance": bitmap(material.texture)}
    return {"type": "twosided", "inner": inner}
