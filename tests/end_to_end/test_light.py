"""The light of the picture through the command: held to that of the samples, or left free."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from deep_io import read_deep
from tests.end_to_end.scenes import read_flat, rgb
from tests.runner import in_process

SCENES = Path(__file__).resolve().parents[2] / "examples/scenes"


@pytest.mark.parametrize("scene", ["interior", "defocus-motion"])
def test_the_picture_has_the_light_of_its_samples(scene: str, tmp_path: Path) -> None:
    source = SCENES / f"{scene}.deep.exr"
    samples, _ = read_deep(source)
    light = np.mean([samples.channels[name].mean(dtype=np.float64) for name in "RGB"])
    off = {}
    for how in ("held", "free"):
        out = tmp_path / f"{how}.exr"
        run = in_process("denoise", source, out, "--light", how, "--pixel-type", "float")
        assert run.code == 0, run.err
        off[how] = abs(float(rgb(out).mean(dtype=np.float64)) / light - 1)
    assert off["held"] < max(0.7 * off["free"], 0.002)


def test_the_sum_of_the_layers_has_the_same_light(tmp_path: Path) -> None:
    source, out, layers = SCENES / "interior.deep.exr", tmp_path / "out.exr", tmp_path / "layers.exr"
    assert in_process("denoise", source, out, "--pixel-type", "float").code == 0
    run = in_process("export-layers", source, layers, "--form", "channels", "--contributions", "--pixel-type", "float")
    assert run.code == 0, run.err
    channels, _ = read_flat(layers)
    summed = np.stack([channels[f"layer0.{name}"] + channels[f"layer1.{name}"] for name in "RGB"], -1)
    np.testing.assert_allclose(summed, rgb(out), rtol=1e-5, atol=1e-6)
