"""Which channels hold ids: by their type, or by the Cryptomattes that the header's metadata name."""

from __future__ import annotations

import numpy as np
import pytest

from deep_io import Header, InputError, Window
from deep_io.attributes import attribute
from deep_io.header import channels_of
from pipelines.channel_names import id_channels
from pipelines.keep import find_kept

WINDOW = Window(0, 0, 1, 0)
FLOATS = ("R", "G", "B", "crypto00.R", "crypto00.G", "crypto01.R", "cryptography.R", "a.b00.red", "axb00.red", "fog")
HEADER = Header(channels_of({**dict.fromkeys(FLOATS, np.float32), "number": np.uint32}), WINDOW, WINDOW, attributes={
    "cryptomatte/1234567/name": attribute("crypto"), "cryptomatte/7654321/name": attribute("a.b"),
    "cryptomatte/1234567/hash": attribute("MurmurHash3_32")})


def test_ids_are_integers_and_the_ranks_of_the_cryptomattes_by_name() -> None:
    assert id_channels(HEADER) == {"a.b00.red": "a.b", "crypto00.R": "crypto", "crypto00.G": "crypto",
                                   "crypto01.R": "crypto", "number": "number"}


def test_a_glob_to_keep_passes_every_id_by() -> None:
    assert find_kept(HEADER, "uniform", ["*"], "in.exr") == ["axb00.red", "cryptography.R", "fog"]


@pytest.mark.parametrize(("name", "owner"), [("crypto00.R", "crypto"), ("crypto00", "crypto"), ("number", "number")])
def test_ids_named_to_be_kept_are_refused(name: str, owner: str) -> None:
    with pytest.raises(InputError, match=f"in.exr: channel {name}.* holds ids.*--ids {owner} to"):
        find_kept(HEADER, "uniform", [name], "in.exr")
