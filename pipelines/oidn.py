"""Intel Open Image Denoise as a yardstick, through `pyoidn` (extra `bench`): flat pictures in, flat pictures out."""

from __future__ import annotations

from collections.abc import Mapping
from types import TracebackType
from typing import Any, Literal, Self

import numpy as np
from numpy.typing import NDArray

from deep_io.errors import UsageError

Image = NDArray[np.floating[Any]]
Picture = NDArray[np.float32]
Quality = Literal["fast", "balanced", "high"]


class Oidn:
    """An OIDN CPU device with a fixed number of threads (None: all cores). Use as a context manager.

    Raises UsageError where `pyoidn` is not installed or the device cannot be made.
    """

    def __init__(self, threads: int | None = None) -> None:
        try:
            import pyoidn
        except ImportError as error:
            raise UsageError(f"Intel Open Image Denoise is needed: install lbmc with its extra 'bench' ({error})"
                             ) from error
        self._oidn = pyoidn
        self._device = pyoidn.Device()
        if threads is not None:
            self._device.set_int("numThreads", threads)
            self._device.set_bool("setAffinity", False)
        self._device.commit()
        self._check()

    def denoise(
        self,
        color: Image,
        albedo: Image | None = None,
        normal: Image | None = None,
        *,
        prefilter: bool = False,
        quality: Quality = "high",
    ) -> Picture:
        """Denoises linear HDR `color` (H, W, 3), guided by noisy `albedo` (0..1) and `normal` (-1..1) of that shape.

        With `prefilter`, the guides are denoised first and declared clean, as OIDN advises for the best quality (only
        then does its high quality use the large network). Raises UsageError when OIDN reports an error.
        """
        guides = {name: image for name, image in (("albedo", albedo), ("normal", normal)) if image is not None}
        if prefilter:
            guides = {name: self._filter({name: image}, quality) for name, image in guides.items()}
        return self._filter({"color": color, **guides}, quality, hdr=True, cleanAux=prefilter)

    def _filter(self, images: Mapping[str, Image], quality: Quality, **flags: bool) -> Picture:
        # Kept alive until the filter has run: OIDN is only given their addresses.
        inputs = {name: np.ascontiguousarray(image, dtype=np.float32) for name, image in images.items()}
        output = np.empty_like(next(iter(inputs.values())))
        with self._oidn.Filter(self._device, self._oidn.OIDN_FILTER_TYPE_RT) as run:
            for name, image in (*inputs.items(), ("output", output)):
                run.set_image(name, image, self._oidn.OIDN_FORMAT_FLOAT3)
            for name, flag in flags.items():
                run.set_bool(name, flag)
            run.set_quality(getattr(self._oidn, f"OIDN_QUALITY_{quality.upper()}"))
            run.commit()
            run.execute()
            self._check()
        return output

    def _check(self) -> None:
        message = self._device.get_error()
        if message:
            raise UsageError(f"Intel Open Image Denoise: {message}")

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._device.release()
