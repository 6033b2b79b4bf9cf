"""The options of every command that denoises, in two groups: what is read and made of it, and on what machine."""

from __future__ import annotations

from typing import Any

import click

from lbmc_cli.options import PROGRESS, THREADS, ByteSize, Device, option, reading_options, together
from lbmc_cli.report import existing_choice
from pipelines.options import ALL_LAYERS


def _layers(ctx: click.Context, parameter: click.Parameter, value: str) -> int | None:
    if value == "auto":
        return None
    if value.isdecimal() and 1 <= int(value) <= ALL_LAYERS:
        return int(value)
    raise click.BadParameter(f"{value!r} is not auto or a number from 1 to {ALL_LAYERS}", ctx, parameter)


def job_choices(overwrite: bool, skip_existing: bool, no_adapt: bool, light: str, **choices: Any) -> dict[str, Any]:
    """The groups' values as the fields of DenoiseOptions."""
    return {"existing": existing_choice(overwrite, skip_existing), "adapt": not no_adapt, "light": light == "held",
            **choices}


job_options = together(
    option("--frames", metavar="RANGE", help="Frames of a sequence, e.g. 1001-1100x2.  [default: those on disk]"),
    option("--overwrite", is_flag=True, help="Replace outputs that exist."),
    option("--skip-existing", is_flag=True, help="Leave outputs that exist and count them as done."),
    option("--force", is_flag=True, help="Take an input that lbmc itself wrote."),
    option("--model", metavar="PRESET|FILE", help="Preset (see: lbmc models) or a .safetensors file."),
    option(
        "--layers",
        metavar=f"auto|1..{ALL_LAYERS}",
        default="auto",
        show_default=True,
        callback=_layers,
        help="Number of layers.",
    ),
    option(
        "--no-adapt",
        is_flag=True,
        help="Model everything, also what the survey finds the scene does not need.",
    ),
    option(
        "--light",
        type=click.Choice(["held", "free"]),
        default="held",
        show_default=True,
        help="Light of the whole picture: held to that of its samples, or free, for parts of one to be put together.",
    ),
    option(
        "--exposure",
        type=click.FloatRange(0.0, min_open=True),
        help="Scale of the radiance before the network; fixes nothing else.  [default: measured]",
    ),
    option(
        "--exposure-from",
        metavar="FRAME|FILE",
        help="Frame that decides for all: exposure, depth scale, number of layers, roles held.  [default: the first]",
    ),
    option(
        "--aov",
        "aovs",
        multiple=True,
        metavar="NAME",
        help="Also denoise this layer, channel or role of IN, by the beauty's own kernels. Repeatable.",
    ),
    option(
        "--ids",
        multiple=True,
        metavar="NAME",
        help="Also write this id channel of IN with the beauty, as ranked pairs (id, weight) the Cryptomatte way; "
        "export-layers: with --form parts or channels. Repeatable.",
    ),
    reading_options,
)
"""Frames, network and how the input is read."""

machine_options = together(
    option(
        "--pixel-type",
        type=click.Choice(["half", "float"]),
        default="half",
        show_default=True,
        help="Type of the colour channels.",
    ),
    option(
        "--device",
        type=Device(),
        default="auto",
        show_default=True,
        metavar="auto|cpu|cuda:N",
        help="Where the network runs.",
    ),
    THREADS,
    option("--memory", type=ByteSize(), metavar="SIZE", help="Memory budget, e.g. 2GiB."),
    option(
        "--precision",
        type=click.Choice(["auto", "fp32", "bf16", "fp16"]),
        default="auto",
        show_default=True,
        help="Of the matrix products; kernels are always fp32.",
    ),
    option("--dry-run", is_flag=True, help="Show frames, mapping, decisions, tile plan and memory; write nothing."),
    PROGRESS,
)
"""Pixel type, device, threads, memory and how the job reports."""
