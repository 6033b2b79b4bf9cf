"""What the files of a scene are called: NAME.deep.exr, the samples, and NAME.ref.exr, the reference beside them.

Where NAME.ref2.exr is there too, the two are independent halves of the reference.
"""

from __future__ import annotations

from pathlib import Path

DEEP, REFERENCE, OTHER_HALF = ".deep.exr", ".ref.exr", ".ref2.exr"


def scene_name(deep: Path) -> str:
    """NAME of NAME.deep.exr."""
    return deep.name.removesuffix(DEEP)


def reference_of(deep: Path) -> Path:
    """NAME.ref.exr beside NAME.deep.exr, whether it exists or not."""
    return deep.with_name(scene_name(deep) + REFERENCE)


def other_half_of(deep: Path) -> Path:
    """NAME.ref2.exr beside NAME.deep.exr, whether it exists or not."""
    return deep.with_name(scene_name(deep) + OTHER_HALF)
