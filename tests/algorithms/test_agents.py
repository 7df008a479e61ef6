"""The actor-critics: that they run, repeat, resume, refuse, and learn; their losses against plain loops."""

from __future__ import annotations

import json
import math
import os
import pickle
from collections.abc import Callable, Iterator
from dataclasses import fields
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium import spaces
from mo_gymnasium.wrappers.vector import MOSyncVectorEnv
from safetensors import safe_open
from safetensors.torch import load_file, save_file

from algorithms import A2C, ALGORITHMS, MOA2C, MOPPO, PCN, PPO
from algorithms.actor_critic import ActorCritic
from algorithms.common.accrued_reward import AccruedReward
from algorithms.common.env_adapter import EnvAdapter, make_env
from algorithms.common.rollout import Rollout, VehicleRollout
from algorithms.evaluation.evaluate import evaluate
from algorithms.learner import Learner
from mo_deepdrive.utilities import make_utility
from tests.helpers.agents import (
    ALL_FORMS,
    CLASSES,
    CONTINUOUS,
    FORMS,
    INTERSECTION,
    MINECART,
    ONE_WAYPOINT,
    SEA,
    STATIC_OBSTACLE,
    exaggerate,
    handmade,
    learner_of,
    make_agent,
    plain_utility,
    recorded,
    same,
    seen_by,
    state,
    value_of,
)


@pytest.fixture
def global_seeds() -> Iterator[Callable[[int], None]]:
    """Seed the global generators for one test. Minecart draws its ore from NumPy's, whatever seed it is reset with."""
    numpy_state, torch_state = np.random.get_state(), torch.get_rng_state()  # noqa: NPY002

    def seed(value: int) -> None:
        np.random.seed(value)  # noqa: NPY002
        torch.manual_seed(value)

    yield seed
    np.random.set_state(numpy_state)  # noqa: NPY002
    torch.set_rng_state(torch_state)


# Running.

PLACES: dict[str, tuple[str, dict[str, Any]]] = {
    "one_waypoint": (ONE_WAYPOINT, {}),
    "one_waypoint, 16 actions": (ONE_WAYPOINT, {"action_type": "discrete-16"}),
    "one_waypoint, continuous": (ONE_WAYPOINT, CONTINUOUS),
    "static_obstacle": (STATIC_OBSTACLE, {}),
    "static_obstacle, continuous": (STATIC_OBSTACLE, CONTINUOUS),
    "intersection": (INTERSECTION, {}),
    "intersection, continuous": (INTERSECTION, CONTINUOUS),
    "deep-sea-treasure": (SEA, {}),
    "minecart": (MINECART, {}),
    "mountaincar, continuous": ("mo-mountaincarcontinuous-v0", {}),
}
EVERYWHERE = pytest.mark.parametrize("place", PLACES)
UPDATES = 3


def small_run(cls: type[ActorCritic], place: str, seed: int = 0, **hyperparameters: Any) -> ActorCritic:
    env_id, arguments = PLACES[place]
    agent = make_agent(cls, env_id, num_envs=2, env=arguments, seed=seed, steps=8, **hyperparameters)
    agent.train(UPDATES * 16)
    return agent


@CLASSES
@EVERYWHERE
def test_training_runs_and_the_policy_gives_valid_actions(cls: type[ActorCritic], place: str) -> None:
    agent = small_run(cls, place)
    assert agent.step == UPDATES * 16
    fresh = state(make_agent(cls, PLACES[place][0], num_envs=2, env=PLACES[place][1], steps=8))
    trained = state(agent)
    for v in range(agent.env.vehicles):
        for name in (f"{v}.actor.body.0.weight", f"{v}.critic.0.weight"):
            assert not torch.equal(trained[name], fresh[name])
    assert all(tensor.isfinite().all() for tensor in trained.values())
    env = make_env(PLACES[place][0], 1, PLACES[place][1])
    observation = env.reset(seed=0)[0][0]
    accrued = np.zeros((agent.env.vehicles, len(agent.env.objectives))).squeeze()
    action = agent.eval(observation, accrued)
    assert env.single_action_space.contains(action)
    np.testing.assert_array_equal(action, agent.eval(observation, accrued_reward=None, discount=1.0))


@CLASSES
@EVERYWHERE
def test_a_seed_determines_every_weight_and_another_seed_gives_others(
    cls: type[ActorCritic], place: str, global_seeds: Callable[[int], None]
) -> None:
    needs_global = place == "minecart"
    runs = []
    for attempt, seed in enumerate((5, 5, 6)):
        global_seeds(0 if needs_global else attempt)
        runs.append(state(small_run(cls, place, seed)))
    assert same(runs[0], runs[1])
    assert not any(
        torch.equal(runs[0][name], runs[2][name])
        for name in runs[0]
        if name.endswith((".weight", ".exp_avg")) and runs[0][name].dim() == 2
    )


@CLASSES
def test_training_does_not_touch_the_global_generators(cls: type[ActorCritic]) -> None:
    before = torch.get_rng_state(), np.random.get_state()[1].copy()  # noqa: NPY002
    small_run(cls, "one_waypoint")
    assert torch.equal(torch.get_rng_state(), before[0])
    assert np.array_equal(np.random.get_state()[1], before[1])  # noqa: NPY002


def test_the_algorithms_are_known_by_their_names() -> None:
    assert ALGORITHMS == {"a2c": A2C, "ppo": PPO, "mo_a2c": MOA2C, "mo_ppo": MOPPO, "pcn": PCN}


@CLASSES
def test_the_networks_have_the_sizes_of_the_paper(cls: type[ActorCritic]) -> None:
    agent = make_agent(cls)
    shapes = {name: tuple(tensor.shape) for name, tensor in agent.learners[0].get_state().items()}
    scalar = cls in (A2C, PPO)
    inputs = 15 if scalar else 15 + 4 + 1
    assert [shapes[f"actor.body.{i}.weight"] for i in (0, 2, 4)] == [(64, inputs), (32, 64), (22, 32)]
    outputs = 1 if scalar else 4
    assert [shapes[f"critic.{i}.weight"] for i in (0, 2, 4)] == [(64, inputs), (32, 64), (outputs, 32)]


def test_mo_a2c_acts_on_the_accrued_reward_and_a2c_does_not() -> None:
    for cls, depends in ((A2C, False), (PPO, False), (MOA2C, True), (MOPPO, True)):
        agent = make_agent(cls)
        exaggerate(agent)
        observation = np.ones(15, dtype=np.float32)
        rng = np.random.default_rng(0)
        actions = {int(agent.eval(observation, rng.normal(0.0, [20.0, 1.0, 5.0, 500.0]))) for _ in range(50)}
        assert (len(actions) > 1) is depends


@CLASSES
def test_eval_is_the_greedy_action_of_the_policy(cls: type[ActorCritic]) -> None:
    agent = make_agent(cls, INTERSECTION)
    exaggerate(agent)
    rng = np.random.default_rng(0)
    observations = rng.normal(0.0, 5.0, (4, 2, agent.env.observation_size)).astype(np.float32)
    accrued = rng.normal(0.0, 5.0, (4, 2, 6)).astype(np.float32)
    accrued_reward = AccruedReward(accrued, np.full((4, 2), 0.5, dtype=np.float32), np.zeros((4, 2), dtype=np.int64))
    together = agent.act(observations, accrued_reward, None)
    for i in range(4):
        np.testing.assert_array_equal(agent.eval(observations[i], accrued[i], 0.5), together[i])


class Toy(gymnasium.Env[Any, Any]):
    """Counts to three."""

    def __init__(self, action_space: spaces.Space[Any], observation_space: spaces.Space[Any] | None = None):
        self.action_space = action_space
        self.observation_space = observation_space or spaces.Box(0.0, 9.0, (2,), dtype=np.float32)
        self.reward_space = spaces.Box(-10.0, 10.0, (2,), dtype=np.float32)
        self.count = 0

    def _observed(self) -> Any:
        if isinstance(self.observation_space, spaces.Discrete):
            return self.count
        return np.full(self.observation_space.shape, self.count, dtype=np.float32)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        self.count = 0
        return self._observed(), {}

    def step(self, action: Any) -> tuple[Any, np.ndarray, bool, bool, dict[str, Any]]:
        assert self.action_space.contains(action)
        self.count += 1
        return self._observed(), np.ones(2, dtype=np.float32), self.count == 3, False, {}


def toy_agent(
    cls: type[ActorCritic], action_space: spaces.Space[Any], observation_space: spaces.Space[Any] | None = None
) -> ActorCritic:
    env = MOSyncVectorEnv(lambda: Toy(action_space, observation_space) for _ in range(2))
    return cls(env, plain_utility(EnvAdapter(env)))


@CLASSES
@pytest.mark.parametrize(
    "action_space",
    [
        spaces.Discrete(3, start=4),
        spaces.Box(np.float32([2.0, -3.0]), np.float32([6.0, -1.0])),
        spaces.Box(-1.0, 1.0, (1,), dtype=np.float32),
    ],
    ids=str,
)
def test_eval_gives_actions_in_the_terms_of_a_foreign_environment(
    cls: type[ActorCritic], action_space: spaces.Space[Any]
) -> None:
    agent = toy_agent(cls, action_space)
    agent.train(32)
    exaggerate(agent, 3e4)
    for value in np.linspace(0.0, 9.0, 7):
        assert action_space.contains(agent.eval(np.full(2, value, dtype=np.float32)))


@CLASSES
def test_eval_of_a_continuous_policy_of_ours_stays_in_the_action_space(cls: type[ActorCritic]) -> None:
    agent = make_agent(cls, env=CONTINUOUS)
    exaggerate(agent, 3e4)
    for value in np.linspace(-9.0, 9.0, 7):
        action = agent.eval(np.full(15, value, dtype=np.float32))
        assert agent.env.vector_env.single_action_space.contains(action)


@CLASSES
def test_eval_understands_the_observations_of_a_foreign_discrete_space(cls: type[ActorCritic]) -> None:
    agent = toy_agent(cls, spaces.Discrete(7), spaces.Discrete(9))
    exaggerate(agent)
    expected = agent.act(np.eye(9, dtype=np.float32)[:, None], AccruedReward.begin(9, 1, 2), None)[:, 0]
    assert len(set(expected.tolist())) > 2
    assert [int(agent.eval(i)) for i in range(9)] == expected.tolist()


# The training loop.


@CLASSES
def test_training_stops_at_the_first_update_that_reaches_the_total(cls: type[ActorCritic]) -> None:
    agent = make_agent(cls, num_envs=4, steps=5)
    agent.train(41)
    assert agent.step == 60
    agent.train(60)
    assert agent.step == 60


@CLASSES
def test_training_stops_when_it_is_told_to(cls: type[ActorCritic]) -> None:
    agent = make_agent(cls, num_envs=4, steps=5)
    seen = []

    def after_update(trained: ActorCritic) -> bool:
        assert trained is agent
        seen.append(trained.step)
        return len(seen) == 2

    agent.train(1000, after_update=after_update)
    assert seen == [20, 40]


def test_metrics_are_logged_every_so_many_updates_and_at_the_end() -> None:
    lines = recorded(make_agent(MOA2C, num_envs=4, steps=5, env={"time_limit": 0.3}), 140, log_interval=3)
    assert [step for step, _ in lines] == [60, 120, 140]
    metrics = lines[0][1]
    assert metrics["train/length"] == 3.0
    names = {"train/utility", "train/success", "train/return/jerk", "loss/policy", "loss/value", "policy/entropy"}
    assert names < metrics.keys()
    assert all(math.isfinite(value) for value in metrics.values())


def test_metrics_of_two_vehicles_are_logged_apart() -> None:
    lines = recorded(make_agent(A2C, INTERSECTION, num_envs=4, steps=5, env={"time_limit": 0.3}), 20)
    for v in (0, 1):
        assert lines[-1][1][f"train/vehicle_{v}/length"] == 3.0
        assert f"vehicle_{v}/loss/policy" in lines[-1][1]


def test_evaluations_happen_before_during_and_after_training() -> None:
    agent = make_agent(A2C, num_envs=4, steps=5, env={"time_limit": 0.5})
    eval_env = make_env(ONE_WAYPOINT, 2, {"time_limit": 0.5})
    lines = recorded(agent, 200, eval_env=eval_env, eval_interval=60, eval_episodes=3, log_interval=1000)
    evaluated = [step for step, metrics in lines if "eval/greedy/utility_esr" in metrics]
    assert evaluated == [0, 60, 120, 180, 200]
    assert all(
        f"eval/{policy}/{name}" in lines[0][1]
        for policy in ("greedy", "stochastic")
        for name in ("utility_esr", "utility_ser", "success", "length", "return/jerk", "discounted_return/jerk")
    )


@CLASSES
def test_schedules_move_from_their_first_value_to_their_last(cls: type[ActorCritic]) -> None:
    settings = {"entropy_start": 0.1, "entropy_end": 0.001, "entropy_until": 0.5}
    agent = make_agent(
        cls, num_envs=4, steps=5, learning_rate=1e-3, learning_rate_end=0.0, **settings, env={"time_limit": 1.0}
    )
    lines = recorded(agent, 200, log_interval=1)
    progress = np.arange(10) / 10
    rates = [metrics["policy/learning_rate"] for _, metrics in lines]
    np.testing.assert_allclose(rates, 1e-3 * (1 - progress), atol=1e-12)
    weights = [metrics["policy/entropy_weight"] for _, metrics in lines]
    np.testing.assert_allclose(weights, 0.1 * 0.01 ** np.minimum(1.0, progress / 0.5))
    assert agent.learners[0].optimiser.param_groups[0]["lr"] == pytest.approx(1e-4)
    constant = agent.Config()
    assert constant.learning_rate_at(0.0) == constant.learning_rate_at(1.0) == constant.learning_rate
    silent = agent.Config(entropy_start=0.0, entropy_end=0.0)
    assert silent.entropy_at(0.5) == 0.0


@CLASSES
def test_the_learners_of_two_vehicles_do_not_share_anything(cls: type[ActorCritic]) -> None:
    objectives = EnvAdapter(make_env(INTERSECTION, 1)).objectives
    mild = make_utility("intersection_linear", objectives)
    strict = make_utility("linear", objectives, weights=[0.0, 0.0, 5.0, 0.0, 1.0, 1.0])
    # Clipping by the common norm of actor and critic would tie the critic to the utility.
    apart = {"steps": 16, "max_grad_norm": 1e9}
    agents = [make_agent(cls, INTERSECTION, utility=[mild, other], **apart) for other in (mild, strict)]
    for agent in agents:
        agent.train(64)  # one update: afterwards the other vehicle drives differently
    first, second = (state(agent) for agent in agents)
    assert all(torch.equal(first[name], second[name]) for name in first if name.startswith("0."))
    assert not torch.equal(first["1.actor.body.0.weight"], second["1.actor.body.0.weight"])
    # A vector critic does not know the utility, a scalar one predicts it.
    assert torch.equal(first["1.critic.0.weight"], second["1.critic.0.weight"]) is (cls not in (A2C, PPO))
    assert not torch.equal(first["0.critic.0.weight"], first["1.critic.0.weight"])


# Losses against plain loops.


@ALL_FORMS
def test_the_next_value_is_zero_after_termination_and_that_of_the_true_final_state_after_truncation(form: str) -> None:
    agent, learner = learner_of(form)
    r = handmade(agent)
    inputs = learner.inputs(r.observations, r.accrued, r.discounts)
    found = learner.next_values(r, inputs, learner.values(inputs[:-1]))
    assert not found.requires_grad
    kinds = set()
    for t in range(len(r.rewards)):
        for i in range(r.rewards.shape[1]):
            terminated, truncated = bool(r.terminated[t, i]), bool(r.truncated[t, i])
            kinds.add((terminated, truncated))
            if terminated:
                expected = torch.zeros_like(found[t, i])
            elif truncated:
                accrued = r.accrued[t, i] + r.discounts[t, i] * r.rewards[t, i]
                expected = value_of(learner, form, r.final[t, i], accrued, 0.9 * r.discounts[t, i])
            else:
                expected = value_of(learner, form, r.observations[t + 1, i], r.accrued[t + 1, i], r.discounts[t + 1, i])
            torch.testing.assert_close(found[t, i], expected, rtol=1e-4, atol=1e-4)
    assert len(kinds) == 4


def test_with_the_past_in_full_a_linear_utility_gives_the_advantages_of_a2c() -> None:
    weights = torch.tensor([0.5, 1.0, 0.03, 0.001])
    utility = make_utility("linear", ("distance", "destination", "g_force", "jerk"), weights=weights.tolist())
    agent = make_agent(MOA2C, num_envs=3, utility=utility, gamma=0.9, gae_lambda=0.8, accrued_gamma=1.0)
    learner, r = agent.learners[0], handmade(agent)
    assert (r.discounts == 1.0).all()
    rng = np.random.default_rng(2)
    values, following = (torch.tensor(rng.normal(size=r.rewards.shape), dtype=torch.float32) for _ in range(2))
    advantages, targets = learner.estimates(r, values, following)
    deltas = (r.rewards + 0.9 * following - values) @ weights
    over = r.terminated | r.truncated
    steps, n = deltas.shape
    for i in range(n):
        later = 0.0
        for t in range(steps - 1, -1, -1):
            later = float(deltas[t, i]) + (0.0 if over[t, i] else 0.9 * 0.8 * later)
            assert float(advantages[t, i]) == pytest.approx(later, rel=1e-4, abs=1e-4)
            # The targets of the critic are the same, one per objective.
            assert float((targets - values)[t, i] @ weights) == pytest.approx(later, rel=1e-4, abs=1e-4)


@pytest.mark.parametrize("cls", [MOA2C, MOPPO])
def test_the_discount_of_the_accrued_reward_is_its_own(cls: type[ActorCritic]) -> None:
    usual = make_agent(cls, gamma=0.9)
    full = make_agent(cls, gamma=0.9, accrued_gamma=1.0)
    assert (usual.gamma, full.gamma) == (0.9, 1.0)
    for agent in (usual, full):
        agent.train(64)
    expected = 1.0 if full.collector.accrued_reward.discounts.size else None
    assert (full.collector.accrued_reward.discounts == expected).all()
    assert usual.collector.accrued_reward.discounts.max() < 1.0
    with pytest.raises(ValueError, match="accrued_gamma"):
        make_agent(cls, accrued_gamma=0.0)


@pytest.mark.parametrize("cls", [MOA2C, MOPPO])
def test_the_accrued_reward_can_be_left_out_of_what_is_seen(cls: type[ActorCritic]) -> None:
    agent = make_agent(cls, observe_accrued=False)
    exaggerate(agent)
    assert agent.learners[0].input_size(agent.env) == 15 + 1
    observation = np.ones(15, dtype=np.float32)
    rng = np.random.default_rng(0)
    assert len({int(agent.eval(observation, rng.normal(0.0, [20.0, 1.0, 5.0, 500.0]))) for _ in range(50)}) == 1
    agent.train(200)


@ALL_FORMS
def test_what_follows_an_end_does_not_enter_the_next_value(form: str) -> None:
    agent, learner = learner_of(form)
    r = handmade(agent)

    def next_values() -> torch.Tensor:
        inputs = learner.inputs(r.observations, r.accrued, r.discounts)
        return learner.next_values(r, inputs, learner.values(inputs[:-1]))

    over = r.terminated | r.truncated
    before = next_values()
    r.observations[1:][over] += 1.0
    after = next_values()
    assert torch.equal(before[over], after[over])
    r.final[r.truncated & ~r.terminated] += 1.0
    changed = (next_values() != after).any(-1)
    assert torch.equal(changed, r.truncated & ~r.terminated)


def u(returns: torch.Tensor) -> float:
    """The non-linear utility of OneWaypoint on maximised returns, written out."""
    d, r, g, j = (float(x) for x in returns)
    if d > 2:
        return 0.5 * d + d * r + 0.1 * g + 0.1 * j
    return 0.5 * d + r - (0.1 * g) ** 2 - (0.1 * j) ** 2


def plain_losses(learner: Any, form: str, r: VehicleRollout, entropy_weight: float) -> dict[str, float]:
    """The losses by loops over single samples."""
    gamma, decay = learner.config.gamma, learner.config.gae_lambda
    steps, n = r.acted.shape
    policy, critic, entropies, advantages = [], [], [], []
    # The slope of u at EXPECTED_RETURN, by hand: there distance is above 2.
    slope = torch.tensor([0.5 + 0.9, 12.0, 0.1, 0.1])
    for t in range(steps):
        for i in range(n):
            if not r.acted[t, i]:
                continue
            advantage: Any = 0.0
            vector: Any = 0.0
            for k in range(t, steps):
                now = r.observations[k, i], r.accrued[k, i], r.discounts[k, i]
                value = value_of(learner, form, *now)
                factor, reward = r.discounts[k, i], r.rewards[k, i]
                if r.terminated[k, i]:
                    following = torch.zeros_like(value)
                elif r.truncated[k, i]:
                    after = r.accrued[k, i] + factor * reward
                    following = value_of(learner, form, r.final[k, i], after, gamma * factor)
                else:
                    following = value_of(
                        learner, form, r.observations[k + 1, i], r.accrued[k + 1, i], r.discounts[k + 1, i]
                    )
                gained = u(reward) if form == "a2c" else reward
                vector = vector + (gamma * decay) ** (k - t) * (gained + gamma * following - value)
                if form == "utility_gradient":
                    advantage = vector @ slope
                elif form == "a2c":
                    advantage = vector
                else:
                    ahead = following if form == "as_printed" else gamma * factor * following
                    difference = u(r.accrued[k, i] + factor * reward + ahead) - u(r.accrued[k, i] + factor * value)
                    advantage = advantage + decay ** (k - t) * difference
                if r.terminated[k, i] or r.truncated[k, i]:
                    break
            scale = learner.config.value_scale if form == "a2c" else learner.objective_scales
            # The critic is at the value itself, so that its error is the advantage.
            critic.append(float(((vector / scale) ** 2).mean()))
            x = seen_by(learner, form, r.observations[t, i], r.accrued[t, i], r.discounts[t, i])
            distribution = torch.distributions.Categorical(logits=learner.actor.body(x).detach())
            policy.append(float(distribution.log_prob(r.actions[t, i])))
            entropies.append(float(distribution.entropy()))
            advantages.append(float(advantage))
    used = np.array(advantages)
    if learner.config.normalise_advantages:
        used = (used - used.mean()) / used.std()
    losses = {
        "loss/policy": -float(np.mean(used * np.array(policy))),
        "loss/value": float(np.mean(critic)),
        "policy/entropy": float(np.mean(entropies)),
    }
    total = losses["loss/policy"] + learner.config.value_coefficient * losses["loss/value"]
    return {"total": total - entropy_weight * losses["policy/entropy"], **losses}


@ALL_FORMS
@pytest.mark.parametrize("normalised", [False, True])
@pytest.mark.parametrize("masked", [False, True])
def test_the_losses_equal_a_plain_loop_over_single_samples(form: str, normalised: bool, masked: bool) -> None:
    agent, learner = learner_of(form, normalise_advantages=normalised, value_coefficient=0.3, gae_lambda=0.8)
    rollout = handmade(agent, masked=masked, seed=3)
    assert bool(rollout.acted.all()) is not masked
    found = {name: float(loss.detach()) for name, loss in learner.losses(rollout, 0.05).items()}
    expected = plain_losses(learner, form, rollout, 0.05)
    assert found.keys() == expected.keys()
    for name, value in expected.items():
        assert found[name] == pytest.approx(value, rel=1e-3, abs=1e-4), name


def gradients(learner: Learner, rollout: VehicleRollout) -> list[torch.Tensor]:
    return list(torch.autograd.grad(learner.losses(rollout, 0.05)["total"], learner.parameters, allow_unused=False))


@ALL_FORMS
@pytest.mark.parametrize("continuous", [False, True])
def test_samples_that_did_not_act_have_no_influence_on_the_gradient(form: str, continuous: bool) -> None:
    agent, learner = learner_of(form, env=CONTINUOUS if continuous else {})
    rollout = handmade(agent, masked=True)
    masked = ~rollout.acted
    assert 0 < masked.sum() < masked.numel() / 2
    before = gradients(learner, rollout)
    generator = torch.Generator().manual_seed(1)
    rollout.rewards[masked] = torch.randn(rollout.rewards[masked].shape, generator=generator) * 100
    rollout.actions[masked] = 1 - rollout.actions[masked].clamp(max=1)
    rollout.observations[:-1][masked] += 3.0
    rollout.accrued[:-1][masked] += 3.0
    after = gradients(learner, rollout)
    for one, other in zip(before, after, strict=True):
        torch.testing.assert_close(one, other, rtol=1e-6, atol=1e-7)
    rollout.rewards[rollout.acted] += 1.0 + torch.randn(rollout.rewards[rollout.acted].shape, generator=generator)
    assert not all(torch.equal(one, other) for one, other in zip(after, gradients(learner, rollout), strict=True))


@ALL_FORMS
def test_a_rollout_in_which_nobody_acted_changes_the_policy_by_nothing(form: str) -> None:
    agent, learner = learner_of(form)
    rollout = handmade(agent)
    rollout.acted[:] = False
    assert all(not gradient.any() for gradient in gradients(learner, rollout))


@pytest.mark.parametrize("cls", [A2C, MOA2C])
def test_an_update_takes_one_clipped_step_of_adam(cls: type[ActorCritic]) -> None:
    agent = make_agent(cls, num_envs=3, max_grad_norm=0.01)
    learner = agent.learners[0]
    rollout = handmade(agent)
    raw = gradients(learner, rollout)
    norm = torch.cat([gradient.flatten() for gradient in raw]).norm()
    assert norm > 0.01
    before = [parameter.detach().clone() for parameter in learner.parameters]
    own = {field.name: getattr(rollout, field.name).unsqueeze(2) for field in fields(Rollout)}
    metrics = learner.update(Rollout(**own), 0.003, 0.05)
    assert metrics.keys() == {"loss/policy", "loss/value", "policy/entropy"}
    for parameter, old, gradient in zip(learner.parameters, before, raw, strict=True):
        clipped = gradient * 0.01 / norm
        # Adam's first step: its running means are corrected to the gradient itself.
        expected = old - 0.003 * clipped / (clipped.abs() + 1e-8)
        torch.testing.assert_close(parameter.detach(), expected, rtol=1e-4, atol=1e-5)


def test_the_expected_return_is_a_running_mean_over_episodes() -> None:
    learner = make_agent(MOA2C, num_envs=1).learners[0]
    learner.finished(np.zeros((0, 4)))
    assert learner.get_state()["expected_return"].tolist() == [0.0] * 4
    learner.finished(np.array([[1.0, 2.0, 3.0, 4.0], [3.0, 2.0, 1.0, 0.0]]))
    assert learner.get_state()["expected_return"].tolist() == [2.0] * 4
    learner.finished(np.array([[12.0] * 4, [2.0] * 4]))
    expected = 0.99**2 * 2.0 + (1 - 0.99**2) * 7.0
    assert learner.get_state()["expected_return"].tolist() == pytest.approx([expected] * 4)
    assert int(learner.get_state()["episodes"]) == 4


# Checkpoints.

SHORT = {"time_limit": 0.8}
SCHEDULES = {"learning_rate_end": 1e-4, "entropy_start": 0.1, "entropy_end": 0.01}
RESUMED: dict[str, tuple[str, str, dict[str, Any]]] = {
    "a2c, one world, one step": ("a2c", ONE_WAYPOINT, {"num_envs": 1, "steps": 1}),
    "a2c": ("a2c", STATIC_OBSTACLE, {"num_envs": 3, "steps": 5}),
    "a2c, continuous": ("a2c", ONE_WAYPOINT, {"num_envs": 8, "steps": 4, "env": CONTINUOUS}),
    "a2c, two vehicles": ("a2c", INTERSECTION, {"num_envs": 3, "steps": 7}),
    "mo_a2c": ("utility_difference", ONE_WAYPOINT, {"num_envs": 8, "steps": 16}),
    "mo_a2c, small": ("utility_difference", ONE_WAYPOINT, {"num_envs": 1, "steps": 3, "hidden": [8]}),
    "mo_a2c, large": ("utility_difference", STATIC_OBSTACLE, {"num_envs": 33, "steps": 2, "hidden": [128, 64, 32]}),
    "mo_a2c, as printed": ("as_printed", STATIC_OBSTACLE, {"num_envs": 4, "steps": 6}),
    "mo_a2c, gradient": ("utility_gradient", ONE_WAYPOINT, {"num_envs": 4, "steps": 6}),
    "mo_a2c, gradient, two vehicles": ("utility_gradient", INTERSECTION, {"num_envs": 4, "steps": 6}),
    "mo_a2c, continuous, two vehicles": ("utility_difference", INTERSECTION, {"num_envs": 2, "env": CONTINUOUS}),
    "mo_a2c, without discount": ("without discount", ONE_WAYPOINT, {"num_envs": 4, "steps": 6}),
    "mo_ppo": ("clipped", STATIC_OBSTACLE, {"num_envs": 4, "steps": 6}),
    "mo_ppo, two vehicles, central": ("clipped", INTERSECTION, {"num_envs": 3, "centralised_critic": True}),
    "mo_a2c, two vehicles, central": ("utility_difference", INTERSECTION, {"centralised_critic": True}),
}


def resumable(name: str, seed: int) -> Any:
    form, env_id, arguments = RESUMED[name]
    cls, settings = {**FORMS, "clipped": (MOPPO, {})}[form]
    env = {**SHORT, **arguments.get("env", {})}
    return make_agent(cls, env_id, seed=seed, **{**settings, **SCHEDULES, **arguments, "env": env})


@pytest.mark.parametrize("name", RESUMED)
@pytest.mark.parametrize("updates", [1, 4])
def test_a_resumed_run_is_the_uninterrupted_run_bit_for_bit(name: str, updates: int, tmp_path: Path) -> None:
    path = tmp_path / "checkpoint.safetensors"
    whole = resumable(name, seed=3)
    per_update = whole.config.steps * whole.env.num_envs
    total = 7 * per_update
    lines = recorded(whole, total, log_interval=3)

    first = resumable(name, seed=3)
    start = recorded(first, total, log_interval=3, after_update=lambda agent: agent.step == updates * per_update)
    first.save(path)
    second = resumable(name, seed=99)  # nothing of its own is left after loading
    second.load(path)
    assert second.step == updates * per_update
    assert same(state(second), state(first))
    rest = recorded(second, total, log_interval=3)

    assert second.step == whole.step
    assert same(state(second), state(whole))
    assert torch.equal(second.generator.get_state(), whole.generator.get_state())
    for key, array in whole.collector.get_state().items():
        np.testing.assert_array_equal(array, second.collector.get_state()[key], err_msg=key)
    assert start + rest == lines


@CLASSES
def test_a_checkpoint_of_an_untrained_agent_starts_the_same_run(cls: type[ActorCritic], tmp_path: Path) -> None:
    fresh = make_agent(cls, seed=1)
    fresh.save(tmp_path / "fresh")
    other = make_agent(cls, seed=1)
    other.load(tmp_path / "fresh")
    for agent in (fresh, other):
        agent.train(64)
    assert same(state(fresh), state(other))


@CLASSES
def test_saving_changes_nothing(cls: type[ActorCritic], tmp_path: Path) -> None:
    plain, saved = make_agent(cls), make_agent(cls)
    plain.train(256)

    def save(agent: ActorCritic) -> bool:
        agent.save(tmp_path / "checkpoint")
        return False

    saved.train(256, after_update=save)
    assert same(state(plain), state(saved))


@CLASSES
def test_training_goes_on_from_a_checkpoint_where_the_environment_cannot_give_its_state(
    cls: type[ActorCritic], tmp_path: Path
) -> None:
    first = make_agent(cls, SEA, steps=8)
    first.train(64)
    first.save(tmp_path / "checkpoint")
    second = make_agent(cls, SEA, steps=8)
    second.load(tmp_path / "checkpoint")
    second.train(128)
    assert second.step == 128


@CLASSES
def test_the_policy_alone_can_be_loaded_for_any_number_of_worlds(cls: type[ActorCritic], tmp_path: Path) -> None:
    trained = make_agent(cls, num_envs=4)
    trained.train(64)
    exaggerate(trained)
    trained.save(tmp_path / "checkpoint")
    other = make_agent(cls, num_envs=1, seed=8)
    other.load(tmp_path / "checkpoint", policy_only=True)
    assert other.step == 0
    observations = np.random.default_rng(0).normal(0.0, 10.0, (50, 15)).astype(np.float32)
    actions = [int(trained.eval(x)) for x in observations]
    assert len(set(actions)) > 1
    assert [int(other.eval(x)) for x in observations] == actions
    with pytest.raises(ValueError, match="num_envs = 4; this agent has 1"):
        other.load(tmp_path / "checkpoint")


@pytest.fixture(scope="module")
def checkpoint(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Of MO-A2C on OneWaypoint with four worlds, after two updates."""
    path = tmp_path_factory.mktemp("checkpoint") / "mo_a2c.safetensors"
    agent = make_agent(MOA2C, steps=8)
    agent.train(64)
    agent.save(path)
    return path


def refused(agent: ActorCritic, path: Path, message: str) -> None:
    """Loading raises ValueError with ``message``, and leaves the agent as it was."""
    before = state(agent)
    for policy_only in (False, True):
        with pytest.raises(ValueError, match=message):
            agent.load(path, policy_only=policy_only)
    assert same(state(agent), before)
    assert agent.step == 0


def test_a_missing_checkpoint_is_refused(tmp_path: Path) -> None:
    refused(make_agent(MOA2C), tmp_path / "absent.safetensors", "absent.safetensors cannot be read")
    refused(make_agent(MOA2C), tmp_path, "cannot be read")


@pytest.mark.parametrize("kept", [0, 4, 8, 100, 0.3, 0.99, -1])
def test_a_truncated_checkpoint_is_refused(checkpoint: Path, tmp_path: Path, kept: float) -> None:
    data = checkpoint.read_bytes()
    broken = tmp_path / "broken.safetensors"
    broken.write_bytes(data[: int(kept * len(data)) if isinstance(kept, float) else kept])
    refused(make_agent(MOA2C), broken, "broken.safetensors cannot be read")


def test_any_other_file_is_refused(checkpoint: Path, tmp_path: Path) -> None:
    other = tmp_path / "other"
    other.write_bytes(pickle.dumps({"weights": [1.0]}) * 100)
    refused(make_agent(MOA2C), other, "other")
    save_file({"weights": torch.zeros(3)}, other)
    refused(make_agent(MOA2C), other, "has .* = None; this agent has")
    save_file({"weights": torch.zeros(3)}, other, metadata={"checkpoint": "{"})
    refused(make_agent(MOA2C), other, "cannot be read")


def test_a_checkpoint_that_lacks_tensors_is_refused(checkpoint: Path, tmp_path: Path) -> None:
    with safe_open(checkpoint, framework="pt") as file:
        metadata = file.metadata()
    tensors = load_file(checkpoint)
    del tensors["vehicle_0.actor.body.0.weight"]
    save_file(tensors, tmp_path / "partial", metadata=metadata)
    refused(make_agent(MOA2C), tmp_path / "partial", "partial")


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: make_agent(A2C), "algorithm = 'mo_a2c'; this agent has 'a2c'"),
        (lambda: make_agent(MOA2C, STATIC_OBSTACLE), "has (environment|observation_size|objectives) = "),
        (lambda: make_agent(MOA2C, SEA), "has (environment|observation_size|objectives|actions) = "),
        (
            lambda: make_agent(MOA2C, env={"objectives": ["distance", "jerk"]}),
            r"objectives = \['distance', 'destination', 'g_force', 'jerk'\]; this agent has \['distance', 'jerk'\]",
        ),
        (
            lambda: make_agent(MOA2C, env={"objectives": ["jerk", "distance", "destination", "g_force"]}),
            "objectives = ",
        ),
        (lambda: make_agent(MOA2C, env=CONTINUOUS), r"actions = \[22, False\]; this agent has \[3, True\]"),
        (lambda: make_agent(MOA2C, env={"action_type": "discrete-16"}), r"actions = \[22, False\]"),
        (lambda: make_agent(MOA2C, hidden=[64, 16]), r"hidden = \[64, 32\]; this agent has \[64, 16\]"),
        (lambda: make_agent(MOA2C, hidden=[64]), r"hidden = \[64, 32\]; this agent has \[64\]"),
        (lambda: make_agent(MOA2C, observe_discount=False), "checkpoint"),
    ],
    ids=[
        "algorithm",
        "scenario",
        "foreign environment",
        "fewer objectives",
        "order of objectives",
        "continuous",
        "action set",
        "hidden sizes",
        "hidden layers",
        "inputs",
    ],
)
def test_a_checkpoint_of_another_agent_is_refused(
    checkpoint: Path, make: Callable[[], ActorCritic], message: str
) -> None:
    refused(make(), checkpoint, message)


def test_a_checkpoint_is_read_without_running_code_from_it(checkpoint: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def forbidden(*_: Any, **__: Any) -> None:
        raise AssertionError("a pickle is being read")

    make_agent(MOA2C, steps=8).load(checkpoint)  # compiled code comes out of Numba's cache, which is a pickle
    for module, name in ((pickle, "load"), (pickle, "loads"), (pickle, "Unpickler"), (torch, "load"), (np, "load")):
        monkeypatch.setattr(module, name, forbidden)
    agent = make_agent(MOA2C, steps=8)
    agent.load(checkpoint)
    assert agent.step == 64


def test_a_checkpoint_is_a_plain_safetensors_file(checkpoint: Path) -> None:
    data = checkpoint.read_bytes()
    size = int.from_bytes(data[:8], "little")
    header = json.loads(data[8 : 8 + size])
    identity = json.loads(header["__metadata__"]["checkpoint"])
    assert identity["algorithm"] == "mo_a2c"
    assert identity["environment"] == ONE_WAYPOINT
    assert identity["step"] == 64
    tensors = load_file(checkpoint)
    assert tensors.keys() == header.keys() - {"__metadata__"}
    assert tensors["vehicle_0.actor.body.0.weight"].shape == (64, 20)
    assert {"vehicle_0.critic.4.bias", "generator", "collector.accrued"} < tensors.keys()


def test_a_failing_save_leaves_the_checkpoint_that_was_there(
    checkpoint: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "checkpoint"
    path.write_bytes(checkpoint.read_bytes())

    def fail(*_: Any, **__: Any) -> None:
        raise OSError("no space left on device")

    monkeypatch.setattr(os, "replace", fail)
    with pytest.raises(OSError, match="no space left"):
        make_agent(A2C).save(path)
    assert path.read_bytes() == checkpoint.read_bytes()
    assert [entry.name for entry in tmp_path.iterdir()] == ["checkpoint"]


# Settings.


@CLASSES
@pytest.mark.parametrize(
    ("name", "near"),
    [
        ("learning_rat", "learning_rate"),
        ("lr_learning_rate", "learning_rate"),
        ("entropy_begin", "entropy_end"),
        ("gae_lamda", "gae_lambda"),
        ("n_steps", "steps"),
    ],
)
def test_an_unknown_hyperparameter_is_refused_with_the_nearest_known_one(
    cls: type[ActorCritic], name: str, near: str
) -> None:
    with pytest.raises(ValueError, match=f"hyperparameters of {cls.name}: '{name}' is unknown; did you mean '{near}'"):
        make_agent(cls, **{name: 1})


def test_a_hyperparameter_of_another_algorithm_is_refused() -> None:
    with pytest.raises(ValueError, match="'value_scale' is unknown"):
        make_agent(MOA2C, value_scale=3.0)
    with pytest.raises(ValueError, match="'advantage' is unknown"):
        make_agent(A2C, advantage="as_printed")


@CLASSES
@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("learning_rate", 0.0),
        ("learning_rate", -1e-3),
        ("learning_rate", 1.5),
        ("learning_rate", "1e-3"),
        ("learning_rate", math.nan),
        ("learning_rate", None),
        ("learning_rate_end", -1e-3),
        ("gamma", 1.01),
        ("gamma", -0.1),
        ("gamma", math.inf),
        ("gae_lambda", 2.0),
        ("steps", 0),
        ("steps", 1.5),
        ("steps", "16"),
        ("steps", True),
        ("hidden", []),
        ("hidden", [0]),
        ("hidden", [64, -32]),
        ("hidden", ["64"]),
        ("hidden", 64),
        ("entropy_start", -0.1),
        ("entropy_start", 0.0),
        ("entropy_end", 0.0),
        ("entropy_until", 0.0),
        ("entropy_until", 1.1),
        ("value_coefficient", 0.0),
        ("max_grad_norm", -0.5),
        ("normalise_advantages", "yes"),
        ("normalise_advantages", 1),
        ("objective_scales", [1.0, 1.0, 1.0]),
        ("objective_scales", [1.0, 1.0, 1.0, 0.0]),
        ("objective_scales", [1.0, 1.0, 1.0, math.nan]),
        ("objective_scales", 1.0),
    ],
)
def test_an_ill_typed_or_unfit_hyperparameter_is_refused_by_name(
    cls: type[ActorCritic], name: str, value: object
) -> None:
    with pytest.raises(ValueError, match=name):
        make_agent(cls, **{name: value})


def test_unfit_hyperparameters_of_one_algorithm_are_refused_by_name() -> None:
    with pytest.raises(ValueError, match="value_scale"):
        make_agent(A2C, value_scale=0.0)
    with pytest.raises(ValueError, match=r"'advantage' = 'as_print'.*'as_printed'"):
        make_agent(MOA2C, advantage="as_print")
    with pytest.raises(ValueError, match="observe_discount"):
        make_agent(MOA2C, observe_discount="no")


def test_every_unfit_hyperparameter_is_named_at_once() -> None:
    with pytest.raises(ValueError, match="gamma") as refusal:
        make_agent(A2C, gamma=2.0, steps=0, hiden=[3])
    assert all(name in str(refusal.value) for name in ("'gamma' = 2.0", "'steps' = 0", "'hidden'"))


@CLASSES
def test_the_settings_of_a_run_are_plain_and_make_the_same_agent_again(cls: type[ActorCritic]) -> None:
    settings = {"seed": 7, "gamma": 0.9, "hidden": [16], "objective_scales": [1.0, 2.0, 3.0, 4.0]}
    agent = make_agent(cls, **settings)
    config = json.loads(json.dumps(agent.get_config()))
    assert config["algorithm"] == cls.name
    assert settings.items() <= config.items()
    assert config["gae_lambda"] == 0.95
    again = make_agent(cls, **{name: value for name, value in config.items() if name != "algorithm"})
    assert again.get_config() == agent.get_config()
    assert same(state(again), state(agent))


def test_objective_scales_replace_those_of_the_environment() -> None:
    assert make_agent(MOA2C).learners[0].objective_scales.tolist() == [10.0, 1.0, 5.0, 500.0]
    scaled = make_agent(MOA2C, objective_scales=[1.0, 2.0, 3.0, 4.0]).learners[0]
    assert scaled.objective_scales.tolist() == [1.0, 2.0, 3.0, 4.0]
    x = scaled.inputs(torch.zeros(15), torch.ones(4), torch.tensor(0.5))
    torch.testing.assert_close(x[15:], torch.tensor([1.0, 1 / 2, 1 / 3, 1 / 4, 0.5]))


@CLASSES
def test_a_utility_of_another_width_is_refused(cls: type[ActorCritic]) -> None:
    narrow = make_utility("linear", ("distance", "jerk"), weights=[1.0, 1.0])
    with pytest.raises(ValueError, match=r"'linear' reads .*'distance', 'jerk'.*the environment emits"):
        make_agent(cls, utility=narrow)


@CLASSES
def test_a_utility_that_reads_our_objectives_in_another_order_is_refused(cls: type[ActorCritic]) -> None:
    utility = make_utility("one_waypoint_linear", ("distance", "destination", "g_force", "jerk"))
    with pytest.raises(ValueError, match="one_waypoint_linear"):
        make_agent(cls, env={"objectives": ["jerk", "distance", "destination", "g_force"]}, utility=utility)


@CLASSES
@pytest.mark.parametrize("number", [1, 3])
def test_another_number_of_utilities_than_vehicles_is_refused(cls: type[ActorCritic], number: int) -> None:
    objectives = EnvAdapter(make_env(INTERSECTION, 1)).objectives
    utility = make_utility("intersection_linear", objectives)
    with pytest.raises(ValueError, match=f"{number} utilities for 2 vehicles"):
        make_agent(cls, INTERSECTION, utility=[utility] * number)
    assert make_agent(cls, INTERSECTION, utility=utility).utilities == [utility, utility]


# Learning.


@CLASSES
def test_deep_sea_treasure_is_learned_in_seconds(cls: type[ActorCritic]) -> None:
    """By Welch's test over 100 episodes each: better than the initial, random policy by four standard errors."""
    agent = make_agent(
        cls,
        SEA,
        num_envs=8,
        utility=make_utility("linear", ("treasure", "time"), weights=[0.5, 0.5]),
        steps=16,
        learning_rate=3e-3,
        entropy_start=0.1,
        entropy_end=0.01,
        objective_scales=[20.0, 20.0],
    )
    env = make_env(SEA, 50)
    before = evaluate(agent, env, episodes=100, greedy=False).episode_utilities()
    agent.train(20_000)
    after = evaluate(agent, env, episodes=100, greedy=False).episode_utilities()
    error = math.sqrt(before.var(ddof=1) / 100 + after.var(ddof=1) / 100)
    assert after.mean() - before.mean() > 4 * error
    # Better than diving at once to the nearest treasure (0.7 after one step).
    assert after.mean() > 0.5 * 0.7 - 0.5 * 1.0


@CLASSES
def test_one_waypoint_is_learned_in_300_000_steps(cls: type[ActorCritic]) -> None:
    agent = make_agent(cls, num_envs=64, steps=8)
    env = make_env(ONE_WAYPOINT, 100)
    before = evaluate(agent, env, greedy=False)
    agent.train(300_000)
    after = evaluate(agent, env, greedy=False)
    assert before.succeeded.mean() < 0.1
    assert after.succeeded.mean() > 0.4
    assert after.episode_utilities().mean() > before.episode_utilities().mean() + 2.0
