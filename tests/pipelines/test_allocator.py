"""Freed memory stays with the process once that was asked for."""

from __future__ import annotations

import subprocess
import sys

from tests.runner import environment

PROGRAM = """
import resource, sys
import numpy as np
from pipelines.allocator import keep_freed_memory

def faults():
    return resource.getrusage(resource.RUSAGE_SELF).ru_minflt

def fill():
    before = faults()
    np.ones(32 << 20, np.uint8)
    return faults() - before

assert not sys.argv[1:] or keep_freed_memory()
fill()
print(fill())
"""


def page_faults(*arguments: str) -> int:
    """Page faults of filling 32 MiB of fresh memory for the second time."""
    command = [sys.executable, "-c", PROGRAM, *arguments]
    return int(subprocess.run(command, capture_output=True, text=True, check=True, env=environment()).stdout)


def test_memory_is_used_again_without_a_page_fault_per_page() -> None:
    assert page_faults("keep") < 0.5 * page_faults()
