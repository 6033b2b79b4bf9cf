"""Training losses against values worked out by hand."""

from __future__ import annotations

import math

import pytest
import torch

from model.losses import LossWeights, tone_mapped, total_loss


def picture(value: float) -> torch.Tensor:
    return torch.full((1, 3, 4, 4), value)


def test_the_tone_mapped_error_is_that_of_srgb_of_the_logarithm() -> None:
    def curve(value: float) -> float:
        return 1.055 * math.log1p(value) ** (1 / 2.4) - 0.055

    assert float(tone_mapped(picture(1.0), picture(3.0))) == pytest.approx((curve(1.0) - curve(3.0)) ** 2, rel=1e-5)
    assert float(tone_mapped(picture(-1.0), picture(0.0))) == 0.0


def test_the_total_is_the_weighted_sum_of_the_terms_asked_for() -> None:
    one, other = picture(1.0), picture(3.0)
    smape = LossWeights(smape=1.0, relative=0.0, pooled=())
    assert float(total_loss(one, other, smape)) == pytest.approx(2 / 4.01)
    toned = LossWeights(smape=0.0, relative=0.0, tone_mapped=2.0, pooled=())
    assert float(total_loss(one, other, toned)) == pytest.approx(2 * float(tone_mapped(one, other)))
