"""Means under weights, and how far a gradient step has moved a policy."""

from __future__ import annotations

import pytest
import torch

from algorithms.learning.losses import mean, policy_change
from mo_deepdrive.evaluation.metrics import APPROX_KL, CLIP_FRACTION


def test_means_are_weighted_and_0_without_weight() -> None:
    assert float(mean(torch.tensor([1.0, 3.0]), None)) == 2.0
    assert float(mean(torch.tensor([1.0, 3.0, 9.0]), torch.tensor([3.0, 1.0, 0.0]))) == 1.5
    assert float(mean(torch.tensor([1.0, 3.0]), torch.zeros(2))) == 0.0


def test_metrics_say_how_far_the_policy_moved_under_the_weights() -> None:
    log_ratio = torch.tensor([0.0, 0.1, -0.3, 0.5, 9.0]).log1p()
    change = policy_change(log_ratio, 0.2, torch.tensor([1.0, 1.0, 1.0, 1.0, 0.0]))
    assert float(change[CLIP_FRACTION]) == 0.5
    expected = (0.1 - 0.0953102 - 0.3 + 0.3566749 + 0.5 - 0.4054651) / 4
    assert float(change[APPROX_KL]) == pytest.approx(expected, rel=1e-4)
