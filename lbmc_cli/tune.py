"""`lbmc tune`: words to TuneOptions."""

from __future__ import annotations

from typing import Any

import click

from lbmc_cli.options import PROGRESS, THREADS, Device, LbmcCommand, build_options, option, reading_options
from lbmc_cli.report import existing_choice
from pipelines.options import DenoiseOptions
from pipelines.tuning.options import MOST_FRAMES, TuneOptions


@click.command(cls=LbmcCommand)
@click.argument("source", metavar="IN")
@click.argument("target", metavar="OUT")
@option("--frames", metavar="RANGE", help="Frames of a sequence, e.g. 1001-1100x2.  [default: those on disk]")
@option("--overwrite", is_flag=True, help="Replace OUT if it exists.")
@option("--skip-existing", is_flag=True, help="Leave OUT if it exists.")
@option("--force", is_flag=True, help="Take an input that lbmc itself wrote.")
@option("--model", metavar="PRESET|FILE", help="Weights to start from: a preset (see: lbmc models) or a file.")
@option("--steps", type=click.IntRange(1),
        help="Steps of gradient descent.  [default: 32 on one crop, up to 96 on many]")
@option("--most-frames", type=click.IntRange(1), default=MOST_FRAMES, show_default=True, metavar="N",
        help="Frames that are looked at, evenly spread over the sequence.")
@option("--seed", type=click.IntRange(0), default=1, show_default=True, help="Of everything that is drawn.")
@option("--exposure", type=click.FloatRange(0.0, min_open=True), help="As for denoise.  [default: measured]")
@option("--exposure-from", metavar="FRAME|FILE", help="As for denoise.  [default: the first]")
@reading_options
@option("--device", type=Device(), default="auto", show_default=True, metavar="auto|cpu|cuda:N",
        help="Where the network runs.")
@THREADS
@PROGRESS
def tune(overwrite: bool, skip_existing: bool, steps: int | None, most_frames: int, seed: int, progress: Any,
         **choices: Any) -> int:
    """Fit weights to IN, a deep EXR of path samples or a sequence of them, and write them to OUT, a .safetensors file.

    No reference is needed: half of the samples is denoised and held against the other half. Then:
    lbmc denoise --model OUT ... for all frames of the shot.
    """
    reading = build_options(DenoiseOptions, **choices)
    options = build_options(TuneOptions, reading=reading, existing=existing_choice(overwrite, skip_existing),
                            steps=steps, most_frames=most_frames, seed=seed, progress=progress)
    from pipelines.frames import find_sources

    frames = find_sources(reading)  # a missing input is said at once, not after the import of torch
    from pipelines.allocator import keep_freed_memory
    from pipelines.tuning.job import tune as fit

    keep_freed_memory()
    done = fit(options, frames)
    if done is None:
        click.echo(f"{reading.target}: exists, skipped", err=True)
    else:
        click.echo(f"wrote {done.path}; steps: {done.steps}, crops: {done.crops}, frames: {done.frames}", err=True)
    return 0
