"""`lbmc compare`, on flat EXRs made here: text, JSON, pictures, sequences, refusals."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from model.metrics import score
from tests.end_to_end.scenes import noisy_scene, write_scene
from tests.pipelines.test_compare import picture, write_flat
from tests.runner import Finished, Runner, in_process


@pytest.fixture
def pair(tmp_path: Path) -> tuple[Path, Path]:
    return write_flat(tmp_path / "image.exr", picture(0)), write_flat(tmp_path / "reference.exr", picture(1))


def test_every_metric_is_a_line(lbmc: Runner, pair: tuple[Path, Path]) -> None:
    run = lbmc("compare", *pair)
    assert run.code == 0
    assert run.err == ""
    expected = score(picture(0), picture(1))
    assert f"{expected.relmse:.6g}  relMSE\n" in run.out
    for name in ("SMAPE", "PSNR", "SSIM", "FLIP", "worst 0.1 %", "epsilon 0.0001", "mean of image"):
        assert name in run.out


def test_json_holds_the_numbers(lbmc: Runner, pair: tuple[Path, Path]) -> None:
    (found,) = json.loads(lbmc("compare", *pair, "--json").out)["images"]
    expected = score(picture(0), picture(1))
    assert found["image"] == str(pair[0])
    for name in ("relmse", "relmse_trimmed", "relmse_small_epsilon", "smape", "psnr", "ssim", "flip", "energy"):
        assert found[name] == pytest.approx(getattr(expected, name), rel=1e-9)


def test_another_half_gives_the_unbiased_error(pair: tuple[Path, Path], tmp_path: Path) -> None:
    half = write_flat(tmp_path / "half.exr", picture(2))
    run = in_process("compare", *pair, "--other-half", half, "--json", "--no-flip")
    (found,) = json.loads(run.out)["images"]
    assert found["relmse_unbiased"] == pytest.approx(score(picture(0), picture(1), picture(2)).relmse_unbiased)
    assert found["flip"] is None


def test_pictures_are_written_and_not_over_others(pair: tuple[Path, Path], tmp_path: Path) -> None:
    heat, panel = tmp_path / "heat.png", tmp_path / "panel.png"
    words = ("compare", *pair, "--no-flip", "--heatmap", heat, "--panel", panel)
    assert in_process(*words).code == 0
    assert Image.open(heat).format == Image.open(panel).format == "PNG"
    before = heat.stat().st_mtime_ns
    refused = in_process(*words)
    assert refused.code == 2
    assert "--overwrite" in refused.err
    assert "--skip-existing" not in refused.err  # compare has no such option
    assert heat.stat().st_mtime_ns == before
    assert in_process(*words, "--overwrite").code == 0
    assert heat.stat().st_mtime_ns > before


def test_a_picture_never_lands_on_an_input(pair: tuple[Path, Path], tmp_path: Path) -> None:
    before = pair[1].read_bytes()
    link = tmp_path / "link.png"
    link.hardlink_to(pair[1])
    run = in_process("compare", *pair, "--no-flip", "--heatmap", link, "--overwrite")
    assert run.code == 2
    assert "is the input" in run.err
    assert pair[1].read_bytes() == before


def test_two_pictures_need_two_names(pair: tuple[Path, Path], tmp_path: Path) -> None:
    run = in_process("compare", *pair, "--heatmap", tmp_path / "one.png", "--panel", tmp_path / "one.png")
    assert run.code == 2
    assert "one.png" in run.err
    assert not (tmp_path / "one.png").exists()


@pytest.mark.parametrize("name", ["error.jpg", "error", "error.exr"])
def test_a_picture_is_a_png_by_name_too(pair: tuple[Path, Path], tmp_path: Path, name: str) -> None:
    run = in_process("compare", *pair, "--panel", tmp_path / name)
    assert run.code == 2
    assert f"{name}: a PNG is written" in run.err
    assert not (tmp_path / name).exists()


def test_without_flip_evaluator_it_is_said_what_is_missing(
    pair: tuple[Path, Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "flip_evaluator", None)
    run = in_process("compare", *pair)
    assert run.code == 0
    assert "FLIP" not in run.out
    assert "install lbmc with its extra 'bench'" in run.err
    assert in_process("compare", *pair, "--no-flip").err == ""


@pytest.fixture
def sequences(tmp_path: Path) -> Path:
    """image.1001-1004 and reference.1002-1005."""
    for number in range(1001, 1005):
        write_flat(tmp_path / f"image.{number}.exr", picture(number))
        write_flat(tmp_path / f"reference.{number + 1}.exr", picture(number + 10))
    return tmp_path


def test_sequences_give_a_table_and_both_kinds_of_means(lbmc: Runner, sequences: Path) -> None:
    run = lbmc("compare", sequences / "image.####.exr", sequences / "reference.####.exr", "--no-flip", "--frames",
               "1002-1004")
    assert run.code == 0
    head, *rows = run.out.splitlines()
    names = [line.split("  ")[0] for line in rows]
    assert names == ["image.1002.exr", "image.1003.exr", "image.1004.exr", "geometric mean", "mean"]
    expected = [score(picture(n), picture(n + 9), with_flip=False) for n in range(1002, 1005)]
    columns = head.split()
    geometric, plain = (dict(zip(columns, row.removeprefix(name).split(), strict=True))
                        for name, row in zip(names[-2:], rows[-2:], strict=True))
    assert float(geometric["relmse"]) == pytest.approx(np.exp(np.mean([np.log(s.relmse) for s in expected])), rel=1e-4)
    assert float(plain["smape"]) == pytest.approx(np.mean([s.smape for s in expected]), rel=1e-4)
    assert {name for name in columns if geometric[name] != "–"} == {"relmse", "trimmed", "small_epsilon"}
    assert {name for name in columns if plain[name] == "–"} == {"relmse", "trimmed", "small_epsilon"}


def test_frames_that_a_sequence_lacks_are_told_and_no_success(lbmc: Runner, sequences: Path) -> None:
    image, reference = sequences / "image.####.exr", sequences / "reference.####.exr"
    run = lbmc("compare", image, reference, "--no-flip", "--json")
    assert run.code == 1
    note, *_, summary = run.err.splitlines()
    assert note == (f"2 of 5 frames are left out: {image} lacks 1005; {reference} lacks 1001; "
                    "pass --frames to name those to compare")
    assert summary.startswith("3 of 5 frames done, 2 left out, ")
    found = json.loads(run.out)
    assert [Path(row["image"]).name for row in found["images"]] == [f"image.{n}.exr" for n in (1002, 1003, 1004)]
    assert found["failed"] == []
    assert found["left_out"] == [
        {"frame": "image.1001.exr", "error": f"{sequences / 'reference.1001.exr'}: no such file"},
        {"frame": "image.1005.exr", "error": f"{sequences / 'image.1005.exr'}: no such file"},
    ]


def test_frames_that_are_named_are_all_that_counts(sequences: Path) -> None:
    reference = sequences / "reference.####.exr"
    for words in ((sequences / "image.####.exr", reference, "--frames", "1003-1004"),
                  (sequences / "image.1003-1004####.exr", reference)):
        run = in_process("compare", *words, "--no-flip", "--json")
        assert run.code == 0, run.err
        assert "left out" not in run.err
        assert len(json.loads(run.out)["images"]) == 2
    run = in_process("compare", sequences / "image.####.exr", reference, "--frames", "1001-1002", "--no-flip", "--json")
    assert run.code == 1
    (failed,) = json.loads(run.out)["failed"]
    assert failed["frame"] == "image.1001.exr"
    assert "reference.1001.exr" in failed["error"]


def test_a_frame_that_fails_is_listed_and_the_others_are_measured(sequences: Path) -> None:
    (sequences / "image.1003.exr").write_bytes(b"broken")
    words = ("compare", sequences / "image.####.exr", sequences / "reference.####.exr", "--no-flip", "--json")
    run = in_process(*words)
    assert run.code == 1
    assert len(json.loads(run.out)["images"]) == 2
    assert [row["frame"] for row in json.loads(run.out)["failed"]] == ["image.1003.exr"]
    assert "failed frames:" in run.err
    assert "1 failed" in run.err


def test_one_reference_serves_a_whole_sequence(sequences: Path) -> None:
    run = in_process("compare", sequences / "image.####.exr", sequences / "reference.1002.exr", "--no-flip", "--json")
    assert len(json.loads(run.out)["images"]) == 4


def test_both_halves_of_a_frame_are_needed(sequences: Path) -> None:
    write_flat(sequences / "half.1003.exr", picture(7))
    words = ("compare", sequences / "image.####.exr", sequences / "reference.####.exr", "--no-flip", "--other-half")
    run = in_process(*words, sequences / "half.####.exr", "--json")
    assert run.code == 1
    assert "4 of 5 frames are left out" in run.err
    assert "half.####.exr lacks 1001-1002,1004-1005" in run.err
    (found,) = json.loads(run.out)["images"]
    assert found["image"].endswith("image.1003.exr")
    expected = score(picture(1003), picture(1012), picture(7), with_flip=False).relmse_unbiased
    assert found["relmse_unbiased"] == pytest.approx(expected)
    run = in_process(*words, sequences / "none.####.exr")
    assert run.code == 3
    assert "none.####.exr: no file matches the pattern" in run.err


def test_sequences_write_a_picture_per_frame(sequences: Path) -> None:
    words = ("compare", sequences / "image.####.exr", sequences / "reference.####.exr", "--no-flip", "--heatmap")
    refused = in_process(*words, sequences / "error.png")
    assert refused.code == 2
    assert in_process(*words, sequences / "error.####.png", "--frames", "1002-1004").code == 0
    assert sorted(path.name for path in sequences.glob("error*")) == [f"error.{n}.png" for n in range(1002, 1005)]


def assert_one_line(run: Finished, *words: str) -> None:
    assert run.code == 3
    assert run.out == ""
    assert run.err.startswith("ERROR: ")
    assert run.err.count("\n") == 1
    for word in words:
        assert word in run.err


def test_sizes_that_differ_are_both_said(lbmc: Runner, pair: tuple[Path, Path], tmp_path: Path) -> None:
    other = write_flat(tmp_path / "other.exr", picture(1, (8, 9)))
    assert_one_line(lbmc("compare", pair[0], other), "image.exr is 20 x 16", "other.exr is 9 x 8")


def test_a_reference_without_light_is_refused(lbmc: Runner, pair: tuple[Path, Path], tmp_path: Path) -> None:
    black = write_flat(tmp_path / "black.exr", np.zeros((16, 20, 3)))
    assert_one_line(lbmc("compare", pair[0], black), "black.exr", "no light")


def test_a_missing_reference_is_named(lbmc: Runner, pair: tuple[Path, Path], tmp_path: Path) -> None:
    assert_one_line(lbmc("compare", pair[0], tmp_path / "none.exr"), "none.exr")


def test_one_missing_reference_of_a_sequence_is_named(sequences: Path) -> None:
    run = in_process("compare", sequences / "image.####.exr", sequences / "none.exr")
    assert_one_line(run, "none.exr: no such file")


def test_a_single_image_has_no_sequence_of_references(sequences: Path) -> None:
    run = in_process("compare", sequences / "image.1002.exr", sequences / "reference.####.exr")
    assert_one_line(run, "reference.####.exr: is a sequence", "image.1002.exr is a single file")


def test_sequences_without_a_common_frame_are_refused(sequences: Path) -> None:
    write_flat(sequences / "else.0001.exr", picture(0))
    run = in_process("compare", sequences / "image.####.exr", sequences / "else.####.exr")
    assert run.code == 3
    assert "no frame in common" in run.err


def test_folders_are_refused_with_what_does_compare_them(lbmc: Runner, sequences: Path, tmp_path: Path) -> None:
    for words in ((sequences, tmp_path), (sequences / "image.1002.exr", sequences)):
        assert_one_line(lbmc("compare", *words), f"{sequences}: is a folder", "NAME.####.exr", "lbmc bench DIR")


def test_a_deep_file_is_refused_with_the_command_that_flattens_it(lbmc: Runner, pair: tuple[Path, Path]) -> None:
    deep = pair[0].with_name("shot.deep.exr")
    write_scene(deep, noisy_scene(1))
    assert_one_line(lbmc("compare", deep, pair[1]), f"{deep}: is a deep EXR", f"lbmc denoise {deep} OUT")


def test_a_layer_can_be_chosen(lbmc: Runner, pair: tuple[Path, Path], tmp_path: Path) -> None:
    names = ("beauty.R", "beauty.G", "beauty.B")
    image = write_flat(tmp_path / "layer.exr", picture(0), names=names)
    assert_one_line(lbmc("compare", image, pair[1]), "layer.exr: no R, G, B channels", "--layer beauty")
    run = lbmc("compare", image, pair[1], "--layer", "beauty", "--part", "0", "--no-flip", "--json")
    assert run.code == 0, run.err
    (found,) = json.loads(run.out)["images"]
    assert found["relmse"] == pytest.approx(score(picture(0), picture(1)).relmse)


def test_two_halves_that_are_one_file_are_refused(lbmc: Runner, pair: tuple[Path, Path]) -> None:
    run = lbmc("compare", *pair, "--other-half", pair[1])
    assert_one_line(run, f"{pair[1]} and {pair[1]} are the same picture; two independent renderings are needed")


@pytest.mark.parametrize("debug", [False, True])
def test_a_pair_that_cannot_be_compared_is_one_line_and_with_debug_a_traceback(
    debug: bool, pair: tuple[Path, Path], tmp_path: Path
) -> None:
    small = write_flat(tmp_path / "small.exr", picture(0)[:5])
    run = in_process("compare", small, pair[1], *["--debug"] * debug)
    assert run.code == 3
    assert run.err.startswith("ERROR: ")
    assert ("Traceback" in run.err) == debug
    assert debug or run.err.count("\n") == 1


@pytest.mark.parametrize(("words", "env"), [(("--progress", "openjd"), {}), ((), {"LBMC_PROGRESS": "openjd"})])
def test_json_is_json_also_where_open_job_description_is_told(
    words: tuple[str, ...], env: dict[str, str], lbmc: Runner, tmp_path: Path
) -> None:
    for number in (1, 2):
        write_flat(tmp_path / f"a.{number}.exr", picture(number))
        write_flat(tmp_path / f"b.{number}.exr", picture(number + 2))
    run = lbmc("compare", tmp_path / "a.#.exr", tmp_path / "b.#.exr", "--no-flip", "--json", *words, env=env)
    assert run.code == 0, run.err
    assert len(json.loads(run.out)["images"]) == 2
    assert "openjd_progress: 100" in run.err.splitlines()
