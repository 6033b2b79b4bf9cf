"""Which frames and crops are looked at, and how long."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from deep_io import Window
from deep_io.errors import InputError
from pipelines.denoise import Job
from pipelines.options import DenoiseOptions
from pipelines.progress import Progress
from pipelines.tuning.job import LIGHT, SHARES, _changed_light, _edges, _gather, _keep, _spread
from pipelines.tuning.options import TuneOptions, steps_for
from tests.end_to_end.scenes import noisy_scene, random_weights, write_scene


@pytest.mark.parametrize(("count", "most"), [(1, 8), (3, 8), (8, 8), (100, 8), (100, 1), (9, 8)])
def test_frames_are_spread_over_the_shot_the_first_among_them(count: int, most: int) -> None:
    sources = [Path(f"{number}.exr") for number in range(count)]
    chosen = _spread(sources, most)
    assert chosen[0] == sources[0]
    assert len(chosen) == len(set(chosen)) == min(count, most)
    assert most == 1 or chosen[-1] == sources[-1]
    assert chosen == sorted(chosen, key=sources.index)


@pytest.mark.parametrize("size", [1, 32, 127, 128, 129, 256, 257, 1080, 1920])
@pytest.mark.parametrize("side", [32, 128])
def test_crops_cover_a_side_evenly(size: int, side: int) -> None:
    places = _edges(size, side)
    assert places[0] == 0
    assert places[-1] + side >= size
    assert max(places[-1], 0) + min(side, size) <= size
    assert all(0 < after - before <= side for before, after in zip(places, places[1:], strict=False))


def test_more_crops_get_more_steps_up_to_a_number() -> None:
    assert [steps_for(crops) for crops in (0.01, 0.8, 1, 4, 9, 64)] == [32, 32, 32, 56, 96, 96]


def test_options_out_of_range_are_refused() -> None:
    reading = DenoiseOptions("in.exr", "out.safetensors")
    for wrong in ({"steps": 0}, {"most_frames": 0}, {"seed": -1}):
        with pytest.raises(ValueError, match=next(iter(wrong))):
            TuneOptions(reading, **wrong)  # type: ignore[arg-type]
    for target in ("out.exr", "out.####.safetensors"):
        with pytest.raises(ValueError, match=target):
            TuneOptions(DenoiseOptions("in.exr", target))


def test_only_so_much_is_kept_as_leaves_the_light(tmp_path: Path) -> None:
    source = write_scene(tmp_path / "in.exr", noisy_scene(0, Window(0, 0, 39, 31), most=8))
    weights = random_weights(tmp_path / "random.safetensors")
    job = Job(DenoiseOptions(str(source), "out.safetensors", model=str(weights), threads=1, device="cpu"))
    places = _gather(job, [source], np.random.default_rng(0), Progress())
    start = {name: values.clone() for name, values in job.net.state_dict().items()}
    assert _keep(job, places, start) == 1
    confidence = f"partitioner.layers.{len(job.net.config.partitioner) - 1}.bias"
    assert confidence in start, sorted(start)
    dim = {**start, confidence: start[confidence].clone()}
    dim[confidence][-1] += 4  # bright samples count for little
    job.net.load_state_dict(dim)
    assert _changed_light(job, places) > LIGHT
    share = _keep(job, places, dim)
    assert share in SHARES[1:]
    assert _changed_light(job, places) <= LIGHT
    with pytest.raises(InputError, match=r"in\.exr: tuning went astray"):
        _keep(job, places, {name: values * np.nan for name, values in start.items()})
