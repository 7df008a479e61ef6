"""The compiled collection loop against the plain one, which it must equal bit for bit."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numba
import numpy as np
import pytest
import torch
from algorithms.networks.actors import CategoricalActor
from algorithms.networks.compiled.perceptron import KeptPasses
from algorithms.networks.threads import set_threads
from algorithms.rollouts.compiled_collection import CompiledCollection
from gymnasium.error import ResetNeeded

from algorithms import A2C, MAPPO, MOA2C, MOCAC, MOPPO, PPO, ConditionedMOPPO
from algorithms.actor_critic import ActorCritic
from algorithms.agent import Agent
from algorithms.mo_a2c import MOA2CLearner
from tests.helpers.agents import (
    CONTINUOUS,
    INTERSECTION,
    LEFT_TURN,
    ONE_WAYPOINT,
    ROUNDABOUT,
    SEA,
    STATIC_OBSTACLE,
    make_agent,
    same,
    state,
)

SHORT = {"time_limit": 0.5}  # episodes of five decisions, so that random numbers run out again and again
CHARGED = SHORT | {"action_delay": 2, "charge_remaining_time": True, "harmful_g_force": 0.05}
FAMILIES = {
    "families": {"linear": 0.4, "chebyshev": 0.3, "comfort_budget": 0.3},
    "budgets": {"g_force": 8.0, "jerk": 150.0},
    "switching": 0.2,
    "cost_growth": 0.5,
}
CASES: dict[str, tuple[type[Agent], str, dict[str, Any]]] = {
    "softmax": (A2C, ONE_WAYPOINT, {"num_envs": 300, "env": SHORT, "steps": 40}),
    "Gaussian": (MOA2C, ONE_WAYPOINT, {"num_envs": 20, "env": CONTINUOUS | SHORT, "cost_growth": 0.5}),
    "Gaussian, deviations of the state": (
        MOPPO,
        ONE_WAYPOINT,
        {"num_envs": 20, "env": CONTINUOUS | SHORT, "state_dependent_std": True},
    ),
    "two Gaussians": (MAPPO, INTERSECTION, {"num_envs": 8, "env": CONTINUOUS | SHORT, "state_dependent_std": True}),
    "the past is not observed": (PPO, ONE_WAYPOINT, {"env": SHORT}),
    "other discounts, three layers": (MOPPO, ONE_WAYPOINT, {"accrued_gamma": 1.0, "hidden": [16, 8, 8]}),
    "unfair draws": (MOPPO, STATIC_OBSTACLE, {"num_envs": 64, "env": SHORT, "steps": 30}),
    "two vehicles": (MOA2C, INTERSECTION, {"num_envs": 30, "centralised_critic": True}),
    "a team": (MAPPO, INTERSECTION, {"num_envs": 12, "env": SHORT}),
    "a shared policy": (MOPPO, ROUNDABOUT, {"num_envs": 6, "env": SHORT, "share_policy": True}),
    "a team with a shared policy": (
        MAPPO,
        INTERSECTION,
        {"num_envs": 12, "env": SHORT | CONTINUOUS, "share_policy": True},
    ),
    "measured objectives": (MOA2C, LEFT_TURN, {"num_envs": 12, "env": SHORT}),
    "late actions, ends that are charged": (MOA2C, LEFT_TURN, {"num_envs": 12, "env": CHARGED}),
    "late controls, ends that are charged": (MOA2C, LEFT_TURN, {"num_envs": 12, "env": CONTINUOUS | CHARGED}),
    "preferences": (ConditionedMOPPO, ONE_WAYPOINT, {"num_envs": 20, "env": SHORT, **FAMILIES}),
    "preferences of one family, of two vehicles": (
        ConditionedMOPPO,
        INTERSECTION,
        {"num_envs": 8, "env": CONTINUOUS | SHORT, "families": {"chebyshev": 1.0}},
    ),
    "distributions": (MOCAC, ONE_WAYPOINT, {"num_envs": 12}),
}


def both(cls: type[Agent], env_id: str, **settings: Any) -> tuple[Any, Any]:
    """An agent, and one of the same seed that may not be compiled."""
    one, other = (make_agent(cls, env_id, seed=3, **settings) for _ in range(2))
    other._can_be_compiled = lambda: False
    return one, other


@pytest.mark.slow
@pytest.mark.parametrize("name", CASES)
def test_a_run_is_that_of_the_plain_loop_bit_for_bit(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    # Learning does not take the results of acting, as it cannot in the plain loop.
    monkeypatch.setattr(KeptPasses, "has", lambda *_: False)
    cls, env_id, settings = CASES[name]
    compiled, plain = both(cls, env_id, **settings)
    for agent in (compiled, plain):
        agent.begin()
        for progress in np.linspace(0.0, 1.0, 12, endpoint=False):
            losses = agent.update(float(progress))
        agent.last = losses
    assert compiled._compiled is not None
    assert plain._compiled is None
    assert same(state(compiled), state(plain))
    assert compiled.last == plain.last
    assert len(compiled.episodes) == len(plain.episodes)
    for one, other in zip(compiled.episodes, plain.episodes, strict=True):
        for field, values in vars(one).items():
            np.testing.assert_array_equal(values, vars(other)[field])
    for field in compiled.collector.buffers._fields:
        one, other = (getattr(agent.collector.buffers, field) for agent in (compiled, plain))
        # Of episodes that have not ended, their returns are what was there before.
        rows = compiled.collector.buffers.ended if field.startswith("ended_") else ...
        np.testing.assert_array_equal(one[rows], other[rows])
    if settings.get("env", {}).get("time_limit"):
        drawn = sum(len(episodes.lengths) for episodes in compiled.episodes)
        assert drawn > 16 * compiled.env.num_envs, "no world has used up a block of random numbers"


@pytest.fixture
def threads() -> Iterator[None]:
    yield
    set_threads(1)


@pytest.mark.slow
@pytest.mark.usefixtures("threads")
def test_threads_share_the_worlds() -> None:
    states = []
    for count in (1, 2, 2):
        set_threads(count)
        agent = make_agent(A2C, num_envs=512)  # two parts of whole blocks of rows
        agent.begin()
        for _ in range(3):
            agent.update(0.0)
        assert len(agent._compiled._rollout.parts) == count
        states.append(state(agent))
    assert same(states[0], states[1])
    assert same(states[1], states[2])


@pytest.mark.slow
def test_the_network_is_not_evaluated_again_to_learn(monkeypatch: pytest.MonkeyPatch) -> None:
    agent = make_agent(A2C, num_envs=8)
    agent.begin()
    agent.update(0.0)
    body, rows = agent.learners[0].actor.body, []
    claim = body._claim
    monkeypatch.setattr(body, "_claim", lambda count, weights: rows.append(count) or claim(count, weights))
    agent.update(0.0)
    assert rows == []
    assert body._kept.done == 8 * agent.config.steps


@pytest.mark.slow
def test_an_agent_that_takes_its_earlier_state_does_the_same_again() -> None:
    agent = make_agent(A2C, num_envs=8, env=SHORT)
    agent.begin()
    for _ in range(3):
        agent.update(0.0)
    saved, step = {name: tensor.clone() for name, tensor in agent.get_state().items()}, agent.step
    results = []
    for _ in range(2):
        agent.generator.manual_seed(0)  # as before every update of a training
        for _ in range(5):
            agent.update(0.0)
        results.append(state(agent))
        agent.step = step
        agent.set_state({name: tensor.clone() for name, tensor in saved.items()})
    assert same(*results)


@pytest.mark.slow
@pytest.mark.parametrize("number", ["nan", "inf"])
def test_actions_that_are_not_finite_are_refused(number: str) -> None:
    for agent in both(PPO, ONE_WAYPOINT, env=CONTINUOUS):
        agent.begin()
        with torch.no_grad():
            agent.learners[0].actor.log_std[1] = float(number)
        with pytest.raises(ValueError, match=rf"environment 0: action component 1 = -?{number}"):
            agent.update(0.0)


@pytest.mark.slow
def test_a_scenario_that_is_never_valid_is_an_error(monkeypatch: pytest.MonkeyPatch) -> None:
    agent = make_agent(PPO, STATIC_OBSTACLE, env=SHORT)
    agent.begin()
    agent.update(0.0)
    worlds = agent._compiled._rollout.parts[0]
    worlds.pins["obstacle"][0, :] = worlds.params["starts"][0, 0, :2]  # the bicycle is under the vehicle
    with pytest.raises(ValueError, match="no valid scenario in 1000 draws"):
        agent.update(0.0)


def test_environments_have_to_be_reset_first() -> None:
    with pytest.raises(ResetNeeded, match="has not begun"):
        make_agent(PPO).update(0.0)


class OwnInputs(MOA2CLearner):
    """Sees nothing."""

    def inputs(self, observations: torch.Tensor, accrued: torch.Tensor, discounts: torch.Tensor) -> torch.Tensor:
        return 0.0 * super().inputs(observations, accrued, discounts)


class SeesNothing(MOA2C):
    """MO-A2C with a learner of its own."""

    learner = OwnInputs


class ActsOtherwise(MOA2C):
    """MO-A2C with actions of its own."""

    def act(self, *arguments: Any) -> Any:
        return 0 * super().act(*arguments)


class ExploresOtherwise(MOA2C):
    """MO-A2C that explores in a way of its own."""

    def _explore(self, *arguments: Any) -> Any:
        return 0 * super()._explore(*arguments)


class First(CategoricalActor):
    """Samples the first action alone."""

    def sample(self, x: torch.Tensor, generator: torch.Generator) -> torch.Tensor:
        return 0 * super().sample(x, generator)


class OwnActor(MOA2CLearner):
    """Has an actor of its own."""

    def __init__(self, *arguments: Any):
        super().__init__(*arguments)
        self.actor = First(self.actor.body)


class SamplesOtherwise(MOA2C):
    """MO-A2C with an actor of its own."""

    learner = OwnActor


class OwnScales(MOA2CLearner):
    """Observes in scales of its own."""

    def __init__(self, *arguments: Any):
        super().__init__(*arguments)
        self.observation_scales = 100.0 * self.observation_scales


class ScalesOtherwise(MOA2C):
    """MO-A2C with scales of its own."""

    learner = OwnScales


@pytest.mark.parametrize(
    ("cls", "env_id", "settings"),
    [
        (SeesNothing, ONE_WAYPOINT, {}),
        (ExploresOtherwise, ONE_WAYPOINT, {}),
        (SamplesOtherwise, ONE_WAYPOINT, {}),
        (ScalesOtherwise, ONE_WAYPOINT, {}),
        (ActsOtherwise, ONE_WAYPOINT, {}),
        (MOA2C, ONE_WAYPOINT, {"activation": "tanh"}),
        (MOA2C, SEA, {}),
    ],
)
def test_what_acts_otherwise_is_not_compiled(
    cls: type[ActorCritic], env_id: str, settings: dict[str, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(CompiledCollection, "collect", lambda *_: pytest.fail("compiled"))
    agent = make_agent(cls, env_id, **settings)
    agent.begin()
    agent.update(0.0)
    if cls in (ActsOtherwise, ExploresOtherwise, SamplesOtherwise):
        assert (agent.collector.actions == 0).all()


def test_nothing_is_compiled_where_numba_is_switched_off(monkeypatch: pytest.MonkeyPatch) -> None:
    agent = make_agent(A2C)
    assert agent._can_be_compiled()
    monkeypatch.setattr(numba.config, "DISABLE_JIT", 1)
    assert not agent._can_be_compiled()
