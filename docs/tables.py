#!/usr/bin/env python3
"""The tables of the documentation: printed from the code and from measured results, checked by a test.

    python docs/tables.py            says which tables differ; exit code 1 if any does
    python docs/tables.py --write    brings them up to date

A table, or a paragraph whose numbers are counted, stands between the lines `<!-- table: NAME -->` and `<!-- end -->` of
README.md or docs/*.md.
"""

from __future__ import annotations

import argparse
import json
import re
import sys
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import is_dataclass
from pathlib import Path
from typing import Any, get_type_hints

from ablation_tables import ABLATION_TABLES
from adapting_tables import ADAPTING_TABLES
from paper_tables import PAPER_TABLES
from quality_tables import QUALITY_TABLES
from result_tables import RESULT_TABLES
from tuning_tables import TUNING_TABLES

from deep_io.aliases import ALIASES, CAMERA_Z_FORWARD, DISTANCE, NOT_A_ROLE, RENDERER_MARKS, VIEW, WORLD, Alias
from deep_io.roles import ROLES
from lbmc_cli.main import COMMANDS
from model.config import CONFIGS
from model.cost import count
from pipelines.training.recipe import Recipe

HOME = Path(__file__).resolve().parent.parent
DOCUMENTS = ("README.md", "docs/*.md")
REGION = re.compile(r"(<!-- table: (\S+) -->\n)(.*?)(<!-- end -->)", re.DOTALL)

SPACES = {VIEW: "view space", CAMERA_Z_FORWARD: "camera space, z forward", WORLD: "world space"}
SAMPLES, LAYERS = 8, 2  # at which multiply-adds are stated


def markdown(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """A Markdown table. A bar inside a cell would end it."""
    lines = [head, ["---"] * len(head), *([cell.replace("|", "\\|") for cell in row] for row in rows)]
    return "".join(f"| {' | '.join(row)} |\n" for row in lines)


def commands() -> str:
    return markdown(("command", "what it does"), ((f"`lbmc {name}`", text) for name, text in COMMANDS.items()))


def roles() -> str:
    return markdown(
        ("role", "channels", "numbers", "meaning"),
        ((role.name, " ".join(f"`{c}`" for c in role.channels), str(role.width), role.meaning)
         for role in ROLES.values()),
    )


def _convention(row: Alias) -> str:
    words = []
    if row.role == "normal":
        words.append(SPACES[row.space])
    if row.role == "depth":
        words.append("length of the ray" if row.depth == DISTANCE else "planar")
    if row.zero_is_miss:
        words.append("0 is a miss")
    return ", ".join(filter(None, [*words, row.note]))


def aliases() -> str:
    order = list(ROLES)
    rows = sorted(ALIASES, key=lambda row: order.index(row.role))
    return markdown(
        ("role", "layer", "in files of", "convention"),
        ((row.role, f"`{row.layer}`" if row.layer else "(no layer: `R G B`)", row.renderer or "any", _convention(row))
         for row in rows),
    )


def renderers() -> str:
    return markdown(("an attribute that starts with", "files of"), ((f"`{mark}`", who) for mark, who in RENDERER_MARKS))


def no_roles() -> str:
    return markdown(
        ("layer", "in files of", "why it is not used"),
        ((f"`{layer}`", renderer or "any", why) for layer, renderer, why in NOT_A_ROLE),
    )


def networks() -> str:
    rows = []
    for name, config in CONFIGS.items():
        cost = count(config)
        products = sum(cost.multiply_adds(SAMPLES, LAYERS if config.layered else 1).values())
        kernels = f"{config.kernel}, {' '.join(f'{size}x{size}' for size in config.kernel_sizes)}"
        rows.append((f"`{name}`", config.variant, kernels, f"{cost.parameters:,}", f"{products / 1e3:,.0f} k"))
    return markdown(("network", "variant", "kernels, finest level first", "parameters",
                     f"multiply-adds per pixel, {SAMPLES} samples"), rows)


def recipe() -> str:
    return markdown(("field", "default", "meaning"), ((f"`{n}`", f"`{v}`", t) for n, v, t in _fields(Recipe(), "")))


def _fields(options: Any, prefix: str) -> Iterator[tuple[str, str, str]]:
    """Name, default and meaning of each field of a recipe; fields of a part follow it."""
    for name, hint in get_type_hints(type(options), include_extras=True).items():
        value = getattr(options, name)
        if is_dataclass(value):
            yield from _fields(value, f"{prefix}{name}.")
        else:
            yield f"{prefix}{name}", json.dumps(value), hint.__metadata__[0]


TABLES: dict[str, Callable[[], str]] = {
    "commands": commands,
    "roles": roles,
    "aliases": aliases,
    "renderers": renderers,
    "no-roles": no_roles,
    "networks": networks,
    "recipe": recipe,
    **RESULT_TABLES,
    **PAPER_TABLES,
    **ABLATION_TABLES,
    **ADAPTING_TABLES,
    **QUALITY_TABLES,
    **TUNING_TABLES,
}


def updated(text: str) -> str:
    """The document with every table as the code has it. Raises KeyError for a table that is not known."""
    return REGION.sub(lambda found: f"{found[1]}{TABLES[found[2]]()}{found[4]}", text)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--write", action="store_true", help="bring the tables up to date")
    options = parser.parse_args()
    code = 0
    for path in sorted(path for pattern in DOCUMENTS for path in HOME.glob(pattern)):
        text = path.read_text("utf-8")
        new = updated(text)
        if new == text:
            continue
        if options.write:
            path.write_text(new, "utf-8")
            print(f"wrote {path.relative_to(HOME)}")
        else:
            print(f"{path.relative_to(HOME)}: a table differs from the code; run python docs/tables.py --write")
            code = 1
    return code


if __name__ == "__main__":
    sys.exit(main())
