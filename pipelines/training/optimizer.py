"""What a run trains of a network, and by which optimizer: Adam, or Muon for matrices with Adam for the rest.

Muon (Jordan et al. 2024) steps by the momentum with all its singular values made alike, so that directions that the
gradient hardly shows are learned, too. It is made for hidden layers: what comes in and goes out is stepped by Adam.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor, nn

from deep_io.errors import UsageError
from model.denoiser import Denoiser
from model.networks import Mlp
from pipelines.training.recipe import Recipe

BETAS = (0.9, 0.99)  # of Adam; steps are few and batches small, so its variance must not lag by a thousand steps
MOMENTUM = 0.95  # of Muon
NARROWEST = 16  # rows and columns; of anything narrower the singular values say little


class Optimizer:
    """One or two of PyTorch's optimizers as one: every parameter of a network belongs to one of them."""

    def __init__(self, net: Denoiser, recipe: Recipe) -> None:
        trained = [parameter for parameter in net.parameters() if parameter.requires_grad]
        matrices, others = _split(net, trained) if recipe.muon else ([], trained)
        self._matrices = [(weight, nn.Parameter(weight.detach().view(len(weight), -1))) for weight in matrices]
        self._parts: list[torch.optim.Optimizer] = [torch.optim.Adam(others, lr=recipe.learning_rate, betas=BETAS)]
        if matrices:
            flat = [matrix for _, matrix in self._matrices]  # convolutions as matrices, of the same memory
            self._parts.append(torch.optim.Muon(flat, lr=recipe.learning_rate, weight_decay=0.0, momentum=MOMENTUM,
                                                adjust_lr_fn="match_rms_adamw"))

    def set_rate(self, rate: float) -> None:
        """The learning rate of the next step."""
        for part in self._parts:
            for group in part.param_groups:
                group["lr"] = rate

    def zero_grad(self) -> None:
        """Forgets the gradients."""
        for part in self._parts:
            part.zero_grad(set_to_none=True)
        for weight, _ in self._matrices:
            weight.grad = None

    def step(self) -> None:
        """Steps every parameter."""
        for weight, matrix in self._matrices:
            assert weight.grad is not None
            matrix.grad = weight.grad.reshape(matrix.shape)
        for part in self._parts:
            part.step()

    def state_dict(self) -> dict[str, Any]:
        """What a checkpoint keeps."""
        return {"parts": [part.state_dict() for part in self._parts]}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """The inverse of `state_dict`; also of Adam's own, which checkpoints held at first."""
        for part, saved in zip(self._parts, state.get("parts", [state]), strict=True):
            part.load_state_dict(saved)


def hold_all_but(net: Denoiser, part: str) -> None:
    """Only the parameters of one part of the network, such as `generator`, are trained. Raises UsageError where there
    is none of that name."""
    parts = [name for name, module in net.named_children() if next(module.parameters(), None) is not None]
    if part not in parts:
        raise UsageError(f"the recipe's only: {net.config.name} has no part {part!r}; there are {', '.join(parts)}")
    for name, parameter in net.named_parameters():
        parameter.requires_grad_(name.startswith(f"{part}."))


def make_optimizer(net: Denoiser, recipe: Recipe) -> Optimizer:
    """The optimizer that a recipe asks for. Raises UsageError where this PyTorch has none such."""
    if recipe.muon and not hasattr(torch.optim, "Muon"):
        raise UsageError(f"the recipe's muon needs PyTorch 2.9 or newer, this is {torch.__version__}; install a newer "
                         f"one or set muon=false")
    return Optimizer(net, recipe)


def _split(net: Denoiser, trained: Sequence[Tensor]) -> tuple[list[Tensor], list[Tensor]]:
    """Hidden matrices and convolutions, and everything else."""
    last = {id(mlp.layers[-1].weight) for mlp in net.modules() if isinstance(mlp, Mlp)}
    matrices: list[Tensor] = []
    others: list[Tensor] = []
    for parameter in trained:
        wide = parameter.dim() in (2, 4) and min(len(parameter), parameter[0].numel()) >= NARROWEST
        (matrices if wide and id(parameter) not in last else others).append(parameter)
    return matrices, others
