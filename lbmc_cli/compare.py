"""`lbmc compare`: an image, or a sequence, against its reference."""

from __future__ import annotations

import json
import sys
from contextlib import nullcontext, redirect_stdout
from typing import Any

import click

from lbmc_cli.options import PROGRESS, LbmcCommand, option
from lbmc_cli.report import end_job


@click.command(cls=LbmcCommand)
@click.argument("image", metavar="IMAGE")
@click.argument("reference", metavar="REFERENCE")
@option(
    "--frames",
    metavar="RANGE",
    help="Frames of a sequence, e.g. 1001-1100x2.  [default: all; if some are not in every sequence, exit code 1]",
)
@option("--part", help="Part of multi-part files, by name or number from 0.  [default: the first with R, G, B]")
@option("--layer", metavar="NAME", help="Layer to measure; files whose only colour is R, G, B are taken as they are.")
@option(
    "--other-half",
    metavar="FILE",
    help="REFERENCE and this are independent halves: also measure free of the reference's own noise.",
)
@option("--json", "as_json", is_flag=True, help="Print JSON.")
@option("--heatmap", "heat_map", metavar="PNG", help="Write the signed relative error as a picture with its scale.")
@option("--panel", metavar="PNG", help="Write image, reference, error and crops of the worst regions.")
@option("--overwrite", is_flag=True, help="Replace pictures that exist.")
@option("--no-flip", is_flag=True, help="Leave FLIP out, the slowest metric.")
@PROGRESS
def compare(as_json: bool, no_flip: bool, **choices: Any) -> int:
    """Measure IMAGE against REFERENCE, two flat EXRs in linear light.

    All metrics but the energy are taken after one common scale, 0.5 / mean(min(reference, its 99th percentile)). Both
    may be sequences (image.####.exr); then a table and the means are printed: geometric ones of relMSE, trimmed and
    small_epsilon (0 where one frame has none of that error), arithmetic ones of the others.
    """
    from pipelines.compare import CompareOptions, compare_frames, comparison_as_dict, comparison_lines

    # in JSON on standard output, the lines of --progress openjd would be no JSON
    with redirect_stdout(sys.stderr) if as_json else nullcontext():
        report = compare_frames(CompareOptions(flip=not no_flip, **choices))
    if as_json:
        click.echo(json.dumps(comparison_as_dict(report), indent=2))
    elif report.values:
        click.echo("\n".join(comparison_lines(report.values)))
    if len(report.frames) > 1 or report.failed or report.left_out:
        return end_job(report)
    return report.exit_code
