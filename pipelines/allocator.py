"""Keeps freed memory with the process, so that large arrays are not mapped, cleared and unmapped again and again.

glibc gives every freed block of some megabytes back to the kernel; a network's activations then cost a page fault per
4 KiB each time they are made, which can take as long as the arithmetic. Measured: a training step of four 128 x 128
crops is 1.5 times faster, for 0.8 GB more resident memory; denoising takes 7 % less CPU time on 960 x 540 pixels and
23 % less on 1920 x 1080, for 1 to 3 % more.
"""

from __future__ import annotations

import ctypes

# Parameters of mallopt(3), from malloc.h.
M_TRIM_THRESHOLD, M_TOP_PAD, M_MMAP_MAX = -1, -2, -4
NEVER = 2**31 - 1
GROW_BY = 256 << 20
"""Bytes that the heap grows by at once."""


def keep_freed_memory() -> bool:
    """Tells glibc to serve all sizes from its heap and never to shrink it; False where the C library is another.

    Same effect as MALLOC_MMAP_MAX_=0 MALLOC_TRIM_THRESHOLD_=2147483647 MALLOC_TOP_PAD_=268435456, without having to be
    set before the process starts. For commands: a process that does other things, too, may want its memory back.
    """
    try:
        mallopt = ctypes.CDLL(None).mallopt
    except (OSError, AttributeError):
        return False
    settings = ((M_MMAP_MAX, 0), (M_TRIM_THRESHOLD, NEVER), (M_TOP_PAD, GROW_BY))
    return all(mallopt(parameter, value) == 1 for parameter, value in settings)
