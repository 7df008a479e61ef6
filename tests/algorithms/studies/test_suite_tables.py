"""The tables of the suite from rows of results, and the study that suite run makes."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from algorithms.commands.suite import main
from algorithms.studies.manifest import read_manifest
from algorithms.studies.plan import plan_of
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


def test_scores_lie_between_floor_and_ceiling_and_failures_count_as_the_lowest_score() -> None:
    header, *rows = Scoreboard(results()).task_table()
    table = {row[0]: dict(zip(header, row, strict=True)) for row in rows}
    assert table["K1"]["lintune"] == "0.410 [0.400, 0.420]"
    assert table["K1"]["clearly best"] == "mo_ppo"
    assert table["K3"]["mo_ppo"].endswith("(1 failed)")
    assert table["K3"]["clearly best"] == ""
    assert Scoreboard(results()).scores("K3")["mo_ppo"].values.tolist() == pytest.approx([0.8, 0.81, -1.0])


def test_a_track_has_a_row_per_learner_the_best_first_with_its_worst_task() -> None:
    ((track, (header, first, second)),) = Scoreboard(results()).track_tables()
    assert track == "known utility"
    best = dict(zip(header, first, strict=True))
    assert (best["learner"], best["tasks"], best["runs"], best["failed"]) == ("mo_ppo", "2 of 7", "6", "1")
    assert best["worst task"].startswith("K3")
    # On K1 every run is better; on K3, two of three.
    assert best["P(better than lintune)"].startswith("0.83")
    assert second[0] == "lintune"
    with pytest.raises(ValueError, match="--against nobody: there are no results of it"):
        Scoreboard(results()).track_tables("nobody")


def test_the_command_prints_the_tables_and_writes_page_and_picture(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    write_rows(tmp_path / "results.csv", results())
    page, picture = tmp_path / "scoreboard.md", tmp_path / "profile.png"
    assert main(["table", str(tmp_path / "results.csv"), "--output", str(page), "--figure", str(picture)]) == 0
    assert "IQM over tasks" in capsys.readouterr().out
    assert "| K3 |" in page.read_text()
    assert picture.read_bytes().startswith(b"\x89PNG")


def test_an_own_learner_gets_the_help_of_all_and_no_tuning() -> None:
    plan = plan_of(["suite/mo_ppo"], ["core"], 2)
    assert {task for task, _ in plan.selected} == {"K1", "K3", "K5", "V1"}
    k5 = next(arm for arm in plan.arms if arm.task == "K5")
    assert (k5.learner, k5.seeds, k5.candidates) == ("mo_ppo", (0, 1), ())
    assert k5.values["algorithm"]["gamma"] == 0.9995
    tuned = plan_of(["lintune"], ["K3"], 2)
    assert [len(arm.candidates) for arm in tuned.arms if arm.key in tuned.selected] == [12]


def test_all_learners_of_a_task_meet_the_same_partners_but_for_its_ablation() -> None:
    plan = plan_of(["ppo", "mappo", "self_play"], ["V1"], 1)
    partners = {arm.learner: arm.values["training"]["partners"] for arm in plan.arms if arm.key in plan.selected}
    assert partners.pop("self_play") == {}
    assert partners.keys() == {"ppo", "mappo", "mo_ppo"}, "what an ablation ablates is trained, too"
    assert all(len(its["vehicle_1"]) == 11 for its in partners.values())


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
        plan.announcement()[-1]
        == "108 runs of tuning, as long as 27 full ones, then 6 that count: mo_ppo, OwnPPO on K1"
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
        (["suite/ppo"], ["U1"], 1, "--tasks U1: no learner of the study is trained on it"),
        (["nowhere"], ["K1"], 1, "config file 'nowhere' does not exist"),
        (["ppo", "suite/ppo"], ["K1"], 101, "seeds has 100, a seed of the tuning"),
        (["ppo", "ppo"], ["K1"], 1, "--learner ppo is given twice"),
        (["ppo", "conditioned_mo_ppo"], ["K1"], 1, "learner 'conditioned_mo_ppo' fits none of the tasks K1"),
        (
            ["conditioned_mo_ppo", "suite/envelope"],
            ["U2"],
            1,
            "every learner must have the same number of candidates, 12, not conditioned_mo_ppo 12, envelope 4",
        ),
        (["suite/ppo"], ["K1"], 0, "--seeds 0 must be at least 1"),
    ],
)
def test_what_suite_run_cannot_do_is_refused(learners: list[str], tasks: list[str], seeds: int, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        plan_of(learners, tasks, seeds)
