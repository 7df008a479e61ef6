"""Runs of several seeds: each is a run like any other, and one that fails does not end the others."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import torch

from algorithms.commands import evaluate, table, train
from algorithms.experiments.jobs import perform
from algorithms.experiments.run_directory import Run, read_status
from algorithms.experiments.training import reopen, resume, train_and_finish
from algorithms.files.checkpoints import STEP, read_checkpoint
from algorithms.files.metrics import read_metrics
from algorithms.files.yaml import dump
from mo_deepdrive.faults import NotFinite
from tests.helpers.short_runs import assert_same_run, job, metrics, printed, quiet

pytestmark = pytest.mark.slow

TOTAL = 960


def runs_of(folder: Path, *seeds: int) -> list[Run]:
    """New runs, whose locks are held."""
    return [Run.create(job(folder, seed).experiment, folder / f"seed{seed}") for seed in seeds]


def trained(runs: list[Run], **options: Any) -> tuple[Any, int | None, str]:
    """The agent that has trained runs side by side, what stopped it, and what was printed."""
    agent, console = resume(*runs), quiet()
    try:
        received = train_and_finish(runs, agent, console, **options)
    finally:
        for run in runs:
            run.unlock()
    return agent, received, printed(console)


@pytest.mark.parametrize("where", ["networks", "checkpoint", "final evaluation"])
def test_a_run_that_fails_keeps_its_last_checkpoint_and_the_others_are_finished(
    where: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    whole, broken = runs_of(tmp_path / "whole", 5, 6), runs_of(tmp_path / "broken", 4, 6)
    trained(whole)
    agents: list[Any] = []
    make = resume

    def spoil(step: int, _: Any) -> None:
        """Spoil the first seed, after a checkpoint and before another."""
        if step == {"networks": 640, "checkpoint": 640, "final evaluation": TOTAL}[where]:
            part = agents[0].learners[0]
            (part.mean if where == "checkpoint" else part.vector)[0] = torch.nan

    monkeypatch.setitem(globals(), "resume", lambda *runs: agents.append(make(*runs)) or agents[-1])
    agent, received, text = trained(broken, watch=spoil)
    assert received is None
    assert [*agent.failed] == [0]
    status = read_status(broken[0].path)
    saved = {"networks": 576, "checkpoint": 576, "final evaluation": TOTAL - 96}[where]
    assert (status["state"], status["step"]) == ("failed", saved)
    assert read_checkpoint(broken[0].checkpoint, {})[1][STEP] == saved
    assert f"seed 4, in the {'update after' if where == 'networks' else 'checkpoint of'} step" in status["reason"]
    assert f"the checkpoint of step {saved} is intact" in text
    assert_same_run(whole[1].path, broken[1].path)


def test_runs_of_which_all_have_failed_are_an_error(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    runs = runs_of(tmp_path, 4, 5)
    agent = resume(*runs)
    agent.learners[0].vector[:] = torch.nan
    monkeypatch.setitem(globals(), "resume", lambda *_: agent)
    with pytest.raises(NotFinite, match="seed 5, in the update after step 0: environment 0: an output"):
        trained(runs)
    assert [read_status(run.path)["state"] for run in runs] == ["failed"] * 2


def test_runs_that_are_stopped_side_by_side_are_resumed_together_or_not_at_all(tmp_path: Path) -> None:
    whole, part = runs_of(tmp_path / "whole", 5, 6), runs_of(tmp_path / "part", 5, 6)
    trained(whole)
    seen: list[int] = []
    trained(part, watch=lambda step, _: seen.append(step), stop=lambda: bool(seen) and seen[-1] >= 320)
    assert read_status(part[0].path)["state"] == "interrupted"
    trained([Run.open(str(run.path)) for run in part], resumed=True)
    for one, other in zip(whole, part, strict=True):
        assert_same_run(one.path, other.path)
    with pytest.raises(ValueError, match="some of the runs have a checkpoint and others have none; resume them apart"):
        resume(whole[0], *runs_of(tmp_path / "new", 7))
    with pytest.raises(ValueError, match=r"trained side by side must differ in training\.seed alone"):
        resume(whole[0], Run.create(job(tmp_path, 8, num_envs=8).experiment, tmp_path / "other"))


def test_the_runs_of_several_seeds_are_those_of_each_and_tabulated(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    config = tmp_path / "config.yaml"
    config.write_text(dump(job(tmp_path, 5, seeds=[5, 6, 7]).experiment.to_dict()))
    assert train.main([f"--config={config}", f"--output={tmp_path / 'runs'}"]) == 0
    paths = [tmp_path / "runs" / f"seed-{seed}" for seed in (5, 6, 7)]
    alone = job(tmp_path / "alone", 6)
    perform(alone, stop=lambda: True)
    (run,), agent = reopen(str(alone.path))
    assert train_and_finish(run, agent, quiet(), resumed=True) is None
    run.unlock()
    assert_same_run(paths[1], alone.path)
    assert metrics(paths[1]) == metrics(alone.path)
    assert evaluate.main([str(paths[0]), "--episodes=3"]) == 0
    assert table.main([*map(str, paths)]) == 0
    assert "with three seeds" in capsys.readouterr().out
    assert Run.open(paths[2]).experiment.training.seed == 7
    assert read_metrics(paths[2] / "metrics.csv")["step"][-1] == TOTAL


def test_a_job_is_one_run(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"training\.seeds = \[0, 1\]: mo-deepdrive train alone trains several"):
        perform(job(tmp_path, seeds=[0, 1]))
