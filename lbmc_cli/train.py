"""`lbmc train`: words to a training run."""

from __future__ import annotations

from pathlib import Path

import click

from lbmc_cli.options import LbmcCommand, option


@click.command(cls=LbmcCommand)
@click.argument("data", type=click.Path(path_type=Path))
@click.argument("out", type=click.Path(path_type=Path))
@option("--validation", type=click.Path(path_type=Path), required=True, metavar="DIR", help="Held-out scenes.")
@option("--network", default="fast", show_default=True, help="Which network to train.")
@option("--steps", type=click.IntRange(1), default=4000, show_default=True, help="Length of the run.")
@option("--batch", type=click.IntRange(1), default=4, show_default=True, help="Crops a step.")
@option("--crop", type=click.IntRange(32), default=128, show_default=True, help="Pixels along a crop's side.")
@option("--learning-rate", type=click.FloatRange(0, min_open=True), default=1e-3, show_default=True)
@option("--seed", type=int, default=1, show_default=True)
@option("--validate-every", type=click.IntRange(1), default=250, show_default=True, help="Steps.")
@option("--start", type=click.Path(path_type=Path), metavar="FILE", help="Weights to start from.")
@option("--seconds", type=click.FloatRange(0, min_open=True), default=float("inf"), help="Stop after this long.")
@option("--threads", type=click.IntRange(1), metavar="N", help="CPU threads.")
def train(
    data: Path,
    out: Path,
    validation: Path,
    network: str,
    steps: int,
    batch: int,
    crop: int,
    learning_rate: float,
    seed: int,
    validate_every: int,
    start: Path | None,
    seconds: float,
    threads: int | None,
) -> int:
    """Train a network on DATA, a folder of NAME.deep.exr with NAME.ref.exr; OUT gets checkpoints, curve and weights.

    A run that finds its own checkpoint in OUT resumes it.
    """
    from pipelines.allocator import keep_freed_memory
    from pipelines.training import job
    from pipelines.training.recipe import Recipe

    recipe = Recipe(
        steps=steps, batch=batch, crop=crop, learning_rate=learning_rate, seed=seed, validate_every=validate_every
    )
    keep_freed_memory()
    path = job.train(data, validation, out, network, recipe, start, threads, seconds, click.echo)
    click.echo(f"wrote {path}")
    return 0
