"""Packing whatever way renders are stored, some rows at a time; nothing is left of one that is damaged."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import OpenEXR
import pytest

from deep_io.errors import InputError
from deep_io.flat import write_flat
from pipelines import flat_renders
from pipelines.pack import PackOptions, pack
from tests.pipelines.flat_render_files import render, write_renders


def write_tiled(path: Path, picture: Mapping[str, Any]) -> None:
    tiles = OpenEXR.TileDescription()
    tiles.xSize, tiles.ySize = 8, 5
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.tiledimage, "tiles": tiles}
    OpenEXR.File(header, dict(picture)).write(str(path))


@pytest.mark.parametrize("stored", ["none", "piz", "zip", "tiles"])
@pytest.mark.parametrize("held", [1, 1000, 10**9])
def test_the_bytes_do_not_depend_on_how_the_renders_are_stored_or_how_much_is_held(tmp_path, monkeypatch, stored, held):
    pictures = [render(seed) for seed in range(3)]
    paths, out = write_renders(tmp_path, pictures), tmp_path / "deep.exr"
    pack(paths, out)
    expected = out.read_bytes()
    for path, picture in zip(paths, pictures, strict=True):
        if stored == "tiles":
            write_tiled(path, picture)
        else:
            write_flat(path, picture, compression=stored)
    monkeypatch.setattr(flat_renders, "BAND_BYTES", held)
    report = pack(paths, out, PackOptions(existing="overwrite"))
    assert report is not None
    assert out.read_bytes() == expected
    times_over = any("times over" in note for note in report.notes)
    assert times_over == (held < 10**9 and stored != "none")


def test_pixels_that_are_damaged_at_the_end_leave_no_output(tmp_path, capfd):
    paths = write_renders(tmp_path, [render(seed) for seed in range(3)])
    write_flat(paths[1], {name: np.tile(values, (20, 1)) for name, values in render(1).items()})
    for seed in (0, 2):
        write_flat(paths[seed], {name: np.tile(values, (20, 1)) for name, values in render(seed).items()})
    data = bytearray(paths[1].read_bytes())
    data[-200:-100] = bytes(100)
    paths[1].write_bytes(data)
    with pytest.raises(InputError, match=r"s1\.exr: the pixels are truncated or corrupt"):
        pack(paths, tmp_path / "deep.exr")
    assert capfd.readouterr() == ("", "")
    assert sorted(os.listdir(tmp_path)) == [path.name for path in paths]


PEAK_OF_PACK = """
import resource, sys
import OpenEXR
from pipelines.pack import pack
*sources, target = sys.argv[1:]
before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
pack(sources, target)
print(1024 * (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before))
"""


@pytest.mark.skipif(sys.platform != "linux", reason="the unit of ru_maxrss is the system's")
def test_memory_does_not_grow_with_the_height_of_the_renders(tmp_path):
    rng, paths = np.random.default_rng(0), [tmp_path / f"s{seed}.exr" for seed in range(8)]
    for path in paths:
        row = rng.exponential(1, (16, 32)).astype(np.float32)
        write_flat(path, {name: np.tile(row, (512, 1)) for name in "RGBAZ"})
    renders = 8 * 5 * 4 * 32 * 16 * 512
    command = [sys.executable, "-c", PEAK_OF_PACK, *paths, tmp_path / "deep.exr"]
    grown = int(subprocess.run(command, check=True, capture_output=True, text=True).stdout)
    assert grown < renders / 2
