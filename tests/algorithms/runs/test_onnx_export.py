"""Policies as ONNX files: every policy of the zoo, every algorithm, and what the files are driven by."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from algorithms import A2C, zoo
from algorithms.actor_critic import ActorCritic
from algorithms.commands import export
from algorithms.runs.build import build, load_policy
from algorithms.runs.onnx_export import export_onnx
from algorithms.runs.run_directory import Run
from mo_deepdrive.evaluation import evaluate
from mo_deepdrive.evaluation.front import Front
from tests.helpers.agents import INTERSECTION, ONE_WAYPOINT, SEA, exaggerate
from tests.helpers.zoo import experiment_of

onnxruntime = pytest.importorskip("onnxruntime")
pytest.importorskip("onnx")
CONTINUOUS = {"action_type": "continuous"}
FAMILIES = {"families": {"linear": 1.0, "chebyshev": 1.0, "comfort_budget": 1.0}, "budgets": {"jerk": 100.0}}


def session_of(path: Path) -> Any:
    return onnxruntime.InferenceSession(str(path), providers=["CPUExecutionProvider"])


@pytest.mark.slow
@pytest.mark.parametrize("name", zoo.names())
def test_every_policy_of_the_zoo_is_exported_and_acts_as_it_does(
    name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert export.main([name, "--output", str(tmp_path / "policy.onnx")]) == 0
    assert "checked in 1,000 states: differs by at most " in capsys.readouterr().out
    about = session_of(tmp_path / "policy.onnx").get_modelmeta().custom_metadata_map
    experiment = Run.open(name).experiment
    assert (about["environment"], about["algorithm"]) == (experiment.environment.id, experiment.algorithm.name)
    assert {"objectives", "version", "steps"} <= about.keys()


@pytest.mark.slow
@pytest.mark.parametrize(
    ("algorithm", "env_id", "arguments", "settings", "inputs"),
    [
        ("a2c", ONE_WAYPOINT, {}, {"activation": "tanh"}, ["observation"]),
        ("ppo", INTERSECTION, CONTINUOUS, {"state_dependent_std": True}, ["observation"]),
        ("mo_a2c", SEA, {}, {}, ["observation", "accrued_reward", "discount"]),
        ("mo_ppo", INTERSECTION, {}, {"centralised_critic": True}, ["observation", "accrued_reward", "discount"]),
        ("mocac", ONE_WAYPOINT, {"action_type": "discrete-16"}, {}, ["observation", "accrued_reward", "discount"]),
        ("mappo", INTERSECTION, {}, {}, ["observation"]),
        ("conditioned_mo_ppo", INTERSECTION, CONTINUOUS, {}, ["observation", "preference"]),
        (
            "conditioned_mo_ppo",
            ONE_WAYPOINT,
            {},
            {**FAMILIES, "max_policies": 60},
            ["observation", "accrued_reward", "discount", "preference"],
        ),
    ],
)
def test_every_algorithm_is_exported_with_the_inputs_that_it_depends_on(
    algorithm: str, env_id: str, arguments: Any, settings: Any, inputs: list[str], tmp_path: Path
) -> None:
    experiment = experiment_of(algorithm, env_id, arguments, steps=8, hidden=[16, 8], **settings)
    agent = build(experiment)
    if isinstance(agent, ActorCritic):
        exaggerate(agent)
    exported = export_onnx(agent, experiment, tmp_path / "policy.onnx")
    assert exported.difference is not None
    session = session_of(tmp_path / "policy.onnx")
    assert [each.name for each in session.get_inputs()] == inputs
    distribution = ["mean", "std"] if agent.env.continuous else ["logits"]
    assert [each.name for each in session.get_outputs()] == ["action", *distribution]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "policy"),
    [("one_waypoint_continuous-mo_ppo", None), ("intersection_linear-mo_ppo", None), ("one_waypoint_front-pcn", 7)],
)
def test_an_exported_policy_drives_the_episodes_of_the_policy(name: str, policy: int | None, tmp_path: Path) -> None:
    path, run = tmp_path / "policy.onnx", Run.open(name)
    chosen = [] if policy is None else ["--policy", str(policy)]
    assert export.main([name, "--output", str(path), *chosen]) == 0
    session = session_of(path)
    about = session.get_modelmeta().custom_metadata_map
    gamma = float(about["accrued_discount"])
    agent = load_policy(run)
    if policy is not None:
        condition = Front.read(run.path).conditions[policy]
        assert json.loads(about["condition"]) == pytest.approx(condition.tolist())
        agent = agent.policy(condition)
    names = [each.name for each in session.get_inputs()]
    decisions = [0]

    def function(observations: Any, accrued: Any, discounts: Any) -> Any:
        first = discounts == 1.0 if gamma < 1.0 else None
        decisions[0] = 0 if first is not None and first.all() else decisions[0]
        given = {
            "observation": observations,
            "accrued_reward": accrued,
            "discount": discounts,
            "decisions": np.full(discounts.shape, decisions[0]),
        }
        decisions[0] += 1
        return session.run(["action"], {name: given[name] for name in names})[0]

    settings = run.experiment.environment
    options: dict[str, Any] = {"episodes": 10, "env_kwargs": settings.arguments}
    found = evaluate(function, settings.id, gamma=gamma, **options)
    expected = evaluate(agent, settings.id, gamma=gamma, **options)
    np.testing.assert_allclose(found.returns, expected.returns, rtol=1e-4, atol=1e-4)
    np.testing.assert_array_equal(found.ends, expected.ends)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["one_waypoint_linear-ppo", "--output", "policy.pt"], "--output 'policy.pt' must end in .onnx"),
        (["one_waypoint_linear-ppo", "--output", "nowhere/policy.onnx"], "'nowhere/policy.onnx': "),
        (["one_waypoint_linear-ppo", "--output", "a.onnx", "--policy", "0"], "learnt one policy, not a front"),
        (["one_waypoint_front-pcn", "--output", "a.onnx", "--policy", "-1"], "--policy -1 must be from 0 to "),
        (["one_waypoint", "--output", "a.onnx"], "is not a run directory"),
    ],
)
def test_what_cannot_be_exported_is_refused(
    arguments: list[str], message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as ended:
        export.main(arguments)
    assert ended.value.code == 2
    assert message in capsys.readouterr().err


@pytest.mark.parametrize(
    ("factor", "message"),
    [(-1.0, "the file chooses other actions than the policy"), (1.001, "the file differs from the policy by ")],
)
def test_a_file_that_acts_otherwise_than_the_policy_is_not_written(
    factor: float, message: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    experiment = experiment_of("a2c", ONE_WAYPOINT, {}, steps=8, hidden=[16, 8])
    agent, export_graph = build(experiment), torch.onnx.export
    exaggerate(agent)

    def export_another(*arguments: Any, **options: Any) -> None:
        weight = agent.learners[0].actor.body[-1].weight
        with torch.no_grad():
            weight.mul_(factor)
            export_graph(*arguments, **options)
            weight.div_(factor)

    monkeypatch.setattr(torch.onnx, "export", export_another)
    with pytest.raises(ValueError, match=message):
        export_onnx(agent, experiment, tmp_path / "policy.onnx")
    assert not list(tmp_path.iterdir())


def test_an_algorithm_that_acts_in_its_own_way_is_refused(tmp_path: Path) -> None:
    class Own(A2C):
        name = "own"

        def act(self, *_: Any) -> Any:
            return np.zeros(1)

    with pytest.raises(ValueError, match="algorithm 'own' cannot be exported"):
        export_onnx(Own.__new__(Own), None, tmp_path / "policy.onnx")  # type: ignore[arg-type]
