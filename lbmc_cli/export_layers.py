"""`lbmc export-layers`: words to ExportOptions."""

from __future__ import annotations

from typing import Any

import click

from lbmc_cli.job_options import job_choices, job_options, machine_options
from lbmc_cli.options import LbmcCommand, build_options, option
from lbmc_cli.report import end_job
from pipelines.export_options import FORMS, ExportOptions
from pipelines.options import COMPRESSIONS


@click.command("export-layers", cls=LbmcCommand)
@click.argument("source", metavar="IN")
@click.argument("target", metavar="OUT")
@option(
    "--form",
    type=click.Choice(FORMS),
    default="deep",
    show_default=True,
    help="deep: one sample per layer, for deep compositing; parts: a multi-part EXR of the beauty and the layers; "
    "channels: the beauty with channels layer0.R ...; files: OUT.layer0.####.exr ...",
)
@option(
    "--contributions",
    is_flag=True,
    help="Flat forms: what each layer adds to the beauty, to be summed, not composited by over.",
)
@option(
    "--samples",
    is_flag=True,
    help="Instead of layers, copy the samples of IN with each one's share in every layer: layer0.weight ... Goes with "
    "none of --form, --contributions, --aov and --ids.",
)
@job_options
@option(
    "--compression",
    type=click.Choice(COMPRESSIONS),
    default="zips",
    show_default=True,
    help="Compression of OUT; deep: none, rle or zips.",
)
@machine_options
def export_layers(**choices: Any) -> int:
    """Write the layers that IN, a deep EXR whose samples are path samples, is denoised to.

    Composited by over, front to back, they give the denoised beauty and its alpha. IN and OUT may be sequences. Exit
    codes are those of denoise.
    """
    options = build_options(ExportOptions, **job_choices(**choices))
    from pipelines.frames import find_frames

    frames = find_frames(options)  # a missing input is said at once, not after the import of torch
    from pipelines.allocator import keep_freed_memory
    from pipelines.export import export_frames

    keep_freed_memory()
    return end_job(export_frames(options, frames))
