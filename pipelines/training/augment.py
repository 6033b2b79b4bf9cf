"""Random changes of a crop: turned, recoloured, rescaled, littered with fireflies. Samples are (N, C), see cache.py."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TypeVar

import numpy as np
import numpy.typing as npt

from pipelines.mirrors import DIRECTIONS, Mirror
from pipelines.training.cache import CHANNELS
from pipelines.training.recipe import Augmentation

FloatArray = npt.NDArray[np.float32]
Scalar = TypeVar("Scalar", bound=np.generic)


@dataclass(frozen=True)
class Turn:
    """One of the eight symmetries of the square: transposed, then mirrored left to right, then top to bottom."""

    transpose: bool = False
    mirror: bool = False
    flip: bool = False

    @staticmethod
    def draw(rng: np.random.Generator) -> Turn:
        """Any of the eight."""
        return Turn(*(bool(bit) for bit in rng.random(3) < 0.5))

    def picture(self, picture: npt.NDArray[Scalar]) -> npt.NDArray[Scalar]:
        """(H, W, ...) turned, a view."""
        return self._mirror.picture(picture.swapaxes(0, 1) if self.transpose else picture)

    def directions(self, samples: FloatArray) -> None:
        """Turns, in place, what points somewhere on the screen."""
        for role, sign in DIRECTIONS.items():
            x = CHANNELS[role].start
            if self.transpose:
                samples[:, [x, x + 1]] = np.float32(sign) * samples[:, [x + 1, x]]
            self._mirror.directions(samples[:, x : x + 2])

    @property
    def _mirror(self) -> Mirror:
        return Mirror(self.mirror, self.flip)


def relight(rng: np.random.Generator, samples: FloatArray, target: FloatArray, how: Augmentation
            ) -> tuple[FloatArray, float]:
    """Recolours, rescales and litters `samples` in place.

    Returns the target (H, W, 3) changed alike, without the litter, and the factor on the radiance.
    """
    if how.permute_colors:
        order = rng.permutation(3)
        for role in ("radiance", "albedo", "specular"):
            samples[:, CHANNELS[role]] = samples[:, CHANNELS[role]][:, order]
        target = target[..., order]
    gain = float(2.0 ** (rng.normal() * how.exposure_stops))
    samples[:, CHANNELS["radiance"]] *= np.float32(gain)
    if rng.random() < how.fireflies:
        hit = np.flatnonzero(rng.random(len(samples), np.float32) < 10 ** rng.uniform(*how.firefly_share))
        factors = 10 ** rng.uniform(*how.firefly_gain, (hit.size, 1))
        samples[hit, CHANNELS["radiance"]] *= factors.astype(np.float32)
    return target * np.float32(gain), gain
