"""The plan of the reproduction."""

from __future__ import annotations

from pathlib import Path

import pytest

from algorithms.studies import CLAIM_NUMBERS, FIGURES
from algorithms.studies.paper_claims import CLAIMS
from algorithms.studies.paper_figures import CURVE_FIGURES, FRONT_FIGURES
from algorithms.studies.paper_plan import QUICK_SEEDS, load_plan, planned_runs
from tests.helpers.reproduction import PLAN, TINY


def test_every_run_of_the_plan_has_a_valid_config_and_a_unique_folder(tmp_path: Path) -> None:
    plan = load_plan(PLAN)
    wanted = planned_runs(plan.select(list(plan.tasks)), tmp_path)
    assert len({run.job.path for run in wanted}) == len(wanted) > 100
    seeds = {run.seed for run in wanted}
    assert min(seeds) == 20
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
    runs = planned_runs(plan.select(list(plan.tasks), seeds=1), tmp_path)
    compared = 0
    for key, task in plan.tasks.items():
        for protocol_key, protocol in task.protocols.items():
            if set(protocol.variants) != {"a2c", "mo_a2c"}:
                continue
            mine = [run.job.experiment for run in runs if (run.task, run.protocol) == (key, protocol_key)]
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
    whole = {(r.task, r.protocol, r.variant): r for r in planned_runs(plan.select(list(plan.tasks)), tmp_path)}
    quick = planned_runs(plan.select(list(plan.tasks), quick=True), tmp_path)
    seeds = {
        (r.task, r.protocol): {other.seed for other in quick if (other.task, other.protocol) == (r.task, r.protocol)}
        for r in quick
    }
    assert {len(each) for each in seeds.values()} == {QUICK_SEEDS}
    for run in quick:
        other = whole[run.task, run.protocol, run.variant].job.experiment
        assert run.job.experiment.training.total_timesteps < other.training.total_timesteps
        assert run.job.experiment.algorithm == other.algorithm
        assert run.job.experiment.evaluation.final_episodes == 200 < other.evaluation.final_episodes
        assert run.job.experiment.evaluation.interval * 5 == run.job.experiment.training.total_timesteps
    assert {(r.task, r.protocol) for r in quick} >= {(task, "best") for each in CLAIMS for task in each.tasks}


def test_fewer_seeds_are_the_first_ones_and_no_task_gets_more_than_it_names(tmp_path: Path) -> None:
    path = tmp_path / "plan.yaml"
    path.write_text(TINY)
    for count, seeds in ((1, {3}), (4, {3, 4, 5, 6})):
        runs = planned_runs(load_plan(path).select(["one_waypoint_linear"], seeds=count), tmp_path)
        assert {run.seed for run in runs if run.protocol == "best"} == seeds
        assert {run.seed for run in runs if run.protocol == "ablation"} == {3}


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("seeds: [3, 4]", "seed: [3, 4]", "study .*'seed'"),
        ("algorithm.gamma", "algorithm.gama", "one_waypoint_linear/ablation learner=gamma.*gama.*gamma"),
        (": one change", ", one change", "'one_waypoint_linear/ablation' must be named TASK/PROTOCOL, with a title"),
    ],
)
def test_an_invalid_plan_is_refused_with_the_place_of_the_error(
    old: str, new: str, message: str, tmp_path: Path
) -> None:
    path = tmp_path / "plan.yaml"
    path.write_text(TINY.replace(old, new))
    with pytest.raises(ValueError, match=message):
        planned_runs(load_plan(path).select(["one_waypoint_linear"]), tmp_path)
