"""The processes of one training: how many there are, which of them this is, and what they tell each other.

`torchrun` starts them and says so in the environment; without it there is one process and nothing to say.
"""

from __future__ import annotations

import gc
import os
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import timedelta

import torch
import torch.distributed as dist
from torch import nn

from pipelines.network import choose_device

PATIENCE = timedelta(hours=12)  # the others wait while the first one decodes the data, and while it validates


@dataclass(frozen=True)
class Group:
    """This process's place: number `rank` of `size`, computing on `device`."""

    rank: int
    size: int
    device: torch.device

    @property
    def leads(self) -> bool:
        """Whether this process is the one that validates, reports and writes."""
        return self.rank == 0

    def part(self, total: int) -> slice:
        """This process's share of `total` things; shares differ by one at most."""
        return slice(self.rank * total // self.size, (self.rank + 1) * total // self.size)

    def wrap(self, module: nn.Module) -> nn.Module:
        """The module, with its gradients averaged over the processes."""
        if self.size == 1:
            return module
        # gradients of 1x1 convolutions are laid out otherwise than the buffers; copying the few of them costs nothing
        warnings.filterwarnings("ignore", message="Grad strides do not match bucket view strides")
        return nn.parallel.DistributedDataParallel(module)

    def mean(self, value: torch.Tensor) -> float:
        """The mean over the processes of a scalar."""
        value = value.detach().clone()
        if self.size > 1:
            dist.all_reduce(value)
        return float(value) / self.size

    def largest(self, number: int) -> int:
        """The largest of the processes' numbers."""
        if self.size == 1:
            return number
        value = torch.tensor(number, device=self.device)
        dist.all_reduce(value, dist.ReduceOp.MAX)
        return int(value)

    def first(self, work: Callable[[], None]) -> None:
        """Work for the leading process; the others wait. Where it fails, they end too, in silence, with its code."""
        failure: Exception | None = None
        if self.leads:
            try:
                work()
            except Exception as error:
                failure = error
        code = self.largest(getattr(failure, "exit_code", 1) if failure is not None else 0)
        if failure is not None:
            raise failure
        if code:
            raise SystemExit(code)


ALONE = Group(0, 1, torch.device("cpu"))


@contextmanager
def joined(device: str) -> Iterator[Group]:
    """The group that torchrun started this process in, or this process alone, on `device` (auto, cpu, cuda).

    On GPUs each process has one, by its number on its machine. Raises UsageError where CUDA is asked for and absent,
    or there are more processes than GPUs.
    """
    alone = not {"RANK", "WORLD_SIZE", "MASTER_ADDR"} <= os.environ.keys()
    if device == "auto":
        device = "cuda" if torch.cuda.is_available() else "cpu"
    local = int(os.environ.get("LOCAL_RANK", "0")) if not alone else 0
    mine = choose_device(f"cuda:{local}" if device == "cuda" else device)
    if mine.type == "cuda":
        torch.cuda.set_device(mine)
    if alone:
        yield Group(0, 1, mine)
        return
    dist.init_process_group("nccl" if mine.type == "cuda" else "gloo", timeout=PATIENCE)
    try:
        yield Group(dist.get_rank(), dist.get_world_size(), mine)
    finally:
        gc.collect()  # a group that outlives this in a cycle of references takes its threads down at exit, loudly
        dist.destroy_process_group()
