"""Roles: what the numbers of a sample mean, and which channels of a file hold them.

A RoleMap prints itself for `lbmc info`. How one is found among a file's channels is role_matching.py's business,
reading the channels and converting them to the project's spaces decoding.py's.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from deep_io.aliases import DISTANCE, PLANAR, VIEW, WORLD

MISS_DEPTH = 1e10  # a depth of this or more says that the camera ray hit nothing


@dataclass(frozen=True)
class Role:
    """What one role holds: its channels in a file of ours, and what a missing or broken value is replaced by."""

    name: str
    channels: tuple[str, ...]
    meaning: str
    missing: float = 0.0

    @property
    def width(self) -> int:
        """Numbers per sample."""
        return len(self.channels)


ROLES: dict[str, Role] = {role.name: role for role in (
    Role("radiance", ("R", "G", "B"), "linear radiance of the path"),
    Role("coverage", ("A",), "1 where the camera ray hit something, 0 where it missed, fractions for opacity"),
    Role("depth", ("Z",), "planar camera-space depth; 0 on a miss once read, 1e10 in the file"),
    Role("normal", ("N.X", "N.Y", "N.Z"), "shading normal in view space: x right, y up, z toward the camera"),
    Role("albedo", ("albedo.R", "albedo.G", "albedo.B"), "diffuse albedo at the first hit"),
    Role("specular", ("specular.R", "specular.G", "specular.B"), "specular colour (F0) at the first hit"),
    Role("roughness", ("roughness",), "0..1 at the first hit"),
    Role("motion", ("motion.X", "motion.Y"), "screen motion over the whole shutter, pixels, x right, y down"),
    Role("coc", ("coc",), "signed circle-of-confusion radius, pixels, positive behind the focus plane"),
    Role("lens", ("lens.X", "lens.Y"), "lens position on the unit disk"),
    Role("time", ("time",), "0..1 within the shutter"),
)}


@dataclass(frozen=True)
class RoleSource:
    """Where one role comes from: `channels` of `layer`, in the convention that the alias table states."""

    role: str
    layer: str
    channels: tuple[str, ...]
    space: str = VIEW
    depth: str = PLANAR
    zero_is_miss: bool = False
    note: str = ""
    by_option: bool = False

    @property
    def convention(self) -> str:
        """In words, what has to be converted or known about the channels; "" where nothing has."""
        words = []
        if self.role == "normal":
            words.append(f"{self.space} space" if self.space != WORLD else "world space, to be turned by the camera")
        if self.role == "depth":
            words.append("ray length, made planar by the camera" if self.depth == DISTANCE else "planar")
        if self.zero_is_miss:
            words.append("0 is a miss")
        if self.by_option:
            words.append("by --map")
        return ", ".join(filter(None, [*words, self.note]))


@dataclass(frozen=True)
class RoleMap:
    """The roles found in a file and the channels that hold them.

    sources    role -> RoleSource, in the order of ROLES; "radiance" always
    unused     channels that play no role, in the file's order
    remarks    one line for each layer that looks like a role and is not used, with the reason
    renderer   the renderer the header points to, "" if none
    """

    sources: Mapping[str, RoleSource]
    unused: tuple[str, ...] = ()
    remarks: tuple[str, ...] = ()
    renderer: str = ""

    def __contains__(self, role: object) -> bool:
        return role in self.sources

    def __getitem__(self, role: str) -> RoleSource:
        return self.sources[role]

    @property
    def roles(self) -> tuple[str, ...]:
        """The roles found, in the order of ROLES."""
        return tuple(self.sources)

    @property
    def channels(self) -> tuple[str, ...]:
        """Every channel that has to be read, each once."""
        return tuple(dict.fromkeys(name for source in self.sources.values() for name in source.channels))

    @property
    def coverage_rule(self) -> str:
        """In words, where coverage comes from."""
        if "coverage" in self and "depth" in self:
            return f"{self['coverage'].channels[0]}, 0 where the depth says miss"
        if "coverage" in self:
            return self["coverage"].channels[0]
        return "1 where the depth is a hit, 0 on a miss" if "depth" in self else "1 everywhere (no A, no depth)"

    def lines(self) -> list[str]:
        """The mapping as text, one line per role and remark, for `lbmc info` and `--dry-run`."""
        text = []
        for role in ROLES:
            if role == "coverage":
                text.append(f"{role:<10} <- {self.coverage_rule}")
            elif role in self:
                source = self[role]
                text.append(f"{role:<10} <- {' '.join(source.channels)}"
                            + (f"  ({source.convention})" if source.convention else ""))
            else:
                text.append(f"{role:<10} -- missing")
        if self.unused:
            text.append(f"{'unused':<10}    {' '.join(self.unused)}")
        return [*text, *(f"{'note':<10}    {remark}" for remark in self.remarks)]
