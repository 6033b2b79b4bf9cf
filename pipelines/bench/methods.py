"""The methods of a bench: what each is called, and how it turns one deep sample file into one flat EXR, timed by stage.

A `MethodSpec` is plain data, so that a fresh process can run the same method to measure its memory.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass, field
from importlib.util import find_spec
from pathlib import Path
from typing import Any, Literal, Protocol

import numpy as np
import torch
from numpy.typing import NDArray
from torch import nn

from deep_io.errors import InputError
from deep_io.flat import to_half, write_flat
from deep_io.path_samples import PathSamples, SampleReader
from deep_io.roles import ROLES
from deep_io.sequences import Frame
from model import zoo
from model.atrous import atrous, bounded_depth
from model.baseline import clamp_and_blur, pixel_means
from model.config import LAYER, LAYER_W, OPTIMIZED, PIXEL_GATHER, SAMPLE_SPLAT, Config
from model.denoiser import Denoiser
from model.weight_files import DEFAULT_PRESET, MIRRORED
from pipelines.bench.clock import Clock
from pipelines.denoise import Job
from pipelines.frame_reader import FrameReader
from pipelines.oidn import Oidn
from pipelines.options import DenoiseOptions
from pipelines.progress import Progress

Image = NDArray[np.floating[Any]]
Kind = Literal["mean", "blur", "atrous", "oidn", "lbmc", "untrained"]
Family = Literal["input", "classical", "OIDN", "lbmc", "paper"]

FAMILIES: Mapping[Family, str] = {
    "input": "the samples' mean",
    "classical": "untrained filters",
    "OIDN": "Intel Open Image Denoise",
    "lbmc": "lbmc",
    "paper": "the paper's networks, random weights: time only",
}

STAGES: Mapping[str, str] = {
    "read": "read",
    "flatten": "flatten",
    "survey": "survey",
    "reducer": "sample reducer",
    "unet": "U-Net",
    "partitioner": "partitioner",
    "generator": "kernel generator",
    "filter": "splat, filter, composite",
    "write": "write",
}
"""In the order they run. Methods that are no network have their whole work under "filter"."""
OUTSIDE = ("read", "flatten", "write")
"""Stages that do not count as a method's own work: a flat denoiser is handed a picture by the renderer."""

PAPER: Mapping[str, Config] = {
    "PIXELGATHER": PIXEL_GATHER,
    "SAMPLESPLAT": SAMPLE_SPLAT,
    "LAYER": LAYER,
    "LAYER_w": LAYER_W,
    "OPTIMIZED": OPTIMIZED,
}
"""The published networks by their published names. The code has the alpha-compositing LAYER_a as LAYER."""


@dataclass(frozen=True)
class MethodSpec:
    """One method.

    argument : a preset or weight file, an OIDN mode, or a name of PAPER
    changes : fields of DenoiseOptions that differ from the default
    """

    name: str
    family: Family
    kind: Kind
    argument: str = ""
    changes: Mapping[str, Any] = field(default_factory=dict)

    @property
    def scored(self) -> bool:
        """Whether its error means anything: random weights have none."""
        return self.kind != "untrained"

    def to_dict(self) -> dict[str, Any]:
        """For JSON; `MethodSpec(**data)` is the inverse."""
        return dataclasses.asdict(self)


class Method(Protocol):
    """A method, ready to run. `clock` times its stages."""

    clock: Clock

    def run(self, source: Path, target: Path) -> None:
        """Denoises a deep sample file to a flat EXR, half, over what is there."""

    def close(self) -> None:
        """Frees what it holds."""


def oidn_installed() -> bool:
    """Whether `pyoidn` can be imported."""
    return find_spec("pyoidn") is not None


def make(spec: MethodSpec, threads: int, folder: Path) -> Method:
    """The method that a spec describes; random weights are written into `folder`. Raises UsageError."""
    if spec.kind == "untrained":
        weights = folder / f"{spec.name.split()[0]}.safetensors"
        torch.manual_seed(0)
        zoo.save(Denoiser(PAPER[spec.argument]), weights, {"description": "random weights"})
        return LbmcMethod(str(weights), threads, spec.changes)
    if spec.kind == "lbmc":
        return LbmcMethod(spec.argument, threads, spec.changes)
    if spec.kind == "oidn":
        return OidnMethod(spec.argument, threads)
    if spec.kind == "blur":
        return BlurMethod(threads)
    return AtrousMethod(threads) if spec.kind == "atrous" else FlatMethod(threads)


class FlatMethod:
    """A filter of pixel means: reads the roles it needs, flattens them, filters, writes. This one filters nothing."""

    roles: tuple[str, ...] = ()
    """Read besides radiance, coverage, and depth, which tells the misses."""

    def __init__(self, threads: int) -> None:
        self.clock = Clock()
        self.threads = threads

    def run(self, source: Path, target: Path) -> None:
        """Raises what SampleReader raises."""
        dropped = {role: "" for role in ROLES if role not in ("radiance", "coverage", "depth", *self.roles)}
        with self.clock.stage("read"), SampleReader(source, overrides=dropped, threads=self.threads) as reader:
            samples, header = reader.read(), reader.header
        color = self.flattened(samples, samples.roles["radiance"])
        alpha = self.flattened(samples, samples.coverage[:, None])
        with self.clock.stage("filter"):
            result = self.filter(samples, color)
        with self.clock.stage("write"):
            half, _ = to_half(np.concatenate([result, alpha], axis=-1))
            write_flat(target, {name: np.ascontiguousarray(half[..., i]) for i, name in enumerate("RGBA")}, header)

    def filter(self, samples: PathSamples, color: Image) -> Image:
        """The method's own work: mean radiance (H, W, 3) in, filtered out; guides come from the samples."""
        return color

    def flattened(self, samples: PathSamples, values: Image) -> Image:
        """(N, C) to weighted means (H, W, C), float32: what a renderer would have handed over."""
        with self.clock.stage("flatten"):
            return pixel_means(samples.counts, samples.weight, values).astype(np.float32)

    def guides(self, samples: PathSamples, *roles: str) -> dict[str, Image]:
        """Those of the roles that the file has, flattened."""
        return {role: self.flattened(samples, samples.roles[role]) for role in roles if role in samples.roles}

    def close(self) -> None:
        """Nothing is held."""


class BlurMethod(FlatMethod):
    """The untrained baseline of model/baseline.py, which clamps samples before it averages them."""

    def filter(self, samples: PathSamples, color: Image) -> Image:
        """See `clamp_and_blur`."""
        return clamp_and_blur(samples.counts, samples.weight, samples.roles["radiance"])


class AtrousMethod(FlatMethod):
    """The a-trous wavelets of model/atrous.py."""

    roles = ("normal", "albedo")

    def filter(self, samples: PathSamples, color: Image) -> Image:
        """See `atrous`."""
        guides = self.guides(samples, "normal", "albedo")
        if "depth" in samples.roles:
            depth = bounded_depth(samples.roles["depth"], samples.coverage[:, None] > 0.0)
            guides["depth"] = self.flattened(samples, depth)
        return atrous(np.maximum(color, 0.0), guides)


class OidnMethod(FlatMethod):
    """Intel OIDN at high quality: "color", "guided" by noisy albedo and normal, or "prefiltered" guides."""

    def __init__(self, mode: str, threads: int) -> None:
        super().__init__(threads)
        self.roles = () if mode == "color" else ("albedo", "normal")
        self.mode = mode
        self.oidn = Oidn(threads)

    def filter(self, samples: PathSamples, color: Image) -> Image:
        """See `Oidn.denoise`; a guide that the file lacks is left out."""
        guides = self.guides(samples, *self.roles)
        if "albedo" not in guides:  # OIDN takes normals only beside albedo
            guides = {}
        return self.oidn.denoise(color, guides.get("albedo"), guides.get("normal"),
                                 prefilter=self.mode == "prefiltered")

    def close(self) -> None:
        """Releases the device."""
        self.oidn.__exit__(None, None, None)


class LbmcMethod:
    """`lbmc denoise` itself, its job watched from outside."""

    def __init__(self, model: str, threads: int, changes: Mapping[str, Any], kind: type[Job] = Job) -> None:
        self.clock = Clock()
        self.job = kind(DenoiseOptions("", "", model=model, device="cpu", threads=threads, existing="overwrite",
                                       progress="none", **changes))
        self.clock.watch(self.job, "open", "read", self._watch_reader)
        self.clock.watch(self.job, "plan", "survey")
        self.clock.watch(self.job, "write", "write")
        watch_network(self.clock, self.job.net)

    @property
    def name(self) -> str:
        """Of the weights."""
        return self.job.weights.name

    def _watch_reader(self, reader: FrameReader) -> None:
        for method in ("read", "read_mirrored", "blocks"):
            self.clock.watch(reader, method, "read")

    def run(self, source: Path, target: Path) -> None:
        """Raises what the job raises for a frame."""
        self.job.shot = None
        with self.clock.stage("filter"):
            self.job.frame(Frame(None, source, target), _Silent())

    def close(self) -> None:
        """Nothing is held."""


class _Silent(Progress):
    """Does not repeat with every run what a frame has to say."""

    def note(self, text: str) -> None:
        """Says nothing."""


def watch_network(clock: Clock, net: Denoiser) -> None:
    """Times the stages of a network that are modules of their own; the caller's stage gets the rest."""
    clock.watch(net.reducer, "forward", "reducer")
    clock.watch(net.unet, "levels", "unet")
    generators = [net.generator] if net.config.kernel == "affinity" else list(net.generators)
    parts: list[tuple[nn.Module, str]] = [(generator, "generator") for generator in generators]
    if net.config.layered:
        parts.append((net.partitioner, "partitioner"))
    for module, stage in parts:
        for method in ("first", "rest"):
            clock.watch(module, method, stage)


def shipped() -> tuple[str, ...]:
    """The presets that ship, the default one first, those that run the weights of another last."""
    return tuple(sorted(zoo.presets(), key=lambda name: (name != DEFAULT_PRESET, name in MIRRORED)))


def method_specs(models: tuple[str, ...], oidn: bool, paper: bool) -> list[MethodSpec]:
    """Every method of a bench, the input first. Raises InputError when two weight files share one name."""
    specs = [
        MethodSpec("noisy", "input", "mean"),
        MethodSpec("clamp and blur", "classical", "blur"),
        MethodSpec("à-trous wavelets", "classical", "atrous"),
    ]
    if oidn:
        specs += [
            MethodSpec("OIDN colour", "OIDN", "oidn", "color"),
            MethodSpec("OIDN + albedo, normal", "OIDN", "oidn", "guided"),
            MethodSpec("OIDN prefiltered", "OIDN", "oidn", "prefiltered"),
        ]
    for model in models:
        name = f"lbmc {Path(model).stem if model.endswith(zoo.SUFFIX) else model}"
        if any(spec.name == name for spec in specs):
            raise InputError(f"--model {model}: another model is called {name!r} already; rename one of the files")
        specs.append(MethodSpec(name, "lbmc", "lbmc", model))
    if paper:
        specs += [MethodSpec(f"{name} (untrained)", "paper", "untrained", name) for name in PAPER]
    return specs
