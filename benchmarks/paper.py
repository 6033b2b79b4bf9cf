#!/usr/bin/env python3
"""Trains the paper's networks and ours at reduced width, on equal steps and equal data, and scores them.

    python benchmarks/paper.py DATA --work WORK --score NAME=FOLDER [--score ...] [--only NAME] [--steps N]

DATA is a folder of training scenes; its cache is built beside it, as by `lbmc train`. Every FOLDER of scenes is scored
at 8 samples per pixel. Each network that is done is a row of docs/results/paper.json (`--json`), from which
docs/tables.py makes the tables of docs/results.md (elsewhere: benchmarks/keep_paper.py takes them there); rows that
exist are kept, and a run that was stopped resumes from its checkpoint in WORK. The scenes that the first run trains on
are those of all later ones.
"""

from __future__ import annotations

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parent))

from reduced import runs
from trials import perform

from deep_io.errors import LbmcError

ROWS = Path(__file__).resolve().parents[1] / "docs" / "results" / "paper.json"

if __name__ == "__main__":
    try:
        perform(__doc__.splitlines()[0], runs(), ROWS)
    except LbmcError as error:
        sys.exit(f"ERROR: {error}")
