"""Finished runs as tables and figures read them: found, parsed and checked here, and grouped by what differs.

A directory with a config.yaml and an evaluation.json is enough: nothing else of a run need be there. Two runs belong
together if their resolved experiments are the same apart from the seed, from where they ran (device, threads, beside
which seeds) and from what they logged; these change neither what is learnt, but for last bits, nor how it is measured.
"""

from __future__ import annotations

import json
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from gymnasium import registry
from pydantic import AfterValidator, ConfigDict, Field

from algorithms.reporting.training_log import Columns, read_metrics
from mo_deepdrive.evaluation.front import EVALUATION_FILE, LARGEST
from mo_deepdrive.evaluation.metrics import STEP
from mo_deepdrive.evaluation.statistics import Estimate
from mo_deepdrive.support.yaml import read_mapping
from mo_deepdrive.world.config import EnvConfig, Settings, is_ours, parse

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator

LEFT_OUT = "left out: "  # at the beginning of a line about a run
INTEGER = 2**63 - 1  # the largest of a Parquet file
SEED = "training.seed"
# Keys of a config, and one section, that change neither what is learnt nor how it is measured.
INCIDENTAL = ("training.device", "training.seeds", "training.threads", "logging")


def _score(value: float) -> float:
    if abs(value) > LARGEST:
        raise ValueError(f"must be at most {LARGEST:g} in magnitude")
    return value


Score = Annotated[float, AfterValidator(_score)]


class Recorded(Settings):
    """A section of a file: the entries that are used are checked; all others are kept and not looked at."""

    model_config = ConfigDict(extra="allow")


class EnvironmentRecord(Recorded):
    """The environment of a run."""

    id: str
    arguments: dict[str, Any] = {}

    @property
    def label(self) -> str:
        """The id and, if the environment is ours, the arguments that are not the default."""
        spec = registry.get(self.id.rpartition(":")[2])
        if spec is None or not is_ours(spec):
            return self.id
        defaults = {name: field.default for name, field in EnvConfig.model_fields.items()}
        changed = [f"{name}={value}" for name, value in self.arguments.items() if value != defaults.get(name)]
        return " ".join([self.id, *changed])


class UtilityRecord(Recorded):
    """The utility of a run, and those of vehicles with another one, by "vehicle_0" or "vehicle_1"."""

    name: str
    vehicles: dict[str, UtilityRecord] = {}

    @property
    def label(self) -> str:
        """The name, and those of the vehicles."""
        return " ".join([self.name, *(f"{vehicle}={other.name}" for vehicle, other in self.vehicles.items())])


class AlgorithmRecord(Recorded):
    """The name of the algorithm; its hyperparameters are not looked at."""

    name: str


class TrainingRecord(Recorded):
    """The seed of a run, and its environment steps where it was trained here."""

    seed: int = Field(ge=-INTEGER, le=INTEGER)
    total_timesteps: int | None = None


class EvaluationRecord(Recorded):
    """How scores were calculated, as far as it decides whether they are comparable."""

    gamma: float | None = None
    reference_point: list[float] | None = None
    split: str | None = None
    final_episodes: int | None = None
    task: str | None = None

    @property
    def label(self) -> str:
        """The episodes of the final evaluation as text; empty if they are not known."""
        return f"{self.final_episodes} episodes of the {self.split} split" if self.final_episodes and self.split else ""


class ExperimentRecord(Recorded):
    """What the config.yaml of a run says, of any algorithm and environment: neither has to be installed."""

    environment: EnvironmentRecord
    utility: UtilityRecord | None = None  # None where a front was learnt
    algorithm: AlgorithmRecord
    training: TrainingRecord
    evaluation: EvaluationRecord = EvaluationRecord()

    @property
    def task(self) -> dict[str, Any]:
        """What runs must share for their scores to be comparable; final ones must share the split, too."""
        shared: Any = {"environment": True, "utility": True, "evaluation": {"gamma", "reference_point"}}
        return self.model_dump(include=shared)

    @property
    def task_key(self) -> str:
        """Equal for runs with equal :attr:`task`."""
        return json.dumps(self.task, sort_keys=True, default=str)

    @property
    def title(self) -> str:
        """Environment and utility as text."""
        return ", ".join(filter(None, (self.environment.label, label_of(self.utility))))


def label_of(section: EnvironmentRecord | UtilityRecord | None) -> str:
    """The label of a section; empty for a utility that is not known."""
    return "" if section is None else section.label


class EstimateRecord(Recorded):
    """A value and its interval over evaluation episodes."""

    value: Score
    low: Score | None = None
    high: Score | None = None


class FinalEvaluation(Recorded):
    """What an evaluation.json says."""

    policies: dict[str, dict[str, EstimateRecord]]  # the estimates by metric
    episodes: int | None = None
    seed: int | None = None  # of the first of these episodes
    suite_version: int | None = None  # by which the policy was scored

    @property
    def scores(self) -> dict[str, Estimate]:
        """The estimates, with intervals over the episodes, by name, as ``greedy/utility_esr``."""
        return {
            f"{policy}/{name}": Estimate(score.value, score.low, score.high)
            for policy, estimates in self.policies.items()
            for name, score in estimates.items()
        }


@dataclass(frozen=True)
class RunRecord:
    """A run, as read from its directory: its config.yaml, and what was asked for of its results."""

    path: Path
    experiment: ExperimentRecord
    scores: dict[str, Estimate]  # of the final evaluation, by metric
    metrics: Columns  # of metrics.csv


def find_runs(paths: Sequence[Path], warn: Callable[[str], None]) -> list[Path]:
    """The run directories among and below ``paths``, each once; with a warning about folders without any."""
    runs: dict[Path, Path] = {}
    empty: list[str] = []
    for path in paths:
        below = sorted(_runs_below(path))
        runs = {**{run.resolve(): run for run in below}, **runs}
        if not below:
            problem = "there is no config.yaml in it or below it; nor is it a sweep, which has a manifest.jsonl"
            empty.append(f"{str(path)!r} holds no run: {problem}")
    if empty and (not runs or not all(path.is_dir() for path in paths)):
        raise ValueError(empty[0])
    for problem in empty:
        warn(f"{LEFT_OUT}{problem}")
    return list(runs.values())


def _runs_below(path: Path) -> Iterator[Path]:
    top, seen = path.resolve(), set()
    for folder, folders, files in os.walk(path, followlinks=True):
        place = Path(folder).resolve()
        if place in seen or place in top.parents:  # a link to what is walked anyway, or back to a folder around it
            folders.clear()
            continue
        seen.add(place)
        if "config.yaml" in files:
            folders.clear()  # W&B writes a config.yaml of its own below a run
            yield Path(folder)


def read_runs(
    paths: Iterable[Path], warn: Callable[[str], None], *, scores: bool = False, metrics: bool = False
) -> list[RunRecord]:
    """Read runs, with what is asked for; those that cannot be read, or do not have it, are left out with a warning."""
    records = []
    for path in paths:
        file = path / "config.yaml"
        try:
            if not file.is_file():
                other = "a run directory, which has a config.yaml, nor a sweep, which has a manifest.jsonl"
                raise ValueError(f"{str(path)!r} is not {other}")
            experiment = experiment_record(read_mapping(file), f"config file {str(file)!r}")
            columns = read_metrics(path / "metrics.csv") if metrics else {}
            estimates = final_scores(path) if scores else {}
            if scores and not estimates:
                raise ValueError(f"{path} has no final evaluation")
            if metrics and not len(columns[STEP]):
                raise ValueError(f"run {str(path)!r} has no metrics yet")
            records.append(RunRecord(path, experiment, estimates, columns))
        except ValueError as error:
            warn(f"{LEFT_OUT}{error}")
    return records


def read_evaluation(run: Path) -> FinalEvaluation | None:
    """The final evaluation of a run; None if there is none yet."""
    file = run / EVALUATION_FILE
    if not file.is_file():
        return None
    try:
        values = json.loads(file.read_bytes())
    except (OSError, ValueError, RecursionError) as error:
        raise ValueError(f"{str(file)!r} is not a final evaluation: {error}") from None
    return parse(FinalEvaluation, values if isinstance(values, dict) else {}, f"final evaluation {str(file)!r}")


def final_scores(run: Path) -> dict[str, Estimate]:
    """The final evaluation of a run by metric; empty if there is none yet."""
    evaluation = read_evaluation(run)
    return {} if evaluation is None else evaluation.scores


def final_metrics(run: Path) -> dict[str, float]:
    """The values of :func:`final_scores`."""
    return {name: score.value for name, score in final_scores(run).items()}


def experiment_record(values: Mapping[str, Any], what: str = "experiment") -> ExperimentRecord:
    """The record of a resolved experiment, such as that of a line of a manifest."""
    return parse(ExperimentRecord, values, what)


def flatten(values: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """Nested settings by dotted keys: ``{"training": {"seed": 0}}`` as ``{"training.seed": 0}``."""
    flat: dict[str, Any] = {}
    for key, value in values.items():
        flat |= flatten(value, f"{prefix}{key}.") if isinstance(value, Mapping) else {prefix + key: value}
    return flat


def identifying_settings(experiment: ExperimentRecord) -> dict[str, Any]:
    """The settings that runs must share to differ in their seed alone, by dotted keys in alphabetical order."""
    flat = flatten(experiment.model_dump())
    left_out = {SEED, *INCIDENTAL}
    return {key: flat[key] for key in sorted(flat) if key not in left_out and key.partition(".")[0] not in left_out}


def distinct_labels(labels: Sequence[str], sections: Sequence[Recorded | Mapping[str, Any] | None]) -> list[str]:
    """The labels of some sections of configs; those that share one also get the settings that differ between them."""
    flat = [flatten(section.model_dump() if isinstance(section, Recorded) else section or {}) for section in sections]
    distinct = []
    for label, settings in zip(labels, flat, strict=True):
        namesakes = [other for name, other in zip(labels, flat, strict=True) if name == label]
        differing = [
            f"{key.removeprefix('arguments.')}={value}"
            for key, value in settings.items()
            if any(key not in other or other[key] != value for other in namesakes)
        ]
        distinct.append(" ".join(filter(None, (label, *differing))))
    return distinct


def group_by_experiment(runs: Sequence[RunRecord]) -> list[list[RunRecord]]:
    """Group runs that differ in their seed alone, groups and runs in the order given."""
    groups: dict[str, dict[int, RunRecord]] = {}
    for run in runs:
        key = json.dumps(identifying_settings(run.experiment), sort_keys=True, default=str)
        seed = run.experiment.training.seed
        other = groups.setdefault(key, {}).setdefault(seed, run)
        if other is not run:
            names = f"runs {str(other.path)!r} and {str(run.path)!r}"
            raise ValueError(f"{names} are the same experiment with the same seed, {seed}; give one of them")
    return [list(members.values()) for members in groups.values()]
