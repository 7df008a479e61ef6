"""The tables of the suite from rows of results, and the study that suite run makes."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from algorithms.commands.suite import main
from algorithms.studies import REFERENCE
from algorithms.studies.manifest import read_manifest
from algorithms.studies.plan import plan_of
from algorithms.studies.settings import load_study
from algorithms.studies.suite_tables import Scoreboard
from mo_deepdrive import suite
from mo_deepdrive.suite import Row, write_rows

VERSION = suite.load().version


def scored(task: str, learner: str, score: float, seed: int = 0, policy: str | None = None) -> Row:
    """A row whose normalised score is ``score``."""
    of = suite.load().task(task)
    value = of.floor.value + score * (of.ceiling.value - of.floor.value)
    return Row(task, learner, seed, policy or of.policy, "score", value, version=VERSION)


def results() -> list[Row]:
    """Two learners on K1 and K3 with three seeds each; one run of the second has failed."""
    rows = [scored(task, "lintune", 0.4 + 0.01 * seed, seed) for task in ("K1", "K3") for seed in range(3)]
    rows += [scored(task, "mo_ppo", 0.8 + 0.01 * seed, seed) for task in ("K1", "K3") for seed in range(3)]
    other = [replace(row, policy="greedy", value=0.0) for row in rows]
    rows[-1] = Row("K3", "mo_ppo", 2, "", "", None, state="failed", version=VERSION)
    return [*rows, *other[:-1]]


def with_samples(scores: dict[str, list[float]]) -> tuple[list[Row], suite.Samples]:
    """Learners on K1 by their mean scores, one of a seed each, and samples of these that differ most by scenario."""
    task, rows, samples = suite.load().task("K1"), [], suite.Samples()
    generator = np.random.default_rng(0)
    scenarios = generator.normal(0.0, 1.5, (task.episodes, 1))
    scenarios -= scenarios.mean()
    for learner, means in scores.items():
        for seed, mean in enumerate(means):
            row = scored("K1", learner, mean, seed)
            assert row.value is not None
            rows.append(replace(row, cpu_seconds=60.0 * (seed + 1)))
            samples["K1", learner, seed] = (row.value + scenarios).astype(np.float32)
    return rows, samples


def by_name(rows: list[list[str]]) -> dict[str, dict[str, str]]:
    return {row[0]: dict(zip(rows[0], row, strict=True)) for row in rows[1:]}


def test_a_task_has_its_learners_between_floor_and_ceiling_and_a_failed_run_has_the_lowest_score() -> None:
    (title, rows), (_, of_k3) = Scoreboard(results()).task_tables()
    assert title.startswith("K1: ")
    assert [row[0].partition(" ")[0] for row in rows[1:]] == ["ceiling", "mo_ppo", "lintune", "floor"]
    table = by_name(rows)
    assert table["lintune"]["score"] == "0.410 [0.400, 0.420]"
    assert table["lintune"]["difference from mo_ppo"].startswith("-0.400 [")
    assert table["mo_ppo"]["failed seeds"] == "0 of 3"
    assert by_name(of_k3)["mo_ppo"]["failed seeds"] == "1 of 3"
    assert Scoreboard(results()).scores("K3")["mo_ppo"].by_seed == pytest.approx({0: 0.8, 1: 0.81, 2: -1.0})


def test_seeds_at_the_floor_have_failed_though_their_runs_finished() -> None:
    rows, samples = with_samples({"ppo": [0.9, 0.9, -0.01, 0.0]})
    ((_, table),) = Scoreboard(rows, samples).task_tables()
    assert by_name(table)["ppo"]["failed seeds"] == "2 of 4"
    assert by_name(table)["ppo"]["CPU minutes"] == "2.5"


def test_learners_are_told_apart_on_the_same_scenarios_though_their_intervals_overlap() -> None:
    means = [0.70, 0.71, 0.72, 0.70, 0.71, 0.72]
    rows, samples = with_samples({
        "first": means, "close": [mean - 0.005 * (-1) ** seed for seed, mean in enumerate(means)],
        "behind": [mean - 0.08 for mean in means],
    })  # fmt: skip
    board = Scoreboard(rows, samples)
    first, behind = (board.scores("K1")[learner].mean.estimate for learner in ("first", "behind"))
    assert first.low is not None
    assert behind.high is not None
    assert behind.high > first.low
    assert board.differences("K1", "first")["behind"].p < 0.01
    assert sorted(board.best("K1")) == ["close", "first"]
    ((_, table),) = board.task_tables()
    assert [row[-1] for row in table[1:]] == ["", "tie", "tie", "", ""]
    # Without samples the interval is of the seeds alone, which are nearly equal.
    alone = Scoreboard(rows).scores("K1")["first"].mean.estimate
    assert alone.low is not None
    assert first.low < alone.low - 0.02


def test_an_ablation_with_the_same_policies_is_compared_with_them_seed_by_seed() -> None:
    of_seeds = [0.1, 0.9, 0.3, 0.7, 0.5]
    arms = {"conditioned_mo_ppo": 0.0, "first_alone": -0.02, "no_switching": -0.02}
    board = Scoreboard([scored("U4", arm, x + less, i) for arm, less in arms.items() for i, x in enumerate(of_seeds)])
    paired, apart = (board.differences("U4")[arm].mean.estimate for arm in ("first_alone", "no_switching"))
    assert paired.low == pytest.approx(-0.02)
    assert paired.high == pytest.approx(-0.02)
    assert apart.low is not None
    assert apart.low < -0.2


def test_sentences_say_who_is_best_and_whether_the_ablation_is_behind_each_with_its_test() -> None:
    def said(scores: dict[str, list[float]]) -> str:
        found = [scored("K3", learner, score, seed) for learner in scores for seed, score in enumerate(scores[learner])]
        return " ".join(Scoreboard(found).sentences("K3"))

    best, blind, noisy = [0.8, 0.81, 0.82, 0.81], [0.3, 0.31, 0.32, 0.31], [0.2, 0.9, 0.5, 0.8]
    apart = said({"mo_ppo_esr": best, "accrued_blind": blind, "ppo": noisy})
    assert apart.startswith("MO-PPO (ESR) (0.810) is tied with PPO (")
    assert "ahead of the ablation, MO-PPO (ESR) without what has accrued, by 0.5" in apart
    assert "Holm's correction for 2" in apart
    assert apart.count("paired bootstrap over seeds") == 1
    third = said({"mo_ppo_esr": best, "lintune": [0.6, 0.61, 0.62, 0.61], "accrued_blind": blind})
    assert "ahead of LinTune by 0.2" in third
    assert "MO-PPO (ESR) is ahead of the ablation, MO-PPO (ESR) without what has accrued (0.5" in third
    assert third.count("paired bootstrap over seeds") == 2
    same = said({"mo_ppo_esr": best, "accrued_blind": best})
    assert "is not ahead of the ablation" in same
    assert same.endswith("): no cause is claimed.")
    assert said({"mo_ppo_esr": best}) == "MO-PPO (ESR) (0.810) is the best that was run."
    assert Scoreboard([]).sentences("K3") == ["Not run."]


def test_every_task_that_counts_has_its_ablation_in_the_study_and_the_rulebook_of_its_learner() -> None:
    study = load_study(REFERENCE)
    for name, task in suite.load().tasks.items():
        if task.counted:
            assert task.ablation in study.learners_of(name), name
        if task.rulebook is not None:
            plan = plan_of(["rulebook_ppo"], [name], 1)
            (values,) = [arm.values for arm in plan.arms if arm.key in plan.selected]
            assert values["algorithm"]["rulebook"] == [rule.model_dump() for rule in task.rulebook.rules]


def test_one_policy_for_all_hidden_preferences_is_a_learner_with_a_utility_of_its_own() -> None:
    plan = plan_of(["one_policy"], ["U2"], 1)
    (arm,) = [arm for arm in plan.arms if arm.key in plan.selected]
    assert arm.values["algorithm"]["name"] == "mo_ppo"
    weights, preferences = arm.values["utility"]["arguments"]["weights"], suite.load().task("U2").preferences
    assert preferences is not None
    prices = {name: preferences.common.get(name, 0.0) for name in weights}
    prices |= {name: prices[name] + 1 / len(preferences.units) / unit for name, unit in preferences.units.items()}
    assert weights == pytest.approx(prices, rel=2e-3), "the mean of the preferences"


def test_a_difference_among_many_needs_a_smaller_p_value_than_a_single_one() -> None:
    ahead, behind = [0.5, 0.9, 0.9, 0.9, 0.9], [0.4, 0.5, 0.6, 0.7, 0.8]
    rows, samples = with_samples({"ahead": ahead, "behind": behind})
    (alone,) = Scoreboard(rows, samples).differences("K1").values()
    assert alone.p == pytest.approx(alone.mean.p)
    rows, samples = with_samples({"ahead": ahead, "behind": behind, **{f"same {k}": ahead for k in range(4)}})
    assert Scoreboard(rows, samples).differences("K1", "ahead")["behind"].p == pytest.approx(5.0 * alone.p)


def test_differences_are_from_a_baseline_where_one_is_named_and_over_the_tasks_of_all() -> None:
    board = Scoreboard(results())
    scores, differences = board.comparison("mo_ppo")
    assert [row[0] for row in scores] == ["task", "K1", "K3", "mean"]
    assert differences[0] == ["task", "lintune - mo_ppo"]
    assert differences[1][1].startswith("-0.400")
    assert differences[1][1].endswith(" *")
    assert not differences[2][1].endswith(" *")
    ((_, rows), _) = board.task_tables("lintune")
    assert "difference from lintune" in rows[0]
    for make in (board.comparison, board.task_tables):
        with pytest.raises(ValueError, match="--baseline nobody: there are no results of it"):
            make("nobody")


def test_the_command_prints_the_tables_and_writes_page_and_picture(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    rows, samples = with_samples({"ppo": [0.2, 0.3, 0.4], "mo_ppo": [0.8, 0.8, 0.9]})
    write_rows(tmp_path / "results.csv", rows)
    suite.write_samples(tmp_path / "results.csv", samples)
    page, picture = tmp_path / "scoreboard.md", tmp_path / "scores.png"
    command = ["table", str(tmp_path / "results.csv"), "--output", str(page), "--figure", str(picture)]
    assert main(command) == 0
    assert "difference from" in capsys.readouterr().out
    assert "| mo_ppo | " in page.read_text()
    assert picture.read_bytes().startswith(b"\x89PNG")
    write_rows(tmp_path / "results.csv", [replace(row, version=VERSION + 1) for row in rows])
    with pytest.raises(SystemExit):
        main(command)
    assert (
        capsys.readouterr().err.strip().endswith(f"has version {VERSION + 1} of the suite; this is version {VERSION}")
    )


def test_an_own_learner_gets_the_help_of_all_and_no_tuning() -> None:
    plan = plan_of(["suite/mo_ppo"], ["core"], 2)
    assert {task for task, _ in plan.selected} == {"K3", "K4", "V1", "R3"}
    v1 = next(arm for arm in plan.arms if arm.task == "V1")
    assert (v1.learner, v1.seeds, v1.candidates) == ("mo_ppo", (0, 1), ())
    assert v1.values["algorithm"]["gamma"] == 0.998
    tuned = plan_of(["lintune"], ["K3"], 2)
    assert [len(arm.candidates) for arm in tuned.arms if arm.key in tuned.selected] == [6]
    more = plan_of(["rulebook_ppo"], ["R5"], 2)
    assert {arm.seeds for arm in more.arms} == {(0, 1)}, "as asked for, also where the study has 20"


def test_all_learners_of_a_task_meet_the_same_partners_but_for_its_ablation() -> None:
    plan = plan_of(["ppo", "mappo", "self_play"], ["V1"], 1)
    partners = {arm.learner: arm.values["training"]["partners"] for arm in plan.arms if arm.key in plan.selected}
    assert partners.pop("self_play") == {}
    assert partners.keys() == {"ppo", "mappo", "mo_ppo"}, "what an ablation ablates is trained, too"
    assert all(len(its["vehicle_1"]) == 7 for its in partners.values())


def test_an_own_learner_beside_one_of_the_reference_is_tuned_by_the_same_rule_and_takes_overrides(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    config = "class Config(PPO.Config):\n        kappa: float = 0.1"
    (tmp_path / "own_ppo.py").write_text(f"from algorithms.ppo import PPO\n\n\nclass OwnPPO(PPO):\n    {config}\n")
    monkeypatch.syspath_prepend(tmp_path)
    plan = plan_of(["mo_ppo", "own_ppo:OwnPPO"], ["K1"], 3, {"algorithm.kappa": 0.2})
    arms = {arm.learner: arm for arm in plan.arms if arm.key in plan.selected}
    assert arms.keys() == {"mo_ppo", "OwnPPO"}
    assert arms["OwnPPO"].candidates == arms["mo_ppo"].candidates
    assert arms["OwnPPO"].values["algorithm"]["kappa"] == 0.2
    assert "kappa" not in arms["mo_ppo"].values["algorithm"]
    assert (
        plan.announcement()[-1] == "48 runs of tuning, as long as 18 full ones, then 6 that count: mo_ppo, OwnPPO on K1"
    )
    for overrides, message in (
        ({"algorithm.kapa": 0.2}, "no learner has the setting 'algorithm.kapa'; did you mean 'algorithm.kappa'"),
        ({"algorithm.learning_rate": 0.2}, "learning_rate = 0.2: the study tunes it for learner 'mo_ppo'"),
        ({"training.seed": 2}, "'training.seed' in the options: set seeds with"),
    ):
        with pytest.raises(ValueError, match=message):
            plan_of(["mo_ppo", "own_ppo:OwnPPO"], ["K1"], 3, overrides)


def test_the_manifest_of_suite_run_holds_what_was_asked_for(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    for folder, name in (("a", "ppo"), ("b", "mo_ppo")):
        (tmp_path / folder).mkdir()
        (tmp_path / folder / "mine.yaml").write_text(f"algorithm: {{name: {name}}}\n")
    command = ["run", "--learner", "a/mine.yaml", "--learner", "b/mine.yaml", "--seeds", "2", "--on", "manifest"]
    assert main([*command, "--tasks", "K1", "--algorithm.gamma=0.9"]) == 0
    assert capsys.readouterr().out.startswith("4 runs, without tuning, that count: a/mine.yaml, b/mine.yaml on K1\n")
    (directory,) = (tmp_path / "runs" / "studies").iterdir()
    rows = read_manifest(directory)
    assert {(row.cell["task"], row.config["algorithm"]["name"], row.seed) for row in rows} == {
        ("K1", name, seed) for name in ("ppo", "mo_ppo") for seed in (0, 1)
    }
    assert {row.config["algorithm"]["gamma"] for row in rows} == {0.9}


@pytest.mark.parametrize(
    ("learners", "tasks", "seeds", "message"),
    [
        (["suite/ppo"], ["K99"], 1, "task 'K99' is unknown"),
        (["suite/ppo"], ["U2"], 1, "--tasks U2: no learner of the study is trained on it"),
        (["nowhere"], ["K1"], 1, "config file 'nowhere' does not exist"),
        (["ppo", "suite/ppo"], ["K1"], 101, "seeds has 100, a seed of the tuning"),
        (["ppo", "ppo"], ["K1"], 1, "--learner ppo is given twice"),
        (["ppo", "conditioned_mo_ppo"], ["K1"], 1, "learner 'conditioned_mo_ppo' fits none of the tasks K1"),
        (
            ["conditioned_mo_ppo", "suite/envelope"],
            ["U2"],
            1,
            "every learner must have the same number of candidates, 6, not conditioned_mo_ppo 6, envelope 2",
        ),
        (["suite/ppo"], ["K1"], 0, "--seeds 0 must be at least 1"),
    ],
)
def test_what_suite_run_cannot_do_is_refused(learners: list[str], tasks: list[str], seeds: int, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        plan_of(learners, tasks, seeds)
