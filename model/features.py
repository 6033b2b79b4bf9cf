"""Per-sample features: what the sample reducer sees of each role, and the divisor, which texture is measured by.

Radiance enters relative to the frame's exposure, depth relative to the frame's median hit depth, pixel quantities
(motion, circle of confusion) squashed by x / (4 + |x|). Of a miss only the radiance is read from a file; its other
features are 0, that of time, which is centred, -1/2.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import torch
from torch import Tensor

from model.samples import ROLE_WIDTHS, Samples

DEPTH_LIMIT = 8.0  # |log(z / median)| beyond this carries no more information
SQUASH_PIXELS = 4.0  # half of the range of x / (SQUASH + |x|) is reached at this many pixels
PRODUCTS = (("coc", "lens"), ("motion", "time"))  # of roles, as features of their own; two wide
DIVISOR_FLOOR = 0.03  # surfaces darker than this count as so dark


@dataclass(frozen=True)
class FrameScale:
    """Two numbers per frame (or shot) that make the network blind to units.

    exposure : 1/radiance; radiance * exposure is about 1 in the middle of the histogram
    depth : scene units; the median depth of the hits
    """

    exposure: float = 1.0
    depth: float = 1.0


def _squash(pixels: Tensor) -> Tensor:
    return pixels / (SQUASH_PIXELS + pixels.abs())


def log_radiance(radiance: Tensor, exposure: float) -> Tensor:
    """log(1 + exposure * max(L, 0)): the network's view of radiance; negative radiance counts as 0 here only."""
    return torch.log1p((radiance.clamp_min(0) * exposure).clamp_max(torch.finfo(radiance.dtype).max))


def log_depth(depth: Tensor, median: float) -> Tensor:
    """log(z / median), clamped to +-DEPTH_LIMIT."""
    tiny = torch.finfo(depth.dtype).tiny
    return torch.log((depth / median).clamp_min(tiny)).clamp(-DEPTH_LIMIT, DEPTH_LIMIT)


def feature_groups(roles: Iterable[str], derived: bool) -> dict[str, int]:
    """Widths of the feature groups a network with these roles has: one group per role, then products of roles.

    Products an MLP learns slowly are given to it: coc * lens and motion * (time - 1/2), both in pixels.
    """
    roles = tuple(roles)
    groups = {role: ROLE_WIDTHS[role] for role in roles}
    if derived:
        groups["coverage"] = 1
        groups |= {f"{a}*{b}": 2 for a, b in PRODUCTS if a in roles and b in roles}
    return groups


def held_groups(samples: Samples) -> set[str]:
    """The groups whose features are 0 because a role is held: the role's own and its products."""
    there = {*samples.roles, *samples.held}
    products = {f"{a}*{b}" for a, b in PRODUCTS if {a, b} <= there and {a, b} & samples.held}
    return {*samples.held, *products}


def encode(samples: Samples, scale: FrameScale, groups: Iterable[str]) -> dict[str, Tensor]:
    """Feature groups of those named that these samples have: name -> (N, width), all finite."""
    roles = samples.roles
    hit = (samples.coverage > 0)[:, None]  # (N, 1)
    out: dict[str, Tensor] = {}
    for group in groups:
        if group == "radiance":
            out[group] = log_radiance(roles["radiance"], scale.exposure)
        elif group == "coverage":
            out[group] = samples.coverage[:, None]
        elif group == "coc*lens":
            if "coc" in roles and "lens" in roles:
                out[group] = torch.where(hit, _squash(roles["coc"] * roles["lens"]), 0)
        elif group == "motion*time":
            if "motion" in roles and "time" in roles:
                out[group] = torch.where(hit, _squash(roles["motion"] * (roles["time"] - 0.5)), 0)
        elif group in roles:
            out[group] = _encode_role(group, roles[group], hit, scale)
    return out


def _encode_role(role: str, values: Tensor, hit: Tensor, scale: FrameScale) -> Tensor:
    if role == "depth":
        return log_depth(torch.where(hit, values, scale.depth), scale.depth)
    if role in ("motion", "coc"):
        return _squash(torch.where(hit, values, 0))
    if role == "lens":
        return values  # 0 on a miss, as it is read
    if role == "time":
        return values - 0.5  # -1/2 on a miss, whose time is read as 0: trained networks know it so
    return torch.where(hit, values, 0)


def divisor(samples: Samples) -> Tensor:
    """(N, 3): what texture is measured by: albedo + specular, DIVISOR_FLOOR to 1; 1 on misses and what has none."""
    total = torch.zeros_like(samples.roles["radiance"])
    for role in ("albedo", "specular"):
        if role in samples.roles:
            total = total + samples.roles[role]
    textured = (samples.coverage[:, None] > 0) & (total.amax(1, keepdim=True) > 0)
    return torch.where(textured, total.clamp(DIVISOR_FLOOR, 1.0), torch.ones_like(total))
