"""Sequences of actions: written as text, read back, and replayed."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mo_deepdrive.fronts.reference_fronts import front_config
from mo_deepdrive.world.action_sequences import decode, encode, replay


@given(st.lists(st.integers(0, 21), max_size=40))
def test_discrete_actions_survive_encoding_and_decoding(actions: list[int]) -> None:
    array = np.array(actions, dtype=np.int64)
    text = encode(array)
    assert decode(text, "discrete").tolist() == actions
    assert len(text) <= 2 * len(actions)


@given(st.lists(st.tuples(*[st.integers(-1024, 1024)] * 3), max_size=20))
def test_continuous_actions_survive_encoding_and_decoding(actions: list[tuple[int, ...]]) -> None:
    array = np.array(actions, dtype=np.float64).reshape(-1, 3) / 1024
    found = decode(encode(array), "continuous")
    np.testing.assert_array_equal(found, array)
    np.testing.assert_array_equal(found.astype(np.float32), array)


def test_repeated_actions_are_encoded_as_runs() -> None:
    assert encode(np.array([3, 3, 3, 0, 21])) == "d3av"
    assert encode(np.array([[0.0, 0.5, -1.0]] * 12 + [[0.25, 0.0, 0.0]])) == "0,512*12 256,0,0"


@pytest.mark.parametrize(
    ("text", "action_type"),
    [
        ("w", "discrete"),
        ("q", "discrete-16"),
        ("a b", "discrete"),
        ("3a", "discrete"),
        ("A", "discrete"),
        ("1", "continuous"),
        ("1,2,3,4", "continuous"),
        ("1,2,3x4", "continuous"),
        ("a3", "continuous"),
        ("1.5,0,0", "continuous"),
    ],
)
def test_texts_that_are_not_sequences_are_refused(text: str, action_type: str) -> None:
    with pytest.raises(ValueError, match="is not a sequence of"):
        decode(text, action_type)


def test_a_replay_is_idle_after_the_last_action() -> None:
    rewards = replay(front_config("one_waypoint", "discrete"), [decode("", "discrete"), decode("a600", "discrete")])
    assert rewards.shape == (2, 600, 4)
    assert not rewards.any()
    continuous = front_config("one_waypoint", "continuous")
    short, long = replay(continuous, [np.array([[0.0, 0.5, -1.0]] * n) for n in (5, 6)])
    assert not np.array_equal(short, long)
    again = replay(continuous, [np.array([[0.0, 0.5, -1.0]] * 5 + [[0.0, 0.0, -1.0]] * 9)])
    np.testing.assert_array_equal(again[0], short)
