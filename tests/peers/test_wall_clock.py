"""The other libraries' learners in scripts/wall_clock.py, in a separate virtual environment: `make test-peers`."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest

from algorithms.peers import PEERS

if TYPE_CHECKING:
    from collections.abc import Callable
    from types import ModuleType

pytestmark = pytest.mark.slow


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("learner", ["stable_baselines3.ppo", "morl_baselines.nl_mo_ppo"])
@pytest.mark.parametrize("env_id", ["mo-deepdrive-one-waypoint-v0", "CartPole-v1"])
def test_a_learner_of_another_library_stops_at_its_limit(
    load_script: Callable[[str], ModuleType], learner: str, env_id: str
) -> None:
    reason = PEERS[learner].unavailable_reason()
    if reason is not None:
        pytest.skip(reason)
    wall_clock = load_script("wall_clock")
    found = wall_clock.race(learner, env_id, 1, limit=1e-6)
    assert (found.learner, found.environment, found.reached) == (learner, env_id, False)
    assert found.steps == wall_clock.ENVS * wall_clock.STEPS
    assert found.seconds > 0.0
