"""Guided starts: another driver begins some episodes of the training, and nothing is learnt from what it does."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch

from algorithms import A2C, MOPPO
from algorithms.hyperparameters import GuideSettings
from algorithms.learning.guides import Guide
from algorithms.runs.build import build, load_policy
from algorithms.runs.config import make_experiment
from algorithms.runs.run_directory import Run
from mo_deepdrive.evaluation.env_adapter import EnvAdapter, make_env
from mo_deepdrive.evaluation.policy import AccruedReward
from mo_deepdrive.evaluation.team import Population
from mo_deepdrive.utilities import make_utility
from tests.helpers.agents import INTERSECTION
from tests.helpers.short_agents import pair_experiment, trained

GUIDED = {"vehicle_0": {"driver": "rule:gap_6", "decisions": 12}}
MARK = 21  # the action of the guide below


def experiment_with(guides: Any, algorithm: str = "ppo", **training: Any) -> Any:
    return pair_experiment(algorithm, guides=guides, **training)


class Constant:
    """A driver whose actions are all MARK."""

    observes_accrued_reward = False
    utilities = ()
    gamma = 1.0
    device = torch.device("cpu")

    def __init__(self, env: EnvAdapter):
        self.env = env

    def act(self, observations: Any, accrued_reward: Any, generator: Any) -> Any:
        del accrued_reward, generator
        return np.full((len(observations), 2), MARK)


def guide_of(num_envs: int, vehicle: int = 0, **settings: Any) -> Guide:
    driver = Population([Constant(EnvAdapter(make_env(INTERSECTION, 1)))], vehicle)
    return Guide(driver, GuideSettings(driver="constant", **settings), num_envs)


def agent_with(guide: Guide, num_envs: int, kind: Any = MOPPO, **options: Any) -> Any:
    env = make_env(INTERSECTION, num_envs)
    return kind(env, make_utility("intersection_linear", EnvAdapter(env).objectives), guides=[guide], **options)


def handovers(guide: Guide, progress: float, episodes: int) -> Any:
    """The decisions of the guide in as many new episodes."""
    guide.begin_rollout(progress)
    past = AccruedReward.begin(episodes, 2, 6)
    guide.drive(
        np.zeros((episodes, 2), np.int64),
        np.zeros((episodes, 2, 29), np.float32),
        past,
        torch.Generator().manual_seed(0),
    )
    return guide.handovers[0]


@pytest.mark.parametrize(("progress", "share"), [(0.0, 0.6), (0.2, 0.3), (0.3, 0.15), (0.4, 0.0), (0.9, 0.0)])
def test_the_share_of_guided_episodes_falls_linearly_to_none(progress: float, share: float) -> None:
    drawn = handovers(guide_of(20_000, share=0.6, until=0.4, decisions=10), progress, 20_000)
    assert (drawn > 0).mean() == pytest.approx(share, abs=0.015)
    if share:
        assert sorted(set(drawn)) == list(range(11))
        np.testing.assert_allclose(np.bincount(drawn)[1:] / (drawn > 0).sum(), 0.1, atol=0.015)


def test_the_guide_drives_its_vehicle_until_it_hands_over_and_its_samples_do_not_count() -> None:
    guide = guide_of(16, share=1.0, until=1.0, decisions=20)
    agent = agent_with(guide, 16, steps=24, hidden=[16])
    agent.begin()
    guide.begin_rollout(0.0)
    agent._draw(0)
    agent.collector.collect()
    rollout = SimpleNamespace(**{name: each[0] for name, each in vars(agent.collector.storage).items()})
    handover = guide.handovers[0]
    ended = (rollout.terminated | rollout.truncated)[:, :, 0].numpy().any(axis=0)
    assert (~ended).sum() >= 8  # episodes that run through the whole rollout
    for n in np.flatnonzero(~ended):
        led = np.arange(24) < handover[n]
        assert (rollout.actions[led, n, 0] == MARK).all()
        np.testing.assert_array_equal(rollout.acted[:, n, 0].numpy(), ~led)
    free = rollout.actions[..., 0][rollout.acted[..., 0]]
    assert (free != MARK).any()  # the learner's own actions
    assert rollout.acted[..., 1].all() or ended.any()
    assert (rollout.actions[..., 1] != MARK).any()


@pytest.mark.parametrize("kind", [A2C, MOPPO])
def test_nothing_is_learnt_from_what_the_guide_does(kind: Any) -> None:
    guide = guide_of(4, share=1.0, until=1.0, decisions=4096)
    agent = agent_with(guide, 4, kind, steps=4, hidden=[16])
    agent.begin()
    guided, other = ([tensor.clone() for tensor in learner.get_weights("actor").values()] for learner in agent.learners)
    agent.update(0.0)
    assert (guide.handovers[0] > 4).all()
    assert all(map(torch.equal, guided, agent.learners[0].get_weights("actor").values()))
    assert not all(map(torch.equal, other, agent.learners[1].get_weights("actor").values()))


def test_a_run_is_not_resumed_with_another_guide(tmp_path: Path) -> None:
    trained(experiment_with(GUIDED)).save(tmp_path / "run")
    changes: tuple[dict[str, Any], ...] = ({"driver": "rule:gap_5"}, {"share": 0.4}, {"until": 0.6}, {"decisions": 11})
    for changed in changes:
        other = build(experiment_with({"vehicle_0": {**GUIDED["vehicle_0"], **changed}}))
        with pytest.raises(ValueError, match=r"has guides = .*rule:gap_6.*decisions = 12.*; this agent has "):
            other.load(tmp_path / "run")
        other.load(tmp_path / "run", policy_only=True)  # of which the guide is no part


@pytest.mark.slow
def test_a_policy_needs_no_guide(tmp_path: Path) -> None:
    pair = Run.create(experiment_with({}), tmp_path / "pair")
    trained(pair.experiment).save(pair.checkpoint)
    pair.unlock()
    run = Run.create(experiment_with({"vehicle_0": {"driver": str(pair.path)}}), tmp_path / "run")
    trained(run.experiment).save(run.checkpoint)
    run.unlock()
    pair.checkpoint.unlink()
    assert not load_policy(run).guides
    with pytest.raises(ValueError, match=r"training.guides.vehicle_0: checkpoint .* cannot be read"):
        build(run.experiment)


@pytest.mark.parametrize(
    ("guides", "message"),
    [
        ({"vehicle_2": {"driver": "rule:gap_6"}}, r"training.guides has 'vehicle_2'; .*vehicle_1"),
        ({"vehicle_0": {"driver": "nobody"}}, r"training.guides.vehicle_0: 'nobody' is not a run directory"),
        (
            {"vehicle_1": {"driver": "rule:gap_6"}},
            "training.guides.vehicle_1: 'rule:gap_6' drives vehicle_0, not vehicle_1",
        ),
        ({"vehicle_0": {}}, r"training.guides.vehicle_0.driver"),
        ({"vehicle_0": {"driver": "rule:gap_6", "share": 0.0}}, r"training.guides.vehicle_0.share"),
        ({"vehicle_0": {"driver": "rule:gap_6", "until": 1.5}}, r"training.guides.vehicle_0.until"),
        ({"vehicle_0": {"driver": "rule:gap_6", "decisions": 0}}, r"training.guides.vehicle_0.decisions"),
        ({"vehicle_0": {"driver": "rule:gap_6", "decision": 9}}, r"did you mean 'decisions'"),
    ],
)
def test_guides_that_cannot_drive_are_refused_before_training(guides: Any, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        build(experiment_with(guides))


def test_a_vehicle_with_partners_has_no_guide() -> None:
    with pytest.raises(ValueError, match="vehicle_0 has a guide, but does not learn: partners drive it"):
        build(experiment_with(GUIDED, partners={"vehicle_0": ["rule:gap_8"]}))


def alone_with(guide: Any, algorithm: Any, **sections: Any) -> Any:
    return make_experiment(
        {
            "environment": {"id": "mo-deepdrive-one-waypoint-v0", "arguments": {"fixed_destination": True}},
            "algorithm": algorithm,
            "training": {"total_timesteps": 400, "num_envs": 8, "guides": {"vehicle_0": guide}},
            **sections,
        }
    )


def test_pcn_and_teams_have_no_guides() -> None:
    with pytest.raises(ValueError, match=r"training.guides: algorithm 'mappo' cannot train with guides"):
        build(experiment_with(GUIDED, "mappo"))
    with pytest.raises(ValueError, match=r"training.guides: algorithm 'pcn' cannot train with guides"):
        build(alone_with({"driver": "one_waypoint_linear-ppo"}, {"name": "pcn"}))


def test_conditioned_mo_ppo_is_guided() -> None:
    guide = {"driver": "one_waypoint_linear-ppo", "share": 1.0, "decisions": 6}
    experiment = alone_with(guide, {"name": "conditioned_mo_ppo", "steps": 8, "hidden": [16]})
    assert trained(experiment).get_state()["guide_0.handover"].max() <= 6


def test_a_vehicle_has_one_guide() -> None:
    env = make_env(INTERSECTION, 4)
    utility = make_utility("intersection_linear", EnvAdapter(env).objectives)
    with pytest.raises(ValueError, match=r"a vehicle has several guides: they are for \[0, 0\]"):
        MOPPO(env, utility, guides=[guide_of(4), guide_of(4)])


def test_a_guide_observes_rewards_that_are_accrued_as_here() -> None:
    env = EnvAdapter(make_env(INTERSECTION, 4))
    utility = make_utility("intersection_linear", env.objectives)
    observer = MOPPO(make_env(INTERSECTION, 4), utility, gamma=0.9)
    guide = Guide(Population([observer], 0), GuideSettings(driver="observer"), 4)
    with pytest.raises(ValueError, match=r"accrued with the discount 0.9; here it is 0.95"):
        agent_with(guide, 4, gamma=0.95)
    assert list(agent_with(guide, 4, gamma=0.9).guides) == [guide]
    with pytest.raises(ValueError, match=r"cost_growth = 0.5 must be 0 with a guide that observes the accrued reward"):
        agent_with(guide, 4, gamma=0.9, cost_growth=0.5)


def test_the_only_vehicle_may_have_a_guide() -> None:
    guide = {"driver": "one_waypoint_linear-ppo", "share": 1.0, "decisions": 50}
    algorithm = {"name": "ppo", "steps": 8, "hidden": [16]}
    agent = build(alone_with(guide, algorithm, utility={"name": "one_waypoint_linear"}))
    agent.train(64)
    handover = agent.get_state()["guide_0.handover"]
    assert handover.min() >= 1
    assert handover.max() <= 50
