"""The format of plans."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from mo_deepdrive.world.action_sequences import decode as decode_actions
from mo_deepdrive.world.action_sequences import encode as encode_actions
from scripts.bounds.front import record_run
from scripts.bounds.plans import PlanFormat
from scripts.bounds.variation import FULL_SCALE


@pytest.mark.parametrize("action_type", ["discrete", "discrete-16"])
def test_discrete_sequences_come_back_without_the_idle_actions_at_their_end(action_type: str) -> None:
    plan_format = PlanFormat(action_type, 8)
    sequences = [np.array([3, 0, 5, 0]), np.array([0, 0]), np.array([], dtype=np.int64)]
    plans = plan_format.from_sequences(sequences)
    assert plans.shape == (3, 8, 1)
    assert [plan_format.to_sequence(plan).tolist() for plan in plans] == [[3, 0, 5], [], []]


def test_continuous_actions_are_stored_in_units() -> None:
    plan_format = PlanFormat("continuous", 4)
    (plan,) = plan_format.from_sequences([np.array([[0.5, 1.0, -1.0], [0.0, 0.0, 0.25]])])
    half, quarter = FULL_SCALE // 2, FULL_SCALE // 4
    expected = [[half, FULL_SCALE, -FULL_SCALE], [0, 0, quarter], [0, 0, -FULL_SCALE], [0, 0, -FULL_SCALE]]
    assert plan.tolist() == expected


def test_continuous_actions_of_a_run_are_rounded_to_what_can_be_written(make_run: Callable[..., Path]) -> None:
    path = make_run("mo-deepdrive-static-obstacle-v0", action_type="continuous")
    sequences = record_run(str(path), "static_obstacle", "continuous", 2).sequences
    plan_format = PlanFormat("continuous", 600)
    plans = plan_format.from_sequences(sequences)
    for plan, sequence in zip(plans, sequences, strict=True):
        written = plan_format.to_sequence(plan)
        np.testing.assert_allclose(written, sequence[: len(written)], atol=0.5 / 1024)
        np.testing.assert_array_equal(decode_actions(encode_actions(written), "continuous"), written)
