"""Peak memory of a method: what it adds to a fresh process that has only its libraries loaded.

    python -m pipelines.bench.memory    reads one JSON document from stdin, prints bytes
"""

from __future__ import annotations

import json
import re
import subprocess
import sys
from pathlib import Path

from deep_io.errors import UsageError
from pipelines.bench.methods import MethodSpec, make

STATUS = Path("/proc/self/status")
"""Where Linux says what a process holds; getrusage would count the memory of the process that started this one."""


def measurable() -> bool:
    """Whether this system tells."""
    return STATUS.is_file()


def peak_memory(spec: MethodSpec, source: Path, threads: int, folder: Path) -> int:
    """Bytes that making and running the method once take at most. Raises UsageError when the method fails."""
    task = {"spec": spec.to_dict(), "source": str(source.resolve()), "threads": threads, "folder": str(folder)}
    run = subprocess.run([sys.executable, "-m", "pipelines.bench.memory"], input=json.dumps(task), text=True,
                         capture_output=True, check=False)
    if run.returncode:
        raise UsageError(f"{spec.name}: failed in a process of its own: {run.stderr.strip().splitlines()[-1:]}")
    return int(run.stdout.split()[-1])


def resident(field: str) -> int:
    """Bytes of VmRSS (now) or VmHWM (at most) of this process."""
    found = re.search(rf"^{field}:\s*(\d+) kB", STATUS.read_text("ascii"), re.MULTILINE)
    return int(found[1]) * 1024 if found else 0


def main() -> None:
    """The fresh process."""
    task = json.load(sys.stdin)
    folder = Path(task["folder"])
    before = resident("VmRSS")
    method = make(MethodSpec(**task["spec"]), task["threads"], folder)
    method.run(Path(task["source"]), folder / "memory.exr")
    method.close()
    print(max(resident("VmHWM") - before, 0))


if __name__ == "__main__":
    main()
