"""The samples of a crop, dealt into those that are denoised and those that the result is held against."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from deep_io import DeepSamples, Window
from deep_io.path_samples import PathSamples, SampleReader
from pipelines.mirrors import ALL_FOUR, STRAIGHT, Mirror
from pipelines.tuning.halves import Crop, cut, evenly_timed
from tests.end_to_end.scenes import changed, noisy_scene, write_scene

WINDOW = Window(2, 3, 15, 13)
"""14 x 11 pixels."""


def read(folder: Path, samples: DeepSamples) -> PathSamples:
    with SampleReader(write_scene(folder / "in.exr", samples)) as reader:
        return reader.read()


def crop_of(samples: PathSamples, start: float = 1.0) -> Crop:
    """Where the network makes a picture of one colour of the samples."""
    return Crop(samples, np.full((*samples.counts.shape, 3), start, np.float32), 1.0)


def numbered(seed: int = 0, most: int = 6) -> DeepSamples:
    """Every sample is a hit with a radiance of its own, and times are independent of each other."""
    samples = noisy_scene(seed, WINDOW, most, np.float32)
    rng = np.random.default_rng(seed)
    number = rng.permutation(samples.total).astype(np.float32) + 1
    return changed(samples, R=number, G=2 * number, B=3 * number, time=rng.random(samples.total, np.float32),
                   A=np.ones(samples.total, np.float32), Z=np.full(samples.total, 5, np.float32))


def stratified(samples: DeepSamples, seed: int = 0) -> DeepSamples:
    """The same with a time in each of as many intervals as a pixel has samples, in any order; red is the time."""
    rng = np.random.default_rng(seed)
    time = np.concatenate([(rng.permutation(count) + rng.random(count)) / max(count, 1)
                           for count in samples.counts.ravel()]).astype(np.float32)
    return changed(samples, time=time, R=time)


def by_pixel(samples: PathSamples) -> list[np.ndarray]:
    """Sorted red of each pixel."""
    return [np.sort(samples.roles["radiance"][a:b, 0]) for a, b in zip(samples.offsets, samples.offsets[1:],
                                                                       strict=False)]


def test_every_sample_is_given_or_held_and_no_more_are_held_than_given(tmp_path: Path) -> None:
    whole = read(tmp_path, numbered())
    halves = crop_of(whole).deal(np.random.default_rng(1), STRAIGHT)
    held = halves.held[0].permute(1, 2, 0).reshape(-1, 3).numpy()
    for pixel, (given, all_of_it) in enumerate(zip(by_pixel(halves.given), by_pixel(whole), strict=True)):
        rest = np.setdiff1d(all_of_it, given)
        assert len(given) + len(rest) == len(all_of_it)
        assert len(rest) == len(all_of_it) // 2
        assert bool(halves.known.reshape(-1)[pixel]) == (len(rest) > 0)
        np.testing.assert_allclose(held[pixel], np.outer(rest, [1, 2, 3]).mean(0) if len(rest) else 0, rtol=1e-6)
    np.testing.assert_allclose(halves.given.weight, 1 / np.repeat(halves.given.counts, halves.given.counts.ravel()))


def test_of_two_neighbours_in_an_even_shutter_one_is_given(tmp_path: Path) -> None:
    whole = read(tmp_path, stratified(numbered(most=8)))
    assert evenly_timed(whole)
    rng = np.random.default_rng(2)
    for _ in range(3):
        for given, all_of_it in zip(by_pixel(crop_of(whole).deal(rng, STRAIGHT).given), by_pixel(whole), strict=True):
            for first in range(0, len(all_of_it) // 2 * 2, 2):
                assert np.isin(all_of_it[first : first + 2], given).sum() == 1


def test_times_are_even_if_stratified_and_not_if_independent_or_unknown(tmp_path: Path) -> None:
    for most in (4, 8, 16):
        whole = read(tmp_path, numbered(most=most))
        assert not evenly_timed(whole)
        assert evenly_timed(read(tmp_path, stratified(numbered(most=most))))
    del whole.roles["time"]
    assert not evenly_timed(whole)
    assert not evenly_timed(read(tmp_path, stratified(numbered(most=2))))


@pytest.mark.parametrize("timed", [False, True], ids=["no time", "misses have none"])
def test_halves_are_independent_where_hits_and_misses_mix(timed: bool, tmp_path: Path) -> None:
    rng = np.random.default_rng(7)
    counts = np.full((48, 48), 8, np.int32)
    hit = rng.random(counts.sum()) < 0.5
    channels = {**{name: hit.astype(np.float32) for name in "RGBA"}, "Z": np.where(hit, 1, 1e10).astype(np.float32)}
    if timed:
        channels["time"] = rng.random(hit.size).astype(np.float32)
    samples = DeepSamples(counts, channels, Window(0, 0, 47, 47))
    order = np.lexsort((channels["Z"], samples.pixel_index))  # as `lbmc pack` writes them
    samples = DeepSamples(counts, {name: values[order] for name, values in channels.items()}, samples.window)
    halves = crop_of(read(tmp_path, samples)).deal(rng, STRAIGHT)
    given = halves.given.roles["radiance"][:, 0].reshape(-1, 4).mean(1)
    assert abs(np.corrcoef(given, halves.held[0, 0].reshape(-1).numpy())[0, 1]) < 0.08


def test_dealing_again_deals_otherwise_and_evenly(tmp_path: Path) -> None:
    whole = read(tmp_path, numbered())
    crop, rng = crop_of(whole), np.random.default_rng(3)
    given = np.zeros(whole.total + 2)
    for _ in range(200):
        given[crop.deal(rng, STRAIGHT).given.roles["radiance"][:, 0].astype(int)] += 1
    counts = whole.counts.reshape(-1)
    paired = [number for pixel, numbers in enumerate(by_pixel(whole)) if counts[pixel] % 2 == 0 for number in numbers]
    share = given[np.array(paired, int)] / 200
    assert abs(share.mean() - 0.5) < 1e-6
    assert share.min() > 0.3
    assert share.max() < 0.7


@pytest.mark.parametrize("mirror", ALL_FOUR)
def test_a_mirrored_deal_is_the_deal_mirrored(mirror: Mirror, tmp_path: Path) -> None:
    crop = crop_of(read(tmp_path, numbered()))
    straight, turned = (crop.deal(np.random.default_rng(4), way) for way in (STRAIGHT, mirror))
    for name in ("held", "variance", "start", "known"):
        planes = [getattr(halves, name)[0].permute(1, 2, 0).numpy() for halves in (straight, turned)]
        np.testing.assert_array_equal(mirror.picture(planes[0]), planes[1])
    pixels = np.arange(crop.size[0] * crop.size[1]).reshape(crop.size)
    there, here = by_pixel(straight.given), by_pixel(turned.given)
    for pixel, came_from in enumerate(mirror.picture(pixels).ravel()):
        np.testing.assert_array_equal(here[pixel], there[came_from])


def test_variance_is_that_of_the_held_means(tmp_path: Path) -> None:
    rng = np.random.default_rng(5)
    samples = noisy_scene(5, Window(0, 0, 63, 63), 1, np.float32)
    counts = np.full((64, 64), 8, np.int32)
    channels = {name: np.repeat(values, 8) for name, values in samples.channels.items()}
    sigma = {"R": 0.5, "G": 1.0, "B": 2.0}
    channels |= {name: (10 + rng.normal(0, size, counts.sum())).astype(np.float32) for name, size in sigma.items()}
    crop = crop_of(read(tmp_path, DeepSamples(counts, channels, samples.window)), 10.0)
    halves = crop.deal(rng, STRAIGHT)
    for plane, size in zip(halves.variance[0], sigma.values(), strict=True):
        assert float(plane.mean()) == pytest.approx(size**2 / 4, rel=0.05)
    for plane, size in zip(halves.held[0], sigma.values(), strict=True):
        assert float(plane.var()) == pytest.approx(size**2 / 4, rel=0.1)


def test_variance_is_relative_and_of_near_pixels(tmp_path: Path) -> None:
    rng = np.random.default_rng(8)
    counts = np.full((40, 40), 4, np.int32)
    counts[:, 35:] = 0
    column = np.repeat(np.tile(np.arange(40), 40), counts.ravel())
    bright = column < 12  # a lamp as noisy, for its size, as the dark beside it
    noise = rng.lognormal(0, 0.5, column.size) / np.exp(0.125)
    radiance = (np.where(bright, 1000.0, 1.0) * noise).astype(np.float32)
    channels = {**dict.fromkeys("RGB", radiance), "A": np.ones_like(radiance), "Z": np.ones_like(radiance)}
    start = np.where(np.arange(40)[None, :, None] < 12, 1000.0, 1.0) * np.ones((40, 40, 3))
    whole = read(tmp_path, DeepSamples(counts, channels, Window(0, 0, 39, 39)))
    halves = Crop(whole, start.astype(np.float32), 1.0).deal(rng, STRAIGHT)
    expected = (np.exp(0.25) - 1) / 2  # of the mean of two
    assert float(halves.variance[..., :10].mean()) == pytest.approx(1e6 * expected, rel=0.15)
    assert float(halves.variance[..., 12:30].mean()) == pytest.approx(expected, rel=0.15)
    assert not halves.known[..., 35:].any()
    assert float(halves.variance[..., 39:].min()) > 1e5  # nothing near tells: the picture is to stay


def test_radiance_beyond_all_bounds_stays_finite(tmp_path: Path) -> None:
    samples = numbered()
    wild = samples.channels["R"].copy()
    wild[3] = 1e29
    crop = crop_of(read(tmp_path, changed(samples, R=wild)))
    for seed in range(8):
        halves = crop.deal(np.random.default_rng(seed), STRAIGHT)
        assert halves.held.isfinite().all()
        assert halves.variance.isfinite().all()


def test_a_cut_is_these_columns_and_its_own(tmp_path: Path) -> None:
    whole = read(tmp_path, numbered())
    part = cut(whole, 3, 9, ("radiance", "depth"))
    assert part.roles.keys() == {"radiance", "depth"}
    assert part.window == Window(WINDOW.xmin + 3, WINDOW.ymin, WINDOW.xmin + 8, WINDOW.ymax)
    rows = np.array(by_pixel(whole), dtype=object).reshape(whole.counts.shape)[:, 3:9].ravel()
    for here, there in zip(by_pixel(part), rows, strict=True):
        np.testing.assert_array_equal(here, there)
    part.roles["radiance"][:] = 0
    assert (whole.roles["radiance"] > 0).all()


def test_what_points_somewhere_is_mirrored_with_the_picture(tmp_path: Path) -> None:
    samples = numbered()
    rng = np.random.default_rng(9)
    names = ("N.X", "N.Y", "N.Z", "lens.X", "lens.Y", "motion.X", "motion.Y")
    crop = crop_of(read(tmp_path, changed(samples, **{n: rng.normal(size=samples.total).astype(np.float32)
                                                      for n in names})))
    straight, turned = (crop.deal(np.random.default_rng(4), way).given for way in (STRAIGHT, Mirror(True, True)))
    there = {red: index for index, red in enumerate(straight.roles["radiance"][:, 0].tolist())}
    index = [there[red] for red in turned.roles["radiance"][:, 0].tolist()]
    for role, signs in (("normal", (-1, -1, 1)), ("lens", (-1, -1)), ("motion", (-1, -1))):
        np.testing.assert_array_equal(turned.roles[role], straight.roles[role][index] * np.array(signs, np.float32))


def test_pixels_of_one_sample_are_given_and_not_known(tmp_path: Path) -> None:
    crop = crop_of(read(tmp_path, noisy_scene(6, WINDOW, most=1)))
    halves = crop.deal(np.random.default_rng(6), STRAIGHT)
    assert not halves.known.any()
    assert (halves.given.counts == 1).all()
