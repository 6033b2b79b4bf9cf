"""Runs other scripts of the repository, in processes of their own. Imports nothing heavy. Not a script itself."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

HOME = Path(__file__).resolve().parents[1]


def run_script(path: str, *words: object) -> None:
    """Runs a script of this path in the repository. Raises CalledProcessError where it fails."""
    subprocess.run([sys.executable, HOME / path, *map(str, words)], check=True)
