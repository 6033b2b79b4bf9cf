"""What a denoising job is told: one typed, frozen dataclass, filled by the command line or by a caller's own code.

Nothing here reads a file or imports torch: checks that need neither happen on construction, the rest in the job.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Literal

from pipelines.progress import ProgressKind

if TYPE_CHECKING:
    from deep_io.atomic import Existing

ALL_LAYERS = 5
"""Weights hold logits for this many layers; a job keeps between one and all of them."""

WeightingName = Literal["uniform", "packed", "over"]
NormalSpace = Literal["auto", "world", "view"]
DepthKind = Literal["auto", "z", "distance"]
PixelType = Literal["half", "float"]
Precision = Literal["auto", "fp32", "bf16", "fp16"]

COMPRESSIONS = ("none", "rle", "zips", "zip", "piz", "pxr24", "b44", "b44a", "dwaa", "dwab")
"""Flat EXR compressions that every reader knows; ZSTD is left out, since older tools and Nuke cannot read it."""
LOSSY_FOR_FLOATS = ("pxr24", "dwaa", "dwab")
"""Those that change floats, and so would make other ids of ids; B44 changes halves alone."""


@dataclass(frozen=True)
class DenoiseOptions:
    """Everything `pipelines.denoise.denoise_frames` is told.

    Raises ValueError on construction when a value is out of its range. What depends on files, devices or frames is
    checked by the job, which raises the errors of `deep_io.errors`.
    """

    source: str
    """The deep sample file, or a sequence pattern: `shot.####.exr`, `%04d`, `$F4`."""
    target: str
    """The flat EXR to write, or a pattern when `source` is one."""
    frames: str | None = None
    """Fileseq frame range, `1001-1100x2`. None: the frames that exist on disk, or the single file."""
    existing: Existing = "refuse"
    """What to do with an output that already exists; `skip` leaves it and counts the frame as done."""
    force: bool = False
    """Take an input that lbmc itself wrote (it carries `lbmc:model`)."""

    part: str | int | None = None
    """Part of a multi-part input, by name or index. None: the only deep part."""
    overrides: Mapping[str, str] = field(default_factory=dict)
    """`--map role=layer`: role name to the name of the layer or channel that plays it; an empty name drops the role."""
    weighting: WeightingName | None = None
    """How samples are weighted. None: by the header attribute, else uniform as long as every alpha is 0 or 1."""
    normals: NormalSpace = "auto"
    """Space of the normals. `world` needs `camera` or the header's worldToCamera."""
    depth: DepthKind = "auto"
    """`z`: planar; `distance`: along the ray, which needs the camera's field of view; `auto`: by header or table."""
    camera: str | None = None
    """An EXR, JSON or text file with the camera, or its field of view in degrees: `deep_io.camera.parse_camera`."""

    model: str | None = None
    """Name of a preset or path of a .safetensors file. None: the zoo's default preset."""
    layers: int | None = None
    """1 to 5 layers. None: as many as the network has; with `adapt` 1 where the frame that decides hits nothing."""
    adapt: bool = True
    """False: no savings; every role is modelled, every cell filtered, with the network's own number of layers."""
    light: bool = True
    """Hold the light of the picture to that of its samples: `pipelines.light.hold_light`."""
    exposure: float | None = None
    """Factor that brings the radiance to the range the network was trained on. None: measured, see `exposure_from`."""
    exposure_from: str | None = None
    """Frame (number or file) whose measured exposure and depth scale serve all. None: the first frame of a sequence."""
    dry_run: bool = False
    """Say what would be done (frames, mapping, decisions, tile plan, memory) and write nothing."""

    device: str = "auto"
    """`auto`, `cpu`, `cuda` or `cuda:N`. CUDA asked for by name and absent is an error."""
    threads: int | None = None
    """Threads of the numeric libraries. None: all that the process may use."""
    memory: int | None = None
    """Budget in bytes for tiles and buffers. None: chosen by the job."""
    precision: Precision = "auto"
    """Type of the matrix products; kernels and normalisation are always fp32. `auto`: fp32 on a CPU."""

    pixel_type: PixelType = "half"
    """Type of the written colour channels. Depth is always float."""
    compression: str = "zip"
    """One of COMPRESSIONS."""
    aovs: tuple[str, ...] = ()
    """Channel groups filtered by the beauty's own partition and kernels: layers, channels or roles."""
    ids: tuple[str, ...] = ()
    """Id channels, written as ranked pairs of id and weight, not filtered."""
    keep: tuple[str, ...] = ()
    """Other channels of the input to keep, as plain pixel means: names, layers (`diffuse`) or globs (`light_*`)."""

    progress: ProgressKind = "auto"
    """Where progress goes: see `pipelines.progress`."""

    def __post_init__(self) -> None:
        if self.layers is not None and not 1 <= self.layers <= ALL_LAYERS:
            raise ValueError(f"layers must be between 1 and {ALL_LAYERS}, not {self.layers}")
        if self.threads is not None and self.threads < 1:
            raise ValueError(f"threads must be at least 1, not {self.threads}")
        if self.memory is not None and self.memory < 1:
            raise ValueError(f"memory must be positive, not {self.memory}")
        if self.exposure is not None and not 1e-30 <= self.exposure <= 1e30:  # single precision holds its products
            raise ValueError(f"exposure must be positive and finite, 1e-30 to 1e30, not {self.exposure}")
        if self.exposure is not None and self.exposure_from is not None:
            raise ValueError("exposure and exposure_from exclude each other")
        if self.compression not in COMPRESSIONS:
            raise ValueError(f"compression must be one of {', '.join(COMPRESSIONS)}, not {self.compression}")
        if self.ids and self.compression in LOSSY_FOR_FLOATS:
            kept = ", ".join(name for name in COMPRESSIONS if name not in LOSSY_FOR_FLOATS)
            raise ValueError(f"--ids: compression {self.compression} makes other ids of them; choose one of {kept}")
