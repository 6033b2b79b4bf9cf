"""How a network is trained, as data: everything that changes the weights, and what a weight file remembers of it.

Every field's type carries a line of documentation, from which docs/training.md has its table. `from_dict` and `changed`
read recipes from JSON and from words; what does not fit is a UsageError that names the field.
"""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from types import UnionType
from typing import Annotated, Any, Union, get_args, get_origin, get_type_hints

from deep_io.errors import InputError, UsageError
from model.config import MAX_LAYERS
from model.losses import LossWeights

Odds = tuple[tuple[int, float], ...]
"""Values and how often they are drawn, relative to each other."""
Range = tuple[float, float]

SMALLEST_CROP = 32  # pixels; the coarsest cells of the filter and of the loss
LARGEST_GAIN = 18.0  # log10; fireflies beyond it are not finite in float32 sums


@dataclass(frozen=True)
class Augmentation:
    """Random changes of each crop; see augment.py."""

    symmetries: Annotated[bool, "flips and quarter turns; normals, motion and lens are turned with the picture"] = True
    permute_colors: Annotated[bool, "red, green and blue change places, in radiance, albedo and specular alike"] = True
    exposure_stops: Annotated[float, "standard deviation of a random exposure, in stops"] = 1.0
    drop_roles: Annotated[float, "probability that a batch loses some of the roles that real files may lack"] = 0.15
    drop_each: Annotated[float, "of the roles, the share that such a batch loses"] = 0.35
    fireflies: Annotated[float, "probability that a crop gets fireflies"] = 0.25
    firefly_share: Annotated[Range, "log10 of the share of a crop's samples that become one, from, to"] = (-4.5, -3.0)
    firefly_gain: Annotated[Range, "log10 of the factor on a firefly's radiance, from, to"] = (1.0, 4.5)


@dataclass(frozen=True)
class Recipe:
    """One training run."""

    steps: Annotated[int, "length of the run"] = 4000
    only: Annotated[
        str | None, "the one part of the network that is trained, such as generator of fast, while all else stays as "
                    "it starts; null: all is trained"
    ] = None
    batch: Annotated[int, "crops a step, of all processes together"] = 4
    crop: Annotated[int, "pixels along a crop's side; smaller where a scene is smaller"] = 128
    learning_rate: Annotated[float, "of Adam, at its highest; Muon's steps are scaled to the size of Adam's"] = 1e-3
    muon: Annotated[
        bool, "matrices and convolutions are stepped by Muon, which makes a step's singular values alike, and only the "
              "rest by Adam"
    ] = False
    warmup: Annotated[int, "steps in which the learning rate rises"] = 50
    final_rate: Annotated[float, "share of `learning_rate` that a cosine reaches at the end"] = 0.02
    average: Annotated[float, "what the averaged weights, which are validated and written, keep each step"] = 0.999
    clip: Annotated[float, "largest norm of the gradient"] = 1.0
    samples: Annotated[
        Odds, "samples per pixel and how often a batch has so many; never more than a scene holds"
    ] = ((1, 0.05), (2, 0.1), (4, 0.25), (8, 0.45), (16, 0.15))
    even_times: Annotated[
        float, "share of the crops whose samples are spread evenly over the shutter, as renderers spread them"
    ] = 0.7
    layers: Annotated[
        Odds, "layers and how often a batch uses so many; never more than the network has"
    ] = ((1, 0.1), (2, 0.75), (3, 0.15))
    loss: Annotated[LossWeights, "what is minimised"] = field(default_factory=LossWeights)
    finish: Annotated[float, "share of the run, its end, in which `finish_loss` takes over"] = 0.0
    finish_loss: Annotated[LossWeights | None, "what is minimised then; fields as those of `loss`"] = None
    augmentation: Annotated[Augmentation, "random changes of the crops"] = field(default_factory=Augmentation)
    partition_entropy: Annotated[
        float, "weight of the guard against a collapsed partition; it fades in the first third of the run"
    ] = 0.02
    depth_order: Annotated[
        float, "weight of the guard of the layers' order: what lies behind the layer that should be behind it costs"
    ] = 2.0
    hold_layers: Annotated[
        float, "how much it counts that each layer covers of cells of 8 pixels what it does by the weights of --start, "
               "so that all else can be trained on while the layers stay"
    ] = 0.0
    bfloat16: Annotated[bool, "matrix products and convolutions in bfloat16"] = True
    seed: Annotated[int, "of everything that is random"] = 1
    validate_every: Annotated[int, "steps"] = 250
    validation_samples: Annotated[int, "samples per pixel in validation"] = 8
    validation_size: Annotated[int, "pixels; the middle of larger validation scenes is used"] = 512

    def __post_init__(self) -> None:
        least = {"steps": 1, "batch": 1, "crop": SMALLEST_CROP, "warmup": 0, "seed": 0, "validate_every": 1,
                 "validation_samples": 1, "validation_size": SMALLEST_CROP}
        for name, low in least.items():
            if getattr(self, name) < low:
                raise ValueError(f"{name} is {getattr(self, name)}; it must be at least {low}")
        for name in ("learning_rate", "clip"):
            if not getattr(self, name) > 0:
                raise ValueError(f"{name} is {getattr(self, name)}; it must be above 0")
        how = self.augmentation
        shares = {"final_rate": self.final_rate, "average": self.average, "finish": self.finish,
                  "even_times": self.even_times,
                  "augmentation.drop_roles": how.drop_roles, "augmentation.drop_each": how.drop_each,
                  "augmentation.fireflies": how.fireflies}
        for name, share in shares.items():
            if not 0 <= share <= 1:
                raise ValueError(f"{name} is {share}; it must be between 0 and 1")
        for name, odds, most in (("samples", self.samples, None), ("layers", self.layers, MAX_LAYERS)):
            values, weights = [pair[0] for pair in odds], [pair[1] for pair in odds]
            if not odds or min(values) < 1 or min(weights) < 0 or sum(weights) <= 0 or (most and max(values) > most):
                raise ValueError(f"{name} must be pairs of a number from 1{f' to {most}' if most else ''} and how "
                                 f"often it is drawn, as in [[1, 0.2], [2, 0.8]]")
        if not how.firefly_gain[0] <= how.firefly_gain[1] <= LARGEST_GAIN:
            raise ValueError(f"augmentation.firefly_gain must rise, to at most {LARGEST_GAIN:g}")
        if not how.firefly_share[0] <= how.firefly_share[1] <= 0:
            raise ValueError("augmentation.firefly_share must rise, to at most 0, the log10 of all samples")
        if self.finish > 0 and self.finish_loss is None:
            raise ValueError("finish is above 0, but there is no finish_loss")
        for size, _ in (*self.loss.pooled, *(self.finish_loss.pooled if self.finish_loss else ())):
            if not 1 <= size <= self.crop:
                raise ValueError(f"pooled cells must be 1 to {self.crop} pixels, as large as a crop, not {size}")

    def loss_at(self, step: int) -> LossWeights:
        """What step `step`, from 0, minimises."""
        finishing = step >= round(self.steps * (1 - self.finish))
        return self.finish_loss if finishing and self.finish_loss is not None else self.loss

    def to_dict(self) -> dict[str, Any]:
        """Plain data that `from_dict` reads, also after a trip through JSON."""
        data: dict[str, Any] = json.loads(json.dumps(dataclasses.asdict(self)))
        return data


def from_dict(data: Mapping[str, Any], source: str) -> Recipe:
    """A recipe from plain data; fields that it does not name have their defaults. Raises UsageError naming `source`."""
    try:
        recipe: Recipe = _read(Recipe, data, "")
    except ValueError as error:
        raise UsageError(f"{source}: {error}") from None
    return recipe


def read_recipe(path: Path) -> Recipe:
    """The recipe of a JSON file. Raises InputError where it is none, UsageError for what a recipe cannot be."""
    try:
        data = json.loads(path.read_text("utf-8"))
    except (OSError, ValueError) as error:
        raise InputError(f"{path}: not a recipe: {error}") from None
    if not isinstance(data, dict):
        raise InputError(f"{path}: not a recipe: it must be a JSON object, {{\"steps\": 4000, ...}}")
    return from_dict(data, str(path))


def changed(recipe: Recipe, words: Sequence[str]) -> Recipe:
    """The recipe with fields set by words: `warmup=100`, `loss.smape=1`, `samples=[[4, 1]]`. Raises UsageError."""
    data = recipe.to_dict()
    for word in words:
        name, separator, text = word.partition("=")
        *path, last = name.strip().split(".")
        if not separator:
            raise UsageError(f"--set {word}: write NAME=VALUE, as in --set warmup=100")
        place: Any = data
        for step in path:
            if isinstance(place, dict) and place.get(step, 0) is None:
                place[step] = {}
            place = place.get(step) if isinstance(place, dict) else None
        if not isinstance(place, dict):
            raise UsageError(f"--set {word}: a recipe has no {name}")
        try:
            place[last] = json.loads(text)
        except ValueError:
            raise UsageError(f"--set {word}: {text!r} is not a JSON value: a number, true, false, null, "
                             f"or a list as in [[4, 0.5], [8, 0.5]]") from None
    return from_dict(data, f"--set {' '.join(words)}")


def differences(one: Mapping[str, Any], other: Mapping[str, Any], prefix: str = "") -> Iterator[str]:
    """Names of the fields in which two recipes' plain data differ."""
    for name in dict.fromkeys((*one, *other)):
        a, b = one.get(name), other.get(name)
        if isinstance(a, Mapping) and isinstance(b, Mapping):
            yield from differences(a, b, f"{prefix}{name}.")
        elif a != b:
            yield f"{prefix}{name}"


def _read(kind: Any, value: Any, name: str) -> Any:
    """`value`, plain data, as the type `kind`. Raises ValueError naming the field."""
    if dataclasses.is_dataclass(kind) and isinstance(kind, type):
        hints = get_type_hints(kind)
        if not isinstance(value, Mapping):
            raise ValueError(f"{name} must be an object of {', '.join(hints)}")
        unknown = [key for key in value if key not in hints]
        if unknown:
            raise ValueError(f"no field {'.'.join(filter(None, (name, unknown[0])))}; there are {', '.join(hints)}")
        fields = {key: _read(hints[key], item, f"{name}.{key}" if name else key) for key, item in value.items()}
        return kind(**fields)
    if get_origin(kind) in (Union, UnionType):
        if value is None and type(None) in get_args(kind):
            return None
        return _read(next(k for k in get_args(kind) if k is not type(None)), value, name)
    if get_origin(kind) is tuple:
        items = get_args(kind)
        if not isinstance(value, (list, tuple)) or (items[-1] is not ... and len(items) != len(value)):
            raise ValueError(f"{name} must be a list{'' if items[-1] is ... else f' of {len(items)}'}, not {value!r}")
        kinds = [items[0]] * len(value) if items[-1] is ... else items
        return tuple(_read(k, item, name) for k, item in zip(kinds, value, strict=True))
    if kind is float and isinstance(value, int) and not isinstance(value, bool):
        return float(value)
    if type(value) is not kind:
        raise ValueError(f"{name} must be {'a whole number' if kind is int else kind.__name__}, not {value!r}")
    return value
