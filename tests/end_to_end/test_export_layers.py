"""`lbmc export-layers`: whatever the form, over gives the denoised beauty, and the files are as Nuke reads them."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import OpenEXR
import OpenImageIO as oiio
import pytest

from deep_io import DeepSamples, Window, read_deep, read_headers
from deep_io.roles import MISS_DEPTH
from model import zoo
from pipelines import __version__
from tests.end_to_end.compositor import flatten, over, part_names, picture, plus
from tests.end_to_end.scenes import changed, noisy_scene, random_weights, read_flat, write_scene
from tests.model.random_models import SMALL, random_network
from tests.runner import Runner, in_process, installed

WINDOW = Window(-7, 3, 32, 26)
"""40 x 24 pixels."""
OIIOTOOL = Path(sys.executable).parent / "oiiotool"
FORMS = ("deep", "parts", "channels", "files")

Weights = Callable[[str], Path]


@pytest.fixture(scope="module")
def weights(tmp_path_factory: pytest.TempPathFactory) -> Weights:
    """Weight files of random networks: "random" or a name of SMALL."""
    folder = tmp_path_factory.mktemp("weights")

    def find(name: str) -> Path:
        path = folder / f"{name.replace(' ', '-')}.safetensors"
        if not path.exists() and name == "random":
            random_weights(path)
        elif not path.exists():
            net = random_network(SMALL[name], 1).float()
            zoo.save(net, path, {"description": "random"})
        return path

    return find


@pytest.fixture(scope="module")
def source(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_scene(tmp_path_factory.mktemp("scene") / "in.exr", noisy_scene(3, WINDOW), owner="somebody")


def lbmc(command: str, source: Path, target: Path, model: Path, *words: object) -> Path:
    """Runs a command that must succeed."""
    run = in_process(command, source, target, "--model", model, "--overwrite", *words)
    assert run.code == 0, run.err
    return target


def tolerance(contributions: list[np.ndarray], pixel_type: str) -> np.ndarray:
    total = np.abs(np.stack(contributions).astype(np.float64)).sum(0)
    return total * 2**-10 + 2**-23 if pixel_type == "half" else total * 1e-5


def pictures_of(form: str, path: Path, layers: int) -> list[oiio.ImageBuf]:
    if form == "parts":
        return [picture(path, f"layer{k}") for k in range(layers)]
    if form == "channels":
        return [picture(path, 0, f"layer{k}") for k in range(layers)]
    return [picture(path.with_name(f"{path.stem}.layer{k}.exr")) for k in range(layers)]


CASES = [(name, layers) for name, config in SMALL.items() for layers in range(1, min(config.partition_logits, 4) + 1)]


@pytest.mark.parametrize(("name", "layers"), CASES)
def test_every_variants_layers_composite_to_its_beauty(
    name: str, layers: int, weights: Weights, source: Path, tmp_path: Path
) -> None:
    words = ("--layers", layers)
    model = weights(name)
    channels, _ = read_flat(lbmc("denoise", source, tmp_path / "beauty.exr", model, *words, "--pixel-type", "float"))
    beauty = np.stack([channels[key] for key in "RGBA"], -1)
    sums = lbmc("export-layers", source, tmp_path / "sums.exr", model, *words, "--pixel-type", "float", "--form",
                "parts", "--contributions")
    contributions = [image.get_pixels(oiio.FLOAT) for image in pictures_of("parts", sums, layers)]
    for pixel_type in ("half", "float"):
        deep = lbmc("export-layers", source, tmp_path / "deep.exr", model, *words, "--pixel-type", pixel_type)
        assert (np.abs(flatten(deep) - beauty) <= tolerance(contributions, pixel_type)).all()


@pytest.mark.parametrize("pixel_type", ["half", "float"])
@pytest.mark.parametrize("form", ["parts", "channels", "files"])
@pytest.mark.parametrize("layers", [1, 2, 4])
def test_flat_layers_composite_and_contributions_sum_to_the_beauty(
    form: str, layers: int, pixel_type: str, weights: Weights, source: Path, tmp_path: Path
) -> None:
    words = ("--layers", layers, "--pixel-type", pixel_type, "--form", form)
    beauty_words = ("--layers", layers, "--pixel-type", "float")
    channels, _ = read_flat(lbmc("denoise", source, tmp_path / "beauty.exr", weights("fast"), *beauty_words))
    beauty = np.stack([channels[key] for key in "RGBA"], -1)
    out = lbmc("export-layers", source, tmp_path / "out.exr", weights("fast"), *words)
    sums = lbmc("export-layers", source, tmp_path / "sums.exr", weights("fast"), *words, "--contributions")
    contributions = pictures_of(form, sums, layers)
    allowed = tolerance([image.get_pixels(oiio.FLOAT) for image in contributions], pixel_type)
    assert (np.abs(over(pictures_of(form, out, layers)) - beauty) <= allowed).all()
    assert (np.abs(plus(contributions) - beauty) <= allowed).all()
    if form != "files":
        plain = picture(out).get_pixels(oiio.FLOAT)
        assert (np.abs(plain - beauty) <= (2**-11 if pixel_type == "half" else 0) * np.abs(beauty) + 2**-25).all()


def test_oiiotool_flattens_the_layers_to_the_beauty(weights: Weights, source: Path, tmp_path: Path) -> None:
    deep = lbmc("export-layers", source, tmp_path / "deep.exr", weights("fast"), "--layers", 3)
    beauty = lbmc("denoise", source, tmp_path / "beauty.exr", weights("fast"), "--layers", 3, "--pixel-type", "float")
    flat = tmp_path / "flat.exr"
    subprocess.run([OIIOTOOL, deep, "--flatten", "-d", "float", "-o", flat], check=True)
    channels, _ = read_flat(flat)
    wanted, _ = read_flat(beauty)
    for name in "RGBA":
        assert np.abs(channels[name] - wanted[name]).max() <= 2**-10 * np.abs(wanted[name]).max()


@pytest.mark.parametrize("layers", [1, 2, 5])
def test_the_deep_file_keeps_the_rules_that_nuke_needs(
    layers: int, weights: Weights, source: Path, tmp_path: Path
) -> None:
    path = lbmc("export-layers", source, tmp_path / "deep.exr", weights("fast"), "--layers", layers)
    headers = read_headers(path)
    assert len(headers) == 1
    assert headers[0].type == "deepscanline"
    assert headers[0].compression == "zips"
    assert {channel.name: channel.dtype.name for channel in headers[0].channels} == {
        "R": "float16", "G": "float16", "B": "float16", "A": "float16", "Z": "float32"}
    assert headers[0].data_window == WINDOW
    found = OpenEXR.File(str(path), separate_channels=True).parts[0]  # the library's own opinion
    assert found.header["type"] == OpenEXR.deepscanline
    assert found.header["lbmc:weighting"] == "over"
    samples, _ = read_deep(path)
    assert samples.counts.max() <= layers
    for z, alpha in zip(*(per_pixel(samples, name) for name in "ZA"), strict=True):
        assert (np.diff(z) > 0).all()
        assert (alpha[:-1] < 1).all()
        assert ((alpha >= 0) & (alpha <= 1)).all()
    hit = samples.channels["A"] > 0
    assert (samples.channels["Z"][hit] < MISS_DEPTH).all()
    for name in "RGB":
        assert np.isfinite(samples.channels[name]).all()


def per_pixel(samples: DeepSamples, name: str) -> list[np.ndarray]:
    offsets = samples.offsets.tolist()
    return [samples.channels[name][first:last] for first, last in pairwise(offsets)]


@pytest.mark.parametrize("form", FORMS)
def test_windows_attributes_and_provenance_are_written(
    form: str, weights: Weights, source: Path, tmp_path: Path
) -> None:
    out = lbmc("export-layers", source, tmp_path / "out.exr", weights("random"), "--form", form)
    for header in read_headers(out if form != "files" else tmp_path / "out.layer1.exr"):
        assert (header.data_window, header.display_window) == (WINDOW, WINDOW)
        assert header.get("owner") == "somebody"
        assert header.get("lbmc:version") == __version__
        assert header.get("lbmc:model") == "random"
        assert header.get("lbmc:layers") == 2
        assert header.get("lbmc:form") == "over"
        assert header.get("lbmc:layerOrder") == "front to back"


def test_the_parts_and_the_channels_and_their_names(weights: Weights, source: Path, tmp_path: Path) -> None:
    parts = lbmc("export-layers", source, tmp_path / "parts.exr", weights("fast"), "--form", "parts", "--layers", 3)
    assert part_names(parts) == ["beauty", "layer0", "layer1", "layer2"]
    assert [header.channel_names for header in read_headers(parts)] == [
        ("A", "B", "G", "R"), *[("A", "B", "G", "R", "Z")] * 3]
    channels = lbmc("export-layers", source, tmp_path / "channels.exr", weights("fast"), "--form", "channels")
    assert set(read_headers(channels)[0].channel_names) == {
        *"RGBA", *(f"layer{k}.{name}" for k in range(2) for name in "RGBAZ")}


def test_a_depth_of_its_own_for_each_layer(weights: Weights, source: Path, tmp_path: Path) -> None:
    """The untrained network's partition is the depth prior: the front layer is nearer where both are seen."""
    out = lbmc("export-layers", source, tmp_path / "out.exr", weights("random"), "--form", "channels")
    channels, _ = read_flat(out)
    both = (channels["layer0.A"] > 0) & (channels["layer1.A"] > 0)
    assert both.any()
    assert (channels["layer0.Z"] < channels["layer1.Z"])[both].mean() > 0.9
    nothing = ~np.any([channels[f"layer0.{name}"] for name in "RGBA"], axis=0)
    assert nothing.any()
    assert (channels["layer0.Z"][nothing] == np.float32(MISS_DEPTH)).all()


def test_files_of_a_sequence_put_the_layer_before_the_frame(weights: Weights, tmp_path: Path) -> None:
    for number in (7, 8):
        write_scene(tmp_path / f"in.{number:04d}.exr", noisy_scene(number, WINDOW))
    words = ("--model", weights("fast"), "--form", "files")
    run = in_process("export-layers", tmp_path / "in.####.exr", tmp_path / "out.####.exr", *words)
    assert run.code == 0, run.err
    names = {path.name for path in tmp_path.glob("out*")}
    assert names == {f"out.layer{k}.{number:04d}.exr" for k in range(2) for number in (7, 8)}
    again = in_process("export-layers", tmp_path / "in.####.exr", tmp_path / "out.####.exr", *words)
    assert again.code == 2
    assert "out.layer0.0007.exr: exists" in again.err
    (tmp_path / "out.layer1.0008.exr").unlink()
    before = (tmp_path / "out.layer0.0008.exr").stat().st_mtime_ns
    skipped = in_process("export-layers", tmp_path / "in.####.exr", tmp_path / "out.####.exr", *words,
                         "--skip-existing")
    assert skipped.code == 0
    assert (tmp_path / "out.layer1.0008.exr").exists()
    assert (tmp_path / "out.layer0.0008.exr").stat().st_mtime_ns == before


@pytest.mark.parametrize("form", FORMS)
def test_the_same_input_gives_the_same_bytes(form: str, weights: Weights, source: Path, tmp_path: Path) -> None:
    made = []
    for name in ("a", "b"):
        (tmp_path / name).mkdir()
        lbmc("export-layers", source, tmp_path / name / "out.exr", weights("fast"), "--form", form, "--threads", 1)
        made.append([path.read_bytes() for path in sorted((tmp_path / name).iterdir())])
    assert made[0] == made[1]


def test_flat_layers_need_no_depth(weights: Weights, source: Path, tmp_path: Path) -> None:
    out = lbmc("export-layers", source, tmp_path / "out.exr", weights("fast"), "--form", "parts", "--map", "depth=")
    assert all("Z" not in header.channel_names for header in read_headers(out))


def test_a_network_without_depth_writes_flat_layers_only(source: Path, tmp_path: Path) -> None:
    config = replace(SMALL["layer"], roles=("radiance", "normal", "albedo"))
    model = tmp_path / "blind.safetensors"
    zoo.save(random_network(config, 1).float(), model, {})
    run = in_process("export-layers", source, tmp_path / "deep.exr", "--model", model)
    assert run.code == 2
    assert "without depth" in run.err
    refused = in_process("denoise", source, tmp_path / "out.exr", "--model", model, "--aov", "depth")
    assert refused.code == 2
    assert "without depth" in refused.err
    out = lbmc("export-layers", source, tmp_path / "parts.exr", model, "--form", "parts")
    assert all("Z" not in header.channel_names for header in read_headers(out))
    assert not (tmp_path / "deep.exr").exists()


def test_layers_without_order_say_so(weights: Weights, source: Path, tmp_path: Path) -> None:
    words = ("--model", weights("layer_w"), "--layers", 2)
    run = in_process("export-layers", source, tmp_path / "out.exr", *words)
    assert run.code == 0
    assert "no depth order" in run.err
    assert read_headers(tmp_path / "out.exr")[0].get("lbmc:layerOrder") == "none"


@pytest.mark.parametrize("runner", [in_process, installed])
def test_the_deep_form_of_a_file_without_depth_says_how_to_map_it(
    runner: Runner, weights: Weights, tmp_path: Path
) -> None:
    scene = noisy_scene(4, WINDOW)
    scene.channels["distance_to_lens"] = scene.channels.pop("Z")
    path = write_scene(tmp_path / "in.exr", scene)
    run = runner("export-layers", path, tmp_path / "out.exr", "--model", weights("fast"))
    assert run.code == 3
    assert run.err.startswith("ERROR:") or "\nERROR:" in run.err
    assert "--map depth=" in run.err
    assert [file.name for file in tmp_path.iterdir()] == ["in.exr"]
    mapped = in_process("export-layers", path, tmp_path / "out.exr", "--model", weights("fast"), "--map",
                        "depth=distance_to_lens")
    assert mapped.code == 0, mapped.err


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["out.png"], "extension .exr"),
        (["out.tif", "--form", "files"], "extension .exr"),
        (["out.exr", "--contributions"], "--form parts"),
        (["out.exr", "--compression", "piz"], "none, rle, zips"),
        (["out.exr", "--form", "shallow"], "shallow"),
        (["out.exr", "--layers", "5", "--model", "MODEL"], "--layers 5"),
    ],
)
def test_forms_that_do_not_fit_are_usage_errors(
    words: list[str], said: str, weights: Weights, source: Path, tmp_path: Path
) -> None:
    model = str(weights("layer"))
    arguments = [model if word == "MODEL" else word for word in words]
    run = in_process("export-layers", source, tmp_path / arguments[0], *arguments[1:], cwd=tmp_path)
    assert run.code == 2
    assert said in run.err
    assert not list(tmp_path.iterdir())


def test_exported_layers_are_refused_as_an_input(weights: Weights, source: Path, tmp_path: Path) -> None:
    deep = lbmc("export-layers", source, tmp_path / "deep.exr", weights("fast"))
    run = in_process("denoise", deep, tmp_path / "again.exr", "--model", weights("fast"))
    assert run.code == 3
    assert "--force" in run.err


def test_a_dry_run_writes_nothing(weights: Weights, source: Path, tmp_path: Path) -> None:
    run = in_process("export-layers", source, tmp_path / "out.exr", "--model", weights("fast"), "--dry-run")
    assert run.code == 0
    assert "layers: 2" in run.out
    assert not list(tmp_path.iterdir())


def test_a_frame_that_needs_one_layer_still_gives_the_files_that_a_comp_counts_on(tmp_path: Path) -> None:
    samples = noisy_scene()
    flat = changed(samples, A=np.zeros(samples.total, np.float16))
    source = write_scene(tmp_path / "in.deep.exr", flat)
    weights = random_weights(tmp_path / "w.safetensors")
    common = ["--model", str(weights), "--pixel-type", "float", "--progress", "none"]
    result = in_process("export-layers", str(source), str(tmp_path / "out.exr"), "--form", "files",
                        "--contributions", *common)
    assert result.code == 0, result.err
    assert in_process("denoise", str(source), str(tmp_path / "beauty.exr"), *common).code == 0
    front, back = (read_flat(tmp_path / f"out.layer{k}.exr")[0] for k in range(2))
    beauty = read_flat(tmp_path / "beauty.exr")[0]
    assert not front["R"].any()
    assert not front["A"].any()
    np.testing.assert_allclose(back["R"], beauty["R"], rtol=1e-6)
