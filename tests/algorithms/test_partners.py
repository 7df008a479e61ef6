"""Training with partners: vehicles that do not learn are driven by runs, policies of the zoo and scripts."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from algorithms.learning.checkpoints import read_checkpoint
from algorithms.learning.threads import set_threads
from algorithms.runs.build import build, load_policy, open_driver
from algorithms.runs.config import make_experiment
from algorithms.runs.run_directory import Run
from mo_deepdrive.evaluation.env_adapter import EnvAdapter, make_env
from mo_deepdrive.evaluation.episodes import evaluate
from mo_deepdrive.evaluation.policy import AccruedReward
from mo_deepdrive.evaluation.team import Team
from tests.helpers.agents import INTERSECTION
from tests.helpers.short_agents import pair_experiment, trained

ZOO = ["intersection_linear-ppo", "intersection_nonlinear-ppo"]
PARTNERS = {"vehicle_1": [*ZOO, "rule:straight_6"]}


def experiment_with(partners: Any, algorithm: str = "ppo", **training: Any) -> Any:
    return pair_experiment(algorithm, partners=partners, **training)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["ppo", "mo_ppo", "a2c", "mo_a2c", "mocac", "mappo"])
def test_one_vehicle_learns_and_the_other_is_driven(name: str) -> None:
    experiment = experiment_with(PARTNERS, name)
    agent = build(experiment)
    (learner,) = agent.learners
    assert learner.vehicles == (0,)
    before = {key: tensor.clone() for key, tensor in learner.get_state().items()}
    observations = agent.env.reset(0)
    past = AccruedReward.begin(8, 2, 6)
    actions = agent.act(observations, past, None)
    for n in range(8):
        driver = open_driver(PARTNERS["vehicle_1"][n % 3], 1, agent.env, "discrete")
        alone = driver.act(observations[n : n + 1], past.take(np.array([n])), None)
        assert actions[n, 1] == alone[0, 1]
    agent.train(400)
    assert any(not torch.equal(before[key], tensor) for key, tensor in learner.get_state().items())
    assert not any(key.startswith("vehicle_1") for key in agent.get_state())


def test_the_other_vehicle_may_learn_instead() -> None:
    agent = trained(experiment_with({"vehicle_0": ["rule:gap_8"]}))
    assert [learner.vehicles for learner in agent.learners] == [(1,)]
    result = evaluate(agent, INTERSECTION, episodes=3, env_kwargs={"time_limit": 6.0})
    script = open_driver("rule:gap_8", 0, agent.env, "discrete")
    pair = evaluate(Team([script, agent]), INTERSECTION, episodes=3, env_kwargs={"time_limit": 6.0})
    np.testing.assert_array_equal(result.returns, pair.returns)


def test_a_run_is_not_resumed_with_other_partners(tmp_path: Path) -> None:
    trained(experiment_with(PARTNERS)).save(tmp_path / "run")
    other = build(experiment_with({"vehicle_1": [*ZOO, "rule:straight_5"]}))
    with pytest.raises(ValueError, match=r"has partners = .*rule:straight_6.*; this agent has .*rule:straight_5"):
        other.load(tmp_path / "run")
    other.load(tmp_path / "run", policy_only=True)  # which says nothing of the partners
    digests = read_checkpoint(tmp_path / "run", {})[1]["partners"]["vehicle_1"]
    assert len(set(digests)) == 3


def saved_run(path: Path, experiment: Any) -> Run:
    run = Run.create(experiment, path)
    trained(experiment).save(run.checkpoint)
    run.unlock()
    return run


@pytest.mark.slow
def test_a_run_drives_the_vehicle_that_it_learnt_whatever_became_of_its_partners(tmp_path: Path) -> None:
    pair = saved_run(tmp_path / "pair", experiment_with({}))
    role = saved_run(tmp_path / "role", experiment_with({"vehicle_1": [str(pair.path)]}))
    env = EnvAdapter(make_env(INTERSECTION, 5))
    observations, past = env.reset(3), AccruedReward.begin(5, 2, 6)
    expected = load_policy(role).act(observations, past, None)
    (pair.path / "checkpoint.safetensors").unlink()
    driver = open_driver(str(role.path), 0, env, "discrete")
    np.testing.assert_array_equal(driver.act(observations, past, None)[:, 0], expected[:, 0])
    with pytest.raises(ValueError, match="did not learn to drive vehicle_1"):
        open_driver(str(role.path), 1, env, "discrete")
    with pytest.raises(ValueError, match=r"training.partners.vehicle_1: checkpoint .* cannot be read"):
        load_policy(role)


def test_a_partner_may_import_only_what_the_experiment_itself_names(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "partner_code.py").write_text(
        "def mine(r):\n    return r[..., 0]\n\n\ndef other(r):\n    return r[..., 0]\n"
    )
    monkeypatch.syspath_prepend(tmp_path)

    def naming(function: str, **training: Any) -> Any:
        values = experiment_with(training.pop("partners", {}), **training).to_dict()
        return make_experiment(values | {"utility": {"name": f"partner_code:{function}"}})

    mine = saved_run(tmp_path / "mine", naming("mine"))
    assert build(naming("mine", partners={"vehicle_1": [str(mine.path)]})).learners[0].vehicles == (0,)
    refused = r"training.partners.vehicle_1: .*utility.name = 'partner_code:mine', code that .*; only code that the exp"
    for experiment in (
        naming("other", partners={"vehicle_1": [str(mine.path)]}),
        experiment_with({"vehicle_1": [str(mine.path)]}),
    ):
        with pytest.raises(ValueError, match=refused):
            build(experiment)


@pytest.mark.parametrize(
    ("partners", "message"),
    [
        ({"vehicle_2": ZOO}, r"training.partners has 'vehicle_2'; .*vehicle_1"),
        ({"vehicle_0": ZOO, "vehicle_1": ZOO}, "none is left to learn"),
        ({"vehicle_1": []}, "training.partners.vehicle_1 must name at least one driver"),
        ({"vehicle_1": ["nobody"]}, r"training.partners.vehicle_1: 'nobody' is not a run directory"),
        ({"vehicle_1": ["rule:gap_3"]}, "'rule:gap_3' drives vehicle_0, not vehicle_1"),
        ({"vehicle_1": ["rule:fast"]}, "no scripted driver 'rule:fast'"),
        ({"vehicle_1": ["one_waypoint_linear-ppo"]}, "cannot drive vehicle_1: a policy for name = "),
        ({"vehicle_1": ["one_waypoint_front-pcn"]}, "is a front of policies"),
        ({"vehicle_1": ["rule:straight_6"] * 9}, "no more than training.num_envs = 8; it has 9"),
    ],
)
def test_partners_that_cannot_drive_are_refused_before_training(partners: Any, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        build(experiment_with(partners))


def test_a_script_of_the_intersection_drives_nowhere_else() -> None:
    env = EnvAdapter(make_env("mo-deepdrive-left-turn-v0", 1))
    with pytest.raises(ValueError, match=r"'rule:gap_3': there are scripted drivers in mo-.*, not in "):
        open_driver("rule:gap_3", 0, env, "discrete")
    assert open_driver("rule:gap_3", 0, EnvAdapter(make_env("mo-deepdrive-intersection-v1", 1)), "discrete")


def test_algorithms_that_learn_fronts_cannot_train_with_partners() -> None:
    values = {
        "environment": {"id": "mo-deepdrive-one-waypoint-v0", "arguments": {"fixed_destination": True}},
        "algorithm": {"name": "pcn"},
        "training": {"total_timesteps": 100, "num_envs": 2, "partners": {"vehicle_0": ["rule:gap_3"]}},
    }
    with pytest.raises(ValueError, match="algorithm 'pcn' cannot train with partners"):
        build(make_experiment(values))


def test_the_threads_of_partners_are_not_those_of_the_run() -> None:
    try:
        build(experiment_with({"vehicle_1": ZOO}, threads=2))
        assert torch.get_num_threads() == 2
    finally:
        set_threads(1)
