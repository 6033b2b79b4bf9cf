"""`lbmc bench`: speed against error on a folder of scenes."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from lbmc_cli.options import PROGRESS, THREAD_COUNT, LbmcCommand, option


@click.command(cls=LbmcCommand)
@click.argument("folder", metavar="DIR", type=click.Path(path_type=Path))
@option(
    "--out",
    type=click.Path(path_type=Path),
    default="bench",
    show_default=True,
    metavar="FOLDER",
    help="Where results.json, results.md and report.html go; made if need be.",
)
@option(
    "--model",
    "models",
    multiple=True,
    metavar="PRESET|FILE",
    help="Preset or .safetensors file to measure. Repeatable.  [default: the presets that ship]",
)
@option("--match", default="*", show_default=True, metavar="GLOB", help="Only scenes whose NAME matches.")
@option("--threads", type=THREAD_COUNT, default=1, show_default=True, metavar="N", help="CPU threads.")
@option("--repeats", type=click.IntRange(1), default=3, show_default=True, help="Timed runs of each method and scene.")
@option(
    "--frame",
    type=click.IntRange(0),
    default=512,
    show_default=True,
    metavar="PIXELS",
    help="Side of the frames that are timed, scenes repeated to that size; 0: every scene as it is.",
)
@option("--no-paper", is_flag=True, help="Leave the paper's networks out (they have no weights, only a time).")
@option("--no-curves", is_flag=True, help="Leave the error at fewer samples per pixel out.")
@option("--no-savings", is_flag=True, help="Leave out what each saving saves and costs.")
@option(
    "--contexts",
    nargs=2,
    metavar="FULL HALF",
    help="Two weight files that differ in the resolution of the context alone: one more row among the savings.",
)
@option("--no-memory", is_flag=True, help="Leave peak memory out, for which each method runs in a new process.")
@option("--no-flip", is_flag=True, help="Leave FLIP out, the slowest metric.")
@option("--overwrite", is_flag=True, help="Replace results that exist.")
@PROGRESS
def bench(
    no_paper: bool, no_curves: bool, no_savings: bool, no_memory: bool, no_flip: bool, **choices: Any
) -> int:
    """Measure speed against error on DIR, a folder of NAME.deep.exr and NAME.ref.exr.

    lbmc, untrained filters, Intel OIDN where pyoidn is installed, and the paper's networks (random weights, so their
    time only) run on every scene. report.html is one page with charts, tables and all images; it needs no network.

    Where NAME.ref2.exr is there too, it and NAME.ref.exr are independent halves: the reference is their mean, and
    relMSE is also given free of its noise, beside the floor that this noise sets.

    Scenes that cannot be read, and what a method cannot do on one scene, are left out: the rest is measured, and the
    exit code is 1.
    """
    from pipelines.bench.job import REPORT, TABLE
    from pipelines.bench.job import bench as run
    from pipelines.bench.options import BenchOptions
    from pipelines.jobs import EXIT_OK, EXIT_SOME_FAILED

    options = BenchOptions(
        paper=not no_paper,
        curves=not no_curves,
        savings=not no_savings,
        memory=not no_memory,
        flip=not no_flip,
        **choices,
    )
    results = run(options)
    click.echo((options.out / TABLE).read_text("utf-8"))
    click.echo(f"report: {options.out / REPORT}", err=True)
    missing = results.missing()
    if not missing:
        return EXIT_OK
    click.echo("failed:", err=True)
    for name, why in missing.items():
        click.echo(f"  {name}: {why}", err=True)
    return EXIT_SOME_FAILED
