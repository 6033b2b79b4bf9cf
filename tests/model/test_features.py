"""Encodings: what reaches the network, what a miss and an absent role leave out, what texture is measured by."""

from __future__ import annotations

import dataclasses
import math

import torch

from model.config import ALL_ROLES
from model.features import DEPTH_LIMIT, FrameScale, divisor, encode, feature_groups
from model.guided import guide_values
from model.partition import basic_values
from model.reducer import LogFeatures, SampleReducer
from tests.model.random_models import SMALL, random_samples, with_roles


def test_published_feature_count_and_derived_groups() -> None:
    assert sum(feature_groups(ALL_ROLES, derived=False).values()) == 20
    derived = feature_groups(ALL_ROLES, derived=True)
    assert set(derived) - set(ALL_ROLES) == {"coverage", "coc*lens", "motion*time"}
    assert "coc*lens" not in feature_groups(("radiance", "coc"), derived=True)


def test_features_of_a_miss_are_never_read() -> None:
    samples = random_samples(1, (1, 4, 4), 3)
    miss = samples.coverage == 0
    assert bool(miss.any())
    rubbish = {
        role: torch.where(miss[:, None], math.nan, values)
        for role, values in samples.roles.items() if role not in ("radiance", "lens", "time")
    }
    groups = feature_groups(ALL_ROLES, derived=True)
    clean, dirty = (encode(s, FrameScale(), groups) for s in (samples, with_roles(samples, **rubbish)))
    for name in groups:
        torch.testing.assert_close(clean[name], dirty[name])
        assert bool(dirty[name].isfinite().all())
    for values in (basic_values, guide_values):
        torch.testing.assert_close(values(samples, FrameScale()), values(with_roles(samples, **rubbish), FrameScale()))


def test_extreme_features_stay_in_range() -> None:
    samples = random_samples(2, (1, 4, 4), 3)
    samples = with_roles(samples, depth=torch.full_like(samples.roles["depth"], 1e38),
                         coc=samples.roles["coc"] * 1e30, radiance=samples.roles["radiance"] * -1e6)
    features = encode(samples, FrameScale(), feature_groups(ALL_ROLES, derived=True))
    assert float(features["depth"].max()) == DEPTH_LIMIT
    assert float(features["coc"].abs().max()) <= 1
    assert float(features["radiance"].max()) == 0  # negative radiance counts as none


def test_divisor_is_one_on_misses_and_where_a_surface_has_no_colour() -> None:
    samples = random_samples(3, (1, 2, 2), 2)
    surface = torch.full_like(samples.roles["radiance"], 0.3)
    surface[0], surface[1], surface[4], surface[5, 0] = 0.001, 4.0, 0.0, 0.0
    samples = with_roles(samples, albedo=surface, specular=torch.zeros_like(surface))
    samples = dataclasses.replace(samples, coverage=torch.tensor([1, 1, 1, 0, 1, 1, 1, 1]).double())
    assert divisor(samples)[:, 0].tolist() == [0.03, 1, 0.3, 1, 1, 0.03, 0.3, 0.3]


def test_an_absent_role_is_left_out_of_the_first_layer() -> None:
    torch.manual_seed(4)
    samples, fewer = (random_samples(4, (1, 3, 3), 2, without) for without in ((), ("motion", "albedo")))
    silent = with_roles(samples, motion=samples.roles["motion"] * 0, albedo=samples.roles["albedo"] * 0)
    paper = SampleReducer(SMALL["layer"]).double()
    torch.testing.assert_close(paper(fewer, FrameScale()), paper(silent, FrameScale()))
    ours = SampleReducer(SMALL["fast"]).double()
    assert ours.presence is not None
    with torch.no_grad():
        ours.presence.normal_()
    assert (ours(fewer, FrameScale()) - ours(silent, FrameScale())).abs().max() > 1e-3  # 0 is not "absent"
    plain = LogFeatures(SMALL["pixel_gather"])
    torch.testing.assert_close(plain(fewer, FrameScale()), plain(silent, FrameScale()))
