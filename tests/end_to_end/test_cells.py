"""Cells that pass through, with the real command: nothing changes around them, and tiles and budgets change nothing."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import OpenEXR
import pytest

from deep_io import DeepSamples, Header, Window, write_deep
from tests.end_to_end.scenes import noisy_scene, random_weights, read_flat, rgb
from tests.runner import in_process

DISPLAY = Window(0, 0, 191, 191)  # nine cells
SKY = (0.25, 0.5, 1.0)


@pytest.fixture
def weights(tmp_path: Path) -> Path:
    return random_weights(tmp_path / "w.safetensors")


def busy(where: np.ndarray, empty: bool = False, seed: int = 0, corner: tuple[int, int] = (0, 0)) -> DeepSamples:
    """Noise where (H, W) says so, elsewhere no samples at all or three of a plain sky."""
    height, width = where.shape
    window = Window(corner[0], corner[1], corner[0] + width - 1, corner[1] + height - 1)
    noise = noisy_scene(seed, Window(0, -8, width - 1, height - 1))  # its own sky, 8 rows, is cut off
    first = int(noise.counts[:8].sum())
    counts, channels = noise.counts[8:], {name: values[first:].copy() for name, values in noise.channels.items()}
    sky = ~np.repeat(where.ravel(), counts.ravel())
    if empty:
        return DeepSamples(np.where(where, counts, 0).astype(np.int32),
                           {name: values[~sky] for name, values in channels.items()}, window)
    for name, values in channels.items():
        values[sky] = SKY["RGB".index(name)] if name in "RGB" else 1e10 if name == "Z" else 0
    return DeepSamples(counts, channels, window)


def denoise(folder: Path, samples: DeepSamples, weights: Path, *words: str, display: Window = DISPLAY) -> np.ndarray:
    """(H, W, 3) through the command."""
    source, target = folder / "in.exr", folder / "out.exr"
    write_deep(source, samples, Header.of_samples(samples, display_window=display))
    run = in_process("denoise", source, target, "--model", weights, "--pixel-type", "float", "--progress", "none",
                     "--layers", "2", "--overwrite", "--threads", "1", *words)
    assert run.code == 0, run.err
    return rgb(target)


def cell(row: int, column: int, shape: tuple[int, int] = (192, 192)) -> np.ndarray:
    """(H, W) the pixels of one cell."""
    where = np.zeros(shape, np.bool_)
    where[row * 64 : row * 64 + 64, column * 64 : column * 64 + 64] = True
    return where


def half() -> np.ndarray:
    where = np.zeros((192, 192), np.bool_)
    where[96:] = True
    return where


@pytest.mark.parametrize("empty", [False, True], ids=["plain", "empty"])
@pytest.mark.parametrize("where", [half(), cell(1, 1)], ids=["half", "one cell"])
def test_pixels_around_are_what_they_are_without_adapting(
    where: np.ndarray, empty: bool, weights: Path, tmp_path: Path
) -> None:
    samples = busy(where, empty)
    adapted, whole = (denoise(tmp_path, samples, weights, *words) for words in ((), ("--no-adapt",)))
    work = np.zeros((192, 192), np.bool_)  # the cells that hold any work
    for row in range(3):
        for column in range(3):
            inside = cell(row, column)
            work |= inside & bool(where[inside].any())
    np.testing.assert_allclose(adapted[work], whole[work], rtol=1e-4, atol=1e-5 * np.abs(whole).max())
    assert np.isfinite(adapted).all()
    if not empty:
        np.testing.assert_allclose(adapted[~work], np.broadcast_to(SKY, (int((~work).sum()), 3)), rtol=1e-6)


def test_budgets_and_bands_change_nothing(weights: Path, tmp_path: Path) -> None:
    samples = busy(half() | cell(0, 2))
    roomy = denoise(tmp_path, samples, weights)
    for budget in ("1KiB", "400MiB"):
        tight = denoise(tmp_path, samples, weights, "--memory", budget)
        assert np.abs(tight - roomy).max() <= 1e-5 * roomy.max()


def test_the_grid_is_the_display_windows_whatever_the_data_window(weights: Path, tmp_path: Path) -> None:
    """A crop whose corner is off the grid: the sky within the cell that holds work is filtered, that of others not."""
    where = np.zeros((150, 170), np.bool_)
    where[50:60, 70:80] = True  # with the corner at (-10, 20): in cell row 1, cell columns 0 and 1
    samples = busy(where, corner=(-10, 20))
    display = Window(0, 0, 300, 300)
    adapted = denoise(tmp_path, samples, weights, display=display)
    whole = denoise(tmp_path, samples, weights, "--no-adapt", display=display)
    _, header = read_flat(tmp_path / "out.exr")
    assert tuple(header["dataWindow"][0]) == (-10, 20)
    exact = (adapted == np.array(SKY, np.float32)).all(-1)
    work = np.zeros_like(where)
    work[64 - 20 : 128 - 20, 0 + 10 : 128 + 10] = True  # rows 64..127, columns 0..127 of the display
    np.testing.assert_allclose(adapted[work], whole[work], rtol=1e-4, atol=1e-5)
    assert exact[~work].all()


@pytest.mark.parametrize("empty", [False, True], ids=["plain", "one sample"])
def test_a_frame_without_any_work_needs_no_network(
    empty: bool, weights: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("model.denoiser.Denoiser.forward", None)
    where = np.zeros((192, 192), np.bool_)
    samples = busy(where)
    if empty:
        counts = np.zeros((192, 192), np.int32)
        counts[100, 20] = 1
        samples = DeepSamples(counts, {name: values[:1] for name, values in samples.channels.items()}, samples.window)
    found = denoise(tmp_path, samples, weights)
    np.testing.assert_allclose(found, np.broadcast_to(SKY, found.shape), rtol=1e-6)


def test_layers_of_a_passing_cell_are_the_background(weights: Path, tmp_path: Path) -> None:
    samples = busy(half())
    source, target = tmp_path / "in.exr", tmp_path / "out.exr"
    write_deep(source, samples, Header.of_samples(samples))
    run = in_process("export-layers", source, target, "--form", "parts", "--contributions", "--model", weights,
                     "--pixel-type", "float", "--progress", "none", "--layers", "3")
    assert run.code == 0, run.err
    parts = {part.name(): part for part in OpenEXR.File(str(target), separate_channels=True).parts}
    for number in range(3):
        planes = parts[f"layer{number}"].channels
        expected = SKY if number == 2 else (0.0, 0.0, 0.0)
        for name, value in zip("RGB", expected, strict=True):
            np.testing.assert_allclose(planes[name].pixels[:64], value, rtol=1e-6)
        assert not planes["A"].pixels[:64].any()


def test_carried_channels_pass_too(weights: Path, tmp_path: Path) -> None:
    samples = busy(half())
    samples.channels["light.R"] = np.where(samples.channels["A"] > 0, 0.5, 0.125).astype(np.float16)
    samples.channels["light.G"] = samples.channels["light.B"] = samples.channels["light.R"]
    denoise(tmp_path, samples, weights, "--aov", "light")
    channels, _ = read_flat(tmp_path / "out.exr")
    np.testing.assert_allclose(channels["light.G"][:64], 0.125, rtol=1e-6)


def test_what_passes_is_said_by_dry_run_and_info(weights: Path, tmp_path: Path) -> None:
    samples = busy(half())
    source = tmp_path / "in.exr"
    write_deep(source, samples, Header.of_samples(samples))
    line = "cells: 3 of 9 pass through, with nothing to do"
    words = ("denoise", source, tmp_path / "o.exr", "--model", weights, "--dry-run")
    assert line in in_process(*words).out
    unadapted = in_process(*words, "--no-adapt").out
    assert "pass through" not in unadapted
    assert "not adapted: no role is held, every cell is filtered" in unadapted
    assert line in in_process("info", source).out
    decisions = json.loads(in_process("info", source, "--json").out)["decisions"]
    assert (decisions["cells"], decisions["cells_passed"], decisions["layers"]) == (9, 3, None)
