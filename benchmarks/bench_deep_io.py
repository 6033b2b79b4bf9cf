"""How fast deep samples are read and written, beside the floor and beside OpenEXR and OpenImageIO.

    python benchmarks/bench_deep_io.py [--threads 1]

Makes a 1920x1080 file of 8 samples and 20 half channels in a temporary folder (about 365 MB, 664 MB raw; noise in the
low bits of most channels, as a renderer leaves it) and measures, each stage in a process of its own:

    floor       inflating the file's bytes and nothing else: no reader of ZIPS can be faster with this inflater
    write       flat arrays in memory -> file
    read        file, warm in the page cache -> flat arrays of the whole frame
    stream      the same in row blocks that are dropped again; its peak memory is the point
    stream RGB  the same, three channels only

and then a file of a sixteenth of the pixels through deep_io, OpenEXR.File and OpenImageIO (whose values Python gets
one at a time). CPU seconds count all threads; the start-up of interpreter and libraries is stated apart.
"""

from __future__ import annotations

import argparse
import json
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import deflate
import numpy as np

from deep_io import DeepReader, DeepSamples, Window, read_deep, write_deep
from deep_io.chunks import read_rows
from deep_io.header import parse_headers

CHANNELS = ("R", "G", "B", "Z", "N.X", "N.Y", "N.Z", "albedo.R", "albedo.G", "albedo.B", "specular.R", "specular.G",
            "specular.B", "roughness", "motion.X", "motion.Y", "coc", "lens.X", "lens.Y", "time")
SAMPLES = 8
FULL, SMALL = (1920, 1080), (480, 270)
READ_TARGET, WRITE_TARGET, STREAM_TARGET = 3.5, 4.0, 600  # CPU seconds, CPU seconds, MB


def picture(width: int, height: int, seed: int = 0) -> DeepSamples:
    """Samples like a renderer's: two surfaces that meet in every pixel, jittered features, noisy radiance."""
    rng = np.random.default_rng(seed)
    pixels = width * height
    x = np.tile(np.linspace(0, 1, width, dtype=np.float32), height)
    y = np.repeat(np.linspace(0, 1, height, dtype=np.float32), width)
    front = (rng.random((pixels, SAMPLES), np.float32) < (0.5 + 0.5 * np.sin(9 * x * y))[:, None]).ravel()

    def spread(values: np.ndarray) -> np.ndarray:
        return np.repeat(values, SAMPLES)

    def noise(scale: float) -> np.ndarray:
        return scale * rng.random(pixels * SAMPLES, np.float32)

    channels = {}
    for index, name in enumerate(CHANNELS):
        wave = spread(np.sin((3 + index) * x + 2 * y))
        if name in ("R", "G", "B"):
            values = np.exp(2 * wave) * -np.log(1 - noise(0.999))
        elif name in ("lens.X", "lens.Y", "time"):
            values = noise(1)
        elif name.startswith(("albedo", "specular")) or name == "roughness":
            values = np.where(front, np.round(4 * wave) / 4, np.float32(0.1 * (index % 7)))
        else:
            values = np.where(front, wave, 0.7 * wave) + noise(0.02)
        channels[name] = values.astype(np.float16)
    counts = np.full((height, width), SAMPLES, np.int32)
    return DeepSamples(counts, channels, Window(0, 0, width - 1, height - 1))


# Each stage prepares (imports, arrays, a warm page cache) and returns what is to be measured.

def write(path: Path, threads: int) -> Callable[[], object]:
    samples = picture(*(SMALL if "small" in path.name else FULL))
    return lambda: write_deep(path, samples, threads=threads)


def floor(path: Path, threads: int) -> Callable[[], object]:
    with path.open("rb") as file:
        headers = parse_headers(file, str(path))
        rows = read_rows(file, headers, 0, str(path))
    data = memoryview(path.read_bytes())
    begins = [row.start + row.table_size for row in rows]
    pieces = [(data[begin:begin + row.data_size], row.unpacked) for begin, row in zip(begins, rows, strict=True)]

    def inflate() -> None:
        for packed, size in pieces:
            if len(packed) < size:
                deflate.zlib_decompress(packed, size)
    return inflate


def read(path: Path, threads: int) -> Callable[[], object]:
    warm(path)
    return lambda: read_deep(path, threads=threads)


def stream(path: Path, threads: int, channels: tuple[str, ...] | None = None) -> Callable[[], object]:
    warm(path)

    def run() -> None:
        with DeepReader(path, threads=threads) as reader:
            for _ in reader.blocks(channels=channels):
                pass
    return run


def stream_rgb(path: Path, threads: int) -> Callable[[], object]:
    return stream(path, threads, ("R", "G", "B"))


def openexr_read(path: Path, threads: int) -> Callable[[], object]:
    import OpenEXR

    return lambda: OpenEXR.File(str(path), separate_channels=True)


def openexr_write(path: Path, threads: int) -> Callable[[], object]:
    import OpenEXR

    file = OpenEXR.File(str(path), separate_channels=True)
    return lambda: file.write(str(path.with_name("small.openexr.exr")))


def openimageio_decode(path: Path, threads: int) -> Callable[[], object]:
    import OpenImageIO as oiio

    return lambda: oiio.ImageInput.open(str(path)).read_native_deep_image(0, 0)


def openimageio_read(path: Path, threads: int) -> Callable[[], object]:
    import OpenImageIO as oiio

    def run() -> list[np.ndarray]:
        data = oiio.ImageInput.open(str(path)).read_native_deep_image(0, 0)
        return [np.array([data.deep_value(pixel, channel, sample) for pixel in range(data.pixels)
                          for sample in range(data.samples(pixel))], np.float16) for channel in range(data.channels)]
    return run


STAGES = {stage.__name__: stage for stage in (write, floor, read, stream, stream_rgb, openexr_read, openexr_write,
                                              openimageio_decode, openimageio_read)}


def warm(path: Path) -> None:
    """Have the file in the page cache, without holding it."""
    with path.open("rb") as file:
        while file.read(1 << 20):
            pass


def measure(stage: str, path: Path, threads: int) -> dict[str, float]:
    """Run a stage in a process of its own: CPU and wall seconds, peak memory in MB."""
    command = [sys.executable, __file__, "--stage", stage, "--threads", str(threads), str(path)]
    result: dict[str, float] = json.loads(subprocess.run(command, check=True, capture_output=True, text=True).stdout)
    return result


def run_stage(stage: str, path: Path, threads: int) -> None:
    work = STAGES[stage](path, threads)
    wall, cpu = time.perf_counter(), time.process_time()
    work()
    cpu, wall = time.process_time() - cpu, time.perf_counter() - wall
    print(json.dumps({"cpu": cpu, "wall": wall, "peak": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e3}))


def start_up(module: str) -> float:
    """CPU seconds of starting Python and importing a module."""
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    subprocess.run([sys.executable, "-c", f"import {module}"], check=True)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime


def report(name: str, seen: dict[str, float], note: str = "") -> None:
    print(f"  {name:34}{seen['cpu']:8.2f} CPU s {seen['wall']:8.2f} s {seen['peak']:7.0f} MB peak  {note}", flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--stage", choices=STAGES, help=argparse.SUPPRESS)
    parser.add_argument("path", nargs="?", type=Path, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.stage:
        run_stage(options.stage, options.path, options.threads)
        return
    with tempfile.TemporaryDirectory() as folder:
        compare(Path(folder), options.threads)


def compare(folder: Path, threads: int) -> None:
    print("start-up of Python with  " + "  ".join(f"{name} {start_up(name):.2f}" for name in (
        "numpy", "deep_io", "OpenEXR", "OpenImageIO")) + "  CPU s")
    full, small = folder / "full.exr", folder / "small.exr"
    seen = {"write": measure("write", full, threads)}
    raw = FULL[0] * FULL[1] * SAMPLES * len(CHANNELS) * 2
    print(f"{FULL[0]}x{FULL[1]}, {SAMPLES} samples, {len(CHANNELS)} half channels, ZIPS: "
          f"{full.stat().st_size / 1e6:.0f} MB, {raw / 1e6:.0f} MB raw; {threads} thread(s)")
    for stage in ("floor", "read", "stream", "stream_rgb"):
        seen[stage] = measure(stage, full, threads)
    report("inflate alone (the floor)", seen["floor"])
    report("read into flat arrays", seen["read"], f"target {READ_TARGET} CPU s")
    report("read in row blocks", seen["stream"], f"target {STREAM_TARGET} MB")
    report("read in row blocks, R G B only", seen["stream_rgb"])
    report("write", seen["write"], f"target {WRITE_TARGET} CPU s")

    ours = {"write": measure("write", small, threads), "read": measure("read", small, threads)}
    print(f"{SMALL[0]}x{SMALL[1]}, otherwise alike")
    for stage, base, name in (("read", "read", "deep_io read"), ("openexr_read", "read", "OpenEXR.File read"),
                              ("openimageio_decode", "read", "OpenImageIO, values left in DeepData"),
                              ("openimageio_read", "read", "OpenImageIO into flat arrays"),
                              ("write", "write", "deep_io write"), ("openexr_write", "write", "OpenEXR.File write")):
        theirs = ours.get(stage) or measure(stage, small, threads)
        report(name, theirs, f"{theirs['cpu'] / ours[base]['cpu']:.0f} x deep_io")


if __name__ == "__main__":
    main()
