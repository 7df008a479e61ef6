"""Rollouts made by hand, and learning from them: the equations of the actor-critics are tested on these."""

from __future__ import annotations

from dataclasses import fields
from functools import partial
from typing import Any

import numpy as np
import torch

from algorithms.actor_critic import ActorCritic
from algorithms.learning.learner import NORM
from algorithms.learning.storage import Rollout
from tests.helpers.agents import EXPECTED_RETURN, FORMS, NONLINEAR, exaggerate, make_agent


def experienced(cls: type[ActorCritic], **hyperparameters: Any) -> tuple[ActorCritic, Any]:
    """An agent far from its initial weights, in which an episode has ended, and its learner."""
    agent = make_agent(cls, num_envs=3, utility=NONLINEAR, **hyperparameters)
    exaggerate(agent)
    agent.learners[0].expected_return[0] = torch.tensor(EXPECTED_RETURN)
    return agent, agent.learners[0]


def samples_of(agent: ActorCritic, rollout: Rollout) -> Any:
    """What is learnt from a rollout, (T N, ...)."""
    samples = agent.samples(agent.learners[0].networks, rollout)
    return samples._make(each if each is None else each.flatten(0, 1) for each in samples)


def learn_from(agent: ActorCritic, rollout: Rollout, rate: float, entropy: float) -> dict[str, float]:
    """Let the only policy learn from a rollout made by hand; the parts of the loss."""
    (learner,) = agent.learners
    storage = agent.collector.storage
    learner.prepare = partial(agent._samples, learner.utility, False)
    learner.order = torch.zeros(1, learner.order.shape[1], rollout.acted.numel(), dtype=torch.int64)
    agent._learning_rate.fill_(rate)
    agent._entropy_coefficient.fill_(entropy)
    agent._draw(0)
    names = [each.name for each in fields(Rollout) if each.name != "utility"]
    tensors = {name: getattr(rollout, name).unsqueeze(0) for name in names}
    tensors["final_inputs"] = tensors["final_states"]
    agent.rollout_of = lambda *_: tensors  # type: ignore[method-assign]
    parts = agent.learn_once(learner, storage)
    return {name: float(part) for name, part in parts.items() if name != NORM}


def handmade(agent: ActorCritic, *, steps: int = 9, masked: bool = False, seed: int = 0) -> Any:
    """A rollout of one vehicle with random content and ends of every kind.

    With ``masked`` a few samples follow every end that do not count, as of a vehicle that has left the road.
    """
    adapter, gamma = agent.env, agent.accrued_discount
    n, o, d = adapter.num_envs, adapter.observation_size, len(adapter.objectives)
    rng = np.random.default_rng(seed)
    scales = adapter.observation_scales, adapter.objective_scales
    observations = rng.normal(size=(steps + 1, n, o)) * scales[0]
    rewards = rng.normal(size=(steps, n, d)) * scales[1] / 10
    terminated, truncated, acted = np.zeros((3, steps, n), dtype=np.bool_)
    accrued, discounts = np.zeros((steps + 1, n, d)), np.ones((steps + 1, n))
    for i in range(n):
        absent = 0
        for t in range(steps):
            acted[t, i] = absent == 0
            kind = rng.integers(0, 8) if acted[t, i] else 7
            # The first world ends in every way, whatever the dice say.
            if i == 0 and t < 6:
                kind = (0, 7, 1, 7, 2, 7)[t] if not masked else kind
            terminated[t, i], truncated[t, i] = kind in (0, 2), kind in (1, 2)
            if kind <= 2 or not acted[t, i]:
                accrued[t + 1, i], discounts[t + 1, i] = 0.0, 1.0
            else:
                accrued[t + 1, i] = accrued[t, i] + discounts[t, i] * rewards[t, i]
                discounts[t + 1, i] = gamma * discounts[t, i]
            if masked:
                absent = int(rng.integers(1, 4)) if kind <= 2 else max(0, absent - 1)
    if adapter.continuous:
        actions = torch.tensor(rng.normal(size=(steps, n, adapter.actions)), dtype=torch.float32)
    else:
        actions = torch.tensor(rng.integers(0, adapter.actions, (steps, n)))
    arrays = {
        "observations": observations,
        "final": rng.normal(size=(steps, n, o)) * scales[0],
        "rewards": rewards,
        "accrued": accrued,
        "discounts": discounts,
    }
    flags = {"terminated": terminated, "truncated": truncated, "acted": acted}
    tensors = {name: torch.tensor(array, dtype=torch.float32) for name, array in arrays.items()}
    observed, final = tensors.pop("observations"), tensors.pop("final")
    nothing = torch.zeros(())
    found: Any = Rollout(
        inputs=nothing,
        states=nothing,
        final_states=nothing,
        actions=actions,
        **tensors,
        **{name: torch.tensor(array) for name, array in flags.items()},
        preferences=torch.zeros(steps, n, 0),
        expected_return=agent.learners[0].expected_return[0],
        ideal=torch.zeros(d),
        utility=agent.learners[0].utility,
    )
    found.observations, found.final = observed, final
    return look(agent, found)


def look(agent: ActorCritic, rollout: Any) -> Any:
    """The rollout, in which networks see its observations and what has been accrued."""
    rollout.inputs = rollout.states = agent.inputs(rollout.observations, rollout.accrued, rollout.discounts)
    after = agent.accrued_discount * rollout.discounts[:-1]
    rollout.final_states = agent.inputs(rollout.final, rollout.next_accrued, after)
    return rollout


def learner_of(form: str, **hyperparameters: Any) -> tuple[ActorCritic, Any]:
    """An agent on OneWaypoint with a non-linear utility, and its learner with larger weights in the actor."""
    cls, settings = FORMS[form]
    agent = make_agent(cls, num_envs=3, utility=NONLINEAR, **{"gamma": 0.9, **settings, **hyperparameters})
    exaggerate(agent)
    learner = agent.learners[0]
    learner.expected_return[0] = torch.tensor(EXPECTED_RETURN)
    return agent, learner


def seen_by(agent: ActorCritic, form: str, observation: Any, accrued: Any, discount: Any) -> torch.Tensor:
    """What the networks see, written out."""
    parts = [observation / agent.observation_scales]
    if form != "a2c":
        parts.append(accrued / agent.objective_scales)
        if form != "without discount":
            parts.append(torch.as_tensor(discount).reshape(1))
    return torch.cat(parts)


def value_scale(agent: Any, form: str) -> Any:
    return 10.0 if form == "a2c" or form.startswith("expected_utility") else agent.objective_scales


def value_of(agent: Any, form: str, *what: Any) -> torch.Tensor:
    value = (value_scale(agent, form) * agent.learners[0].critic(seen_by(agent, form, *what))).detach()
    return value.squeeze(-1) if form == "a2c" else value
