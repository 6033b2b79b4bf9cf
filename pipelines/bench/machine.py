"""What a bench ran on: processor, system, versions."""

from __future__ import annotations

import platform
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

from deep_io.cores import usable_cores
from pipelines import __version__


def machine(threads: int) -> dict[str, Any]:
    """The processor, the system, the versions and the threads of this run."""
    packages = {}
    for name in ("torch", "numpy", "OpenEXR", "pyoidn", "flip-evaluator"):
        try:
            packages[name] = version(name)
        except PackageNotFoundError:
            packages[name] = "not installed"
    return {
        "processor": processor(),
        "cores": usable_cores(),
        "threads": threads,
        "system": platform.platform(),
        "python": platform.python_version(),
        "lbmc": __version__,
        **packages,
    }


def processor() -> str:
    """The processor's name as the system tells it."""
    path = Path("/proc/cpuinfo")
    if path.is_file():
        for line in path.read_text("utf-8", "replace").splitlines():
            if line.startswith("model name"):
                return line.partition(":")[2].strip()
    return platform.processor() or platform.machine()
