"""What the actor-critics share: hyperparameters, single observations, independent learners, centralised critics."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from gymnasium import spaces

from algorithms import A2C, MOA2C, MOCAC, MOPPO, PPO
from algorithms.actor_critic import ActorCritic
from mo_deepdrive.evaluation.env_adapter import EnvAdapter, make_env
from mo_deepdrive.evaluation.policy import AccruedReward
from mo_deepdrive.support.faults import NotFinite
from mo_deepdrive.utilities import make_utility
from tests.helpers.agents import (
    CLASSES,
    CONTINUOUS,
    INTERSECTION,
    ROUNDABOUT,
    SEA,
    WITHOUT_RULES,
    exaggerate,
    make_agent,
    plain_utility,
    recorded,
    state,
)
from tests.helpers.toy_env import toy_worlds


@CLASSES
def test_the_networks_have_the_sizes_of_the_paper(cls: type[ActorCritic]) -> None:
    agent = make_agent(cls)
    shapes = {name: tuple(tensor.shape) for name, tensor in agent.learners[0].get_state().items()}
    scalar = cls in (A2C, PPO)
    inputs = 15 if scalar else 15 + 4 + 1
    assert [shapes[f"actor.body.{i}.weight"] for i in (0, 2, 4)] == [(64, inputs), (32, 64), (22, 32)]
    outputs = 1 if scalar else 4
    assert [shapes[f"critic.{i}.weight"] for i in (0, 2, 4)] == [(64, inputs), (32, 64), (outputs, 32)]


def toy_agent(cls: type[ActorCritic], *spaces_of_env: spaces.Space[Any]) -> ActorCritic:
    env = toy_worlds(*spaces_of_env)
    return cls(env.vector_env, plain_utility(env))


@WITHOUT_RULES
@pytest.mark.parametrize(
    "action_space",
    [
        spaces.Discrete(3, start=4),
        spaces.Box(np.float32([2.0, -3.0]), np.float32([6.0, -1.0])),
        spaces.Box(-1.0, 1.0, (1,), dtype=np.float32),
    ],
    ids=str,
)
def test_eval_returns_actions_of_another_librarys_action_space(
    cls: type[ActorCritic], action_space: spaces.Space[Any]
) -> None:
    agent = toy_agent(cls, action_space)
    agent.train(32)
    exaggerate(agent, 3e4)
    for value in np.linspace(0.0, 9.0, 7):
        assert action_space.contains(agent.eval(np.full((2, 2), value, dtype=np.float32)))


@WITHOUT_RULES
def test_eval_accepts_observations_of_a_discrete_space(cls: type[ActorCritic]) -> None:
    agent = toy_agent(cls, spaces.Discrete(7), spaces.Discrete(9))
    exaggerate(agent)
    expected = agent.act(np.eye(9, dtype=np.float32)[:, None], AccruedReward.begin(9, 1, 2), None)[:, 0]
    assert len(set(expected.tolist())) > 2
    assert [int(agent.eval(i)) for i in range(9)] == expected.tolist()


def test_schedules_run_from_their_first_value_to_their_last() -> None:
    settings = {"entropy_start": 0.1, "entropy_end": 0.001, "entropy_until": 0.5}
    agent = make_agent(A2C, num_envs=4, steps=5, learning_rate=1e-3, learning_rate_end=0.0, **settings)
    lines = recorded(agent, 200, log_interval=1)
    progress = np.arange(10) / 10
    rates = [metrics["policy/learning_rate"] for _, metrics in lines]
    np.testing.assert_allclose(rates, 1e-3 * (1 - progress), atol=1e-12)
    weights = [metrics["policy/entropy_coefficient"] for _, metrics in lines]
    np.testing.assert_allclose(weights, 0.1 * 0.01 ** np.minimum(1.0, progress / 0.5))


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


@CLASSES
def test_vehicles_that_share_a_policy_are_rows_of_one_batch(cls: type[ActorCritic]) -> None:
    agent = make_agent(cls, ROUNDABOUT, share_policy=True, steps=8)
    (learner,) = agent.learners
    assert learner.vehicles == (0, 1, 2, 3)
    agent.train(8 * 4)
    storage = agent.collector.storage
    for name, rows in agent.rollout_of(learner, storage).items():
        if hasattr(storage, name):
            assert torch.equal(rows, getattr(storage, name).flatten(2, 3)), name

    exaggerate(agent)
    observations = agent.collector.now.observations[0].numpy()
    past = AccruedReward.begin(4, 4, len(agent.env.objectives))
    order = [2, 0, 3, 1]
    np.testing.assert_array_equal(
        agent.act(observations[:, order], past, None), agent.act(observations, past, None)[:, order]
    )
    observations = observations.copy()
    observations[2, 1] = np.nan
    with pytest.raises(NotFinite, match="environment 2: an output of the policy's network = nan"):
        agent.act(observations, past, None)


@pytest.mark.parametrize("of_state", [False, True])
def test_deviations_of_actions_depend_on_the_state_where_this_is_asked_for(of_state: bool) -> None:
    agent = make_agent(PPO, env=CONTINUOUS, state_dependent_std=of_state)
    exaggerate(agent, 100.0)
    states = np.repeat(np.random.default_rng(0).normal(0.0, 5.0, (2, 1, 15)).astype(np.float32), 2000, axis=0)
    actions = agent.act(states, AccruedReward.begin(4000, 1, 4), torch.Generator().manual_seed(0))
    first, second = actions.reshape(2, 2000, -1).std(axis=1)
    assert bool((np.abs(np.log(first / second)) > 0.3).any()) is of_state


def test_objective_scales_replace_those_of_the_environment() -> None:
    assert make_agent(MOA2C).objective_scales.tolist() == [10.0, 1.0, 5.0, 500.0]
    scaled = make_agent(MOA2C, objective_scales=[1.0, 2.0, 3.0, 4.0])
    assert scaled.objective_scales.tolist() == [1.0, 2.0, 3.0, 4.0]
    x = scaled.inputs(torch.zeros(15), torch.ones(4), torch.tensor(0.5))
    torch.testing.assert_close(x[15:], torch.tensor([1.0, 1 / 2, 1 / 3, 1 / 4, 0.5]))


def collected(agent: ActorCritic) -> Any:
    """The storage after a rollout, (1, T, N, V, ...)."""
    agent.begin()
    agent.update(0.0)
    return agent.collector.storage


@CLASSES
def test_a_centralised_critic_sees_the_other_vehicle_and_the_actor_does_not(cls: type[ActorCritic]) -> None:
    agent = make_agent(cls, INTERSECTION, num_envs=3, steps=6, centralised_critic=True)
    own = make_agent(cls, INTERSECTION, num_envs=3, steps=6)
    size = agent.env.observation_size
    for learner, alone in zip(agent.learners, own.learners, strict=True):
        assert learner.actor.body[0].in_features == alone.actor.body[0].in_features
        assert learner.critic[0].in_features == alone.critic[0].in_features + size
    storage = collected(agent)
    for v, learner in enumerate(agent.learners):
        mine = agent.rollout_of(learner, storage)
        width = agent.input_size
        for name, inputs in (("states", storage.inputs), ("final_states", storage.final_inputs)):
            assert torch.equal(mine[name][..., :width], inputs[:, :, :, v])
            assert torch.equal(mine[name][..., width:], inputs[:, :, :, 1 - v, :size])


def spied_steps(agent: ActorCritic) -> list[Any]:
    """The steps that the agent's environment will take."""
    seen: list[Any] = []
    inner = agent.env.step

    def spy(actions: Any) -> Any:
        step = inner(actions)
        seen.append(type(step)(*(None if part is None else np.copy(part) for part in step)))
        return step

    agent.env.step = spy  # type: ignore[method-assign]
    return seen


def test_a_vehicle_that_is_cut_alone_is_valued_with_the_last_observation_of_the_other() -> None:
    # A limit on the g-force that random driving soon exceeds.
    limits = {"env": {"harmful_g_force": 0.3, "time_limit": 6.0}, "centralised_critic": True}
    agent = make_agent(MOPPO, INTERSECTION, num_envs=32, steps=100, **limits)
    exaggerate(agent, 30.0)
    seen = spied_steps(agent)
    storage = collected(agent)
    size, alone = agent.env.observation_size, 0
    finals = [agent.states(storage, (v,))["final_states"][0, ..., -size:] for v in range(2)]
    for t, step in enumerate(seen):
        for i, v in zip(*np.nonzero(step.truncated & step.acted), strict=True):
            expected = torch.from_numpy(step.final[i, 1 - v]) / agent.observation_scales
            assert torch.equal(finals[v][t, i], expected)
            alone += int(not step.acted[i, 1 - v])
    assert alone > 5


GRID = {"critic": "categorical", "v_max": [20.0, 1.0]}


@pytest.mark.parametrize(
    ("cls", "env_id", "trained", "other", "policy_only", "message"),
    [
        (PPO, ROUNDABOUT, {"share_policy": True}, {}, False, "has .vehicle_0.actor.body.0.weight. of shape None; this"),
        (MOPPO, INTERSECTION, {"centralised_critic": True}, {}, False, "centralised_critic = True; this agent has"),
        (MOCAC, SEA, GRID, {**GRID, "v_max": [30.0, 1.0]}, False, "critic"),
        # What a policy observes of the past is in these units.
        (MOA2C, SEA, {}, {"objective_scales": [1.0, 2.0]}, True, "has objective_scales = "),
        (MOA2C, SEA, {}, {"accrued_discount": 1.0}, True, "has accrued_discount = 0.99; this agent has 1.0"),
    ],
)
def test_a_checkpoint_of_other_settings_is_refused(
    cls: Any, env_id: str, trained: Any, other: Any, policy_only: bool, message: str, tmp_path: Path
) -> None:
    make_agent(cls, env_id, **trained).save(tmp_path / "checkpoint.safetensors")
    with pytest.raises(ValueError, match=message):
        make_agent(cls, env_id, **other).load(tmp_path / "checkpoint.safetensors", policy_only=policy_only)
