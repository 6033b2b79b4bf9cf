"""The training loop: steps, averaged weights, validation, checkpoints that resume to the same curve."""

from __future__ import annotations

import csv
import dataclasses
import json
import math
import os
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from model.config import Config
from model.denoiser import Denoiser
from model.features import FrameScale
from model.losses import EPSILON, smape, total_loss
from pipelines.training.batches import Batch, common_roles, random_batch, to_samples
from pipelines.training.cache import SampleCache, SceneEntry
from pipelines.training.recipe import Recipe

CHECKPOINT = "checkpoint.pt"
CURVE = "curve.csv"
UNIT = FrameScale()  # cached scenes are stored in exposure and depth units
VALIDATION_SAMPLES = 8
PREFETCH = 2  # batches made ahead


def learning_rate(step: int, recipe: Recipe) -> float:
    """Linear warm-up, then a cosine down to `final_rate` of the top."""
    if step < recipe.warmup:
        return recipe.learning_rate * (step + 1) / recipe.warmup
    done = min((step - recipe.warmup) / max(recipe.steps - recipe.warmup, 1), 1.0)
    low = recipe.final_rate
    return recipe.learning_rate * (low + (1 - low) * 0.5 * (1 + math.cos(math.pi * done)))


@dataclasses.dataclass(frozen=True)
class Score:
    """Validation with VALIDATION_SAMPLES samples: geometric mean relMSE, mean SMAPE, spread of the energy ratio."""

    relmse: float
    smape: float
    energy: float  # mean over scenes of |mean(output) / mean(reference) - 1|
    front: float  # mean visible weight of the first layer


@torch.no_grad()
def validate(net: Denoiser, cache: SampleCache, entries: Sequence[SceneEntry]) -> Score:
    """Scores a network on whole scenes, the first VALIDATION_SAMPLES samples of each."""
    errors, smapes, energies, fronts = [], [], [], []
    for entry in entries:
        block, target = cache.arrays(entry)
        count = min(VALIDATION_SAMPLES, entry.samples)
        samples = to_samples([np.asarray(block[:, :, :count]).astype(np.float32)], common_roles([entry]))
        layers = net(samples, UNIT)
        image = layers.beauty() * entry.target_scale
        clean = torch.from_numpy(np.array(target)).permute(2, 0, 1)[None] * entry.target_scale
        errors.append(float(((image - clean) ** 2 / (clean**2 + EPSILON)).mean()))
        smapes.append(float(smape(image, clean)))
        energies.append(abs(float(image.mean() / clean.mean()) - 1))
        fronts.append(float(layers.weight[:, 0].mean()))
    return Score(
        math.exp(float(np.mean(np.log(errors)))), float(np.mean(smapes)), float(np.mean(energies)),
        float(np.mean(fronts)),
    )


class Trainer:
    """One run in one folder: `run()` continues from the folder's checkpoint if there is one.

    Every batch depends on the seed and the step alone, so a resumed run repeats the uninterrupted one.
    """

    def __init__(self, config: Config, recipe: Recipe, folder: Path, start: dict[str, Tensor] | None = None) -> None:
        torch.manual_seed(recipe.seed)
        self.recipe, self.folder = recipe, folder
        self.net = Denoiser(config).set_product_dtype(torch.bfloat16 if recipe.bfloat16 else None)
        if start is not None:
            self.net.load_state_dict(start)
        self.averaged = Denoiser(config)
        self.averaged.load_state_dict(self.net.state_dict())
        self.optimizer = torch.optim.Adam(self.net.parameters(), lr=recipe.learning_rate, betas=(0.9, 0.99))
        self.step = 0
        self.rows: list[dict[str, float]] = []
        folder.mkdir(parents=True, exist_ok=True)
        if (folder / CHECKPOINT).exists():
            self._restore(torch.load(folder / CHECKPOINT, weights_only=True))

    def _restore(self, state: dict[str, Any]) -> None:
        self.net.load_state_dict(state["net"])
        self.averaged.load_state_dict(state["averaged"])
        self.optimizer.load_state_dict(state["optimizer"])
        self.step, self.rows = state["step"], state["rows"]

    def save(self) -> None:
        """Writes the checkpoint and the curve, each whole or not at all."""
        state = {
            "net": self.net.state_dict(),
            "averaged": self.averaged.state_dict(),
            "optimizer": self.optimizer.state_dict(),
            "step": self.step,
            "rows": self.rows,
            "config": json.dumps(self.net.config.to_dict()),
            "recipe": json.dumps(dataclasses.asdict(self.recipe)),
        }
        temporary = self.folder / f"{CHECKPOINT}.part"
        torch.save(state, temporary)
        os.replace(temporary, self.folder / CHECKPOINT)
        if self.rows:
            with (self.folder / CURVE).open("w", newline="") as file:
                writer = csv.DictWriter(file, fieldnames=list(self.rows[0]))
                writer.writeheader()
                writer.writerows(self.rows)

    def run(
        self,
        cache: SampleCache,
        validation: SampleCache,
        report: Callable[[str], None] = print,
        seconds: float = math.inf,
    ) -> None:
        """Trains until `recipe.steps` or for `seconds`, validating and saving every `validate_every` steps.

        A KeyboardInterrupt leaves a checkpoint of the last finished step.
        """
        begun = time.monotonic()
        losses: list[float] = []
        with ThreadPoolExecutor(1) as pool:
            def ask(step: int) -> Any:
                return pool.submit(random_batch, cache, cache.entries, self.recipe, (self.recipe.seed, step))

            pending = [ask(self.step + k) for k in range(PREFETCH)]
            try:
                while self.step < self.recipe.steps and time.monotonic() - begun < seconds:
                    batch = pending.pop(0).result()
                    pending.append(ask(self.step + PREFETCH))
                    losses.append(self.update(batch))
                    self.step += 1
                    if self.step % self.recipe.validate_every == 0 or self.step == self.recipe.steps:
                        self._log(losses, validation, time.monotonic() - begun, report)
                        losses = []
                        self.save()
            finally:
                for future in pending:
                    future.cancel()
                self.save()

    def _log(self, losses: list[float], validation: SampleCache, elapsed: float,
             report: Callable[[str], None]) -> None:
        score = validate(self.averaged, validation, validation.entries)
        row = {"step": float(self.step), "loss": float(np.mean(losses)), **dataclasses.asdict(score)}
        self.rows.append(row)
        report(f"step {self.step}  loss {row['loss']:.4f}  relMSE {score.relmse:.5f}  SMAPE {score.smape:.5f}  "
               f"energy off {score.energy:.4f}  front {score.front:.2f}  {elapsed:.0f} s")

    def update(self, batch: Batch) -> float:
        """One step; returns its loss."""
        recipe = self.recipe
        rate = learning_rate(self.step, recipe)
        for group in self.optimizer.param_groups:
            group["lr"] = rate
        layers = self.net(batch.samples, UNIT, batch.layers)
        scale = batch.scale[:, None, None, None]
        loss = total_loss(layers.beauty() * scale, batch.target * scale, recipe.loss)
        guard = recipe.partition_entropy * max(0.0, 1 - 3 * self.step / recipe.steps)
        if guard > 0 and batch.layers > 1:
            share = layers.weight.mean((2, 3)).clamp_min(1e-6)  # (B, L): a layer that is never used is lost
            loss = loss + guard * (share * share.log()).sum(1).mean()
        self.optimizer.zero_grad(set_to_none=True)
        loss.backward()
        norm = torch.nn.utils.clip_grad_norm_(self.net.parameters(), recipe.clip)
        if bool(torch.isfinite(norm)):
            self.optimizer.step()
        keep = min(recipe.average, (1 + self.step) / (10 + self.step))
        with torch.no_grad():
            for mine, theirs in zip(self.averaged.parameters(), self.net.parameters(), strict=True):
                mine.lerp_(theirs, 1 - keep)
        return float(loss.detach())
