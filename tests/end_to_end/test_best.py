"""The preset `best`: one network on a frame and its mirror images, averaged."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import torch

from deep_io import DeepSamples, Window, read_deep, read_headers
from model import weight_files, zoo
from pipelines.denoise import Job
from pipelines.inference import FrameLayers, denoise_bands
from pipelines.options import DenoiseOptions
from pipelines.training.job import starting_weights
from tests.end_to_end.scenes import changed, noisy_scene, random_weights, read_flat, rgb, write_scene
from tests.runner import in_process, installed

WINDOW = Window(-5, 3, 33, 91)
"""39 x 89 pixels: a multiple of no stride, and tall enough for several bands."""
EXAMPLE = Path(__file__).resolve().parents[2] / "examples/scenes/interior.deep.exr"
FIXED = ("--exposure", "1", "--no-adapt", "--pixel-type", "float", "--threads", "1", "--progress", "none")
"""The survey's grids of bins and cells begin at a frame's first pixel, whichever way round it is."""


@pytest.fixture(autouse=True)
def weights(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A random network in the place of `high`, in this process."""
    (tmp_path / "presets").mkdir()
    random_weights(tmp_path / "presets" / "high.safetensors")
    monkeypatch.setattr(weight_files, "WEIGHTS", tmp_path / "presets")


def scene(seed: int = 0) -> DeepSamples:
    """0 to 4 samples a pixel, misses among them, and a direction of its own in every sample."""
    rng = np.random.default_rng(seed)
    samples = noisy_scene(seed, WINDOW, dtype=np.float32)
    quiet = samples.pixel_index // WINDOW.width < 40  # rows of little noise, which the light leaves alone
    samples = changed(samples, **{name: np.where(quiet, 0.5 + 1e-3 * samples.channels[name], samples.channels[name])
                                  .astype(np.float32) for name in "RGB"})
    names = ("N.X", "N.Y", "N.Z", "lens.X", "lens.Y", "motion.X", "motion.Y")
    samples = changed(samples, **{name: rng.normal(size=samples.total).astype(np.float32) for name in names})
    empty = rng.random(samples.counts.shape) < 0.1
    kept = ~empty.ravel()[samples.pixel_index]
    return DeepSamples(np.where(empty, 0, samples.counts).astype(np.int32),
                       {name: values[kept] for name, values in samples.channels.items()}, WINDOW)


def mirrored(samples: DeepSamples, axis: int) -> DeepSamples:
    """The same scene seen in a mirror; axis 0 turns it upside down, 1 swaps left and right."""
    pixels = np.flip(np.arange(samples.counts.size).reshape(samples.counts.shape), axis).ravel()
    order = np.concatenate([np.arange(samples.offsets[pixel], samples.offsets[pixel + 1]) for pixel in pixels])
    channels = {name: values[order] for name, values in samples.channels.items()}
    for layer in ("N", "motion", "lens"):
        channels[f"{layer}.{'YX'[axis]}"] = -channels[f"{layer}.{'YX'[axis]}"]
    return DeepSamples(np.ascontiguousarray(np.flip(samples.counts, axis)), channels, samples.window)


def denoised(folder: Path, name: str, samples: DeepSamples, model: str, *more: str) -> np.ndarray:
    """(H, W, 3) through the command, the network's own light unless told."""
    source, output = write_scene(folder / f"{name}.exr", samples), folder / f"{name}.{model}.exr"
    run = in_process("denoise", source, output, "--model", model, "--light", "free", *FIXED, *more)
    assert run.code == 0, run.err
    assert read_flat(output)[1]["lbmc:model"] == model
    return rgb(output)


def difference(left: np.ndarray, right: np.ndarray) -> float:
    """The largest, as a part of the largest value."""
    return float(np.abs(left - right).max() / np.abs(left).max())


@pytest.mark.parametrize("more", [(), ("--memory", "1MiB"), ("--light", "held")], ids=["whole", "bands", "held"])
@pytest.mark.parametrize("axis", [0, 1])
def test_what_is_mirrored_comes_out_mirrored(axis: int, more: tuple[str, ...], tmp_path: Path) -> None:
    samples = scene()
    there = mirrored(samples, axis)
    best = [denoised(tmp_path, name, one, "best", *more) for name, one in (("a", samples), ("b", there))]
    assert difference(best[0], np.flip(best[1], axis)) < 1e-5
    high = [denoised(tmp_path, name, one, "high", *more) for name, one in (("a", samples), ("b", there))]
    assert difference(high[0], np.flip(high[1], axis)) > 1e-3


def test_it_is_the_mean_of_the_mirror_images(tmp_path: Path) -> None:
    samples = scene(1)
    runs = [np.flip(denoised(tmp_path, f"run{number}", image, "high"), axes) for number, (image, axes) in enumerate((
        (samples, ()), (mirrored(samples, 0), (0,)), (mirrored(samples, 1), (1,)),
        (mirrored(mirrored(samples, 0), 1), (0, 1))))]
    assert difference(denoised(tmp_path, "mean", samples, "best"), np.mean(runs, axis=0)) < 1e-5


def test_memory_changes_nothing_and_cells_that_pass_are_mirrored_too(tmp_path: Path) -> None:
    samples = scene(2)
    rows = samples.pixel_index // WINDOW.width
    sky = rows < 80  # the first row of cells passes
    samples = changed(samples, A=np.where(sky, 0, 1).astype(np.float32),
                      Z=np.where(sky, 1e10, samples.channels["Z"]).astype(np.float32),
                      **{name: np.where(sky, 0.25, samples.channels[name]).astype(np.float32) for name in "RGB"})
    found = []
    for name, words in (("whole", ()), ("bands", ("--memory", "1MiB"))):
        source, output = write_scene(tmp_path / f"{name}.exr", samples), tmp_path / f"{name}.out.exr"
        run = in_process("denoise", source, output, "--model", "best", "--pixel-type", "float", *words)
        assert run.code == 0, run.err
        found.append(rgb(output))
    assert difference(*found) < 1e-5
    np.testing.assert_allclose(found[0][:60], 0.25, rtol=1e-5)


def layers_of(source: Path, aovs: tuple[str, ...] = ()) -> FrameLayers:
    job = Job(DenoiseOptions(str(source), "", model="best", device="cpu", threads=1, aovs=aovs, progress="none"))
    with job.open(source) as reader:
        plan = job.plan(source, reader, lambda _: None)
        return denoise_bands(reader, job.net, plan.shot.scale, plan.roles, plan.shot.layers, plan.bands,
                             held=plan.held, cells=plan.survey.cells, mirrors=job.mirrors)


def test_its_layers_are_layers(tmp_path: Path) -> None:
    samples = scene(3)
    depth = samples.channels["Z"][samples.channels["Z"] < 1e10]
    found = layers_of(write_scene(tmp_path / "in.exr", samples))
    np.testing.assert_allclose(found.weight.sum(0), 1, rtol=1e-5)
    assert (found.weight >= 0).all()
    assert (found.coverage >= 0).all()
    assert (found.coverage <= found.weight).all()
    np.testing.assert_array_equal(np.isfinite(found.depth), found.coverage > 0)
    hits = found.depth[found.coverage > 1e-6]
    assert hits.min() >= depth.min() * 0.999
    assert hits.max() <= depth.max() * 1.001


def test_shares_of_samples_are_averaged_whatever_the_bands(tmp_path: Path) -> None:
    samples = scene(4)
    words = ("--samples", "--model", "best", "--layers", "2", *FIXED)
    shares = {}
    for name, image, more in (("whole", samples, ()), ("bands", samples, ("--memory", "1MiB")),
                              ("mirrored", mirrored(samples, 1), ())):
        source, output = write_scene(tmp_path / f"{name}.exr", image), tmp_path / f"{name}.out.exr"
        run = in_process("export-layers", source, output, *words, *more)
        assert run.code == 0, run.err
        made, header = read_deep(output)
        assert header.get("lbmc:partition", "").startswith("best ")
        for channel, values in image.channels.items():
            assert made.channels[channel].tobytes() == values.tobytes()
        np.testing.assert_allclose(made.channels["layer0.weight"] + made.channels["layer1.weight"], 1, atol=1e-6)
        shares[name] = made
    np.testing.assert_allclose(shares["bands"].channels["layer0.weight"], shares["whole"].channels["layer0.weight"],
                               atol=1e-5)
    back = mirrored(shares["mirrored"], 1)
    np.testing.assert_allclose(back.channels["layer0.weight"], shares["whole"].channels["layer0.weight"], atol=1e-5)


def test_exported_layers_and_a_dry_run_say_best(tmp_path: Path) -> None:
    source = write_scene(tmp_path / "in.exr", scene(5))
    dry = in_process("denoise", source, tmp_path / "no.exr", "--model", "best", "--dry-run")
    assert "model: best, the mean of 4 runs of high" in dry.out
    run = in_process("export-layers", source, tmp_path / "deep.exr", "--model", "best")
    assert run.code == 0, run.err
    (header,) = read_headers(tmp_path / "deep.exr")
    assert header.get("lbmc:model") == "best"
    assert header.get("lbmc:weights") == zoo.find("high").digest


def test_it_is_a_preset_by_the_weights_of_another() -> None:
    best, high = zoo.find("best"), zoo.find("high")
    assert (best.name, best.mirrored, high.mirrored) == ("best", True, False)
    assert (best.path, best.digest) == (high.path, high.digest)
    assert zoo.presets() == ["best", "high"]
    found = {preset["name"]: preset for preset in json.loads(in_process("models", "--json").out)}
    assert found["best"]["weights"] == "high"
    assert found["best"]["mirrored"]
    assert not found["high"]["mirrored"]


def test_training_from_it_starts_with_the_weights_that_it_runs() -> None:
    config = zoo.find("high").config
    best, high = (starting_weights(Path(name), config) for name in ("best", "high"))
    assert best.keys() == high.keys()
    assert all(torch.equal(best[name], high[name]) for name in high)


def test_without_the_weights_there_is_no_such_preset(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(weight_files, "WEIGHTS", tmp_path / "none")
    assert zoo.presets() == []
    with pytest.raises(ValueError, match="no preset 'best'"):
        zoo.find("best")


def test_the_shipped_preset_denoises_an_example(tmp_path: Path) -> None:
    run = installed("denoise", EXAMPLE, tmp_path / "best.exr", "--progress", "none", env={"LBMC_MODEL": "best",
                                                                                        "LBMC_THREADS": "1"})
    assert run.code == 0, run.err
    plain = installed("denoise", EXAMPLE, tmp_path / "high.exr", "--model", "high", "--threads", "1", "--progress",
                      "none")
    assert plain.code == 0, plain.err
    assert read_flat(tmp_path / "best.exr")[1]["lbmc:model"] == "best"
    best, high = rgb(tmp_path / "best.exr").astype(np.float64), rgb(tmp_path / "high.exr").astype(np.float64)
    assert 0 < np.abs(best - high).mean() < 0.05 * high.mean()
