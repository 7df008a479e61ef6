"""List the policies of the zoo, which are trained already, with their scores.

    mo-deepdrive zoo
    mo-deepdrive evaluate one_waypoint_nonlinear-mo_ppo --video drive.mp4

Their names can be given instead of a run: to evaluate, choose (fronts) and play.
"""

from __future__ import annotations

import json
from typing import TYPE_CHECKING, Any

from algorithms.reporting.run_records import experiment_record
from algorithms.runs import cli
from algorithms.runs.config import find_environment
from algorithms.zoo import ABOUT, CONFIG, find, names
from mo_deepdrive.evaluation.metrics import CARDINALITY, FRONT, POLICIES, SUCCESS, TOTAL_UTILITY_ESR, UTILITY_ESR
from mo_deepdrive.support.yaml import read_mapping

if TYPE_CHECKING:
    from pathlib import Path

    from algorithms.reporting.run_records import ExperimentRecord

CAPTION = (
    "Arrivals (both vehicles, where there are two) and utility (their sum): greedy / stochastic policy, test split."
)
ENDINGS = {
    "-printed": "for the paper's hyperparameters",
    "-together": "where the first vehicle to end ends the episode for both",
    "-solved": "where the median run fails and another one is added",
}


def list_zoo(_options: cli.Options) -> int:
    """Print one row per policy: its name, which has the algorithm, the task of its training, and its scores."""
    from algorithms.reporting.tables import make_table
    from algorithms.runs.console import make_console

    endings = [f"in {end} {meaning}" for end, meaning in ENDINGS.items() if any(name.endswith(end) for name in names())]
    caption = CAPTION + (f" Names end {', '.join(endings)}." if endings else "")
    rows = [["name", "task", "arrivals (%)", "utility (ESR)"]]
    for name in names():
        config = find(name) / CONFIG
        experiment = experiment_record(read_mapping(config), f"experiment {str(config)!r}")
        rows.append([name, _task(experiment), *_score_columns(find(name) / ABOUT)])
    make_console().print(make_table(rows, 4, unbroken=(0,), title="policies of the zoo", caption=caption))
    return 0


def _task(experiment: ExperimentRecord) -> str:
    """The utilities of an experiment, and its scenario unless their names begin with it."""
    scenario: str = find_environment(experiment.environment.id).kwargs.get("scenario", experiment.environment.id)
    settings = experiment.utility
    if settings is None:
        return f"{scenario}, a front"
    utilities = dict.fromkeys([settings.name, *(choice.name for choice in settings.vehicles.values())])
    return ", ".join([*([] if settings.name.startswith(scenario) else [scenario]), *utilities])


def _score_columns(path: Path) -> list[str]:
    """Arrivals and utility of both policies, or the number of policies of a front; empty where they are not known."""
    try:
        scores: dict[str, dict[str, Any]] = json.loads(path.read_bytes()).get("scores", {})
        if FRONT in scores:
            return ["", f"{scores[FRONT][CARDINALITY]:.0f} policies"]
        columns = [
            [100.0 * scores[policy][SUCCESS], scores[policy].get(TOTAL_UTILITY_ESR, scores[policy].get(UTILITY_ESR))]
            for policy in POLICIES
            if policy in scores
        ]
        return [" / ".join(f"{value:.3g}" for value in values) for values in zip(*columns, strict=True)] or ["", ""]
    except (OSError, AttributeError, KeyError, TypeError, ValueError) as error:
        raise ValueError(f"{str(path)!r} is not valid: {type(error).__name__}: {error}") from None


main = cli.Command("zoo", __doc__, (), list_zoo)
