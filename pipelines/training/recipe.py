"""How a network is trained, as data: everything that `lbmc train` can be told, and what a weight file remembers."""

from __future__ import annotations

from dataclasses import dataclass, field

from model.losses import LossWeights


@dataclass(frozen=True)
class Augmentation:
    """Random changes of each crop; see batches.py. Probabilities are per batch where all crops must agree."""

    symmetries: bool = True  # flips and quarter turns, normals, motion and lens turned with them
    permute_colors: bool = True
    exposure_stops: float = 1.0  # standard deviation of the exposure's jitter, log2
    drop_roles: float = 0.15  # probability that a batch loses some roles
    fireflies: float = 0.25  # probability that a crop gets samples of 10..10^4.5 times their radiance


@dataclass(frozen=True)
class Recipe:
    """One training run."""

    steps: int = 4000
    batch: int = 4
    crop: int = 128  # pixels
    learning_rate: float = 1e-3
    warmup: int = 50  # steps
    final_rate: float = 0.02  # of learning_rate, reached by a cosine
    average: float = 0.999  # exponential moving average of the weights
    clip: float = 1.0  # gradient norm
    samples: tuple[tuple[int, float], ...] = ((1, 0.05), (2, 0.1), (4, 0.25), (8, 0.45), (16, 0.15))
    layers: tuple[tuple[int, float], ...] = ((1, 0.1), (2, 0.75), (3, 0.15))
    loss: LossWeights = field(default_factory=LossWeights)
    augmentation: Augmentation = field(default_factory=Augmentation)
    partition_entropy: float = 0.02  # weight of the guard against a collapsed partition, gone after a third of the run
    bfloat16: bool = True  # matrix products and convolutions
    seed: int = 1
    validate_every: int = 250  # steps
