"""Peak memory of a method: what it adds to a fresh process that has only its libraries loaded.

    python -m pipelines.bench.memory    reads one JSON document from stdin, prints bytes
"""

from __future__ import annotations

import json
import re
import subprocess
import sys
from pathlib import Path

from deep_io.errors import LbmcError
from pipelines.bench.methods import MethodSpec, make
from pipelines.jobs import MORE_MEMORY, describe_error

STATUS = Path("/proc/self/status")
"""Where Linux says what a process holds; getrusage would count the memory of the process that started this one."""


def measurable() -> bool:
    """Whether this system tells."""
    return STATUS.is_file()


def peak_memory(spec: MethodSpec, source: Path, threads: int, folder: Path) -> int:
    """Bytes that making and running the method once take at most. Raises LbmcError when the method fails."""
    task = {"spec": spec.to_dict(), "source": str(source.resolve()), "threads": threads, "folder": str(folder)}
    run = subprocess.run([sys.executable, "-m", "pipelines.bench.memory"], input=json.dumps(task), text=True,
                         capture_output=True, check=False)
    if run.returncode:
        raise LbmcError(f"failed in a process of its own: {_why(run)}")
    return int(run.stdout.split()[-1])


def _why(run: subprocess.CompletedProcess[str]) -> str:
    """Why a process failed: what it said last, or how it ended."""
    if run.returncode < 0:
        return f"stopped by signal {-run.returncode}, as where the machine's memory runs out; {MORE_MEMORY}"
    said = run.stderr.strip().splitlines()
    return said[-1] if said else f"ended with exit code {run.returncode} and no word"


def resident(field: str) -> int:
    """Bytes of VmRSS (now) or VmHWM (at most) of this process."""
    found = re.search(rf"^{field}:\s*(\d+) kB", STATUS.read_text("ascii"), re.MULTILINE)
    return int(found[1]) * 1024 if found else 0


def main() -> int:
    """The fresh process."""
    task = json.load(sys.stdin)
    folder = Path(task["folder"])
    before = resident("VmRSS")
    try:
        method = make(MethodSpec(**task["spec"]), task["threads"], folder)
        method.run(Path(task["source"]), folder / "memory.exr")
        method.close()
    except Exception as error:  # told in one line by the process that waits for this one
        print(describe_error(error), file=sys.stderr)
        return 1
    print(max(resident("VmHWM") - before, 0))
    return 0


if __name__ == "__main__":
    sys.exit(main())
