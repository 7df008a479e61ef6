"""Numbers that are not finite stop a run where they come from, and episodes without an end are noticed."""

from __future__ import annotations

import math
import re
from typing import Any

import numpy as np
import pytest
import torch

from algorithms.learning.advantages import check_utility_gradient
from algorithms.runs.build import build
from algorithms.runs.config import make_experiment
from mo_deepdrive.evaluation import env_adapter, evaluate
from mo_deepdrive.evaluation.env_adapter import make_env
from mo_deepdrive.support.faults import EndlessEpisode, Fault, NotFinite
from mo_deepdrive.utilities import Utility
from mo_deepdrive.world.objectives import Objective, register_objective
from tests.helpers.agents import INTERSECTION, ONE_WAYPOINT
from tests.helpers.foul import FOUL

pytestmark = pytest.mark.filterwarnings("ignore::RuntimeWarning")

KNOWN_UTILITY = ("a2c", "ppo", "mo_a2c", "mo_ppo", "mocac", "mappo")
ALGORITHMS = (*KNOWN_UTILITY, "pcn", "conditioned_mo_ppo")
BROKEN = ("nan", "inf", "1e30")


def foul_agent(algorithm: str, env_id: str, arguments: dict[str, Any], utility: Any = None, **settings: Any) -> Any:
    """An agent of an experiment with four environments."""
    if algorithm == "pcn":
        settings |= {"gradient_steps": 2, "warmup_episodes": 4}
    known = algorithm in KNOWN_UTILITY
    values = {
        "environment": {"id": env_id, "arguments": arguments},
        "algorithm": {"name": algorithm, "hidden": [8], **settings},
        "training": {"total_timesteps": 4000, "num_envs": 4},
        **({"utility": utility or {"name": "linear", "arguments": {"weights": [1.0, 1.0]}}} if known else {}),
        **({} if known else {"evaluation": {"reference_point": [-1.0, -1.0]}}),
    }
    return build(make_experiment(values))


def stopped(agent: Any) -> str:
    """The message, one line, with which training stops; what the agent has learnt is finite."""
    with pytest.raises(NotFinite) as caught:
        agent.train(4000)
    for name, tensor in agent.get_policy().items():
        assert tensor.isfinite().all(), name
    message = str(caught.value)
    assert re.match(r"(before the first update|in the update after step [\d,]+): [^\n]+$", message), message
    return message


@pytest.mark.slow
@pytest.mark.parametrize("continuous", [False, True], ids=["discrete", "continuous"])
@pytest.mark.parametrize("algorithm", [name for name in ALGORITHMS if name != "mappo"])
def test_what_an_environment_hands_over_is_named(algorithm: str, continuous: bool) -> None:
    for what, part in (("reward", "reward 'gain'"), ("observation", "observation component 0")):
        for number in BROKEN:
            arguments = {what: float(number), "continuous": continuous, "after": 30}
            found = stopped(foul_agent(algorithm, FOUL, arguments))
            assert re.search(rf"foul-v0, environment \d: {part} = \S+; it must be a number", found)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("algorithm", "action_type", "number"),
    [
        ("a2c", "discrete", "nan"),
        ("mo_ppo", "continuous", "nan"),
        ("mo_ppo", "continuous", "1e30"),
        ("mappo", "discrete", "inf"),
        ("pcn", "discrete", "nan"),
    ],
)
@pytest.mark.filterwarnings("ignore:.*draws its scenarios")
def test_an_own_objective_is_named_also_where_collection_is_compiled(
    algorithm: str, action_type: str, number: str, registries: None
) -> None:
    value = float(number)

    def measure(vehicles: Any, v: int, params: Any) -> float:
        return value if vehicles[v].decisions > 15 else 0.5

    register_objective(Objective("own", "1", -1, 1.0, "own", bound=1.0, measure=measure))
    arguments = {"time_limit": 5, "action_type": action_type, "objectives": ["distance", "own"]}
    found = stopped(foul_agent(algorithm, INTERSECTION if algorithm == "mappo" else ONE_WAYPOINT, arguments))
    assert re.search(r"environment \d(, vehicle 0)?: reward 'own' = (nan|-inf|-1e\+30); it must be", found)


@pytest.mark.parametrize("algorithm", KNOWN_UTILITY)
def test_a_utility_is_named_with_the_return_it_was_given(algorithm: str) -> None:
    env_id, arguments = (INTERSECTION, {"objectives": ["distance", "g_force"]}) if algorithm == "mappo" else (FOUL, {})
    root = {"name": "tests.helpers.foul:late_root"} if env_id == FOUL else {"name": f"{__name__}:root_of_costs"}
    found = stopped(foul_agent(algorithm, env_id, arguments, root))
    assert re.search(r"utility '\S+' = nan for the return {'\w+': -?[\d.e-]+, '\w+': -?[\d.e-]+}; it must", found)
    large = {"name": "linear", "arguments": {"weights": [1e38, 1e38]}}
    found = stopped(foul_agent(algorithm, env_id, arguments, large))
    assert re.search(r"utility 'linear' = |loss/policy = \S+, loss/value = (inf|nan)", found)


def root_of_costs(returns: Any) -> Any:
    """Not a number once there has been a cost."""
    return (0.01 + returns[..., 1]) ** 0.5


def test_a_gradient_of_a_utility_must_be_finite() -> None:
    with pytest.raises(NotFinite, match=r"gradient of utility 'root' = \[inf\] at the expected return {'a': 0.0}"):
        check_utility_gradient(Utility("root", ["a"], lambda returns: returns[..., 0] ** 0.5), torch.zeros(1))


def test_losses_and_gradients_that_overflow_stop_the_update_without_normalised_advantages() -> None:
    agent = foul_agent("a2c", FOUL, {"reward": 1e14, "after": 0}, normalise_advantages=False, value_scale=1e-30)
    assert re.search("loss/value = (inf|nan)", stopped(agent))
    agent = foul_agent("ppo", FOUL, {"reward": 1e14, "after": 0}, normalise_advantages=False, value_scale=1e-10)
    assert "the norm of the gradient = inf" in stopped(agent)


@pytest.mark.parametrize("continuous", [False, True])
def test_a_policy_that_has_diverged_does_not_act(continuous: bool) -> None:
    agent = foul_agent("mo_a2c", FOUL, {"continuous": continuous})
    with torch.no_grad():
        agent.learners[0].actor.body[0].weight.fill_(math.nan)
    for greedy in (True, False):
        with pytest.raises(NotFinite, match="environment 0: an output of the policy's network = nan"):
            evaluate(agent, FOUL, episodes=2, env_kwargs={"continuous": continuous}, greedy=greedy)


def first_action(observations: Any, *_: Any) -> Any:
    return np.zeros(len(observations), dtype=np.int64)


@pytest.fixture
def fifty_decisions(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let an episode of another library's environment have at most 50 decisions."""
    monkeypatch.setattr(env_adapter, "LONGEST_EPISODE", 50)


@pytest.mark.usefixtures("fifty_decisions")
@pytest.mark.parametrize(
    ("arguments", "error", "message"),
    [
        ({"reward": math.nan, "after": 3}, NotFinite, "foul-v0, environment 0: reward 'gain' = nan"),
        ({"observation": math.inf, "after": 3}, NotFinite, "foul-v0, environment 0: observation component 0 ="),
        ({"length": 0}, EndlessEpisode, "an episode of foul-v0 has not ended after 50 decisions; limit its length"),
        ({"length": 9, "max_episode_steps": 5}, None, ""),
    ],
)
def test_an_evaluation_refuses_what_is_not_finite_and_ends(
    arguments: dict[str, Any], error: type[Fault] | None, message: str
) -> None:
    if error is None:
        assert evaluate(first_action, FOUL, episodes=2, env_kwargs=arguments).lengths.tolist() == [[5], [5]]
        return
    with pytest.raises(error, match=re.escape(message)):
        evaluate(first_action, FOUL, episodes=2, env_kwargs=arguments)


@pytest.mark.usefixtures("fifty_decisions")
def test_episodes_for_a_front_have_an_end_too() -> None:
    agent = foul_agent("pcn", FOUL, {"length": 0, "max_episode_steps": 6})
    agent.begin()
    assert set(agent.buffer.lengths.tolist()) == {6}
    with pytest.raises(EndlessEpisode, match="before the first update: an episode of foul-v0 has not ended"):
        foul_agent("pcn", FOUL, {"length": 0}).train(100)
    front = foul_agent("conditioned_mo_ppo", FOUL, {"length": 0}, max_policies=2)
    with pytest.raises(EndlessEpisode):
        front.front(make_env(FOUL, 2, {"length": 0}), episodes=1, seed=0, gamma=0.9)
