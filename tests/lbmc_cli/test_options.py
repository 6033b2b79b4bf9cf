"""What the commands share: environment variables, sizes, devices, role overrides, flags that exclude each other."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click
import pytest
from click.testing import CliRunner

from deep_io.sequences import Frame
from lbmc_cli.main import lbmc as program
from lbmc_cli.options import ByteSize, Device
from pipelines.options import DenoiseOptions
from tests.runner import in_process


@pytest.fixture
def parsed(monkeypatch: pytest.MonkeyPatch) -> Any:
    """Runs `lbmc denoise IN OUT ARGUMENTS` up to the pipeline's door and gives the options that would go in."""
    caught: list[DenoiseOptions] = []

    def parse(*arguments: str, env: dict[str, str] | None = None) -> DenoiseOptions:
        import pipelines.denoise
        import pipelines.frames
        from pipelines.jobs import JobReport

        def catch(options: DenoiseOptions, frames: list[Frame]) -> JobReport[None]:
            caught.append(options)
            return JobReport(())

        monkeypatch.setattr(pipelines.frames, "find_frames", lambda options: [])
        monkeypatch.setattr(pipelines.denoise, "denoise_frames", catch)
        result = CliRunner().invoke(program, ["denoise", "in.exr", "out.exr", *arguments], env=env)
        assert result.exit_code == 0, result.output
        return caught[-1]

    return parse


def test_no_flags_are_the_dataclass_defaults(parsed: Any) -> None:
    assert parsed() == DenoiseOptions("in.exr", "out.exr")


def test_every_flag_reaches_its_option(parsed: Any) -> None:
    words = (
        "--frames 1-5 --skip-existing --force --part 1 --map normal=Nw --map depth=Zc --weighting over --normals world "
        "--depth distance --camera cam.exr --model fast --layers 3 --no-adapt --exposure 2.5 --dry-run "
        "--device cuda:1 --threads 3 --memory 1.5GiB --precision bf16 --pixel-type float --compression dwaa "
        "--keep id --keep light_* --progress openjd"
    )
    assert parsed(*words.split()) == DenoiseOptions(
        "in.exr",
        "out.exr",
        frames="1-5",
        existing="skip",
        force=True,
        part="1",
        overrides={"normal": "Nw", "depth": "Zc"},
        weighting="over",
        normals="world",
        depth="distance",
        camera="cam.exr",
        model="fast",
        layers=3,
        adapt=False,
        exposure=2.5,
        dry_run=True,
        device="cuda:1",
        threads=3,
        memory=3 << 29,
        precision="bf16",
        pixel_type="float",
        compression="dwaa",
        keep=("id", "light_*"),
        progress="openjd",
    )


def test_a_part_may_be_named(parsed: Any) -> None:
    assert parsed("--part", "beauty").part == "beauty"


def test_environment_variables_stand_in_for_flags(parsed: Any) -> None:
    assert parsed(env={"LBMC_THREADS": "2", "LBMC_DENOISE_DEVICE": "cpu"}).threads == 2
    assert parsed(env={"LBMC_THREADS": "2", "LBMC_DENOISE_THREADS": "3"}).threads == 3
    assert parsed("--threads", "4", env={"LBMC_DENOISE_THREADS": "3"}).threads == 4
    assert parsed(env={"LBMC_OVERWRITE": "1"}).existing == "overwrite"
    assert not parsed(env={"LBMC_NO_ADAPT": "1"}).adapt
    assert parsed(env={"LBMC_NO_ADAPT": "0"}).adapt
    assert parsed(env={"LBMC_KEEP": "albedo"}).keep == ("albedo",)


def test_a_variable_of_a_repeatable_option_holds_a_value_a_line(parsed: Any) -> None:
    assert parsed(env={"LBMC_MAP": "normal=Denoising Normal"}).overrides == {"normal": "Denoising Normal"}
    two = parsed(env={"LBMC_MAP": "normal=N w\n\n depth=Zc\n", "LBMC_KEEP": "light *\nfog"})
    assert two.overrides == {"normal": "N w", "depth": "Zc"}
    assert two.keep == ("light *", "fog")


def test_a_flag_wins_over_the_variable_of_one_that_excludes_it(parsed: Any) -> None:
    assert parsed("--skip-existing", env={"LBMC_OVERWRITE": "1"}).existing == "skip"
    assert parsed("--overwrite", env={"LBMC_DENOISE_SKIP_EXISTING": "1"}).existing == "overwrite"
    fixed = parsed("--exposure", "2", env={"LBMC_EXPOSURE_FROM": "1001"})
    assert (fixed.exposure, fixed.exposure_from) == (2.0, None)
    named = parsed("--exposure-from", "1001", env={"LBMC_EXPOSURE": "2"})
    assert (named.exposure, named.exposure_from) == (None, "1001")
    run = in_process("denoise", "in.exr", "out.exr", env={"LBMC_OVERWRITE": "1", "LBMC_SKIP_EXISTING": "1"})
    assert run.code == 2
    assert "exclude each other" in run.err


def test_samples_win_over_variables_of_what_they_exclude() -> None:
    env = {"LBMC_FORM": "parts", "LBMC_AOV": "key", "LBMC_IDS": "id", "LBMC_CONTRIBUTIONS": "1"}
    run = in_process("export-layers", "absent.exr", "out.exr", "--samples", env=env)
    assert run.code == 3, run.err
    assert "absent.exr: no such file" in run.err
    assert in_process("export-layers", "absent.exr", "out.exr", env={**env, "LBMC_SAMPLES": "1"}).code == 2


@pytest.mark.parametrize(
    ("text", "size"),
    [("2GiB", 2 << 30), ("512M", 512 << 20), ("1.5g", 3 << 29), ("100", 100), ("64 kib", 65536), ("1TB", 1 << 40)],
)
def test_sizes(text: str, size: int) -> None:
    assert ByteSize().convert(text, None, None) == size


@pytest.mark.parametrize("text", ["", "GiB", "-1G", "0", "2X", "1e9"])
def test_what_is_not_a_size_is_refused(text: str) -> None:
    with pytest.raises(click.BadParameter):
        ByteSize().convert(text, None, None)


@pytest.mark.parametrize("text", ["gpu", "cuda:", "cuda:x", "cpu:0", ""])
def test_what_is_not_a_device_is_refused(text: str) -> None:
    with pytest.raises(click.BadParameter):
        Device().convert(text, None, None)


@pytest.mark.parametrize(
    ("arguments", "word"),
    [
        (["--map", "normal"], "ROLE=LAYER"),
        (["--map", "=N"], "ROLE=LAYER"),
        (["--map", "normal=N", "--map", "normal=M"], "twice"),
        (["--overwrite", "--skip-existing"], "exclude each other"),
        (["--exposure", "1", "--exposure-from", "1001"], "exclude each other"),
        (["--exposure", "0"], "exposure"),
        (["--memory", "much"], "2GiB"),
        (["--layers", "0"], "from 1 to 5"),
        (["--layers", "\u00b2"], "from 1 to 5"),
    ],
)
def test_wrong_values_are_usage_errors_that_say_what_is_right(arguments: list[str], word: str) -> None:
    run = in_process("denoise", "in.exr", "out.exr", *arguments)
    assert run.code == 2
    assert word in run.err
    assert run.err.count("\n") == 1


def test_a_wrong_value_from_the_environment_names_its_variable() -> None:
    words = ("denoise", "in.exr", "out.exr")
    run = in_process(*words, env={"LBMC_DENOISE_MEMORY": "much"})
    assert run.code == 2
    assert "--memory" in run.err
    assert "LBMC_DENOISE_MEMORY" in run.err
    assert "environment" not in in_process(*words, "--memory", "much", env={"LBMC_MEMORY": "2GiB"}).err


@pytest.mark.parametrize(
    "words",
    [
        "denoise in.exr out.exr --device cuda:99999999999999999999",
        "denoise in.exr out.exr --threads 100000",
        "export-layers in.exr out.exr --threads 100000",
        "pack in.exr out.exr --threads 100000",
        "bench scenes --threads 100000",
        "train scenes out --validation held --threads 100000",
        "train scenes out --validation held --loaders 100000",
        "render out --threads 100000",
        "render out --workers 100000",
    ],
)
def test_numbers_that_crash_the_libraries_are_refused(words: str, tmp_path: Path) -> None:
    run = in_process(*words.split(), cwd=tmp_path)
    assert run.code == 2
    assert f"Invalid value for '{words.split()[-2]}'" in run.err
    assert not list(tmp_path.iterdir())
