"""The options of a denoising job refuse values that no frame could be denoised with."""

from __future__ import annotations

from typing import Any

import pytest

from pipelines.options import DenoiseOptions


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
