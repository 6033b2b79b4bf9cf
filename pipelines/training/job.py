"""`lbmc train` as a function: checks and caches the data, trains or resumes, writes the averaged weights."""

from __future__ import annotations

import math
import os
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import torch
from torch import Tensor

from deep_io.errors import InputError, UsageError
from model import zoo
from model.config import CONFIGS, FAST, Config
from model.denoiser import Denoiser
from model.widening import widened
from pipelines.training.batches import crop_size
from pipelines.training.cache import CACHE_VERSION, SampleCache
from pipelines.training.caching import build_cache, scene_files
from pipelines.training.drawing import can_draw
from pipelines.training.group import Group, joined
from pipelines.training.loop import Trainer
from pipelines.training.optimizer import hold_all_but
from pipelines.training.recipe import Recipe, differences
from pipelines.training.run_folder import RunFolder, read_checkpoint

FEWEST_SCENES, FEWEST_VALIDATION_SCENES = 2, 1


@dataclass(frozen=True)
class TrainOptions:
    """What to train on what, and how; only the recipe and the network change the weights.

    data, validation : folders of NAME.deep.exr with NAME.ref.exr
    out : folder of the run, see run_folder.py; a checkpoint in it is resumed
    network : a name of model.config.CONFIGS; None: that of the checkpoint, or of `start`, or fast
    start : weight file, or a preset's name, to start from instead of random weights; of no use to a run that resumes
    cache : folder for the decoded data; None: beside each data folder, see cache_beside
    device : auto, cpu or cuda
    threads : of each process; None leaves PyTorch's choice
    loaders : threads of each process that make batches
    seconds : stop after so long, resumable
    save_every : seconds between checkpoints; there is one at every validation, too
    """

    data: Path
    validation: Path
    out: Path
    network: str | None = None
    recipe: Recipe = field(default_factory=Recipe)
    start: Path | None = None
    cache: Path | None = None
    device: str = "auto"
    threads: int | None = None
    loaders: int = 1
    seconds: float = math.inf
    save_every: float = 600.0


def train(options: TrainOptions, report: Callable[[str], None] = print) -> Path | None:
    """Trains and returns the path of the weight file, None where `seconds` ended the run before its last step; under
    torchrun, one of its processes.

    Raises InputError and UsageError, naming the file, for data, weights and checkpoints that cannot be used, before
    training starts; StoppedError after SIGINT and SIGTERM, with a checkpoint written.
    """
    if options.threads is not None:
        torch.set_num_threads(options.threads)
    with joined(options.device) as group:
        return _train(options, group, report)


def _train(options: TrainOptions, group: Group, report: Callable[[str], None]) -> Path | None:
    """One process's part. A function of its own: what holds on to the group is gone before the group is."""
    recipe = options.recipe

    def say(text: str) -> None:
        if group.leads:
            report(text)

    group.first(lambda: _prepare(options, group, say))
    training, held_out = (SampleCache(folder) for folder in cache_folders(options))
    config = network_of(options)
    start = starting_weights(options.start, config, options.recipe.seed) if options.start is not None else None
    trainer = Trainer(config, recipe, options.out, start, group)
    say(f"{len(training.entries)} scenes, {len(held_out.entries)} held out, crops of "
        f"{crop_size(training.entries, recipe)} pixels, {group.size} process{'es'[:2 * (group.size > 1)]} on "
        f"{group.device.type}, from step {trainer.step}")
    trainer.run(training, held_out, say, options.seconds, options.save_every, options.loaders)
    if trainer.step < recipe.steps:
        say(f"stopped at step {trainer.step} of {recipe.steps}; the same command goes on")
        return None
    info = {
        "description": f"{config.name}, trained by lbmc train",
        "data": {"scenes": len(training.entries), "validation": len(held_out.entries)},
        "recipe": recipe.to_dict(),
        "steps": trainer.step,
        "scores": trainer.state.rows[-1] if trainer.state.rows else {},
    }
    path = options.out / f"{config.name}{zoo.SUFFIX}"
    group.first(lambda: trainer.folder.write_weights(path, trainer.averaged, info))
    say(f"wrote {path}")
    return path


def _prepare(options: TrainOptions, group: Group, report: Callable[[str], None]) -> None:
    """Everything that can be refused, cheapest first; then the caches."""
    config = network_of(options)
    if options.recipe.batch < group.size:
        raise UsageError(f"a batch of {options.recipe.batch} crops for {group.size} processes; raise --batch or start "
                         f"fewer")
    scene_files(options.data, FEWEST_SCENES)
    scene_files(options.validation, FEWEST_VALIDATION_SCENES)
    if os.path.samefile(options.data, options.validation):
        raise InputError(f"{options.validation}: is the training folder itself; scenes that were trained on say "
                         f"nothing about others, so name a folder of other scenes")
    if options.start is not None:
        starting_weights(options.start, config)
    elif options.recipe.hold_layers:
        raise UsageError("the recipe's hold_layers: holds the layers of weights that training starts from; name them "
                         "with --start, also to resume")
    if options.recipe.only is not None:
        with torch.device("meta"):
            hold_all_but(Denoiser(config), options.recipe.only)
    folder = RunFolder(options.out, config, options.recipe)
    if folder.read(torch.device("cpu")) is None and options.start is None and options.recipe.only is not None:
        raise UsageError(f"the recipe's only: trains the {options.recipe.only} of a network whose other parts are "
                         f"trained; name its weights with --start")
    folder.require_room()
    if not can_draw():
        report("curve.png and panels are not drawn: install lbmc with its extra 'train'")
    for source, cache in zip((options.data, options.validation), cache_folders(options), strict=True):
        build_cache(source, cache, report, options.threads)


def cache_folders(options: TrainOptions) -> tuple[Path, Path]:
    """Where the decoded training and validation data are kept."""
    if options.cache is not None:
        return options.cache / "training", options.cache / "validation"
    return cache_beside(options.data), cache_beside(options.validation)


def cache_beside(source: Path) -> Path:
    """The cache of a folder of scenes; versions of lbmc with other layouts do not share one."""
    whole = source.resolve()
    return whole.with_name(f"{whole.name}.cache-{CACHE_VERSION}")


def open_cache(source: Path, report: Callable[[str], None]) -> SampleCache:
    """The cache beside a folder of scenes, brought up to date. Raises InputError, see `build_cache`."""
    return build_cache(source, cache_beside(source), report)


def network_of(options: TrainOptions) -> Config:
    """The network to train. Raises UsageError where there is none of that name, or no weights to take it from, and what
    `read_checkpoint` does."""
    if options.network is None:
        found = read_checkpoint(options.out, torch.device("cpu"))
        if found is not None:
            return found.config
        return FAST if options.start is None else _found(options.start).config
    if options.network not in CONFIGS:
        raise UsageError(f"--network {options.network}: there are {', '.join(CONFIGS)}")
    return CONFIGS[options.network]


def starting_weights(path: Path, config: Config, seed: int = 1) -> dict[str, Tensor]:
    """The weights of a file, widened if `config` has more channels; `seed` is of what those start with.

    Raises UsageError where it is no weight file, or of a network that `config` does not contain.
    """
    weights = _found(path)
    changed = [name for name in differences(config.to_dict(), weights.config.to_dict()) if name != "name"]
    try:
        net = weights.load()
        if changed:
            with torch.random.fork_rng(devices=[]):
                torch.manual_seed(seed)
                net = widened(net, config)
    except ValueError as error:
        if not changed:
            raise UsageError(f"--start: {error}") from None
        raise UsageError(f"--start: {path}: its network, {weights.config.name!r}, differs from the {config.name!r} to "
                         f"be trained in {', '.join(changed)}, and is no narrower one of its kind ({error}); without "
                         f"--network, into a new folder, the file's is trained") from None
    return net.state_dict()


def _found(path: Path) -> zoo.Weights:
    try:
        return zoo.find(str(path))
    except (ValueError, KeyError, TypeError) as error:
        raise UsageError(f"--start: {error}") from None
