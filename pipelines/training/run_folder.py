"""The folder of one run: its checkpoint, recipe, curve, pictures and weights, each written whole or not at all.

    recipe.json        the whole recipe; `lbmc train --recipe` takes it
    checkpoint.pt      weights, their average, the optimizer's moments, the curve so far
    curve.csv          one row a validation; curve.png shows it
    panels/            stepNNNNNN.png, some validation scenes
    PRESET.safetensors the averaged weights, once the run ends
"""

from __future__ import annotations

import csv
import json
import os
import pickle
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, field
from pathlib import Path
from tempfile import TemporaryFile
from typing import Any

import torch

from deep_io.atomic import atomic_output
from deep_io.errors import InputError, UsageError
from model import zoo
from model.config import Config
from model.denoiser import Denoiser
from pipelines.training.drawing import can_draw, curve_png, panel_png
from pipelines.training.optimizer import Optimizer
from pipelines.training.recipe import Recipe, differences
from pipelines.training.validation import Shown

CHECKPOINT, RECIPE, CURVE, CURVE_PICTURE, PANELS = "checkpoint.pt", "recipe.json", "curve.csv", "curve.png", "panels"


@dataclass
class State:
    """Where a run is: steps done, the curve's rows, and the losses of the steps since the last of them."""

    step: int = 0
    rows: list[dict[str, float]] = field(default_factory=list)
    losses: list[float] = field(default_factory=list)


@dataclass(frozen=True)
class Checkpoint:
    """What a checkpoint holds: network and recipe, the state, and the state dicts of network, average and optimizer."""

    config: Config
    recipe: dict[str, Any]
    state: State
    net: dict[str, Any]
    averaged: dict[str, Any]
    optimizer: dict[str, Any]


def read_checkpoint(folder: Path, device: torch.device) -> Checkpoint | None:
    """The checkpoint of a run's folder, if there is one. Raises InputError where it is broken, UsageError for a file in
    the folder's place."""
    path = folder / CHECKPOINT
    # os.path takes what cannot even be asked for as absent; require_room says why
    if os.path.exists(folder) and not os.path.isdir(folder):
        raise UsageError(f"{folder}: is a file; name a folder for the run")
    if not os.path.exists(path):
        return None
    try:
        data = torch.load(path, map_location=device, weights_only=True)
        return Checkpoint(Config.from_dict(json.loads(data["config"])), json.loads(data["recipe"]),
                          State(data["step"], data["rows"], data["losses"]), data["net"], data["averaged"],
                          data["optimizer"])
    except (OSError, RuntimeError, EOFError, KeyError, ValueError, TypeError, pickle.UnpicklingError) as error:
        raise InputError(f"{path}: not a checkpoint of this lbmc ({type(error).__name__}); train into another "
                         f"folder") from None


class RunFolder:
    """The files of one run of one network by one recipe. The folder need not exist until something is written."""

    def __init__(self, folder: Path, config: Config, recipe: Recipe) -> None:
        self.folder, self.config, self.recipe = folder, config, recipe

    def read(self, device: torch.device) -> Checkpoint | None:
        """The folder's checkpoint, if there is one.

        Raises InputError where it is broken, UsageError where it is of another network or recipe.
        """
        found = read_checkpoint(self.folder, device)
        if found is None:
            return None
        path = self.folder / CHECKPOINT
        changed = list(differences(self.config.to_dict(), found.config.to_dict()))
        if changed:
            raise UsageError(f"{path}: its network, {found.config.name!r}, differs from the {self.config.name!r} of "
                             f"--network in {', '.join(changed)}; train into another folder, or go on without "
                             f"--network")
        # a field that a recipe does not name, since lbmc had it later, has its default
        changed = list(differences(self.recipe.to_dict(), {**Recipe().to_dict(), **found.recipe}))
        if changed:
            raise UsageError(f"{path}: was made by another recipe (differs in {', '.join(changed)}); train into "
                             f"another folder, or go on with --recipe {self.folder / RECIPE}")
        return found

    def require_room(self) -> None:
        """Makes the folder, writes into it, and takes both back. Raises InputError where that cannot be done."""
        missing = [folder for folder in (self.folder, *self.folder.parents) if not os.path.exists(folder)]
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
            with TemporaryFile(dir=self.folder):
                pass
        except OSError as error:
            raise InputError(f"{self.folder}: cannot be written to ({error.strerror}); name another folder for the "
                             f"run") from None
        finally:
            for folder in missing:
                with suppress(OSError):
                    folder.rmdir()

    def write(self, state: State, net: Denoiser, averaged: Denoiser, optimizer: Optimizer) -> None:
        """Recipe, checkpoint and curve."""
        self.folder.mkdir(parents=True, exist_ok=True)
        with atomic_output(self.folder / RECIPE) as path:
            path.write_text(json.dumps(self.recipe.to_dict(), indent=1) + "\n", "utf-8")
        with atomic_output(self.folder / CHECKPOINT) as path:
            torch.save({
                "net": net.state_dict(),
                "averaged": averaged.state_dict(),
                "optimizer": optimizer.state_dict(),
                **asdict(state),
                "config": json.dumps(self.config.to_dict()),
                "recipe": json.dumps(self.recipe.to_dict()),
            }, path)
        if state.rows:
            with atomic_output(self.folder / CURVE) as path, path.open("w", newline="") as file:
                writer = csv.DictWriter(file, fieldnames=list(state.rows[0]))
                writer.writeheader()
                writer.writerows(state.rows)

    def draw(self, state: State, shown: Sequence[Shown]) -> None:
        """The picture of the curve and a panel of this step's validation; nothing where they cannot be drawn."""
        if not can_draw():
            return
        with atomic_output(self.folder / CURVE_PICTURE) as path:
            path.write_bytes(curve_png(state.rows))
        (self.folder / PANELS).mkdir(exist_ok=True)
        with atomic_output(self.folder / PANELS / f"step{state.step:06d}.png") as path:
            path.write_bytes(panel_png(shown, state.step))

    def write_weights(self, target: Path, averaged: Denoiser, info: dict[str, Any]) -> None:
        """The averaged weights as a weight file that `--model` takes."""
        with atomic_output(target) as path:
            zoo.save(averaged, path, info)
