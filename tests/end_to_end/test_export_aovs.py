"""`--aov` and `--ids`, on denoise and export-layers: lights sum to the beauty, ids are ranked and not filtered."""

from __future__ import annotations

import json
import re
from pathlib import Path

import numpy as np
import OpenImageIO as oiio
import pytest

from deep_io import DeepSamples, Window, read_deep, read_headers
from pipelines.ids import cryptomatte_hash
from pipelines.options import COMPRESSIONS, LOSSY_FOR_FLOATS
from tests.end_to_end.compositor import picture
from tests.end_to_end.scenes import noisy_scene, random_weights, read_flat, write_scene
from tests.runner import in_process

WINDOW = Window(-7, 3, 32, 26)


@pytest.fixture(scope="module")
def weights(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return random_weights(tmp_path_factory.mktemp("weights") / "random.safetensors")


def scene_with_aovs() -> DeepSamples:
    """In float, so that key + fill is the radiance; `fog` and `id` besides."""
    samples = noisy_scene(5, WINDOW, dtype=np.float32)
    rng = np.random.default_rng(1)
    channels = samples.channels
    for name in "RGB":
        channels[f"key.{name}"] = (channels[name] * rng.random(samples.total)).astype(np.float32)
        channels[f"fill.{name}"] = channels[name] - channels[f"key.{name}"]
    channels["fog"] = rng.random(samples.total).astype(np.float32)
    channels["id"] = np.where(channels["Z"] < 3, 7, 40).astype(np.uint32)
    return samples


@pytest.fixture(scope="module")
def source(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_scene(tmp_path_factory.mktemp("scene") / "in.exr", scene_with_aovs())


def lbmc(command: str, source: Path, target: Path, model: Path, *words: object) -> Path:
    run = in_process(command, source, target, "--model", model, *words)
    assert run.code == 0, run.err
    return target


def test_lights_that_sum_to_the_beauty_are_denoised_to_its_sum(weights: Path, source: Path, tmp_path: Path) -> None:
    plain, _ = read_flat(lbmc("denoise", source, tmp_path / "plain.exr", weights, "--pixel-type", "float"))
    out, _ = read_flat(lbmc("denoise", source, tmp_path / "out.exr", weights, "--pixel-type", "float", "--aov", "key",
                            "--aov", "fill", "--aov", "fog"))
    assert set(out) == {*"RGBA", *(f"{light}.{name}" for light in ("key", "fill") for name in "RGB"), "fog"}
    for name in "RGBA":
        assert np.allclose(out[name], plain[name], rtol=1e-5, atol=0)
    for name in "RGB":
        total = out[f"key.{name}"].astype(np.float64) + out[f"fill.{name}"]
        assert (np.abs(total - out[name]) <= 1e-5 * np.abs(out[name])).all()
    assert ((out["fog"] > 0) & (out["fog"] < 1)).all()


def test_denoised_albedo_normal_and_depth_come_the_same_way(weights: Path, source: Path, tmp_path: Path) -> None:
    out, _ = read_flat(lbmc("denoise", source, tmp_path / "out.exr", weights, "--aov", "albedo", "--aov", "N", "--aov",
                            "depth"))
    assert set(out) == {*"RGBA", "albedo.R", "albedo.G", "albedo.B", "N.X", "N.Y", "N.Z", "Z"}
    assert out["Z"].dtype == np.float32
    hits = out["A"] > 0.99
    assert ((out["Z"] > 1.9) & (out["Z"] < 5.2))[hits].all()
    assert (out["albedo.R"][hits] > 0.05).all()


@pytest.mark.parametrize("form", ["parts", "channels", "files"])
def test_the_layers_aovs_composite_to_the_beautys(form: str, weights: Path, source: Path, tmp_path: Path) -> None:
    words = ("--pixel-type", "float", "--aov", "key", "--layers", 3)
    beauty, _ = read_flat(lbmc("denoise", source, tmp_path / "beauty.exr", weights, *words))
    out = lbmc("export-layers", source, tmp_path / "out.exr", weights, *words, "--form", form)
    result, through = np.zeros((WINDOW.height, WINDOW.width, 3)), np.ones((WINDOW.height, WINDOW.width, 1))
    for number in range(3):
        path = out if form != "files" else tmp_path / f"out.layer{number}.exr"
        image = oiio.ImageBuf(str(path), number + 1 if form == "parts" else 0, 0)
        prefix = f"layer{number}." if form == "channels" else ""
        names = image.spec().channelnames
        pixels = image.get_pixels(oiio.FLOAT)
        result += through * pixels[..., [names.index(f"{prefix}key.{name}") for name in "RGB"]]
        through = through * (1 - pixels[..., [names.index(f"{prefix}A")]])
    wanted = np.stack([beauty[f"key.{name}"] for name in "RGB"], -1)
    assert np.abs(result - wanted).max() <= 1e-5 * np.abs(wanted).max()


def test_the_deep_layers_carry_aovs_that_flatten_to_the_beautys(weights: Path, source: Path, tmp_path: Path) -> None:
    words = ("--pixel-type", "float", "--aov", "key", "--aov", "fog")
    beauty, _ = read_flat(lbmc("denoise", source, tmp_path / "beauty.exr", weights, *words))
    deep = lbmc("export-layers", source, tmp_path / "deep.exr", weights, *words)
    samples, _ = read_deep(deep)
    assert set(samples.channels) == {*"RGBAZ", "key.R", "key.G", "key.B", "fog"}
    flat = oiio.ImageBufAlgo.flatten(oiio.ImageBuf(str(deep)))
    names = list(flat.spec().channelnames)
    for name in ("key.R", "key.G", "key.B", "fog"):
        made = flat.get_pixels(oiio.FLOAT)[..., names.index(name)]
        assert np.abs(made - beauty[name]).max() <= 1e-5 * np.abs(beauty[name]).max()


def test_ids_are_ranked_pairs_with_a_manifest(weights: Path, source: Path, tmp_path: Path) -> None:
    out = lbmc("denoise", source, tmp_path / "out.exr", weights, "--ids", "id")
    channels, _ = read_flat(out)
    header = read_headers(out)[0]
    keys = {key.rpartition("/")[2]: str(header.get(key)) for key in header.attributes if key.startswith("cryptomatte/")}
    assert keys["name"] == "id"
    assert (keys["hash"], keys["conversion"]) == ("MurmurHash3_32", "uint32_to_float32")
    manifest = json.loads(keys["manifest"])
    assert manifest == {number: f"{cryptomatte_hash(number):08x}" for number in ("7", "40")}
    samples = scene_with_aovs()
    near = np.zeros(samples.counts.size)
    np.add.at(near, samples.pixel_index, (samples.channels["id"] == 7) & (samples.channels["A"] > 0))
    wanted = (near / samples.counts.ravel()).reshape(samples.counts.shape)
    seven = np.uint32(cryptomatte_hash("7"))
    made = sum(np.where(channels[f"id00.{i}"].view(np.uint32) == seven, channels[f"id00.{w}"], 0) for i, w in
               ("RG", "BA"))
    assert np.allclose(made, wanted)
    assert (channels["id00.G"] >= channels["id00.A"]).all()


def test_ids_go_with_the_beauty_of_the_flat_forms(weights: Path, source: Path, tmp_path: Path) -> None:
    out = lbmc("export-layers", source, tmp_path / "out.exr", weights, "--ids", "id", "--form", "parts")
    assert "id00.R" in read_headers(out)[0].channel_names
    assert "id00.R" not in read_headers(out)[1].channel_names
    assert picture(out, "beauty").get_pixels(oiio.FLOAT)[..., 3].max() > 0
    refused = in_process("export-layers", source, tmp_path / "deep.exr", "--model", weights, "--ids", "id")
    assert refused.code == 2
    assert "--form parts" in refused.err


@pytest.mark.parametrize("command", [("denoise",), ("export-layers", "--form", "channels")], ids=" ".join)
def test_no_compression_that_is_taken_with_ids_changes_one_of_their_bits(
    command: tuple[str, ...], weights: Path, source: Path, tmp_path: Path
) -> None:
    words = (*command, source, tmp_path / "out.exr", "--model", weights, "--ids", "id", "--overwrite", "--compression")
    found: dict[str, dict[str, bytes]] = {}
    for compression in COMPRESSIONS:
        run = in_process(*words, compression)
        if compression in LOSSY_FOR_FLOATS:
            assert run.code == 2
            assert re.fullmatch(rf"ERROR: --ids: compression {compression} .*; choose one of none, .*\n", run.err)
            continue
        assert run.code == 0, run.err
        channels, _ = read_flat(tmp_path / "out.exr")
        found[compression] = {name: plane.tobytes() for name, plane in channels.items() if name.startswith("id0")}
    assert all(len(planes) == 12 and planes == found["none"] for planes in found.values())


def test_ids_whose_names_are_alike_are_all_written(weights: Path, tmp_path: Path) -> None:
    samples = noisy_scene(5, WINDOW)
    names = ("inst1", "inst100", "inst10000.R")
    for number, name in enumerate(names):
        samples.channels[name] = np.full(samples.total, number, np.uint32)
    source = write_scene(tmp_path / "in.exr", samples)
    words = (word for name in names for word in ("--ids", name))
    channels, _ = read_flat(lbmc("denoise", source, tmp_path / "out.exr", weights, *words))
    for number, name in enumerate(("inst1", "inst100", "inst10000")):
        ids = channels[f"{name}00.R"].view(np.uint32)
        assert set(ids[channels[f"{name}00.G"] > 0].tolist()) == {cryptomatte_hash(str(number))}


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--keep", "albedo", "--aov", "albedo"], "--keep albedo: albedo.B is written by --aov already; leave one of"),
        (["--keep", "id00", "--ids", "id"], "--keep id00: id00.G is written by --ids id already; leave one of"),
        (["--aov", "id00", "--ids", "id"], "id00.R would be written twice, by --aov and by --ids id; leave one of"),
        (["--ids", "id", "--ids", "id.R"], "id00.R would be written twice, by --ids id and by --ids id.R; leave one"),
    ],
)
def test_no_channel_is_written_twice(words: list[str], said: str, weights: Path, tmp_path: Path) -> None:
    samples = scene_with_aovs()
    samples.channels |= {"id00.R": samples.channels["fog"], "id00.G": samples.channels["fog"],
                         "id.R": samples.channels["id"]}
    source = write_scene(tmp_path / "in.exr", samples)
    run = in_process("denoise", source, tmp_path / "out.exr", "--model", weights, *words)
    assert run.code == 2, run.err
    assert len([line for line in run.err.splitlines() if line.startswith("ERROR: ") and said in line]) == 1
    assert list(tmp_path.iterdir()) == [source]


def test_a_layers_own_channel_is_no_name_for_an_aov(weights: Path, tmp_path: Path) -> None:
    samples = scene_with_aovs()
    samples.channels["layer1.R"] = samples.channels["fog"]
    source = write_scene(tmp_path / "in.exr", samples)
    words = ("--model", weights, "--aov", "layer1.R")
    refused = in_process("export-layers", source, tmp_path / "out.exr", *words, "--form", "channels")
    assert refused.code == 2
    assert "layer1.R would be written twice, by --aov and by the layers" in refused.err
    lbmc("export-layers", source, tmp_path / "out.exr", weights, "--aov", "layer1.R", "--form", "parts")


def test_a_glob_to_keep_passes_denoised_aovs_by(weights: Path, source: Path, tmp_path: Path) -> None:
    out, _ = read_flat(lbmc("denoise", source, tmp_path / "out.exr", weights, "--aov", "albedo"))
    both, _ = read_flat(lbmc("denoise", source, tmp_path / "both.exr", weights, "--aov", "albedo", "--keep", "*"))
    assert {"N.X", "fog", "key.R"} < set(both)
    assert all(np.array_equal(both[name], plane) for name, plane in out.items())


@pytest.mark.parametrize("command", ["denoise", "export-layers"])
@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--aov", "rim"], "no AOV 'rim'; there are"),
        (["--aov", "id"], "--ids id"),
        (["--aov", "RGB"], "fill"),
        (["--aov", "key", "--aov", "key.R"], "in.exr: --aov key.R: key.R is written by --aov key already"),
        (["--map", "radiance=key", "--aov", "fog", "--aov", "R"], "in.exr: --aov R: R is the beauty's name"),
    ],
)
def test_an_aov_that_is_not_there_is_an_id_or_has_a_name_that_is_taken(
    command: str, words: list[str], said: str, weights: Path, source: Path, tmp_path: Path
) -> None:
    run = in_process(command, source, tmp_path / "out.exr", "--model", weights, *words)
    assert run.code == 3
    assert said in run.err
    assert not list(tmp_path.iterdir())
