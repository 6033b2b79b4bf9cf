"""Finding and starting Mitsuba 3 with an LLVM that it can use; one clear line when either is missing."""

from __future__ import annotations

import glob
import os
import re
from functools import lru_cache
from typing import Any

from deep_io.errors import UsageError

VARIANT = "llvm_ad_rgb"
# Older LLVMs abort the whole process ("Cannot select fminimum"), so they must never be loaded.
OLDEST_LLVM = 17
SEARCH = ("/usr/lib/*/libLLVM*.so*", "/usr/lib/llvm-*/lib/libLLVM*.so*", "/usr/lib64/libLLVM*.so*",
          "/usr/lib64/llvm*/lib/libLLVM*.so*", "/usr/local/lib/libLLVM*.so*",
          "/opt/homebrew/opt/llvm*/lib/libLLVM*.dylib", "/usr/local/opt/llvm*/lib/libLLVM*.dylib")
CURE = "install LLVM 17 or newer (Debian: `apt install libllvm19`) or point DRJIT_LIBLLVM_PATH at its libLLVM.so"
MITSUBA_CURE = "install lbmc with its extra 'render'"


class RendererMissingError(UsageError):
    """Mitsuba or the LLVM library it needs is not installed."""


def llvm_version(path: str) -> int | None:
    """The major version in a libLLVM's file name or folder, after links; None if it does not tell."""
    for name in (path, os.path.realpath(path)):
        found = re.search(r"libLLVM(?:-|\.so\.|\.)?(\d+)", os.path.basename(name)) or re.search(r"llvm-?@?(\d+)", name)
        if found:
            return int(found.group(1))
    return None


def find_llvm() -> str:
    """The path of the newest usable libLLVM; DRJIT_LIBLLVM_PATH wins.

    Raises RendererMissingError if there is none of version OLDEST_LLVM or newer.
    """
    wanted = os.environ.get("DRJIT_LIBLLVM_PATH")
    if wanted:
        if not os.path.exists(wanted):
            raise RendererMissingError(f"DRJIT_LIBLLVM_PATH names {wanted}, which does not exist: {CURE}")
        if (llvm_version(wanted) or OLDEST_LLVM) < OLDEST_LLVM:
            raise RendererMissingError(f"{wanted} is too old for Mitsuba: {CURE}")
        return wanted
    candidates = {p: llvm_version(p) or 0 for pattern in SEARCH for p in glob.glob(pattern)}
    usable = sorted((version, path) for path, version in candidates.items() if version >= OLDEST_LLVM)
    if not usable:
        raise RendererMissingError(f"no usable LLVM library found: {CURE}")
    return usable[-1][1]


@lru_cache(maxsize=1)
def load_mitsuba(threads: int = 0) -> Any:
    """The mitsuba module with its variant set and `threads` workers (0: one per core).

    Raises RendererMissingError with the package to install. The last number of threads asked for counts.
    """
    os.environ["DRJIT_LIBLLVM_PATH"] = find_llvm()
    try:
        import drjit
        import mitsuba
    except ImportError as error:
        raise RendererMissingError(f"rendering needs Mitsuba 3 ({error}): {MITSUBA_CURE}") from error
    try:
        mitsuba.set_variant(VARIANT)
    except ImportError as error:
        raise RendererMissingError(f"this Mitsuba has no variant {VARIANT} ({error}): {MITSUBA_CURE}") from error
    if threads:
        drjit.set_thread_count(threads)
    mitsuba.set_log_level(mitsuba.LogLevel.Error)
    return mitsuba
