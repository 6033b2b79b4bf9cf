#!/usr/bin/env python3
"""Makes rows of benchmarks/paper.py those of the documentation, and redraws all that is made of them.

    python benchmarks/keep_paper.py [ROWS.json] [--group paper] [--work WORK] [--model fast]

The rows of one group in ROWS.json take the place of all rows of that group in docs/results/paper.json; what else is
there stays, times and other groups among it. Rows of other scenes, or of steps that differ, are refused: a table
compares them. WORK is where benchmarks/paper.py left its weights; with it the pictures of layers are drawn anew,
through two of these. Then charts and tables are. Without ROWS.json, of the rows that are there.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Mapping
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parent))

from paper import ROWS
from scripts import run_script
from trials import Row, write

from deep_io.errors import InputError, LbmcError


def replaced(kept: Mapping[str, Row], found: Mapping[str, Row], group: str) -> Row:
    """The rows kept, those of a group replaced. Raises InputError where the group has none or is not of equal steps."""
    new = {key: row for key, row in found.items() if row["group"] == group}
    missing = [key for key, row in kept.items() if row["group"] == group and key not in new]
    steps = sorted({row["steps"] for row in new.values()})
    if missing or len(steps) != 1:
        what = f"has no {', '.join(missing)}" if missing else f"has rows of {steps or 'no'} steps"
        raise InputError(f"group {group}: the file {what}; a table compares rows of equal steps, so let the run finish")
    return {**new, **{key: row for key, row in kept.items() if row["group"] != group}}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("rows", nargs="?", type=Path)
    parser.add_argument("--group", default="paper", choices=("paper", "ours"))
    parser.add_argument("--work", type=Path)
    parser.add_argument("--model", default="fast")
    parser.add_argument("--json", type=Path, default=ROWS)
    options = parser.parse_args()
    if options.rows:
        kept, found = (json.loads(path.read_text("utf-8")) for path in (options.json, options.rows))
        if kept["scenes"] != found["scenes"]:
            raise InputError(f"{options.rows}: trained on other scenes than {options.json}")
        kept["rows"] = replaced(kept["rows"], found["rows"], options.group)
        write(options.json, kept)
    if options.json != ROWS:
        return
    if options.work:
        run_script("docs/layer_images.py", "--model", options.model, "--work", options.work)
    run_script("docs/figures.py")
    run_script("docs/tables.py", "--write")


if __name__ == "__main__":
    try:
        main()
    except LbmcError as error:
        sys.exit(f"ERROR: {error}")
