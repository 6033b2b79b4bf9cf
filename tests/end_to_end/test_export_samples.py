"""`lbmc export-layers --samples`: the input bit for bit, and with each sample its share in every layer."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

from deep_io import Window, read_deep
from deep_io.path_samples import SampleReader
from model import zoo
from model.features import FrameScale
from pipelines.inference import to_model
from pipelines.survey import survey
from tests.end_to_end.compositor import flatten
from tests.end_to_end.scenes import changed, noisy_scene, random_weights, write_scene
from tests.runner import in_process

WINDOW = Window(-7, 3, 56, 150)
"""64 x 148 pixels: tall enough for several bands."""


@pytest.fixture(scope="module")
def weights(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return random_weights(tmp_path_factory.mktemp("weights") / "random.safetensors")


def export(source: Path, target: Path, model: Path, *words: object) -> Path:
    run = in_process("export-layers", source, target, "--samples", "--model", model, *words)
    assert run.code == 0, run.err
    return target


@pytest.mark.parametrize("layers", [1, 2, 4])
def test_the_copy_is_the_input_and_its_shares_sum_to_one(layers: int, weights: Path, tmp_path: Path) -> None:
    samples = noisy_scene(3, Window(-7, 3, 32, 26))
    source = write_scene(tmp_path / "in.exr", samples, owner="somebody", lbmc__weighting="uniform")
    made, header = read_deep(export(source, tmp_path / "out.exr", weights, "--layers", layers, "--pixel-type", "float"))
    assert header.get("owner") == "somebody"
    assert header.get("lbmc:weighting") == "uniform"
    assert header.get("lbmc:partition", "").startswith("random ")
    assert np.array_equal(made.counts, samples.counts)
    for name, values in samples.channels.items():
        assert made.channels[name].tobytes() == values.tobytes()
    shares = [made.channels[f"layer{layer}.weight"] for layer in range(layers)]
    assert len(made.channels) == len(samples.channels) + layers
    assert np.allclose(sum(shares), 1, atol=1e-6)


def test_the_shares_are_the_networks_partition_whatever_the_bands(weights: Path, tmp_path: Path) -> None:
    source = write_scene(tmp_path / "in.exr", noisy_scene(4, WINDOW))
    words = ("--layers", 3, "--pixel-type", "float")
    whole, _ = read_deep(export(source, tmp_path / "whole.exr", weights, *words))
    banded, _ = read_deep(export(source, tmp_path / "banded.exr", weights, *words, "--memory", "1MiB"))
    with SampleReader(source) as reader:
        seen = survey(reader.blocks())
        net = zoo.find(str(weights)).load()
        block = reader.read()
        scale = FrameScale(seen.exposure, seen.depth)
        samples = to_model(block, net.config.roles, scale.depth, torch.device("cpu"))
        with torch.inference_mode():
            expected = net.partition(samples, scale, 3).numpy()
    for layer in range(3):
        assert np.allclose(whole.channels[f"layer{layer}.weight"], expected[:, layer], atol=1e-5)
        assert np.allclose(whole.channels[f"layer{layer}.weight"], banded.channels[f"layer{layer}.weight"], atol=1e-5)


def test_shares_follow_the_stored_order_of_packed_samples(weights: Path, tmp_path: Path) -> None:
    """A packed file, its samples unsorted: the partition is by the sample, wherever it is stored."""
    samples = noisy_scene(5, Window(0, 0, 23, 15), dtype=np.float32)
    for name in "RGBA":
        samples.channels[name] = (samples.channels[name] * 0.5).astype(np.float32)
    flipped = changed(samples)
    order = np.concatenate([np.arange(b, a, -1) - 1 for a, b in zip(samples.offsets[:-1], samples.offsets[1:],
                                                                    strict=True)])
    for name, values in samples.channels.items():
        flipped.channels[name] = values[order].copy()
    made = []
    for name, scene in (("a", samples), ("b", flipped)):
        source = write_scene(tmp_path / f"{name}.exr", scene, lbmc__weighting="over")
        made.append(read_deep(export(source, tmp_path / f"{name}.out.exr", weights, "--pixel-type", "float"))[0])
    assert np.allclose(made[0].channels["layer0.weight"][order], made[1].channels["layer0.weight"], atol=1e-5)


def test_the_copy_flattens_and_denoises_as_the_input_does(weights: Path, tmp_path: Path) -> None:
    source = write_scene(tmp_path / "in.exr", noisy_scene(6, Window(0, 0, 23, 15)))
    copy = export(source, tmp_path / "copy.exr", weights)
    assert np.array_equal(flatten(copy), flatten(source))
    for path in (source, copy):
        run = in_process("denoise", path, tmp_path / f"{path.stem}.flat.exr", "--model", weights)
        assert run.code == 0, run.err
    again = in_process("export-layers", copy, tmp_path / "again.exr", "--samples", "--model", weights)
    assert again.code == 3
    assert "layer0.weight already" in again.err
    assert not (tmp_path / "again.exr").exists()


@pytest.mark.parametrize("words", [["--form", "parts"], ["--aov", "albedo"], ["--contributions"]])
def test_samples_go_without_options_of_layers(words: list[str], weights: Path, tmp_path: Path) -> None:
    source = write_scene(tmp_path / "in.exr", noisy_scene(6, Window(0, 0, 9, 9)))
    run = in_process("export-layers", source, tmp_path / "out.exr", "--samples", "--model", weights, *words)
    assert run.code == 2
    assert "--samples" in run.err


def test_the_light_is_not_spoken_of_where_no_picture_is_made(weights: Path, tmp_path: Path) -> None:
    """A farm may have LBMC_LIGHT set for all of its jobs."""
    source = write_scene(tmp_path / "in.exr", noisy_scene(6, Window(0, 0, 9, 9)))
    plans = [in_process("export-layers", source, tmp_path / "out.exr", "--dry-run", "--model", weights, *words).out
             for words in ((), ("--samples",), ("--samples", "--light", "free"))]
    assert ["light:" in plan for plan in plans] == [True, False, False]
