"""The training loop: steps, averaged weights, validation, and when to save. One process, or a group of them."""

from __future__ import annotations

import copy
import dataclasses
import math
import time
from collections import deque
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from itertools import islice
from pathlib import Path

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor, nn

from deep_io.errors import LbmcError
from model.compositing import Layers
from model.config import Config
from model.denoiser import Denoiser
from model.losses import total_loss
from pipelines.signals import StoppedError, signals_noted
from pipelines.training.batches import Batch, random_batch
from pipelines.training.cache import SampleCache
from pipelines.training.group import ALONE, Group
from pipelines.training.optimizer import hold_all_but, make_optimizer
from pipelines.training.recipe import Recipe
from pipelines.training.run_folder import RunFolder, State
from pipelines.training.validation import UNIT, validate

TIME_IS_UP = 1  # below the numbers of the signals that end a run
GUARDED = 1 / 3  # of the run, in which the guard against a collapsed partition fades
ORDER_MARGIN = 0.02  # log units of depth by which a layer should be behind the one in front of it
HELD_CELL = 8  # pixels: what a layer covers of so much is held, its edges may become better
HOPELESS = 40  # steps in a row whose gradient is not finite: the weights have diverged, and would not change again

Report = Callable[[str], None]


def learning_rate(step: int, recipe: Recipe) -> float:
    """Linear warm-up, then a cosine down to `final_rate` of the top."""
    if step < recipe.warmup:
        return recipe.learning_rate * (step + 1) / recipe.warmup
    done = min((step - recipe.warmup) / max(recipe.steps - recipe.warmup, 1), 1.0)
    low = recipe.final_rate
    return recipe.learning_rate * (low + (1 - low) * 0.5 * (1 + math.cos(math.pi * done)))


def disorder(layers: Layers) -> Tensor:
    """How far layers lie behind those that should be behind them: log units of depth, times the lesser coverage of the
    two, mean over pixels and pairs of neighbours. Layers without hits are in nobody's way, and where hits are few they
    count little: else the derivative, which divides by the coverage, would have no bound.
    """
    known = layers.depth.isfinite() & (layers.depth > 0)
    zeta = torch.log(torch.where(known, layers.depth, 1))
    wrong = (zeta[:, :-1] - zeta[:, 1:] + ORDER_MARGIN).clamp_min(0) * (known[:, :-1] & known[:, 1:])
    return (torch.minimum(layers.coverage[:, :-1], layers.coverage[:, 1:]) * wrong).mean()


def displacement(layers: Layers, before: Layers) -> Tensor:
    """How much of the visible weight is in other layers than before: 0 to 1, over cells of HELD_CELL pixels."""
    moved = F.avg_pool2d(layers.weight - before.weight, min(HELD_CELL, *layers.weight.shape[-2:]))
    return moved.abs().sum(1).mean() / 2


class Objective(nn.Module):
    """What a step minimises, as a module, so that DistributedDataParallel sees every parameter used.

    before : the network whose layers are held, by `recipe.hold_layers`
    """

    def __init__(self, net: Denoiser, recipe: Recipe, before: Denoiser | None = None) -> None:
        super().__init__()
        self.net, self.recipe = net, recipe
        self.before = None if before is None else before.requires_grad_(False)

    def forward(self, batch: Batch, step: int) -> Tensor:
        """The mean loss of the batch's crops, a scalar."""
        wanted = min(batch.layers, self.net.config.partition_logits)
        layers = self.net(batch.samples, UNIT, wanted)
        scale = batch.scale[:, None, None, None]
        loss = total_loss(layers.beauty() * scale, batch.target * scale, self.recipe.loss_at(step))
        guard = self.recipe.partition_entropy * max(0.0, 1 - step / (GUARDED * self.recipe.steps))
        if guard > 0 and wanted > 1:
            share = layers.weight.mean((2, 3)).clamp_min(1e-6)  # (B, L): a layer that is never used is lost
            loss = loss + guard * (share * share.log()).sum(1).mean()
        if self.recipe.depth_order and wanted > 1 and "depth" in batch.samples.roles:
            loss = loss + self.recipe.depth_order * disorder(layers)
        if self.before is not None and wanted > 1:
            with torch.no_grad():
                before = self.before(batch.samples, UNIT, wanted)
            loss = loss + self.recipe.hold_layers * displacement(layers, before)
        # processes must agree on which parameters have a gradient: all have one, if only 0
        return loss + 0 * torch.stack([p.sum() for p in self.net.parameters() if p.requires_grad]).sum()


class Trainer:
    """One run in one folder: `run()` continues from the folder's checkpoint if there is one.

    Every batch depends on the seed and the step alone, so a resumed run repeats the uninterrupted one, and any number
    of processes makes the same steps.

    start : weights to begin with, and whose layers are held if the recipe says so, of a resumed run as well

    Raises UsageError where the folder holds a checkpoint of another network or recipe, InputError where it is broken.
    """

    def __init__(self, config: Config, recipe: Recipe, folder: Path, start: dict[str, Tensor] | None = None,
                 group: Group = ALONE) -> None:
        torch.manual_seed(recipe.seed)
        self.recipe, self.group, self.folder = recipe, group, RunFolder(folder, config, recipe)
        self.net = Denoiser(config).set_product_dtype(torch.bfloat16 if recipe.bfloat16 else None)
        if recipe.only is not None:
            hold_all_but(self.net, recipe.only)
        before = None
        if start is not None:
            self.net.load_state_dict(start)
            before = copy.deepcopy(self.net).to(group.device) if recipe.hold_layers else None
        self.averaged = Denoiser(config)
        self.averaged.load_state_dict(self.net.state_dict())
        for net in (self.net, self.averaged):
            net.to(group.device)
        self.optimizer = make_optimizer(self.net, recipe)
        self.state = State()
        found = self.folder.read(group.device)
        if found is not None:
            self.state = found.state
            self.net.load_state_dict(found.net)
            self.averaged.load_state_dict(found.averaged)
            self.optimizer.load_state_dict(found.optimizer)
        self.objective = group.wrap(Objective(self.net, recipe, before))
        self._torn = False  # weights and step count belong to different steps
        self._wasted = 0  # steps in a row that changed nothing

    @property
    def step(self) -> int:
        """Steps done."""
        return self.state.step

    def save(self) -> None:
        """Writes the checkpoint and the curve, each whole or not at all. The leading process does."""
        if self.group.leads and not self._torn:
            self.folder.write(self.state, self.net, self.averaged, self.optimizer)

    def run(self, cache: SampleCache, validation: SampleCache, report: Report = print, seconds: float = math.inf,
            save_every: float = math.inf, loaders: int = 1) -> None:
        """Trains until `recipe.steps` or for `seconds`; validates by the recipe, saves then and every so many seconds.

        SIGINT and SIGTERM end the run after the step they came in: raises StoppedError, once the checkpoint is
        written. Raises LbmcError where training has diverged. Whatever ends it, the checkpoint is that of the last
        whole step. `loaders` threads make batches.
        """
        begun = saved = time.monotonic()
        stop = 0
        with signals_noted() as signal, self._batches(cache, loaders) as batches:
            try:
                while True:
                    if self._due() and self.group.leads:
                        self._validate(validation, report, signal, begun)
                        saved = time.monotonic()
                    stop = self.group.largest(signal() or (TIME_IS_UP if time.monotonic() - begun >= seconds else 0))
                    if stop or self.step >= self.recipe.steps:
                        break
                    self.advance(next(batches))
                    self._refuse_to_go_on_for_nothing()
                    if time.monotonic() - saved >= save_every:
                        self.save()
                        saved = time.monotonic()
            finally:
                self.save()
        if stop > TIME_IS_UP:
            raise StoppedError(stop)

    @contextmanager
    def _batches(self, cache: SampleCache, loaders: int) -> Iterator[Iterator[Batch]]:
        """This process's part of the batches from the next step on, made ahead by `loaders` threads."""
        part = self.group.part(self.recipe.batch)
        pool = ThreadPoolExecutor(loaders)

        def stream() -> Iterator[Batch]:
            steps = iter(range(self.step, self.recipe.steps))
            pending = deque(pool.submit(random_batch, cache, self.recipe, step, part)
                            for step in islice(steps, loaders + 1))
            while pending:
                batch = pending.popleft().result()
                for step in islice(steps, 1):
                    pending.append(pool.submit(random_batch, cache, self.recipe, step, part))
                yield batch

        try:
            yield stream()
        finally:
            pool.shutdown(cancel_futures=True)

    def _refuse_to_go_on_for_nothing(self) -> None:
        """Raises LbmcError where no step has had a finite gradient for long. All processes see the same gradients."""
        if self._wasted >= HOPELESS:
            raise LbmcError(f"step {self.step}: the last {HOPELESS} gradients were not finite, the weights have "
                            f"diverged; train anew with a lower --learning-rate")

    def _due(self) -> bool:
        """Whether the curve lacks the row of this step."""
        step, rows = self.step, self.state.rows
        due = step > 0 and (step % self.recipe.validate_every == 0 or step == self.recipe.steps)
        return due and not (rows and rows[-1]["step"] >= step)

    def _validate(self, cache: SampleCache, report: Report, signal: Callable[[], int], begun: float) -> None:
        """Adds a row to the curve, saves and draws; a signal leaves that to the resumed run."""
        result = validate(self.averaged, cache, self.recipe, signal)
        if result is None:
            return
        score, shown = result
        losses = np.array(self.state.losses)
        finite = losses[np.isfinite(losses)]
        row = {"step": float(self.step), "loss": float(finite.mean()) if finite.size else math.nan,
               **dataclasses.asdict(score), "rate": learning_rate(self.step - 1, self.recipe),
               "skipped": float(losses.size - finite.size)}
        self.state.rows.append(row)
        self.state.losses.clear()
        self.save()
        self.folder.draw(self.state, shown)
        skipped = f"  {row['skipped']:.0f} steps skipped, not finite" if row["skipped"] else ""
        report(f"step {self.step}  loss {row['loss']:.4f}  relMSE {score.relmse:.5f}  SMAPE {score.smape:.5f}  "
               f"energy off {score.energy:.4f}  front {score.front:.2f}  {time.monotonic() - begun:.0f} s{skipped}")

    def advance(self, batch: Batch) -> float:
        """One step on this process's part of its batch; returns the loss of the whole batch, NaN for a skipped step."""
        recipe, step = self.recipe, self.step
        self.optimizer.set_rate(learning_rate(step, recipe))
        # DistributedDataParallel takes the mean over processes, whose parts may differ by a crop
        weight = len(batch.target) * self.group.size / recipe.batch
        loss = weight * self.objective(batch.to(self.group.device), step)
        self.optimizer.zero_grad()
        loss.backward()
        norm = torch.nn.utils.clip_grad_norm_(self.net.parameters(), recipe.clip)
        mean = self.group.mean(loss)
        self._torn = True
        if bool(torch.isfinite(norm)):
            self.optimizer.step()
            self._wasted = 0
        else:
            mean = math.nan
            self._wasted += 1
        keep = min(recipe.average, (1 + step) / (10 + step))
        with torch.no_grad():
            for mine, theirs in zip(self.averaged.parameters(), self.net.parameters(), strict=True):
                mine.lerp_(theirs, 1 - keep)
        self.state.losses.append(mean)
        self.state.step += 1
        self._torn = False
        return mean
