"""`lbmc pack`: one-sample renders to a deep sample file."""

from __future__ import annotations

from typing import Any

import click

from lbmc_cli.options import PROGRESS, THREADS, LbmcCommand, mapping_options, option
from lbmc_cli.report import end_job, existing_choice


@click.command(cls=LbmcCommand)
@click.argument("renders", metavar="FRAMES...", nargs=-1, required=True)
@click.argument("target", metavar="OUT")
@option("--seeds", metavar="RANGE", help="Seeds to put in place of @SEED@ in the one name given, e.g. 1-8.")
@option("--frames", metavar="RANGE", help="Frames of a sequence, e.g. 1001-1100x2.  [default: those on disk]")
@option("--overwrite", is_flag=True, help="Replace outputs that exist.")
@option("--skip-existing", is_flag=True, help="Leave outputs that exist and count them as done.")
@option("--layer", "layers", multiple=True, metavar="NAME",
        help="Also carry this light or lobe layer, beside the roles. Repeatable.")
@mapping_options
@option(
    "--pixel-type",
    type=click.Choice(["half", "float"]),
    default="half",
    show_default=True,
    help="Type of the channels; depth and alpha are always float.",
)
@option(
    "--compression",
    type=click.Choice(["none", "rle", "zips"]),
    default="zips",
    show_default=True,
    help="Compression of OUT.",
)
@THREADS
@PROGRESS
def pack(
    renders: tuple[str, ...],
    target: str,
    seeds: str | None,
    frames: str | None,
    overwrite: bool,
    skip_existing: bool,
    progress: Any,
    **choices: Any,
) -> int:
    """Pack flat one-sample renders of a frame, each with another seed, into one deep sample file.

    Any deep reader flattens OUT to the mean of the renders; lbmc denoises it. For sequences give one pattern per seed,
    or one name for all: lbmc pack --seeds 1-8 'shot.s@SEED@.####.exr' shot.####.exr
    """
    existing = existing_choice(overwrite, skip_existing)
    from pipelines.pack import PackOptions, pack_frames, plan

    jobs = plan(renders, target, seeds, frames)
    return end_job(pack_frames(jobs, PackOptions(existing=existing, **choices), progress))
