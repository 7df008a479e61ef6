"""The plan of the reproduction."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest

from algorithms.reproduction import CLAIM_NUMBERS, FIGURES
from algorithms.reproduction.claims import CLAIMS
from algorithms.reproduction.figures import CURVE_FIGURES, FRONT_FIGURES
from algorithms.reproduction.plan import load_plan, planned_runs
from tests.helpers.reproduction import PLAN, TINY

if TYPE_CHECKING:
    from pathlib import Path


def test_every_run_of_the_plan_has_a_valid_config_and_a_unique_folder(tmp_path: Path) -> None:
    plan = load_plan(PLAN)
    wanted = planned_runs(plan, list(plan.tasks), tmp_path)
    assert len({run.job.path for run in wanted}) == len(wanted) > 100
    seeds = {run.seed for run in wanted}
    assert min(seeds) == plan.first_seed
    assert not seeds & set(range(5)) | seeds & set(range(100, 210))  # seeds of other tables and of tuning
    for run in wanted:
        assert run.job.experiment.training.seed == run.seed
        assert run.job.experiment.evaluation.split == "test"
        assert not run.job.experiment.logging.save_figures


def test_every_claim_and_figure_has_its_tasks_in_the_plan() -> None:
    plan = load_plan(PLAN)
    assert [each.number for each in CLAIMS] == list(CLAIM_NUMBERS) == [1, 2, 3, 4, 5, 6]
    assert set(FIGURES) == {*CURVE_FIGURES, *FRONT_FIGURES}
    assert {figure for each in CLAIMS for figure in each.figures} == set(FIGURES) == {4, 5, 6, 7, 8, 9, 10}
    for each in CLAIMS:
        for task in each.tasks:
            assert {"printed", "best"} <= set(plan.tasks[task].protocols)
    for figure in CURVE_FIGURES.values():
        assert set(figure.tasks) <= set(plan.tasks)


def test_both_algorithms_of_a_protocol_have_the_same_budget_networks_and_environment(tmp_path: Path) -> None:
    plan = load_plan(PLAN)
    compared = 0
    for key, task in plan.tasks.items():
        for protocol_key, protocol in task.protocols.items():
            if set(protocol.variants) != {"a2c", "mo_a2c"}:
                continue
            mine = [
                r.job.experiment for r in planned_runs(plan, [key], tmp_path, seeds=1) if r.protocol == protocol_key
            ]
            for name in ("steps", "learning_rate", "epochs", "minibatches"):
                values = {getattr(each.algorithm.config, name, None) for each in mine}
                assert len(values) == 1, (key, protocol_key, name)
            assert mine[0].training == mine[1].training
            assert mine[0].environment == mine[1].environment
            compared += 1
    # Six tasks as printed and with best effort, two of them also with both vehicles ending together, one continuous.
    assert compared == 2 * 6 + 2 + 1


def test_a_quick_reproduction_differs_only_in_length_and_seeds(tmp_path: Path) -> None:
    plan = load_plan(PLAN)
    whole = {(r.task, r.protocol, r.variant): r for r in planned_runs(plan, list(plan.tasks), tmp_path)}
    quick = planned_runs(plan, list(plan.tasks), tmp_path, quick=True)
    seeds = {
        (r.task, r.protocol): {other.seed for other in quick if (other.task, other.protocol) == (r.task, r.protocol)}
        for r in quick
    }
    assert {len(each) for each in seeds.values()} == {plan.quick_seeds}
    for run in quick:
        other = whole[run.task, run.protocol, run.variant].job.experiment
        assert run.job.experiment.training.total_timesteps < other.training.total_timesteps
        assert run.job.experiment.algorithm == other.algorithm
        assert run.job.experiment.evaluation.final_episodes == 200 < other.evaluation.final_episodes
        assert run.job.experiment.evaluation.interval * 5 == run.job.experiment.training.total_timesteps
    assert {(r.task, r.protocol) for r in quick} >= {(task, "best") for each in CLAIMS for task in each.tasks}


def test_an_invalid_plan_is_refused_with_the_place_of_the_error(tmp_path: Path) -> None:
    path = tmp_path / "plan.yaml"
    path.write_text(TINY.replace("quick_seeds", "quick_seed"))
    with pytest.raises(ValueError, match=r"plan .*quick_seed"):
        load_plan(path)
    path.write_text(TINY.replace("algorithm.gamma", "algorithm.gama"))
    with pytest.raises(ValueError, match=r"one_waypoint_linear/ablation/gamma: .*gama.*gamma"):
        planned_runs(load_plan(path), ["one_waypoint_linear"], tmp_path)
    path.write_text(TINY)
    with pytest.raises(ValueError, match=r"task 'one_waypoint_lineal' is unknown.*one_waypoint_linear"):
        planned_runs(load_plan(path), ["one_waypoint_lineal"], tmp_path)
