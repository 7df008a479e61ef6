"""What the tests of the agents share: small agents on every environment, and rollouts made by hand."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest
import torch

from algorithms import A2C, MOA2C, MOPPO, PPO, RulebookPPO
from algorithms.actor_critic import ActorCritic
from algorithms.agent import Agent
from algorithms.learning.storage import Rollout
from mo_deepdrive.evaluation.env_adapter import EnvAdapter, make_env
from mo_deepdrive.utilities import Utility, make_utility

ONE_WAYPOINT = "mo-deepdrive-one-waypoint-v0"
STATIC_OBSTACLE = "mo-deepdrive-static-obstacle-v0"
INTERSECTION = "mo-deepdrive-intersection-v0"
LEFT_TURN = "mo-deepdrive-left-turn-v0"
ROUNDABOUT = "mo-deepdrive-roundabout-v0"
SEA = "deep-sea-treasure-v0"
MINECART = "minecart-v0"
CONTINUOUS = {"action_type": "continuous"}

WITHOUT_RULES = pytest.mark.parametrize("cls", [A2C, PPO, MOA2C, MOPPO])
CLASSES = pytest.mark.parametrize("cls", [A2C, PPO, MOA2C, MOPPO, RulebookPPO])
# Every algorithm in every form of its advantage.
FORMS: dict[str, tuple[type[ActorCritic], dict[str, Any]]] = {
    "a2c": (A2C, {}),
    "utility_difference": (MOA2C, {}),
    "as_printed": (MOA2C, {"advantage": "as_printed"}),
    "utility_gradient": (MOA2C, {"advantage": "utility_gradient"}),
    "expected_utility": (MOA2C, {"advantage": "expected_utility"}),
    "expected_utility, cut short": (MOA2C, {"advantage": "expected_utility", "accrued_discount": 1.0}),
    "without discount": (MOA2C, {"observe_discount": False}),
}
ALL_FORMS = pytest.mark.parametrize("form", FORMS)


def plain_utility(adapter: EnvAdapter) -> Utility:
    """The linear utility of our scenarios, or the sum of the objectives elsewhere."""
    for name in ("one_waypoint_linear", "static_obstacle_linear", "intersection_linear"):
        try:
            return make_utility(name, adapter.objectives)
        except ValueError:
            continue
    return make_utility("linear", adapter.objectives, weights=[1.0] * len(adapter.objectives))


def make_agent(
    cls: type[Agent],
    env_id: str = ONE_WAYPOINT,
    *,
    num_envs: int = 4,
    env: dict[str, Any] | None = None,
    utility: Any = None,
    seed: int = 0,
    **hyperparameters: Any,
) -> Any:
    made = make_env(env_id, num_envs, env)
    adapter = EnvAdapter(made)
    known = [utility or plain_utility(adapter)] if cls.known_utility else []
    if cls is RulebookPPO:
        rules = [{"objective": adapter.objectives[i], "at_most": 1e3} for i in np.flatnonzero(adapter.costs)[:2]]
        hyperparameters = {"rulebook": rules, **hyperparameters}
    return cls(made, *known, seed=seed, **hyperparameters)


def state(agent: ActorCritic) -> dict[str, torch.Tensor]:
    """Weights and the optimiser's state of every learner."""
    return {
        f"{v}.{name}": tensor.clone()
        for v, learner in enumerate(agent.learners)
        for name, tensor in learner.get_state().items()
    }


def experienced(cls: type[ActorCritic], **hyperparameters: Any) -> tuple[Any, Any]:
    """An agent on OneWaypoint far from its initial weights, in which an episode has ended, and its learner."""
    agent = make_agent(cls, num_envs=3, utility=NONLINEAR, **hyperparameters)
    exaggerate(agent)
    agent.learners[0].expected_return[:], agent.learners[0].episodes[:] = torch.tensor(EXPECTED_RETURN), 1
    return agent, agent.learners[0]


def same(first: dict[str, torch.Tensor], second: dict[str, torch.Tensor]) -> bool:
    return first.keys() == second.keys() and all(torch.equal(first[name], second[name]) for name in first)


def exaggerate(agent: Any, factor: float = 300.0) -> None:
    """Take the policies far from their initial, nearly uniform ones."""
    with torch.no_grad():
        for learner in agent.learners:
            learner.actor.body[-1].weight.mul_(factor)


def recorded(agent: ActorCritic, total: int, **arguments: Any) -> list[tuple[int, dict[str, float]]]:
    """Train and return what was logged, without the times."""
    lines: list[tuple[int, dict[str, float]]] = []

    def log(step: int, metrics: dict[str, float]) -> None:
        lines.append((step, {name: value for name, value in metrics.items() if not name.startswith("time/")}))

    agent.train(total, log=log, **arguments)
    return lines


def parameters_of(learner: Any) -> list[torch.nn.Parameter]:
    return [*learner.actor.parameters(), *learner.critic.parameters()]


@dataclass
class Handmade:
    """What one vehicle did and met, as environments hand it over: T steps of N environments.

    Attributes:
        observations: (T + 1, N, o).
        final: (T, N, o) after each step.
        accrued, discounts: (T + 1, N, ...); the others are (T, N, ...).
    """

    observations: torch.Tensor
    final: torch.Tensor
    rewards: torch.Tensor
    accrued: torch.Tensor
    discounts: torch.Tensor
    terminated: torch.Tensor
    truncated: torch.Tensor
    acted: torch.Tensor
    actions: torch.Tensor

    def rollout(self, agent: Any) -> Rollout:
        """As the agent's first policy learns from it."""
        before = self.accrued[:-1], self.discounts[:-1]
        after = before[0] + before[1].unsqueeze(-1) * self.rewards, agent.accrued_discount * before[1]
        inputs, final = agent.inputs(self.observations, self.accrued, self.discounts), agent.inputs(self.final, *after)
        expected = agent.learners[0].expected_return[0]
        names = ("rewards", "accrued", "discounts", "terminated", "truncated", "acted", "actions")
        return Rollout(
            inputs=inputs,
            states=inputs,
            final_states=final,
            **{name: getattr(self, name) for name in names},
            preferences=self.rewards[..., :0],
            outputs=agent.learners[0].actor.body(inputs[:-1]).detach(),
            expected_return=expected,
            ideal=expected,
            utility=agent.utilities[0].unchecked(),
        )


def handmade(agent: ActorCritic, *, steps: int = 9, masked: bool = False, seed: int = 0) -> Handmade:
    """Random content and ends of every kind.

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
    return Handmade(
        actions=actions,
        **{name: torch.tensor(array, dtype=torch.float32) for name, array in arrays.items()},
        **{name: torch.tensor(array) for name, array in flags.items()},
    )


@torch.no_grad()
def samples_of(agent: Any, made: Handmade) -> Any:
    samples = agent.samples(agent.learners[0].networks, made.rollout(agent))
    return type(samples)(*(each if each is None else each.flatten(0, 1) for each in samples))


def loss_of(agent: Any, samples: Any, entropy_coefficient: float = 0.05) -> Any:
    return agent.loss(agent.learners[0].networks, samples, torch.tensor(entropy_coefficient))


def gradients_of(agent: Any, samples: Any, entropy_coefficient: float = 0.05) -> list[torch.Tensor]:
    return [*torch.autograd.grad(loss_of(agent, samples, entropy_coefficient).total, parameters_of(agent.learners[0]))]


def step_of(agent: Any, samples: Any, learning_rate: float = 0.003, entropy_coefficient: float = 0.05) -> Any:
    """Take one gradient step of the first policy on all samples; the parts of the loss."""
    tensors = {name: each.unsqueeze(0) for name, each in samples._asdict().items() if each is not None}
    numbers = torch.tensor(learning_rate), torch.tensor(entropy_coefficient)
    return agent.learners[0].minimise(agent._loss, tensors, [], *numbers)


NONLINEAR = make_utility("one_waypoint_nonlinear", ("distance", "destination", "g_force", "jerk"))
EXPECTED_RETURN = [12.0, 0.9, -4.0, -30.0]


def learner_of(form: str, **hyperparameters: Any) -> tuple[Any, Any]:
    """The same with a form of the advantage."""
    cls, settings = FORMS[form]
    return experienced(cls, **{"gamma": 0.9, **settings, **hyperparameters})


def seen_by(agent: Any, form: str, observation: Any, accrued: Any, discount: Any) -> torch.Tensor:
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
    scale = value_scale(agent, form)
    value: torch.Tensor = (scale * agent.learners[0].critic(seen_by(agent, form, *what))).detach()
    return value.squeeze(-1) if form == "a2c" else value


def diversified(agent: Any) -> Any:
    """The agent with a policy that differs from state to state, far from uniform, and of ours one that moves.

    Of the 22 discrete actions every third one from 3 on is "increase speed".
    """
    with torch.no_grad():
        for learner in agent.learners:
            learner.actor.body[-1].weight.mul_(100.0)
            if agent.env.actions == 22:
                learner.actor.body[-1].bias[3::3] += 10.0
    return agent
