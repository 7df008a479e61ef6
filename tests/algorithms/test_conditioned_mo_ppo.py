"""Conditioned MO-PPO: utilities, rewards and advantages against plain loops; each preference finds its best arm."""

from __future__ import annotations

import re
from itertools import pairwise
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium import spaces
from gymnasium.vector import VectorEnv
from mo_gymnasium.wrappers.vector import MOSyncVectorEnv

from algorithms import ConditionedMOPPO
from algorithms.learning.storage import Rollout
from mo_deepdrive.evaluation.env_adapter import make_env
from mo_deepdrive.evaluation.pareto import non_dominated
from mo_deepdrive.evaluation.policy import AccruedReward
from mo_deepdrive.utilities import make_utility
from tests.helpers.agents import CONTINUOUS, INTERSECTION, LEFT_TURN, ONE_WAYPOINT, ROUNDABOUT, same

SMALL: dict[str, Any] = {"hidden": [16], "steps": 8, "minibatches": 2, "epochs": 2, "max_policies": 6}
MIXTURE: dict[str, Any] = {
    "families": {"linear": 0.4, "chebyshev": 0.3, "comfort_budget": 0.3},
    "budgets": {"g_force": 8.0, "jerk": 150.0},
}
SHORT = {"time_limit": 0.8}
IDEAL = torch.tensor([12.0, 0.8, 0.0, 0.0])


def make_agent(
    env_id: str = ONE_WAYPOINT, *, num_envs: int = 4, env: dict[str, Any] | None = None, seed: int = 0, **changed: Any
) -> ConditionedMOPPO:
    return ConditionedMOPPO(make_env(env_id, num_envs, env or SHORT), seed=seed, **{**SMALL, **changed})


class Arms(gymnasium.Env[Any, Any]):
    """One decision, which earns the vector of an arm."""

    def __init__(self, arms: list[list[float]]):
        self.arms = np.asarray(arms, dtype=np.float32)
        self.observation_space = spaces.Box(0.0, 1.0, (1,), dtype=np.float32)
        self.action_space = spaces.Discrete(len(arms))
        self.reward_space = spaces.Box(-5.0, 5.0, (self.arms.shape[1],), dtype=np.float32)
        self.objectives = ("gain", "cost")

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        return np.zeros(1, dtype=np.float32), {}

    def step(self, action: Any) -> tuple[Any, np.ndarray, bool, bool, dict[str, Any]]:
        return np.zeros(1, dtype=np.float32), self.arms[int(action)].copy(), True, False, {}


def arms_env(arms: list[list[float]], num_envs: int = 16) -> VectorEnv:
    return MOSyncVectorEnv(lambda: Arms(arms) for _ in range(num_envs))


def chosen_arm(agent: ConditionedMOPPO, family: str, **numbers: Any) -> int:
    """The greedy first action under a preference."""
    policy = agent.policy(agent.preferences.condition(family, **numbers))
    start = AccruedReward.begin(1, 1, 2)
    return int(policy.act(np.zeros((1, 1, 1), dtype=np.float32), start, None)[0, 0])


def trained_on(arms: list[list[float]], steps: int = 12_000, **changed: Any) -> ConditionedMOPPO:
    hyper = {"hidden": [32, 32], "steps": 16, "learning_rate": 3e-3, "learning_rate_end": 1e-4, "entropy_start": 0.02}
    agent = ConditionedMOPPO(arms_env(arms), seed=1, **{**hyper, **changed})
    agent.train(steps)
    return agent


# ---------------------------------------------------------------------------------------- each preference its best arm

CONCAVE = [[1.0, 0.0], [0.4, 0.4], [0.0, 1.0]]
WEIGHTS = [(0.95, 0.05), (0.5, 0.5), (0.05, 0.95)]


@pytest.mark.slow
def test_chebyshev_weights_find_the_arm_of_a_concave_front_that_linear_weights_do_not() -> None:
    linear = trained_on(CONCAVE, concentration=1.0)
    grid = np.linspace(0.02, 0.98, 25).tolist()
    assert {chosen_arm(linear, "linear", weights={"gain": w, "cost": 1.0 - w}) for w in grid} == {0, 2}
    chebyshev = trained_on(CONCAVE, concentration=1.0, families={"chebyshev": 1.0})
    np.testing.assert_allclose(chebyshev.ideal[0], [1.0, 1.0])
    arms = [chosen_arm(chebyshev, "chebyshev", weights={"gain": a, "cost": b}) for a, b in WEIGHTS]
    assert arms == [0, 1, 2]


@pytest.mark.slow
def test_a_larger_budget_buys_a_better_arm() -> None:
    arms = [[0.0, 0.0], [1.0, -1.0], [3.0, -3.0]]
    entropy = {"entropy_start": 0.3, "entropy_end": 0.01}
    agent = trained_on(arms, 30_000, families={"comfort_budget": 1.0}, budgets={"cost": 4.0}, price=2.0, **entropy)
    # An arm is worth its gain minus 2 per unit of cost above the budget: the best one changes at 0.5 and at 2.
    assert [chosen_arm(agent, "comfort_budget", budgets={"cost": b}) for b in (0.2, 1.8, 3.8)] == [0, 1, 2]


@pytest.mark.slow
def test_one_network_serves_a_mixture_and_its_front_is_the_concave_one() -> None:
    mixture = {"linear": 0.5, "chebyshev": 0.5}
    agent = trained_on(CONCAVE, 16_000, families=mixture, concentration=1.0, max_policies=40)
    env = arms_env(CONCAVE, 4)
    front = agent.front(env, episodes=1, seed=0, gamma=0.99)
    np.testing.assert_allclose(front.discounted, sorted(CONCAVE), atol=1e-6)
    assert front.condition_names == ("linear", "chebyshev", "weight/gain", "weight/cost")
    assert non_dominated(front.discounted).all()


# --------------------------------------------------------------------------------------------- utilities and advantages


def test_utilities_are_those_of_plain_loops() -> None:
    agent = make_agent(**MIXTURE, rho=0.1, price=3.0)
    preferences, rng = agent.preferences, np.random.default_rng(0)
    rows = preferences.draw(60, rng)
    returns = rng.uniform(0.0, 1.0, (60, 4)) * [12.0, 1.0, -9.0, -200.0]
    values = preferences.utility(torch.from_numpy(returns), torch.from_numpy(rows), IDEAL).numpy()
    s, z = agent.scales.astype(float), IDEAL.numpy().astype(float)
    seen = set()
    for row, r, value in zip(rows.astype(float), returns, values, strict=True):
        family, w, b = int(row[:3].argmax()), row[3:7], row[7:]
        seen.add(family)
        if family == 0:
            expected = sum(w[i] * r[i] / s[i] for i in range(4))
        elif family == 1:
            names = agent.env.objectives
            expected = make_utility("augmented_chebyshev", names, weights=w / s, ideal=z, rho=0.1)(r)
        else:
            excess = [max(0.0, -r[2] - b[0]) / s[2], max(0.0, -r[3] - b[1]) / s[3]]
            expected = r[0] / s[0] + r[1] / s[1] - 3.0 * sum(excess)
        assert value == pytest.approx(expected, rel=1e-5, abs=1e-6)
    assert seen == {0, 1, 2}


def collected(agent: Any, rows: np.ndarray) -> Rollout:
    """A rollout of the first vehicle under preferences (N, m), or (T, N, m) in every step."""
    agent.begin()
    steps, num_envs = agent.config.steps, agent.env.num_envs
    chosen = torch.from_numpy(rows).expand(steps, num_envs, -1)
    agent.training.follow = lambda t, _: chosen[t].view(1, num_envs, 1, -1)
    agent._draw(0)
    agent.collector.collect()
    found = agent.rollout_of(agent.learners[0], agent.collector.storage)
    found |= {"states": found["inputs"], "final_states": found.pop("final_inputs")}
    return Rollout(**{name: each[0] for name, each in found.items()})


@pytest.mark.parametrize("vector_critic", [False, True])
def test_the_discounted_sum_of_the_scalar_rewards_is_the_increase_of_the_utility(vector_critic: bool) -> None:
    settings = {"steps": 40, "gae_lambda": 1.0, "gamma": 0.9, "vector_critic": vector_critic, **MIXTURE}
    agent = make_agent(num_envs=6, env={"time_limit": 20}, **settings)
    agent.ideal[:] = IDEAL
    rows = agent.preferences.draw(6, np.random.default_rng(3))
    own = collected(agent, rows)
    assert not own.ended.any()
    zeros = torch.zeros(40, 6, 1 + len(agent.env.objectives) * vector_critic)
    found = agent.advantages(own, zeros, zeros)[0][0]
    preferences = torch.from_numpy(rows)
    after, before = (agent.preferences.utility(each, preferences, IDEAL) for each in (own.accrued[-1], own.accrued[0]))
    assert len({row[: len(MIXTURE["families"])].tobytes() for row in rows}) == len(MIXTURE["families"])
    torch.testing.assert_close(found, after - before, rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("vector_critic", [False, True])
def test_advantages_are_those_of_a_plain_loop_and_linear_ones_need_no_past(vector_critic: bool) -> None:
    settings = {"steps": 7, "gamma": 0.9, "gae_lambda": 0.8, "vector_critic": vector_critic}
    agent = make_agent(num_envs=3, env={"time_limit": 0.5}, **settings)
    rows = agent.preferences.draw(3, np.random.default_rng(1))
    own = collected(agent, rows)
    assert own.ended.any()
    generator = torch.Generator().manual_seed(0)
    components = len(agent.env.objectives) if vector_critic else 1
    values, next_values = torch.randn(2, 7, 3, components, generator=generator)
    own.truncated = own.truncated | (torch.rand(7, 3, generator=generator) < 0.2)
    found, _ = agent.advantages(own, values, next_values)
    for n in range(3):
        w = rows[n] if vector_critic else np.ones(1)
        later = 0.0
        for t in range(6, -1, -1):
            reward = float((own.rewards[t, n].numpy() / agent.scales) @ rows[n])
            delta = reward + 0.9 * float(next_values[t, n].numpy() @ w) - float(values[t, n].numpy() @ w)
            later = delta + (0.0 if own.ended[t, n] else 0.9 * 0.8 * later)
            assert float(found[t, n]) == pytest.approx(later, abs=2e-5)


def test_the_state_knows_of_the_past_what_the_rest_of_the_utility_depends_on() -> None:
    agent = make_agent(**MIXTURE)
    preferences = agent.preferences
    weights = dict(zip(agent.env.objectives, (0.4, 0.3, 0.2, 0.1), strict=True))
    rows = torch.from_numpy(
        np.stack(
            [
                preferences.condition("linear", weights),
                preferences.condition("chebyshev", weights),
                preferences.condition("comfort_budget", budgets={"g_force": 4.0, "jerk": 75.0}),
            ]
        )
    )
    accrued = torch.tensor([2.0, 0.0, -1.0, -15.0]).expand(3, -1)
    past = preferences.features(rows, accrued, torch.full((3,), 0.5), IDEAL)[:, rows.shape[1] :]
    assert not past[0].any()
    gaps = [0.4 * (12 - 2) / 10, 0.3 * 0.8, 0.2 * 1.0 / 5, 0.1 * 15 / 500]
    np.testing.assert_allclose(past[1], [*(max((q - gaps[0]) / 0.5, -2.0) for q in gaps), 0, 0], rtol=1e-5)
    np.testing.assert_allclose(past[2], [0, 0, 0, 0, (4 - 1) / 0.5 / 8, (75 - 15) / 0.5 / 150], rtol=1e-5)


def test_values_are_bootstrapped_after_truncation_and_not_after_termination() -> None:
    agent = make_agent(num_envs=3, env={"time_limit": 0.5}, steps=7, vector_critic=True)
    own = collected(agent, agent.preferences.draw(3, np.random.default_rng(1)))
    values = torch.randn(8, 3, len(agent.env.objectives), generator=torch.Generator().manual_seed(0))
    networks = agent.learners[0].networks
    with torch.no_grad():
        found, at_end = agent.next_values(networks, own, values), networks.critic(own.final_states)
    assert own.truncated.any()
    torch.testing.assert_close(found, torch.where(own.truncated.unsqueeze(-1), at_end, values[1:]))
    own.terminated = own.truncated
    with torch.no_grad():
        assert not agent.next_values(networks, own, values)[own.truncated].any()


def test_where_the_preference_switches_the_next_value_is_that_of_the_old_one() -> None:
    agent = make_agent(num_envs=3, env={"time_limit": 20}, steps=7, vector_critic=True, **MIXTURE)
    agent.ideal[:] = IDEAL
    rows = agent.preferences.draw(21, np.random.default_rng(1)).reshape(7, 3, -1)
    own = collected(agent, rows)
    size, networks = agent.env.observation_size, agent.learners[0].networks
    features = agent.preferences.features(torch.from_numpy(rows), own.accrued[1:], own.discounts[1:], IDEAL)
    under_old = torch.cat([own.inputs[1:, :, :size], features], dim=-1)
    # The last decision of the rollout keeps its preference.
    assert own.truncated.tolist() == [[True] * 3] * 6 + [[False] * 3]
    with torch.no_grad():
        values = networks.critic(own.states)
        expected = networks.critic(under_old)
        torch.testing.assert_close(agent.next_values(networks, own, values)[:-1], expected[:-1])
        targets = agent.samples(networks, own).targets
    # So all advantages but the last are one-step ones.
    torch.testing.assert_close(targets[:-1], agent.components(own)[:-1] + agent.config.gamma * expected[:-1])


# ---------------------------------------------------------------------------------------------- preferences of episodes


def test_every_episode_has_one_preference_and_vehicles_have_their_own() -> None:
    agent = make_agent(INTERSECTION, num_envs=3, switching=0.0, cost_growth=0.0)
    seen: list[tuple[np.ndarray, np.ndarray]] = []
    agent.begin()
    for _ in range(4):
        agent.update(0.0)
        storage = agent.collector.storage
        seen.extend(zip(storage.preferences[0].numpy().copy(), storage.discounts[0, :-1].numpy() == 1.0, strict=True))
    changes = 0
    for (before, _), (after, begins) in pairwise(seen):
        changed = (before != after).any(axis=-1)
        np.testing.assert_array_equal(changed, begins)
        changes += int(changed.sum())
    assert changes > 3
    assert (seen[0][0][:, 0] != seen[0][0][:, 1]).any()
    np.testing.assert_allclose(np.concatenate([rows for rows, _ in seen]).sum(axis=-1), 1.0, rtol=1e-5)


def test_preferences_switch_at_the_given_rate() -> None:
    agent = make_agent(num_envs=16, env={"time_limit": 60}, steps=100, switching=0.1, cost_growth=0.0)
    agent.begin()
    changes, before = 0, agent.training.current.clone()
    for _ in range(3):
        agent.update(0.0)
        changes += int((agent.training.current != before).any(dim=-1).sum())
        before = agent.training.current.clone()
    assert changes == 48  # 16 environments, of which none keeps its preference for 100 decisions (0.9^100 = 3e-5)
    still = make_agent(num_envs=16, env={"time_limit": 60}, switching=0.0)
    still.begin()
    still.update(0.0)
    before = still.training.current.clone()
    still.update(0.0)
    assert torch.equal(still.training.current, before)


def drawn(agent: ConditionedMOPPO, share: float) -> np.ndarray:
    """Preferences (N, m) of episodes that begin, with a share of the costs; the same draws each time."""
    agent.collector  # noqa: B018  (which makes what draws)
    agent.ideal[:] = torch.tensor([12.0, 0.8, 0.0, -0.1])
    agent.grow_costs(share)
    agent.training.draw(0, torch.Generator().manual_seed(0))
    agent.training.begin_rollout()
    rows = agent.training.follow(0, agent.collector.now.lengths)
    return rows[0, :, 0].numpy().copy()


def test_the_weights_of_costs_grow() -> None:
    agent = make_agent(num_envs=500, concentration=1.0)
    whole, half, none = (drawn(agent, share) for share in (1.0, 0.5, 0.0))
    gains = whole * [1.0, 1.0, 0.0, 0.0]
    np.testing.assert_allclose(none, gains / gains.sum(axis=1, keepdims=True), rtol=1e-4, atol=1e-6)
    np.testing.assert_allclose(half, 0.5 * whole + 0.5 * none, rtol=1e-5, atol=1e-7)


def test_in_a_mixture_weights_grow_and_budgets_are_as_drawn() -> None:
    agent = make_agent(num_envs=400, **MIXTURE)
    usual, growing = (drawn(agent, share) for share in (1.0, 0.0))
    agent.preferences.check(usual)
    agent.preferences.check(growing)
    shares = usual[:, :3].mean(axis=0)
    np.testing.assert_allclose(shares, [0.4, 0.3, 0.3], atol=0.08)
    budgeted = usual[:, 2] == 1.0
    np.testing.assert_array_equal(growing[budgeted], usual[budgeted])
    np.testing.assert_array_equal(growing[~budgeted, 5:7], 0.0)  # of costs, after three families and two gains
    assert (usual[~budgeted, 5:7] > 0.0).any()


def test_costs_have_their_weights_after_the_growth() -> None:
    agent = make_agent(cost_growth=0.5)
    agent.begin()
    seen = []
    for progress in (0.0, 0.25, 0.5, 0.75):
        agent.update(progress)
        seen.append(float(agent.training.cost_share))
    assert seen == [0.0, 0.5, 1.0, 1.0]


def test_an_emphasis_sets_the_share_of_the_weight() -> None:
    preferences = make_agent(concentration=0.5, emphasis={"distance": 3.0, "jerk": 2.0}).preferences
    weights = preferences.draw(20_000, np.random.default_rng(0))
    np.testing.assert_allclose(weights.mean(axis=0), np.array([3.0, 1.0, 1.0, 2.0]) / 7.0, atol=0.01)
    without = preferences.draw(20_000, np.random.default_rng(0), emphasis=False)
    np.testing.assert_allclose(without.mean(axis=0), 0.25, atol=0.01)


# ---------------------------------------------------------------------------------------------------------- checkpoints

PLACES: dict[str, dict[str, Any]] = {
    "discrete": {},
    "continuous": {"env": {**SHORT, **CONTINUOUS}},
    "continuous, one deviation": {"env": {**SHORT, **CONTINUOUS}, "state_dependent_std": False},
    "vector critic": {"vector_critic": True},
    "vector critic of a mixture": {"vector_critic": True, **MIXTURE},
    "mixture": MIXTURE,
    "chebyshev": {"families": {"chebyshev": 1.0}},
    "linear and chebyshev": {"families": {"linear": 0.5, "chebyshev": 0.5}},
    "left turn": {"env_id": LEFT_TURN},
    "growing costs": {"cost_growth": 1.0, "env": {"time_limit": 0.5}},
    "two vehicles": {"env_id": INTERSECTION},
}


@pytest.mark.parametrize("place", PLACES)
def test_a_saved_policy_acts_as_its_agent(place: str, tmp_path: Path) -> None:
    agent, other = make_agent(**PLACES[place]), make_agent(seed=9, num_envs=2, **PLACES[place])
    agent.train(32 * 4)
    agent.save_policy(tmp_path / "policy.safetensors")
    other.load(tmp_path / "policy.safetensors", policy_only=True)
    vehicles, rng = agent.env.vehicles, np.random.default_rng(0)
    observations = rng.normal(size=(50, vehicles, agent.env.observation_size)).astype(np.float32)
    start = AccruedReward.begin(50, vehicles, len(agent.env.objectives))
    start.value -= rng.uniform(0, 5, start.value.shape).astype(np.float32)
    conditions = agent.conditions()
    assert len(conditions) == SMALL["max_policies"]
    for condition in conditions:
        np.testing.assert_array_equal(
            agent.policy(condition).act(observations, start, None),
            other.policy(condition).act(observations, start, None),
        )


def test_a_checkpoint_of_other_preferences_is_refused(tmp_path: Path) -> None:
    make_agent(**MIXTURE).save(tmp_path / "mixture.safetensors")
    with pytest.raises(ValueError, match="has preferences = "):
        make_agent().load(tmp_path / "mixture.safetensors")
    with pytest.raises(ValueError, match="has budgets = "):
        make_agent(**{**MIXTURE, "budgets": {"g_force": 9.0, "jerk": 150.0}}).load(tmp_path / "mixture.safetensors")
    for name in ("rho", "price"):
        with pytest.raises(ValueError, match=f"has {name} = .*; this agent has 7.0"):
            make_agent(**MIXTURE, **{name: 7.0}).load(tmp_path / "mixture.safetensors")
    linear = tmp_path / "linear.safetensors"
    make_agent().save(linear)
    make_agent(rho=7.0, price=7.0).load(linear)  # which linear utilities do not have


def test_training_does_not_go_on_with_another_critic_but_the_policy_acts(tmp_path: Path) -> None:
    scalar, vector = make_agent(), make_agent(vector_critic=True)
    scalar.save(tmp_path / "scalar.safetensors")
    scalar.save_policy(tmp_path / "policy.safetensors")
    with pytest.raises(ValueError, match=r"'vehicle_0.critic.*' of shape \(1, 16\); this agent needs \(4, 16\)"):
        vector.load(tmp_path / "scalar.safetensors")
    vector.load(tmp_path / "policy.safetensors", policy_only=True)
    assert same(scalar.get_policy(), vector.get_policy())


# --------------------------------------------------------------------------------------------------------------- errors


@pytest.mark.parametrize(
    ("family", "numbers", "message"),
    [
        ("gini", {"weights": {"jerk": 1.0}}, "family = 'gini' was not trained; it must be one of linear, chebyshev"),
        ("linear", {}, "family 'linear' needs weights and nothing else"),
        ("linear", {"weights": {"jerk": 1.0}, "budgets": {"jerk": 1.0}}, "needs weights and nothing else"),
        ("comfort_budget", {"weights": {"jerk": 1.0}}, "needs budgets and nothing else"),
        ("comfort_budget", {"budgets": {"distance": 1.0}}, "budgets has 'distance'; it must be one of g_force, jerk"),
        ("comfort_budget", {"budgets": {"jerk": 1e6}}, "budgets of 'jerk' = 1000000.0 must be at most 150.0"),
        ("linear", {"weights": {"comfort": 1.0}}, "weights has 'comfort'; it must be one of distance, "),
        ("linear", {"weights": {"jerk": -1.0}}, "weights of 'jerk' = -1.0 must be finite and not negative"),
        ("chebyshev", {"weights": {"jerk": 0.0}}, "must have a positive number"),
    ],
)
def test_invalid_preferences_are_refused(family: str, numbers: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=re.escape(message)):
        make_agent(**MIXTURE).preferences.condition(family, **numbers)


def test_several_vehicles_have_preferences_of_their_own_and_a_front_of_all_their_objectives() -> None:
    agent = make_agent(INTERSECTION)
    env = make_env(INTERSECTION, 4, SHORT)
    conditions = agent.conditions()
    assert conditions.shape == (6, 12)
    assert agent.condition_names[6] == "vehicle_1/weight/distance"
    found = agent.evaluate_policies(conditions, env, episodes=2, seed=0, gamma=0.99)
    assert [each.returns.shape for each in found] == [(2, 2, 6)] * 6
    front = agent.front(env, episodes=2, seed=0, gamma=0.99)
    assert front.objectives == agent.front_objectives
    assert front.objectives[7] == "vehicle_1/destination"
    for k, condition in enumerate(front.conditions):
        of_row = int(np.flatnonzero((conditions == condition.astype(np.float32)).all(axis=1))[0])
        np.testing.assert_allclose(front.returns[k], found[of_row].returns.mean(axis=0).ravel())
    np.testing.assert_array_equal(agent.front_scales.reshape(2, 6), [agent.scales] * 2)


def test_vehicles_that_share_a_policy_have_preferences_of_their_own() -> None:
    agent = make_agent(ROUNDABOUT, env={}, share_policy=True)
    assert [learner.vehicles for learner in agent.learners] == [(0, 1, 2, 3)]
    agent.train(agent.config.steps * 4)
    assert len(agent.training.current.view(16, -1).unique(dim=0)) == 16
    rows = np.stack([agent.preferences.condition("linear", {name: 1.0}) for name in agent.env.objectives[:4]])
    observations = np.repeat(agent.collector.now.observations[0, :, :1].numpy(), 4, axis=1)
    past = AccruedReward.begin(4, 4, len(agent.env.objectives))
    with torch.no_grad():
        agent.learners[0].actor.body[-1].weight.mul_(300.0)
    actions = agent.policy(rows).act(observations, past, None)
    for v, row in enumerate(rows):
        alike = agent.policy(np.tile(row, (4, 1))).act(observations, past, None)
        np.testing.assert_array_equal(actions[:, v], alike[:, v])
        assert (alike == alike[:, :1]).all()
    with pytest.raises(ValueError, match=re.escape("conditions of shape (1, 3, 10) must be (n, 4, 10)")):
        agent.policy(rows[:3])


def test_conditions_of_the_wrong_shape_or_that_are_no_preference_are_refused() -> None:
    agent = make_agent()
    with pytest.raises(ValueError, match=re.escape("conditions of shape (1, 3) must be (n, 1, 4)")):
        agent.policy([1.0, 0.0, 0.0])
    for weights in ([1.0, np.nan, 0.0, 0.0], [-3.0, 4.0, 0.0, 0.0], [0.5, 0.0, 0.0, 0.0]):
        with pytest.raises(ValueError, match="is no preference; it must have one family"):
            agent.policy(weights)
