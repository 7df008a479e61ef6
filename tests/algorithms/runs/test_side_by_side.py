"""Runs of several seeds: each is a run like any other, and one that fails does not end the others."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import torch

from algorithms.commands import table, train
from algorithms.learning.checkpoints import STEP, read_checkpoint
from algorithms.runs.jobs import perform
from algorithms.runs.run_directory import Run, read_status
from algorithms.runs.training import reopen, resume, train_and_finish
from mo_deepdrive.support.yaml import dump
from tests.helpers.short_runs import assert_same_run, job, metrics, printed, quiet

pytestmark = pytest.mark.slow


def runs_of(folder: Path, *seeds: int) -> list[Run]:
    """New runs, whose locks are held."""
    return [Run.create(job(folder, seed).experiment, folder / f"seed{seed}") for seed in seeds]


def finished(runs: list[Run], agent: Any, **options: Any) -> str:
    """Train runs side by side; what was printed."""
    console = quiet()
    try:
        train_and_finish(runs, agent, console, **options)
    finally:
        for run in runs:
            run.unlock()
    return " ".join(printed(console).split())


# Where the first seed fails, after a row of which step what of it has been spoilt, and its last checkpoint.
FAULTS: dict[str, tuple[int, str, int]] = {
    "in the update after step 160": (160, "vector", 96),
    "in the checkpoint of step 480": (480, "mean", 384),
    "in the evaluation at step 960": (960, "vector", 864),
}


@pytest.mark.parametrize("where", FAULTS)
def test_a_run_that_fails_keeps_its_last_checkpoint_and_the_others_are_finished(where: str, tmp_path: Path) -> None:
    whole, broken = runs_of(tmp_path / "whole", 5, 6), runs_of(tmp_path / "broken", 4, 6)
    finished(whole, resume(*whole))
    agent, (when, name, saved) = resume(*broken), FAULTS[where]

    def spoil(step: int, _: Any) -> None:
        if step == when:
            getattr(agent.learners[0], name)[0] = torch.nan

    text = finished(broken, agent, watch=spoil)
    status = read_status(broken[0].path)
    assert (status["state"], status["step"]) == ("failed", saved)
    assert status["reason"].startswith(f"seed 4, {where}: ")
    assert read_checkpoint(broken[0].checkpoint, {})[1][STEP] == saved
    assert f"the checkpoint of step {saved} is intact" in text
    assert_same_run(whole[1].path, broken[1].path)


def test_runs_that_are_stopped_side_by_side_are_resumed_together_or_not_at_all(tmp_path: Path) -> None:
    whole, part = runs_of(tmp_path / "whole", 5, 6), runs_of(tmp_path / "part", 5, 6)
    finished(whole, resume(*whole))
    seen: list[int] = []
    finished(part, resume(*part), watch=lambda at, _: seen.append(at), stop=lambda: bool(seen) and seen[-1] >= 320)
    assert read_status(part[0].path)["state"] == "interrupted"
    again = [Run.open(str(run.path)) for run in part]
    for run in again:
        run.lock()
    finished(again, resume(*again), resumed=True)
    for one, other in zip(whole, part, strict=True):
        assert_same_run(one.path, other.path)
    (new,) = runs_of(tmp_path / "new", 7)
    different = Run.create(job(tmp_path, 8, num_envs=8).experiment, tmp_path / "different")
    with pytest.raises(ValueError, match="some of the runs have a checkpoint and others have none; resume them apart"):
        resume(whole[0], new)
    with pytest.raises(ValueError, match=r"trained side by side must differ in training\.seed alone"):
        resume(whole[0], different)


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
    assert table.main([*map(str, paths)]) == 0
    assert "with three seeds" in capsys.readouterr().out
