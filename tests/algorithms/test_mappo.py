"""MAPPO: the team's rewards and states, what each joint utility makes two agents choose, and checkpoints."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

import algorithms.agent
from algorithms import MAPPO
from algorithms.mappo import JOINT_UTILITIES, joint_utility
from mo_deepdrive.evaluation.env_adapter import EnvAdapter, Step, make_env
from mo_deepdrive.evaluation.episodes import evaluate
from mo_deepdrive.utilities import Utility, make_utility
from tests.helpers.agents import INTERSECTION

JOINT = pytest.mark.parametrize("joint", list(JOINT_UTILITIES))
EARNED = Utility("earned", ("earned",), lambda returns: returns[..., 0])
SHORT = {"time_limit": 4.0}


def make_mappo(num_envs: int = 4, env: dict[str, Any] | None = None, **settings: Any) -> MAPPO:
    made = make_env(INTERSECTION, num_envs, env)
    utility = make_utility("intersection_linear", EnvAdapter(made).objectives)
    return MAPPO(made, utility, **{"hidden": [16], "steps": 8, **settings})


# -------------------------------------------------------------------------------------------------- joint utilities


@pytest.mark.parametrize(
    ("name", "expected"), [("sum", [4.0, 5.0]), ("worst_off", [-1.0, 2.0]), ("gini", [0.75, 1.75])]
)
def test_joint_utilities_of_two(name: Any, expected: list[float]) -> None:
    utilities = torch.tensor([[-1.0, 5.0], [3.0, 2.0]])
    assert JOINT_UTILITIES[name](utilities).tolist() == expected
    assert JOINT_UTILITIES[name](utilities.flip(-1)).tolist() == expected  # whoever is who
    double = [lambda returns: 2.0 * returns[..., 0]] * 2
    assert joint_utility(name, double, utilities.unsqueeze(-1)).tolist() == [2.0 * each for each in expected]


# ------------------------------------------------------------------------------------------------------- known optimum

TAKE, GIVE = 0, 1
OWN = {TAKE: 3.0, GIVE: 1.0}
OTHERS = {TAKE: 0.0, GIVE: 1.5}
LAST = 2  # decision of the second agent in which the first one's choice shows


class TakeOrGive:
    """Two agents in the place of an EnvAdapter: the first decides once and ends; the second is paid two steps later.

    Taking earns the first 3 and the second nothing, giving 1 and 1.5: the sum is greater where the first one takes, the
    least one and the Gini index where it gives.
    """

    name, vehicles, objectives, named, native = "take-or-give", 2, ("earned",), True, False
    cost_sign, actions, continuous, observation_size = "maximise", 2, False, 2
    bare, costs = None, np.zeros(1, np.bool_)

    def __init__(self, num_envs: int):
        self.num_envs = num_envs
        self.observation_scales, self.objective_scales = np.ones(2, np.float32), np.ones(1, np.float32)
        self.reset(0)

    def chosen_objective_scales(self, _scales: Any) -> NDArray[np.float32]:
        return self.objective_scales

    def _observations(self) -> NDArray[np.float32]:
        row = [[self.t == 0, self.t / LAST], [0.0, self.t / LAST]]
        return np.broadcast_to(np.array(row, np.float32), (self.num_envs, 2, 2)).copy()

    def reset(self, _seed: Any) -> NDArray[np.float32]:
        self.t = 0
        self.gave = np.zeros(self.num_envs, dtype=np.bool_)
        return self._observations()

    def step(self, actions: NDArray[Any]) -> Step:
        rewards = np.zeros((self.num_envs, 2, 1), np.float32)
        terminated = np.zeros((self.num_envs, 2), np.bool_)
        acted = np.ones((self.num_envs, 2), np.bool_)
        acted[:, 0] = self.t == 0
        if self.t == 0:
            self.gave = actions[:, 0] == GIVE
            rewards[:, 0, 0] = np.where(self.gave, OWN[GIVE], OWN[TAKE])
            terminated[:, 0] = True
        else:
            rewards[:, 0, 0] = 1000.0  # of who has ended: not a part of the episode
        if self.t == LAST:
            rewards[:, 1, 0] = np.where(self.gave, OTHERS[GIVE], OTHERS[TAKE])
            terminated[:, 1] = True
        final = self._observations()
        self.t = 0 if self.t == LAST else self.t + 1
        none = np.zeros_like(terminated)
        return Step(self._observations(), rewards, terminated, none, acted, final, none, None)

    def get_state(self) -> dict[str, NDArray[Any]]:
        return {}


@pytest.fixture(name="two_agents")
def make_two_agents(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(algorithms.agent, "EnvAdapter", lambda env: env)


@pytest.mark.slow
@pytest.mark.usefixtures("two_agents")
@pytest.mark.parametrize(("joint", "choice"), [("sum", TAKE), ("worst_off", GIVE), ("gini", GIVE)])
@pytest.mark.parametrize("gae_lambda", [0.5, 1.0])
def test_the_first_agent_minds_what_happens_after_its_own_end(joint: str, choice: int, gae_lambda: float) -> None:
    env: Any = TakeOrGive(32)
    settings: dict[str, Any] = {"hidden": [16], "steps": 12, "value_scale": 1.0, "learning_rate": 0.01}
    agent = MAPPO(env, EARNED, seed=1, joint=joint, gae_lambda=gae_lambda, **settings)
    agent.train(40 * 12 * 32)
    first = torch.tensor([[1.0, 0.0]])
    log_prob, _ = agent.learners[0].actor(first, torch.tensor([choice]))
    assert log_prob.exp().item() > 0.9


def collected(agent: MAPPO, steer: Any = None) -> Any:
    """The storage after a rollout of greedy actions, or of the one that all take, and what became of the team."""
    agent.begin()
    agent.collector.policy = Steered(agent, steer)
    agent.collector.collect()
    agent.before_learning(agent.collector.storage)
    return agent.collector.storage, SimpleNamespace(**{name: each[0] for name, each in agent._team.items()})


class Steered:
    """Drives greedily, or by one action."""

    def __init__(self, agent: MAPPO, action: int | None):
        self.agent, self.action = agent, action
        self.inputs, self.input_size = agent.inputs, agent.input_size

    def decide(self, _t: int, at: Any, now: Any) -> None:
        """Write the actions."""
        observations, past = now.arrays(0)
        actions = self.agent.act(observations, past, None)
        at.actions[0] = torch.from_numpy(actions) if self.action is None else torch.full(actions.shape, self.action)


@pytest.mark.usefixtures("two_agents")
def test_the_rewards_of_an_episode_sum_to_the_utility_of_its_returns() -> None:
    env: Any = TakeOrGive(3)
    agent = MAPPO(env, EARNED, joint="worst_off", hidden=[4], steps=2 * (LAST + 1))
    storage, team = collected(agent, GIVE)
    assert team.terminated[:, 0].tolist() == [False, False, True] * 2
    assert not team.truncated.any()
    assert team.rewards[:, 0, 0].tolist() == [0.0, 0.0, 1.0] * 2  # min(1, 0) = 0 until the second is paid
    # S_t: two observations of 2, two returns, and who has ended.
    assert team.states[:, 0, 4:].tolist() == [[0, 0, 0, 0], [1, 0, 1, 0], [1, 0, 1, 0]] * 2 + [[0, 0, 0, 0]]
    # The steps after its end are no samples of the first agent's policy, but are of its critic.
    for learner, acted in zip(agent.learners, (6, 18), strict=True):
        samples = learner.compute(learner.prepare, agent.rollout_of(learner, storage))
        assert (int(samples["weights"].sum()), samples["actions"].numel()) == (acted, 18)


# ------------------------------------------------------------------------------------------------------ at the crossing


@JOINT
def test_the_teams_rewards_are_those_of_its_evaluated_episodes(joint: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    agent = make_mappo(num_envs=3, env=SHORT, joint=joint, steps=41)
    monkeypatch.setattr(type(agent), "env_seed", 5)
    _, team = collected(agent)
    result = evaluate(agent, INTERSECTION, episodes=3, seed=5, env_kwargs=SHORT)
    nothing = joint_utility(joint, agent.utilities, torch.zeros(3, 2, 6))
    expected = joint_utility(joint, agent.utilities, torch.from_numpy(result.returns)) - nothing
    for n in range(3):
        over = (team.terminated | team.truncated)[:, n].nonzero()
        first = int(over[0]) + 1
        assert first == result.lengths[n].max()
        assert float(team.rewards[:first, n].sum()) == pytest.approx(float(expected[n]), rel=1e-4, abs=1e-4)


def test_after_a_time_limit_the_critic_values_the_true_final_state() -> None:
    agent = make_mappo(num_envs=2, env={"time_limit": 0.5}, steps=7)
    storage, team = collected(agent)
    assert team.truncated[:, 0].nonzero().flatten().tolist() == [4]
    assert not team.terminated.any()
    final = storage.final_inputs[0, 4, 0].flatten()
    torch.testing.assert_close(team.final_states[4, 0, : len(final)], final)
    assert not torch.equal(final, storage.inputs[0, 5, 0].flatten())  # not what the next episode begins with
    for learner in agent.learners:
        with torch.no_grad():
            values = agent.value_scales * learner.critic(team.states)
            found = agent.next_values(learner.networks, team, values)
            torch.testing.assert_close(found[4, 0], agent.value_scales * learner.critic(team.final_states[4, 0]))
        assert found[5, 0] == values[6, 0]


def test_a_vehicle_that_ends_as_the_other_is_cut_has_ended_in_the_final_state() -> None:
    agent = make_mappo(num_envs=1, steps=2)
    storage, _ = collected(agent)
    storage.terminated[0, 1, 0, 0] = storage.truncated[0, 1, 0, 1] = True
    agent.returns.zero_()
    agent.team_ended.zero_()
    agent.before_learning(storage)
    team = {name: each[0] for name, each in agent._team.items()}
    assert team["truncated"][:, 0].tolist() == [False, True]
    assert team["final_states"][1, 0, -2:].tolist() == [1.0, 0.0]
    assert team["states"][1, 0, -2:].tolist() == [0.0, 0.0]


def test_continuous_actions_train() -> None:
    agent = make_mappo(env={"action_type": "continuous", **SHORT})
    before = [parameter.clone() for learner in agent.learners for parameter in learner.actor.parameters()]
    agent.train(128)
    after = [parameter for learner in agent.learners for parameter in learner.actor.parameters()]
    assert all(not torch.equal(one, other) for one, other in zip(before, after, strict=True))
