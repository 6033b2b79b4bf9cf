"""Roles: what the numbers of a sample mean, and which channels of a file hold them.

`map_roles` turns channel names into a RoleMap with the table of aliases.py; the RoleMap prints itself for
`lbmc info`. Reading the channels and converting them to the project's spaces is path_samples.py's business.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace

import numpy as np

from deep_io.aliases import (
    ALIASES,
    BARE_COMPONENTS,
    COMPONENTS,
    DISTANCE,
    NOT_A_ROLE,
    PLANAR,
    RENDERER_MARKS,
    VIEW,
    WORLD,
    Alias,
)
from deep_io.errors import InputError, UsageError

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
            words.append(f"{self.space} space" if self.space != WORLD else "world space, turned by the camera")
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


def renderer_of(attributes: Iterable[str]) -> str:
    """The renderer that header attribute names point to (see RENDERER_MARKS), "" if none."""
    names = [name.lower() for name in attributes]
    return next((renderer for start, renderer in RENDERER_MARKS if any(name.startswith(start) for name in names)), "")


def map_roles(channel_names: Iterable[str], overrides: Mapping[str, str] | None = None, *,
              attributes: Iterable[str] = (), dtypes: Mapping[str, np.dtype[np.generic]] | None = None,
              source: str = "the file") -> RoleMap:
    """Find the roles among the channels of a file.

    Parameters
        channel_names  the file's channels, with view-layer or part prefixes
        overrides      role -> layer or single channel, as given by `--map role=layer`; "" or "none" drops the role
        attributes     names of the header's attributes: they show the renderer, whose rows then win
        dtypes         the channels' types, to refuse radiance stored as uint
        source         the file's name for messages
    Raises InputError when there is no R, G, B, when two layers match one role, when radiance is uint or when an
    override names a layer that is absent or too narrow; UsageError when it names an unknown role.
    """
    names = list(channel_names)
    layers = _layers(names)
    renderer = renderer_of(attributes)
    found: dict[str, RoleSource] = {}
    remarks: list[str] = []
    wanted = dict(overrides or {})
    for role, layer in wanted.items():
        if role not in ROLES:
            raise UsageError(f"--map {role}={layer}: unknown role; the roles are {', '.join(ROLES)}")
        if layer.lower() not in ("", "none"):
            found[role] = _by_option(role, layer, layers, renderer, source)
    claims: dict[str, list[RoleSource]] = {}
    # One channel picked out of a wider layer, such as the A of RGBA, leaves the layer to its own role.
    chosen = {claim.layer for claim in found.values() if len(claim.channels) > 1 or len(layers[claim.layer]) == 1}
    for layer, components in layers.items():
        if layer in chosen:
            continue  # named by an option: not up for matching, nothing to remark
        reason = _reason_against(layer, renderer)
        if reason:
            remarks.append(f"{layer} is not used: {reason}")
        row = None if reason else _row(layer, renderer)
        if row is not None and row.role not in wanted:
            claim = _claim(row, layer, components)
            if claim is not None:
                claims.setdefault(row.role, []).append(claim)
            else:
                has = " ".join(components.values())
                remarks.append(f"{layer or 'RGB'} is not used as {row.role}: it has only {has}")
    for role, candidates in claims.items():
        if len(candidates) > 1:
            both = " and ".join(repr(claim.layer or "RGB") for claim in candidates)
            raise InputError(f"{source}: {both} both match the role {role!r}; choose one with --map {role}=LAYER")
        found[role] = candidates[0]
    if "radiance" not in found:
        there = ", ".join(layer or " ".join(components.values()) for layer, components in layers.items())
        raise InputError(f"{source}: no R, G, B channels; name the layer with the beauty by --map radiance=LAYER "
                         f"(there are {there})")
    if "coverage" not in wanted:
        alpha = layers.get(found["radiance"].layer, {}).get(3)
        if alpha is not None and "coverage" in found:
            raise InputError(f"{source}: {alpha!r} and {found['coverage'].layer!r} both match the role 'coverage'; "
                             f"choose one with --map coverage=CHANNEL")
        if alpha is not None:
            found["coverage"] = RoleSource("coverage", found["radiance"].layer, (alpha,))
    _refuse_uint(found["radiance"], dtypes or {}, source)
    used = {name for claim in found.values() for name in claim.channels}
    return RoleMap({role: found[role] for role in ROLES if role in found},
                   tuple(name for name in names if name not in used), tuple(remarks), renderer)


def _layers(names: Iterable[str]) -> dict[str, dict[int, str]]:
    """Layer -> {component: channel}. A channel without a known suffix is a layer of its own with component 0."""
    layers: dict[str, dict[int, str]] = {}
    for name in names:
        layer, dot, suffix = name.rpartition(".")
        if dot and suffix.lower() in COMPONENTS:
            layers.setdefault(layer, {}).setdefault(COMPONENTS[suffix.lower()], name)
        elif name.lower() in BARE_COMPONENTS:
            layers.setdefault("", {}).setdefault(BARE_COMPONENTS[name.lower()], name)
        else:
            layers.setdefault(name, {}).setdefault(0, name)
    return {layer: dict(sorted(components.items())) for layer, components in layers.items()}


def _ends_with(layer: str, alias: str) -> bool:
    """Whether `layer` is the alias, or the alias after a view-layer or part prefix."""
    layer = layer.lower()
    return layer == alias or bool(alias and layer.endswith("." + alias))


def _row(layer: str, renderer: str) -> Alias | None:
    """The alias table's row for a layer; the renderer's own rows win over the general ones."""
    rows = [row for row in ALIASES if row.renderer in ("", renderer) and _ends_with(layer, row.layer)]
    return max(rows, key=lambda row: (row.renderer != "", len(row.layer)), default=None)


def _reason_against(layer: str, renderer: str) -> str:
    return next((reason for name, of, reason in NOT_A_ROLE if of in ("", renderer) and _ends_with(layer, name)), "")


def _claim(row: Alias, layer: str, components: Mapping[int, str]) -> RoleSource | None:
    """The role's channels out of a layer, or None if the layer is too narrow."""
    width = ROLES[row.role].width
    if row.component is not None:
        wanted = [row.component]
    else:
        # One number may have any suffix (`Depth.Z`, `Roughness.X`); vectors and colours need theirs.
        wanted = list(components)[:1] if width == 1 else list(range(width))
    if not all(index in components for index in wanted):
        return None
    return RoleSource(row.role, layer, tuple(components[index] for index in wanted), row.space, row.depth,
                      row.zero_is_miss, row.note)


def _by_option(role: str, text: str, layers: Mapping[str, Mapping[int, str]], renderer: str,
               source: str) -> RoleSource:
    """The layer (or single channel) that `--map role=text` names."""
    option = f"--map {role}={text}"
    matches = [layer for layer in layers if layer == text or (text in ("RGB", "RGBA") and layer == "")]
    matches = matches or [layer for layer in layers if _ends_with(layer, text.lower())]
    if len(matches) > 1:
        raise InputError(f"{source}: {option} matches {' and '.join(map(repr, matches))}; give the whole name")
    if not matches:
        # A single channel, such as `other.fields.q` or one component of a layer.
        for layer, components in layers.items():
            if text in components.values() and ROLES[role].width == 1:
                return RoleSource(role, layer, (text,), by_option=True)
        raise InputError(f"{source}: {option}: no such layer; it has {', '.join(name or 'RGB' for name in layers)}")
    row = _row(matches[0], renderer)
    if row is None or row.role != role:
        row = Alias(role, text.lower())
    claim = _claim(row, matches[0], layers[matches[0]])
    if claim is None:
        raise InputError(f"{source}: {option}: the role takes {ROLES[role].width} channels, the layer has "
                         f"{' '.join(layers[matches[0]].values())}")
    return replace(claim, by_option=True)


def _refuse_uint(radiance: RoleSource, dtypes: Mapping[str, np.dtype[np.generic]], source: str) -> None:
    for name in radiance.channels:
        if name in dtypes and np.dtype(dtypes[name]).kind != "f":
            raise InputError(f"{source}: radiance channel {name!r} is uint; radiance must be half or float, "
                             f"choose another layer with --map radiance=LAYER")
