"""What a job that writes layers is told, over what every denoising job is told. Imports no torch, as options.py."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, get_args

from pipelines.options import DenoiseOptions

Form = Literal["deep", "parts", "channels", "files"]

FORMS: tuple[Form, ...] = get_args(Form)
DEEP_COMPRESSIONS = ("none", "rle", "zips")


@dataclass(frozen=True)
class ExportOptions(DenoiseOptions):
    """Everything `pipelines.export.export_frames` is told. Raises ValueError as DenoiseOptions does."""

    compression: str = "zips"
    """One of COMPRESSIONS; of DEEP_COMPRESSIONS for the deep form. ZIPS suits readers of single rows, such as Nuke."""
    form: Form = "deep"
    """`deep`: a sample per layer; `parts`: a part per layer after the beauty; `channels`: layer0.R ... beside the
    beauty's R, G, B, A in one part; `files`: a file per layer, OUT.layer0.####.exr."""
    samples: bool = False
    """Write the input's samples with their share in each layer, not the layers."""
    contributions: bool = False
    """Flat forms only: what each layer adds to the beauty, for a plain sum, in place of over form."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.form not in FORMS:
            raise ValueError(f"form must be one of {', '.join(FORMS)}, not {self.form}")
        if not self.target.lower().endswith(".exr"):
            raise ValueError(f"{self.target}: --form {self.form} writes OpenEXR; give OUT the extension .exr")
        if self.samples and (self.form != "deep" or self.contributions or self.aovs or self.ids):
            raise ValueError("--samples copies the input's own samples: it goes without --form, --contributions, "
                             "--aov and --ids")
        if self.form == "deep" and self.contributions:
            raise ValueError("contributions are summed, but deep samples are composited by over; choose --form parts, "
                             "channels or files for them")
        if self.ids and self.form in ("deep", "files"):
            raise ValueError(f"ids go with the beauty, which --form {self.form} has not; choose --form parts or "
                             f"channels, or lbmc denoise")
        if self.form == "deep" and self.compression not in DEEP_COMPRESSIONS:
            raise ValueError(f"deep files are compressed with {', '.join(DEEP_COMPRESSIONS)}, not {self.compression}")
