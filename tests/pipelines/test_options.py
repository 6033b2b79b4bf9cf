"""The options of a denoising job refuse values that no frame could be denoised with."""

from __future__ import annotations

from typing import Any

import pytest

from pipelines.options import COMPRESSIONS, LOSSY_FOR_FLOATS, DenoiseOptions


@pytest.mark.parametrize(
    "wrong",
    [
        {"layers": 0},
        {"layers": 6},
        {"threads": 0},
        {"memory": 0},
        {"exposure": 0.0},
        {"exposure": float("nan")},
        {"exposure": float("inf")},
        {"exposure": 1e40},
        {"exposure": 1.0, "exposure_from": "1001"},
        {"compression": "zstd"},
    ],
)
def test_values_out_of_range_are_refused(wrong: dict[str, Any]) -> None:
    with pytest.raises(ValueError, match="|".join(wrong)):
        DenoiseOptions("in.exr", "out.exr", **wrong)


@pytest.mark.parametrize("compression", COMPRESSIONS)
def test_ids_are_refused_with_a_compression_that_changes_floats(compression: str) -> None:
    assert DenoiseOptions("in.exr", "out.exr", compression=compression).ids == ()
    if compression not in LOSSY_FOR_FLOATS:
        assert DenoiseOptions("in.exr", "out.exr", compression=compression, ids=("id",)).compression == compression
        return
    with pytest.raises(ValueError, match=f"--ids: compression {compression} .* one of none, rle, .*, b44a$"):
        DenoiseOptions("in.exr", "out.exr", compression=compression, ids=("id",))
