"""A finished run as tables and figures read it: its directory is parsed and checked here, once and nowhere else.

A directory with a config.yaml and an evaluation.json is enough: nothing else of a run need be there.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from gymnasium import registry
from pydantic import AfterValidator, ConfigDict, Field

from algorithms.reporting.training_log import Columns, read_metrics
from mo_deepdrive.evaluation.front import EVALUATION_FILE, LARGEST
from mo_deepdrive.evaluation.statistics import Estimate
from mo_deepdrive.support.yaml import read_mapping
from mo_deepdrive.world.config import EnvConfig, Settings, parse

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Mapping

LEFT_OUT = "left out: "  # at the beginning of a line about a run
INTEGER = 2**63 - 1  # the largest of a Parquet file


def _score(value: float) -> float:
    if abs(value) > LARGEST:
        raise ValueError(f"must be at most {LARGEST:g} in magnitude")
    return value


Score = Annotated[float, AfterValidator(_score)]


class Recorded(Settings):
    """A section of a file: the entries that are used are checked; all others are kept and not looked at."""

    model_config = ConfigDict(extra="allow")


class EnvironmentRecord(Recorded):
    """The environment of a run: its id and its keyword arguments."""

    id: str
    arguments: dict[str, Any] = {}

    @property
    def label(self) -> str:
        """The id and, if the environment is ours, the arguments that are not the default."""
        spec = registry.get(self.id.rpartition(":")[2])
        if spec is None or not str(spec.vector_entry_point).startswith("mo_deepdrive."):
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
    utility: UtilityRecord | None = None
    algorithm: AlgorithmRecord
    training: TrainingRecord
    evaluation: EvaluationRecord = EvaluationRecord()

    @property
    def task(self) -> dict[str, Recorded | None]:
        """What runs must share for their scores to be comparable: environment, utility, and how scores are calculated.

        Final scores are comparable if they are also of the same split; evaluations during training are all of one.
        """
        how = EvaluationRecord(gamma=self.evaluation.gamma, reference_point=self.evaluation.reference_point)
        return {"environment": self.environment, "utility": self.utility, "evaluation": how}

    @property
    def task_key(self) -> str:
        """A text that is equal for runs with equal :attr:`task`."""
        values = {name: section and section.model_dump() for name, section in self.task.items()}
        return json.dumps(values, sort_keys=True, default=str)

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
    """What an evaluation.json says.

    It has the estimates by policy and metric, the episodes from the first seed on, and the version of the suite by
    which the policy was scored.
    """

    policies: dict[str, dict[str, EstimateRecord]]
    episodes: int | None = None
    seed: int | None = None
    suite_version: int | None = None

    @property
    def scores(self) -> dict[str, Estimate]:
        """The estimates by name, as ``greedy/utility_esr``."""
        return {
            f"{policy}/{name}": Estimate(each.value, each.low, each.high)
            for policy, estimates in self.policies.items()
            for name, each in estimates.items()
        }


@dataclass(frozen=True)
class RunRecord:
    """A run, as read from its directory.

    Attributes:
        path: the directory.
        experiment: its config.yaml.
        scores: of the final evaluation, by metric; empty if there is none, or it was not asked for.
        metrics: the columns of metrics.csv; empty if they were not asked for.
    """

    path: Path
    experiment: ExperimentRecord
    scores: dict[str, Estimate]
    metrics: Columns


def read_run(path: str | Path, *, scores: bool = False, metrics: bool = False) -> RunRecord:
    """Read a run: what it was, and what is asked for of its results.

    Raises:
        ValueError: naming the file that is missing or damaged, and the fault.
    """
    path = Path(path)
    file = path / "config.yaml"
    if not file.is_file():
        raise ValueError(
            f"{str(path)!r} is not a run directory, which has a config.yaml, nor a sweep, which has a manifest.jsonl"
        )
    return RunRecord(
        path,
        parse(ExperimentRecord, read_mapping(file), f"config file {str(file)!r}"),
        final_scores(path) if scores else {},
        read_metrics(path / "metrics.csv") if metrics else {},
    )


def read_runs(
    paths: Iterable[Path], warn: Callable[[str], None], *, scores: bool = False, metrics: bool = False
) -> list[RunRecord]:
    """Read runs, and leave out those that cannot be read.

    Args:
        paths: of the runs.
        warn: called with a line about every run that is left out, which names the file and the fault.
        scores: whether to read the final evaluation.
        metrics: whether to read metrics.csv.
    """
    records = []
    for path in paths:
        try:
            records.append(read_run(path, scores=scores, metrics=metrics))
        except ValueError as error:
            warn(f"{LEFT_OUT}{error}")
    return records


def read_evaluation(run: Path) -> FinalEvaluation | None:
    """The final evaluation of a run; None if there is none yet.

    Raises:
        ValueError: if its file is damaged.
    """
    file = run / EVALUATION_FILE
    if not file.is_file():
        return None
    try:
        values = json.loads(file.read_bytes())
        if not isinstance(values, dict):
            raise ValueError(f"it holds a {type(values).__name__}")
    except (OSError, ValueError, RecursionError) as error:
        reason = "it is nested too deeply" if isinstance(error, RecursionError) else error
        raise ValueError(f"{str(file)!r} is not a final evaluation: {reason}") from None
    return parse(FinalEvaluation, values, f"final evaluation {str(file)!r}")


def final_scores(run: Path) -> dict[str, Estimate]:
    """The final evaluation of a run by metric, as ``greedy/utility_esr``; empty if there is none yet.

    The intervals are those over evaluation episodes.

    Raises:
        ValueError: if its file is damaged.
    """
    evaluation = read_evaluation(run)
    return {} if evaluation is None else evaluation.scores


def final_metrics(run: Path) -> dict[str, float]:
    """The values of :func:`final_scores`, with its errors."""
    return {name: score.value for name, score in final_scores(run).items()}


def experiment_record(values: Mapping[str, Any], what: str = "experiment") -> ExperimentRecord:
    """The record of a resolved experiment, such as that of a line of a manifest.

    Raises:
        ValueError: naming what is missing or of another type.
    """
    return parse(ExperimentRecord, values, what)
