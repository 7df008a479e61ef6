"""Finished sweeps with made-up metrics and scores."""

from __future__ import annotations

import copy
import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from algorithms.reporting.training_log import MetricsFile
from algorithms.runs.config import load_experiment
from algorithms.runs.jobs import Job
from algorithms.runs.run_directory import file_hashes
from algorithms.studies.execution import Backend
from algorithms.studies.manifest import ManifestRow, run_id, write_manifest
from tests.helpers.paths import REPOSITORY

Script = Callable[..., int]  # calls a script with arguments and returns its exit code


@dataclass(frozen=True)
class MadeUpBackend(Backend):
    """A backend whose runs end at once: with a score, or failed if ``fails`` says so."""

    score: Callable[[Job], float] = lambda job: job.experiment.algorithm.config.learning_rate
    fails: Callable[[Job], bool] = lambda _job: False
    batches: list[list[str | None]] = field(default_factory=list)  # the ids of the runs that were trained together

    def train(self, jobs: Sequence[Job], *_: Any) -> dict[Job, str]:
        failed = {}
        open_jobs = [job for job in jobs if not job.done]
        self.batches.append([job.id for job in open_jobs])
        for job in open_jobs:
            job.path.mkdir(parents=True, exist_ok=True)
            state: dict[str, Any] = {"state": "finished", "cpu_seconds": 60.0}
            if self.fails(job):
                failed[job] = "made to fail"
                state = {"state": "failed", "reason": failed[job]}
            score = {"utility_esr": {"value": self.score(job)}}
            (job.path / "config.yaml").write_text("")
            (job.path / "status.json").write_text(json.dumps(state))
            (job.path / "evaluation.json").write_text(json.dumps({"policies": {"stochastic": score}}))
        return failed


def make_row(base: Mapping[str, Any], cell: dict[str, Any], seed: int, trial: int | None = None) -> ManifestRow:
    """A line of a manifest: ``base`` with the values of the cell, whose key "config" is only a name."""
    config = copy.deepcopy(dict(base))
    for key, value in {**cell, "training.seed": seed}.items():
        if key != "config":
            *sections, last = key.split(".")
            place = config
            for section in sections:
                place = place[section]
            place[last] = value
    name = run_id(config)
    return ManifestRow(name, f"runs/{config['algorithm']['name']}-seed{seed}-{name}", cell, seed, trial, config)


def config_of(name: str) -> dict[str, Any]:
    """The resolved experiment of ``configs/NAME.yaml``."""
    return load_experiment(REPOSITORY / f"configs/{name}.yaml").to_dict()


def log(sweep: Path, row: ManifestRow, rows: Sequence[tuple[int, dict[str, float]]]) -> Path:
    path = sweep / row.directory / "metrics.csv"
    path.parent.mkdir(parents=True, exist_ok=True)
    file = MetricsFile(path)
    for step, metrics in rows:
        file.write(step, metrics)
    return path


def end(sweep: Path, row: ManifestRow, policies: Mapping[str, Mapping[str, float]], state: str = "finished") -> None:
    """Write the status of a run; if it has finished, its final evaluation too."""
    directory = sweep / row.directory
    directory.mkdir(parents=True, exist_ok=True)
    (directory / "status.json").write_text(json.dumps({"state": state, "step": 100}))
    if state == "finished":
        summary = {
            policy: {name: {"value": value, "low": value - 1.0, "high": None} for name, value in metrics.items()}
            for policy, metrics in policies.items()
        }
        (directory / "evaluation.json").write_text(json.dumps({"policies": summary}))


def record(sweep: Path, row: ManifestRow) -> None:
    """Record the files of a finished run in its status, as training does."""
    path = sweep / row.directory / "status.json"
    status = json.loads(path.read_text())
    path.write_text(json.dumps({**status, "files": file_hashes(path.parent)}))


def scores_of(row: ManifestRow) -> float:
    """A score that is unique to each run: it increases with the learning rate and slightly with the seed."""
    return 1000.0 * row.config["algorithm"]["learning_rate"] + 0.1 * row.seed


def make_sweep(sweep: Path, rows: Sequence[ManifestRow], points: int = 12) -> list[ManifestRow]:
    for row in rows:
        score = scores_of(row)
        logged: list[tuple[int, dict[str, float]]] = []
        for i in range(points):
            logged.append((10 * i, {"eval/greedy/utility_esr": score + i, "eval/greedy/return/jerk": -float(i)}))
            logged.append((10 * i + 5, {"train/utility": score * i, "loss/policy": 0.5}))
        log(sweep, row, logged)
        numbers = {"utility_esr": score, "success": 0.5, "end/collision": -score}
        end(sweep, row, {"greedy": numbers, "stochastic": {**numbers, "utility_esr": -score}})
    write_manifest(sweep, rows)
    return list(rows)
