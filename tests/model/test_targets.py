"""A network leaves out unwanted targets, alike samples and roles that say nothing; the rest stays equal."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from torch import Tensor

from model import chunks
from model.features import FrameScale
from model.samples import Samples
from model.targets import cells_with, sources_of
from tests.model.random_models import SMALL, random_network, random_samples, with_roles

SCALE = FrameScale(exposure=0.7, depth=2.5)


def beauty_and_coverage(variant: str, samples: Samples, wanted: Tensor | None = None) -> Tensor:
    """(B, 4, H, W) without a gradient."""
    with torch.inference_mode():
        layers = random_network(SMALL[variant], 3)(samples, SCALE, fill=False, wanted=wanted)
        return torch.cat([layers.beauty(), layers.alpha()[:, None]], 1)


@pytest.mark.parametrize("variant", ["fast", "layer", "sample_splat"])
def test_wanted_targets_are_what_they_are_among_all(variant: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(chunks, "CHUNK_SAMPLES", 3000)
    samples = random_samples(1, (2, 70, 133), 2)
    wanted = torch.zeros(2, 70, 133, dtype=torch.bool)
    wanted[0, 3:9, 60:70] = wanted[1, 69, 132] = True
    every = beauty_and_coverage(variant, samples).movedim(1, -1)
    some = beauty_and_coverage(variant, samples, wanted).movedim(1, -1)
    torch.testing.assert_close(some[wanted], every[wanted], rtol=1e-9, atol=1e-12)


def test_targets_that_nobody_wants_are_left_out() -> None:
    wanted = torch.zeros(1, 70, 133, dtype=torch.bool)
    wanted[0, :64, :64] = True
    found = beauty_and_coverage("fast", random_samples(1, (1, 70, 133), 2), wanted)
    assert bool((found[:, :, :64, 64:] == 0).all())
    assert bool((found[:, :3, :64, :64] > 0).any())


def test_sources_are_the_pixels_that_kernels_reach() -> None:
    wanted = torch.zeros(1, 20, 30, dtype=torch.bool)
    wanted[0, 9, 14] = True
    fine, coarse = sources_of(wanted, (5,)), sources_of(wanted, (3, 3, 3))
    assert [int(side) for side in fine[0].nonzero().amin(0)] == [7, 12]
    assert int(fine.sum()) == 25
    assert [int(side) for side in coarse[0].nonzero().amin(0)] == [4, 8]  # its cell of 4 is 8..11, 12..15
    assert [int(side) for side in coarse[0].nonzero().amax(0)] == [15, 19]


def test_cells_hold_a_wanted_pixel_or_none() -> None:
    wanted = torch.zeros(1, 65, 130, dtype=torch.bool)
    wanted[0, 64, 64] = True
    assert cells_with(wanted, 64)[0].tolist() == [[False, False, False], [False, True, False]]


@pytest.mark.parametrize("counts", [[0, 1, 4], [0, 1, 2, 3, 4, 5, 6]])
def test_pixels_sorted_by_their_number_of_samples_find_their_places(
    counts: list[int], monkeypatch: pytest.MonkeyPatch
) -> None:
    drawn = torch.tensor(counts)[torch.randint(len(counts), (19 * 23,), generator=torch.Generator().manual_seed(0))]
    samples = random_samples(2, (1, 19, 23), drawn.to(torch.int32))
    whole = beauty_and_coverage("fast", samples)
    monkeypatch.setattr(chunks, "CHUNK_SAMPLES", 40)
    torch.testing.assert_close(beauty_and_coverage("fast", samples), whole, rtol=1e-9, atol=1e-12)


def test_one_sample_can_stand_for_all_of_a_pixel_that_are_alike() -> None:
    many = random_samples(3, (1, 12, 14), 4)
    same = torch.arange(12 * 14) % 3 == 0
    first = torch.arange(12 * 14) * 4
    source = torch.where(same.repeat_interleave(4), first.repeat_interleave(4), torch.arange(12 * 14 * 4))
    many = replace(many, coverage=many.coverage[source],
                   roles={role: values[source] for role, values in many.roles.items()})
    kept = ~same.repeat_interleave(4)
    kept[first[same]] = True
    weight, squares = many.weight.clone(), many.weight**2
    weight[first[same]] = many.weight.view(-1, 4).sum(1)[same]
    squares[first[same]] = (many.weight**2).view(-1, 4).sum(1)[same]
    one = Samples(many.shape, torch.where(same, 1, 4).to(torch.int32), weight[kept], many.coverage[kept],
                  {role: values[kept] for role, values in many.roles.items()}, squares=squares[kept])
    expected = beauty_and_coverage("fast", many)
    torch.testing.assert_close(beauty_and_coverage("fast", one), expected, rtol=1e-9, atol=1e-12)
    forgotten = beauty_and_coverage("fast", replace(one, squares=None))
    assert float((forgotten - expected).abs().max()) > 1e-4  # how noisy a pixel is matters


@pytest.mark.parametrize("roles", [("coc", "lens"), ("motion",), ("specular", "roughness")])
def test_a_held_role_is_one_whose_features_are_zero(roles: tuple[str, ...]) -> None:
    samples = random_samples(4, (1, 12, 14), 3)
    zeros = with_roles(samples, **{role: torch.zeros_like(samples.roles[role]) for role in roles})
    rest = {role: values for role, values in samples.roles.items() if role not in roles}
    held = replace(samples, roles=rest, held=frozenset(roles))
    expected = beauty_and_coverage("fast", zeros)
    torch.testing.assert_close(beauty_and_coverage("fast", held), expected, rtol=1e-9, atol=1e-12)
    unknown = beauty_and_coverage("fast", replace(held, held=frozenset()))
    assert float((unknown - expected).abs().max()) > 1e-4  # absent is another thing than 0
