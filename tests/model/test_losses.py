"""Training losses against values worked out by hand."""

from __future__ import annotations

import pytest
import torch

from model.losses import LossWeights, tonemapped_l2, total_loss


def picture(value: float) -> torch.Tensor:
    return torch.full((1, 3, 4, 4), value)


def test_tonemapped_error_is_that_of_the_compressed_values() -> None:
    assert float(tonemapped_l2(picture(1.0), picture(3.0))) == pytest.approx((1 / 2 - 3 / 4) ** 2)
    assert float(tonemapped_l2(picture(-1.0), picture(0.0))) == 0.0


def test_a_bright_miss_costs_less_than_a_dark_one_of_equal_ratio() -> None:
    bright, dark = (float(tonemapped_l2(picture(value), picture(2 * value))) for value in (1e4, 0.5))
    assert bright < 1e-6 < dark


def test_total_loss_is_the_weighted_sum_of_the_terms_asked_for() -> None:
    one, other = picture(1.0), picture(3.0)
    only = LossWeights(smape=0.0, relative=0.0, tonemapped=2.0, pooled=())
    assert float(total_loss(one, other, only)) == pytest.approx(2 * (1 / 4) ** 2)
    smape = LossWeights(smape=1.0, relative=0.0, pooled=())
    assert float(total_loss(one, other, smape)) == pytest.approx(2 / 4.01)
