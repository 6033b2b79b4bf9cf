"""Finding the roles among the channels of a file, with the table of aliases.py and what the user says by `--map`."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping
from dataclasses import replace

import numpy as np

from deep_io.aliases import ALIASES, BARE_COMPONENTS, COMPONENTS, NOT_A_ROLE, RENDERER_MARKS, Alias
from deep_io.errors import InputError, UsageError
from deep_io.roles import ROLES, RoleMap, RoleSource

Layers = Mapping[str, Mapping[int, str]]  # layer -> {component: channel}


def renderer_of(attributes: Iterable[str]) -> str:
    """The renderer that header attribute names point to (see RENDERER_MARKS), "" if none."""
    names = [name.lower() for name in attributes]
    return next((renderer for start, renderer in RENDERER_MARKS if any(name.startswith(start) for name in names)), "")


def map_roles(channel_names: Iterable[str], overrides: Mapping[str, str] | None = None, *,
              attributes: Iterable[str] = (), dtypes: Mapping[str, np.dtype[np.generic]] | None = None,
              source: str = "the file", lights: Collection[str] = ()) -> RoleMap:
    """Find the roles among the channels of a file.

    Parameters
        channel_names  the file's channels, with view-layer or part prefixes
        overrides      role -> layer or single channel, as given by `--map role=layer`; "" or "none" drops the role
        attributes     names of the header's attributes: they show the renderer, whose rows then win
        dtypes         the channels' types, to refuse radiance stored as uint
        source         the file's name for messages
        lights         layers that are known for parts of the radiance: they play no role but by an override
    Raises InputError when there is no R, G, B, when two layers match one role, when radiance is uint or when an
    override names a layer that is absent or too narrow; UsageError when it names an unknown role.
    """
    names = list(channel_names)
    layers = _layers(names)
    renderer = renderer_of(attributes)
    overrides = dict(overrides or {})
    found = _by_options(overrides, layers, renderer, source)
    claims, remarks = _by_names(overrides, found, layers, renderer, lights)
    for role, candidates in claims.items():
        if len(candidates) > 1:
            both = " and ".join(repr(claim.layer or "RGB") for claim in candidates)
            raise InputError(f"{source}: {both} both match the role {role!r}; choose one with --map {role}=LAYER")
        found[role] = candidates[0]
    if "radiance" not in found:
        there = ", ".join(layer or " ".join(components.values()) for layer, components in layers.items())
        raise InputError(f"{source}: no R, G, B channels; name the layer with the beauty by --map radiance=LAYER "
                         f"(there are {there})")
    if "coverage" not in overrides:
        _add_alpha(found, layers, source)
    _refuse_uint(found["radiance"], dtypes or {}, source)
    used = {name for claim in found.values() for name in claim.channels}
    return RoleMap({role: found[role] for role in ROLES if role in found},
                   tuple(name for name in names if name not in used), tuple(remarks), renderer)


def _by_options(overrides: Mapping[str, str], layers: Layers, renderer: str, source: str) -> dict[str, RoleSource]:
    """The roles that `--map` gives a layer; one that it drops is not among them."""
    found: dict[str, RoleSource] = {}
    for role, layer in overrides.items():
        if role not in ROLES:
            raise UsageError(f"--map {role}={layer}: unknown role; the roles are {', '.join(ROLES)}")
        if layer.lower() not in ("", "none"):
            found[role] = _by_option(role, layer, layers, renderer, source)
    return found


def _by_names(overrides: Mapping[str, str], chosen: Mapping[str, RoleSource], layers: Layers, renderer: str,
              lights: Collection[str]) -> tuple[dict[str, list[RoleSource]], list[str]]:
    """The layers that match each role by their names, and remarks on those that nearly do."""
    claims: dict[str, list[RoleSource]] = {}
    remarks: list[str] = []
    # One channel picked out of a wider layer, such as the A of RGBA, leaves the layer to its own role.
    taken = {claim.layer for claim in chosen.values() if len(claim.channels) > 1 or len(layers[claim.layer]) == 1}
    for layer, components in layers.items():
        if layer in taken or layer in lights:
            continue  # named by an option or by the header: not up for matching, nothing to remark
        if reason := _reason_against(layer, renderer):
            remarks.append(f"{layer} is not used: {reason}")
            continue
        row = _row(layer, renderer)
        if row is None or row.role in overrides:
            continue
        claim = _claim(row, layer, components)
        if claim is not None:
            claims.setdefault(row.role, []).append(claim)
        else:
            has = " ".join(components.values())
            remarks.append(f"{layer or 'RGB'} is not used as {row.role}: it has only {has}")
    return claims, remarks


def _add_alpha(found: dict[str, RoleSource], layers: Layers, source: str) -> None:
    """The fourth component of the radiance's layer is the coverage."""
    layer = found["radiance"].layer
    alpha = layers.get(layer, {}).get(3)
    if alpha is None:
        return
    if "coverage" in found:
        raise InputError(f"{source}: {alpha!r} and {found['coverage'].layer!r} both match the role 'coverage'; "
                         f"choose one with --map coverage=CHANNEL")
    found["coverage"] = RoleSource("coverage", layer, (alpha,))


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


def _by_option(role: str, text: str, layers: Layers, renderer: str, source: str) -> RoleSource:
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
