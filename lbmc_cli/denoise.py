"""`lbmc denoise`: words to DenoiseOptions."""

from __future__ import annotations

from typing import Any

import click

from lbmc_cli.job_options import job_choices, job_options, machine_options
from lbmc_cli.options import LbmcCommand, build_options, option
from lbmc_cli.report import end_job
from pipelines.options import COMPRESSIONS, DenoiseOptions


@click.command(cls=LbmcCommand)
@click.argument("source", metavar="IN")
@click.argument("target", metavar="OUT")
@job_options
@option(
    "--keep",
    "keep",
    multiple=True,
    metavar="NAME",
    help="Also write this channel or layer of IN, averaged per pixel; globs work. Repeatable.",
)
@option("--compression", type=click.Choice(COMPRESSIONS), default="zip", show_default=True, help="Compression of OUT.")
@machine_options
def denoise(**choices: Any) -> int:
    """Denoise IN, a deep EXR whose samples are path samples, to the flat EXR OUT.

    IN and OUT may be sequences: shot.####.exr, shot.%04d.exr, shot.$F4.exr. Exit codes: 0 done, 1 some frames failed,
    2 usage or refused output, 3 IN unreadable or unsuitable, or a frame of --frames missing (then none is written).
    """
    options = build_options(DenoiseOptions, **job_choices(**choices))
    from pipelines.frames import find_frames

    frames = find_frames(options)  # a missing input is said at once, not after the import of torch
    from pipelines.allocator import keep_freed_memory
    from pipelines.denoise import denoise_frames

    keep_freed_memory()
    return end_job(denoise_frames(options, frames))
