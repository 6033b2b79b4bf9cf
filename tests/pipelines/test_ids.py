"""Ids: the heaviest first, their weights the coverage of their samples, hashed as Cryptomatte hashes names."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from deep_io import Header, InputError, Window
from deep_io.header import channels_of
from pipelines.ids import RANKS, IdChannel, cryptomatte_hash, find_ids, rank
from tests.deep_io.oracles import seeded

HEADER = Header(channels_of({"R": np.float16, "id": np.uint32, "object.id": np.uint32, "crypto00.R": np.float32,
                             "crypto00.G": np.float32, "half_id": np.float16, "id100": np.uint32,
                             "hash100": np.float32, "n00.R": np.uint32}), Window(0, 0, 1, 1), Window(0, 0, 1, 1))


@pytest.mark.parametrize(
    ("name", "bits"),
    [
        ("", 0x00800000),  # the hash is 0, which would be a denormal
        ("hello", 0x248BFA47),
        ("hello, world", 0x149BBB7F),
        ("The quick brown fox jumps over the lazy dog", 0x2E4FF723),
    ],
)
def test_the_hash_is_murmur3(name: str, bits: int) -> None:
    assert cryptomatte_hash(name) == bits


@seeded
@given(st.text(max_size=12))
def test_a_hash_is_an_ordinary_float(name: str) -> None:
    value = np.array([cryptomatte_hash(name)], np.uint32).view(np.float32)
    assert np.isfinite(value).all()
    assert (np.abs(value) >= np.finfo(np.float32).tiny).all()


SAMPLES = st.lists(st.tuples(st.integers(0, 4), st.integers(0, 9), st.floats(2.0**-7, 1.0, width=32)), max_size=60)


@seeded
@given(SAMPLES)
def test_ranked_weights_are_the_sums_of_each_id(samples: list[tuple[int, int, float]]) -> None:
    pixel, ids, weight = (np.array([s[k] for s in samples], kind) for k, kind in
                          enumerate((np.int64, np.uint32, np.float32)))
    found, weights = rank(pixel, ids, weight, 5)
    for p in range(5):
        sums: dict[int, float] = {}
        for where, number, w in samples:
            if where == p:
                sums[number] = sums.get(number, 0.0) + w
        expected = sorted(sums.values(), reverse=True)[:RANKS]
        assert np.allclose(weights[: len(expected), p], expected)
        assert not weights[len(expected):, p].any()
        assert len(set(found[: len(expected), p].tolist())) == len(expected)
        assert np.allclose([sums[number] for number in found[: len(expected), p].tolist()], expected)


@pytest.mark.parametrize(
    ("name", "expected"),
    [
        ("id", IdChannel("id", "id", False)),
        ("object", IdChannel("object.id", "object", False)),
        ("crypto", IdChannel("crypto00.R", "crypto", True)),
        ("crypto00.R", IdChannel("crypto00.R", "crypto", True)),
        ("id100", IdChannel("id100", "id100", False)),
        ("hash100", IdChannel("hash100", "hash100", True)),
        ("n00", IdChannel("n00.R", "n00", False)),
    ],
)
def test_id_channels_are_found_by_channel_layer_or_cryptomatte(name: str, expected: IdChannel) -> None:
    assert find_ids([name, name], HEADER, "in.exr") == [expected]


def test_a_cryptomatte_named_twice_is_written_once() -> None:
    assert find_ids(["crypto", "crypto00.R"], HEADER, "in.exr") == [IdChannel("crypto00.R", "crypto", True)]


@pytest.mark.parametrize(("name", "said"), [("nothing", "id, id100, n00.R, object.id"), ("half_id", "half")])
def test_what_cannot_hold_ids_is_refused(name: str, said: str) -> None:
    with pytest.raises(InputError, match=said):
        find_ids([name], HEADER, "in.exr")
