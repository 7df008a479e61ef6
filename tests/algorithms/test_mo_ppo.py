"""MO-PPO: its clipped steps against plain loops and against MO-A2C's; and the centralised critic of every learner."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch

from algorithms import MOA2C, MOPPO
from algorithms.actor_critic import ActorCritic
from algorithms.common.rollout import Rollout
from tests.helpers.agents import (
    CLASSES,
    CONTINUOUS,
    INTERSECTION,
    NONLINEAR,
    exaggerate,
    handmade,
    make_agent,
    same,
    state,
)

ADVANTAGES = pytest.mark.parametrize("advantage", ["utility_difference", "as_printed", "utility_gradient"])


def learner_of(cls: type[ActorCritic], **hyperparameters: Any) -> tuple[ActorCritic, Any]:
    agent = make_agent(cls, num_envs=3, utility=NONLINEAR, **hyperparameters)
    exaggerate(agent)
    agent.learners[0].finished(np.array([[12.0, 0.9, -4.0, -30.0]]))
    return agent, agent.learners[0]


# The clipped steps.


@ADVANTAGES
@pytest.mark.parametrize("env", [{}, CONTINUOUS], ids=["discrete", "continuous"])
@pytest.mark.parametrize("normalised", [False, True])
def test_one_epoch_of_one_minibatch_is_the_step_of_mo_a2c(
    advantage: str, env: dict[str, Any], normalised: bool
) -> None:
    settings = {"advantage": advantage, "env": env, "normalise_advantages": normalised}
    one, clipped = learner_of(MOPPO, epochs=1, minibatches=1, **settings)
    other, plain = learner_of(MOA2C, **settings)
    for agent, learner in ((one, clipped), (other, plain)):
        metrics = learner.learn(handmade(agent, masked=True), 0.05)
        assert metrics["policy/entropy"] > 0.0
    for mine, theirs in zip(clipped.parameters, plain.parameters, strict=True):
        torch.testing.assert_close(mine, theirs, rtol=1e-4, atol=1e-5)


def recorded_steps(learner: Any, rollout: Any, monkeypatch: pytest.MonkeyPatch) -> list[Any]:
    """The samples of every gradient step while learning from ``rollout``."""
    taken: list[Any] = []
    inner = learner._step

    def spy(samples: Any, entropy_weight: float) -> Any:
        taken.append(samples)
        return inner(samples, entropy_weight)

    monkeypatch.setattr(learner, "_step", spy)
    learner.learn(rollout, 0.05)
    return taken


@pytest.mark.parametrize(("epochs", "minibatches"), [(1, 1), (3, 4), (2, 5), (1, 1000)])
def test_every_epoch_uses_every_sample_that_counts_once(
    epochs: int, minibatches: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    agent, learner = learner_of(MOPPO, epochs=epochs, minibatches=minibatches)
    rollout = handmade(agent, steps=12, masked=True)
    count = int(rollout.acted.sum())
    assert 10 < count < rollout.acted.numel()
    mine = sorted(float(reward) for reward in rollout.observations[:-1][rollout.acted][:, 0] / 1.0)
    steps = recorded_steps(learner, rollout, monkeypatch)
    per_epoch = min(minibatches, count)
    assert len(steps) == epochs * per_epoch
    for first in range(0, len(steps), per_epoch):
        batch = steps[first : first + per_epoch]
        sizes = [len(samples.actions) for samples in batch]
        assert sum(sizes) == count
        assert max(sizes) - min(sizes) <= 1
        seen = torch.cat([samples.inputs[:, 0] * learner.observation_scales[0] for samples in batch])
        assert sorted(seen.tolist()) == pytest.approx(mine)
    if epochs > 1:
        assert not torch.equal(steps[0].inputs, steps[per_epoch].inputs)  # in another order


def test_the_old_policy_and_the_advantages_stay_those_of_the_collection(monkeypatch: pytest.MonkeyPatch) -> None:
    agent, learner = learner_of(MOPPO, epochs=3, minibatches=1, learning_rate=0.01)
    rollout = handmade(agent)
    steps = recorded_steps(learner, rollout, monkeypatch)

    def ordered(samples: Any, values: torch.Tensor) -> torch.Tensor:
        return values[samples.inputs[:, 0].argsort()]

    for later in steps[1:]:
        for name in ("log_probability", "advantages", "targets"):
            first = ordered(steps[0], getattr(steps[0], name))
            assert torch.equal(ordered(later, getattr(later, name)), first), name


def test_the_loss_is_the_clipped_surrogate_written_out_and_clipped_samples_have_no_gradient() -> None:
    agent, learner = learner_of(MOPPO, clip=0.2, value_coefficient=1e-9, max_grad_norm=1e9)
    samples = learner._samples(handmade(agent, steps=20))
    # As if the policy had moved since: ratios on both sides of the clip.
    shift = torch.linspace(-0.6, 0.6, len(samples.actions))
    samples = samples._replace(log_probability=samples.log_probability + shift)
    terms, counts = [], []
    for row in range(len(shift)):
        ratio, advantage = float(torch.exp(-shift[row])), float(samples.advantages[row])
        terms.append(min(ratio * advantage, min(max(ratio, 0.8), 1.2) * advantage))
        counts.append(not ((ratio > 1.2 and advantage > 0) or (ratio < 0.8 and advantage < 0)))
    assert 0 < sum(counts) < len(counts)
    learner.optimiser = torch.optim.SGD(learner.parameters, lr=0.0)
    found = learner._step(samples, 0.0)
    assert float(found["loss/policy"]) == pytest.approx(-np.mean(terms), rel=1e-4)
    assert float(found["policy/clipped"]) == pytest.approx(float(((torch.exp(-shift) - 1).abs() > 0.2).float().mean()))
    gradient = [parameter.grad.clone() for parameter in learner.actor.parameters()]
    # The same gradient from the samples that count alone, at their share of the mean.
    chosen = torch.tensor(counts)
    learner._step(samples.at(chosen), 0.0)
    share = sum(counts) / len(counts)
    for mine, theirs in zip(gradient, learner.actor.parameters(), strict=True):
        torch.testing.assert_close(mine, share * theirs.grad, rtol=1e-3, atol=1e-6)


def test_samples_that_did_not_act_change_nothing() -> None:
    results = []
    for noise in (0.0, 5.0):
        agent, learner = learner_of(MOPPO)
        rollout = handmade(agent, masked=True)
        masked = ~rollout.acted
        rollout.rewards[masked] += noise
        rollout.observations[:-1][masked] += noise
        rollout.accrued[:-1][masked] += noise
        learner.learn(rollout, 0.05)
        results.append(state(agent))
    assert same(*results)


def test_a_rollout_in_which_nobody_acted_changes_nothing() -> None:
    agent, learner = learner_of(MOPPO)
    rollout = handmade(agent)
    rollout.acted[:] = False
    before = state(agent)
    assert learner.learn(rollout, 0.05) == {}
    assert same(before, state(agent))


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"epochs": 0}, "'epochs' = 0"),
        ({"minibatches": 0}, "'minibatches' = 0"),
        ({"clip": 0.0}, "'clip' = 0.0"),
        ({"clip": 1.0}, "'clip' = 1.0"),
        ({"minibatch": 4}, "did you mean 'minibatches'"),
    ],
)
def test_unfit_settings_are_refused_by_name(settings: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        make_agent(MOPPO, **settings)


# The centralised critic.


def joint_rollout(agent: ActorCritic) -> Rollout:
    agent.collector.reset(3)
    rollout, _ = agent.collector.collect(agent._explore)
    return rollout


@CLASSES
def test_a_centralised_critic_sees_the_other_vehicle_and_the_actor_does_not(cls: type[ActorCritic]) -> None:
    agent = make_agent(cls, INTERSECTION, num_envs=3, steps=6, centralised_critic=True)
    own = make_agent(cls, INTERSECTION, num_envs=3, steps=6)
    size = agent.env.observation_size
    for learner, alone in zip(agent.learners, own.learners, strict=True):
        assert learner.actor.body[0].in_features == alone.actor.body[0].in_features
        assert learner.critic[0].in_features == alone.critic[0].in_features + size
    rollout = joint_rollout(agent)
    for v, learner in enumerate(agent.learners):
        mine = rollout.of_vehicle(v, agent.device)
        inputs = learner.inputs(mine.observations, mine.accrued, mine.discounts)
        seen = learner.critic_inputs(inputs, mine.others)
        assert torch.equal(seen[..., : inputs.shape[-1]], inputs)
        other = rollout.observations[:, :, 1 - v] / learner.observation_scales
        assert torch.equal(seen[..., inputs.shape[-1] :], other)
        assert torch.equal(mine.observations, rollout.observations[:, :, v])


@CLASSES
def test_a_critic_of_its_own_does_not_see_the_other_vehicle(cls: type[ActorCritic]) -> None:
    agent = make_agent(cls, INTERSECTION, num_envs=3, steps=6)
    mine = joint_rollout(agent).of_vehicle(0, agent.device)
    inputs = agent.learners[0].inputs(mine.observations, mine.accrued, mine.discounts)
    assert agent.learners[0].critic_inputs(inputs, mine.others) is inputs


@CLASSES
def test_the_value_after_a_time_limit_is_that_of_what_both_vehicles_saw_last(cls: type[ActorCritic]) -> None:
    agent = make_agent(cls, INTERSECTION, num_envs=2, steps=6, env={"time_limit": 0.3}, centralised_critic=True)
    rollout = joint_rollout(agent)
    learner = agent.learners[1]
    mine = rollout.of_vehicle(1, agent.device)
    cut = mine.truncated & ~mine.terminated
    assert cut.any()
    inputs = learner.critic_inputs(learner.inputs(mine.observations, mine.accrued, mine.discounts), mine.others)
    found = learner.next_values(mine, inputs, learner.values(inputs[:-1]).detach())
    for t, i in cut.nonzero().tolist():
        accrued = mine.accrued[t, i] + mine.discounts[t, i] * mine.rewards[t, i]
        final = learner.inputs(rollout.final[t, i, 1], accrued, mine.discounts[t, i] * agent.config.gamma)
        expected = learner.critic(torch.cat([final, rollout.final[t, i, 0] / learner.observation_scales]))
        scale = getattr(learner.config, "value_scale", None) or learner.objective_scales
        torch.testing.assert_close(found[t, i], (scale * expected).detach())
        # Not what the next episode begins with.
        assert not torch.equal(rollout.final[t, i], rollout.observations[t + 1, i])


def test_a_vehicle_that_ends_alone_leaves_what_the_other_saw_at_that_moment() -> None:
    # A limit on the g-force that random driving soon exceeds.
    agent = make_agent(MOPPO, INTERSECTION, num_envs=16, steps=64, env={"harmful_g_force": 0.3})
    exaggerate(agent)
    worlds, seen = agent.env, []
    inner = worlds.step

    def spy(actions: Any) -> Any:
        seen.append(inner(actions))
        return seen[-1]

    worlds.step = spy  # type: ignore[method-assign]
    rollout = joint_rollout(agent)
    alone = 0
    for t, step in enumerate(seen):
        for i, v in zip(*np.nonzero(step.terminated | step.truncated), strict=True):
            np.testing.assert_array_equal(rollout.of_vehicle(v, agent.device).final_others[t, i], step.final[i, 1 - v])
            alone += int(not (step.terminated | step.truncated)[i].all())
    assert alone > 5


@CLASSES
def test_a_centralised_critic_is_refused_for_one_vehicle(cls: type[ActorCritic]) -> None:
    with pytest.raises(ValueError, match="centralised_critic = True needs an environment with more than one vehicle"):
        make_agent(cls, centralised_critic=True)


def test_a_checkpoint_of_a_centralised_critic_is_refused_by_one_of_its_own(tmp_path: Any) -> None:
    path = tmp_path / "checkpoint.safetensors"
    make_agent(MOPPO, INTERSECTION, centralised_critic=True).save(path)
    with pytest.raises(ValueError, match="centralised_critic = True; this agent has False"):
        make_agent(MOPPO, INTERSECTION).load(path)
