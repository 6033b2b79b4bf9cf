"""What holds for every network and every input, through the command: files in, files out.

The networks are random: these are properties of the algorithm, not of training.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from deep_io import DeepSamples, Window
from tests.end_to_end.scenes import changed, noisy_scene, random_weights, read_flat, rgb, write_scene
from tests.runner import in_process

SMALL = Window(0, 0, 39, 33)


@pytest.fixture(params=[0, 1], ids=["network 0", "network 1"])
def weights(request: pytest.FixtureRequest, tmp_path: Path) -> Path:
    return random_weights(tmp_path / "random.safetensors", request.param)


def denoise(folder: Path, name: str, samples: DeepSamples, weights: Path, *more: str) -> np.ndarray:
    """(H, W, 3) float32 of `samples` through the command."""
    source, output = write_scene(folder / f"{name}.exr", samples), folder / f"{name}.out.exr"
    words = ("--model", weights, "--pixel-type", "float", "--threads", "2", "--progress", "none", *more)
    run = in_process("denoise", source, output, *words)
    assert run.code == 0, run.err
    return rgb(output)


def close(left: np.ndarray, right: np.ndarray, relative: float = 1e-5) -> bool:
    return bool((np.abs(left - right) <= relative * np.maximum(np.abs(left), np.abs(right)).max()).all())


def constant(samples: DeepSamples, value: float) -> DeepSamples:
    """Constant radiance, without albedo: a varying divisor is filtered too and would rightly show in the result."""
    channels = {name: v for name, v in samples.channels.items() if not name.startswith("albedo")}
    channels.update({name: np.full(samples.total, value, np.float16) for name in "RGB"})
    return DeepSamples(samples.counts, channels, samples.window)


@pytest.mark.parametrize("layers", ["auto", "1", "2", "5"])
def test_a_constant_stays_constant_with_any_number_of_layers(layers: str, weights: Path, tmp_path: Path) -> None:
    samples = constant(noisy_scene(1, SMALL), 0.375)
    found = denoise(tmp_path, "constant", samples, weights, "--layers", layers)
    np.testing.assert_allclose(found, 0.375, rtol=2e-5)


def test_the_output_scales_with_the_input(weights: Path, tmp_path: Path) -> None:
    samples = noisy_scene(2, SMALL, dtype=np.float32)
    scaled = {name: samples.channels[name] * np.float32(1024.0) for name in "RGB"}
    before = denoise(tmp_path, "one", samples, weights)
    assert close(denoise(tmp_path, "scaled", changed(samples, **scaled), weights), 1024.0 * before)


def test_the_unit_of_depth_does_not_matter(weights: Path, tmp_path: Path) -> None:
    samples = noisy_scene(3, SMALL)
    depth = samples.channels["Z"]
    centimetres = np.where(depth < 1e10, 128.0 * depth, depth).astype(np.float32)
    before = denoise(tmp_path, "one", samples, weights)
    assert close(denoise(tmp_path, "other", changed(samples, Z=centimetres), weights), before)


def test_the_order_of_the_samples_does_not_matter(weights: Path, tmp_path: Path) -> None:
    samples = noisy_scene(4, SMALL)
    rng = np.random.default_rng(4)
    order = np.lexsort((rng.random(samples.total), samples.pixel_index))
    shuffled = DeepSamples(samples.counts, {name: v[order] for name, v in samples.channels.items()}, SMALL)
    before = denoise(tmp_path, "one", samples, weights)
    assert close(denoise(tmp_path, "other", shuffled, weights), before)


def test_a_sample_split_into_two_of_half_weight_changes_nothing(tmp_path: Path) -> None:
    # Without what sees the effective number of samples: twice as many mean less noise.
    weights = random_weights(tmp_path / "random.safetensors", statistics=False, texture_reliability=False)
    samples = noisy_scene(11, SMALL)
    split = DeepSamples(2 * samples.counts, {name: np.repeat(v, 2) for name, v in samples.channels.items()}, SMALL)
    before = denoise(tmp_path, "one", samples, weights)
    assert close(denoise(tmp_path, "other", split, weights), before)


@pytest.mark.parametrize("more", [("--threads", "1"), ("--memory", "1MiB")])
def test_threads_and_memory_budget_change_nothing(more: tuple[str, str], weights: Path, tmp_path: Path) -> None:
    samples = noisy_scene(5, Window(0, 0, 24, 119), most=2)
    before = denoise(tmp_path, "one", samples, weights)
    assert close(denoise(tmp_path, "other", samples, weights, *more), before)


@pytest.mark.parametrize("shape", [(1, 1), (1, 70), (3, 2)])
def test_any_size_is_denoised(shape: tuple[int, int], weights: Path, tmp_path: Path) -> None:
    window = Window(0, 0, shape[1] - 1, shape[0] - 1)
    assert np.isfinite(denoise(tmp_path, "one", noisy_scene(6, window), weights)).all()


def test_only_radiance_is_needed(weights: Path, tmp_path: Path) -> None:
    samples = noisy_scene(8, SMALL)
    bare = DeepSamples(samples.counts, {name: samples.channels[name] for name in "RGB"}, SMALL)
    assert np.isfinite(denoise(tmp_path, "bare", bare, weights)).all()


def test_pixels_without_samples_are_filled_from_their_neighbours(weights: Path, tmp_path: Path) -> None:
    samples = noisy_scene(9, SMALL)
    hole = np.zeros(samples.counts.shape, bool)
    hole[10:14, 10:14] = True
    kept = ~hole.ravel()[samples.pixel_index]
    channels = {name: values[kept] for name, values in samples.channels.items()}
    holed = constant(DeepSamples(np.where(hole, 0, samples.counts).astype(np.int32), channels, SMALL), 0.5)
    np.testing.assert_allclose(denoise(tmp_path, "hole", holed, weights), 0.5, rtol=2e-5)


def test_alpha_is_the_filtered_coverage(weights: Path, tmp_path: Path) -> None:
    samples = noisy_scene(10, SMALL)
    denoise(tmp_path, "sky", samples, weights)
    alpha = read_flat(tmp_path / "sky.out.exr")[0]["A"]
    assert alpha.min() >= 0.0
    assert alpha.max() <= 1.0
    assert alpha[:3].mean() < 0.3
    assert alpha[-8:].mean() > 0.9
    everywhere = changed(samples, A=np.ones(samples.total, np.float16), Z=np.full(samples.total, 3.0, np.float32))
    denoise(tmp_path, "covered", everywhere, weights)
    np.testing.assert_allclose(read_flat(tmp_path / "covered.out.exr")[0]["A"], 1.0, rtol=1e-5)
