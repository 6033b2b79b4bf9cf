"""`lbmc train`: words to a training run."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from lbmc_cli.options import THREAD_COUNT, LbmcCommand, option


@click.command(cls=LbmcCommand)
@click.argument("data", type=click.Path(path_type=Path))
@click.argument("out", type=click.Path(path_type=Path))
@option("--validation", type=click.Path(path_type=Path), required=True, metavar="DIR", help="Held-out scenes.")
@option("--network", metavar="NAME", help="Which network to train.  [default: that of OUT or --start, else fast]")
@option("--recipe", type=click.Path(path_type=Path), metavar="FILE", help="JSON file with fields of the recipe.")
@option("--steps", type=click.IntRange(1), help="Length of the run.  [default: 4000]")
@option("--batch", type=click.IntRange(1), help="Crops a step, of all processes together.  [default: 4]")
@option("--crop", type=click.IntRange(32), help="Pixels along a crop's side.  [default: 128]")
@option("--learning-rate", type=click.FloatRange(0, min_open=True), help="At its highest.  [default: 0.001]")
@option("--seed", type=click.IntRange(0), help="Of everything that is random.  [default: 1]")
@option("--validate-every", type=click.IntRange(1), help="Steps.  [default: 250]")
@option("--set", "words", multiple=True, metavar="NAME=VALUE",
        help="Any field of the recipe, its value as JSON: --set warmup=100 --set loss.smape=1. Repeatable.")
@option("--start", type=click.Path(path_type=Path), metavar="FILE", help="Weights to start from, or a preset's name.")
@option("--cache", type=click.Path(path_type=Path), metavar="DIR",
        help="Where decoded data are kept.  [default: beside each folder of scenes]")
@option("--save-every", type=click.FloatRange(0, min_open=True), default=10.0, show_default=True,
        help="Minutes between checkpoints; there is one at each validation, too.")
@option("--seconds", type=click.FloatRange(0, min_open=True), default=float("inf"),
        help="Stop after this long, resumable; no weights are written then.")
@option("--device", type=click.Choice(["auto", "cpu", "cuda"]), default="auto", show_default=True,
        help="auto: the GPU if there is one.")
@option("--threads", type=THREAD_COUNT, metavar="N", help="CPU threads of each process.")
@option("--loaders", type=THREAD_COUNT, default=1, show_default=True, metavar="N",
        help="Threads of each process that make batches; more for a fast GPU.")
def train(
    data: Path,
    out: Path,
    validation: Path,
    recipe: Path | None,
    words: tuple[str, ...],
    save_every: float,
    steps: int | None,
    batch: int | None,
    crop: int | None,
    learning_rate: float | None,
    seed: int | None,
    validate_every: int | None,
    **choices: Any,
) -> int:
    """Train a network on DATA, a folder of NAME.deep.exr with NAME.ref.exr; OUT gets checkpoints, curves and weights.

    A run that finds its own checkpoint in OUT resumes it. Several processes, with a GPU each where there are GPUs:
    torchrun --standalone --nproc-per-node 2 --no-python -- lbmc train ...
    """
    from pipelines.allocator import keep_freed_memory
    from pipelines.training import job
    from pipelines.training.recipe import Recipe, changed, read_recipe

    fields = {"steps": steps, "batch": batch, "crop": crop, "learning_rate": learning_rate, "seed": seed,
              "validate_every": validate_every}
    given = [f"{name}={value}" for name, value in fields.items() if value is not None]
    whole = changed(Recipe() if recipe is None else read_recipe(recipe), [*given, *words])
    options = job.TrainOptions(data, validation, out, recipe=whole, save_every=60 * save_every, **choices)
    keep_freed_memory()
    job.train(options, click.echo)
    return 0
