"""Minari data sets, against the episodes of the simulator that they record."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import mo_gymnasium
import numpy as np
import pytest

minari = pytest.importorskip("minari", reason="needs Minari: the extra [minari]")
pytest.importorskip("h5py", reason="needs h5py: the extra [minari]")


from mo_deepdrive.evaluation import record_dataset  # noqa: E402
from mo_deepdrive.evaluation.splits import FIRST_TRAINING_SEED  # noqa: E402

ONE_WAYPOINT = "mo-deepdrive-one-waypoint-v0"
SEA = "deep-sea-treasure-v0"

pytestmark = pytest.mark.filterwarnings("ignore::UserWarning")  # Minari recommends an author and a permalink


@pytest.fixture(autouse=True)
def _folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path))


def first_action(observations: Any, accrued: Any, discounts: Any) -> Any:
    """Depends on the number of the decision alone."""
    return np.where(discounts > 0.9, 3, 0)


def steer(observations: Any, accrued: Any, discounts: Any) -> Any:
    return np.stack([observations[:, 0], 1.0 - accrued[:, 0], -np.ones(len(observations))], axis=1).astype(np.float32)


@pytest.mark.parametrize(
    ("env_id", "policy", "env_kwargs"),
    [
        (ONE_WAYPOINT, first_action, {"time_limit": 3.0}),
        (ONE_WAYPOINT, steer, {"time_limit": 3.0, "action_type": "continuous"}),
        (ONE_WAYPOINT, first_action, {"time_limit": 0.1}),  # episodes of one decision
        (ONE_WAYPOINT, steer, {"time_limit": 0.1, "action_type": "continuous"}),
        (SEA, lambda *inputs: np.array([1]), {}),
    ],
)
def test_a_data_set_has_the_trajectories_of_the_environment(
    env_id: str, policy: Callable[..., Any], env_kwargs: dict[str, Any]
) -> None:
    made = record_dataset(policy, env_id, "mo-deepdrive/test-v0", episodes=3, env_kwargs=env_kwargs, description="x")
    dataset = minari.load_dataset("mo-deepdrive/test-v0")
    assert made.total_episodes == dataset.total_episodes == 3
    assert dataset.storage.metadata["description"] == "x"
    env = mo_gymnasium.make(env_id, **env_kwargs)
    seeds = [each["seed"] for each in dataset.storage.get_episode_metadata(range(3))]
    assert seeds == [FIRST_TRAINING_SEED + i for i in range(3)]
    for seed, episode in zip(seeds, dataset.iterate_episodes(), strict=True):
        observations = [env.reset(seed=seed)[0]]
        for t, action in enumerate(episode.actions):
            observation, reward, terminated, truncated, info = env.step(action)
            observations.append(observation)
            np.testing.assert_array_equal(episode.rewards[t], reward)
            assert (episode.terminations[t], episode.truncations[t]) == (terminated, truncated)
        assert terminated or truncated
        np.testing.assert_array_equal(episode.observations, observations)
        assert len(observations) == len(episode) + 1 == len(episode.actions) + 1
        assert episode.rewards.dtype == np.float32
        assert episode.observations.dtype == env.observation_space.dtype
        assert episode.actions.dtype == env.action_space.dtype
        for name, value in info.items():
            assert len(episode.infos[name]) == len(observations)
            last = episode.infos[name][-1]
            assert (last.decode() if isinstance(last, bytes) else last) == value
            assert not episode.infos[name][:-1].any()


def test_the_environment_of_a_data_set_can_be_made_again() -> None:
    record_dataset(first_action, ONE_WAYPOINT, "again-v0", episodes=1, seed=7, env_kwargs={"time_limit": 2.0})
    dataset = minari.load_dataset("again-v0")
    env = dataset.recover_environment()
    np.testing.assert_array_equal(env.reset(seed=7)[0], dataset[0].observations[0])
    assert env.unwrapped.config.time_limit == 2.0


def test_an_existing_data_set_and_several_vehicles_are_refused() -> None:
    record_dataset(first_action, SEA, "sea-v0", episodes=1)
    with pytest.raises(ValueError, match="dataset_id = 'sea-v0' exists"):
        record_dataset(first_action, SEA, "sea-v0", episodes=1)
    with pytest.raises(ValueError, match="has 2 vehicles; a Minari data set holds one agent"):
        record_dataset(first_action, "mo-deepdrive-intersection-v0", "two-v0", episodes=1)
