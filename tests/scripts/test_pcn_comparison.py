"""``scripts/pcn_comparison.py``: PCN beside morl-baselines' PCN."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import pytest

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path
    from types import ModuleType

    from tests.helpers.script_runs import Call


@pytest.fixture
def comparison(load_script: Callable[[str], ModuleType]) -> ModuleType:
    """The script as a module."""
    return load_script("pcn_comparison")


def test_the_optimum_of_a_problem_is_the_known_front(comparison: ModuleType) -> None:
    import mo_gymnasium

    for env_id, problem in comparison.PROBLEMS.items():
        env = mo_gymnasium.make(env_id).unwrapped
        assert len(problem.reference_point) == env.reward_space.shape[0]
        if problem.optimum is not None:
            assert len(env.pareto_front(gamma=comparison.GAMMA)) == problem.optimum


def test_a_run_has_the_defaults_of_the_learner(comparison: ModuleType) -> None:
    from algorithms.pcn import PCNConfig

    ours, theirs = (
        comparison.make_run("fruit-tree-v0", name, 12, 500) for name in (comparison.OURS, comparison.THEIRS)
    )
    assert ours.algorithm.config == PCNConfig()
    assert theirs.algorithm.config.nominal_scales is False
    for run in (ours, theirs):
        assert (run.training.seed, run.training.total_timesteps, run.evaluation.gamma) == (12, 500, 0.99)


def test_a_run_is_measured_by_its_front_of_new_episodes(comparison: ModuleType) -> None:
    found = comparison.learn("deep-sea-treasure-v0", "pcn", 10, 700)
    again = comparison.learn("deep-sea-treasure-v0", "pcn", 10, 700)
    assert (found.environment, found.learner, found.seed) == ("deep-sea-treasure-v0", "pcn", 10)
    assert found.taken >= found.steps == 700
    assert len(found.commit.removesuffix("-dirty")) == 40
    assert 0.0 <= found.hypervolume <= 360.5
    assert 1 <= found.policies <= 10
    assert (found.hypervolume, found.policies, found.taken) == (again.hypervolume, again.policies, again.taken)


def test_the_table_has_means_over_the_seeds(comparison: ModuleType) -> None:
    runs = [("fruit-tree-v0", "pcn", 10, 9.0, 60), ("fruit-tree-v0", "pcn", 11, 11.0, 64)]
    results = [
        comparison.Result(env_id, name, seed, 20_000, 20_064, hv, k, 1.26, "abc") for env_id, name, seed, hv, k in runs
    ]
    results.append(comparison.Result("four-room-v0", "morl_baselines.pcn", 10, 60_000, 60_000, 0.0, 1, 20.0, "abe"))
    results.append(comparison.Result("fruit-tree-v0", "pcn", 10, 500, 512, 3.0, 1, 0.5, "abc"))
    short, first, other = comparison.rows(results)
    assert short[:4] == ["fruit-tree-v0", "500", "pcn", "1"]
    assert first[:4] == ["fruit-tree-v0", "20,000", "pcn", "2"]
    assert other[:4] == ["four-room-v0", "60,000", "morl_baselines.pcn", "1"]
    assert first[4].startswith("10")
    assert first[5].startswith("62")
    assert first[5].endswith(" of 64")


def test_a_comparison_is_continued(
    comparison: ModuleType, call: Call, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(comparison, "learn_in_new_process", lambda run: comparison.learn(*run))
    file = tmp_path / "runs.csv"
    known = comparison.Result("deep-sea-treasure-v0", "pcn", 10, 200, 250, 0.25, 3, 9.0, "abc")
    comparison.write_results(file, [known])
    code, _, _ = call(
        "pcn_comparison",
        *("--only", "deep-sea-treasure-v0", "--learners", "pcn", "--seeds", 2, "--steps", 200, "--output", file),
    )
    assert code is None
    first, second = comparison.read_results(file, comparison.Result)
    assert first == known
    assert second.run == replace(known, seed=11).run


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("--seeds", 0), "--seeds 0 must be at least 1"),
        (("--steps", 0), "--steps 0 must be at least 1"),
        (("--output", "nowhere/x.csv"), "--output nowhere/x.csv: there is no folder nowhere"),
        (("--only", "cart-v0"), "invalid choice: 'cart-v0'"),
    ],
)
@pytest.mark.usefixtures("comparison")
def test_invalid_arguments_are_refused(call: Call, arguments: tuple[object, ...], message: str) -> None:
    code, _, error = call("pcn_comparison", "--learners", "pcn", *arguments)
    assert code == 2
    assert message in error
